r"""Laws over time, which drives and forces follow, as data that checks itself.

Every law becomes a :class:`Curve`,

    s(t) = sum_j c_ij (t - b_i)^j  on [b_i, b_{i+1})  +  sum_k A_k sin(w_k t + phi_k),

so that both backends evaluate the same numbers.  All laws are twice continuously differentiable.
Times at which s''' jumps are called knots; steps end there, so that schemes keep their order.

The fields of these classes are the one list of the keys of a law: descriptions
(:mod:`srm_mbs.formats.toml.schema`) and saved runs (:mod:`srm_mbs.simulation.storage`) read them.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, overload, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, safe_repr
from srm_mbs.model.numbers import finite_array

CONTINUOUS = 1e-8
"""Jump of a position (rad, m) or rate (per s), over it plus one, that counts as rounding."""


@dataclass(frozen=True)
class Curve:
    """A law ready for evaluation.

    Attributes
    ----------
    breaks
        b_i (s), ascending; the first piece also holds before b_0, the last one for ever.
    pieces
        c_i: the coefficients of each piece in rising powers, all of one length >= 1.
    sines
        (amplitude, angular frequency in rad/s, phase in rad) of each sine.
    """

    breaks: tuple[float, ...] = (0.0,)
    pieces: tuple[tuple[float, ...], ...] = ((0.0,),)
    sines: tuple[tuple[float, float, float], ...] = ()

    def __call__(self, t: float) -> tuple[float, float, float]:
        """s, s' and s'' at t (s)."""
        i = max(bisect_right(self.breaks, t) - 1, 0)
        return self._values(t, t - self.breaks[i], self.pieces[i], math)

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The same (n,) at the times t (n,) s."""
        breaks = np.array(self.breaks)
        i = np.maximum(np.searchsorted(breaks, t, side="right") - 1, 0)
        return self._values(t, t - breaks[i], np.array(self.pieces)[i].T, np)

    def _values(self, t: Any, x: Any, piece: Any, functions: Any) -> tuple[Any, Any, Any]:
        """s, s' and s'' at t, which is ``x`` after the begin of the ``piece``; ``functions``: the
        module of sine and cosine."""
        value = rate = half = 0.0 * x
        for c in reversed(piece):
            half = half * x + rate
            rate = rate * x + value
            value = value * x + c
        bend = 2.0 * half
        for amplitude, omega, phase in self.sines:
            sine, cosine = functions.sin(omega * t + phase), functions.cos(omega * t + phase)
            value = value + amplitude * sine
            rate = rate + amplitude * omega * cosine
            bend = bend - amplitude * omega * omega * sine
        return value, rate, bend

    def piece(self, t: float) -> Curve:
        """The polynomial piece that is active at t (s), extended to all times, with the sines."""
        i = max(bisect_right(self.breaks, t) - 1, 0)
        return Curve((self.breaks[i],), (self.pieces[i],), self.sines)

    def jump(self) -> tuple[float, str] | None:
        """The first time (s) after 0 at which s or s' jumps, and a clause that says so; None if
        both are continuous."""
        for i, t in enumerate(self.breaks[1:], start=1):
            if t <= 0.0:  # drives begin at 0
                continue
            before = Curve((self.breaks[i - 1],), (self.pieces[i - 1],))(t)
            after = Curve((t,), (self.pieces[i],))(t)
            for name, left, right in zip(("position", "rate"), before, after):
                if abs(right - left) > CONTINUOUS * (1.0 + abs(left)):
                    return t, f"its {name} jumps from {left:.6g} to {right:.6g}"
        return None

    def shifted(self, by: float) -> Curve:
        """The curve s(t) + ``by``."""
        pieces = tuple((piece[0] + by, *piece[1:]) for piece in self.pieces)
        return Curve(self.breaks, pieces, self.sines)

    def constants(self) -> dict[str, Any]:
        """Breaks (n,), pieces (n, k) and sines (m, 3) as arrays, for the compiled kernel."""
        return {
            "breaks": np.array(self.breaks),
            "pieces": np.array(self.pieces),
            "sines": np.array(self.sines, dtype=float).reshape(-1, 3),
        }


@runtime_checkable
class Law(Protocol):
    """A law over time, twice continuously differentiable.

    A class of one's own defines ``type`` and ``curve``, and ``knots`` and ``span`` where the
    defaults do not fit; it inherits from this one, or has all four.
    """

    type: ClassVar[str]
    """Its name in a description."""

    def curve(self, initial: float = 0.0) -> Curve:
        """s(t); ``initial`` is s(0) of laws that prescribe only their target or their speed."""

    @property
    def knots(self) -> Sequence[float]:
        """Times (s) at which its third derivative jumps; none by default."""
        return ()

    @property
    def span(self) -> tuple[float, float]:
        """First and last time (s) for which it is defined; all times by default."""
        return (-math.inf, math.inf)


def _fault(law: Law, problem: str, remedy: str) -> InputError:
    return InputError(problem, element=f"law {law.type!r}", remedy=remedy)


def _take(law: Law, key: str, above: float = -math.inf) -> float:
    """Check a number of ``law`` and store it as a float."""
    given = getattr(law, key)
    number = finite_array(given, ())
    if number is None:
        raise _fault(
            law, f"{key} = {safe_repr(given)} is not a finite number", f"Give a number for {key}"
        )
    if not number > above:
        raise _fault(law, f"{key} = {safe_repr(given)} is too small", f"Give {key} above {above:g}")
    object.__setattr__(law, key, float(number))
    return float(number)


def _list(law: Law, key: str, least: int) -> FloatArray:
    """The list of numbers of ``law``, of which there are at least ``least``, as an array that
    nothing else changes: a new one, or that of :class:`Samples`."""
    given = getattr(law, key)
    array = finite_array(given, (None,), new=not isinstance(given, Samples))
    remedy = f"Give a list of finite numbers, at least {least}"
    if array is None:
        raise _fault(law, f"{key} is not a list of finite numbers", remedy)
    if len(array) < least:
        raise _fault(law, f"{key} has shape {array.shape}", remedy)
    return array


class Samples(Sequence[float]):
    """Numbers that behave as a tuple of floats, in a read-only array: a tuple takes four times the
    memory.

    Parameters
    ----------
    array : (n,)
        The numbers; it becomes read-only.
    """

    __slots__ = ("_array",)

    def __init__(self, array: FloatArray) -> None:
        array.setflags(write=False)
        self._array = array

    def __len__(self) -> int:
        return len(self._array)

    @overload
    def __getitem__(self, index: int) -> float: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[float, ...]: ...

    def __getitem__(self, index: int | slice) -> float | tuple[float, ...]:
        found = self._array[index].tolist()
        return tuple(found) if isinstance(index, slice) else found

    def __iter__(self) -> Iterator[float]:
        return iter(self._array.tolist())

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self._array, dtype) if copy else np.asarray(self._array, dtype)

    def __eq__(self, other: object) -> bool:
        if isinstance(other, Samples):
            return np.array_equal(self._array, other._array)
        return tuple(self) == other if isinstance(other, tuple) else NotImplemented

    def __hash__(self) -> int:
        return hash(tuple(self))

    def __repr__(self) -> str:
        return repr(tuple(self))

    def __reduce__(self) -> tuple[Any, ...]:
        return Samples, (self._array,)


@dataclass(frozen=True)
class ConstantSpeed(Law):
    """s = s_0 + speed t.

    Parameters
    ----------
    speed
        rad/s or m/s.

    Raises
    ------
    InputError
        For a value that is not finite.
    """

    type: ClassVar[str] = "constant_speed"
    speed: float

    def __post_init__(self) -> None:
        _take(self, "speed")

    def curve(self, initial: float = 0.0) -> Curve:
        return Curve(pieces=((initial, self.speed),))


@dataclass(frozen=True)
class Sine(Law):
    """s = offset + amplitude sin(omega t + phase), omega = 2 pi frequency_hz.

    Parameters
    ----------
    amplitude
        In the unit of what follows the law (rad, m, N m, N).
    frequency_hz, omega
        One of the two: Hz, or rad/s.
    phase
        rad.
    offset
        Mean value; without effect on a drive, which starts from its initial value.

    Raises
    ------
    InputError
        For a value that is not finite, or unless one of the frequencies is given.
    """

    type: ClassVar[str] = "sine"
    amplitude: float
    frequency_hz: float | None = None
    omega: float | None = None
    phase: float = 0.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        for key in ("amplitude", "phase", "offset"):
            _take(self, key)
        if (self.frequency_hz is None) == (self.omega is None):
            raise _fault(
                self, "a sine needs one frequency", "Give frequency_hz (Hz) or omega (rad/s)"
            )
        _take(self, "omega" if self.frequency_hz is None else "frequency_hz")

    def curve(self, initial: float = 0.0) -> Curve:
        turns = 2.0 * math.pi * (self.frequency_hz or 0.0)
        wave = (self.amplitude, turns if self.omega is None else self.omega, self.phase)
        return Curve(pieces=((self.offset,),), sines=(wave,))


@dataclass(frozen=True)
class Polynomial(Law):
    """s = c_0 + c_1 t + c_2 t^2 + ...

    Parameters
    ----------
    coefficients
        c_0, c_1, ...: unit, unit/s, unit/s^2, ...

    Raises
    ------
    InputError
        Unless they are finite numbers.
    """

    type: ClassVar[str] = "polynomial"
    coefficients: Sequence[float]

    def __post_init__(self) -> None:
        coefficients = tuple(_list(self, "coefficients", 1).tolist())
        object.__setattr__(self, "coefficients", coefficients)

    def curve(self, initial: float = 0.0) -> Curve:
        return Curve(pieces=(tuple(self.coefficients),))


@dataclass(frozen=True)
class MinimumJerk(Law):
    """From rest to rest: s = s_0 + (target - s_0)(10 x^3 - 15 x^4 + 6 x^5).

    x = (t - start)/duration.  It holds s_0 before ``start`` and ``target`` after start + duration.
    T. Flash, N. Hogan, J. Neurosci. 5 (1985) 1688.

    Parameters
    ----------
    target
        Final value (rad, m): a position, not a distance.
    duration
        s, positive.
    start
        s, not negative.

    Raises
    ------
    InputError
        For values that are not finite, a duration that is not positive, or start < 0.
    """

    type: ClassVar[str] = "minimum_jerk"
    target: float
    duration: float
    start: float = 0.0

    def __post_init__(self) -> None:
        _take(self, "target")
        _take(self, "duration", 0.0)
        if _take(self, "start") < 0.0:
            raise _fault(self, f"start = {self.start:g} is negative", "Give a start >= 0")

    def curve(self, initial: float = 0.0) -> Curve:
        way, T = self.target - initial, self.duration
        motion = (initial, 0.0, 0.0, 10.0 * way / T**3, -15.0 * way / T**4, 6.0 * way / T**5)
        rest = (0.0,) * 5
        return Curve(
            (self.start - 1.0, self.start, self.start + T),
            ((initial, *rest), motion, (self.target, *rest)),
        )

    @property
    def knots(self) -> tuple[float, ...]:
        return (self.start, self.start + self.duration)


@dataclass(frozen=True)
class Table(Law):
    """The cubic spline (C2, not-a-knot) through values over time.

    Parameters
    ----------
    t
        Times (s), ascending, from 0 or earlier; at least 4.
    values
        As many values.

    Raises
    ------
    InputError
        If they do not fit, are not finite, or the times do not ascend from 0 or earlier.
    """

    type: ClassVar[str] = "table"
    t: Sequence[float]
    values: Sequence[float]

    def __post_init__(self) -> None:
        t, values = _list(self, "t", 4), _list(self, "values", 4)
        if len(t) != len(values):
            raise _fault(self, f"{len(t)} times and {len(values)} values", "Give as many of each")
        if not (t[1:] > t[:-1]).all():
            raise _fault(self, "the times do not ascend", "Sort them, each time once")
        if t[0] > 0.0:
            raise _fault(
                self, f"the table begins at t = {t[0]:g} s", "Let it begin at t = 0 or before"
            )
        object.__setattr__(self, "t", Samples(t))
        object.__setattr__(self, "values", Samples(values))

    def curve(self, initial: float = 0.0) -> Curve:
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(np.array(self.t), np.array(self.values))
        return Curve(tuple(self.t[:-1]), tuple(map(tuple, spline.c[::-1].T.tolist())))

    @property
    def knots(self) -> Sequence[float]:
        # Not-a-knot: the third derivative is the same on both sides of the second and last but one.
        # Not a tuple: isinstance(table, Law) asks for the attributes of the protocol.
        return Samples(np.asarray(self.t)[2:-2])

    @property
    def span(self) -> tuple[float, float]:
        return self.t[0], self.t[-1]


def curve_of(law: Law, initial: float = 0.0) -> Curve:
    """s(t) of ``law``, checked if it is one of the user.

    Raises
    ------
    InputError
        If that is not a :class:`Curve` of numbers that fit to each other.
    """
    found = law.curve(initial)
    return found if is_of_package(law) else _checked_curve(law, found)


def check_law(law: Law) -> None:
    """Refuse a law of the user whose curve cannot be evaluated, or whose times are none.

    Raises
    ------
    InputError
        Naming the law.
    """
    if is_of_package(law):
        return
    curve_of(law)
    if finite_array(law.knots, (None,)) is None:
        raise _fault(
            law, f"its knots {safe_repr(law.knots)} are not times", "Give a list of numbers (s)"
        )
    try:
        first, last = law.span
        covers = bool(first <= 0.0 < last)
    except Exception:  # objects may raise anything
        covers = False
    if not covers:
        raise _fault(
            law,
            f"its span {safe_repr(law.span)} is not from t = 0 or before to a later time",
            "Give a first and a last time (s), which may be infinite",
        )


def is_of_package(law: Law) -> bool:
    """Whether the fields of ``law`` say all about it: a class of the user, also one that inherits
    from a law of the package, may have another curve."""
    return type(law) is LAW_TYPES.get(law.type)


def _checked_curve(law: Law, found: Any) -> Curve:
    if not isinstance(found, Curve):
        raise _fault(law, f"its curve is {safe_repr(found)}", "Return a Curve")
    breaks = finite_array(found.breaks, (None,))
    if breaks is None or not len(breaks) or (np.diff(breaks) <= 0.0).any():
        raise _fault(
            law,
            f"the breaks {safe_repr(found.breaks)} of its curve are not ascending times",
            "Give at least one finite number (s)",
        )
    pieces = finite_array(found.pieces, (len(breaks), None))
    if pieces is None or not pieces.shape[1]:
        raise _fault(
            law,
            f"the pieces {safe_repr(found.pieces)} of its curve are not coefficients of "
            f"{len(breaks)} polynomials",
            "Give each break a list of finite numbers, all of one length",
        )
    sines = finite_array(found.sines, (None, 3)) if len(found.sines) else np.zeros((0, 3))
    if sines is None:
        raise _fault(
            law,
            f"the sines {safe_repr(found.sines)} of its curve are not triples of numbers",
            "Give (amplitude, angular frequency in rad/s, phase in rad) of each",
        )
    rows: list[Any] = [tuple(map(tuple, array.tolist())) for array in (pieces, sines)]
    return Curve(tuple(breaks.tolist()), *rows)


LAW_TYPES: Mapping[str, type[Law]] = MappingProxyType(
    {kind.type: kind for kind in (ConstantSpeed, Sine, Polynomial, MinimumJerk, Table)}
)
"""The laws by their type in a description."""
