r"""The Sequential Regularization Method: m sweeps over every step.

Mechanisms, (2.6) of the thesis,

    q_s' = v_s - E g/eps,   v_s' = M^{-1} f - yhat_s,   yhat_s = P (yhat_{s-1} + v_s/eps);

DAEs, (2.2) or (2.4) (:class:`srm_mbs.SemiExplicitDAE`).  The result is sweep m.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

from srm_mbs.errors import InputError
from srm_mbs.integration.methods.base import DelegatingMethod, Method
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.tableaus import check_explicit
from srm_mbs.integration.methods.thesis.iterated_sweeps import First, IteratedSweeps
from srm_mbs.integration.methods.thesis.regularisation import Regularisation, parse_eps
from srm_mbs.integration.methods.thesis.sweep import REGULARISERS, interpolant
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import choice, flag, positive_integer

LARGEST_CARRIED = 3
"""Number of sweeps up to which restarting with the carried multiplier is stable (measured)."""


@dataclass(frozen=True)
class SRM(DelegatingMethod):
    r"""SRM with m sweeps.

    Theory: O(eps^m) + O(h^p), so min(m, p) with eps = h.  Observed
    (``tests/integration/methods/thesis/test_sweeps.py``): 2 for mechanisms with tvd32 and erk4,
    whose linear interpolation of the multiplier is of second order; about 3 with dopr54 and m = 5,
    because with eps = h an explicit scheme has stage order 1 on the terms in 1/eps; 1 when
    restarted from multiplier 0, and 2 with ``carry``, whose first multiplier is constant over the
    step, whatever m.  The higher orders of the thesis show on its problem 1, which has no error but
    these.

    With step-size control, singular configurations that rounding keeps such short steps from
    passing within the tolerance are passed by the split form of the same tableau
    (:mod:`srm_mbs.integration.methods.thesis.iterated_sweeps`; slider-crank: from 1e-7 on), and the
    message says so.

    With step-size control, ``restart`` and ``carry``, measured with tvd32 and m = 3: slider-crank
    to t = 40 through its passages, errors 1e-3 and 4e-5 at tolerances of 1e-4 and 1e-5; four-bar
    to t = 5, 5e-3 and 4e-4.  Sweeps with their own history drift apart, and the last one is off the
    closures by a power of eps that no step mends: the message says how far.  With a fixed eps of
    0.01 and 0.003 s at 1e-4 and 1e-5 the slider-crank has errors of 6e-4 and 2e-5, but the four-bar
    0.6 with 0.003 s at 1e-4; with eps = h every change of the step is an initial layer, which takes
    nine times the steps of restarted sweeps.

    Parameters
    ----------
    tableau
        Name in :data:`srm_mbs.TABLEAUS`, or a :class:`ButcherTableau`.
    iterations
        Number m of sweeps; by default the order of the tableau, at most 3 with ``carry``.
    eps
        Regularisation parameter: seconds, or ``"h"``, ``"5h"``, ``"h^(2/3)"`` with the step h (s).
        Explicit schemes need h/eps below their real stability limit.
    restart
        False: every sweep keeps its own trajectory for the whole run, as in the thesis; but next
        to singular configurations, where the first sweeps are too far off the closures to determine
        the branch, all start again from the accepted state, y_0 being its multiplier.  True: every
        step starts all sweeps from the accepted state of the last one.  With step-size control use
        True.
    carry
        With ``restart``: yhat_0 of a step is the last sweep's multiplier at its start instead of
        0, which would put an initial layer into every step.  Needs m <= 3: more sweeps amplify
        what is carried.  It is stable up to smaller h/eps than the scheme: 2.0, 1.4, 1.2 with 1, 2,
        3 sweeps of tvd32, 3.2, 2.5, 2.2 of dopr54, 2.7 of erk4 (measured).
    T
        For DAEs: ``"identity"``, ``"transpose"`` (GB)^T or ``"inverse"`` (GB)^-1.
    interpolation
        Of the multiplier between the sweeps: ``"auto"`` or ``"linear"``
        (:func:`~srm_mbs.integration.methods.thesis.sweep.interpolant`).

    Raises
    ------
    InputError
        For an unknown tableau or option, or a combination that makes no sense.
    """

    tableau: str | ButcherTableau = "tvd32"
    iterations: int | None = None
    eps: float | str = "h"
    restart: bool = False
    carry: bool = False
    T: str = "identity"
    interpolation: str = "auto"

    def __post_init__(self) -> None:
        check_explicit(self.scheme)
        order, m = self.scheme.order, self.iterations
        if m is None:
            m = min(order, LARGEST_CARRIED) if self.carry else order
        m = positive_integer(m, "iterations", "Give a positive integer", " of sweeps")
        object.__setattr__(self, "iterations", m)
        for name in ("restart", "carry"):
            object.__setattr__(self, name, flag(getattr(self, name), name))
        if self.carry and not self.restart:
            raise InputError(
                "carry=True without restart=True: sweeps with their own history start from 0",
                element="carry",
                remedy="Give restart=True as well",
            )
        if self.carry and m > LARGEST_CARRIED:
            raise InputError(
                f"iterations = {m} with carry=True is unstable",
                element="iterations",
                remedy=f"Use at most {LARGEST_CARRIED} sweeps, or carry=False",
            )
        choice(self.T, REGULARISERS, "T")
        self.stepper  # noqa: B018 - bad eps or interpolation is refused now

    @cached_property
    def regularisation(self) -> Regularisation:
        """eps as a function of the step."""
        return parse_eps(self.eps)

    @cached_property
    def stepper(self) -> Method:
        """The sweeps of a step."""
        sweeps = IteratedSweeps(
            self.scheme,
            First.HELD if self.carry else First.ZERO,
            self.iterations or 1,
            not self.restart,
            self.regularisation,
            interpolant(self.scheme, self.interpolation),
        )
        return cast(Method, sweeps)  # its memory is its own, a SweepState
