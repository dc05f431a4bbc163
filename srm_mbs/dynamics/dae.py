r"""A semi-explicit DAE of index 2 as a system.

    x' = f(t, x) - B(t, x) y,    0 = g(t, x),    yhat = B y = E (G f + g_t),    E = B (GB)^-1.

:class:`ObliqueProjection` is the algebra at one point.  With the column-pivoted QR of the scaled
G^T = Q_G R_G and B = Q_B R_B, and C = Q_G^T Q_B,

    E r = Q_B C^-1 R_G^-T r,    P w = Q_B C^-1 Q_G^T w,

so that the division is by the cosines of the angles in C only, where rows of G, or columns of B,
become dependent: P stays bounded there (thesis, (2.4)), unlike products with (GB)^-1.  Angles and
sizes are those in z = x/s with scales s, where the states of a problem have the same size.

:class:`DaeTerms` has the quantities of one evaluated point.  One sweep of the SRM is
y_s = y_{s-1} + T g/eps, x_s' = f - B y_s, (2.2) of the thesis with T = I or (GB)^T; and for
T = (GB)^-1 the form (2.4), which carries yhat = B y instead of y,

    yhat_s = P yhat_{s-1} + E g/eps,    P = E G,

and passes isolated singularities of G B, where P and yhat stay bounded and y need not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.projection import PIVOT_ZERO, pivoted_qr, q_columns, whiten
from srm_mbs.dynamics.system import Zone
from srm_mbs.errors import CallbackError, EvaluationError, InputError, raised, time_text
from srm_mbs.model.dae import SemiExplicitDAE
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import all_finite, real_array

LARGEST_PIVOT = 1e150
"""Largest norm of a row of G or a column of B, over the typical one: squares of larger ones
overflow."""


class ObliqueProjection:
    """Factorisation of G and B at one point; reused.

    Parameters
    ----------
    scale : (nx,)
        Scales s of the states: G s and B/s are factorised.
    rows : (ny,), columns : (ny,)
        Typical norms of the rows of G s and the columns of B/s.
    reference
        Three typical ``sizes``; 1 if not known.

    Attributes
    ----------
    factorisations
        How many factorisations were done.
    sizes
        The smallest singular value of the scaled G^T, that of the scaled B, and the smallest
        cosine in C.  Of up to two rows, the last pivot takes the place of the singular value.
    sigma
        The smallest of these three numbers over its reference.
    rank, rank_deficient
        Number of directions in use, and whether it is less than ny.
    """

    def __init__(
        self,
        scale: FloatArray,
        rows: FloatArray,
        columns: FloatArray,
        reference: Sequence[float] = (1.0, 1.0, 1.0),
    ) -> None:
        self.scale, self.rows, self.columns, self.reference = scale, rows, columns, reference
        # Scales are powers of 2, by which nothing is rounded.
        self._G_units, self._B_units = rows[:, None] / scale, scale[:, None] * columns
        self._upper = np.tri(len(rows)).T
        self.factorisations = 0

    def _sizes(self, packed: FloatArray, pivots: FloatArray) -> FloatArray:
        """Sizes (ny,) of the directions of a matrix from its :func:`pivoted_qr`, falling:
        continuous functions of the matrix, as the last of more than two ``pivots`` is not, which
        jumps where others change places."""
        if len(pivots) <= 2:
            return pivots
        R = packed[: len(pivots)] * self._upper
        return lapack.dgesdd(R, compute_uv=0)[1]  # type: ignore[no-any-return]

    def factor(self, G: FloatArray, B: FloatArray, threshold: float | None) -> None:
        """Factorise G (ny, nx) and B (nx, ny), which are finite.

        ``threshold`` drops the directions in which G or B is below ``threshold`` times its
        reference (the zone); ``None`` uses all.

        Raises
        ------
        EvaluationError
            If one of them is so large that its squares overflow, or if G B is singular though
            neither G nor B loses rank.
        """
        self.factorisations += 1
        packed, order, tau, pivots = pivoted_qr((G / self._G_units).T)
        packed_b, _, tau_b, pivots_b = pivoted_qr(B / self._B_units)
        if not pivots[0] + pivots_b[0] < LARGEST_PIVOT:
            raise EvaluationError("G or B grows beyond all numbers")
        g_sizes, b_sizes = self._sizes(packed, pivots), self._sizes(packed_b, pivots_b)
        floor = PIVOT_ZERO if threshold is None else max(PIVOT_ZERO, threshold)
        usual_g, usual_b, usual_cosine = self.reference
        g_floor, b_floor = floor * usual_g, floor * usual_b
        rank = len(G)
        while rank and not (g_sizes[rank - 1] > g_floor and b_sizes[rank - 1] > b_floor):
            rank -= 1
        self.rank, self.rank_deficient = rank, rank < len(G)
        self.order = order[:rank]
        self.R = packed[:rank, :rank]
        self.Q_G = q_columns(packed, tau, rank)
        self.Q_B = q_columns(packed_b, tau_b, rank)
        angles = self.Q_G.T.dot(self.Q_B)
        cosine = 1.0
        if rank == 1:
            cosine = abs(float(angles[0, 0]))
        elif rank:
            left, cosines, right, _ = lapack.dgesdd(angles)
            cosine = float(cosines[-1])
        if cosine < PIVOT_ZERO:
            raise EvaluationError(
                "G B is singular though neither G nor B loses rank: x' does not stay bounded there"
            )
        # Where no direction is in use, the matrices have no elements.
        self.inverse: FloatArray = 1.0 / angles if rank < 2 else (right.T / cosines) @ left.T
        g_size, b_size = float(g_sizes[-1]), float(b_sizes[-1])
        self.sizes = (g_size, b_size, cosine)
        self.sigma = min(g_size / usual_g, b_size / usual_b, cosine / usual_cosine)

    def lift(self, residual: FloatArray) -> FloatArray:
        """E r (nx,) for ``residual`` r (ny,): B (GB)^-1 r."""
        if self.rank == 0:
            return np.zeros(self.Q_B.shape[0])
        scaled = (residual / self.rows).take(self.order)
        lifted: FloatArray = self.Q_B.dot(self.inverse.dot(whiten(self.R, scaled)))
        return self.scale * lifted

    def project(self, w: FloatArray) -> FloatArray:
        """P w (nx,)."""
        projected: FloatArray = self.Q_B.dot(self.inverse.dot(self.Q_G.T.dot(w / self.scale)))
        return self.scale * projected


class DaeTerms:
    """Terms of one evaluated point, with ``predicted``, the yhat (nx,) of the zone."""

    held = False

    def __init__(
        self,
        system: DaeSystem,
        t: float,
        x: FloatArray,
        functions: tuple[FloatArray, FloatArray, FloatArray],
        predicted: FloatArray | None,
    ) -> None:
        self._system = system
        self._p = system.projection
        self.t, self.x, self.predicted = t, x, predicted
        self.f, self.B, self.G = functions

    @property
    def sigma(self) -> float:
        return self._p.sigma

    @property
    def rank(self) -> int:
        return self._p.rank

    @property
    def rank_deficient(self) -> bool:
        return self._p.rank_deficient

    def normals(self) -> FloatArray:
        return np.zeros((len(self.x), 0))

    @cached_property
    def _residual(self) -> FloatArray:
        return self._system.call("g", self.t, self.x)

    def _gamma(self) -> FloatArray:
        along_f: FloatArray = self.G.dot(self.f)
        return along_f + self._system.time_derivative(self.t, self.x)

    def _completed(self, strong: FloatArray) -> FloatArray:
        """The strong part of yhat plus (1 - P_s) yhat_pred."""
        if self.predicted is None:
            return strong
        return strong + self.predicted - self._p.project(self.predicted)

    def rate(self) -> FloatArray:
        return self.f - self.multiplier()

    def multiplier(self) -> FloatArray:
        return self._completed(self._p.lift(self._gamma()))

    def prediction(self) -> FloatArray:
        if self._system.carries_yhat:
            return self.multiplier()
        if not self.rank_deficient:
            y = np.linalg.solve(self.G @ self.B, self._gamma())
            return y.astype(np.float64, copy=False)
        return self._system.factor_of(self.multiplier(), self.B)

    def project(self, w: FloatArray) -> FloatArray:
        return self._p.project(w)

    def constraint_residual(self) -> float:
        return 0.0

    def correction(self) -> FloatArray:
        return self._p.lift(self._residual)

    def sweep(self, previous: FloatArray, eps: float) -> tuple[FloatArray, FloatArray]:
        g = self._residual
        if self._system.carries_yhat:
            yhat = self._completed(self._p.project(previous) + self._p.lift(g) / eps)
            return self.f - yhat, yhat
        with np.errstate(over="ignore", invalid="ignore"):  # of sweeps that are unstable
            scaled = g if self._system.T == "identity" else (self.G @ self.B).T @ g
            y = previous + scaled / eps
            rate = self.f - self.B @ y
        if not (np.isfinite(rate).all() and np.isfinite(y).all()):
            raise EvaluationError("the multiplier of a sweep grows beyond all numbers")
        return rate, y


PROBES = 24
"""Points around the start at which the typical sizes of G and B are measured."""
PROBE_DISTANCE = 0.1
"""Their distance, in the units of the states."""
OTHER_SIZE = 10.0
"""Factor by which the largest unit of the states changes until they are measured again."""
DEPENDENT = 1e-10
"""Smallest singular value of rows that count as independent."""
DEPENDENT_SHARE = 0.01
"""Smallest factor in their relation, of a norm of 1, of those that a message names."""
DIFFERENCE = 1e-6
"""Step of the finite differences that check G and g_t, relative to |x|, or to the smallest unit of
the states, and to the run."""
FINER = tuple(10.0**-k for k in range(9))
"""Lengths of that step, over the usual one, until the differences settle: x may be of a smaller
size than its unit, and g vary faster than the run is long."""
SIDES = ((1, -1), (1, 0), (0, -1))
"""Ends of the differences, in steps: at a kink a derivative is that on one of its sides."""
SETTLED = 0.1
"""They have where their change is that much smaller than their distance from what is given."""
JACOBIAN_REMEDY = "Return the derivative of g with respect to x from G"
TIME_DERIVATIVE_REMEDY = "Return the partial derivative of g with respect to t from g_t"
WRONG_DERIVATIVE = 1e-3
"""Relative difference from which a derivative is called wrong."""


def _dependent(rows: FloatArray) -> list[int]:
    """Numbers of the ``rows`` (ny, nx) of norms of about 1 that depend on each other."""
    left, sizes, _ = np.linalg.svd(rows)
    shares = np.abs(left[:, sizes < DEPENDENT]).max(axis=1, initial=0.0)
    numbers: list[int] = np.flatnonzero(shares > DEPENDENT_SHARE).tolist()
    return numbers


def _differs(given: FloatArray, slope: FloatArray, least: FloatArray) -> NDArray[np.bool_]:
    """Which derivatives ``given`` are not the ``slope``, over that or ``least``."""
    wrong: NDArray[np.bool_] = np.abs(slope - given) > WRONG_DERIVATIVE * np.maximum(
        least, np.abs(slope)
    )
    return wrong


def _other_slope(
    slope_over: Callable[[float, tuple[int, int]], FloatArray],
    given: FloatArray,
    least: FloatArray,
    differences: Sequence[tuple[int, int]] = SIDES,
) -> FloatArray | None:
    """Where differences settle, if none of them does at the ``given`` derivatives; None also where
    the function ends, and there is nothing to compare with."""
    others = []
    for ends in differences:
        others.append(_settled(lambda finer: slope_over(finer, ends), given, least))  # noqa: B023
        if others[-1] is None:
            return None
    return others[0]


def _settled(
    slope_over: Callable[[float], FloatArray], given: FloatArray, least: FloatArray
) -> FloatArray | None:
    """Where differences of one kind settle; see :func:`_other_slope`."""
    last: FloatArray | None = None
    for finer in FINER:
        try:
            slope = slope_over(finer)
        except (CallbackError, EvaluationError):
            return None
        if last is not None and ((slope == 0.0) & (last != 0.0)).any():
            return last  # rounding takes all of the difference
        wrong = _differs(given, slope, least)
        if not wrong.any():
            return None
        if last is not None:
            settled = np.abs(slope - last) < SETTLED * np.abs(slope - given)
            if (wrong & settled).any():
                return slope
        last = slope
    return last


def _units(sizes: FloatArray, largest: float, one: FloatArray, greatest: float) -> FloatArray:
    """Sizes (nx,) of the states: |x|, given as ``sizes``, or what the tolerance is absolute to,
    ``one``, between 1 and the ``largest`` state, now or since the start (``greatest``); 1 at the
    origin, where the states tell nothing.

    A circle of a radius far below them counts as a point next to a singular one.
    """
    least = np.minimum(np.maximum(one, min(1.0, largest or 1.0)), max(1.0, greatest))
    return np.maximum(sizes, least)


class DaeSystem:
    """A :class:`~srm_mbs.model.dae.SemiExplicitDAE` as a :class:`~srm_mbs.dynamics.system.System`.

    Parameters
    ----------
    problem
        The equations.
    t0, x0
        Start of the run; x0 (nx,).
    t_end
        End of the run.
    one
        atol / rtol (nx,): sizes of the states below which the tolerance is absolute.
    T
        ``"identity"``, ``"transpose"`` or ``"inverse"``: the factor of g in the sweeps.

    Raises
    ------
    InputError
        If a function fails at the start, shapes do not fit, G or g_t is not the derivative of g,
        or G B is singular everywhere.
    """

    has_constraints = True
    time_unit = ""
    sigma_scatters = False
    time_dependent = True
    laws = np.zeros(0)
    singularities = None
    branch_system = None

    def __init__(
        self,
        problem: SemiExplicitDAE,
        t0: float,
        x0: FloatArray,
        t_end: float,
        one: FloatArray,
        T: str = "identity",
    ) -> None:
        self.problem = problem
        self.T = T
        self.evaluations = 0
        self.nx = len(x0)
        # Powers of 2, by which nothing is rounded; 1 if atol is the same for all states.
        self._scale = np.exp2(np.round(np.log2(one / one.max())))
        self._one = one / self._scale
        sizes = np.abs(x0 / self._scale)
        self._greatest = float(sizes.max())
        self._unit = _units(sizes, self._greatest, self._one, self._greatest)
        self.ny = self._count_rows(t0, x0)
        self.shapes = {
            "f": (self.nx,),
            "B": (self.nx, self.ny),
            "g": (self.ny,),
            "G": (self.ny, self.nx),
            "g_t": (self.ny,),
        }
        self._accepted = {name: self._accepted_shapes(name) for name in self.shapes}
        self._nothing = np.zeros(self.ny)
        self.tangent_size = self.nx
        self.multiplier_part = slice(0, self.nx)
        self.carries_yhat = T == "inverse"
        self.wraps = False
        self.multiplier_size = self.nx if self.carries_yhat else self.ny
        self._check_values(t0, x0)
        self.projection = self._measured(t0, x0)
        wrong = self.wrong_jacobian(t0, x0)
        if wrong is not None:  # everything else would look right and be wrong
            raise InputError(f"at the start, {wrong}", element="G", remedy=JACOBIAN_REMEDY)
        self.predicts = self._time_derivative_known(t0, x0, t_end)

    @property
    def factorisations(self) -> int:
        """How often G and B were factorised."""
        return self.projection.factorisations

    # --- the user's functions -----------------------------------------------------------------

    def _accepted_shapes(self, name: str) -> tuple[tuple[int, ...], ...]:
        """Shapes that ``name`` may return: the one of the contract, shorter where ny = 1, and for a
        single value that of a number."""
        shape = self.shapes[name]
        if max(shape) == 1:
            return (shape, (1,), ())
        if self.ny > 1 or name == "f":
            return (shape,)
        return (shape, ()) if len(shape) == 1 else (shape, (self.nx,))

    def call(self, name: str, t: float, x: FloatArray) -> FloatArray:
        """The value of the user's function ``name`` in the shape of the contract.

        Raises
        ------
        CallbackError
            If it raises, or returns another shape.
        EvaluationError
            If it returns values that are not finite.
        """
        try:
            value = real_array(getattr(self.problem, name)(t, x.copy()))
        except Exception as error:
            raise CallbackError(raised(name, error, f"at t = {time_text(t)}")) from error
        shape = self.shapes[name]
        if value.shape != shape:
            if value.shape not in self._accepted[name]:
                raise CallbackError(
                    f"{name} returned shape {value.shape} at t = {time_text(t)}; "
                    f"it must return {shape}"
                )
            value = value.reshape(shape)
        if not all_finite(value):
            raise EvaluationError(
                f"{name} returned values that are not finite at t = {time_text(t)}"
            )
        return value

    def time_derivative(self, t: float, x: FloatArray) -> FloatArray:
        """g_t (ny,); 0 where none is given."""
        return self._nothing if self.problem.g_t is None else self.call("g_t", t, x)

    def _count_rows(self, t: float, x: FloatArray) -> int:
        try:
            value = real_array(self.problem.g(t, x.copy()))
        except Exception as error:
            raise InputError(
                raised("g", error, "at the start"),
                element="g",
                remedy="Give a function of (t, x) that returns (ny,) values",
            ) from error
        if value.ndim > 1 or not 1 <= value.size <= self.nx:
            raise InputError(
                f"g returns shape {value.shape} for {self.nx} states",
                element="g",
                remedy="Return (ny,) values with 1 <= ny <= nx",
            )
        return int(value.size)

    def _check_values(self, t: float, x: FloatArray) -> None:
        for name in self.shapes:
            if name == "g_t" and self.problem.g_t is None:
                continue
            try:
                self.call(name, t, x)
            except (CallbackError, EvaluationError) as error:
                raise InputError(
                    f"at the start, {error}",
                    element=name,
                    remedy=f"Give a function of (t, x) that returns {self.shapes[name]} numbers",
                ) from error

    def _measured(self, t: float, x: FloatArray) -> ObliqueProjection:
        """The projection, with the typical sizes of G and B around the start."""
        rng = np.random.default_rng(0)
        pairs = [(self.call("G", t, x), self.call("B", t, x))]
        for _ in range(PROBES):
            moves = self._scale * self._unit * rng.uniform(-1.0, 1.0, self.nx)
            probe = x + PROBE_DISTANCE * moves
            try:
                with np.errstate(all="ignore"):
                    pairs.append((self.call("G", t, probe), self.call("B", t, probe)))
            except (CallbackError, EvaluationError):
                continue  # outside the domain of the functions; the start itself counts
        scale = self._scale
        rows = np.sqrt(np.mean([np.sum((G * scale) ** 2, axis=1) for G, _ in pairs], axis=0))
        columns = np.sqrt(
            np.mean([np.sum((B / scale[:, None]) ** 2, axis=0) for _, B in pairs], axis=0)
        )
        for name, sizes, what in (("G", rows, "row"), ("B", columns, "column")):
            if not (sizes > 0.0).all():
                raise InputError(
                    f"{what} {int(np.argmin(sizes))} of {name} vanishes around the start",
                    element=name,
                    remedy="Give equations of index 2: G B regular",
                )
        measured = ObliqueProjection(scale, rows, columns)
        sizes_seen = []
        for G, B in pairs:
            try:
                measured.factor(G, B, None)
            except EvaluationError:
                continue
            if not measured.rank_deficient:
                sizes_seen.append(measured.sizes)
        if 2 * len(sizes_seen) < len(pairs):
            G, B = pairs[-1]
            for name, matrix, what, remedy in (
                ("G", G * scale / rows[:, None], "rows", "Leave out what follows from other rows"),
                ("B", (B / scale[:, None] / columns).T, "columns", "Give equations of index 2"),
            ):
                dependent = _dependent(matrix)
                if dependent:
                    raise InputError(
                        f"{what} {', '.join(map(str, dependent))} of {name} depend on each other "
                        "at the start and around it",
                        element=name,
                        remedy=remedy,
                    )
            raise InputError(
                "G B is singular at the start and around it",
                element="G",
                remedy="Give equations of index 2: G B regular but for isolated points",
            )
        return ObliqueProjection(scale, rows, columns, np.median(sizes_seen, axis=0).tolist())

    def rescale(self, t: float, state: FloatArray) -> bool:
        """Measure G and B again where the states have another size than before; see
        :class:`~srm_mbs.dynamics.system.System`.

        A solution that decays would come next to a singular point by its old size.
        """
        sizes, old = np.abs(state / self._scale), self._unit
        largest = float(sizes.max())
        self._greatest = max(self._greatest, largest)
        unit = _units(sizes, largest, self._one, self._greatest)
        if largest == 0.0 or 1.0 / OTHER_SIZE < unit.max() / old.max() < OTHER_SIZE:
            return False
        self._unit = unit
        try:
            measured = self._measured(t, state)
        except (CallbackError, EvaluationError, InputError):
            self._unit = old
            return False
        measured.factorisations += self.projection.factorisations
        self.projection = measured
        return True

    def wrong_jacobian(self, t: float, x: FloatArray) -> str | None:
        """Says where G at ``t`` and x (nx,) is not dg/dx; None if it is.

        Raises
        ------
        CallbackError, EvaluationError
            If G cannot be evaluated.
        """
        G, unit = self.call("G", t, x), float(self._unit.min())
        for i in range(self.nx):

            def slope_over(finer: float, sides: tuple[int, int], i: int = i) -> FloatArray:
                step = np.zeros(self.nx)
                step[i] = finer * DIFFERENCE * max(unit, abs(x[i]))
                ahead, behind = (self.call("g", t, x + side * step) for side in sides)
                return np.asarray((ahead - behind) / ((sides[0] - sides[1]) * step[i]))

            least = self.projection.rows / self._scale[i]
            slope = _other_slope(slope_over, G[:, i], least)
            if slope is not None:
                row = int(np.argmax(_differs(G[:, i], slope, least)))
                return (
                    f"G[{row}, {i}] is {G[row, i]:.6g}, but dg/dx is {slope[row]:.6g} by finite "
                    "differences"
                )
        return None

    def wrong_time_derivative(
        self, t: float, x: FloatArray, span: float, sides: Sequence[int] = (1,)
    ) -> str | None:
        """Says that g_t at ``t`` and x (nx,) is not dg/dt on any of the ``sides``; None if it is.

        Raises
        ------
        CallbackError, EvaluationError
            If g_t cannot be evaluated.
        """
        if self.problem.g_t is None:
            return None

        def slope_over(finer: float, ends: tuple[int, int]) -> FloatArray:
            dt = ends[0] * finer * DIFFERENCE * span
            g0, g1, g2 = (self.call("g", t + k * dt, x) for k in range(3))
            return np.asarray((4.0 * g1 - 3.0 * g0 - g2) / (2.0 * dt))

        given = self.call("g_t", t, x)
        least = self.projection.rows * self._unit.max() / span
        slope = _other_slope(slope_over, given, least, [(side, 0) for side in sides])
        if slope is None:
            return None
        return f"g_t is {given}, but dg/dt is {slope} by finite differences"

    def _time_derivative_known(self, t0: float, x: FloatArray, t_end: float) -> bool:
        """Whether g_t is given, or g does not depend on t."""
        span = t_end - t0
        if self.problem.g_t is None:
            here = self.call("g", t0, x)
            scale = self.projection.rows * self._unit.max()
            for fraction in (1e-3, 0.17, 0.61, 1.0):
                try:
                    moved = self.call("g", t0 + fraction * span, x) - here
                except (CallbackError, EvaluationError):
                    continue
                if (np.abs(moved) > 1e-12 * scale).any():
                    return False
            return True
        wrong = self.wrong_time_derivative(t0, x, span)
        if wrong is not None:
            raise InputError(f"at the start, {wrong}", element="g_t", remedy=TIME_DERIVATIVE_REMEDY)
        return True

    # --- the contract -------------------------------------------------------------------------

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> DaeTerms:
        """Factorise G and B at ``state``; see :class:`~srm_mbs.dynamics.system.System`."""
        self.evaluations += 1
        if not all_finite(state):
            raise EvaluationError("the state is not finite")
        f, B, G = self.call("f", t, state), self.call("B", t, state), self.call("G", t, state)
        self.projection.factor(G, B, None if zone is None else zone.threshold)
        predicted = None
        if self.projection.rank_deficient and zone is not None:
            predicted = zone.predict(t)
            if predicted is None:
                raise EvaluationError(
                    "the solution stays next to a singularity of G B for longer than its "
                    "multiplier can be predicted"
                )
        return DaeTerms(self, t, state, (f, B, G), predicted)

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """x + dx."""
        return state + delta

    def chart_rate(self, delta: FloatArray, rate: FloatArray) -> FloatArray:
        """``rate`` itself."""
        return rate

    def rate_change(self, delta: FloatArray) -> FloatArray:
        """0: no state is another one's rate."""
        return np.zeros_like(delta)

    friction_speed = np.inf

    @property
    def friction_sums(self) -> FloatArray:
        """None: a DAE has no friction."""
        return np.zeros((0, self.multiplier_part.start))

    def friction_tolerance(self, v: FloatArray) -> FloatArray:
        """Infinite: a DAE has no friction."""
        return np.full(self.nx, np.inf)

    def apply_laws(self, values: FloatArray | None) -> None:
        """Nothing: a DAE has no forces."""

    def derivatives(self, state: FloatArray, accelerations: FloatArray) -> None:
        """None: its functions are known at single points only."""

    def position_norm(self, delta: FloatArray) -> float:
        """max |dx| over the units; see :class:`~srm_mbs.dynamics.system.System`."""
        return float((np.abs(delta) / (self._scale * self._unit)).max())

    def position_rounding(self, state: FloatArray) -> float:
        """That of x; see :class:`~srm_mbs.dynamics.system.System`."""
        return self.position_norm(np.spacing(np.abs(state)))

    def reachable(self, start: FloatArray, end: FloatArray) -> bool:
        """True: there is one chart."""
        return True

    def difference(
        self, start: FloatArray, end: FloatArray, near: FloatArray | None = None
    ) -> FloatArray:
        """end - start; see :class:`~srm_mbs.dynamics.system.System`."""
        return end - start

    def state_scale(self, state: FloatArray) -> FloatArray:
        """|x|."""
        return np.abs(state)

    def constraint_residual(self, t: float, state: FloatArray) -> float:
        """max |g| over the typical row of G and the size of x: a relative error of x."""
        g = self.call("g", t, state)
        return float(np.max(np.abs(g) / self.projection.rows)) / max(
            min(1.0, float(self._unit.max())), float(np.abs(state / self._scale).max())
        )

    def damping(self, t: float, state: FloatArray) -> NDArray[np.complex128]:
        """Eigenvalues (ny,) of G B T: the rates at which sweeps reduce g, times eps."""
        if self.T == "inverse":
            return np.ones(self.ny, dtype=np.complex128)
        product = self.call("G", t, state) @ self.call("B", t, state)
        if self.T == "transpose":
            product = product @ product.T
        return np.linalg.eigvals(product).astype(np.complex128)

    def step_limit(self, state: FloatArray) -> float:
        """No limit."""
        return np.inf

    def begin_step(self, t: float, state: FloatArray) -> None:
        """Measure by the size of ``state``."""
        self.rescale(t, state)

    def end_step(self) -> None:
        """Nothing jumps."""

    def past_jump(self, t: float, state: FloatArray) -> float:
        """Nothing jumps."""
        return -np.inf

    # --- multipliers --------------------------------------------------------------------------

    def factor_of(self, yhat: FloatArray, B: FloatArray) -> FloatArray:
        """y (ny,) of least norm with B y = ``yhat``."""
        return np.linalg.lstsq(B, yhat, rcond=None)[0].astype(np.float64, copy=False)

    def multiplier_at(self, t: float, state: FloatArray) -> FloatArray:
        """y (ny,) by the exact prediction; of least norm where B loses rank."""
        self.rescale(t, state)
        terms = self.evaluate(t, state)
        return self.factor_of(terms.multiplier(), terms.B)

    def uncarried(self, t: float, state: FloatArray, carried: FloatArray) -> FloatArray:
        """y (ny,) from the quantity that sweeps carry, y or yhat."""
        if not self.carries_yhat:
            return carried
        return self.factor_of(carried, self.call("B", t, state))
