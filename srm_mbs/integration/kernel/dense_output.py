"""The accepted steps of a run as the compiled kernel reads them: dense output, minima of sigma."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from srm_mbs._kernel import core
from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.dynamics.constraints.geometry import geometry_of
from srm_mbs.dynamics.constraints.row_algebra import COMPILED_ABOVE
from srm_mbs.dynamics.constraints.structure import SMALL_REFERENCE_PIVOT, structure_of
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.dynamics.singularities.critical import CriticalPlace
from srm_mbs.integration import critical_passages, singular_passages
from srm_mbs.integration.critical_passages import exact_up_to
from srm_mbs.integration.dense_output import DenseOutput, StepData
from srm_mbs.integration.generated.code import code_of_record
from srm_mbs.integration.kernel import marshalling
from srm_mbs.integration.kernel.backend import COMPILED
from srm_mbs.integration.kernel.observables import CompiledObservables, separated_rows
from srm_mbs.integration.kernel.system import make_kernel_system, shared, workspace
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.run_samples import RunSamples
from srm_mbs.integration.singular_passages import (
    AVOIDED_SIGMA,
    ConstraintMonitor,
    RecordedDips,
    Turn,
)
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData, per_start

READING_PART = 1e-3
"""Error within which a turn is read between ends of steps, over sigma next to it."""
LEAST_READING = 1e-7
"""That error below which it is not: ends of steps are seldom so close to a polynomial."""
READING_MARGIN = 100.0
"""The smallest singular value at the turn, over that error, above which the turn certainly stays
short of the singular configuration."""


def dense_output(
    system: ClosedSystem | OpenSystem, scheme: ButcherTableau, steps: StepData, made_by: str
) -> DenseOutput:
    """Dense output of a run, on the kernel if it made the run and is available.

    Parameters
    ----------
    made_by
        Backend of the run.
    """
    if made_by in COMPILED and core is not None:
        code = code_of_record(made_by, system.mechanism)
        own = None if shared(system) else make_kernel_system(system, code)
        return CompiledDenseOutput(own, system, scheme, steps, made_by=made_by)
    return DenseOutput(system, scheme, steps)


class CompiledDenseOutput(DenseOutput):
    """Dense output of a run of the kernel, evaluated by it.

    Parameters
    ----------
    kernel_system
        The kernel system of the run; None where any idle one of the mechanism serves
        (:func:`~srm_mbs.integration.kernel.system.shared`), so that results hold no workspace.
    system, scheme, steps, end_state
        As for :class:`~srm_mbs.integration.dense_output.DenseOutput`.
    made_by
        Backend of the run.
    recorded
        Records of the kernel and the time (s) of a terminal event or None, if they are all that is
        needed: the steps, as arrays of Python, are then not read.
    """

    def __init__(
        self,
        kernel_system: Any,
        system: ClosedSystem | OpenSystem,
        scheme: ButcherTableau,
        steps: StepData | Callable[[], StepData],
        end_state: FloatArray | None = None,
        made_by: str = "kernel",
        recorded: tuple[Any, float | None] | None = None,
    ) -> None:
        super().__init__(system, scheme, steps, end_state)
        self._made_by = made_by
        self.recorded = recorded
        self._mechanism_system = system
        self.kernel_system = kernel_system

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy may be loaded where there is no kernel.
        return dense_output, (self._mechanism_system, self._scheme, self._steps, self._made_by)

    @cached_property
    def observables(self) -> CompiledObservables:
        """Quantities at many states of the mechanism of the run."""
        return CompiledObservables(self._mechanism_system)

    def __call__(self, t: FloatArray) -> FloatArray:
        """States (k, nx) at the times ``t`` (k,), in any order; see
        :class:`~srm_mbs.integration.dense_output.DenseOutput`."""
        if self._by_reference:
            return super().__call__(t)
        try:
            return self._read("states", _as_array(t))  # type: ignore[no-any-return]
        except ArithmeticError:
            return super().__call__(t)  # raises the error that says why
        except IndexError:
            self.check(t)  # raises
            raise

    def samples(self, unit: FloatArray) -> RunSamples | None:
        """As :func:`srm_mbs.integration.run_samples.run_samples`; None where that has to read the
        run, or raises the error that says why it cannot be read."""
        if self._by_reference:
            return None
        try:
            return RunSamples(*self._read("samples", marshalling.sample_rules(), unit))
        except ArithmeticError:
            return None

    def element_works(
        self, observables: CompiledObservables, t: FloatArray
    ) -> dict[str, FloatArray] | None:
        """Work (n,) J of each force element, but that of its potential, up to the ends ``t`` (n,) s
        of steps, by the weights of the stages; None where the reference integrates it."""
        if self._by_reference:
            return None
        stages = marshalling.weighted_stages(self._scheme.member(False))
        return observables.element_works(self._compiled, t, *stages)

    def between_ends(self, t: FloatArray, allowed: FloatArray) -> FloatArray:
        """As the reference (:meth:`DenseOutput.between_ends`)."""
        if self._by_reference:
            return super().between_ends(t, allowed)
        try:
            return self._read("between_ends", _as_array(t), allowed)  # type: ignore[no-any-return]
        except ArithmeticError:
            return super().between_ends(t, allowed)  # raises the error that says why
        except IndexError:
            self.check(t)  # raises
            raise

    def _read(self, what: str, *arguments: Any) -> Any:
        if self.kernel_system is not None:
            return self._read_by(self.kernel_system, what, *arguments)
        code = code_of_record(self._made_by, self._mechanism_system.mechanism)
        with workspace(self._mechanism_system, code) as kernel_system:
            return self._read_by(kernel_system, what, *arguments)

    def _read_by(self, kernel_system: Any, what: str, *arguments: Any) -> Any:
        before = kernel_system.evaluations, kernel_system.factorisations
        try:
            return getattr(self._compiled, what)(kernel_system, *arguments)
        finally:
            self._mechanism_system.count(
                kernel_system.evaluations - before[0], kernel_system.factorisations - before[1]
            )

    def turns(
        self, scheme: ButcherTableau, dips: RecordedDips, tolerance: float
    ) -> RecordedDips | None:
        """:func:`~srm_mbs.integration.singular_passages.recorded_turns` of a run without stiff
        steps; None where that itself has to find them.  ``tolerance``: as of its monitor."""
        system = self._mechanism_system
        search = None if self._by_reference else _turn_search(system.mechanism)
        if search is None:
            return None
        try:
            with self.observables.all_rows() as all_rows:
                given = all_rows, *search, _dip_search(scheme), dips.samples, dips.tops
                others, turns = self._read("turns", *given, tolerance, marshalling.CONSTANTS)
        except ArithmeticError:
            return None
        return dips.at_no_turn(others, [Turn(*turn) for turn in turns])

    def critical_near(self, monitor: ConstraintMonitor, t: float) -> CriticalPlace | None:
        """:func:`~srm_mbs.integration.singular_passages.critical_near` of the run."""
        geometry, system = monitor.geometry, self._mechanism_system
        q = monitor.configurations(np.array([t]))[0]
        reach = singular_passages.CROSSING_SEARCH
        given = t, q, float(geometry.unit[-1]), reach, marshalling.CONSTANTS
        try:
            if self.kernel_system is not None:
                found = self.kernel_system.critical_near(*given)
            else:
                with workspace(system) as kernel_system:
                    found = kernel_system.critical_near(*given)
        except ArithmeticError:
            return singular_passages.critical_near(monitor, t)
        if found is None:
            return None
        place, time, residual = found
        return CriticalPlace(geometry.at(place, time), residual)

    @cached_property
    def _by_reference(self) -> bool:
        """Whether only the reference can evaluate it."""
        if self.recorded is not None:
            return False
        steps, extension = self._steps, self._scheme.dense
        if not steps.count:
            return True
        if len(extension.extra_c) and steps.rates.shape[1] == extension.n_rates:
            return True  # loaded without the controller: no stage is to be evaluated
        # In a step between two breakpoints the state follows from extra stages, which have no zone
        # in the kernel.
        if not len(steps.breaks):
            return steps.count < 2 and bool(steps.between_nodes)
        intervals = (steps.smooth_interval(step) for step in steps.between_nodes)
        return any(last - first < 2 for first, last in intervals)

    @cached_property
    def _compiled(self) -> Any:
        system, schemes = self._mechanism_system, marshalling.scheme_denses(self._scheme)
        constants = marshalling.dense_constants()
        if self.recorded is not None:
            return core.DenseOutput(schemes, constants, *self.recorded)  # type: ignore[union-attr]
        steps = marshalling.steps_struct(self._steps)
        return core.DenseOutput(system.nq, system.nv, schemes, constants, steps)  # type: ignore[union-attr]


def _as_array(t: FloatArray) -> FloatArray:
    return np.ascontiguousarray(t, dtype=float)


@lru_cache(maxsize=64)
def _dip_search(scheme: ButcherTableau) -> Any:
    """``DipSearch`` of sigma_dips.hpp for the steps of ``scheme`` that are not stiff."""
    own = scheme.member(False)
    return core.DipSearch(  # type: ignore[union-attr]
        columns=own.distinct.tolist(),
        abscissae=own.abscissae[own.distinct],
        around=scheme.n_stages,
        slope_margin=singular_passages.SLOPE_MARGIN,
        vanishing=singular_passages.VANISHING_SIGMA,
        lingering=singular_passages.LINGERING_SIGMA,
        departed=singular_passages.DEPARTED_VALUE,
        least_departed=singular_passages.LEAST_DEPARTED,
        depth=singular_passages.RECORDED_DEPTH,
    )


def recorded_dips(scheme: ButcherTableau, steps: StepData) -> RecordedDips | None:
    """As :func:`srm_mbs.integration.singular_passages.recorded_dips`; that itself for steps of two
    schemes."""
    if np.logical_or.reduce(steps.stiff):
        return singular_passages.recorded_dips(scheme, steps)
    found = core.recorded_dips(  # type: ignore[union-attr]
        _dip_search(scheme), steps.times, steps.sigmas, steps.end
    )
    return None if found is None else RecordedDips(*found)


@per_start
def _turn_search(mechanism: MechanismData) -> tuple[Any, Any] | None:
    """``SeparatedRows`` and ``TurnSearch`` of turns.hpp; None for mechanisms with many columns, of
    which the reference has faster algebra."""
    geometry = geometry_of(mechanism, mechanism.q0)
    if geometry.model.nv > COMPILED_ABOVE:
        return None
    rows = separated_rows(geometry, singular_passages.singular_values(mechanism), [])
    search = core.TurnSearch(  # type: ignore[union-attr]
        unit=geometry.coordinate_unit,
        columns=singular_passages.turning_columns(mechanism),
        rank=structure_of(mechanism).rank,
        newton_steps=singular_passages.REVERSAL_STEPS,
        resting=singular_passages.RESTING_SPEED,
        together=singular_passages.VANISHING_TOGETHER,
        touching=singular_passages.TOUCHING_VALUE,
        untouched=singular_passages.UNTOUCHED_VALUE,
        reading_part=READING_PART,
        least_reading=LEAST_READING,
        reading_margin=READING_MARGIN,
        time_unit=float(geometry.unit[-1]),
        reach=singular_passages.CROSSING_SEARCH,
    )
    return rows, search


def recorded_turns(
    monitor: ConstraintMonitor, scheme: ButcherTableau, steps: StepData, dips: RecordedDips
) -> RecordedDips:
    """As :func:`srm_mbs.integration.singular_passages.recorded_turns`."""
    if isinstance(monitor.dense, CompiledDenseOutput) and not np.logical_or.reduce(steps.stiff):
        found = monitor.dense.turns(scheme, dips, monitor.tolerance)
        if found is not None:
            return found
    return singular_passages.recorded_turns(monitor, scheme, steps, dips)


def critical_near(monitor: ConstraintMonitor, t: float) -> CriticalPlace | None:
    """As :func:`srm_mbs.integration.singular_passages.critical_near`; that itself for mechanisms
    with many coordinates, of which it has faster algebra."""
    dense = monitor.dense
    large = monitor.geometry.model.nv > critical_passages.LARGEST
    if large or not isinstance(dense, CompiledDenseOutput):
        return singular_passages.critical_near(monitor, t)
    return dense.critical_near(monitor, t)


def dips_in_records(
    system: ClosedSystem | OpenSystem, scheme: ButcherTableau, dense: DenseOutput, tolerance: float
) -> RecordedDips | tuple[()] | None:
    """:func:`recorded_dips`, told from turns where the kernel can, of records of the kernel before
    they are arrays; () if they show that
    :func:`~srm_mbs.integration.singular_passages.find_crossings` finds nothing, None if they are
    arrays, or have to be.  ``tolerance``: as of :class:`ConstraintMonitor`."""
    if not isinstance(dense, CompiledDenseOutput) or dense.recorded is None:
        return None
    analysis = system.singularities
    if analysis is None:
        return ()
    records, stop = dense.recorded
    if analysis.sigma_reference < SMALL_REFERENCE_PIVOT or records.stiff:
        return None
    # Of driven mechanisms, layers that steps resolve are looked for as well.
    layers = analysis.driven and records.least_sigma < AVOIDED_SIGMA
    found = core.dips_of_records(_dip_search(scheme), records, stop)  # type: ignore[union-attr]
    if found is None:
        return None if layers else ()
    dips = RecordedDips(*found)
    others = dense.turns(scheme, dips, exact_up_to(tolerance))
    if others is None:
        return dips
    return others if others or layers else ()


def close_to_singular(abscissae: FloatArray, sigmas: FloatArray) -> BoolArray:
    """As :func:`srm_mbs.integration.dense_output.close_to_singular`, of sigmas (n, s + 1)."""
    found = core.close_to_singular(  # type: ignore[union-attr]
        abscissae.tolist(), sigmas, marshalling.dense_constants()
    )
    close: BoolArray = found > 0.0
    return close
