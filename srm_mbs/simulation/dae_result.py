"""Results of runs of index-2 DAEs: states and multipliers, and their dense output."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.dae import DaeSystem
from srm_mbs.dynamics.singularities.branch_limit import lagrange_weights
from srm_mbs.errors import time_text
from srm_mbs.integration.dense_output import DenseOutput, StepData, checked_output_times
from srm_mbs.integration.driver import RunStatus
from srm_mbs.integration.methods.base import Method
from srm_mbs.model.lazy import cached_property
from srm_mbs.simulation.csv_export import write_table
from srm_mbs.simulation.result import RunOutcome, Settings, Statistics

MULTIPLIER_POINTS = 5
"""Ends of steps through which the multiplier of sweeps is interpolated."""


class DaeResult(RunOutcome):
    """Result of :func:`srm_mbs.solve_dae`.

    Attributes
    ----------
    t : (n,)
        ``t_eval``, or the ends of the accepted steps, the start first.
    x : (n, nx), y : (n, ny)
        States and multipliers there.  y is that of the last sweep; for the split form, which has
        no sweep, the exact one at x.
    status, message
        ``finished``, ``event`` (a terminal event), ``failed`` or ``interrupted``; when and why.
    t_events, x_events
        For each event in turn the times (k,) and states (k, nx) of its occurrences; None if no
        events were given.
    stats
        :class:`~srm_mbs.simulation.result.Statistics`.
    settings
        :class:`~srm_mbs.simulation.result.Settings`.
    attempts : (k,)
        The rejected and redone steps, a structured array of
        :data:`~srm_mbs.simulation.result.ATTEMPT`.
    steps
        :class:`~srm_mbs.integration.dense_output.StepData`: what the stepping recorded, sigma
        included.
    """

    def __init__(
        self,
        system: DaeSystem,
        method: Method,
        steps: StepData,
        carried: Sequence[FloatArray],
        *,
        t_eval: FloatArray | None,
        attempts: NDArray[np.void],
        settings: Settings,
        events: tuple[list[FloatArray], list[FloatArray]] | None,
        status: str,
        message: str,
        stats: Statistics,
    ) -> None:
        self.steps = steps
        self.scheme = method.scheme
        self.attempts = attempts
        self.settings = settings
        self.status = RunStatus(status)
        self.message = message
        self.t_events: list[FloatArray] | None = None
        self.x_events: list[FloatArray] | None = None
        if events is not None:
            self.t_events, self.x_events = events
        self.stats = stats
        self._system = system
        self._dense = DenseOutput(system, method.scheme, steps)
        # x and y at the nodes are what the dense output is made of.
        steps.states.setflags(write=False)
        steps.times.setflags(write=False)
        self._nodes: FloatArray | None = None
        if carried:
            self._nodes = np.array(
                [system.uncarried(*node) for node in zip(steps.times, steps.states, carried)]
            )
        if t_eval is None:
            self.t, self.x = self._dense.nodes()
            if self._nodes is not None and steps.stop is None:
                self.y = self._nodes
            else:
                self.y = self._multipliers(self.t, self.x)
        else:
            self.t = t_eval[t_eval <= steps.end]
            self.x, self.y = self._at(self.t)

    def __call__(self, t: Any) -> tuple[FloatArray, FloatArray]:
        """Dense output: x and y at time ``t``, a scalar or an array of any order.

        Returns shapes (nx,), (ny,) for a scalar, (k, nx), (k, ny) for an array.  Between the ends
        of steps the y of sweeps is interpolated by polynomials through five of them.

        Raises
        ------
        InputError
            If a time lies outside the run, or t has more than one dimension.
        """
        times = checked_output_times(t, scalar=True)
        x, y = self._at(np.atleast_1d(times))
        return (x[0], y[0]) if times.ndim == 0 else (x, y)

    def _at(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = self._dense(times)
        return x, self._multipliers(times, x)

    def _multipliers(self, times: FloatArray, x: FloatArray) -> FloatArray:
        out = np.empty((len(times), self._system.ny))
        nodes, known = self.steps.times, self._nodes
        for k, t in enumerate(times.tolist()):
            if known is None:
                out[k] = self._system.multiplier_at(t, x[k])
                continue
            width = min(MULTIPLIER_POINTS, len(nodes))
            first = int(np.searchsorted(nodes, t)) - width // 2
            near = slice(max(0, min(first, len(nodes) - width)), None)
            weights = lagrange_weights(nodes[near][:width], t)
            out[k] = weights @ known[near][:width]
        return out

    @cached_property
    def drift(self) -> FloatArray:
        """||g|| (n,) at ``t``.

        Raises
        ------
        CallbackError, EvaluationError
            If the problem's g fails.
        """
        g = [self._system.call("g", t, x) for t, x in zip(self.t.tolist(), self.x)]
        out: FloatArray = np.linalg.norm(np.array(g).reshape(len(g), self._system.ny), axis=1)
        return out

    def to_csv(self, path: str | Path) -> None:
        """Write t, x and y as a table of comma-separated values, one row per time ``t``.

        Parameters
        ----------
        path
            File name; ``.csv`` is usual and is not added.
        """
        columns = {"t": self.t}
        for name, values in (("x", self.x), ("y", self.y)):
            columns |= {f"{name}[{i}]": column for i, column in enumerate(values.T)}
        write_table(columns, path)

    def __repr__(self) -> str:
        return (
            f"DaeSolution(t={time_text(self.steps.times[0])}..{time_text(self.steps.times[-1])}, "
            f"{len(self.t)} points, {self.stats.steps} steps, {self.status})"
        )
