"""A run in the compiled kernel, advanced in chunks."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from srm_mbs._kernel import core
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import Zone
from srm_mbs.integration import driver, singular_endpoints
from srm_mbs.integration.breakpoints import BreakpointHandler, SmoothIntervals
from srm_mbs.integration.control.step_size import StepDecision
from srm_mbs.integration.kernel.marshalling import (
    CONSTANTS,
    VERDICTS,
    history_from,
    memory_data,
    memory_from,
    scheme_data,
)
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, StepResult
from srm_mbs.integration.methods.psrm import PSRM

CHUNK = 0.1
"""Seconds after which the kernel returns, so that Ctrl-C is heard."""
(
    CHUNK_FULL,
    FINISHED,
    TOO_SHORT,
    STANDSTILL,
    CLOSURES,
    NOT_EVALUATED,
    BREAKPOINT,
    ARRIVAL,
) = range(8)
"""Why the kernel returned: ``Stop`` in run.hpp."""


class CompiledRun:
    """A run of the kernel that can be advanced step by step.

    Parameters
    ----------
    twin
        From :func:`~srm_mbs.integration.kernel.system.make_kernel_system`.
    method, norm, memory, state
        As for :func:`~srm_mbs.integration.driver.integrate`.
    pieces
        Of the run; its end is that of the last one.
    t0
        Its start (s).
    step, first_step, max_step
        Fixed step or None, first and longest step of step-size control (s).
    placed
        ``"automatic"`` or ``"off"``.
    arrivals
        Whether it returns before an end beside a singular configuration.
    """

    def __init__(
        self,
        kernel_system: Any,
        method: PSRM,
        norm: ErrorNorm,
        memory: IntegratorState,
        state: FloatArray,
        pieces: SmoothIntervals,
        *,
        t0: float = 0.0,
        step: float | None,
        first_step: float,
        max_step: float,
        placed: str,
        arrivals: bool = False,
    ) -> None:
        self.kernel_system, self.method, self.norm = kernel_system, method, norm
        self.start, self.t0, self.t_end = state.copy(), t0, float(pieces.ends[-1])
        self.adaptive = step is None
        eps = method.regularisation
        self._run = core.Run(  # type: ignore[union-attr]
            kernel_system,
            {
                "scheme": scheme_data(method.scheme),
                "constants": CONSTANTS,
                "norm": {
                    "atol": np.ascontiguousarray(norm.atol),
                    "one": np.ascontiguousarray(norm.one),
                    "rtol": norm.rtol,
                    "negligible": norm.negligible,
                },
                "memory": memory_data(memory),
                "eps": None if eps is None else (eps.factor, eps.power),
                "state": np.ascontiguousarray(state),
                "t0": t0,
                "ends": pieces.ends,
                "first": pieces.first,
                "last": pieces.last,
                "given": pieces.given.astype(float),
                "step": 0.0 if step is None else step,
                "first_step": first_step,
                "max_step": max_step,
                "placement": placed,
                "arrivals": arrivals,
            },
        )

    def advance(self, steps: int = 0) -> int:
        """Make ``steps`` steps (0: as many as fit in CHUNK); why it returned (CHUNK_FULL, ...)."""
        return int(self._run.advance(steps, CHUNK))

    def attempt_from(
        self, t: float, state: FloatArray, memory: IntegratorState, control: dict[str, Any]
    ) -> tuple[int, StepDecision | None]:
        """One attempt from where the reference stands, for comparison with it.

        Parameters
        ----------
        t, state, memory
            Before the attempt.
        control
            What step-size control remembers; the keys are those of ``ControlState`` in control.hpp.

        Returns
        -------
        Why it returned (CHUNK_FULL, ...), and the verdict; None if no step was made.
        """
        stop, verdict = self._run.attempt_from(t, state, memory_data(memory), control)
        return stop, None if verdict < 0 else VERDICTS[verdict]

    def last(self) -> StepResult:
        """The step made last."""
        data = dict(self._run.last())
        threshold, history = data.pop("zone_threshold"), data.pop("history")
        data["state_scale"] = data.pop("magnitude")
        data["constraint_residual"] = data.pop("gap")
        known = None if history is None else history_from(history)
        near = None if known is None else Zone(threshold, known.predict_near, known.normals)
        return StepResult(zone=near, history=known, multiplier=None, **data)

    def memory(self) -> IntegratorState:
        """What it carries to the next step."""
        return memory_from(self._run.memory())

    def pass_breakpoint(self, passing: BreakpointHandler) -> None:
        """Go on behind a breakpoint at which the kernel stopped.

        Raises
        ------
        ControllerError
            If the sampled controller fails.
        EvaluationError
            If the first stage cannot be evaluated, or the motion on is not determined.
        """
        t, state = self._run.t, self._run.state
        before = self.memory()
        known = False
        if self._run.at_breakpoint:
            passing.enter(self._run.piece + 1, t, state)
            with suppress(ArithmeticError):  # the reference says why
                known = self._run.enter()
        else:
            passing.enter(self._run.piece, t, state)
        if not known:
            self.remember(passing.resolved(t, state, before))

    def arrive(self, passing: BreakpointHandler) -> None:
        """Prepare for the end beside a singular configuration before which the kernel stopped."""
        run = self._run
        self.remember(passing.singular_arrival(run.t, run.state, self.memory(), run.piece))

    def remember(self, memory: IntegratorState) -> None:
        """Carry ``memory`` to the next step."""
        self._run.remember(memory_data(memory))

    def begin(
        self, t: float, state: FloatArray, memory: IntegratorState, first_step: float
    ) -> None:
        """Start again, from ``state`` at ``t`` (s); what was counted stays."""
        fresh = {"h": first_step, "xi_old": 1.0, "just_rejected": False, "index": 1, "slope": 0.0,
                 "zero": np.nan, "redo": 0.0, "redone": 0, "limit": np.inf, "tries": 0,
                 "arrival": 0}  # fmt: skip
        self._run.restore(
            {
                "t": t,
                "state": np.ascontiguousarray(state),
                "memory": memory_data(memory),
                "control": fresh,
                "seen": driver.RESIDUAL_EXAMINED,
                "near": singular_endpoints.NEAR_SINGULAR_SIGMA,
            }
        )

    def __getattr__(self, name: str) -> Any:
        return getattr(self._run, name)
