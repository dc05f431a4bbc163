"""All assembly modes: the closed configurations of a mechanism for given held joints.

Newton's method closes the loops from many starts, some structured (each joint rotated by quarter
turns), the others random; its results are sorted into distinct modes.  The number of starts that
led to each mode indicates how likely it is that none is missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.assembly.assemble import Assembly, assemble
from srm_mbs.assembly.position import (
    ClosureProblem,
    close_positions,
    onto_singular_point,
    polish,
    turned_within_limits,
)
from srm_mbs.dynamics.constraints.local_coordinates import tangent_basis
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.errors import InputError, counted, get_logger, naming, safe_repr, warn
from srm_mbs.model.coordinates import coordinate_names, free_coordinates, set_position
from srm_mbs.model.numbers import name_list, named_values, positive_integer

log = get_logger(__name__)

SAME_MODE_TOLERANCE = 1e-6
"""Largest difference (rad, scene diagonals) of two solutions of one mode."""
INDEPENDENCE_TOLERANCE = 1e-6
"""Smallest rate of a joint, over that of the motion, with which it moves."""
MAX_NEWTON_STEPS = 40
"""Most Newton steps from one start; longer iterations mostly do not converge."""
REACH, KEPT = 0.02, 0.3
"""Motion (rad, scene diagonals) with which a singular mode is tried, and the part of it that a
configuration keeps which is closed again and belongs to a motion."""
MIN_MOVABLE_MODES = 3
"""Number of modes in which the mechanism can move after which the search ends."""


@dataclass(frozen=True, eq=False)
class AssemblyMode(Assembly):
    """One assembly mode.

    Attributes
    ----------
    found, starts
        Number of starts that led to this mode, and of all starts.
    held
        Names of the joints that were held.
    """

    found: int
    starts: int
    held: tuple[str, ...]


def _joints_to_hold(mechanism: Mechanism, problem: ClosureProblem, q: FloatArray) -> list[str]:
    """Joints of one degree of freedom that together prevent every motion at q, those closest to the
    ground first."""
    depth = {
        name: len(mechanism.model.supports[k + 1]) for k, name in enumerate(mechanism.joint_names)
    }
    rest, _ = tangent_basis(problem, q, np.arange(mechanism.model.nv))
    chosen = []
    for name in sorted(mechanism.joint_names, key=lambda name: depth[name]):
        joint = mechanism.joint(name)
        row = rest[joint.idx_v]
        if joint.nv > 1 or not np.linalg.norm(row) > INDEPENDENCE_TOLERANCE:
            continue
        chosen.append(name)
        # The motions that remain: the null space of its row.
        rest = rest @ np.linalg.svd(row[None])[2][1:].T
    return chosen


def _starts(
    problem: ClosureProblem, q: FloatArray, free: IndexArray, count: int, seed: int
) -> Iterable[FloatArray]:
    """``count`` configurations: q, its mirror image, quarter turns of each joint, then random."""
    rng = np.random.default_rng(seed)
    shifts = [np.zeros(len(free)), -2.0 * problem.difference(pin.neutral(problem.model), q)[free]]
    for angle in (np.pi, 0.5 * np.pi, -0.5 * np.pi):
        shifts += list(angle * np.eye(len(free)))
    for k in range(count):
        # At most half of them are structured.
        if k < min(len(shifts), count // 2):
            yield problem.move(q, shifts[k], free)
        else:
            yield problem.move(q, rng.uniform(-np.pi, np.pi, len(free)), free)


def _apart(problem: ClosureProblem, a: FloatArray, b: FloatArray) -> float:
    """Largest difference of two configurations in units, angles of hinges modulo 2 pi."""
    away = problem.difference(a, b)
    periodic = problem.periodic
    away[periodic] = (away[periodic] + np.pi) % (2.0 * np.pi) - np.pi
    return float(np.abs(away).max(initial=0.0))


def _moves(problem: ClosureProblem, mode: FloatArray, free: IndexArray) -> bool:
    """Whether closed configurations with the same held joints lie next to a mode: at a singular
    one, tangents alone do not tell."""
    basis, _ = tangent_basis(problem, mode, free)
    for way in (*basis.T, *-basis.T):
        beside = polish(problem, problem.move(mode, REACH * way), free)
        if problem.closed(beside) and _apart(problem, mode, beside) > KEPT * REACH * max(abs(way)):
            return True
    return False


def assembly_modes(
    mechanism: Mechanism,
    q: Mapping[str, Any] | None = None,
    *,
    hold: str | Iterable[str] | None = None,
    starts: int = 200,
    seed: int = 0,
) -> list[AssemblyMode]:
    """Find all closed configurations with some joints held.

    Parameters
    ----------
    q
        Joint name -> position that is held (as for :func:`srm_mbs.assemble`); the others start from
        the initial configuration.
    hold
        Further joints that keep their initial position.  If neither is given, as many joints of one
        degree of freedom as the mechanism has degrees of freedom are held, those closest to the
        ground first.
    starts, seed
        Number of starts, and seed of the random ones among them.

    Returns
    -------
    list of AssemblyMode
        At rest, the one closest to the initial configuration first; hinge angles within half a turn
        of it, or a whole number of turns away, within the limits of their joint.  Modes that lie
        beyond limits are listed as well; configurations in which the mechanism still moves with
        these joints held are not, and a warning counts them.  If one was ``found`` from few starts
        only, others may be missing; more ``starts`` find them.  Empty if no configuration closes.

    Raises
    ------
    InputError
        If the held joints leave the mechanism free to move, so that modes are not isolated, or for
        unknown joints or malformed values.
    """
    starts = positive_integer(starts, "starts", "Give a positive number, for example 200")
    if not isinstance(seed, Integral) or seed < 0:
        raise InputError(
            f"seed = {safe_repr(seed)} is not a natural number",
            element="seed",
            remedy="Give 0, 1, 2 ...",
        )
    check_mechanism(mechanism)
    positions = named_values(q, "q")
    further = () if hold is None else name_list(hold, "hold")
    mechanism = mechanism.undriven  # modes are those of the loops alone
    if not mechanism.loops:
        raise InputError(
            "a mechanism without loops has no assembly modes",
            element="loop",
            remedy="Give a mechanism with closures",
        )
    start = np.array(mechanism.q0)
    for name, value in positions.items():
        with naming(element="q"):
            set_position(mechanism, start, name, value)
    problem = ClosureProblem(mechanism, start)
    if q is None and hold is None:
        held = tuple(_joints_to_hold(mechanism, problem, start))
    else:
        held = tuple(dict.fromkeys([*positions, *further]))
    free = free_coordinates(mechanism, held)
    modes: list[FloatArray] = []
    counts: list[int] = []
    for guess in _starts(problem, start, free, int(starts), int(seed)):
        closed = close_positions(problem, guess, free, MAX_NEWTON_STEPS)
        if not problem.closed(closed):
            continue
        closed = onto_singular_point(problem, closed, free)
        distances = [_apart(problem, closed, mode) for mode in modes]
        if distances and min(distances) < SAME_MODE_TOLERANCE:
            counts[int(np.argmin(distances))] += 1
            continue
        modes.append(closed)
        counts.append(1)
        if len(modes) >= MIN_MOVABLE_MODES:
            _check_isolated(mechanism, problem, modes, free, held)
    if modes:
        _check_isolated(mechanism, problem, modes, free, held)
    movable = [_moves(problem, mode, free) for mode in modes]
    if any(movable):
        warn(
            f"{sum(np.compress(movable, counts))} of {starts} starts led to closed configurations "
            f"in which the mechanism still moves with {', '.join(held)} held, as where links lie "
            "on each other: they are no assembly modes, and left out"
        )
        modes, counts = (
            [one for one, moves in zip(every, movable) if not moves] for every in (modes, counts)
        )
    log.debug("%s: %d assembly modes from %d starts", mechanism.name, len(modes), int(starts))
    order = sorted(range(len(modes)), key=lambda k: problem.distance(modes[k]))
    return [
        AssemblyMode(
            **vars(assemble(mechanism, turned_within_limits(problem, modes[k], free), hold=held)),
            found=counts[k],
            starts=int(starts),
            held=held,
        )
        for k in order
    ]


def _check_isolated(
    mechanism: Mechanism,
    problem: ClosureProblem,
    modes: list[FloatArray],
    free: IndexArray,
    held: tuple[str, ...],
) -> None:
    bases = [tangent_basis(problem, mode, free)[0] for mode in modes]
    least = min(bases, key=lambda basis: basis.shape[1])
    everything = np.arange(mechanism.model.nv)
    # A singular mode can be isolated although its tangent space has more directions.
    singular = all(
        tangent_basis(problem, mode, everything)[0].shape[1] > mechanism.degrees_of_freedom
        for mode in modes
    )
    if not least.shape[1] or (singular and len(modes) < MIN_MOVABLE_MODES):
        return
    moving = np.flatnonzero(np.linalg.norm(least, axis=1) > INDEPENDENCE_TOLERANCE)
    labels = coordinate_names(mechanism)
    what = f"with {', '.join(held)} held" if held else "with no joint held"
    raise InputError(
        f"{what} the mechanism can still move ({counted(least.shape[1], 'degree')} of freedom): "
        "its closed configurations are not isolated",
        element="hold",
        remedy=f"Hold more; free to move are {', '.join(labels[i] for i in moving)}",
    )
