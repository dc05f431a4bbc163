"""Explicit Runge-Kutta schemes and their continuous extensions, as validated read-only data.

A step of an s-stage scheme forms the rates K_0 ... K_{s-1} and the end state

    x_{n+1} = x_n (+) h sum_i b_i K_i,    K_i = f(t_n + c_i h, x_n (+) h sum_{j<i} a_ij K_j),

and evaluates K_s, the rate at the end state, which is the first stage of the next step.  Tableaus
are stored without that repeated stage, so that a step costs ``n_stages`` evaluations.

Sources: C. B. Macdonald, *The Predicted Sequential Regularization Method for DAEs*, Acadia
University 2001, appendix C (with a_62 = -355/33 and a_64 = 49/176 of dopr54 corrected); E. Hairer,
S. P. Norsett, G. Wanner, *Solving Ordinary Differential Equations I*, 2nd edition, Springer 1993
(HNW below).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from srm_mbs.methods import dop853_data

FloatArray = NDArray[np.float64]
ExactRow = tuple[Fraction, ...]
ExactMatrix = tuple[ExactRow, ...]

_ROUNDING = 1e-13
"""Sums of coefficients agree up to rounding; a wrong digit in the data is far above this."""


@dataclass(frozen=True, eq=False)
class _Record:
    """Pickles and copies by construction, so that copies are read-only and validated as well."""

    def __reduce__(self) -> tuple[Any, ...]:
        values = (getattr(self, field.name) for field in fields(self))
        return type(self), tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in values)


@dataclass(frozen=True, eq=False)
class DenseExtension(_Record):
    """Continuous extension x(t_n + theta h) = x_n (+) h sum_i w_i(theta) K_i of a scheme.

    The weights run over the s stages, the end-point rate K_s and e extra stages (``n_rates`` in
    all) and are kept in the nested form of dopri5.f and dop853.f,

        w(theta) = theta (F_0 + (1 - theta) (F_1 + theta (F_2 + (1 - theta) (F_3 + ...)))),

    which loses nothing to cancellation and ends exactly at F_0 = (b, 0).

    Attributes
    ----------
    name
        "hermite", "C1", "thesis" or "dop853" in the tableaus of this module.
    order
        Order of accuracy at every theta.
    continuity
        1 if the derivative is K_0 at the start and K_s at the end of the step, otherwise 0.
    rows : (degree, n_rates)
        The nested coefficients F_0, F_1, ...
    extra_A : (e, n_rates)
        Row i weighs the rates before extra stage i, which is rate s + 1 + i.
    extra_c : (e,)
        Abscissae of the extra stages.
    """

    name: str
    order: int
    continuity: int
    rows: FloatArray
    extra_A: FloatArray
    extra_c: FloatArray

    def __post_init__(self) -> None:
        owner = f"extension {self.name!r}"
        _freeze(self, owner, rows=(-1, -1), extra_c=(-1,))
        _freeze(self, owner, extra_A=(self.n_extra, self.n_rates))
        if len(self.rows) == 0 or self.n_rates < self.n_extra + 2:
            raise ValueError(f"{owner}: rows have shape {self.rows.shape}, without any stage")
        if self.continuity not in (0, 1):
            raise ValueError(f"{owner}: continuity is {self.continuity!r}, not 0 or 1")
        if np.triu(self.extra_A, self.n_rates - self.n_extra).any():
            raise ValueError(f"{owner}: an extra stage uses its own or a later rate")
        _check_sums(self.extra_A, self.extra_c, f"{owner}: row sum of extra_A")
        # The weights add up to theta, so that constant rates are integrated exactly.
        _check_sums(self.rows, np.eye(len(self.rows))[0], f"{owner}: row sum of rows")

    @property
    def n_rates(self) -> int:
        """Number of rates weighed: s + 1 + e."""
        return int(self.rows.shape[1])

    @property
    def n_extra(self) -> int:
        """Number e of extra stages, needed only when dense output is read."""
        return int(self.extra_c.shape[0])

    def weights(self, theta: ArrayLike) -> FloatArray:
        """w (k, n_rates) at theta, a scalar (k = 1) or (k,): the fraction of the step."""
        return self._evaluate(theta)[0]

    def derivative_weights(self, theta: ArrayLike) -> FloatArray:
        """dw / dtheta (k, n_rates) at theta, a scalar (k = 1) or (k,)."""
        return self._evaluate(theta)[1]

    def _evaluate(self, theta: ArrayLike) -> tuple[FloatArray, FloatArray]:
        points = np.atleast_1d(np.asarray(theta, dtype=np.float64))
        if points.ndim != 1:
            raise ValueError(f"theta has shape {points.shape}; a scalar or (k,) is needed")
        column = points[:, None]
        value = slope = np.zeros((points.size, self.n_rates))
        for k in reversed(range(len(self.rows))):
            factor, sign = (1.0 - column, -1.0) if k % 2 else (column, 1.0)
            value = value + self.rows[k]
            slope = factor * slope + sign * value
            value = factor * value
        return value, slope


@dataclass(frozen=True, eq=False)
class ExactTableau(_Record):
    """The data of a rational tableau in fractions.

    Attributes
    ----------
    A : (s, s)
    b, c : (s,)
    bhat : (s + 1,) or None
        Embedded weights over the stages and the end-point rate.
    extensions
        name -> (degree, s + 1), the nested coefficients of :class:`DenseExtension`.
    """

    A: ExactMatrix
    b: ExactRow
    c: ExactRow
    bhat: ExactRow | None
    extensions: Mapping[str, ExactMatrix]

    def __post_init__(self) -> None:
        object.__setattr__(self, "extensions", MappingProxyType(dict(self.extensions)))


@dataclass(frozen=True, eq=False)
class ButcherTableau(_Record):
    """An explicit Runge-Kutta scheme.

    Attributes
    ----------
    name
        Key in :data:`TABLEAUS`.
    order
        Order of accuracy of b.
    citation
        What the scheme is and where its coefficients come from.
    A : (s, s)
        Strictly lower triangular.
    b, c : (s,)
        Weights; abscissae, the row sums of A.
    error : (s + 1,) or None
        Weights of the local error estimate over K_0 ... K_s: b - bhat.
    embedded_order, controller_order
        Order of bhat; k of the exponents 1/k of step-size control.  None without embedded pair.
    dense
        The default continuous extension.
    extensions
        All continuous extensions by name.
    exact
        The same data in fractions; None if the scheme is not rational.

    Raises
    ------
    ValueError
        If the data contradict each other; says which tableau and what is wrong.
    """

    name: str
    order: int
    citation: str
    A: FloatArray
    b: FloatArray
    c: FloatArray
    error: FloatArray | None
    embedded_order: int | None
    controller_order: int | None
    dense: DenseExtension
    extensions: Mapping[str, DenseExtension]
    exact: ExactTableau | None

    def __post_init__(self) -> None:
        owner = f"tableau {self.name!r}"
        _freeze(self, owner, b=(-1,))
        s = self.n_stages
        _freeze(self, owner, A=(s, s), c=(s,))
        if np.triu(self.A).any():
            raise ValueError(f"{owner}: A is not strictly lower triangular, so not explicit")
        _check_sums(self.A, self.c, f"{owner}: row sum of A")
        _check_sums(self.b[None, :], np.ones(1), f"{owner}: sum of b")
        orders = (self.embedded_order, self.controller_order)
        if any((order is None) != (self.error is None) for order in orders):
            raise ValueError(f"{owner}: error, embedded_order and controller_order go together")
        if self.error is not None:
            _freeze(self, owner, error=(s + 1,))
            _check_sums(self.error[None, :], np.zeros(1), f"{owner}: sum of error")
        object.__setattr__(self, "extensions", MappingProxyType(dict(self.extensions)))
        if self.extensions.get(self.dense.name) is not self.dense:
            raise ValueError(f"{owner}: dense ({self.dense.name!r}) is not one of its extensions")
        for name, extension in self.extensions.items():
            self._check_extension(extension, f"{owner}: extension {name!r}")

    def _check_extension(self, extension: DenseExtension, what: str) -> None:
        s, width, end = self.n_stages, extension.n_rates, extension.rows[0]
        if width != s + 1 + extension.n_extra:
            raise ValueError(f"{what} weighs {width} rates, not {s + 1 + extension.n_extra}")
        if not np.array_equal(end[:s], self.b) or end[s:].any():
            raise ValueError(f"{what} does not end at the end state: its first row is not (b, 0)")
        slopes = extension.derivative_weights((0.0, 1.0))
        if extension.continuity == 1 and not np.allclose(
            slopes, np.eye(width)[[0, s]], rtol=0.0, atol=_ROUNDING
        ):
            raise ValueError(f"{what} is not C1: its end slopes are not K_0 and K_{s}")

    @property
    def n_stages(self) -> int:
        """Number of stages s, also the evaluations per step."""
        return int(self.b.shape[0])

    @cached_property
    def gaps(self) -> tuple[tuple[float, float], ...]:
        """(centre, half width) of the gaps between 0, the abscissae and 1, the widest first."""
        nodes = sorted({0.0, 1.0, *(x for x in self.c.tolist() if 0.0 < x < 1.0)})
        gaps = [((a + b) / 2, (b - a) / 2) for a, b in pairwise(nodes)]
        return tuple(sorted(gaps, key=lambda gap: -gap[1]))


def get_tableau(name: str | ButcherTableau) -> ButcherTableau:
    """The tableau of that name; a :class:`ButcherTableau` is returned as it is.

    Raises
    ------
    ValueError
        For an unknown name; lists the known ones.
    """
    if isinstance(name, ButcherTableau):
        return name
    tableau = TABLEAUS.get(name) if isinstance(name, str) else None
    if tableau is None:
        raise ValueError(f"unknown tableau {name!r}; known are {', '.join(TABLEAUS)}")
    return tableau


def _freeze(record: _Record, owner: str, **shapes: tuple[int, ...]) -> None:
    """Replace fields by read-only copies; refuse other shapes (-1: any length), NaN, infinity."""
    for key, shape in shapes.items():
        try:
            array = np.array(getattr(record, key), dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{owner}: {key} is not an array of numbers") from error
        fits = (n in (m, -1) for m, n in zip(array.shape, shape, strict=False))
        if array.ndim != len(shape) or not all(fits):
            raise ValueError(f"{owner}: {key} has shape {array.shape} instead of {shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{owner}: {key} has an entry that is not finite")
        array.setflags(write=False)
        object.__setattr__(record, key, array)


def _check_sums(rows: FloatArray, expected: FloatArray, what: str) -> None:
    sums = rows.sum(axis=1)
    wrong = np.abs(sums - expected) > _ROUNDING * (1.0 + np.abs(rows).sum(axis=1))
    for i in np.flatnonzero(wrong):
        raise ValueError(f"{what} is {sums[i]:.17g} instead of {expected[i]:.17g} (row {i})")


def _fractions(text: str) -> ExactRow:
    return tuple(Fraction(word) for word in text.split())


def _padded(rows: Iterable[Sequence[Any]], width: int) -> FloatArray:
    return np.array([[*map(float, row), *[0.0] * (width - len(row))] for row in rows])


def _hermite(b: ExactRow, n_extra: int = 0) -> ExactMatrix:
    """F_0, F_1, F_2 of the cubic through both end states and both end rates (HNW, II.6)."""
    weights = (*b, *[Fraction(0)] * (1 + n_extra))
    outer = [(w, i == 0, i == len(b)) for i, w in enumerate(weights)]
    return (
        weights,
        tuple(first - w for w, first, _ in outer),
        tuple(2 * w - first - last for w, first, last in outer),
    )


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
) -> ButcherTableau:
    """Build a tableau from fractions in text.

    pair: bhat over the stages and the end-point rate, embedded_order, controller_order.
    extensions: name -> (order, continuity, rows), the default first; None for cubic Hermite.
    """
    weights = _fractions(b)
    s = len(weights)
    zero = Fraction(0)
    if extensions is None:
        extensions = {"hermite": (min(order, 3), 1, _hermite(weights))}
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
            "C1": (4, 1, (*_hermite(_fractions(b)), d)),
            "thesis": (4, 0, tuple(zip(*columns, strict=True))),
        },
    )


def _dop853() -> ButcherTableau:
    s, n_extra = len(dop853_data.B), len(dop853_data.EXTRA_C)
    n_rates = s + 1 + n_extra
    hermite = _hermite(tuple(map(Fraction, dop853_data.B)), n_extra)
    dense = DenseExtension(
        name="dop853",
        order=7,
        continuity=1,
        rows=_padded((*hermite, *dop853_data.D), n_rates),
        extra_A=_padded(dop853_data.EXTRA_A, n_rates),
        extra_c=np.array(dop853_data.EXTRA_C),
    )
    return ButcherTableau(
        name="dop853",
        order=8,
        citation="DOP853, Dormand and Prince 8(5, 3) without the third-order estimate: HNW, "
        "sections II.5 and II.6, and dop853.f",
        A=_padded(dop853_data.A, s),
        b=np.array(dop853_data.B),
        c=np.array(dop853_data.C),
        error=np.array([*dop853_data.E5, 0.0]),
        embedded_order=5,
        controller_order=8,
        dense=dense,
        extensions={dense.name: dense},
        exact=None,
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
)

TABLEAUS: Mapping[str, ButcherTableau] = MappingProxyType({t.name: t for t in _ALL})
"""Every scheme by name, read-only: fe, trap, heun, tvd32, erk4, dopr54, dop853.

The names are the thesis': its heun is the explicit midpoint rule, c = (0, 1/2), b = (0, 1), and its
trap, c = (0, 1), b = (1/2, 1/2), is what is often called Heun's method elsewhere.
"""
