"""Branch guards of runs with sweeps: branch changes that spread over several steps.

Sweeps may lie off the constraints by so much that, next to a singular configuration, they cannot
determine the branch.  They then change it in many short steps, each of which looks smooth.  The
velocity (x' of a DAE) is compared across all steps whose sweeps are off the constraints by a part
of sigma.
"""

from __future__ import annotations

from dataclasses import dataclass

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.control.branch_guard import (
    BranchGuard,
    RateBranchGuard,
    velocity_jumps,
)
from srm_mbs.integration.control.step_size import Proposal, StepDecision, StepSizeControl
from srm_mbs.integration.methods.base import DelegatingMethod, Method, StepResult
from srm_mbs.integration.methods.near_singular import AMBIGUOUS_DISTANCE
from srm_mbs.integration.methods.thesis.iterated_sweeps import IteratedSweeps
from srm_mbs.integration.methods.thesis.sweep import SweepResult

DEPARTED = 10.0
"""sigma, over its smallest value in a passage, from which the passage is over."""
LARGEST_PASSAGE_SIGMA = 0.1
"""Smallest sigma of steps that passed nothing singular: sweeps in their initial layers are off the
closures, and a velocity that changes afterwards has not changed its branch."""


@dataclass
class _Passage:
    """Steps next to a singular configuration: time (s) and tangent rate (n,) at the start and at
    the end, and the smallest sigma so far."""

    t: float
    rate: FloatArray
    end: float
    end_rate: FloatArray
    lowest: float


class AmbiguousPassages:
    """The passages of a run in which its sweeps cannot determine the branch, step by step."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._changed: list[tuple[float, float]] = []
        self._passage: _Passage | None = None

    def add(self, t_new: float, result: StepResult) -> None:
        """Take account of an accepted step to ``t_new`` (s)."""
        passage = self._passage
        distance = result.closure_distance if isinstance(result, SweepResult) else 0.0
        if passage is None and distance == 0.0:
            return
        lowest = float(result.sigmas.min())
        ambiguous = distance > AMBIGUOUS_DISTANCE * lowest
        if passage is None:
            if ambiguous:
                rate = result.rates[0].copy()
                self._passage = _Passage(result.t, rate, t_new, result.end_rate, lowest)
            return
        passage.end, passage.end_rate = t_new, result.end_rate
        passage.lowest = min(passage.lowest, lowest)
        if not ambiguous and result.sigmas[-1] > DEPARTED * passage.lowest:
            self._changed = self.branch_changes()
            self._passage = None

    @property
    def under_way(self) -> bool:
        """Whether a passage has begun and is not over."""
        return self._passage is not None

    def branch_changes(self) -> list[tuple[float, float]]:
        """Start and end (s) of the passages over which the velocity jumped, one that the run ends
        in included."""
        passage = self._passage
        if passage is None or not passage.lowest < LARGEST_PASSAGE_SIGMA:
            return self._changed
        if not velocity_jumps(self._system, passage.rate, passage.end_rate):
            return self._changed
        return [*self._changed, (passage.t, passage.end)]


class SweepBranchGuard(BranchGuard):
    """The branch guard of a mechanism's run with sweeps."""

    def __init__(self, inner: StepSizeControl, system: System) -> None:
        super().__init__(inner, system)
        self._passages = AmbiguousPassages(system)

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """As without sweeps; accepted steps are compared across a passage as well."""
        decision = super().decide(proposal, result)
        if decision is StepDecision.ACCEPTED and result is not None and not result.quiet:
            self._passages.add(proposal.t_new, result)
        return decision

    def suspect_times(self) -> list[float]:
        """Times (s) up to which the motion may have changed its branch: those of steps, and the
        ends of longer passages that contain none of them."""
        longer = [
            end
            for begin, end in self._passages.branch_changes()
            if not any(begin < t <= end for t in self.suspects)
        ]
        return sorted([*self.suspects, *longer])


class SweepRateBranchGuard(SweepBranchGuard, RateBranchGuard):
    """The branch guard of a DAE's run with sweeps, which ends before a step after which it is on
    another branch.

    Where the sweeps carry y, which is not bounded at the singular point, no shorter step leads them
    over it: a sweep that is off the constraints by d, at a distance r, is driven away by
    B'(x) d y ~ d/r, so that d grows like a power of 1/r, while the term that brings it back,
    G B T/eps, vanishes.  Such a run ends as soon as x' jumps, not only when the passage is over.
    """

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """Redo a step whose rate jumps; otherwise the inner decision.

        Raises
        ------
        EvaluationError
            Where the sweeps take another branch.
        """
        decision = super().decide(proposal, result)
        if decision is StepDecision.ACCEPTED:
            self._refuse_branch_change()
        return decision

    def _refuse_branch_change(self) -> None:
        unbounded = not self._system.carries_yhat
        if self._passages.under_way and not unbounded and not self.suspects:
            return
        if not (self.suspects or self._passages.branch_changes()):
            return
        why = ", because they carry y, which is not bounded there" if unbounded else ""
        raise EvaluationError(
            "next to a singular point of G B x' turned, and no shorter step mended it: the sweeps "
            f"leave on another branch of g = 0{why}"
        )


def branch_guard(control: StepSizeControl, system: System, method: Method) -> BranchGuard:
    """The branch guard of a run around ``control``: of a mechanism, or of a DAE, whose states are
    of first order, and with or without sweeps."""
    first_order = system.multiplier_part.start == 0
    if isinstance(method, DelegatingMethod) and isinstance(method.stepper, IteratedSweeps):
        return (SweepRateBranchGuard if first_order else SweepBranchGuard)(control, system)
    return (RateBranchGuard if first_order else BranchGuard)(control, system)
