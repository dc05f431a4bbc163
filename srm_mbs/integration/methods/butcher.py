r"""Runge-Kutta schemes, explicit and linearly implicit: validated, read-only data with their
extensions.

A step of an s-stage scheme forms the rates K_0 ... K_{s-1} and the end state

    x_{n+1} = x_n (+) h sum_i b_i K_i,    K_i = f(t_n + c_i h, x_n (+) h sum_{j<i} a_ij K_j),

and evaluates K_s, the rate at the end state, which is the first stage of the next step.  Tableaus
are stored without that repeated stage, so that a step of an explicit scheme costs ``n_stages``
evaluations.

In a linearly implicit (Rosenbrock) scheme, with J = df/dx and f_t = df/dt at the start of the step,

    K_i = f(t_n + c_i h, x_n (+) h sum_{j<i} a_ij K_j) + h J sum_{j<=i} g_ij K_j
          + h (sum_j g_ij) f_t,

g_ii = gamma (E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, 2nd edition,
Springer 1996, IV.7).  Its first stages have no weight: they are the rate at the start of the step,
so that K_0 is the same in every scheme.

The schemes themselves are in :mod:`srm_mbs.integration.methods.tableaus`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from fractions import Fraction
from itertools import pairwise
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.model.lazy import cached_property

ExactRow = tuple[Fraction, ...]
ExactMatrix = tuple[ExactRow, ...]

_ROUNDING = 1e-13
"""Sums of coefficients agree up to rounding; a wrong digit in the data is far above this."""
SAME_STAGE = 1e-9
"""Distance of two stages, over the step, below which they are at the same time."""


@dataclass(frozen=True, eq=False)
class _Record:
    """Pickles and copies by construction, so that copies are read-only and validated as well."""

    def __reduce__(self) -> tuple[Any, ...]:
        values = (getattr(self, each.name) for each in fields(self))
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
        "hermite", "C1", "thesis" or "dop853" in the tableaus of this package.
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


Number = TypeVar("Number", Fraction, float)


def hermite(b: tuple[Number, ...], n_extra: int = 0) -> tuple[tuple[Number, ...], ...]:
    """F_0, F_1, F_2 (s + 1 + n_extra,) of the cubic through both end states and both end rates
    (HNW, II.6), for the weights ``b`` (s,)."""
    weights = list(b)
    weights += [b[0] - b[0]] * (1 + n_extra)
    outer = [(w, i == 0, i == len(b)) for i, w in enumerate(weights)]
    return (
        tuple(weights),
        tuple(first - w for w, first, _ in outer),
        tuple(2 * w - first - last for w, first, last in outer),
    )


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
    """A Runge-Kutta scheme, explicit or linearly implicit.

    Attributes
    ----------
    name
        Key in :data:`srm_mbs.integration.methods.tableaus.TABLEAUS`.
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
        The default continuous extension; by default the cubic Hermite polynomial, of order 3.
    extensions
        All continuous extensions by name; by default that one.
    exact
        The same data in fractions; None if the scheme is not rational.
    implicit : (s, s) or None
        The g_ij of a linearly implicit scheme, lower triangular; None for explicit ones.
    stable_to
        h |lambda| up to which steps of an explicit scheme do not count as stiff, at most the bound
        of its stability; None where it is not tested.
    stiff
        The scheme that takes over where the problem is stiff; None without one.

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
    error: FloatArray | None = None
    embedded_order: int | None = None
    controller_order: int | None = None
    dense: DenseExtension = None  # type: ignore[assignment]  # one is made
    extensions: Mapping[str, DenseExtension] = field(default_factory=dict)
    exact: ExactTableau | None = None
    implicit: FloatArray | None = None
    stable_to: float | None = None
    stiff: ButcherTableau | None = None

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
        if self.dense is None:
            rows, none = np.array(hermite(tuple(self.b.tolist()))), np.zeros(0)
            cubic = DenseExtension(
                "hermite", min(self.order, 3), 1, rows, none.reshape(0, s + 1), none
            )
            object.__setattr__(self, "dense", cubic)
        if not isinstance(self.dense, DenseExtension):
            raise ValueError(f"{owner}: dense is {self.dense!r}, not a DenseExtension")
        extensions = dict(self.extensions) or {self.dense.name: self.dense}
        object.__setattr__(self, "extensions", MappingProxyType(extensions))
        if self.extensions.get(self.dense.name) is not self.dense:
            raise ValueError(f"{owner}: dense ({self.dense.name!r}) is not one of its extensions")
        for name, extension in self.extensions.items():
            self._check_extension(extension, f"{owner}: extension {name!r}")
        if self.implicit is not None:
            _freeze(self, owner, implicit=(s, s))
            self._check_implicit(self.implicit, owner)
        else:
            self._check_orders(owner)
        if self.stiff is not None and self.stiff.n_stages != s:
            raise ValueError(f"{owner}: {self.stiff.name!r} has another number of stages")

    def _check_orders(self, owner: str) -> None:
        """Refuse an order of an explicit scheme that not even the integral of a function of time
        has; the other conditions, those on A, are left to tests."""
        step = np.ones(1)
        _check_quadrature(self.b[None], self.c, self.order, step, f"{owner}: order of b")
        if self.error is not None and self.embedded_order is not None:
            what, weights = f"{owner}: embedded_order", self.error[None]
            _check_quadrature(weights, self.abscissae, self.embedded_order, 0.0 * step, what)
        for name, extension in self.extensions.items():
            theta = np.linspace(0.0, 1.0, len(extension.rows) + 1)
            nodes = np.concatenate([self.abscissae, extension.extra_c])
            what = f"{owner}: order of extension {name!r}"
            _check_quadrature(extension.weights(theta), nodes, extension.order, theta, what)

    def _check_implicit(self, implicit: FloatArray, owner: str) -> None:
        lead = self.lead
        diagonal = np.diagonal(implicit)
        if np.triu(implicit, 1).any() or implicit[:, :lead].any() or implicit[:lead].any():
            raise ValueError(f"{owner}: implicit is not that of the stages after the first")
        if not (lead < self.n_stages and diagonal[lead] > 0.0) or np.ptp(diagonal[lead:]) > 0.0:
            raise ValueError(f"{owner}: the diagonal of implicit is not one positive number")
        if self.A[:, :lead].any() or self.b[:lead].any() or self.c[: lead + 1].any():
            raise ValueError(f"{owner}: its first stages are not the rate at the start")

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
        """Number of stages s, those without weight included."""
        return int(self.b.shape[0])

    @cached_property
    def lead(self) -> int:
        """Index of the last stage that takes the rate at the start of the step: 0 in explicit
        schemes, in linearly implicit ones that of the first with a weight."""
        if self.implicit is None:
            return 0
        return int(np.argmax(np.diagonal(self.implicit) != 0.0))

    def member(self, stiff: bool) -> ButcherTableau:
        """The scheme of a step: ``stiff`` if there is one for stiff problems, else this one."""
        return self.stiff if stiff and self.stiff is not None else self

    @cached_property
    def abscissae(self) -> FloatArray:
        """Abscissae (s + 1,) of the stages and of the end."""
        return np.append(self.c, 1.0)

    @cached_property
    def distinct(self) -> IndexArray:
        """Places in ``abscissae`` of those after 0 in order of time, each time once."""
        order = np.argsort(self.abscissae, kind="stable")
        return order[np.diff(self.abscissae[order], prepend=0.0) > SAME_STAGE]

    @cached_property
    def gaps(self) -> tuple[tuple[float, float], ...]:
        """(centre, half width) of the gaps between 0, the abscissae and 1, the widest first."""
        nodes = sorted({0.0, 1.0, *(x for x in self.c.tolist() if 0.0 < x < 1.0)})
        gaps = [((a + b) / 2, (b - a) / 2) for a, b in pairwise(nodes)]
        return tuple(sorted(gaps, key=lambda gap: -gap[1]))

    @cached_property
    def middle(self) -> tuple[int, float]:
        """Index and abscissa > 0 of the stage nearest to the middle of the step; the end (s, 1)
        where none lies inside."""
        inside = [(i, c) for i, c in enumerate(self.c.tolist()) if 0.0 < c < 1.0]
        return min(inside, key=lambda node: abs(node[1] - 0.5), default=(self.n_stages, 1.0))


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


def _check_quadrature(
    rows: FloatArray, nodes: FloatArray, order: int, ends: FloatArray, what: str
) -> None:
    """Refuse weights, one row for each of the ``ends``, that do not integrate the powers below
    ``order`` from 0 to there."""
    exponents = np.arange(order)
    powers, exact = nodes[:, None] ** exponents, ends[:, None] ** (exponents + 1) / (exponents + 1)
    errors = np.abs(rows @ powers - exact)
    wrong = (errors > _ROUNDING * (1.0 + np.abs(rows) @ np.abs(powers))).any(axis=0)
    for k in np.flatnonzero(wrong):
        raise ValueError(
            f"{what} is {order}, but t^{k} is integrated with an error of {errors[:, k].max():.1e}"
        )
