"""What a peer is."""

from __future__ import annotations

import importlib.util
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.work_precision.problems.base import SAMPLES, Problem

Array = Any
TOLERANCES = tuple(10.0**-k for k in range(3, 14))
SUBSTEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Fixed steps are the distance of two samples divided by these."""


class NotApplicableError(Exception):
    """The peer cannot express the problem; the message says why."""


class RunFailedError(Exception):
    """The run did not reach its end; the message says why."""


class OverBudgetError(Exception):
    """The run was stopped because it took too long."""


@dataclass(frozen=True)
class Setting:
    """One way to run a peer.

    ``kind``: ``"rtol"`` or ``"step"`` (s).  ``variant``: what else differs, such as Baumgarte
    rates; every variant is a sweep of its own.  ``gain``: that rate alpha (1/s), 0 without.
    ``substeps``: steps from one sample to the next, where they are fixed.
    """

    kind: str
    value: float
    variant: str = ""
    gain: float = 0.0
    substeps: int = 0


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a run returns.

    ``states()`` gives (q, v) at the samples in the peers' coordinates; or ``observed()`` what is
    compared, ``own_drift()`` the largest closure error (m) and ``own_energy()`` the energy (J) at
    the start and the samples.
    """

    evaluations: int | None
    steps: int | None = None
    states: Callable[[], tuple[Array, Array]] | None = None
    observed: Callable[[], Array] | None = None
    own_drift: Callable[[], float] | None = None
    own_energy: Callable[[], Array] | None = None


Run = Callable[[], Outcome]
Runner = Callable[[Setting], Run]


class Peer(ABC):
    """One simulator.

    ``modules``: what must be importable; otherwise the peer is skipped.  ``implicit``: whether it
    integrates the reduced equations of stiff problems, and no others.
    """

    name: str
    title: str
    modules: tuple[str, ...] = ()
    implicit = False
    compiler_time: float | None = None
    """Seconds that a C compiler took, beside this process, to prepare the last problem."""

    def check(self, problem: Problem) -> None:
        """Raises NotApplicableError if the peer is not for problems of that kind."""
        if problem.stiff and not self.implicit:
            raise NotApplicableError("stiff problems are for implicit integrators")
        if self.implicit and not problem.stiff:
            raise NotApplicableError("implicit integrators are for stiff problems")

    def missing(self) -> str | None:
        """The first module that is not installed."""
        return next((m for m in self.modules if importlib.util.find_spec(m) is None), None)

    @abstractmethod
    def settings(self, problem: Problem) -> Sequence[Setting]:
        """The sweep, every variant from loose to tight."""

    @abstractmethod
    def everyday(self, problem: Problem) -> Setting:
        """What somebody would use who tunes nothing and wants about eight digits."""

    @abstractmethod
    def prepare(self, problem: Problem) -> Runner:
        """Build the model, untimed.

        The runner takes a setting and returns the call that is timed.  The call raises
        RunFailedError or OverBudgetError.

        Raises
        ------
        NotApplicableError
            If the peer cannot express the problem.
        """


class Budget:
    """Counts evaluations and ends runs that take longer than ``seconds`` of CPU time."""

    seconds = 20.0
    __slots__ = ("_deadline", "count")

    def __init__(self) -> None:
        self.count = 0
        self._deadline = time.process_time() + self.seconds

    def tick(self, count: int = 1) -> None:
        """Count; every 256 evaluations look at the clock."""
        self.count += count
        if (self.count & 255) < count and time.process_time() > self._deadline:
            raise OverBudgetError(f"stopped after {self.seconds:g} s")


def tolerance_sweep(
    tolerances: Iterable[float] = TOLERANCES, variants: Iterable[tuple[str, float]] = (("", 0.0),)
) -> list[Setting]:
    """Every variant (name, gain) over ``tolerances``."""
    return [Setting("rtol", tol, name, gain) for name, gain in variants for tol in tolerances]


def step_sweep(
    problem: Problem,
    substeps: Iterable[int] = SUBSTEPS,
    variants: Iterable[tuple[str, float]] = (("", 0.0),),
) -> list[Setting]:
    """Every variant (name, gain) over steps that end on the samples."""
    spacing = problem.t_end / SAMPLES
    return [
        Setting("step", spacing / k, name, gain, k) for name, gain in variants for k in substeps
    ]


def gain_variants(problem: Problem) -> list[tuple[str, float]]:
    """Baumgarte rates (1/s) to try."""
    return [(f"alpha = {gain:g}/s", gain) for gain in problem.gains]


def middle_gain(problem: Problem) -> tuple[str, float]:
    """The rate of somebody who does not tune."""
    variants = gain_variants(problem)
    return variants[len(variants) // 2]
