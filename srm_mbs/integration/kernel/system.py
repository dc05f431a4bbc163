"""Mechanisms in the compiled kernel, their pool, and the reference with the kernel's stages."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from functools import lru_cache
from typing import Any, Self, cast

import numpy as np

from srm_mbs._kernel import core
from srm_mbs._kernel.workspace import idle_pool, take_idle
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.structure import rows_in_use, structure_of
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.dynamics.system import Zone
from srm_mbs.integration.kernel.branch_motion import CompiledBranchNodes, CompiledNodes
from srm_mbs.integration.kernel.marshalling import system_struct
from srm_mbs.integration.methods.base import ErrorNorm
from srm_mbs.integration.singular_endpoints import MakesNodes
from srm_mbs.model.mechanism import MechanismData, per_model

LARGEST_KEPT = 641
"""Coordinates of a mechanism that keeps any: one takes 11 MB there."""


def make_kernel_system(system: ClosedSystem | OpenSystem, code: Any = None) -> Any:
    """The mechanism of ``system`` in the kernel, with a workspace of its own.

    Parameters
    ----------
    code
        Generated code that computes its terms
        (:func:`~srm_mbs.integration.generated.code.load_code`); None: a pass over the tree does.
    """
    held = system.held
    calls = system.has_user_forces or (system.controlled and held is None)
    controller = system.callback_force if calls else None
    data = system_struct(system.constants())
    kernel_system = core.System(system.model, data, controller)  # type: ignore[union-attr]
    if held is not None:
        for t, force in zip(held.times, held.values):
            kernel_system.hold(t, force, True)
    kernel_system.use_code(code)
    return kernel_system


def shared(system: ClosedSystem | OpenSystem) -> bool:
    """Whether a kernel system of ``system`` serves every run of its mechanism: it holds no function
    of the user and no motion from one start, and is small enough to be kept."""
    return (
        system.nv <= LARGEST_KEPT
        and system.held is None
        and not (system.controlled or system.has_user_forces or system.mechanism.drives)
    )


@per_model
def idle_workspaces(mechanism: MechanismData) -> deque[Any]:
    """The pool of a mechanism: kernel systems of :func:`shared` ones that no run uses; those of
    variants with the same rows and without force elements are the same."""
    if mechanism.forces or not structure_of(mechanism).rank:
        return idle_pool(mechanism.model.nv)
    return rows_in_use(mechanism).idle


class workspace:  # noqa: N801 - used as a function
    """A kernel system of ``system`` for one user: an idle one of its mechanism, or a new one;
    ``code`` as for :func:`make_kernel_system`.  A context manager, whose object it is.

    It returns to the pool afterwards, if it is :func:`shared`.  One whose user raised is left to
    the garbage collector.

    A program that ends waits for the user's thread, which sleeps from its next call of the kernel
    on: its Python code between such calls may be in C++ of a library, where CPython's end of a
    daemon thread aborts the program.
    """

    __slots__ = ("_code", "_kernel_system", "_pool", "_system")

    def __init__(self, system: ClosedSystem | OpenSystem, code: Any = None) -> None:
        self._system, self._code = system, code

    def __enter__(self) -> Any:
        core.enter_python()  # type: ignore[union-attr]
        try:
            system = self._system
            self._pool = idle_workspaces(system.mechanism) if shared(system) else None
            self._kernel_system = _idle_or_new(self._pool, system, self._code)
        except BaseException:
            core.leave_python()  # type: ignore[union-attr]
            raise
        return self._kernel_system

    def __exit__(self, kind: Any, *_: object) -> None:
        try:
            if kind is None and self._pool is not None:
                self._pool.append(self._kernel_system)
        finally:
            core.leave_python()  # type: ignore[union-attr]


class SuccessiveWorkspaces:
    """Kernel systems for one user, who needs one after the other: the same as long as the equations
    of motion are.  A context manager."""

    __slots__ = ("_kernel_system", "_lent", "_system")

    def __init__(self) -> None:
        self._system: ClosedSystem | OpenSystem | None = None
        self._kernel_system: Any = None
        self._lent: workspace | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        lent, self._lent = self._lent, None
        if lent is not None:
            lent.__exit__(*error)

    def of(self, system: ClosedSystem | OpenSystem, code: Any) -> Any:
        """That of ``system``, as new; ``code`` as for :func:`make_kernel_system`."""
        if system is self._system:
            self._kernel_system.restart()
        else:
            self._system = None
            self.__exit__(None)
            lent = workspace(system, code)
            self._kernel_system = lent.__enter__()
            self._lent, self._system = lent, system
        return self._kernel_system

    def evaluator(self, system: ClosedSystem | OpenSystem) -> Evaluator | ClosedSystem | OpenSystem:
        """``system``, evaluated by its kernel system, if this was asked for that last."""
        return Evaluator(system, self._kernel_system) if system is self._system else system


def _idle_or_new(pool: deque[Any] | None, system: ClosedSystem | OpenSystem, code: Any) -> Any:
    kernel_system = None if pool is None else take_idle(pool)
    if kernel_system is None:
        return make_kernel_system(system, code)
    kernel_system.move(system.model, system.origins)
    kernel_system.renew(**system.constants_of_start())
    kernel_system.use_code(code)
    return kernel_system


@lru_cache(maxsize=64)
def _ones(size: int) -> FloatArray:
    return np.ones(size)


class _KernelTerms:
    """Terms of a stage, evaluated by the kernel; dropped rows have no multiplier."""

    held = False

    def __init__(self, found: dict[str, Any]) -> None:
        self.sigma: float = found["sigma"]
        self.rank: int = found["rank"]
        self.rank_deficient: bool = found["rank_deficient"]
        self._found = found

    def rate(self) -> FloatArray:
        return self._found["rate"]  # type: ignore[no-any-return]

    def multiplier(self) -> FloatArray:
        return self._found["multiplier"]  # type: ignore[no-any-return]

    def correction(self) -> FloatArray:
        return self._found["correction"]  # type: ignore[no-any-return]


class Evaluator(MakesNodes):
    """A system whose stages are evaluated by the kernel, if no multiplier is to be predicted.

    Parameters
    ----------
    system, kernel_system
        The mechanism, and its kernel system from :func:`make_kernel_system`.
    """

    def __init__(self, system: ClosedSystem | OpenSystem, kernel_system: Any) -> None:
        self.system = system
        self.kernel_system = kernel_system

    def __getattr__(self, name: str) -> Any:
        return getattr(self.system, name)

    def between(self, first: float, last: float) -> None:
        """Evaluate both at times within [``first``, ``last``] (s) only: between breakpoints."""
        self.system.between(first, last)
        self.kernel_system.between(first, last)

    def begin_step(self, t: float, state: FloatArray) -> None:
        """Begin a step of both from ``state`` at ``t`` (s)."""
        self.system.begin_step(t, state)
        self.kernel_system.begin_step(t, state)

    def largest_residuals(self, state: FloatArray, t: float) -> tuple[float, float]:
        """As :meth:`~srm_mbs.dynamics.multibody.ClosedSystem.largest_residuals`."""
        system = self.system
        if system.has_constraints:
            with suppress(ArithmeticError):  # the reference raises the error that says why
                unit = _ones(len(cast(ClosedSystem, system).residual_scale))
                return self.kernel_system.largest_errors(t, *system.split(state), unit)  # type: ignore[no-any-return]
        return system.largest_residuals(state, t)

    def impulse_response(self, q: FloatArray, n: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As :meth:`~srm_mbs.dynamics.multibody.ClosedSystem.impulse_response`."""
        try:
            return self.kernel_system.impulse_response(q, n)  # type: ignore[no-any-return]
        except ArithmeticError:
            return self.system.impulse_response(q, n)  # raises the error that says why

    def node_maker(self, norm: ErrorNorm) -> CompiledNodes:
        return CompiledNodes(self.kernel_system, norm)

    def branch_nodes(self) -> CompiledBranchNodes:
        return CompiledBranchNodes(self)

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> Any:
        """Terms of a stage; see :class:`~srm_mbs.dynamics.system.System`."""
        if zone is None or not zone.predicts:
            threshold = -1.0 if zone is None else zone.threshold
            try:
                return _KernelTerms(self.kernel_system.terms(t, state, threshold))
            except ArithmeticError:
                pass  # the reference raises the error that says why
        return self.system.evaluate(t, state, zone)
