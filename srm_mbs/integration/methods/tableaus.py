"""The Runge-Kutta schemes of the package, and how to get one by name.

Sources: C. B. Macdonald, *The Predicted Sequential Regularization Method for DAEs*, Acadia
University 2001, appendix C (with a_62 = -355/33 and a_64 = 49/176 of dopr54 corrected); E. Hairer,
S. P. Norsett, G. Wanner, *Solving Ordinary Differential Equations I*, 2nd edition, Springer 1993
(HNW below); G. Steinebach, BIT Numer. Math. 63 (2023) 27.
"""

from __future__ import annotations

import copyreg
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from types import MappingProxyType
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.integration.methods import dop853_coefficients, rodas5p_coefficients
from srm_mbs.integration.methods.butcher import (
    ButcherTableau,
    DenseExtension,
    ExactMatrix,
    ExactRow,
    ExactTableau,
    hermite,
)
from srm_mbs.model.numbers import choice


def get_tableau(name: str | ButcherTableau) -> ButcherTableau:
    """The tableau of that name; a :class:`ButcherTableau` is returned as it is.

    Raises
    ------
    InputError
        For an unknown name; lists the known ones.
    """
    if isinstance(name, ButcherTableau):
        return name
    return TABLEAUS[choice(name, TABLEAUS, "tableau")]


def check_explicit(scheme: ButcherTableau) -> None:
    """Refuse a scheme that is not explicit, or not always, for sweeps.

    Raises
    ------
    InputError
        If it is linearly implicit, or one for stiff problems takes over from it.
    """
    if scheme.implicit is not None or scheme.stiff is not None:
        explicit = [name for name, known in TABLEAUS.items() if known.member(True).implicit is None]
        raise InputError(
            f"sweeps are explicit, the tableau {scheme.name!r} is not",
            element="tableau",
            remedy=f"Use one of {', '.join(explicit)}",
        )


def _fractions(text: str) -> ExactRow:
    return tuple(Fraction(word) for word in text.split())


def _padded(rows: Iterable[Sequence[Any]], width: int) -> FloatArray:
    return np.array([[*map(float, row), *[0.0] * (width - len(row))] for row in rows])


def _nested(p1: Fraction, p2: Fraction, p3: Fraction, p4: Fraction) -> ExactRow:
    """F_0 ... F_3 of p1 theta + p2 theta^2 + p3 theta^3 + p4 theta^4."""
    f2 = -p3 - 2 * p4
    f1 = f2 + p4 - p2
    return p1 - f1, f1, f2, p4


def _rational(
    name: str,
    order: int,
    citation: str,
    A: Sequence[str],
    b: str,
    c: str,
    pair: tuple[str, int, int] | None = None,
    extensions: Mapping[str, tuple[int, int, ExactMatrix]] | None = None,
    stable_to: float | None = None,
) -> ButcherTableau:
    """Build a tableau from fractions in text.

    pair: bhat over the stages and the end-point rate, embedded_order, controller_order.
    extensions: name -> (order, continuity, rows), the default first; None for cubic Hermite.
    """
    weights = _fractions(b)
    s = len(weights)
    zero = Fraction(0)
    if extensions is None:
        extensions = {"hermite": (min(order, 3), 1, hermite(weights))}
    hat, embedded_order, controller_order = pair or (None, None, None)
    bhat = error = None
    if hat is not None:
        bhat = _fractions(hat)
        error = np.array([float(x - y) for x, y in zip((*weights, zero), bhat, strict=True)])
    exact = ExactTableau(
        A=tuple((*_fractions(row), *[zero] * (s - i)) for i, row in enumerate(A)),
        b=weights,
        c=_fractions(c),
        bhat=bhat,
        extensions={key: rows for key, (_, _, rows) in extensions.items()},
    )
    no_A, no_c = np.zeros((0, s + 1)), np.zeros(0)
    dense = {
        key: DenseExtension(key, accuracy, continuity, _padded(rows, s + 1), no_A, no_c)
        for key, (accuracy, continuity, rows) in extensions.items()
    }
    return ButcherTableau(
        name=name,
        order=order,
        citation=citation,
        A=_padded(exact.A, s),
        b=np.array(exact.b, dtype=np.float64),
        c=np.array(exact.c, dtype=np.float64),
        error=error,
        embedded_order=embedded_order,
        controller_order=controller_order,
        dense=next(iter(dense.values())),
        extensions=dense,
        exact=exact,
        stable_to=stable_to,
    )


def _dopr54() -> ButcherTableau:
    b = "35/384 0 500/1113 125/192 -2187/6784 11/84"
    # d_1 ... d_7 of dopri5.f; the formula of degree 5 printed in HNW, II.6, differs from this
    # extension of degree 4 by a multiple of theta^2 (1 - theta)^2 (1 - 2 theta).
    d = _fractions(
        "-12715105075/11282082432 0 87487479700/32700410799 -10690763975/1880347072 "
        "701980252875/199316789632 -1453857185/822651844 69997945/29380423"
    )
    # Table C.6 of the thesis, corrected: a factor and the coefficients of theta ... theta^4.
    thesis = (
        ("1", "1 -1337/480 1039/360 -1163/1152"),
        ("0", "0 0 0 0"),
        ("100/3", "0 1054/9275 -4682/27825 379/5565"),
        ("-5/2", "0 27/40 -9/5 83/96"),
        ("18225/848", "0 -3/250 22/375 -37/600"),
        ("-22/7", "0 -3/10 29/30 -17/24"),
        ("0", "0 0 0 0"),
    )
    columns = [_nested(*(Fraction(factor) * x for x in _fractions(p))) for factor, p in thesis]
    return _rational(
        "dopr54",
        5,
        "J. R. Dormand, P. J. Prince, J. Comput. Appl. Math. 6 (1980) 19; extension C1: "
        "L. F. Shampine, Math. Comp. 46 (1986) 135, and dopri5.f of HNW; extension thesis: "
        "Macdonald 2001, table C.6, corrected",
        A=(
            "",
            "1/5",
            "3/40 9/40",
            "44/45 -56/15 32/9",
            "19372/6561 -25360/2187 64448/6561 -212/729",
            "9017/3168 -355/33 46732/5247 49/176 -5103/18656",
        ),
        b=b,
        c="0 1/5 3/10 4/5 8/9 1",
        pair=("5179/57600 0 7571/16695 393/640 -92097/339200 187/2100 1/40", 4, 5),
        extensions={
            "C1": (4, 1, (*hermite(_fractions(b)), d)),
            "thesis": (4, 0, tuple(zip(*columns, strict=True))),
        },
        stable_to=3.25,
    )


def _dop853() -> ButcherTableau:
    s, n_extra = len(dop853_coefficients.B), len(dop853_coefficients.EXTRA_C)
    n_rates = s + 1 + n_extra
    cubic = hermite(tuple(map(Fraction, dop853_coefficients.B)), n_extra)
    dense = DenseExtension(
        name="dop853",
        order=7,
        continuity=1,
        rows=_padded((*cubic, *dop853_coefficients.D), n_rates),
        extra_A=_padded(dop853_coefficients.EXTRA_A, n_rates),
        extra_c=np.array(dop853_coefficients.EXTRA_C),
    )
    return ButcherTableau(
        name="dop853",
        order=8,
        citation="DOP853, Dormand and Prince 8(5, 3) without the third-order estimate: HNW, "
        "sections II.5 and II.6, and dop853.f",
        A=_padded(dop853_coefficients.A, s),
        b=np.array(dop853_coefficients.B),
        c=np.array(dop853_coefficients.C),
        error=np.array([*dop853_coefficients.E5, 0.0]),
        embedded_order=5,
        controller_order=8,
        dense=dense,
        extensions={dense.name: dense},
        exact=None,
        # Half the bound of stability, 6.1: at tight tolerances the error estimate notices the
        # fastest mode before it grows, and steps stay below the bound.
        stable_to=3.25,
    )


def _rodas5p() -> ButcherTableau:
    own = rodas5p_coefficients
    count = len(own.B)
    s = len(dop853_coefficients.B)  # as many, so that both schemes can alternate in one run
    lead = s - count

    def square(rows: Sequence[Sequence[float]]) -> FloatArray:
        out = np.zeros((s, s))
        for i, row in enumerate(rows, lead):
            out[i, lead : lead + len(row)] = row
        return out

    def weights(values: Sequence[float]) -> list[float]:
        return [*[0.0] * lead, *values, 0.0]

    rows = np.array([weights(row) for row in (own.B, *own.D)])
    dense = DenseExtension("rodas5p", 4, 0, rows, np.zeros((0, s + 1)), np.zeros(0))
    return ButcherTableau(
        name="rodas5p",
        order=5,
        citation="Rodas5P, linearly implicit and stiffly accurate, with a pair of order 4: "
        "G. Steinebach, BIT Numer. Math. 63 (2023) 27",
        A=square(own.A),
        b=np.array(weights(own.B)[:-1]),
        c=np.array([*[0.0] * lead, *own.C]),
        error=np.array(weights(own.E)),
        embedded_order=4,
        controller_order=5,
        dense=dense,
        extensions={dense.name: dense},
        exact=None,
        implicit=square(own.G),
    )


_THESIS = "Macdonald 2001, appendix C"
_ALL = (
    _rational("fe", 1, "explicit Euler method; HNW, I.7", ("",), "1", "0"),
    _rational("trap", 2, f"explicit trapezoidal rule; {_THESIS}", ("", "1"), "1/2 1/2", "0 1"),
    _rational("heun", 2, f"explicit midpoint rule; {_THESIS}", ("", "1/2"), "0 1", "0 1/2"),
    _rational(
        "tvd32",
        3,
        f"C.-W. Shu, S. Osher, J. Comput. Phys. 77 (1988) 439; pair: {_THESIS}",
        ("", "1", "1/4 1/4"),
        "1/6 1/6 2/3",
        "0 1 1/2",
        pair=("1/2 1/2 0 0", 2, 3),
    ),
    _rational(
        "erk4",
        4,
        "the classical Runge-Kutta method; HNW, table II.1.2",
        ("", "1/2", "0 1/2", "0 0 1"),
        "1/6 1/3 1/3 1/6",
        "0 1/2 1/2 1",
    ),
    _dopr54(),
    _dop853(),
    _rodas5p(),
    replace(_dop853(), name="auto", stiff=_rodas5p()),
)

TABLEAUS: Mapping[str, ButcherTableau] = MappingProxyType({t.name: t for t in _ALL})
"""Every scheme by name, read-only: fe, trap, heun, tvd32, erk4, dopr54, dop853, the linearly
implicit rodas5p, and auto, which is dop853 and, where the problem is stiff, rodas5p.

The names are the thesis': its heun is the explicit midpoint rule, c = (0, 1/2), b = (0, 1), and its
trap, c = (0, 1), b = (1/2, 1/2), is what is often called Heun's method elsewhere.
"""


def _reduced(tableau: ButcherTableau) -> tuple[Any, ...]:
    """A scheme of the package by its name: a copy, also in another process, is the scheme itself,
    by which saved runs know it."""
    if TABLEAUS.get(tableau.name) is tableau:
        return get_tableau, (tableau.name,)
    return tableau.__reduce__()


copyreg.pickle(ButcherTableau, _reduced)
