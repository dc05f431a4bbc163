"""Both backends side by side: the kernel repeats every attempt of the reference.

The kernel starts each attempt from the state of the reference, so that rounding does not add up:
one proposal, one step and one decision are compared at a time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.breakpoints import BreakpointHandler, smooth_intervals
from srm_mbs.integration.control.branch_guard import BranchGuard
from srm_mbs.integration.control.placement import SingularityPlacement, SlopeOfSigma
from srm_mbs.integration.control.step_size import FixedStep, PIControl, StepDecision, initial_step
from srm_mbs.integration.kernel.marshalling import control_struct, state_struct
from srm_mbs.integration.kernel.run import CompiledRun, ReturnReason
from srm_mbs.integration.kernel.system import make_kernel_system
from srm_mbs.integration.methods.base import NEGLIGIBLE, ErrorNorm
from srm_mbs.integration.singular_endpoints import start
from srm_mbs.simulation.options import RunOptions
from srm_mbs.simulation.runner import absolute_tolerance, placed_control
from tests.support.dynamics import mass_matrix


def control_state(control: Any) -> Any:
    """The state of a control of the reference, as a struct of the kernel."""
    state: dict[str, Any] = {}
    while True:
        if isinstance(control, BranchGuard):
            state |= {"limit": control._limit, "tries": control._tries}
        elif isinstance(control, SingularityPlacement):
            state |= {
                "slope": control._slope,
                "zero": np.nan if control._zero is None else control._zero,
                "redo": 0.0 if control._redo is None else control._redo,
                "redone": control._redone,
                "arrival": int(control._arrival),
                "turning": control._turning,
                "lost_branch": control._lost_branch,
            }
        elif isinstance(control, SlopeOfSigma):
            state |= {"slope": control._slope}
        elif isinstance(control, PIControl):
            state |= {
                "h": control._h,
                "xi_old": control._xi_old,
                "just_rejected": control._just_rejected,
            }
            return control_struct(**state)
        else:
            assert isinstance(control, FixedStep)
            return control_struct(**state, index=control._index)
        control = control._inner


@dataclass
class Comparison:
    """Largest differences over all attempts, each over the size that it should be small to.

    Attributes
    ----------
    h, state, rates, sigma, correction, error
        Step lengths, states (over units), stage rates, sigma, corrections, error ratios.
    energy
        States again, as sqrt(d^T M d): in the norm of the kinetic energy both backends' solves are
        well conditioned; on single coordinates rounding is magnified by the condition of M.
    condition
        Largest condition number of M.
    near
        States of steps next to singular configurations, where rounding is magnified.
    decisions
        (t, decision of the reference, decision of the kernel) where these differ.
    attempts, zones, replaced
        How many attempts there were, how many used the zone, how many were redone.
    entered
        How many breakpoints were passed.
    arrivals
        How many intervals ended on nodes of the branch, beside singular configurations.
    """

    h: float = 0.0
    state: float = 0.0
    energy: float = 0.0
    condition: float = 1.0
    near: float = 0.0
    rates: float = 0.0
    sigma: float = 0.0
    correction: float = 0.0
    error: float = 0.0
    decisions: list[tuple[float, Any, Any]] = field(default_factory=list)
    attempts: int = 0
    zones: int = 0
    replaced: int = 0
    entered: int = 0
    arrivals: int = 0

    def enlarge(self, **found: Any) -> None:
        """Keep the largest of each difference."""
        for name, value in found.items():
            setattr(self, name, max(getattr(self, name), float(value)))


def compare(
    mechanism: srm.Mechanism,
    t_end: float,
    *,
    rtol: float,
    tableau: str = "dop853",
    step: float | None = None,
    placement: str = "automatic",
    eps: float | str | None = None,
    max_step: float = np.inf,
    controller: Any = None,
    breakpoints: tuple[float, ...] = (),
    arrivals: bool = True,
) -> Comparison:
    """Run the reference and repeat each of its attempts on the kernel."""
    method = srm.PSRM(tableau, eps=eps)
    scheme = method.scheme
    system = make_system(mechanism, controller)
    intervals = smooth_intervals(np.array(breakpoints), np.zeros(0), 0.0, t_end)
    kernel_system = make_kernel_system(system)
    norm = ErrorNorm(
        absolute_tolerance(mechanism, None, rtol),
        rtol,
        NEGLIGIBLE if step is None else 0.0,
    )
    x = np.concatenate([mechanism.q0, mechanism.v0])
    memory = start(system, method, 0.0, x, norm, t_end)
    order = scheme.controller_order or 1
    first = initial_step(system, x, memory, norm, t_end, order) if step is None else 0.0
    options = RunOptions(
        t_end, method=method, step=step, placement=placement, singular_times=np.zeros(0)
    )
    control, _ = placed_control(system, options, lambda: first, arrivals)
    run = CompiledRun(
        kernel_system,
        method,
        norm,
        state_struct(memory),
        x,
        intervals,
        step=step,
        first_step=first,
        max_step=max_step,
        placed=placement,
        arrivals=arrivals,
    )
    out = Comparison()
    one = np.concatenate([norm.one, norm.one])[: 2 * system.nv]
    t = 0.0
    passing = BreakpointHandler(intervals, system, method, norm)
    control.set_target_time(passing.end)
    while t < t_end and out.attempts < 4000:
        if t >= passing.end:
            memory = passing.next(t, x, memory)
            control.set_target_time(passing.end)
            out.entered += 1
            assert run.core.at_breakpoint
            run.core.enter()
            change = run.memory().rate - memory.rate
            out.enlarge(rates=np.max(np.abs(change) / (np.abs(memory.rate) + one)))
        limit = min(max_step, system.step_limit(x))
        # Before the reference proposes: its proposal writes the slope into the memory.
        reason, compiled_decision = run.attempt_from(t, x, memory, control_state(control))
        proposal = control.propose(t, limit, memory)
        assert proposal.singular_arrival == (reason is ReturnReason.ARRIVAL)
        if proposal.singular_arrival:
            memory = passing.singular_arrival(t, x, memory)
            continue
        try:
            result = method.step(system, t, proposal.h, x, memory, norm)
        except EvaluationError:
            result = None
        decision = control.decide(proposal, result)
        out.attempts += 1
        out.enlarge(h=abs(run.core.h - proposal.h) / proposal.h)
        if decision is not compiled_decision:
            out.decisions.append((t, decision, compiled_decision))
        if result is not None:
            compiled_result = run.last()
            size = np.maximum(one, memory.state_scale)
            rates = np.abs(result.rates).max(axis=0)
            change = system.difference(result.state, compiled_result.state)
            # Next to a singular configuration the algebra magnifies rounding by 1 / sigma^2.
            lowest = min(1.0, float(result.sigmas.min()))
            scale = np.maximum(size, proposal.h * rates) / lowest**2
            moved = np.max(np.abs(change) / scale)
            if result.quiet or not system.has_constraints:
                M = mass_matrix(mechanism.model, x[: mechanism.model.nq])
                out.enlarge(state=moved, condition=np.linalg.cond(M))
                for d, s in zip(np.split(change, 2), np.split(scale, 2)):
                    out.enlarge(energy=np.sqrt((d @ M @ d) / (s * s @ np.diag(M))))
            else:
                out.enlarge(near=moved)
            change = np.abs(compiled_result.rates - result.rates).max(axis=0)
            out.enlarge(rates=np.max(change / (rates + one)) * lowest**2)
            if np.isfinite(result.sigmas).all():
                out.enlarge(sigma=np.abs(compiled_result.sigmas - result.sigmas).max() * lowest)
            if result.correction.size:
                change = np.abs(compiled_result.correction - result.correction)
                out.enlarge(correction=np.max(change / scale))
            # An error estimate is a difference of rates: its rounding is theirs.
            rounding = norm(proposal.h * rates, norm.weights(memory.state_scale))
            change = abs(compiled_result.error_ratio - result.error_ratio)
            out.enlarge(error=change / ((rounding + result.error_ratio) / lowest**2))
            out.zones += result.zone is not None
            assert (result.zone is None) == (compiled_result.zone is None)
            assert result.rank == compiled_result.rank
            assert result.held == compiled_result.held
            assert result.quiet == compiled_result.quiet
        out.replaced += decision is StepDecision.REPLACED
        if decision is StepDecision.ACCEPTED and result is not None:
            out.arrivals += proposal.t_new >= passing.end and result.away is not None
            method.accept(memory, result)
            t, x = proposal.t_new, result.state
    return out
