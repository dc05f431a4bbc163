r"""Inverse dynamics on closures: the forces of chosen joints for a prescribed motion.

With a basis N of the velocities that keep the loops closed, M a + nle - forces = S^T tau - G^T lam
becomes

    N^T S^T tau = N^T (M a + nle - forces),

which does not contain the multipliers.  With more actuators than degrees of freedom, tau has least
weighted norm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.local_coordinates import tangent_basis
from srm_mbs.dynamics.constraints.reactions import Reactions
from srm_mbs.dynamics.constraints.structure import structure_of
from srm_mbs.dynamics.controllers import HeldForce
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.errors import InputError, counted, time_text
from srm_mbs.integration.kernel.observables import make_observables
from srm_mbs.model.coordinates import coordinate_names, joint_coordinates
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import positive_number
from srm_mbs.simulation.options import numbers
from srm_mbs.simulation.result import SimulationResult

MOTION_TOLERANCE = 1e-6
"""Default of ``tolerance``: relative error of the motion, and of its forces."""
RANK_TOLERANCE = 1e-12
"""Relative singular value below which the actuators do not act on a direction."""


@dataclass(frozen=True, eq=False)
class InverseDynamics:
    """Forces of the actuators for a motion.

    Attributes
    ----------
    t : (n,) s
        Times.
    actuated : na names
        Joints (``joint[i]`` where one has several coordinates).
    torques : (n, na)
        Their forces, N m and N.
    power : (n,) W
        Power that they transfer to the mechanism.
    residual : (n,)
        Missing force that the actuators cannot exert, over the largest that the motion needs.
    moved : (n,)
        How far the states of a run were moved onto the closures, over its tolerance; 0 for those
        that stayed as they were.
    """

    t: FloatArray
    actuated: tuple[str, ...]
    torques: FloatArray
    power: FloatArray
    residual: FloatArray
    moved: FloatArray
    _reactions: Callable[[], Reactions] = field(repr=False)

    def __repr__(self) -> str:
        moved = int((self.moved > 0.0).sum())
        also = f", {counted(moved, 'state')} moved onto the closures" if moved else ""
        return (
            f"InverseDynamics({len(self.t)} times, {len(self.actuated)} actuated coordinates, "
            f"residual at most {self.residual.max(initial=0.0):.2g}{also})"
        )

    @cached_property
    def _computed(self) -> Reactions:
        return self._reactions()

    @property
    def reactions(self) -> Mapping[str, FloatArray]:
        """Per loop (n, 6), as ``solution.reactions``; computed on first use."""
        return self._computed.closures

    @property
    def reaction_multipliers(self) -> Mapping[str, FloatArray]:
        """Per loop (n, rows), as ``solution.reaction_multipliers``."""
        return self._computed.multipliers

    @property
    def joint_reactions(self) -> Mapping[str, FloatArray]:
        """Per joint (n, 6), as ``solution.joint_reactions``, the actuators included."""
        return self._computed.joints


def _motion(
    mechanism: Mechanism, motion: Any, t: Any, tolerance: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """t (n,), q (n, nq), v (n, nv), a (n, nv) of a motion in any of its forms, and how far its
    states were moved onto the closures (n,)."""
    nq, nv = mechanism.model.nq, mechanism.model.nv
    if isinstance(motion, SimulationResult):
        if (motion.mechanism.model.nq, motion.mechanism.model.nv) != (nq, nv):
            raise InputError(
                "the run is one of another mechanism",
                element="motion",
                remedy="Give a run of this mechanism",
            )
        run = motion if t is None else motion.at(t)
        whole, moved = run.closed_motion(tolerance)
        q, v, a = np.split(whole, [nq, nq + nv], axis=1)
        return run.t, q, v, a, moved
    states: list[Any] | None = None
    if callable(motion):
        if t is None:
            raise InputError(
                "a motion given as a function needs times", element="t", remedy="Give t (n,)"
            )
        times = np.atleast_1d(numbers(t, "t", "Give times t (n,) in s"))
        states = [motion(float(time)) for time in times.ravel()]
    elif t is not None:
        raise InputError(
            "times are part of a motion that is given as arrays", element="t", remedy="Leave it out"
        )
    try:
        if states:
            motion = [times, *zip(*states, strict=True)]
        elif states is not None:
            motion = [times, np.zeros((0, nq)), np.zeros((0, nv)), np.zeros((0, nv))]
        parts = [np.array(part, dtype=float) for part in motion]
    except Exception:  # objects may raise anything
        parts = []
    n = len(parts[0]) if parts and parts[0].ndim == 1 else 0
    shapes = [part.shape for part in parts]
    if shapes != [(n,), (n, nq), (n, nv), (n, nv)] or not all(
        np.isfinite(part).all() for part in parts
    ):
        raise InputError(
            f"a motion of shapes {shapes}, or with values that are not finite, cannot be",
            element="motion",
            remedy=f"Give a solution, (t, q, v, a) of shapes (n,), (n, {nq}), (n, {nv}), "
            f"(n, {nv}), or a function of t that returns q, v, a",
        )
    return parts[0], parts[1], parts[2], parts[3], np.zeros(n)


def inverse_dynamics(
    mechanism: Mechanism,
    motion: Any,
    actuated: str | Iterable[str] | None = None,
    *,
    t: Any = None,
    weights: Any = None,
    tolerance: float = MOTION_TOLERANCE,
) -> InverseDynamics:
    """Compute the forces of the actuated joints for a motion.

    Parameters
    ----------
    mechanism
        Its gravity, force elements, damping and friction act as well.
    motion
        A run (:class:`~srm_mbs.Solution`; the forces include that of its controller), arrays
        (t, q, v, a) of shapes (n,), (n, nq), (n, nv), (n, nv), or a function of t that returns q,
        v, a.  States of a run beyond ``tolerance`` are moved onto the closures if that takes at
        most ten tolerances of the run, as starts of :func:`srm_mbs.simulate` are.
    actuated
        Names of the joints with actuators; by default all joints.
    t : (n,) s
        Times of a function or a run.
    weights : (na,)
        If the forces are not unique, the sum of weight times squared force is minimal; by default
        ones, 1/(N m)^2 and 1/N^2.
    tolerance
        Largest error of the motion in the closures, over units and rates, and largest missing
        force, over the largest needed.

    Raises
    ------
    InputError
        If the motion violates the closures, includes a singular configuration, or needs forces that
        the actuated joints cannot exert.
    """
    check_mechanism(mechanism)
    tolerance = positive_number(tolerance, "tolerance")
    mechanism = mechanism.undriven  # the actuators replace the drives
    times, q, v, a, moved = _motion(mechanism, motion, t, tolerance)
    names = mechanism.joint_names if actuated is None else actuated
    columns = joint_coordinates(mechanism, (names,) if isinstance(names, str) else names)
    labels = coordinate_names(mechanism)
    count = len(columns)
    weight = np.ones(count)
    if weights is not None:
        weight = numbers(weights, "weights", f"Give {count} positive numbers")
    if weight.shape != (count,) or not np.all(weight > 0.0):
        raise InputError(
            f"weights of shape {weight.shape} do not fit {count} actuated coordinates",
            element="weights",
            remedy=f"Give {count} positive numbers",
        )
    geometry = ClosureGeometry(mechanism, np.array(mechanism.q0))
    unit, nv = geometry.unit, mechanism.model.nv
    free = nv - mechanism.structure.rank
    system = make_system(mechanism)
    torques, missing, needed = np.zeros((len(times), count)), np.zeros(len(times)), 0.0
    for i, time in enumerate(times):
        with np.errstate(over="ignore", invalid="ignore"):
            _check_motion(geometry, time, q[i], v[i] / unit, a[i] / unit, tolerance)
        basis, _ = tangent_basis(geometry, q[i], np.arange(nv))
        if basis.shape[1] != free:
            raise InputError(
                f"at t = {time_text(time)} s the motion is on a singular configuration, where the "
                "forces of the actuators are not determined",
                element="motion",
                remedy="Leave this time out",
            )
        inertial = geometry.mass() @ (a[i] / unit)
        own = system.working_force(time, q[i], v[i]) + system.inertial_force(q[i], v[i])
        right = basis.T @ (inertial - own * unit)
        needed = max(needed, *np.abs(right), *np.abs(basis.T @ inertial), 0.0)
        reach = basis[columns].T * (unit[columns] / np.sqrt(weight))
        found = np.linalg.lstsq(reach, right, rcond=RANK_TOLERANCE)[0]
        torques[i] = found / np.sqrt(weight)
        missing[i] = np.abs(reach @ found - right).max(initial=0.0)
    residual = missing / needed if needed else missing
    if residual.max(initial=0.0) > tolerance:
        worst = int(np.argmax(residual))
        raise InputError(
            f"{', '.join(labels[j] for j in columns)} cannot drive this motion of "
            f"{counted(free, 'degree')} of freedom: at t = {time_text(times[worst])} s "
            f"{residual[worst]:.1e} of the largest force is missing",
            element="actuated",
            remedy="Name more joints",
        )

    power = (torques * v[:, columns]).sum(axis=1)
    reactions = partial(_reactions, mechanism, times, q, v, torques, columns)
    return InverseDynamics(
        times, tuple(labels[j] for j in columns), torques, power, residual, moved, reactions
    )


def _check_motion(
    geometry: ClosureGeometry,
    time: float,
    q: FloatArray,
    u: FloatArray,
    a: FloatArray,
    tolerance: float,
) -> None:
    """Refuse positions, rates u and accelerations a, in units, that violate the closures."""
    g, G = geometry.closure(q)
    # At rest the error is rounding: it is compared with the characteristic rate.
    rate = structure_of(geometry.mechanism).units.rate
    speed = np.abs(u).max(initial=rate)
    bias = geometry.bias(q, u) * geometry.row_size
    checks = (
        ("positions", g, 1.0),
        ("rates", G @ u, speed),
        ("accelerations", G @ a + bias, np.abs(a).max(initial=speed * speed)),
    )
    for what, error, size in checks:
        worst = np.abs(error).max(initial=0.0)
        if not np.isfinite(worst + size):
            raise InputError(
                f"at t = {time_text(time)} s the motion is so fast that its accelerations overflow",
                element="motion",
                remedy="Give rates in rad/s and m/s, accelerations in rad/s^2 and m/s^2",
            )
        if worst > tolerance * size:
            raise InputError(
                f"at t = {time_text(time)} s the {what} of the motion violate the closures by "
                f"{worst / size:.1e}",
                element="motion",
                remedy="Close positions and rates with srm.assemble, or simulate a motion",
            )


def _reactions(
    mechanism: Mechanism,
    times: FloatArray,
    q: FloatArray,
    v: FloatArray,
    torques: FloatArray,
    columns: IndexArray,
) -> Reactions:
    """The reactions at n states, with the forces (n, na)."""
    acting = np.zeros(v.shape)
    acting[:, columns] = torques
    system = make_system(mechanism, HeldForce())
    return make_observables(system).reactions(times, q, v, acting)
