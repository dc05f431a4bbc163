r"""The Predicted Sequential Regularization Method in all its forms.

:mod:`srm_mbs.integration.methods.split_step` makes the steps of its split form, the default, and
:mod:`srm_mbs.integration.methods.thesis.iterated_sweeps` those of the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

from srm_mbs.errors import InputError, safe_repr
from srm_mbs.integration.methods.base import DelegatingMethod, Method
from srm_mbs.integration.methods.butcher import ButcherTableau, DenseExtension
from srm_mbs.integration.methods.linear_split_step import LinearSplitStep, SwitchingStep
from srm_mbs.integration.methods.split_step import SplitStep
from srm_mbs.integration.methods.tableaus import check_explicit, get_tableau
from srm_mbs.integration.methods.thesis.iterated_sweeps import First, IteratedSweeps
from srm_mbs.integration.methods.thesis.regularisation import Regularisation, parse_eps
from srm_mbs.integration.methods.thesis.sweep import (
    INTERPOLATIONS,
    REGULARISERS,
    interpolant,
)
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import choice

_FORMS = {"exact": ("split", "sweep", "fused"), "simple": ("sweep",)}
"""Corrections of each prediction, the default first."""


def is_split(method: Method) -> bool:
    """Whether ``method`` is the split PSRM itself, which the kernel has: the steps of a subclass
    may be others."""
    return type(method) is PSRM and method.correction == "split"


@dataclass(frozen=True)
class PSRM(DelegatingMethod):
    r"""Predicted sequential regularisation, in all its forms.

    =========== ============ ===================================================== ==============
    prediction  correction   what a step does                                      default eps
    =========== ============ ===================================================== ==============
    exact       split        exact multiplier at the stages, correction at the end None: eps -> 0
    exact       sweep        predictor sweep, then a corrector sweep (3.3)         h^(2/3), from
                                                                                   order 5 h^(1/3)
    exact       fused        both in one sweep at its own stages                   as for sweep
    simple      sweep        multiplier held over the step, one corrector (3.1)    h
    =========== ============ ===================================================== ==============

    The split form has the order of its tableau and is the one to use.  Orders of the others, which
    ``tests/integration/methods/thesis/test_sweeps.py`` observes: simple 2 with eps proportional to
    h, 1 with a fixed eps; exact sweeps O(eps h^2) + O(h^4/eps^2) for erk4, so 8/3 with
    eps = h^(2/3), and O(eps h^4) + O(h^5/eps^2) for dopr54, so 13/3 with eps = h^(1/3).  With a
    fixed eps the exact sweeps with ``interpolation="stages"``, and the fused form, have the order
    of the tableau.

    Parameters
    ----------
    tableau
        Name in :data:`srm_mbs.TABLEAUS`, or a :class:`ButcherTableau`.  The sweeps are explicit:
        their default is ``"dop853"``.
    prediction
        ``"exact"``: the multiplier of every stage from the acceleration-level equations;
        ``"simple"``: that of the step before.
    correction
        ``"split"``, ``"sweep"`` or ``"fused"``; by default split for the exact prediction, sweep
        for the simple one.
    eps
        Regularisation parameter: seconds, or ``"h"``, ``"5h"``, ``"h^(2/3)"`` with the step h
        (s).  None for the default of the form.  Explicit schemes need h/eps below their real
        stability limit
        (:func:`~srm_mbs.integration.methods.thesis.regularisation.real_stability_limit`).
    T
        For DAEs: ``"identity"``, ``"transpose"`` (GB)^T or ``"inverse"`` (GB)^-1, in the sweeps.
        Mechanisms have no such choice, and the split form is the same for all.
    interpolation
        Of the predicted multiplier, with ``correction="sweep"``: ``"stages"``, the predictor's own
        stages, the default: full order with a fixed eps; or as in the thesis, ``"auto"`` or
        ``"linear"`` (:func:`~srm_mbs.integration.methods.thesis.sweep.interpolant`), which leave
        larger constraint errors and need more steps: with dopr54, the slider-crank to t = 20 at a
        tolerance of 1e-4, 95 for ``"stages"``, 101 for ``"auto"``, some 770 for ``"linear"``, which
        is of order 2.

    Raises
    ------
    InputError
        For an unknown tableau or option, a combination that does not exist, or eps <= 0.
    """

    tableau: str | ButcherTableau = "auto"
    prediction: str = "exact"
    correction: str | None = None
    eps: float | str | None = None
    T: str = "identity"
    interpolation: str = "stages"

    def __post_init__(self) -> None:
        get_tableau(self.tableau)
        forms = _FORMS.get(self.prediction, ()) if isinstance(self.prediction, str) else ()
        if self.correction is None and forms:
            object.__setattr__(self, "correction", forms[0])
        if self.correction not in forms:
            raise InputError(
                f"there is no PSRM with prediction={safe_repr(self.prediction)}, "
                f"correction={safe_repr(self.correction)}",
                element="method",
                remedy='Use prediction="exact" with correction="split", "sweep" or "fused", or '
                'prediction="simple" with correction="sweep"',
            )
        choice(self.T, REGULARISERS, "T")
        if self.correction != "split":
            if self.tableau == "auto":
                object.__setattr__(self, "tableau", "dop853")
            check_explicit(self.scheme)
        self._interpolant()
        self.regularisation  # noqa: B018 - bad eps is refused now

    def _interpolant(self) -> DenseExtension | str:
        return interpolant(self.scheme, self.interpolation, (*INTERPOLATIONS, "stages"))

    @cached_property
    def regularisation(self) -> Regularisation | None:
        """eps as a function of the step; None for eps -> 0."""
        if self.eps is not None:
            return parse_eps(self.eps)
        if self.correction == "split":
            return None
        if self.prediction == "simple":
            return parse_eps("h")
        return parse_eps("h^(1/3)" if self.scheme.order >= 5 else "h^(2/3)")

    @cached_property
    def stepper(self) -> Method:
        """The split form, or the sweeps of the others."""
        if self.correction == "split" or self.regularisation is None:
            scheme = self.scheme
            linear = LinearSplitStep if scheme.implicit is not None else SplitStep
            return (linear if scheme.stiff is None else SwitchingStep)(scheme, self.regularisation)
        fused = self.correction == "fused"
        exact = First.FUSED if fused else First.EXACT
        first = First.HELD if self.prediction == "simple" else exact
        how = self._interpolant()
        sweeps = IteratedSweeps(self.scheme, first, 1, fused, self.regularisation, how)
        return cast(Method, sweeps)  # its memory is its own, a SweepState
