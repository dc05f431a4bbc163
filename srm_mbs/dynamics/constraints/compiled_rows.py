"""Rows of closures, g and G, by the compiled kernel: for walks over many single configurations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._kernel import core
from srm_mbs._kernel.workspace import take_idle, workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rheonomic import unscaled_rows
from srm_mbs.dynamics.constraints.row_algebra import CompiledAlgebra, RowAlgebra
from srm_mbs.dynamics.constraints.rows import COINCIDENT, LoopKinematics
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData, per_model

_NO_NUMBERS = np.zeros(0)
KEPT_SUPPORTS = 2048
"""Closures whose coordinates are kept: variants of a mechanism have the same.  Runs ask for all in
turn: of a mechanism with more closures none would still be there."""


def closure_structs(constants: dict[str, Any]) -> dict[str, Any]:
    """The fields of ``SystemData`` (system.hpp) that describe closures.

    Parameters
    ----------
    constants
        From :meth:`~srm_mbs.dynamics.constraints.rows.LoopKinematics.constants`.
    """
    made: Any = core
    return {
        "closures": [_closure_rows(**rows) for rows in constants["loops"]],
        "joint_rows": [made.JointRow(**row) for row in constants["joint_rows"]],
        "eliminations": [
            made.Elimination(row=row, other=other, factor=factor, columns=columns)
            for row, other, factor, columns in constants["eliminations"]
        ],
    }


def _closure_rows(support: FloatArray, **rows: Any) -> Any:
    made: Any = core
    columns, signs = _columns_and_signs(support.tobytes())
    return made.ClosureRows(columns=columns, signs=signs, **rows)


@lru_cache(maxsize=KEPT_SUPPORTS)
def _columns_and_signs(support: bytes) -> tuple[list[int], FloatArray]:
    """The coordinates that move a closure, and in which sense, from the bytes of its support (nv,);
    nothing may change them."""
    signs = np.frombuffer(support)
    columns = np.flatnonzero(signs)
    return columns.tolist(), signs[columns]


class ClosureRows:
    """g and G of closures at one configuration after the other, by the kernel where there is one.

    Parameters
    ----------
    model, rows
        The tree, and the rows of its closures, without motions of drives; only a copy of their
        workspace is evaluated.

    Attributes
    ----------
    g : (m,), G : (m, nv)
        Closure errors and their Jacobian, after :meth:`evaluate`; they are not changed afterwards.
    idle
        Kernel systems of the rows, without drives and forces, that nobody uses; None without the
        kernel.
    """

    def __init__(self, model: pin.Model, rows: LoopKinematics) -> None:
        self._model, self._given = model, rows
        self.g, self.G = rows.g, rows.G
        self.idle = None if core is None else rows.idle

    def _made(self) -> Any:
        """A kernel system of the rows."""
        count, nv = len(self._given.g), int(self._model.nv)
        fields: dict[str, Any] = {
            "drives": [],
            "forces": [],
            "rows": count,
            "structural_rank": 0,
            "sigma_ref": 1.0,
            "algebra": "auto",
            "order": [],
            "pivot_share": 0.0,
            "pivot_window": 1,
            "residual_scale": np.ones(count),
            "unit": np.ones(nv),
            "position_of": [-1] * nv,
            "damping": _NO_NUMBERS,
            "friction": _NO_NUMBERS,
            "friction_speed": 1.0,
            "coincident": COINCIDENT,
            "half_turn": np.zeros(2),
            "groups": [],
            "series": _NO_NUMBERS,
            "wrapped_angles": [],
            "largest_rotation": 0.0,
            "farthest_node": 0.0,
            "rotation_per_step": 0.0,
        }
        closures = closure_structs(LoopKinematics.constants(self._given))
        made: Any = core
        return made.System(self._model, made.SystemData(**fields, **closures), None)

    def _by_kernel(self, name: str, *arguments: Any) -> Any:
        """The result of a method of the kernel's system of the rows, which no other thread uses
        meanwhile; None without the kernel, and where something cannot be evaluated."""
        if self.idle is None:
            return None
        kernel_system = take_idle(self.idle)
        if kernel_system is None:
            kernel_system = self._made()
        else:
            kernel_system.move(self._model, self._given.origins)
        try:
            return getattr(kernel_system, name)(*arguments)
        except ArithmeticError:
            return None
        finally:
            self.idle.append(kernel_system)

    @cached_property
    def _data(self) -> pin.Data:
        return workspace(self._model)

    @cached_property
    def _rows(self) -> LoopKinematics:
        return self._given.copy_workspace()

    def at(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """g and G at the configuration q (nq,).

        Raises
        ------
        EvaluationError
            If the points of a ``distance`` coincide.
        """
        found = self._by_kernel("rows_at", 0.0, np.ascontiguousarray(q))
        if found is not None:
            return found  # type: ignore[no-any-return]
        # The reference raises the error that says why.
        self._rows.evaluate(self._model, self._data, q)
        return self._rows.g.copy(), self._rows.G.copy()

    def jacobians(self, q: FloatArray) -> FloatArray:
        """G (n, m, nv) at n configurations q (n, nq), otherwise as :meth:`at`."""
        found: FloatArray | None = self._by_kernel("jacobians", np.zeros(len(q)), q)
        if found is not None:
            return found
        return np.array([self.at(each)[1] for each in q])

    def evaluate(self, q: FloatArray) -> None:
        """Evaluate g and G as :meth:`at`."""
        self.g, self.G = self.at(q)

    def close(
        self,
        algebra: RowAlgebra | CompiledAlgebra,
        row_unit: FloatArray,
        units: FloatArray,
        q: FloatArray,
        limits: Limits,
    ) -> tuple[FloatArray, float] | None:
        """Newton's iteration from q (nq,) onto the first rows, as many as ``algebra`` has, in one
        call of the kernel; None without it, and where the rows cannot be evaluated.

        Parameters
        ----------
        row_unit : (rows,), units : (nv,)
            Errors over their units; steps are the shortest in those of the coordinates.
        limits
            Where the iteration ends.

        Returns
        -------
        tuple
            The last configuration, and the largest error there, over its unit.
        """
        if self.idle is None or not isinstance(algebra, CompiledAlgebra):
            return None
        start = np.ascontiguousarray(q)
        return self._by_kernel(  # type: ignore[no-any-return]
            "close", algebra.compiled, row_unit, units, start, limits.compiled()
        )

    def regular_start(
        self, rules: Any, *request: Any
    ) -> tuple[FloatArray, FloatArray, float, float, float, float] | None:
        """The consistent state next to a closed and regular guess, see ``find_regular_start``
        (regular_start.hpp): q (nq,), v (nv,), the diagonal (m) of the scene at the guess, the least
        inertia, and the least and the largest gyration; None where there is none, and without the
        kernel.

        Parameters
        ----------
        rules
            The kernel's ``StartRules``.
        request
            The fields of ``StartRequest``.
        """
        return self._by_kernel("regular_start", rules, *request)  # type: ignore[no-any-return]

    def sampler(
        self, algebras: Sequence[RowAlgebra | CompiledAlgebra], limits: Limits, **scaled: Any
    ) -> CompiledSampler | None:
        """Walks by the kernel over the rows; None without it.

        Parameters
        ----------
        algebras
            Of all rows and of those of the loops in the mass metric, and of the latter in units.
        scaled
            The other fields of ``ScaledRows`` (manifold.hpp).
        """
        compiled = [each.compiled for each in algebras if isinstance(each, CompiledAlgebra)]
        if self.idle is None or len(compiled) < len(algebras):
            return None
        made: Any = core
        scaled_rows = made.ScaledRows(closing=limits.compiled(), **scaled)
        return CompiledSampler(self._by_kernel, (scaled_rows, *compiled))


@per_model
def _shared_rows(mechanism: MechanismData) -> ClosureRows:
    return ClosureRows(mechanism.model, unscaled_rows(mechanism))


def compiled_rows(mechanism: MechanismData) -> ClosureRows:
    """All rows of a mechanism, unscaled and without the motions of its drives, for users of which
    none keeps results in it."""
    if core is not None:
        return _shared_rows(mechanism)
    return ClosureRows(mechanism.model, unscaled_rows(mechanism))


@dataclass(frozen=True)
class Limits:
    """Where Newton's iteration onto closures ends, as for
    :func:`~srm_mbs.dynamics.constraints.newton.newton`, not monotone.

    Attributes
    ----------
    evaluations, tolerance, rounding
        As there.
    cut
        Pivots below this part of the longest row are zero.
    """

    evaluations: int
    tolerance: float
    rounding: float
    cut: float

    def compiled(self) -> Any:
        """The kernel's own."""
        made: Any = core
        return made.ClosingLimits(
            evaluations=self.evaluations,
            tolerance=self.tolerance,
            rounding=self.rounding,
            cut=self.cut,
        )


@dataclass(frozen=True)
class CompiledSampler:
    """Walks of the load-time analysis in one call of the kernel each, from
    :meth:`ClosureRows.sampler`.  What they return is None where anything cannot be evaluated."""

    by_kernel: Callable[..., Any]
    rows: tuple[Any, ...]

    def walk(
        self,
        q: FloatArray,
        sample_start: bool,
        directions: FloatArray,
        reaches: FloatArray,
        first: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None:
        """See ``ScaledSampler::walk``: configurations (n, nq), pivots (n, k) of all rows and
        (n, l) of those of the loops, and the largest norms (rows,) of rows."""
        start = np.ascontiguousarray(q)
        return self.by_kernel(  # type: ignore[no-any-return]
            "walk", *self.rows, start, sample_start, directions, reaches, first
        )

    def open_norms(
        self, q: FloatArray, spreads: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """See ``ScaledSampler::open_norms``: sums (rows,) and (2,) over the spreads (n, nv)."""
        return self.by_kernel(  # type: ignore[no-any-return]
            "open_norms", *self.rows, np.ascontiguousarray(q), spreads
        )
