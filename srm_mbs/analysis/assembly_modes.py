"""All assembly modes: the closed configurations that a mechanism has for given held joints.

Closing starts from many configurations, some structured (each joint turned by quarter turns), the
rest random; what is found is sorted into distinct modes.  How often each was found says how sure
it is that none is missing.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.assembly.assemble import Assembly, assemble
from srm_mbs.assembly.position import ClosureProblem, close_positions, onto_singular_point
from srm_mbs.dynamics.constraints.local_coordinates import tangent_basis
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError
from srm_mbs.model.coordinates import coordinate_names, free_coordinates, set_position

log = logging.getLogger(__name__)

SAME = 1e-6
"""Largest difference (rad, scene diagonals) of two closings of one mode."""
INDEPENDENT = 1e-6
"""Part of a motion that holding a joint must stop to count."""
SEARCH_STEPS = 40
"""Of one closing: what takes longer mostly ends where nothing closes."""
LOOKS = 3
"""Modes that must leave the mechanism free to move before the search is given up."""


@dataclass(frozen=True, eq=False)
class AssemblyMode(Assembly):
    """One assembly mode.

    Attributes
    ----------
    found, starts
        How many of the starts led to it, of how many.
    held
        Names of the joints that were held.
    """

    found: int
    starts: int
    held: tuple[str, ...]


def _joints_to_hold(mechanism: Mechanism, problem: ClosureProblem, q: FloatArray) -> list[str]:
    """One-degree joints, those next to the ground first, that together stop every motion at q."""
    depth = {
        name: len(mechanism.model.supports[k + 1]) for k, name in enumerate(mechanism.joint_names)
    }
    rest, _ = tangent_basis(problem, q, np.arange(mechanism.model.nv))
    chosen = []
    for name in sorted(mechanism.joint_names, key=lambda name: depth[name]):
        joint = mechanism.joint(name)
        row = rest[joint.idx_v]
        if joint.nv > 1 or not np.linalg.norm(row) > INDEPENDENT:
            continue
        chosen.append(name)
        # What is left moves without it: the complement of its row.
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
        # At most half of them structured.
        if k < min(len(shifts), count // 2):
            yield problem.move(q, shifts[k], free)
        else:
            yield problem.move(q, rng.uniform(-np.pi, np.pi, len(free)), free)


def _apart(problem: ClosureProblem, a: FloatArray, b: FloatArray) -> float:
    """Largest difference of two configurations in units, hinges modulo whole turns."""
    away = problem.difference(a, b)
    periodic = problem.periodic
    away[periodic] = (away[periodic] + np.pi) % (2.0 * np.pi) - np.pi
    return float(np.abs(away).max(initial=0.0))


def assembly_modes(
    mechanism: Mechanism,
    q: Mapping[str, Any] | None = None,
    *,
    hold: str | Iterable[str] | None = None,
    starts: int = 200,
    seed: int = 0,
) -> list[AssemblyMode]:
    """All closed configurations that were found with some joints held.

    Parameters
    ----------
    q
        Joint name -> position that is held (as for :func:`srm_mbs.assemble`); the others start from
        the initial configuration.
    hold
        Further joints that keep their initial position.  If neither is given, as many one-degree
        joints as there are degrees of freedom are held, those next to the ground first.
    starts, seed
        Number of configurations from which closing starts, and seed of the random ones among them.

    Returns
    -------
    list of AssemblyMode
        At rest, the one nearest to the initial configuration first; hinge angles within half a turn
        of it.  Each says how often it was ``found``: where one was found only a few times, more may
        be missing, and more ``starts`` would tell.  Empty if nothing closes.

    Raises
    ------
    InputError
        If the held joints leave the mechanism free to move, so that modes are not isolated, or for
        unknown joints or malformed values.
    """
    if not isinstance(starts, Integral) or starts < 1:
        raise InputError(
            f"starts = {starts!r} is not a positive whole number",
            element="starts",
            remedy="Give a positive number, for example 200",
        )
    if not isinstance(seed, Integral) or seed < 0:
        raise InputError(
            f"seed = {seed!r} is not a natural number", element="seed", remedy="Give 0, 1, 2 ..."
        )
    mechanism = mechanism.undriven  # modes are those of the loops
    if not mechanism.loops:
        raise InputError(
            "a mechanism without loops has no assembly modes",
            element="loop",
            remedy="Give a mechanism with closures",
        )
    start = np.array(mechanism.q0)
    for name, value in (q or {}).items():
        set_position(mechanism, start, name, value)
    further = (hold,) if isinstance(hold, str) else tuple(hold or ())
    problem = ClosureProblem(mechanism, start)
    if q is None and hold is None:
        held = tuple(_joints_to_hold(mechanism, problem, start))
    else:
        held = tuple(dict.fromkeys([*(q or {}), *further]))
    free = free_coordinates(mechanism, held)
    modes: list[FloatArray] = []
    counts: list[int] = []
    for guess in _starts(problem, start, free, int(starts), int(seed)):
        closed = close_positions(problem, guess, free, SEARCH_STEPS)
        if not problem.closed(closed):
            continue
        closed = onto_singular_point(problem, closed, free)
        distances = [_apart(problem, closed, mode) for mode in modes]
        if distances and min(distances) < SAME:
            counts[int(np.argmin(distances))] += 1
            continue
        modes.append(closed)
        counts.append(1)
        if len(modes) >= LOOKS:
            _check_isolated(mechanism, problem, modes, free, held)
    if modes:
        _check_isolated(mechanism, problem, modes, free, held)
    log.debug("%s: %d assembly modes from %d starts", mechanism.name, len(modes), int(starts))
    order = sorted(range(len(modes)), key=lambda k: problem.distance(modes[k]))
    return [
        AssemblyMode(
            **vars(assemble(mechanism, modes[k], hold=held)),
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
    # A singular mode can be isolated though the closures seem to let it move.
    singular = all(
        tangent_basis(problem, mode, everything)[0].shape[1] > mechanism.degrees_of_freedom
        for mode in modes
    )
    if not least.shape[1] or (singular and len(modes) < LOOKS):
        return
    moving = np.flatnonzero(np.linalg.norm(least, axis=1) > INDEPENDENT)
    labels = coordinate_names(mechanism)
    what = f"with {', '.join(held)} held" if held else "with no joint held"
    raise InputError(
        f"{what} the mechanism can still move ({least.shape[1]} degrees of freedom): its closed "
        "configurations are not isolated",
        element="hold",
        remedy=f"Hold more; free to move are {', '.join(labels[i] for i in moving)}",
    )
