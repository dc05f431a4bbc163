"""Options of a run, and their checks: the one source that runs, results, storage and reruns read.

:class:`RunOptions` is made once, from the arguments of :func:`srm_mbs.simulate`,
:func:`srm_mbs.solve_dae` or :class:`srm_mbs.Simulator`, and handed on whole.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, joined_names, safe_repr, warn
from srm_mbs.integration.control.prescribed_times import PLACEMENTS
from srm_mbs.integration.methods.base import NEGLIGIBLE, Method
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.psrm import PSRM, is_split
from srm_mbs.integration.methods.tableaus import TABLEAUS, get_tableau
from srm_mbs.integration.methods.thesis.srm import SRM
from srm_mbs.model.numbers import choice, finite_array, finite_number, flag, positive_number

LOOSEST_RTOL = 1e-4
"""Looser tolerances let sweeps jump to another branch at a change point."""
LOOSEST_OF_SPLIT = {8: 1e-2, 1: 1e-3}
"""The split PSRM, which watches its branch itself: order of the error estimate, from which order on
-> loosest rtol.  Estimates of low order let a run drift away altogether at 1e-2."""
TIGHTEST_RTOL = 100 * np.finfo(float).eps
TIGHTEST_OF_CLOSURES = {5: 1e-12, 1: 1e-11}
"""Where closures or drives act: order of the error estimate, from which order on -> tightest rtol.
Next to singular configurations corrections know positions to rounding / sigma, the less the shorter
the steps.  Errors then fall no further: the largest of 63 runs through one to three of them is,
against dop853 at 1e-12, 3e-11 at 1e-11 and 9e-11 at 2e-13; tvd32 would still gain at 1e-12 (1e-10
instead of 9e-10), with nothing to spare."""
AVOIDABLE = 1e-9
"""Fraction of the run within which of its ends a given singular time cannot be avoided."""
SAMPLED = 1e-9
"""Part of a sample time before the end of a run from which no sample is taken."""
MOST_SAMPLES = 10**8
SINGULAR_TOLERANCE = 1e-9
"""Default of ``singular_tolerance``: residual, over the size of the mechanism, up to which a
critical configuration counts as singular; that of data with ten digits."""
_NO_TIMES = np.zeros(0)
METHODS: dict[str, Callable[..., Method]] = {
    "psrm": PSRM,
    "srm": partial(SRM, restart=True, carry=True),
}
"""Methods that can be given by name; sweeps that restart, because own histories and step-size
control do not go together (:class:`srm_mbs.SRM`)."""


METHOD_ATTRIBUTES = ("scheme", "start", "step", "accept", "resume")
"""Those of :class:`~srm_mbs.integration.methods.base.Method`."""


class RunOptions(NamedTuple):
    """Options of a run; :func:`srm_mbs.simulate` explains each.

    As the caller gave them, until :meth:`checked` replaces them by values of their final types.
    A result keeps them, so that the run can be made again with another accuracy.

    Attributes
    ----------
    lost
        In a loaded run: the options that saved runs do not keep, in words.
    """

    t_end: Any
    t0: Any = 0.0
    q0: Any = None
    v0: Any = None
    method: Any = "psrm"
    tableau: Any = None
    rtol: Any = 1e-6
    atol: Any = None
    step: Any = None
    first_step: Any = None
    max_step: Any = None
    t_eval: Any = None
    events: Any = None
    controller: Any = None
    sample_time: Any = None
    breakpoints: Any = ()
    placement: Any = "automatic"
    singular_times: Any = ()
    progress: Any = False
    backend: Any = "auto"
    raise_on_failure: bool = False
    singular_tolerance: Any = SINGULAR_TOLERANCE
    lost: tuple[str, ...] = ()

    def checked(
        self,
        method: Method,
        rtol_range: tuple[float, float],
        span: tuple[float, float],
        *,
        unit: str,
        arguments: str,
    ) -> RunOptions:
        """The options with their final types: numbers, arrays, a method object.

        Parameters
        ----------
        method
            The checked method.
        rtol_range
            Tightest and loosest relative tolerance that the method can use.
        span
            Start and end of the run, checked.
        unit
            Unit of times in messages: ``" of seconds"`` or nothing.
        arguments
            Arguments of a progress function in messages: ``"(t, h, state)"``.

        Raises
        ------
        InputError
            For the first invalid option.
        """
        flag(self.raise_on_failure, "raise_on_failure")
        tightest, loosest = rtol_range
        t0, t_end = span
        step, first_step, max_step = (
            None if value is None else positive_number(value, name, unit)
            for name, value in (
                ("step", self.step),
                ("first_step", self.first_step),
                ("max_step", self.max_step),
            )
        )
        check_progress(self.progress, arguments)
        return self._replace(
            t0=t0,
            t_end=t_end,
            placement=checked_placement(self.placement),
            singular_times=checked_singular_times(self.singular_times, t0, t_end, unit),
            step=step,
            first_step=first_step,
            max_step=max_step,
            method=method,
            tableau=None,
            rtol=checked_rtol(self.rtol, loosest, tightest),
            singular_tolerance=checked_singular_tolerance(self.singular_tolerance),
            t_eval=checked_times(self.t_eval, t0, t_end, unit),
        )

    @property
    def longest_step(self) -> float:
        """``max_step`` (s); infinite if none is given."""
        return math.inf if self.max_step is None else float(self.max_step)

    @property
    def negligible(self) -> float:
        """Part of the tolerance that is not worth an evaluation; 0 for fixed steps."""
        return NEGLIGIBLE if self.step is None else 0.0

    def repeatable(self) -> RunOptions:
        """The options that another run of the same motion needs: without start, accuracy, output.

        Results keep these, so that they hold neither progress functions nor further arrays.
        """
        return RunOptions._make(_REPEATABLE(self + _NOT_REPEATED))


REPEATED = (
    *("t0", "method", "tableau", "first_step", "max_step", "events", "controller", "sample_time"),
    *("breakpoints", "placement", "singular_times", "backend", "singular_tolerance"),
)
"""Options that a rerun takes over; start, accuracy and output come from elsewhere."""
_NOT_REPEATED = (None, *RunOptions._field_defaults.values())
"""Values of the options that a rerun does not take over."""
_REPEATABLE = itemgetter(
    *(
        place if name in ("t_end", *REPEATED, "lost") else place + len(RunOptions._fields)
        for place, name in enumerate(RunOptions._fields)
    )
)
"""The values of the options of a rerun, from those of a run and :data:`_NOT_REPEATED`."""


def checked_singular_tolerance(value: Any) -> float:
    """``singular_tolerance`` as a float.

    Raises
    ------
    InputError
        If it is negative or not finite.
    """
    if type(value) is float and 0.0 <= value < math.inf:
        return value
    number = finite_array(value, ())
    if number is None or not float(number) >= 0.0:
        raise InputError(
            f"singular_tolerance = {safe_repr(value)} is not a number of at least 0",
            element="singular_tolerance",
            remedy="Give the residual, over the size of the mechanism, up to which a configuration "
            "counts as singular; 0 follows the data",
        )
    return float(number)


def check_progress(progress: Any, arguments: str) -> None:
    """Refuse what is neither a boolean nor a function of ``arguments``, as messages name them.

    Raises
    ------
    InputError
        If it is anything else.
    """
    if not (callable(progress) or isinstance(progress, bool | np.bool_)):
        raise InputError(
            f"progress = {safe_repr(progress)} is neither True or False nor a function",
            element="progress",
            remedy=f"Give True for a progress bar, or a function of {arguments}",
        )


def finite(value: Any, what: str) -> float:
    """``value`` as a finite number of seconds."""
    return finite_number(value, what, what, "Give a number of seconds")


def numbers(values: Any, what: str, remedy: str) -> FloatArray:
    """``values`` as an array of finite numbers."""
    array = finite_array(values)
    if array is None:
        raise InputError(
            f"{what} = {safe_repr(values)} does not consist of finite numbers",
            element=what,
            remedy=remedy,
        )
    return array


def loosest_rtol(method: Method) -> float:
    """The loosest rtol with which ``method`` keeps to its branch of the motion."""
    if not is_split(method):
        return LOOSEST_RTOL
    order = method.scheme.controller_order or 1
    return next(rtol for least, rtol in LOOSEST_OF_SPLIT.items() if order >= least)


def tightest_rtol(scheme: ButcherTableau, constrained: bool) -> float:
    """The tightest rtol that rounding leaves ``scheme``, of mechanisms ``constrained`` by closures
    or drives and of others, whose positions are of the order of their units."""
    if not constrained:
        return float(TIGHTEST_RTOL)
    order = scheme.controller_order or 1
    return next(rtol for least, rtol in TIGHTEST_OF_CLOSURES.items() if order >= least)


def checked_rtol(value: Any, loosest: float, tightest: float) -> float:
    """rtol within what the methods can use, from ``tightest`` to ``loosest``; warns where it is
    changed."""
    rtol = positive_number(value, "rtol")
    if rtol > loosest:
        warn(
            f"rtol = {rtol:g} is looser than {loosest:g}, from where a step may jump to "
            f"another branch at a singular configuration: using {loosest:g}"
        )
        return loosest
    if rtol < tightest:
        where = "" if rtol < TIGHTEST_RTOL else " next to singular configurations of closures"
        warn(f"rtol = {rtol:g} is below round-off{where}: using {tightest:.1e}")
        return tightest
    return rtol


@lru_cache(maxsize=64)
def _named(name: str, tableau: str | ButcherTableau | None) -> Method:
    kind = METHODS[name]
    return kind() if tableau is None else kind(tableau)


def checked_method(method: str | Method, tableau: str | ButcherTableau | None) -> Method:
    """A method object from a name or an object."""
    if isinstance(method, str):
        if method.lower() in TABLEAUS:  # as of SciPy's solve_ivp: method="DOP853"
            raise InputError(
                f"{safe_repr(method)} is a tableau, not a method",
                element="method",
                remedy=f'Give tableau="{method.lower()}"',
            )
        name = choice(method, METHODS, "method")
        if tableau is not None:
            get_tableau(tableau)  # refuses what cannot be looked up
        return _named(name, tableau)
    if tableau is not None:
        raise InputError(
            "tableau is given beside a method object",
            element="tableau",
            remedy="Give the tableau to the method: PSRM(tableau=...)",
        )
    missing = [name for name in METHOD_ATTRIBUTES if not hasattr(method, name)]
    if isinstance(method, type) or missing:
        partly = 0 < len(missing) < len(METHOD_ATTRIBUTES)
        without = f": it has no {joined_names(missing)}" if partly else ""
        raise InputError(
            f"method = {safe_repr(method)} is not a method{without}",
            element="method",
            remedy='Give "psrm" or an object such as PSRM(tableau="dopr54")',
        )
    if not isinstance(method.scheme, ButcherTableau):
        raise InputError(
            f"the scheme of the method is {safe_repr(method.scheme)}",
            element="method",
            remedy="Give it an srm.ButcherTableau, such as one of srm.TABLEAUS",
        )
    return method


def checked_times(t_eval: Any, t0: float, t_end: float, unit: str) -> FloatArray | None:
    """Output times within the run, increasing; None if none are given."""
    if t_eval is None:
        return None
    remedy = f"Give increasing times between {t0:.15g} and t_end = {t_end:.15g}"
    remedy += " s" if unit else ""
    times = numbers(t_eval, "t_eval", remedy)
    slack = 1e-12 * max(abs(t0), abs(t_end))  # np.arange(4) * 0.1 ends a rounding error after 0.3
    if times.ndim != 1 or (
        times.size and (times.min() < t0 - slack or times.max() > t_end + slack)
    ):
        raise InputError(
            f"t_eval must be one-dimensional and lie within {t0:.15g} and t_end",
            element="t_eval",
            remedy=remedy,
        )
    if np.any(np.diff(times) <= 0.0):
        raise InputError("t_eval must increase", element="t_eval", remedy=remedy)
    return np.clip(times, t0, t_end)


def checked_placement(placement: Any) -> str:
    """One of the known placements around singular configurations."""
    return choice(placement, PLACEMENTS, "placement")


def _given_times(values: Any, what: str, remedy: str) -> FloatArray:
    """``values`` as times (k,) s."""
    times = numbers(values, what, remedy)
    if times.ndim != 1:
        raise InputError(f"{what} has shape {times.shape}", element=what, remedy=remedy)
    return times


def checked_singular_times(singular_times: Any, t0: float, t_end: float, unit: str) -> FloatArray:
    """The given times within the run, in order."""
    if isinstance(singular_times, tuple) and not singular_times:
        return np.zeros(0)
    seconds = " (s)" if unit else ""
    remedy = f"Give times{seconds} between the start and the end of the run"
    times = np.unique(_given_times(singular_times, "singular_times", remedy))
    slack = AVOIDABLE * (t_end - t0)
    for end in (t0, t_end):
        if np.any(np.abs(times - end) <= slack):
            raise InputError(
                f"the run starts or ends at t = {end:.15g}, where a step must begin or end",
                element="singular_times",
                remedy=remedy,
            )
    inside: FloatArray = times[(times > t0) & (times < t_end)]
    return inside


def checked_breakpoints(breakpoints: Any) -> FloatArray:
    """The given times, in any order."""
    if isinstance(breakpoints, tuple) and not breakpoints:
        return _NO_TIMES
    remedy = "Give times (s) at which a force jumps or has a kink"
    return _given_times(breakpoints, "breakpoints", remedy)


def check_avoidable(singular_times: FloatArray, breakpoints: FloatArray, t_end: float) -> None:
    """Refuse singular times on breakpoints, on which a step has to end."""
    if not len(singular_times):
        return
    apart = np.abs(singular_times[:, None] - breakpoints).min(axis=1)
    if np.any(apart <= AVOIDABLE * t_end):
        raise InputError(
            f"a step must end at {singular_times[int(np.argmin(apart))]:g} s, a breakpoint",
            element="singular_times",
            remedy="Leave it out, or move the breakpoint",
        )


def checked_span(t0: Any, t_end: Any) -> tuple[float, float]:
    """Start and end (s) of a run."""
    start = finite(t0, "t0")
    if start == 0.0:
        return 0.0, positive_number(t_end, "t_end", " of seconds")
    end = finite(t_end, "t_end")
    if not end > start:
        raise InputError(
            f"the run ends at {end:.15g} s, before it starts at {start:.15g} s",
            element="t_end",
            remedy="Give a time after t0",
        )
    return start, end


def checked_samples(sample_time: Any, controller: Any, t0: float, t_end: float) -> FloatArray:
    """Multiples (s) of ``sample_time`` within a run, at which a controller is sampled; often
    none."""
    if sample_time is None:
        return _NO_TIMES
    period = positive_number(sample_time, "sample_time", " of seconds")
    if controller is None:
        raise InputError(
            "sample_time is given, but no controller",
            element="sample_time",
            remedy="Give controller=, a function of (t, q, v)",
        )
    count = (t_end - t0) / period
    if not count < MOST_SAMPLES:
        raise InputError(
            f"sample_time = {period:g} s makes {count:.3g} samples",
            element="sample_time",
            remedy=f"Give at least {(t_end - t0) / MOST_SAMPLES:.1e} s for a run of this length",
        )
    first: int = math.floor(t0 / period + SAMPLED) + 1
    end: int = math.ceil(t_end / period - SAMPLED)
    return np.arange(first, end, dtype=np.float64) * np.float64(period)


def checked_atol(atol: Any, lengths: tuple[int, ...], remedy: str) -> FloatArray:
    """``atol`` as one positive number () or several, as many as one of ``lengths``.

    Raises
    ------
    InputError
        With ``remedy``, if it is something else.
    """
    array = numbers(atol, "atol", remedy)
    if array.shape not in ((), *((length,) for length in lengths)):
        raise InputError(f"atol has shape {array.shape}", element="atol", remedy=remedy)
    if not (array > 0.0).all():
        raise InputError(
            f"atol = {array.min():g} is not positive"
            if array.ndim == 0
            else f"the smallest atol, {array.min():g}, is not positive",
            element="atol",
            remedy=remedy,
        )
    return array


def check_embedded(scheme: ButcherTableau, step: float | None) -> None:
    """Refuse step-size control for a scheme without an embedded pair.

    Raises
    ------
    InputError
        If ``step`` is None and the scheme has no embedded pair.
    """
    if step is None and scheme.controller_order is None:
        raise InputError(
            f"the tableau {scheme.name!r} has no embedded pair to estimate its error",
            element="tableau",
            remedy="Give a step, or use tvd32, dopr54 or dop853",
        )
