"""What a problem is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from benchmarks.work_precision.references import Reference, read
from benchmarks.work_precision.trees import Tree
from srm_mbs.dynamics.mechanism import Mechanism

SAMPLES = 100
"""Equally spaced times of a run, the end included, at which errors are taken."""
Array = Any
Observer = Callable[[Array, Array], Array]
"""(q (n, nq), v (n, nv)) -> (n, k): what is compared with the reference."""


@dataclass(frozen=True, eq=False)
class ReducedModel:
    """A mechanism in minimal coordinates of its own: y' = field(t, y), y(0)."""

    field: Callable[[float, Any], Any]
    start: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Problem:
    """One problem, for us and for the peers.

    Attributes
    ----------
    name, title, t_end
        Key, a line of description, and the end of the run (s).
    make_mechanism, make_tree
        What we simulate, and what the peers simulate.
    observe
        What is compared, from the peers' coordinates or from ours.
    rate_unit
        What a velocity is divided by before errors are compared (1/s); lengths and angles count
        in m and rad.
    rates
        Which columns of the observation are velocities: all from this one on.
    reduced
        The model in minimal coordinates, if there is one, whose state ``expand`` turns into
        columns.
    index_one
        Equations of index 1 written by hand, whose states are the columns of the observation.
    stiff
        Whether forces are stiff: we take the tableaus for that, and the peers are implicit
        integrators of the reduced model.
    singular
        Whether the motion passes through singular configurations.
    planar
        The two world axes of the plane in which everything moves; None in space.
    gains
        Baumgarte rates alpha (1/s) that peers are tried with: kp = alpha^2, kd = 2 alpha.
    reference_of
        Computes the reference; the stored one is read by default.
    """

    name: str
    title: str
    t_end: float
    make_mechanism: Callable[[], Mechanism]
    make_tree: Callable[[], Tree]
    observe: Observer
    rates: int
    rate_unit: float = 1.0
    reduced: ReducedModel | None = None
    expand: Callable[[Array], Array] = lambda observed: observed
    index_one: ReducedModel | None = None
    singular: bool = False
    stiff: bool = False
    planar: tuple[int, int] | None = None
    gains: tuple[float, ...] = (3.0, 10.0, 30.0)
    reference_of: Callable[[], Reference] | None = None

    @property
    def times(self) -> Array:
        """The sample times (SAMPLES,) s."""
        return np.linspace(0.0, self.t_end, SAMPLES + 1)[1:]

    @cached_property
    def mechanism(self) -> Mechanism:
        """What we simulate."""
        return self.make_mechanism()

    @cached_property
    def tree(self) -> Tree:
        """What the peers simulate."""
        return self.make_tree()

    @cached_property
    def reference(self) -> Reference:
        """Observed values (SAMPLES, k), and how accurate they are."""
        stored = read(self.name) if self.reference_of is None else self.reference_of()
        return replace(stored, observed=self.expand(stored.observed))

    def error(self, observed: Array) -> float:
        """Largest difference from the reference over the samples."""
        difference = np.abs(observed - self.reference.observed)
        difference[:, self.rates :] /= self.rate_unit
        return float(difference.max())


def crank(q: Array, v: Array) -> Array:
    """Angle and rate (n, 2) of the first joint."""
    return np.column_stack([q[:, 0], v[:, 0]])


def state(q: Array, v: Array) -> Array:
    """Everything: (n, nq + nv)."""
    return np.hstack([q, v])
