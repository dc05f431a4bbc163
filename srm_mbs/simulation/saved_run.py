"""Checks of saved runs: the entries of their JSON text, and shape, type and range of their arrays.

A file of a stranger may say anything.  :mod:`srm_mbs.simulation.storage` hands on nothing that has
not been checked here; every fault is a ValueError that names the entry or the array.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    TypeAdapter,
    ValidationError,
)

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rows import Elimination
from srm_mbs.dynamics.constraints.structure import Structure, row_names
from srm_mbs.dynamics.controllers import HeldForce
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import Units
from srm_mbs.dynamics.system import System
from srm_mbs.integration.control.prescribed_times import PLACEMENTS
from srm_mbs.integration.dense_output import STEP_PLACEMENTS, TIME_TOLERANCE, StepData
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.forces import FORCE_TYPES
from srm_mbs.model.laws import LAW_TYPES
from srm_mbs.model.model_data import StrictData, finite_numbers
from srm_mbs.model.numbers import LARGEST_MAGNITUDE
from srm_mbs.simulation.options import SINGULAR_TOLERANCE
from srm_mbs.simulation.result import ATTEMPT

LONGEST_TEXT = 64 * 10**6
"""Characters of a description or a URDF."""
LONGEST_NAME = 1000
"""Characters of a name."""
LONGEST_SENTENCE = 100_000
"""Characters of a message or a note."""
MOST_ELEMENTS = 10_000
"""Closures, forces, drives, points or actuators of a mechanism."""
LARGEST_NUMBER = 1e100
"""Largest magnitude in an array of a run: where runs end because products of larger ones
overflow."""
JOIN_TOLERANCE = 1e-9
"""Distance between the end of a step and where its rates lead, over the size of the state and of
the terms: rounding leaves 1e-14."""
UNIT_LENGTH = 1e-6
"""Deviation of quaternions and (cos, sin) pairs of a run from unit length."""
VERDICTS = ("rejected", "replaced")
ELEMENT_TYPES: dict[str, Any] = {**LAW_TYPES, **FORCE_TYPES}
"""Elements that are saved with their type; the others follow from where they are."""


def _positive_numbers(values: list[Any]) -> list[Any]:
    if not all(0.0 < value <= LARGEST_MAGNITUDE for value in finite_numbers(values)):
        raise ValueError("it has numbers that are not positive, or too large")
    return values


def _pairs(values: list[Any]) -> list[tuple[int, float]]:
    """Pairs of a step and a threshold."""
    for pair in values:
        if not isinstance(pair, list) or len(pair) != 2 or type(pair[0]) is not int:
            raise ValueError("it does not consist of a step and a threshold each")
        if pair[0] < 0 or min(finite_numbers(pair)) < 0.0:
            raise ValueError("it has numbers that are negative")
    return [(index, float(threshold)) for index, threshold in values]


Arrays = dict[str, NDArray[Any]]
Text = Annotated[str, Field(max_length=LONGEST_TEXT)]
Name = Annotated[str, Field(max_length=LONGEST_NAME)]
Sentence = Annotated[str, Field(max_length=LONGEST_SENTENCE)]
Number = Annotated[float, Field(ge=-LARGEST_MAGNITUDE, le=LARGEST_MAGNITUDE, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, le=LARGEST_MAGNITUDE, allow_inf_nan=False)]
Numbers = Annotated[list[Any], AfterValidator(finite_numbers)]
Sentences = Annotated[list[Sentence], Field(max_length=MOST_ELEMENTS)]
Elements = Annotated[list[dict[str, Any]], Field(max_length=MOST_ELEMENTS)]
NamedElements = Annotated[dict[Name, dict[str, Any]], Field(max_length=MOST_ELEMENTS)]


class SourceEntry(StrictData):
    """:class:`~srm_mbs.model.mechanism.Source`."""

    description: Text
    urdf: Text
    urdf_path: Sentence
    path: Sentence
    base: Literal["fixed", "floating", "planar"]
    gravity: Annotated[list[Number], Field(min_length=3, max_length=3)]
    format: Name = "URDF"
    parameters: Annotated[dict[Name, Number], Field(max_length=MOST_ELEMENTS)] = Field({})


class DefaultsEntry(StrictData):
    """:class:`~srm_mbs.model.mechanism.SimulationDefaults`."""

    t_end: Positive | None
    rtol: Positive | None
    atol: Positive | None


class MechanismEntry(StrictData):
    """A mechanism; ``model`` is data in format 5, Pinocchio's archive in format 4, and None beside
    a source."""

    name: Name
    source: SourceEntry | None
    model: dict[str, Any] | Text | None
    loops: Elements
    forces: Elements
    drives: Elements
    drive_starts: Annotated[dict[Name, Number], Field(max_length=MOST_ELEMENTS)] | None = None
    friction_speed: Positive
    defaults: DefaultsEntry
    notes: Sentences
    points: NamedElements = Field({})
    actuators: NamedElements = Field({})


class StructureEntry(StrictData):
    """Numbers of :class:`~srm_mbs.dynamics.constraints.structure.Structure` and its units."""

    rank: NonNegativeInt
    loop_rank: NonNegativeInt
    sigma_ref: Positive
    samples: NonNegativeInt
    notes: Sentences
    length: Positive
    rate: Positive


Tolerance = Annotated[NonNegativeFloat, Field(allow_inf_nan=False)]


class SettingsEntry(StrictData):
    """:class:`~srm_mbs.simulation.result.Settings`."""

    method: Name
    tableau: Name
    rtol: Positive
    atol: Annotated[list[Any], AfterValidator(_positive_numbers)]
    step: Positive | None
    controlled: bool
    placement: Literal[tuple(PLACEMENTS)] = "automatic"  # type: ignore[valid-type]
    singular_times: Numbers = Field(default_factory=list)
    backend: Literal["python", "kernel", "generated"] = "python"
    singular_tolerance: Tolerance = SINGULAR_TOLERANCE
    user_forces: bool = False


class StatisticsEntry(StrictData):
    """:class:`~srm_mbs.simulation.result.Statistics`."""

    steps: NonNegativeInt
    rejected: NonNegativeInt
    placements: NonNegativeInt
    replaced: NonNegativeInt
    zone_steps: NonNegativeInt
    evaluations: NonNegativeInt
    factorisations: NonNegativeInt
    wall_time: Annotated[NonNegativeFloat, Field(allow_inf_nan=False)]


class OptionsEntry(StrictData):
    """Options of :class:`~srm_mbs.simulation.options.RunOptions` that are saved; a rerun checks
    them as those of any run."""

    t0: Number
    method: Name | dict[Name, Any] | None
    tableau: Name | None
    first_step: Positive | None
    max_step: Annotated[float, Field(gt=0.0)] | None
    sample_time: Positive | None
    breakpoints: Numbers
    placement: Literal[tuple(PLACEMENTS)]  # type: ignore[valid-type]
    singular_times: Numbers
    backend: Literal["auto", "python", "kernel", "generated"]
    singular_tolerance: Tolerance = SINGULAR_TOLERANCE


class RequestEntry(StrictData):
    """How the run was asked for, and what of it is not saved."""

    t_end: Number
    options: OptionsEntry
    lost: Sentences


Zones = Annotated[list[Any], AfterValidator(_pairs)]
Status = Literal["running", "finished", "event", "interrupted", "failed"]


class RunEntry(StrictData):
    """The JSON text of a run of one segment."""

    format: int
    pin: Name
    mechanism: MechanismEntry
    structure: StructureEntry
    settings: SettingsEntry
    stats: StatisticsEntry
    request: RequestEntry | None = None
    status: Status
    message: Sentence
    zones: Zones
    stop: Number | None
    events: NonNegativeInt | None


class SegmentsEntry(StrictData):
    """The JSON text of a run of several segments."""

    format: int
    count: Annotated[int, Field(ge=1)]
    status: Status
    message: Sentence
    request: RequestEntry | None = None
    t_eval: Numbers | None


E = TypeVar("E", bound=BaseModel)


def checked_entry(kind: type[E], values: Mapping[str, Any]) -> E:
    """``values``, from JSON, as an entry of the class ``kind``.

    Raises
    ------
    ValueError
        Naming the first entry that is missing, unknown, or of another kind or size.
    """
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise ValueError(_first_fault(error)) from None


def _first_fault(error: ValidationError) -> str:
    first = error.errors(include_input=False, include_url=False)[0]
    where = ".".join(map(str, first["loc"]))
    return f"{where[:100]}: {first['msg'].removeprefix('Value error, ')[:200]}"


# -- elements: closures, forces, drives, laws and anchors ------------------------------------


@cache
def _checks(kind: Any) -> dict[str, TypeAdapter[Any]]:
    """By field of the class ``kind``, what checks the type of its value."""
    hints = get_type_hints(kind) | ({"type": str} if kind not in ELEMENT_TYPES.values() else {})
    config = ConfigDict(arbitrary_types_allowed=True, strict=True)
    checks: dict[str, TypeAdapter[Any]] = {}
    for key in fields(kind):
        hint = hints[key.name]
        own = getattr(hint, "__dataclass_fields__", None) is not None
        # Pydantic takes a dataclass as it is, and knows its own settings only.
        checks[key.name] = TypeAdapter(hint) if own else TypeAdapter(hint, config=config)
    return checks


def element(kind: Any, values: Any) -> Any:
    """The element of the class ``kind`` with the fields ``values``, from JSON.

    Raises
    ------
    ValueError
        If they are not its fields, or values of other types.
    InputError
        If the element cannot be.
    """
    if not isinstance(values, dict):
        raise ValueError(f"a {kind.__name__} is no object")
    made = {key: value_of(value) for key, value in values.items()}
    checks = _checks(kind)
    for key, value in made.items():
        if key not in checks:
            raise ValueError(f"a {kind.__name__} has no field {key[:100]!r}")
        try:
            checks[key].validate_python(value)
        except ValidationError as error:
            raise ValueError(f"{kind.__name__}.{key}: {_first_fault(error)}") from None
    return kind(**made)


def value_of(plain: Any) -> Any:
    """A value of an element, from JSON: an object is a law or force with its type, or else an
    anchor; a list is a tuple.

    Raises
    ------
    ValueError, InputError
        As :func:`element`; for numbers that are not finite, and long texts.
    """
    if isinstance(plain, list):
        return tuple(map(value_of, plain))
    if isinstance(plain, str) and len(plain) > LONGEST_NAME:
        raise ValueError(f"a name has {len(plain)} characters")
    if isinstance(plain, float | int) and not abs(plain) <= LARGEST_MAGNITUDE:
        raise ValueError("a number of an element is not finite, or too large")
    if not isinstance(plain, dict):
        return plain
    values = dict(plain)
    if "type" not in values:
        return element(Anchor, values)
    kind = values.pop("type")
    if not isinstance(kind, str) or kind not in ELEMENT_TYPES:
        raise ValueError(f"there is no element of the type {str(kind)[:100]!r}")
    return element(ELEMENT_TYPES[kind], values)


# -- arrays -----------------------------------------------------------------------------------

Shape = tuple[int | None, ...]


def _array(
    arrays: Arrays, name: str, shape: Shape, kinds: str = "f", *, infinite: bool = False
) -> NDArray[Any]:
    """The array ``name``, of that shape, with items of one of the ``kinds`` of dtypes.

    Numbers are finite and at most LARGEST_NUMBER, unless they may be ``infinite``; none is NaN.
    """
    if name not in arrays:
        raise ValueError(f"it has no {name}")
    array = arrays[name]
    fits = len(array.shape) == len(shape) and all(
        length in (None, actual) for length, actual in zip(shape, array.shape)
    )
    if not fits:
        expected = str(shape).replace("None", "any")
        raise ValueError(f"{name} has shape {array.shape}, not {expected}")
    if array.dtype.kind not in kinds or array.dtype.names or array.dtype.itemsize > 8:
        raise ValueError(f"{name} has items of the type {array.dtype}")
    if kinds == "f":
        if array.dtype.itemsize != 8:
            raise ValueError(f"{name} has items of the type {array.dtype}")
        largest = np.inf if infinite else LARGEST_NUMBER
        if not (np.abs(array) <= largest).all():
            raise ValueError(f"{name} has numbers that are not finite, or too large")
    return array


def _within(name: str, array: NDArray[Any], low: float, high: float) -> None:
    if array.size and not (array.min() >= low and array.max() <= high):
        raise ValueError(f"{name} has values outside {low:g} to {high:g}")


def _positive(name: str, array: FloatArray) -> None:
    if not (array > 0.0).all():
        raise ValueError(f"{name} has values that are not positive")


def _increasing(name: str, array: NDArray[Any]) -> None:
    if not (array[1:] > array[:-1]).all():
        raise ValueError(f"{name} does not increase")


def _whole_numbers(name: str, array: NDArray[Any]) -> None:
    if not (array == np.floor(array)).all():
        raise ValueError(f"{name} has values that are no whole numbers")


def checked_start(arrays: Arrays, model: pin.Model) -> tuple[FloatArray, FloatArray]:
    """q0 (nq,) and v0 (nv,)."""
    return _array(arrays, "q0", (model.nq,)), _array(arrays, "v0", (model.nv,))


def structure_from(mechanism: Mechanism, entry: StructureEntry, arrays: Arrays) -> Structure:
    """The analysis of the closures of ``mechanism`` in a saved run."""
    names, nv = row_names(mechanism), mechanism.model.nv
    rows = len(names)
    row_scale = _array(arrays, "row_scale", (rows,))
    kept = _array(arrays, "kept", (rows,), "b")
    unit = _array(arrays, "coordinate_unit", (nv,))
    _positive("row_scale", row_scale)
    _positive("coordinate_unit", unit)
    driven = len(mechanism.drives)
    if not kept[rows - driven :].all():
        raise ValueError("kept leaves out the row of a drive")
    if not entry.loop_rank <= entry.rank <= min(int(kept.sum()), nv):
        raise ValueError(
            f"the ranks {entry.loop_rank} of the loops and {entry.rank} of all rows are not those "
            f"of {int(kept.sum())} rows and {nv} velocities"
        )
    if rows and not entry.rank:
        raise ValueError("the rank of its rows is 0")
    eliminations = arrays.get("eliminations")
    found: tuple[Elimination, ...] = ()
    if eliminations is not None:
        table = _array(arrays, "eliminations", (None, 3))
        pairs = table[:, :2]
        _whole_numbers("eliminations", pairs)
        _within("eliminations", pairs, 0, rows - driven - 1)
        if (pairs[:, 0] == pairs[:, 1]).any() or len(table) > rows**2:
            raise ValueError("eliminations subtracts a row from itself")
        found = tuple(Elimination(int(i), int(j), factor) for i, j, factor in table.tolist())
    return Structure(
        names,
        row_scale,
        kept,
        entry.rank,
        entry.loop_rank,
        entry.sigma_ref,
        Units(entry.length, unit, entry.rate),
        entry.samples,
        tuple(entry.notes),
        found,
    )


def steps_from(
    mechanism: Mechanism, scheme: ButcherTableau, entry: RunEntry, arrays: Arrays
) -> StepData:
    """The accepted steps of a saved run."""
    model = mechanism.model
    nq, nv, m = model.nq, model.nv, 2 * model.nv
    times = _array(arrays, "times", (None,))
    if not len(times):
        raise ValueError("times is empty")
    _increasing("times", times)
    n, s = len(times) - 1, scheme.n_stages
    states = _array(arrays, "states", (n + 1, nq + nv))
    _check_states(model, "states", states)
    rates = _array(arrays, "rates", (n, None, m))
    # Methods with sweeps store the extra stages of the dense output as well.
    if rates.shape[1] not in (s + 1, scheme.dense.n_rates):
        raise ValueError(f"rates has shape {rates.shape}, not {(n, s + 1, m)}")
    corrections = _array(arrays, "corrections", (n, None))
    if corrections.shape[1] not in (0, m):
        raise ValueError(f"corrections has shape {corrections.shape}")
    sigmas = _array(arrays, "sigmas", (n, s + 1), infinite=True)
    ranks = _array(arrays, "ranks", (n,))
    error_ratios = _array(arrays, "error_ratios", (n,), infinite=True)
    placements = _array(arrays, "placements", (n,))
    held = _array(arrays, "held", (n,))
    stiff = _array(arrays, "stiff", (n,)) if "stiff" in arrays else np.zeros(n)
    for name, array, largest in (
        ("ranks", ranks, nv),
        ("placements", placements, len(STEP_PLACEMENTS) - 1),
        ("held", held, 1),
        ("stiff", stiff, 1),
    ):
        _whole_numbers(name, array)
        _within(name, array, 0, largest)
    for name, array in (("sigmas", sigmas), ("error_ratios", error_ratios)):
        _within(name, array, 0, np.inf)
    breaks = _array(arrays, "breaks", (None,), "i")
    _within("breaks", breaks, 1, n)
    _increasing("breaks", breaks)
    stop = entry.stop
    if stop is not None and not (n and times[-2] <= stop <= times[-1]):
        raise ValueError(f"the run cannot have stopped at {stop!r} s")
    return StepData(
        times=times,
        states=states,
        rates=rates,
        corrections=corrections,
        sigmas=sigmas,
        ranks=ranks,
        error_ratios=error_ratios,
        placements=placements,
        held=held,
        end_rate=_array(arrays, "end_rate", (m,)),
        zones=_zones(entry, arrays, n, nv),
        stop=stop,
        breaks=breaks,
        break_rates=_array(arrays, "break_rates", (len(breaks), m)),
        stiff=stiff,
    )


def check_steps_join(system: System, scheme: ButcherTableau, steps: StepData) -> None:
    """Refuse steps whose rates and corrections do not lead from each state to the next.

    A step ends at the uncorrected point that dense output has there, moved by the correction; both
    repeat what the run computed, to rounding.

    Raises
    ------
    ValueError, EvaluationError
        If a step ends elsewhere, or nowhere.
    """
    count = steps.rates.shape[1]
    members = tuple(scheme.member(stiff).dense for stiff in (False, True))
    wholes = tuple(dense.weights(np.ones(1))[0][:count] for dense in members)
    with np.errstate(over="ignore", invalid="ignore"):
        for i, h in enumerate(np.diff(steps.times).tolist()):
            weights = wholes[int(steps.stiff[i])]
            terms = h * weights[:, None] * steps.rates[i, : len(weights)]
            moved = terms.sum(axis=0)
            system.chart_rate(moved, moved)  # refuses joints that turn too far
            x, end = system.retract(steps.states[i], moved), steps.states[i + 1]
            if steps.corrections.shape[1]:
                x = system.retract(x, -steps.corrections[i])
            size = 1.0 + np.abs(end).max() + np.abs(terms).max()
            if not np.abs(x - end).max() <= JOIN_TOLERANCE * size:
                raise ValueError(f"the rates of step {i} do not lead from its state to the next")


def _zones(
    entry: RunEntry, arrays: Arrays, steps: int, nv: int
) -> dict[int, tuple[float, MultiplierHistory]]:
    zones: dict[int, tuple[float, MultiplierHistory]] = {}
    for k, (index, threshold) in enumerate(entry.zones):
        if index in zones or index >= steps:
            raise ValueError(f"zones names the step {index}, twice or of {steps}")
        times = _array(arrays, f"zone_{k}_times", (None,))
        values = _array(arrays, f"zone_{k}_values", (len(times), nv))
        if not len(times):
            raise ValueError(f"zone_{k}_times is empty")
        _increasing(f"zone_{k}_times", times)
        zones[index] = threshold, MultiplierHistory(times, values)
    return zones


def _check_states(model: pin.Model, name: str, states: FloatArray) -> None:
    """Refuse states (k, nq + nv) with a quaternion or (cos, sin) pair that is not of unit
    length."""
    if model.nq == model.nv:
        return
    for state in states:
        if not pin.isNormalized(model, state[: model.nq].copy(), UNIT_LENGTH):
            raise ValueError(f"{name} has a rotation that is not of unit length")


def events_from(
    model: pin.Model, count: int | None, steps: StepData, arrays: Arrays
) -> tuple[list[FloatArray], list[FloatArray]] | None:
    """Times (k,) and states (k, nq + nv) of each event; None if no events were given."""
    if count is None:
        return None
    times, states = [], []
    slack = TIME_TOLERANCE * max(abs(float(steps.times[0])), abs(steps.end))
    for k in range(count):
        found = _array(arrays, f"event_{k}_times", (None,))
        _within(f"event_{k}_times", found, float(steps.times[0]) - slack, steps.end + slack)
        if (found[1:] < found[:-1]).any():
            raise ValueError(f"event_{k}_times descends")
        there = _array(arrays, f"event_{k}_states", (len(found), model.nq + model.nv))
        _check_states(model, f"event_{k}_states", there)
        times.append(found)
        states.append(there)
    return times, states


def held_from(arrays: Arrays, nv: int) -> HeldForce | None:
    """The output of a sampled controller; None if there was none."""
    if "held_times" not in arrays:
        return None
    times = _array(arrays, "held_times", (None,), infinite=True)
    values = _array(arrays, "held_values", (len(times), nv))
    if not len(times) or (times[1:] == -np.inf).any() or (times == np.inf).any():
        raise ValueError("held_times is empty, or has times that are not finite")
    if (times[1:] <= times[:-1]).any():
        raise ValueError("held_times does not increase")
    held = HeldForce()
    for t, value in zip(times.tolist(), values):
        held.hold(t, value)
    return held


def attempts_from(arrays: Arrays) -> NDArray[Any]:
    """The steps that were not accepted."""
    attempts = arrays.get("attempts")
    if attempts is None:
        raise ValueError("it has no attempts")
    if attempts.dtype != ATTEMPT or attempts.ndim != 1:
        raise ValueError(f"attempts has the fields {attempts.dtype}")
    numbers = {key: np.ascontiguousarray(attempts[key]) for key in ("t", "h", "error_ratio")}
    for key in ("t", "h"):
        _array(numbers, key, (None,))
    if np.isnan(numbers["error_ratio"]).any() or not np.isin(attempts["verdict"], VERDICTS).all():
        raise ValueError("attempts has values that no attempt has")
    return attempts


def output_times_from(arrays: Arrays, start: float) -> FloatArray | None:
    """``t_eval`` (k,) of a run that begins at ``start`` (s), in any order; None without any."""
    if "t_eval" not in arrays:
        return None
    times = _array(arrays, "t_eval", (None,))
    _within("t_eval", times, start, LARGEST_NUMBER)
    return times
