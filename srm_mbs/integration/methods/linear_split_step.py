r"""The linearly implicit step of the split PSRM, for stiff problems.

The stages integrate the equations of :mod:`srm_mbs.integration.methods.split_step`, in the chart
at the start of the step, where x = x_n (+) delta and delta' = D(t, delta).  With
J = dD/d delta and D_t there, the rate of the stage i is

    (1 - h gamma J) (K_i + w_i) = D(t_i, h sum_{j<i} a_ij K_j) + w_i + h (sum_j g_ij) D_t,
    w_i = sum_{j<i} g_ij K_j / gamma

(G. Steinebach, BIT Numer. Math. 63 (2023) 27; E. Hairer, G. Wanner, *Solving Ordinary Differential
Equations II*, 2nd edition, Springer 1996, IV.7).  The order depends on J: it is found anew at every
accepted state.  The accelerations of a tree with closures of joint coordinates alone, whose G is
constant, have derivatives in closed form: with the inverse dynamics ID(q, v, a) and the
M-orthonormal normals N of the closures, da = (M^-1 - N N^T) (df - dID), where ID is differentiated
by Pinocchio (J. Carpentier, N. Mansard, *Analytical derivatives of rigid body dynamics algorithms*,
RSS 2018), and the forces f by one-sided differences.  Other systems are differentiated as a whole
by such differences.

**Laws of forces.**  Dampers, springs, bushings and friction act along directions B(q) that turn
with the configuration: f = f_0(q, v, t) + B(q) y, y = F(q, v).  Evaluated at stages, a law of a
large constant c errs by c h^2, and steps would shrink like c^(-1/4).  So its value y is a variable
of its own: 0 = F(q, v) - y is linearised like the other equations (the same reference, VI.3), the
stages evaluate the forces with their own y, and what is nonlinear no longer contains c.  With
L = dF/d delta and W = dD/dy the full J is that with y held, plus W L; what a stage's law lacks,
r = F - y, adds W r to the right-hand side, and the rate of y is r / (h gamma) + L (K + w) - w_y.
More laws than degrees of freedom are one, y = M (1 - P) M^-1 B F: closures take up the rest, which
may grow with c.

**Next to a singular configuration** stages are evaluated at their projection on the branch
(:mod:`srm_mbs.integration.methods.near_singular`): what is integrated there are the rates at the
nearest place on the branch, and J is their derivative.  Along the branch it is as smooth as the
motion, along the normals it is 0; that of the rates off the branch grows like 1/sigma^2.  So J is
found by differences along the tangents (1 - P) e_j, at projected places.  Where the motion lingers
and nodes of the branch solve the stages (:mod:`srm_mbs.integration.methods.branch_nodes`), they
solve the places of the differences, too.  All differences are central there, and longer: nodes
round to 1e-13 only, direct solves beside them to more.  Where branches touch nodes are not used.

Everything else, the correction at the end, the zone and the placement, is that of explicit steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System, Terms
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, Linearisation, StepResult
from srm_mbs.integration.methods.branch_nodes import BRANCH_SIGMA, StageNodes
from srm_mbs.integration.methods.near_singular import BranchStages
from srm_mbs.integration.methods.split_step import SplitStep, Stages
from srm_mbs.integration.methods.stiffness import largest_eigenvalue
from srm_mbs.model.lazy import cached_property

DIFFERENCE = 2.0**-26
"""Step of a difference by a coordinate, over its size: the root of the rounding."""
CENTRAL_DIFFERENCE = 2.0**-17
"""The same of a central one, where a motion lingers."""
FRICTION_DIFFERENCE = 2.0**-10
"""Step of that by a rate, at most, over the speed in which friction changes its sign."""
TIME_DIFFERENCE = 2.0**-17
"""Step of a difference by time, over that of the integration: the third root of the rounding,
because that difference is of second order."""
SHORTEST_DIFFERENCE = 64.0
"""Shortest step of a difference by time, in units of rounding of the time."""


def rounded_down(sizes: FloatArray) -> FloatArray:
    """The powers of 2 up to ``sizes``: steps that a sum with a coordinate does not round."""
    return np.ldexp(0.5, np.frexp(sizes)[1])


def linearised(
    system: System,
    t: float,
    h: float,
    state: FloatArray,
    memory: IntegratorState,
    norm: ErrorNorm,
    branch: BranchStages | None,
    nodes: StageNodes | None = None,
) -> Linearisation:
    """``system`` linearised at ``state`` (nx,) and ``t`` (s), for steps of about ``h`` (s), whose
    stages are those of ``branch`` and ``nodes``."""
    n, k = system.tangent_size, system.multiplier_part.start
    unit = norm.one if norm.unit is None else norm.unit
    zone, on_branch = (None, False) if branch is None else (branch.zone, branch.near)

    def solved_at(time: float, x: FloatArray) -> Terms | StageNodes:
        terms = system.evaluate(time, x, zone if nodes is None else None)
        if nodes is not None and terms.sigma < BRANCH_SIGMA:
            if nodes.solve_stage(time, x):
                return nodes
            terms = system.evaluate(time, x, zone)
        if on_branch and not terms.rank_deficient:
            terms = system.evaluate(time, system.retract(x, -terms.correction()), zone)
        return terms

    def rate_of(stage: Terms | StageNodes) -> tuple[FloatArray, FloatArray]:
        if isinstance(stage, StageNodes):
            return stage.rate.copy(), stage.laws.copy()
        return stage.rate().copy(), system.laws

    def rate_at(time: float, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return rate_of(solved_at(time, x))

    # The rate of the memory is the one before the last correction, which stiff forces notice.
    system.apply_laws(memory.laws)
    start = solved_at(t, state)
    (rate, laws), directions = rate_of(start), np.eye(n)
    along = isinstance(start, StageNodes) or (on_branch and not start.rank_deficient)
    if along and not isinstance(start, StageNodes):
        size = n - k  # of positions and of rates, or of all unknowns
        tangents = np.transpose([e - start.project(e) for e in np.eye(size)])
        for i in range(0, n, size):
            directions[i : i + size, i : i + size] = tangents
    applied = laws if memory.laws is None else memory.laws
    m = len(applied)
    system.apply_laws(applied if m else None)
    steps = rounded_down(DIFFERENCE * np.maximum(unit, memory.state_scale))
    # Accelerations are linear in what acts in place of the laws.
    change = max(1.0, float(np.abs(applied).max(initial=0.0)))
    J, by_coordinates, by_laws = np.zeros((n, n)), np.empty((m, n)), np.zeros((n, m))
    known = None if along else system.derivatives(state, rate[k:])
    held = rate[k:] if known is None else known.forces(t, state)

    def probe(step: float, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """At ``x``, ``step`` away: the rate, except for what inertia, gravity and closures change
        if that is known; the derivative of the accelerations; the laws."""
        if known is None:
            there, own = rate_at(t, x)
            return there, (there[k:] - rate[k:]) / step, own
        forces = known.forces(t, x)
        there = np.concatenate([x[len(x) - k :], rate[k:]])
        return there, known.by_forces @ ((forces - held) / step), system.laws

    central = along and nodes is not None
    if central:
        sizes = CENTRAL_DIFFERENCE * np.maximum(unit, memory.state_scale)
        if len(system.friction_sums):
            sizes[k:] = np.minimum(sizes[k:], FRICTION_DIFFERENCE * system.friction_speed)
        steps = np.maximum(steps, rounded_down(sizes))
    for j, step in enumerate(steps.tolist()):
        delta = step * directions[:, j]
        if central:
            (ahead, own), (behind, other) = (
                rate_at(t, system.retract(state, side * delta)) for side in (1.0, -1.0)
            )
            there = system.chart_rate(delta, ahead) - system.chart_rate(-delta, behind)
            J[:, j] = np.concatenate([there[:k], (ahead - behind)[k:]]) / (2.0 * step)
            by_coordinates[:, j] = (own - other) / (2.0 * step)
            continue
        there, J[k:, j], own = probe(step, system.retract(state, delta))
        J[:k, j] = (system.chart_rate(delta, there) - rate)[:k] / step
        by_coordinates[:, j] = (own - laws) / step
    if known is not None:
        J[k:] += np.hstack([known.by_positions, known.by_velocities])
    for i in range(m):
        system.apply_laws(applied + change * (np.arange(m) == i))
        by_laws[k:, i] = probe(change, state)[1]
    system.apply_laws(applied if m else None)
    J += by_laws @ by_coordinates
    by_time = np.zeros(n)
    if system.time_dependent:
        shortest = SHORTEST_DIFFERENCE * np.spacing(abs(t))
        tau = float(rounded_down(np.array(max(TIME_DIFFERENCE * h, shortest))))
        first, second = (rate_at(t + i * tau, state)[0] - rate for i in (1.0, 2.0))
        by_time = (4.0 * first - second) / (2.0 * tau)
    return Linearisation(
        rate,
        J,
        by_time,
        applied,
        laws,
        by_coordinates,
        by_laws,
        (on_branch, nodes is not None),
        n if known is None and not along else 0,
    )


class LinearStages:
    """The stages of one linearly implicit step.

    Parameters
    ----------
    rate_of
        See :meth:`Stages.rate`.
    apply
        Lets the laws of a stage act, which it returns (m,).
    """

    def __init__(
        self,
        rate_of: Callable[[int, FloatArray, FloatArray], FloatArray],
        apply: Callable[[int], FloatArray],
        stiffness: float,
        cost: float,
    ) -> None:
        self.rate, self._apply = rate_of, apply
        self.stiffness, self.cost = stiffness, cost
        self.laws: FloatArray | None = None

    def begin(self, j: int) -> None:
        """See :class:`Stages`."""
        self.laws = self._apply(j)


@dataclass(frozen=True)
class LinearSplitStep(SplitStep):
    """Steps of a linearly implicit ``scheme``; see :class:`SplitStep`."""

    def step(
        self,
        system: System,
        t: float,
        h: float,
        state: FloatArray,
        memory: IntegratorState,
        norm: ErrorNorm,
    ) -> StepResult:
        """One step; see :class:`~srm_mbs.integration.methods.base.Method`."""
        try:
            return super().step(system, t, h, state, memory, norm)
        finally:
            system.apply_laws(None)

    @property
    def _implicit(self) -> FloatArray:
        """The g_ij of the scheme."""
        if self.scheme.implicit is None:
            raise ValueError(f"the tableau {self.scheme.name!r} is explicit")
        return self.scheme.implicit

    def stage_rates(
        self,
        system: System,
        t: float,
        h: float,
        state: FloatArray,
        memory: IntegratorState,
        norm: ErrorNorm,
        branch: BranchStages | None,
        nodes: StageNodes | None,
        rates: FloatArray,
    ) -> Stages:
        """See :class:`SplitStep`; the equations are linearised here."""
        from scipy.linalg import lu_factor, lu_solve

        scheme, n, implicit = self.scheme, system.tangent_size, self._implicit
        lead, end = scheme.lead, scheme.n_stages
        known = memory.linearisation
        places = (branch is not None and branch.near, nodes is not None)
        if known is None or known.places != places:
            known = linearised(system, t, h, state, memory, norm, branch, nodes)
            memory.linearisation = known
        gamma = float(implicit[lead, lead])
        factors = lu_factor(np.eye(n) - h * gamma * known.J, check_finite=False)
        before = np.tril(implicit, -1) / gamma
        time_shares = h * implicit.sum(axis=1)
        law_rates = np.zeros((end, len(known.laws)))

        def apply(j: int) -> FloatArray:
            """Let the laws of the stage ``j`` act, or at the end those of the end state itself."""
            weights = scheme.A[j] if j < end else scheme.b
            applied = known.applied + h * weights @ law_rates
            system.apply_laws(applied if j < end and len(applied) else None)
            return applied

        def rate_of(j: int, rate: FloatArray, laws: FloatArray) -> FloatArray:
            w, law_w = before[j] @ rates[:end], before[j] @ law_rates
            missing = laws - (known.applied + h * scheme.A[j] @ law_rates)
            given = rate + w + time_shares[j] * known.by_time + known.by_laws @ missing
            solved = np.asarray(lu_solve(factors, given, check_finite=False), dtype=np.float64)
            law_rates[j] = missing / (h * gamma) + known.by_coordinates @ solved - law_w
            return np.asarray(solved - w)

        rates[:lead] = known.rate
        rates[lead] = rate_of(lead, known.rate, known.laws)
        unit = norm.one if norm.unit is None else norm.unit
        k = system.multiplier_part.start
        stiffness = largest_eigenvalue(known.J, h, unit, k)
        cost = 1.0 + known.differences / (end - lead)
        return LinearStages(rate_of, apply, stiffness, cost)


@dataclass(frozen=True)
class SwitchingStep(SplitStep):
    """Steps of ``scheme``, and where the problem is stiff those of its scheme for that."""

    def _stepper(self, stiff: bool) -> SplitStep:
        return LinearSplitStep(self.scheme.member(True), self.eps) if stiff else self._explicit

    @cached_property
    def _explicit(self) -> SplitStep:
        return SplitStep(self.scheme, self.eps)

    def step(
        self,
        system: System,
        t: float,
        h: float,
        state: FloatArray,
        memory: IntegratorState,
        norm: ErrorNorm,
    ) -> StepResult:
        """One step; see :class:`~srm_mbs.integration.methods.base.Method`."""
        return self._stepper(memory.stiff).step(system, t, h, state, memory, norm)

    def accept(self, memory: IntegratorState, result: StepResult) -> None:
        """Move ``memory`` to the end of an accepted step."""
        self._stepper(result.stiff).accept(memory, result)
