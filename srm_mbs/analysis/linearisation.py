r"""Linearisation on the closures: x' = A x + B tau with x = (z, w).

z (k,) are minimal coordinates around the state
(:mod:`srm_mbs.dynamics.constraints.local_coordinates`), here k joint coordinates, and w their
rates: L v, which is z' unless a ball, planar or free joint moves.  A comes from central differences
of order 6 of the constrained dynamics on the closures; B is exact, because the accelerations are
linear in the forces.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import ComplexArray, FloatArray, IndexArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.local_coordinates import TangentChart, differences, tangent_basis
from srm_mbs.dynamics.constraints.projection import cholesky, unwhiten, whiten
from srm_mbs.dynamics.controllers import Controller
from srm_mbs.dynamics.forces import friction_sums, resolved_forces
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.dynamics.singularities.local_analysis import TAU
from srm_mbs.errors import InputError, counted, get_logger, naming, safe_repr
from srm_mbs.model.coordinates import coordinate_names, joint_coordinates
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import finite_number, positive_integer, positive_number
from srm_mbs.model.validation import STATE_ARGUMENTS
from srm_mbs.simulation.consistency import closed_start
from srm_mbs.simulation.options import RunOptions
from srm_mbs.simulation.runner import checked_accuracy, error_norm
from srm_mbs.visualization.animation.joint_motion import JointMotion

log = get_logger(__name__)

FRICTION_STEP = 0.01
"""Largest difference of rates, over the friction speed."""
INDEPENDENCE_TOLERANCE = 1e-6
"""Smallest singular value of coordinates that determine the others."""
FRAMES = 120
"""Default number of frames of a mode shape."""


@dataclass(frozen=True, eq=False)
class Linearisation:
    """x' = A x + B tau + drift, with x = (z, w) counted from the state.

    Attributes
    ----------
    q : (nq,), v : (nv,)
        The state, on the closures.
    A : (2 k, 2 k), B : (2 k, ni)
        System and input matrix; rad, m, s, N, N m.
    coordinates : k names
        Joints (``joint[i]`` where one has several coordinates) whose positions are z.
    inputs : ni names
        Joints whose forces are tau, likewise.
    drift : (2 k,)
        x' at the state itself: (z', z''), zero at an equilibrium.
    to_joints : (nv, k)
        Velocity of all joints per w: the motion of the mechanism in each coordinate.
    moved
        How far the given state was moved onto the closures, over the tolerance of its run; 0 if it
        stayed as it was.
    eigenvalues : (2 k,)
        Of A, 1/s, slowest first; conjugate pairs together.
    """

    mechanism: Mechanism
    q: FloatArray
    v: FloatArray
    A: FloatArray
    B: FloatArray
    coordinates: tuple[str, ...]
    inputs: tuple[str, ...]
    drift: FloatArray
    to_joints: FloatArray
    moved: float
    chart: TangentChart

    def __repr__(self) -> str:
        k, ni = len(self.coordinates), len(self.inputs)
        return (
            f"Linearisation({self.mechanism.name!r}, {counted(k, 'coordinate')}, "
            f"{counted(ni, 'input')}, {'stable' if self.stable else 'not stable'})"
        )

    def __str__(self) -> str:
        shown = {
            "coordinates z": ", ".join(self.coordinates),
            "inputs tau": ", ".join(self.inputs),
            "q": self.q,
            "v": self.v,
            "A": self.A,
            "B": self.B,
            "drift": self.drift,
            "eigenvalues (1/s)": self.eigenvalues,
        }
        if self.moved:
            shown["q and v were moved onto the closures, over the tolerance by"] = (
                f"{self.moved:.2g}"
            )
        return "\n".join([repr(self), *(f"{name}:\n{value}" for name, value in shown.items())])

    @cached_property
    def _eigen(self) -> tuple[FloatArray | ComplexArray, FloatArray | ComplexArray]:
        values, vectors = np.linalg.eig(self.A)
        order = np.lexsort((-values.imag, -values.real, np.round(np.abs(values.imag), 9)))
        return values[order], vectors[:, order]

    @property
    def eigenvalues(self) -> FloatArray | ComplexArray:
        """Eigenvalues of A (2 k,), 1/s; complex unless all of them are real."""
        return self._eigen[0]

    @cached_property
    def modes(self) -> FloatArray | ComplexArray:
        """Joint motions (nv, 2 k) of each eigenvalue, complex as they are; the largest entry, in
        units, is 1."""
        k = len(self.coordinates)
        unit = self.chart.geometry.unit
        shapes = self.to_joints @ self._eigen[1][:k]
        largest = np.argmax(np.abs(shapes) / unit[:, None], axis=0)
        size = shapes[largest, range(shapes.shape[1])] / unit[largest]
        # A mode without joint motion has rates only: it belongs to a double eigenvalue zero.
        return shapes / np.where(size == 0.0, 1.0, size)

    @property
    def frequencies(self) -> FloatArray:
        """Natural frequency |eigenvalue|/(2 pi) (2 k,) in Hz."""
        out: FloatArray = np.abs(self.eigenvalues) / (2.0 * np.pi)
        return out

    @property
    def damping_ratios(self) -> FloatArray:
        """-Re/|eigenvalue| (2 k,): 0 undamped, 1 aperiodic, negative unstable; nan at zero."""
        size = np.abs(self.eigenvalues)
        out: FloatArray = np.full(len(size), np.nan)
        np.divide(-self.eigenvalues.real, size, out=out, where=size > 0.0)
        return out

    @property
    def stable(self) -> bool:
        """Whether every eigenvalue has a negative real part (rounding apart)."""
        size = max(float(np.abs(self.eigenvalues).max(initial=0.0)), 1e-300)
        return bool(np.all(self.eigenvalues.real < -1e-9 * size))

    def mode_shape(self, mode: int, amplitude: float = 0.2, frames: int = FRAMES) -> JointMotion:
        """One period of a mode as a motion that can be animated, with closed loops in every frame.

        Growth and decay are left out, so that it can be repeated.

        Parameters
        ----------
        mode
            Index of its eigenvalue.
        amplitude
            Largest motion of a joint: rad, or scene diagonals.
        frames
            Number of frames.

        Returns
        -------
        JointMotion
            Its period is that of the eigenvalue; 1 s if that does not oscillate.

        Raises
        ------
        InputError
            If there is no such mode, the mechanism cannot move that far, ``amplitude`` is no finite
            number, or ``frames`` no positive integer.
        """
        frames = positive_integer(frames, "frames", f"Give a positive number, for example {FRAMES}")
        count = len(self.eigenvalues)
        if not isinstance(mode, Integral) or not -count <= mode < count:
            raise InputError(
                f"there is no mode {safe_repr(mode)}",
                element="mode",
                remedy=f"Give 0 to {count - 1}",
            )
        amplitude = finite_number(amplitude, "amplitude", "amplitude")
        mode = int(mode)
        turning = abs(float(self.eigenvalues[mode].imag))
        period = 2.0 * np.pi / turning if turning > 0.0 else 1.0
        # Coordinates of the shape: z = L times the joint motion.
        shape = self.chart.left @ (self.modes[:, mode] / self.chart.geometry.unit)
        phases = np.linspace(0.0, 2.0 * np.pi, frames + 1)
        configurations = []
        for phase in phases:
            point = self.chart.point(amplitude * (shape * np.exp(1j * phase)).real)
            if point is None:
                raise InputError(
                    f"the loops do not close at an amplitude of {amplitude:g}",
                    element="amplitude",
                    remedy="Give a smaller one",
                )
            configurations.append(point.q)
        return JointMotion(self.mechanism, period * phases / phases[-1], np.array(configurations))


def _chosen(mechanism: Mechanism, basis: FloatArray, names: Iterable[str] | None) -> IndexArray:
    """Coordinates that determine the motion: those of ``names``, or the ones that move most."""
    k = basis.shape[1]
    if names is None:
        from scipy.linalg import qr

        return np.sort(qr(basis.T, mode="r", pivoting=True)[1][:k])
    with naming(element="coordinates"):
        chosen = joint_coordinates(mechanism, names)
    smallest = (
        np.linalg.svd(basis[chosen], compute_uv=False).min(initial=1.0) if len(chosen) == k else 0.0
    )
    if smallest < INDEPENDENCE_TOLERANCE:
        raise InputError(
            f"{counted(len(chosen), 'coordinate')} of these joints cannot determine the "
            f"{counted(k, 'degree')} of freedom here",
            element="coordinates",
            remedy=f"Name joints with {counted(k, 'independent coordinate')}, or none",
        )
    return chosen


def linearise(
    mechanism: Mechanism,
    q: Any = None,
    v: Any = None,
    *,
    controller: Controller | None = None,
    inputs: str | Iterable[str] | None = None,
    coordinates: str | Iterable[str] | None = None,
    step: float = TAU,
    rtol: float = 1e-6,
) -> Linearisation:
    """Linearise the equations of motion of a mechanism at a state.

    Parameters
    ----------
    mechanism
        Gravity, force elements, joint damping and (smoothed) friction act; elements with a law over
        time at their value for t = 0.
    q : (nq,), v : (nv,)
        The state, with closed loops and consistent rates.  By default the initial state; at rest
        if only q is given.
    controller
        A control law tau(t, q, v), at t = 0, with which the closed loop is linearised.
    inputs
        Names of the joints whose forces are the inputs of B; all joints by default.
    coordinates
        Names of the joints whose positions are z; by default those that move most.
    step
        Step of the differences, rad or scene diagonals; their error is proportional to its sixth
        power.
    rtol
        Relative tolerance of the run that the state is from.  A state that violates the closures by
        more than 1e-8 is moved onto them if that takes at most ten tolerances, as starts of
        :func:`srm_mbs.simulate` are.

    Raises
    ------
    InputError
        If the state is not consistent, or singular (there the closures leave no tangent space of
        the right size), or names do not fit.
    """
    check_mechanism(mechanism)
    mechanism.refuse_drives("a linearisation")
    step = positive_number(step, "step")
    if q is None:
        q, v = mechanism.q0, mechanism.v0 if v is None else v
    v = np.zeros(mechanism.model.nv) if v is None else v
    mechanism = mechanism.moved(q, v)
    options = checked_accuracy(mechanism, RunOptions(np.inf, rtol=rtol), 0.0, np.inf)
    state, moved = closed_start(
        mechanism,
        0.0,
        error_norm(mechanism, options),
        names=STATE_ARGUMENTS,
        remedy="Use srm.assemble(mechanism, q=..., v=...), or give the rtol of the run that the "
        "state is from",
    )
    q, v = np.split(state, [mechanism.model.nq])
    mechanism = mechanism.moved(q, v)
    geometry = ClosureGeometry(mechanism, q)
    unit, nv = geometry.unit, mechanism.model.nv
    everything = np.arange(nv)
    basis, _ = tangent_basis(geometry, q, everything)
    k = nv - mechanism.structure.rank
    if basis.shape[1] != k:
        raise InputError(
            f"the closures leave {basis.shape[1]} directions of motion at this configuration, and "
            f"{k} next to it: it is singular",
            element="q",
            remedy="Linearise at a regular configuration",
        )
    given = (coordinates,) if isinstance(coordinates, str) else coordinates
    chosen = _chosen(mechanism, basis, given)
    chart = TangentChart(geometry, q, basis, everything, chosen)
    system = make_system(mechanism, controller)

    def field(x: FloatArray) -> FloatArray:
        """(z', w') at x = (z, w), in units."""
        point = chart.point(x[:k])
        if point is None:
            raise InputError(
                "the loops do not close at the steps of the differences",
                element="step",
                remedy="Give a smaller step: a singular configuration may be close",
            )
        w = start + x[k:]
        state = np.concatenate([point.q, unit * (point.velocities @ w)])
        rate = system.evaluate(0.0, state).rate()[nv:] / unit
        return np.concatenate([point.rate_matrix @ w, chart.left @ rate])

    start = chart.left @ (v / unit)
    velocities = chart.basis
    size = max(mechanism.structure.units.rate, float(np.abs(start).max(initial=0.0)))
    rubs = friction_sums(mechanism.model, resolved_forces(mechanism))
    reach = np.abs(rubs @ (unit[:, None] * velocities)).max(initial=0.0)
    if reach > 0.0:
        size = min(size, FRICTION_STEP * mechanism.friction_speed / (reach * step))
    steps = step * np.concatenate([np.ones(k), np.full(k, size)])
    scale = np.tile(unit[chosen], 2)
    A = differences(field, steps) * scale[:, None] / scale
    names = mechanism.joint_names if inputs is None else inputs
    with naming(element="inputs"):
        columns = joint_coordinates(mechanism, (names,) if isinstance(names, str) else names)
    drift = field(np.zeros(2 * k)) * scale
    # The factorisation at the state gives the response to forces.
    terms = system.evaluate(0.0, np.concatenate([q, v]))
    U = cholesky(pin.crba(mechanism.model, workspace(mechanism.model), q))
    pushed = unwhiten(U, whiten(U, np.asfortranarray(np.eye(nv)[:, columns])))
    response = np.array([w - terms.project(w) for w in pushed.T]).reshape(-1, nv).T
    B = np.vstack([np.zeros((k, len(columns))), response[chosen]])
    labels = coordinate_names(mechanism)
    log.debug("%s: linearised in %d coordinates", mechanism.name, k)
    return Linearisation(
        mechanism,
        q,
        v,
        A,
        B,
        tuple(labels[i] for i in chosen),
        tuple(labels[i] for i in columns),
        drift,
        unit[:, None] * velocities / unit[chosen],
        moved,
        chart,
    )
