"""Consistent initial states: positions that close the loops, then velocities that keep them closed.

Positions come from :mod:`srm_mbs.assembly.position`, velocities from
:mod:`srm_mbs.assembly.velocity`.  Drives that prescribe positions, not only motions from the
initial ones, hold their coordinates where their laws begin.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.assembly.diagnosis import cannot_close, limits_in_the_way
from srm_mbs.assembly.position import (
    ClosureProblem,
    assemble_positions,
    assemble_within_limits,
    beyond_limits,
)
from srm_mbs.assembly.regular_start import regular_start
from srm_mbs.assembly.velocity import assemble_velocity
from srm_mbs.dynamics.constraints.geometry import DriveRows
from srm_mbs.dynamics.constraints.row_algebra import null_basis
from srm_mbs.dynamics.constraints.structure import structure_of
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.dynamics.singularities.local_analysis import SINGULAR
from srm_mbs.errors import AssemblyError, EvaluationError, InputError, get_logger, naming
from srm_mbs.model.coordinates import free_coordinates, set_position, set_rate
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import finite_numbers, flag, name_list, named_values

log = get_logger(__name__)

LARGEST_CONTRADICTION = 1e-9
"""Largest difference (rad, m) between a held position and the initial value of a drive."""
ARRAY_OR_MAPPING = "Give an array, or a mapping from joint names to values"
"""Remedy for malformed q and v."""


def _with_absolute_drives(
    mechanism: Mechanism, start: FloatArray, held: tuple[str, ...]
) -> tuple[tuple[str, ...], Mechanism]:
    """Hold absolute drives at their initial values: joints in ``start`` and ``held``, points by
    additional loops of the mechanism.

    Raises
    ------
    AssemblyError
        If a held position contradicts a drive.
    """
    loops = list(mechanism.loops)
    for drive in mechanism.drives:
        if not drive.absolute:
            continue
        value = drive.curve(0.0)(0.0)[0]
        if drive.joint is None:
            loops.append(drive.frozen(value))
            continue
        driven = start.copy()
        set_position(mechanism, driven, drive.joint, value)
        if drive.joint in held and np.abs(driven - start).max() > LARGEST_CONTRADICTION:
            raise AssemblyError(
                f"the held position of {drive.joint!r} contradicts the drive {drive.name!r}, "
                f"which begins at {value:.6g}",
                residuals={},
                q=start,
                held=(drive.joint,),
                element="initial.q",
                remedy="Free it, or remove absolute from the drive: its law then begins there",
            )
        start[:] = driven
        held = tuple(dict.fromkeys((*held, drive.joint)))
    if len(loops) == len(mechanism.loops):
        return held, mechanism
    return held, replace(mechanism, loops=tuple(loops), drives=())


@dataclass(frozen=True, eq=False)
class Assembly:
    """A consistent state.

    Attributes
    ----------
    q : (nq,), v : (nv,)
        Configuration and velocity with closed loops and consistent rates.
    residuals : (rows,)
        Closure errors left at q, m and rad; those of the drives last.
    rate_residuals : (rows,)
        G v - s' left, m/s and rad/s.
    free_directions : (nv, k)
        Basis of the velocities that keep the loops closed and the drives still at q, orthonormal
        when divided by the units of the coordinates (1 rad, the scene diagonal).  More columns
        than degrees of freedom: q is singular.
    singular : bool
        Whether the closures have lost rank at q against the mechanism's structural rank.
    """

    q: FloatArray
    v: FloatArray
    residuals: FloatArray = field(repr=False)
    rate_residuals: FloatArray = field(repr=False)
    free_directions: FloatArray = field(repr=False)
    singular: bool


def _positions(
    mechanism: Mechanism,
    problem: ClosureProblem,
    start: FloatArray,
    held: tuple[str, ...],
    limits: bool,
) -> FloatArray:
    """The closed configuration (nq,) nearest to ``start``, within the joint limits if asked for."""
    free = free_coordinates(mechanism, held)
    q = assemble_positions(problem, start, free)
    if not problem.closed(q):
        raise cannot_close(mechanism, problem, start, held, q)
    if not limits or not beyond_limits(mechanism, q):
        return q
    within = assemble_within_limits(problem, start, free)
    if within is None:
        raise limits_in_the_way(mechanism, problem, held, q)
    return within


def _check_distances(problem: ClosureProblem, start: FloatArray) -> None:
    """Refuse a guess in which the points of a ``distance`` coincide."""
    try:
        problem.closure(start)
    except EvaluationError as error:
        raise InputError(
            f"the loops cannot be evaluated at the guess: {error}",
            element="initial.guess",
            remedy='Give another guess, or use type = "point" if they are to coincide',
        ) from error


@dataclass(frozen=True, eq=False)
class ConsistentStart:
    """A mechanism in a consistent state, not analysed yet unless its assembly needed that.

    Attributes
    ----------
    mechanism
        The mechanism in this state.
    guess
        The mechanism as it was given.
    start : (nq,)
        The guess of its configuration, at which units are measured.
    searched
        Its closure equations, if it was searched with these.
    """

    mechanism: Mechanism
    guess: Mechanism
    start: FloatArray
    searched: ClosureProblem | None = None

    @cached_property
    def problem(self) -> ClosureProblem:
        """Its closure equations."""
        return self.searched or ClosureProblem(self.guess, self.start)

    @cached_property
    def at_rest(self) -> Mechanism:
        """The mechanism in this configuration with the rates that it had before, which is analysed
        where it is singular; ``mechanism`` itself if these are the consistent ones."""
        found, rates = self.mechanism, self.guess.v0
        same = np.array_equal(found.v0, rates)
        return found if same else found.with_state(found.q0, rates)


def consistent_start(
    mechanism: Mechanism,
    q: Mapping[str, Any] | Any = None,
    v: Mapping[str, Any] | Any = None,
    *,
    guess: Mapping[str, Any] | None = None,
    hold: Iterable[str] | None = None,
    limits: bool = False,
) -> ConsistentStart:
    """The consistent state that :func:`assemble` finds, with the same parameters and errors."""
    check_mechanism(mechanism)
    flag(limits, "limits")
    model = mechanism.model
    start = np.array(mechanism.q0)
    for name, value in named_values(guess, "guess").items():
        if isinstance(q, Mapping) and name in q:
            raise InputError(
                f"joint {name!r} is held in q and guessed in guess",
                element="guess",
                remedy="Keep one of the two",
            )
        with naming(element="guess"):
            set_position(mechanism, start, name, value)
    held: tuple[str, ...] = ()
    if isinstance(q, Mapping):
        for name, value in q.items():
            with naming(element="q"):
                set_position(mechanism, start, name, value)
        held = tuple(q)
    elif q is not None:
        start = pin.normalize(model, np.array(finite_numbers(q, model.nq, "q", ARRAY_OR_MAPPING)))
        if not (np.isfinite(start).all() and pin.isNormalized(model, start, 1e-9)):
            raise InputError(
                "q has a quaternion, or a (cos, sin) pair, of length zero",
                element="q",
                remedy="Use pinocchio.normalize(model, q)",
            )
    if hold is not None:
        held = name_list(hold, "hold")
        for name in held:
            with naming(element="hold"):
                mechanism.joint(name)
    rates = np.zeros(model.nv)
    held_rates: tuple[str, ...] = ()
    if isinstance(v, Mapping):
        for name, value in v.items():
            with naming(element="v"):
                set_rate(mechanism, rates, name, value)
        held_rates = tuple(v)
    elif v is not None:
        rates = np.array(finite_numbers(v, model.nv, "v", ARRAY_OR_MAPPING))
    if not mechanism.constrained:
        return ConsistentStart(mechanism.with_state(start, rates), mechanism, start)
    problem = None
    state = regular_start(mechanism, start, rates, held, held_rates)
    if state is not None and not (limits and beyond_limits(mechanism, state[0])):
        closed, consistent = state
        _restore_held(mechanism, closed, start, held)
        found = mechanism.with_state(closed, consistent)
    else:
        held, to_close = _with_absolute_drives(mechanism, start, held)
        problem = ClosureProblem(to_close, start)
        closed = start.copy()
        if to_close.loops:
            _check_distances(problem, start)
            closed = _positions(to_close, problem, start, held, limits)
        if to_close is not mechanism:
            problem = ClosureProblem(mechanism, start)
        _restore_held(mechanism, closed, start, held)
        # Walks from open loops find few closed configurations: analyses begin here.
        at_rest = mechanism.with_state(closed, mechanism.v0)
        consistent = assemble_velocity(mechanism, problem, closed, rates, held_rates, at_rest)
        same = np.array_equal(consistent, at_rest.v0)
        found = at_rest if same else mechanism.with_state(closed, consistent)
    if log.isEnabledFor(logging.DEBUG):
        residuals, _ = found.initial_errors
        log.debug(
            "%s: assembled with %s held, closed to %.1e",
            mechanism.name,
            ", ".join(held) or "no joint",
            np.abs(residuals).max(initial=0.0),
        )
    return ConsistentStart(found, mechanism, start, problem)


def _restore_held(
    mechanism: Mechanism, q: FloatArray, start: FloatArray, held: tuple[str, ...]
) -> None:
    """Give the joints that are ``held`` exactly their positions in ``start``, because moving a
    quaternion by nothing rounds it."""
    for name in held:
        joint = mechanism.joint(name)
        own = slice(joint.idx_q, joint.idx_q + joint.nq)
        q[own] = start[own]


def assemble(
    mechanism: Mechanism,
    q: Mapping[str, Any] | Any = None,
    v: Mapping[str, Any] | Any = None,
    *,
    guess: Mapping[str, Any] | None = None,
    hold: Iterable[str] | None = None,
    limits: bool = False,
) -> Assembly:
    """Close the loops and make the rates consistent.

    Parameters
    ----------
    mechanism
        Its q0 is the guess for everything that is not given.
    q
        Joint name -> position (rad, m, or a list, see :mod:`srm_mbs.model.coordinates`), held
        exactly unless ``hold`` says otherwise; or a configuration (nq,), of which only the joints
        in ``hold`` are held.
    v
        Joint name -> rate, held exactly; or a velocity (nv,), which is changed as little as
        possible.  Rates not given are the least-norm ones: at a singular configuration, those of
        the branch on which the norm is least; give one more rate to choose another branch.
    guess
        Joint name -> position from which assembly starts; chooses the branch (the closing
        nearest to it that was found, in rad and scene diagonals).
    hold
        Names of the joints whose position is held; by default those named in ``q``.  If given,
        the other positions in ``q`` are guesses.
    limits
        Stay within the position limits of the joints.

    Returns
    -------
    Assembly
        With |g| <= 1e-12 in rad and scene diagonals, |G v| <= 1e-12 in those per second.  Next to
        a singular configuration, at distance d, the rates are those of the branch, exact to
        round-off over d; |G v| may be as large.

    Raises
    ------
    AssemblyError
        If the loops cannot close (with each loop's gap, the closest configuration, the held joints
        or limits in the way, and the nearest values of held joints that close), or if held values
        or rates contradict each other (naming them).
    InputError
        For unknown joints or malformed values, or a guess in which the points of a ``distance``
        coincide.
    """
    start = consistent_start(mechanism, q, v, guess=guess, hold=hold, limits=limits)
    found = start.mechanism
    if not mechanism.constrained:
        nothing, everything = np.zeros(0), np.eye(mechanism.model.nv)
        return Assembly(found.q0.copy(), found.v0.copy(), nothing, nothing, everything, False)
    problem = start.problem
    drives = DriveRows(mechanism, problem, found.q0)
    free = null_basis(np.concatenate([problem.normalised(found.q0), drives.rows]), SINGULAR)
    if structure_of.kept(mechanism) is None:
        structure_of.keep(mechanism, start.at_rest.structure.at(mechanism))
    residuals, rate_residuals = found.initial_errors
    log.debug("%s: %d directions are free", mechanism.name, free.shape[1])
    return Assembly(
        found.q0.copy(),
        found.v0.copy(),
        residuals,
        rate_residuals,
        problem.unit[:, None] * free,
        free.shape[1] > start.at_rest.degrees_of_freedom,
    )
