"""Quantities at many states of a mechanism by the compiled kernel, in one call for all of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from srm_mbs._kernel import core
from srm_mbs._kernel.workspace import idle_pool, take_idle
from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.compiled_rows import compiled_rows
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.reactions import Reactions, named_reactions
from srm_mbs.dynamics.constraints.rheonomic import all_rows, constraint_errors, unscaled_rows
from srm_mbs.dynamics.constraints.row_algebra import INERT, SingularValues, active_rows
from srm_mbs.dynamics.forces import ForceKinematics
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem, make_system
from srm_mbs.dynamics.observables import (
    NO_ANGLES,
    Invariants,
    Observables,
    conservative_elements,
    working_elements,
)
from srm_mbs.integration.kernel.marshalling import force_struct, system_struct
from srm_mbs.integration.kernel.system import workspace
from srm_mbs.model.drives import in_order_of_rows
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData, per_model


def _make_all_rows(system: ClosedSystem | OpenSystem) -> Any:
    """A kernel system with all rows of closures and drives, unscaled, and no algebra of them."""
    mechanism = system.mechanism
    rows = all_rows(mechanism) if mechanism.drives else unscaled_rows(mechanism)
    own = {
        "rows": len(rows.g),
        "structural_rank": 0,
        "sigma_ref": 1.0,
        "order": [],
        "residual_scale": np.ones(len(rows.g)),
        "drives": rows.drive_constants(),
    }
    constants = system.constants() | rows.constants() | own
    return core.System(mechanism.model, system_struct(constants), None)  # type: ignore[union-attr]


@per_model
def _idle_all_rows(mechanism: Mechanism) -> deque[Any]:
    """Those of :func:`_make_all_rows` that nobody uses; of a large mechanism one.

    Without forces, and where moves commute, they are those of assembly and analysis.
    """
    known = compiled_rows(mechanism).idle
    same = not (mechanism.drives or mechanism.forces) and mechanism.model.nq == mechanism.model.nv
    if known is not None and same:
        return known
    return idle_pool(mechanism.model.nv)


class _Lent:
    """A kernel system of all rows of a mechanism, for one user; made from ``system`` if there is
    one."""

    __slots__ = ("_idle", "_kernel_system", "_mechanism", "_system")

    def __init__(
        self,
        idle: deque[Any],
        mechanism: Mechanism,
        system: ClosedSystem | OpenSystem | None,
    ) -> None:
        self._idle, self._mechanism, self._system = idle, mechanism, system

    def __enter__(self) -> Any:
        mechanism = self._mechanism
        self._kernel_system = take_idle(self._idle)
        if self._kernel_system is None:
            self._kernel_system = _make_all_rows(self._system or make_system(mechanism))
        else:
            self._kernel_system.move(mechanism.model, unscaled_rows(mechanism).origins)
        return self._kernel_system

    def __exit__(self, *_: object) -> None:
        self._idle.append(self._kernel_system)


def closure_errors(
    mechanism: Mechanism,
    t: FloatArray,
    q: FloatArray,
    v: FloatArray,
    system: ClosedSystem | OpenSystem | None = None,
) -> tuple[FloatArray, FloatArray]:
    """As :func:`~srm_mbs.dynamics.constraints.rheonomic.constraint_errors`, of a mechanism without
    drives: their rows begin with its initial state; ``system`` is its own, if it is at hand."""
    try:
        with _Lent(_idle_all_rows(mechanism), mechanism, system) as kernel_system:
            return kernel_system.closure_errors(*_states(t, q, v))  # type: ignore[no-any-return]
    except ArithmeticError:
        return constraint_errors(mechanism, t, q, v)  # raises the error that says why


def largest_errors(
    mechanism: Mechanism,
    t: float,
    q: FloatArray,
    v: FloatArray,
    unit: FloatArray,
    system: ClosedSystem | OpenSystem | None = None,
) -> tuple[float, float]:
    """The largest errors of :func:`closure_errors` at one state, q (nq,) and v (nv,), and their
    rates, over the units (rows,) of the rows; infinite where they cannot be evaluated:
    :func:`closure_errors` then raises the error that says why."""
    try:
        with _Lent(_idle_all_rows(mechanism), mechanism, system) as kernel_system:
            return kernel_system.largest_errors(t, q, v, unit)  # type: ignore[no-any-return]
    except ArithmeticError:
        return np.inf, np.inf


class CompiledObservables(Observables):
    """:class:`~srm_mbs.dynamics.observables.Observables`, evaluated by the kernel."""

    _separated: tuple[ClosureGeometry, tuple[Any, Any, int] | None] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        # Without workspaces; a copy may be loaded where there is no kernel.
        return make_observables, (self.system,)

    @cached_property
    def idle(self) -> deque[Any]:
        """Kernel systems of all rows that nobody uses."""
        mechanism = self.mechanism
        if mechanism.drives:  # they start where the mechanism does
            return deque(maxlen=1)
        return _idle_all_rows(mechanism)

    def all_rows(self) -> _Lent:
        """A kernel system of :func:`_make_all_rows` for one user."""
        return _Lent(self.idle, self.mechanism, self.system)

    @property
    def _calls_python(self) -> bool:
        """Whether functions of the user act."""
        system = self.system
        return system.has_user_forces or (system.controlled and system.held is None)

    def closure_errors(
        self, t: FloatArray, q: FloatArray, v: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        if not self.mechanism.drives:
            return closure_errors(self.mechanism, t, q, v, self.system)
        try:
            with self.all_rows() as kernel_system:
                return kernel_system.closure_errors(*_states(t, q, v))  # type: ignore[no-any-return]
        except ArithmeticError:
            return super().closure_errors(t, q, v)

    def invariants(
        self,
        t: FloatArray,
        states: FloatArray,
        ends: list[int],
        whole: int,
        order: list[int],
        starts: list[int],
    ) -> Invariants:
        """As the reference, with one pass over the bodies."""
        numbers = t, states, ends, whole, order, starts
        try:
            with self.all_rows() as kernel_system:
                return Invariants(*kernel_system.invariants(*numbers))
        except ArithmeticError:
            return super().invariants(*numbers)

    def jacobians(self, t: FloatArray, q: FloatArray) -> FloatArray:
        times, places = np.ascontiguousarray(t, dtype=float), np.ascontiguousarray(q)
        try:
            with self.all_rows() as kernel_system:
                return kernel_system.jacobians(times, places)  # type: ignore[no-any-return]
        except ArithmeticError:
            return super().jacobians(t, q)

    def smallest_values(
        self,
        geometry: ClosureGeometry,
        values: SingularValues,
        k: int,
        t: FloatArray,
        q: FloatArray,
    ) -> FloatArray:
        """As the reference, by one factorisation of the active rows for each state, from which
        Lanczos' iteration follows the smallest singular value."""
        if self._separated is None or self._separated[0] is not geometry:
            self._separated = (
                geometry,
                _separated_rows(geometry, values, self.jacobians(t[:1], q[:1])),
            )
        prepared = self._separated[1]
        # Of more active rows than k some depend on the others, and the last value is another.
        if prepared is None or prepared[2] != k:
            return super().smallest_values(geometry, values, k, t, q)
        rows, algebra, _ = prepared
        times, places = np.ascontiguousarray(t, dtype=float), np.ascontiguousarray(q)
        with self.all_rows() as kernel_system:
            found: FloatArray = kernel_system.smallest_values(rows, algebra, times, places)
        others = np.isnan(found)  # other rows are active there
        if others.any():
            found[others] = super().smallest_values(geometry, values, k, t[others], q[others])
        return found

    def largest_differences(
        self,
        a: FloatArray,
        b: FloatArray,
        unit: FloatArray,
        order: list[int],
        starts: list[int],
        turned: Sequence[int] = (),
        angles: FloatArray = NO_ANGLES,
    ) -> tuple[FloatArray, list[float]]:
        """As the reference."""
        with self.all_rows() as kernel_system:
            return kernel_system.largest_differences(  # type: ignore[no-any-return]
                a, b, unit, order, starts, turned, angles
            )

    def moved(self, states: FloatArray, motions: FloatArray) -> FloatArray:
        if states.shape[1] == motions.shape[1]:
            return states + motions
        with self.all_rows() as kernel_system:
            return kernel_system.moved(states, motions)  # type: ignore[no-any-return]

    @staticmethod
    def largest_norms(x: FloatArray, order: list[int], starts: list[int]) -> list[float]:
        """As the reference."""
        return core.largest_norms(x, order, starts)  # type: ignore[no-any-return,union-attr]

    def energies(self, q: FloatArray, v: FloatArray) -> FloatArray:
        with self.all_rows() as kernel_system:
            return kernel_system.energies(np.concatenate((q, v), axis=1))  # type: ignore[no-any-return]

    def reactions(
        self, t: FloatArray, q: FloatArray, v: FloatArray, forces: FloatArray | None = None
    ) -> Reactions:
        """As the reference, by one evaluation of each state; the reference itself where functions
        of the user act."""
        system = self.system
        if self._calls_python:
            return super().reactions(t, q, v, forces)
        try:
            with workspace(system) as kernel_system, self.all_rows() as all_rows_system:
                structure = self.mechanism.structure
                lam, on_b, joints = kernel_system.reactions(
                    all_rows_system,
                    structure.row_scale,
                    structure.kept_rows,
                    *_states(t, q, v),
                    forces,
                )
        except ArithmeticError:
            return super().reactions(t, q, v, forces)  # raises the error that says why
        return named_reactions(self.mechanism, lam, on_b.transpose(1, 0, 2), joints)

    def accelerations(self, t: FloatArray, q: FloatArray, v: FloatArray) -> FloatArray:
        if self._calls_python:
            return super().accelerations(t, q, v)
        try:
            with workspace(self.system) as kernel_system:
                return kernel_system.accelerations(*_states(t, q, v))  # type: ignore[no-any-return]
        except ArithmeticError:
            return super().accelerations(t, q, v)  # raises the error that says why

    def drive_forces(self, t: FloatArray, q: FloatArray, v: FloatArray) -> dict[str, FloatArray]:
        """As the reference, from the factorisation of each state; the reference itself for states
        at which rows depend on each other, and where functions of the user act."""
        if self._calls_python:
            return super().drive_forces(t, q, v)
        try:
            with workspace(self.system) as kernel_system:
                forces: FloatArray = kernel_system.drive_forces(*_states(t, q, v))
        except ArithmeticError:
            return super().drive_forces(t, q, v)  # raises the error that says why
        open_ones = np.isnan(forces).any(axis=1)
        if open_ones.any():
            found = super().drive_forces(t[open_ones], q[open_ones], v[open_ones])
            forces[open_ones] = np.column_stack(list(found.values()))
        names = (drive.name for drive in in_order_of_rows(self.mechanism.drives))
        return dict(zip(names, forces.T))

    def _powers(
        self,
        elements: dict[str, ForceKinematics],
        t: FloatArray,
        q: FloatArray,
        v: FloatArray,
        resting: bool = False,
    ) -> dict[str, FloatArray]:
        own = {name: element.constants() for name, element in elements.items()}
        compiled = [name for name, constants in own.items() if constants]
        called = {name: elements[name] for name in elements if name not in compiled}
        powers = super()._powers(called, t, q, v, resting) if called else {}
        if compiled:
            structs = [force_struct(**own[name][0]) for name in compiled]
            try:
                with self.all_rows() as kernel_system:
                    found = kernel_system.powers(*_states(t, q, v), structs, resting)
            except ArithmeticError:
                return super()._powers(elements, t, q, v, resting)
            powers |= dict(zip(compiled, found.T))
        return {name: powers[name] for name in elements}

    def stage_powers(
        self,
        chosen: IndexArray,
        times: FloatArray,
        states: FloatArray,
        rates: FloatArray,
        A: FloatArray,
        c: FloatArray,
    ) -> dict[str, FloatArray]:
        """As the reference."""
        structs = _structs_of_dampers(self.mechanism)
        if structs is None:
            return super().stage_powers(chosen, times, states, rates, A, c)
        try:
            with self.all_rows() as kernel_system:
                found = kernel_system.stage_powers(
                    chosen.tolist(), times, states, rates, A, c, structs
                )
        except ArithmeticError:  # the reference raises the error that says why
            return super().stage_powers(chosen, times, states, rates, A, c)
        return dict(zip(working_elements(self.mechanism), np.moveaxis(found, 2, 0)))

    def element_works(
        self, dense: Any, t: FloatArray, A: FloatArray, b: FloatArray, c: FloatArray
    ) -> dict[str, FloatArray] | None:
        """Work (n,) J of each element of :meth:`stage_powers` up to the ends ``t`` (n,) s of steps
        of ``dense``, the dense output of the kernel, by the weights b (k,) of their stages; None
        where that is not all, and where powers cannot be evaluated."""
        structs = _structs_of_dampers(self.mechanism)
        if structs is None:
            return None
        try:
            with self.all_rows() as kernel_system:
                found = dense.works(kernel_system, t, structs, A, b, c)
        except ArithmeticError:
            return None
        return None if found is None else dict(zip(working_elements(self.mechanism), found.T))


@per_model
def _structs_of_dampers(mechanism: MechanismData) -> list[Any] | None:
    """The working elements as the kernel takes them; None if it cannot evaluate all, or their force
    at rest has a potential."""
    own = [element.constants() for element in working_elements(mechanism).values()]
    if not all(own) or conservative_elements(mechanism):
        return None
    return [force_struct(**constants[0]) for constants in own]


def make_observables(system: OpenSystem | ClosedSystem) -> Observables:
    """Those of ``system`` by the kernel, if it is there."""
    return (Observables if core is None else CompiledObservables)(system)


def _separated_rows(
    geometry: ClosureGeometry, values: SingularValues, jacobians: FloatArray
) -> tuple[Any, Any, int] | None:
    """Rows of ``geometry``, the algebra of those that are active at the first of the ``jacobians``
    (n, rows, columns), as the kernel takes both, and the number of active rows; None for few
    columns."""
    active = active_rows(geometry.separated_rows(jacobians[:1])[0])
    algebra = values.compiled(active)
    if algebra is None:
        return None
    rows = separated_rows(geometry, values, np.flatnonzero(active).tolist())
    return rows, algebra.compiled, int(active.sum())


def separated_rows(geometry: ClosureGeometry, values: SingularValues, active: list[int]) -> Any:
    """``SeparatedRows`` of separated_rows.hpp, those of ``geometry``, with singular ``values``; the
    ``active`` ones are the rows of an algebra."""
    shares = geometry.shares
    return core.SeparatedRows(  # type: ignore[union-attr]
        supports=values.supports,
        factors=geometry.row_factors,
        share_rows=[row for row, _, _ in shares],
        share_others=[other for _, other, _ in shares],
        shares=np.array([share for *_, share in shares]),
        left=geometry.left if shares else np.ones(len(values.supports)),
        active=active,
        inert=INERT,
    )


def _states(t: FloatArray, q: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and states (n, nx), as the kernel takes them."""
    return np.ascontiguousarray(t, dtype=float), np.concatenate((q, v), axis=1)
