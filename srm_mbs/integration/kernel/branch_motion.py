"""The motion next to a singular configuration, and nodes of its branch, by the compiled kernel."""

from __future__ import annotations

from typing import Any

import numpy as np

from srm_mbs._kernel import core
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.singularities.branch_limit import BranchCurve
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.kernel.marshalling import CONSTANTS, norm_struct, tableau_struct
from srm_mbs.integration.methods.base import ErrorNorm
from srm_mbs.integration.methods.branch_nodes import BranchNodes
from srm_mbs.integration.methods.tableaus import get_tableau
from srm_mbs.integration.singular_endpoints import Point


def curve_struct(curve: BranchCurve) -> Any:
    """``BranchCurve`` of branch_motion.hpp."""
    nq = curve.geometry.model.nq
    first, last = curve.range
    return core.BranchCurve(  # type: ignore[union-attr]
        q=np.array(curve.place[:nq]),
        t=float(curve.place[nq]) if len(curve.place) > nq else 0.0,
        unit=curve.geometry.unit,
        along=curve.along,
        nodes=curve.nodes,
        normal=np.ravel(curve.normal),
        velocities=np.ravel(curve.velocities),
        quadratic=np.ravel(curve.quadratic),
        first=first,
        last=last,
    )


class CompiledBranchNodes(BranchNodes):
    """:class:`~srm_mbs.integration.methods.branch_nodes.BranchNodes` by the kernel, for stages of
    ``evaluator``, an :class:`~srm_mbs.integration.kernel.system.Evaluator`."""

    def __init__(self, evaluator: Any) -> None:
        super().__init__(evaluator)
        self._nodes = core.BranchNodes(  # type: ignore[union-attr]
            evaluator.kernel_system, CONSTANTS, self._singular
        )

    def solve(self, t: float, state: FloatArray, away: FloatArray) -> bool:
        """Solve the stage ``state`` (nx,) at t (s); whether it could be solved."""
        try:
            found = self._nodes.solve(t, state, away)
        except ArithmeticError as error:
            raise EvaluationError("a node of the branch") from error
        if found is not None:
            self.state, self.rate, self.multiplier, self.moved, along = found
            self.away = along[None]
        return found is not None


class CompiledNodes:
    """:class:`~srm_mbs.integration.singular_endpoints.NodeMaker` by the kernel.

    Parameters
    ----------
    kernel_system
        The mechanism in the kernel.
    norm
        Error norm of the run.
    """

    def __init__(self, kernel_system: Any, norm: ErrorNorm) -> None:
        scheme = get_tableau("dop853")
        self._motion = core.BranchMotion(  # type: ignore[union-attr]
            kernel_system, tableau_struct(scheme), CONSTANTS, norm_struct(norm)
        )
        self._curve: tuple[BranchCurve | None, Any] = (None, None)

    def nodes(
        self,
        points: list[Point],
        times: FloatArray,
        values: FloatArray,
        direct: float,
        curve: BranchCurve | None,
        extrapolated: int,
    ) -> tuple[list[Point], FloatArray | None]:
        """See :class:`~srm_mbs.integration.singular_endpoints.NodeMaker`.

        Raises
        ------
        EvaluationError
            If a stage or a node cannot be evaluated.
        """
        if curve is not self._curve[0]:
            self._curve = curve, None if curve is None else curve_struct(curve)
        given = [
            core.BranchPoint(p.state, p.rate, p.multiplier, p.sigma)  # type: ignore[union-attr]
            for p in points
        ]
        try:
            found, left = self._motion.nodes(
                times, np.ravel(values), given, extrapolated, direct, self._curve[1]
            )
        except ArithmeticError as error:
            raise EvaluationError("a stage next to a singular configuration") from error
        made = [Point(p.state, p.rate, p.multiplier, p.sigma) for p in found[len(points) :]]
        return [*points, *made], left
