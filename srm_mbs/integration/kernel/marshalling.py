"""Structs of the compiled kernel, made from objects of the reference and turned back into them.

The kernel binds its C++ structs as immutable classes.  Their constructors take every field by
keyword: a missing or an unknown field is a TypeError, an array of another size a ValueError that
names the field.  Matrices of the reference have their vectors in columns, those of the kernel in
rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from srm_mbs._kernel import core
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.compiled_rows import closure_structs
from srm_mbs.dynamics.singularities import critical
from srm_mbs.errors import InputError, safe_repr
from srm_mbs.integration import (
    breakpoints,
    critical_passages,
    dense_output,
    driver,
    events,
    reversals,
    run_samples,
    singular_endpoints,
)
from srm_mbs.integration.breakpoints import SmoothIntervals
from srm_mbs.integration.control import branch_guard, placement, step_size
from srm_mbs.integration.control.step_size import StepDecision
from srm_mbs.integration.dense_output import StepData
from srm_mbs.integration.methods import (
    branch_nodes,
    linear_split_step,
    near_singular,
    split_step,
    stiffness,
    touching_branches,
)
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState
from srm_mbs.integration.methods.butcher import ButcherTableau, DenseExtension
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory
from srm_mbs.integration.methods.thesis.regularisation import Regularisation

# Tests without the compiled kernel import this module, too.
_core: Any = core

_NO_NUMBERS = np.zeros(0)
DECISIONS = (StepDecision.ACCEPTED, StepDecision.REJECTED, StepDecision.REPLACED)
"""The decisions that the kernel numbers from 0: ``StepDecision`` in control.hpp."""
_GROUPS = ("so3", "se3", "se2")
"""The groups that the kernel numbers from 0: ``Group`` in charts.hpp."""
FORCE_KINDS = (
    "spring_damper",
    "joint_torque",
    "torsion_spring",
    "wrench",
    "bushing",
    "limit_spring",
    "coupling_spring",
)
"""The force elements that the kernel numbers from 0: ``ForceKind`` in forces.hpp."""


def constants() -> Any:
    """``Constants`` of constants.hpp, each from the module of the reference that has it."""
    return _core.Constants(
        # Branch stages and zone.
        monitored_below=near_singular.WATCHED_SIGMA,
        near_steps=near_singular.NEAR_STEPS,
        far_steps=near_singular.FAR_STEPS,
        ambiguous_offset=near_singular.AMBIGUOUS_DISTANCE,
        held_tolerance=near_singular.HELD_ERROR,
        position_rounding=near_singular.POSITION_ROUNDING,
        usual_rounding=near_singular.USUAL_ROUNDING,
        crossing_sigma=near_singular.CROSSING_SIGMA,
        lead_steps=near_singular.FLOOR_STEPS,
        largest_rounding_floor=near_singular.LARGEST_FLOOR,
        zone_largest=near_singular.LARGEST_ZONE_SIGMA,
        count_uncertainty_above=near_singular.UNCERTAINTY_SIGMA_CHANGE,
        direct_hit=near_singular.DIRECT_HIT_SIGMA,
        max_projections=near_singular.MAX_PROJECTIONS,
        min_history=near_singular.MIN_PREDICTION_NODES,
        # Branch nodes.
        known_direction=branch_nodes.KNOWN_DIRECTION_SIGMA,
        direction_probe=branch_nodes.DIRECTION_PROBE,
        node_spacing=branch_nodes.NODE_SPACING,
        node_doublings=branch_nodes.SPACING_DOUBLINGS,
        node_sigma=branch_nodes.FIRST_NODE_SIGMA,
        node_iterations=branch_nodes.MAX_CLOSINGS,
        node_closing=branch_nodes.LARGEST_CLOSING,
        node_accuracy=branch_nodes.CLOSING_ACCURACY,
        node_rounding=branch_nodes.CLOSING_ROUNDING,
        node_misfit=branch_nodes.LARGEST_MISFIT,
        touching=touching_branches.TOUCHING,
        touching_farthest=touching_branches.FARTHEST,
        touching_spacing=touching_branches.NODE_SPACING,
        touching_nodes=touching_branches.EACH_SIDE,
        touching_samples=touching_branches.SAMPLES,
        touching_least=touching_branches.LEAST_SIGMA,
        touching_sigma=touching_branches.FIRST_NODE_SIGMA,
        touching_accuracy=touching_branches.CLOSING_ACCURACY,
        touching_settled=touching_branches.SETTLED,
        touching_misfit=touching_branches.LARGEST_MISFIT,
        touching_residual=touching_branches.LARGEST_RESIDUAL,
        branch_below=branch_nodes.BRANCH_SIGMA,
        residual_interval=split_step.RESIDUAL_EVERY,
        # Stiffness.
        stiff_steps=stiffness.STIFF_STEPS,
        other_steps=stiffness.OTHER_STEPS,
        dear_steps=stiffness.DEAR_STEPS,
        not_stiff=stiffness.NOT_STIFF,
        power_iterations=stiffness.POWER_ITERATIONS,
        unresolved=stiffness.UNRESOLVED,
        reversal_share=stiffness.REVERSAL_SHARE,
        friction_layer=reversals.LAYER,
        layer_landing=reversals.LANDING,
        layer_approached=reversals.APPROACHED,
        layer_unresolved=reversals.UNRESOLVED,
        difference=linear_split_step.DIFFERENCE,
        central_difference=linear_split_step.CENTRAL_DIFFERENCE,
        friction_difference=linear_split_step.FRICTION_DIFFERENCE,
        time_difference=linear_split_step.TIME_DIFFERENCE,
        shortest_difference=linear_split_step.SHORTEST_DIFFERENCE,
        # Step-size control.
        safety=step_size.SAFETY,
        min_factor=step_size.MIN_FACTOR,
        max_factor=step_size.MAX_FACTOR,
        proportional=step_size.PROPORTIONAL_EXPONENT,
        integral=step_size.INTEGRAL_EXPONENT,
        previous_error_floor=step_size.MIN_OLD_ERROR_RATIO,
        error_floor=step_size.MIN_ERROR_RATIO,
        failed_evaluation=step_size.UNEVALUATED_ERROR_RATIO,
        rate_overflow=step_size.RATE_OVERFLOW,
        first_step_probe=step_size.PROBE_LENGTH,
        longest_first_step=step_size.LONGEST_FIRST,
        at_rest=step_size.AT_REST,
        rest_probe_late=step_size.REST_PROBES[0],
        rest_probe_early=step_size.REST_PROBES[1],
        rest_ends=step_size.REST_ENDS,
        rest_factor=step_size.REST_FACTOR,
        clock_rounding=step_size.CLOCK_ROUNDING,
        # Placement.
        max_sigma_change=placement.SIGMA_CHANGE,
        scatter_from=placement.SCATTER_FROM,
        too_close=placement.TOO_CLOSE,
        clearance=placement.CLEARANCE,
        zero_horizon=placement.PREDICTION_STEPS,
        max_placements=placement.MAX_REDONE,
        singular_end=placement.SINGULAR_END_SIGMA,
        arrival_sigma_change=placement.ARRIVAL_SIGMA_CHANGE,
        turning_sigma=placement.TURNING_SIGMA,
        turning_misfit=placement.TURNING_MISFIT,
        slow_sigma_change=placement.SLOW_SIGMA_CHANGE,
        # Branch guard.
        branch_change=branch_guard.VELOCITY_JUMP,
        max_guard_retries=branch_guard.MAX_REDONE,
        # Driver and breakpoints.
        smallest_step=driver.SMALLEST_STEP,
        standstill=driver.STANDSTILL,
        standstill_steps=driver.WATCHED_STEPS,
        large_correction=driver.LARGE_CORRECTION,
        open_residual=driver.RESIDUAL_EXAMINED,
        lost_residual=driver.LARGEST_RESIDUAL,
        max_jump_steps=driver.MAX_JUMP_STEPS,
        search_below=singular_endpoints.NEAR_SINGULAR_SIGMA,
        search_factor=breakpoints.REPEATED_SEARCH_SIGMA,
        rounding_share=breakpoints.FIRST_STAGE_ERROR,
        # Critical configurations.
        critical_iterations=critical.ITERATIONS,
        critical_difference=critical.DIFFERENCE,
        critical_converged=critical.CONVERGED,
        critical_decided=critical.DECIDED,
        critical_accepted=critical.ACCEPTED,
        critical_frozen=critical.FROZEN,
        critical_converging=critical.CONVERGING,
        critical_ridge=critical.RIDGE,
        critical_time_ridge=critical.TIME_RIDGE,
        critical_reach=critical_passages.SEARCH,
        critical_farthest=critical_passages.FARTHEST,
        critical_passed=critical_passages.PASSED,
        rounded_residual=critical_passages.ROUNDED_RESIDUAL,
        stepped_residual=critical_passages.STEPPED_RESIDUAL,
        falling_sigma=critical_passages.FALLING_SIGMA,
        dead_point_width=critical_passages.DEAD_POINT_WIDTH,
        dead_point_widths=critical_passages.DEAD_POINT_WIDTHS,
        examined_again=critical_passages.EXAMINED_AGAIN,
        dependent_row=critical_passages.DEPENDENT,
        definite=critical.DEFINITE,
        largest_deviation=critical.LARGEST_DEVIATION,
        straight=critical.STRAIGHT,
        layer=critical_passages.LAYER,
        shortest_panel=critical_passages.SHORTEST_PANEL,
        panel_error=critical_passages.PANEL_ERROR,
        relative_panel_error=critical_passages.RELATIVE_PANEL_ERROR,
        panel_shrinkage=critical_passages.SHRINKAGE,
        curvature=critical_passages.CURVATURE,
        passage_sweeps=critical_passages.SWEEPS,
        bisections=critical_passages.BISECTIONS,
        passage_converged=critical_passages.CONVERGED,
        panel_shortened=critical_passages.SHORTENED,
        least_energy=critical_passages.LEAST_ENERGY,
        placing_steps=critical_passages.PLACING_STEPS,
        converging=critical_passages.CONVERGING,
        passage_turned=critical_passages.TURNED,
        spent_energy=critical_passages.SPENT_ENERGY,
        layers_left=critical_passages.LAYERS_LEFT,
        place_rounding=critical_passages.PLACE_ROUNDING,
        extrapolated=critical_passages.EXTRAPOLATED,
        panel_cut=critical_passages.CUT,
        panel_cut_from=critical_passages.CUT_FROM,
        smallest_rest=critical_passages.SMALLEST_REST,
        expected_steps=placement.EXPECTED_STEPS,
        expected_sigma=placement.EXPECTED_SIGMA,
    )


CONSTANTS: Any = None if core is None else constants()
"""The constants of every run; a field that :func:`constants` lacks is an error on import."""


@lru_cache(maxsize=64)
def tableau_struct(scheme: ButcherTableau) -> Any:
    """``ButcherTableau`` of step.hpp."""
    gaps = np.array(scheme.gaps)
    return _core.ButcherTableau(
        A=scheme.A,
        b=scheme.b,
        c=scheme.c,
        error=_NO_NUMBERS if scheme.error is None else scheme.error,
        controller_order=scheme.controller_order or 1,
        implicit=_NO_NUMBERS if scheme.implicit is None else scheme.implicit,
        lead=scheme.lead,
        stable_to=scheme.stable_to or 0.0,
        gap_centres=gaps[:, 0],
        gap_half_widths=gaps[:, 1],
    )


@lru_cache(maxsize=64)
def norm_struct(norm: ErrorNorm) -> Any:
    """``ErrorNorm`` of step.hpp."""
    return _core.ErrorNorm(
        atol=norm.atol,
        one=norm.one,
        unit=norm.one if norm.unit is None else norm.unit,
        rtol=norm.rtol,
        negligible=norm.negligible,
        singular=norm.singular,
    )


def history_struct(history: MultiplierHistory) -> Any:
    """``MultiplierHistory`` of history.hpp."""
    normals = history.normals
    return _core.MultiplierHistory(
        nv=history.values.shape[1],
        times=history.times,
        values=history.values,
        known_until=history.known_until,
        known_below=history.known_below,
        normals=_NO_NUMBERS if normals is None else np.ascontiguousarray(normals.T),
        away=_NO_NUMBERS if history.away is None else np.ravel(history.away),
    )


def history_from(struct: Any) -> MultiplierHistory:
    """The history of multipliers in a ``MultiplierHistory`` of the kernel."""
    nv: int = struct.nv
    normals: FloatArray = struct.normals.reshape(-1, nv)
    return MultiplierHistory(
        struct.times,
        struct.values.reshape(-1, nv),
        struct.known_until,
        struct.known_below,
        normals.T if len(normals) else None,
        struct.away.reshape(-1, nv) if len(struct.away) else None,
    )


def state_struct(memory: IntegratorState) -> Any:
    """``IntegratorState`` of step.hpp."""
    history = memory.history
    return _core.IntegratorState(
        rate=memory.rate,
        state_scale=memory.state_scale,
        sigma=memory.sigma,
        sigma_slope=memory.sigma_slope,
        steps=memory.steps,
        lingering=memory.lingering,
        stiff=memory.stiff,
        stiff_steps=memory.stiff_steps,
        other_steps=memory.other_steps,
        needed_steps=memory.needed_steps,
        saved_steps=memory.saved_steps,
        laws=_NO_NUMBERS if memory.laws is None else memory.laws,
        history=None if history is None else history_struct(history),
    )


def state_from(struct: Any) -> IntegratorState:
    """The integrator's state in an ``IntegratorState`` of the kernel."""
    history = struct.history
    return IntegratorState(
        struct.rate,
        struct.sigma,
        struct.state_scale,
        None if history is None else history_from(history),
        struct.sigma_slope,
        struct.steps,
        struct.lingering,
        struct.stiff,
        struct.stiff_steps,
        struct.other_steps,
        struct.needed_steps,
        struct.saved_steps,
        struct.laws if len(struct.laws) else None,
    )


_CONTROL_START = {
    "h": 0.0,
    "xi_old": 1.0,
    "just_rejected": False,
    "index": 1,
    "slope": 0.0,
    "zero": np.nan,
    "zero_error": 0.0,
    "expected": np.nan,
    "redo": 0.0,
    "redone": 0,
    "arrival": 0,
    "turning": False,
    "lost_branch": False,
    "limit": np.inf,
    "tries": 0,
}


def control_struct(**state: float) -> Any:
    """``ControlState`` of control.hpp; by default that of a control before its first step."""
    return _core.ControlState(**_CONTROL_START | state)


@lru_cache(maxsize=64)
def intervals_struct(intervals: SmoothIntervals) -> Any:
    """``SmoothIntervals`` of run.hpp."""
    return _core.SmoothIntervals(
        ends=intervals.ends,
        first=intervals.first,
        last=intervals.last,
        given=intervals.given.tolist(),
    )


@lru_cache(maxsize=16)
def collocation_struct(count: int) -> Any:
    """``Collocation`` of passage.hpp."""
    nodes, weights, integrals = critical_passages.gauss_nodes(count)
    return _core.Collocation(nodes=nodes, weights=weights, integrals=integrals)


@lru_cache(maxsize=64)
def options_struct(
    *,
    step: float | None,
    max_step: float,
    placed: str,
    arrivals: bool,
    singular_tolerance: float | None,
    rtol: float,
    eps: Regularisation | None,
) -> Any:
    """``RunOptions`` of run.hpp."""
    return _core.RunOptions(
        step=0.0 if step is None else step,
        max_step=max_step,
        placement=placed,
        arrivals=arrivals,
        examines=singular_tolerance is not None,
        singular_tolerance=singular_tolerance or 0.0,
        collocation=collocation_struct(critical_passages.node_count(rtol)),
        eps_factor=0.0 if eps is None else eps.factor,
        eps_power=0.0 if eps is None else eps.power,
    )


def extension_struct(extension: DenseExtension) -> Any:
    """``Extension`` of dense.hpp."""
    return _core.Extension(
        n_rates=extension.n_rates,
        rows=extension.rows,
        extra_A=extension.extra_A,
        extra_c=extension.extra_c,
    )


@lru_cache(maxsize=1)
def dense_constants() -> Any:
    """``DenseConstants`` of dense.hpp."""
    return _core.DenseConstants(
        nodes=list(dense_output.HERMITE_NODES),
        spacing=dense_output.NODE_SPACING,
        away_reach=dense_output.AWAY_REACH,
        least_away=dense_output.LEAST_AWAY,
        close=dense_output.CLOSE_SIGMA,
        branch_below=branch_nodes.BRANCH_SIGMA,
        probes=dense_output.COMPARED_AT,
        slack=dense_output.TIME_TOLERANCE,
    )


@lru_cache(maxsize=1)
def sample_rules() -> Any:
    """``SampleRules`` of run_samples.hpp."""
    fewest, one_of, most = zip(*run_samples.READ_STEPS)
    return _core.SampleRules(
        most_ends=run_samples.MAX_SAMPLED_ENDS,
        even_times=run_samples.EVEN_TIMES,
        fewest=fewest,
        one_of=one_of,
        most=most,
        read_at=run_samples.READ_AT,
    )


@lru_cache(maxsize=64)
def scheme_dense(scheme: ButcherTableau) -> Any:
    """``SchemeDense`` of dense.hpp."""
    return _core.SchemeDense(abscissae=scheme.abscissae, extension=extension_struct(scheme.dense))


@lru_cache(maxsize=64)
def weighted_stages(scheme: ButcherTableau) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rows of A, weights and abscissae of the stages of ``scheme`` that have weights."""
    stages = np.flatnonzero(scheme.b)
    return scheme.A[stages], scheme.b[stages], scheme.c[stages]


@lru_cache(maxsize=64)
def scheme_denses(scheme: ButcherTableau) -> list[Any]:
    """The dense outputs of a run: of ``scheme`` and, where it has one, of its scheme for stiff
    problems."""
    return [scheme_dense(one) for one in (scheme, scheme.stiff) if one is not None]


@lru_cache(maxsize=1)
def event_constants() -> Any:
    """``EventConstants`` of event_search.hpp."""
    return _core.EventConstants(
        same_time_step=events.SAME_TIME_STEP,
        same_time_rounding=events.SAME_TIME_ROUNDING,
        max_halvings=events.MAX_HALVINGS,
        max_bisections=events.MAX_BISECTIONS,
        max_root_steps=events.MAX_ROOT_STEPS,
        converged_step=events.CONVERGED_STEP,
        fast_convergence=events.FAST_CONVERGENCE,
        vertex_value=events.VERTEX_VALUE,
    )


_STEP_ARRAYS = (
    "times",
    "states",
    "rates",
    "corrections",
    "sigmas",
    "error_ratios",
    "end_rate",
    "stiff",
)


def steps_struct(steps: StepData) -> Any:
    """``StepArrays`` of bind_dense_output.cpp, which refers to the arrays of ``steps``."""
    return _core.StepArrays(
        **{name: getattr(steps, name) for name in _STEP_ARRAYS},
        break_rates=steps.break_rates.reshape(len(steps.breaks), len(steps.end_rate)),
        breaks=steps.breaks.tolist(),
        zones=steps.between_nodes,
        layers=steps.layers,
        end=steps.end,
    )


def steps_from(records: Any, stop: float | None) -> StepData:
    """The accepted steps in ``StepRecords`` of the kernel; its arrays are not copied."""
    ranks, error_ratios, placements, held, stiff = records.numbers
    steps = StepData(
        records.times,
        records.states,
        records.rates,
        records.corrections,
        records.sigmas,
        ranks,
        error_ratios,
        placements,
        held,
        records.end_rate,
        {zone.step: (zone.threshold, history_from(zone.history)) for zone in records.zones},
        stop,
        stiff=stiff,
    )
    if not records.break_count:
        return steps
    breaks = records.breaks.astype(int)
    inside = breaks > 0  # others end steps that were taken before
    return replace(steps, breaks=breaks[inside], break_rates=records.break_rates[inside])


def system_struct(constants: dict[str, Any]) -> Any:
    """``SystemData`` of system.hpp.

    Parameters
    ----------
    constants
        From :meth:`~srm_mbs.dynamics.multibody.Mechanics.constants`.
    """
    data = dict(constants)
    damping, friction = data.pop("damping"), data.pop("friction")
    return _core.SystemData(
        **closure_structs({key: data.pop(key) for key in ("loops", "joint_rows", "eliminations")}),
        drives=[_driven_row(**row) for row in data.pop("drives")],
        forces=[force_struct(**force) for force in data.pop("forces")],
        groups=[
            _core.GroupJoint(group=_GROUPS.index(group), start=start, size=size, position=position)
            for group, start, size, position in data.pop("groups")
        ],
        damping=_NO_NUMBERS if damping is None else damping,
        friction=_NO_NUMBERS if friction is None else friction,
        **data,
    )


def _driven_row(curve: dict[str, Any], **row: Any) -> Any:
    return _core.DrivenRow(curve=_core.Curve(**curve), **row)


_NO_ANCHOR = (0, np.zeros(12))


_NO_FORCE: dict[str, Any] = {
    "positions": [],
    "stiffness": 0.0,
    "damping": 0.0,
    "rest": 0.0,
    "in_q": 0,
    "in_v": 0,
    "in_link_axes": False,
    "numbers": _NO_NUMBERS,
}


def force_struct(
    kind: str,
    a: tuple[int, FloatArray] = _NO_ANCHOR,
    b: tuple[int, FloatArray] = _NO_ANCHOR,
    support: FloatArray = _NO_NUMBERS,
    curves: Sequence[dict[str, Any]] = (),
    **own: Any,
) -> Any:
    """``ForceElement`` of forces.hpp; the fields that its kind has not are zero or empty.

    Raises
    ------
    InputError
        If the kernel has no formulas of that kind, as of an element that is being added.
    """
    if kind not in FORCE_KINDS:
        raise InputError(
            f"the kernel has no force element {safe_repr(kind)}",
            element="backend",
            remedy='Use backend="python", or add it to FORCE_KINDS, forces.hpp and forces.cpp',
        )
    columns = np.flatnonzero(support)
    return _core.ForceElement(
        kind=FORCE_KINDS.index(kind),
        a=_core.Anchor(joint=a[0], placement=a[1]),
        b=_core.Anchor(joint=b[0], placement=b[1]),
        columns=columns.tolist(),
        signs=support[columns].astype(float),
        curves=[_core.Curve(**curve) for curve in curves],
        **_NO_FORCE | own,
    )
