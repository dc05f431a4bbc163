"""Saved runs: one ``.npz`` with everything needed to interpolate, replay and plot a run.

Arrays are stored as they are; the rest (description, URDF, closures, settings, options of the run
but Python functions) as one JSON text.  Nothing is pickled.  A run of several segments is one
archive of the files of its segments.
"""

from __future__ import annotations

import io
import json
import logging
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rows import Elimination
from srm_mbs.dynamics.constraints.structure import Structure, row_names
from srm_mbs.dynamics.controllers import HeldForce
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.dynamics.scaling import Units
from srm_mbs.errors import InputError
from srm_mbs.formats.build import rebuild
from srm_mbs.integration.dense_output import StepData
from srm_mbs.integration.driver import RunStatus
from srm_mbs.integration.events import acting
from srm_mbs.integration.kernel.dense_output import dense_output
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory
from srm_mbs.integration.methods.psrm import PSRM
from srm_mbs.integration.methods.tableaus import TABLEAUS, get_tableau
from srm_mbs.integration.methods.thesis.srm import SRM
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.drives import Drive
from srm_mbs.model.forces import FORCE_TYPES, ForceElement
from srm_mbs.model.laws import LAW_TYPES, Curve, Law
from srm_mbs.model.mechanism import SimulationDefaults, Source
from srm_mbs.model.reach import Reach
from srm_mbs.simulation.options import REPEATED, RunOptions
from srm_mbs.simulation.result import ATTEMPT, Settings, SimulationResult, Statistics
from srm_mbs.simulation.segmented_result import R, ResultTypes, SegmentedResult

log = logging.getLogger(__name__)

FORMAT = 4
SEGMENTS_FORMAT = 1
CONTENTS = "segments.json"
"""Entry of an archive of segments that describes the whole run."""
SAVED_BY = "Give a file written by solution.save or srm-mbs simulate --out"
OTHER_VERSION = "Load it with the version of srm_mbs that wrote it, or simulate again"
SAVE_ARRAYS = "Save the arrays t, q and v instead"
LOST_CONTROLLER = "the controller"
METHODS = {"PSRM": PSRM, "SRM": SRM}
"""Methods that are saved, by their kind."""
ELEMENT_TYPES: dict[str, Any] = {**LAW_TYPES, **FORCE_TYPES}
"""Elements that are saved with their type; the others follow from where they are."""
STEP_ARRAYS = tuple(key.name for key in fields(StepData) if key.name not in ("zones", "stop"))
STRUCTURE_VALUES = ("rank", "loop_rank", "sigma_ref", "samples", "notes")
"""Fields of :class:`Structure` that are neither arrays nor names of rows."""

Arrays = dict[str, NDArray[Any]]


# -- elements: closures, forces, drives, laws and anchors as JSON -----------------------------


def _plain(value: Any) -> Any:
    """An element as an object of its fields, tuples as lists."""
    if is_dataclass(value):
        kind: dict[str, Any] = {"type": value.type} if isinstance(value, Law | ForceElement) else {}
        return kind | {key.name: _plain(getattr(value, key.name)) for key in fields(value)}
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


def _element(kind: Any, values: dict[str, Any]) -> Any:
    """The element of the class ``kind`` from what :func:`_plain` made of it."""
    return kind(**{key: _value(value) for key, value in values.items()})


def _value(plain: Any) -> Any:
    """A value of an element: an object is a law or force with its type, or else an anchor."""
    if isinstance(plain, list):
        return tuple(map(_value, plain))
    if not isinstance(plain, dict):
        return plain
    values = dict(plain)
    return _element(ELEMENT_TYPES[values.pop("type")] if "type" in values else Anchor, values)


# -- options of the run -----------------------------------------------------------------------


def _request_entry(solution: SimulationResult) -> dict[str, Any] | None:
    """The options of a run as JSON, and the names of those that JSON cannot hold."""
    request = solution.request
    if request is None:
        return None
    options = {name: getattr(request, name) for name in REPEATED}
    lost = list(request.lost)
    if options.pop("controller") is not None:
        lost.append(LOST_CONTROLLER)
    if acting(options.pop("events")):
        lost.append("the actions of events")
    user = [f.name for f in solution.mechanism.forces if f.type not in FORCE_TYPES]
    lost += [f"the function of the force {name!r}" for name in user]
    method = options["method"]
    if type(method) in METHODS.values():
        values = asdict(method) | {"tableau": method.scheme.name}
        options["method"] = {"kind": type(method).__name__} | values
    elif not isinstance(method, str):
        options["method"] = None
        lost.append(f"the method {type(method).__name__}")
    tableau = options["tableau"]
    options["tableau"] = getattr(tableau, "name", tableau)
    for name in ("breakpoints", "singular_times"):
        options[name] = np.asarray(options[name], dtype=float).tolist()
    # Without its events a run does not know where one of them ended it.
    end = solution.span[1] if solution.status is RunStatus.EVENT else float(request.t_end)
    return {"t_end": end, "options": options, "lost": lost}


def _request(entry: dict[str, Any] | None) -> RunOptions | None:
    """The options in a saved run; None if it has none."""
    if entry is None:
        return None
    options = dict(entry["options"])
    if LOST_CONTROLLER in entry["lost"]:
        options["sample_time"] = None
    if isinstance(options["method"], dict):
        values = dict(options["method"])
        options["method"] = METHODS[values.pop("kind")](**values)
    return RunOptions(entry["t_end"], **options, lost=tuple(entry["lost"]))


# -- writing ----------------------------------------------------------------------------------


def save_solution(solution: SimulationResult, path: Path) -> None:
    """Write a run of one segment to ``path``; see :meth:`srm_mbs.Solution.save`.

    Raises
    ------
    InputError
        If the run used a tableau that is not in TABLEAUS, or a closure type of one's own.
    OSError
        If the file cannot be written.
    """
    path.write_bytes(_archive(solution, path))
    log.info("written: %s", path)


def save_segments(solution: SegmentedResult, path: Path) -> None:
    """Write a run of several segments to ``path``.

    Raises
    ------
    InputError, OSError
        As :func:`save_solution`.
    """
    contents = {
        "format": SEGMENTS_FORMAT,
        "count": len(solution.segments),
        "status": solution.status,
        "message": solution.message,
        "request": _request_entry(solution),
        "t_eval": None if solution.t_eval is None else solution.t_eval.tolist(),
    }
    segments = [_archive(segment, path) for segment in solution.segments]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(CONTENTS, json.dumps(contents))
        for k, segment in enumerate(segments):
            archive.writestr(f"{k}.npz", segment)
    log.info("written: %s", path)


def _archive(solution: SimulationResult, path: Path) -> bytes:
    """The ``.npz`` of a run of one segment; messages call it ``path``."""
    mechanism = solution.mechanism
    own = [loop.type_name for loop in mechanism.loops if not isinstance(loop.type, str)]
    refused = [f"closure type {name!r}" for name in own]
    if TABLEAUS.get(solution.scheme.name) is not solution.scheme:
        refused.insert(0, f"tableau {solution.scheme.name!r}")
    if refused:
        raise InputError(
            f"the {refused[0]} is not one of the package's and is not saved",
            file=str(path),
            remedy=SAVE_ARRAYS,
        )
    structure = mechanism.structure
    zones = solution.steps.zones
    meta = {
        "format": FORMAT,
        "pin": pin.__version__,
        "mechanism": {
            "name": mechanism.name,
            "source": None if mechanism.source is None else mechanism.source.entries(),
            "model": mechanism.model.saveToString() if mechanism.source is None else None,
            "loops": [_plain(loop) for loop in mechanism.loops],
            "forces": [_plain(force) for force in mechanism.forces if force.type in FORCE_TYPES],
            "drives": [_plain(drive) for drive in mechanism.drives],
            "drive_starts": _drive_starts(solution),
            "friction_speed": mechanism.friction_speed,
            "defaults": asdict(mechanism.defaults),
            "notes": mechanism.notes,
        },
        "structure": {name: getattr(structure, name) for name in STRUCTURE_VALUES}
        | {"length": structure.units.length, "rate": structure.units.rate},
        "settings": asdict(solution.settings),
        "stats": asdict(solution.stats),
        "request": _request_entry(solution),
        "status": solution.status,
        "message": solution.message,
        "zones": [[index, threshold] for index, (threshold, _) in zones.items()],
        "stop": solution.steps.stop,
        "events": None if solution.t_events is None else len(solution.t_events),
    }
    steps = solution.steps_to_save
    arrays: dict[str, Any] = {name: getattr(steps, name) for name in STEP_ARRAYS}
    for k, (_, history) in enumerate(zones.values()):
        arrays |= {f"zone_{k}_times": history.times, f"zone_{k}_values": history.values}
    found = (solution.t_events or [], solution.q_events or [], solution.v_events or [])
    for k, (times, q, v) in enumerate(zip(*found)):
        arrays |= {f"event_{k}_times": times, f"event_{k}_states": np.hstack([q, v])}
    if solution.t_eval is not None:
        arrays["t_eval"] = solution.t_eval
    if solution.held is not None:
        arrays |= {"held_times": solution.held.times, "held_values": solution.held.values}
    arrays |= {
        "attempts": solution.attempts,
        "q0": mechanism.q0,
        "v0": mechanism.v0,
        "row_scale": structure.row_scale,
        "kept": structure.kept,
        "eliminations": np.array(structure.eliminations, dtype=float).reshape(-1, 3),
        "coordinate_unit": structure.units.coordinate,
    }
    file = io.BytesIO()
    np.savez_compressed(file, meta=np.array(json.dumps(meta)), **arrays)
    return file.getvalue()


def _drive_starts(solution: SimulationResult) -> dict[str, float] | None:
    """The driven coordinates at t = 0 of a run that starts later: its q0 does not have them."""
    if solution.span[0] == 0.0:
        return None
    return {name: curve(0.0)[0] for name, curve in solution.mechanism.drive_curves.items()}


# -- reading ----------------------------------------------------------------------------------


def load_result(path: Path, types: ResultTypes[R], reach: Reach) -> R:
    """Read a saved run; see :func:`srm_mbs.load_solution`.

    Parameters
    ----------
    types
        Classes of the result.
    reach
        Where its animations may read meshes, which the file does not decide.

    Raises
    ------
    InputError
        If the file is missing, is no saved run, or is of another format.
    """
    with _naming(str(path)):
        file = io.BytesIO(path.read_bytes())
        if not zipfile.is_zipfile(file):  # NumPy would speak of pickles, and how to trust them
            raise ValueError("no archive of arrays")
        with zipfile.ZipFile(file) as archive:
            if CONTENTS in archive.namelist():
                return _segments(archive, path, types, reach)
        return _one_segment(file, types.plain, reach)


@contextmanager
def _naming(name: str) -> Iterator[None]:
    """Turns every error of reading a saved run into an :class:`InputError` about ``name``."""
    try:
        yield
    except FileNotFoundError as error:
        raise InputError("there is no such file", file=name, remedy="Check the path") from error
    except OSError as error:
        raise InputError(
            f"it cannot be read: {error.strerror or error}", file=name, remedy=SAVED_BY
        ) from error
    except InputError as error:
        raise error.located(name) from error
    except Exception as error:  # a damaged file makes NumPy and zipfile raise almost anything
        raise InputError(f"it is not a saved run: {error}", file=name, remedy=SAVED_BY) from error


def _check_format(what: str, found: int, known: int) -> None:
    if found != known:
        raise InputError(f"{what} format {found}, this version reads {known}", remedy=OTHER_VERSION)


def _segments(archive: zipfile.ZipFile, path: Path, types: ResultTypes[R], reach: Reach) -> R:
    """A run of several segments."""
    contents = json.loads(archive.read(CONTENTS))
    _check_format("its segments have", contents["format"], SEGMENTS_FORMAT)
    segments = []
    for k in range(contents["count"]):
        with _naming(f"{path}, segment {k}"):
            file = io.BytesIO(archive.read(f"{k}.npz"))
            segments.append(_one_segment(file, types.plain, reach))
    t_eval = contents["t_eval"]
    whole = types.segmented(
        segments,
        t_eval=None if t_eval is None else np.array(t_eval),
        status=contents["status"],
        message=contents["message"],
    )
    whole.request = _request(contents.get("request"))
    return whole


def _one_segment(file: io.BytesIO, result_type: type[R], reach: Reach) -> R:
    """A run of one segment."""
    with np.load(file, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    if "meta" not in arrays:
        raise ValueError(f"it has the arrays {', '.join(arrays)} only")
    meta = json.loads(str(arrays.pop("meta")))
    _check_format("it has", meta["format"], FORMAT)
    mechanism = _mechanism(meta["mechanism"], arrays, reach)
    # The analysis of the run itself, so that the dense output is the same to the last bit.
    mechanism = mechanism.with_structure(_structure(mechanism, meta["structure"], arrays))
    zones = {
        int(index): (
            float(threshold),
            MultiplierHistory(arrays[f"zone_{k}_times"], arrays[f"zone_{k}_values"]),
        )
        for k, (index, threshold) in enumerate(meta["zones"])
    }
    if arrays["attempts"].dtype != ATTEMPT:
        raise ValueError(f"attempts has the fields {arrays['attempts'].dtype}")
    steps = StepData(**{name: arrays[name] for name in STEP_ARRAYS}, zones=zones, stop=meta["stop"])
    tuples = {key: tuple(meta["settings"][key]) for key in ("atol", "singular_times")}
    settings = Settings(**meta["settings"] | tuples)
    scheme = get_tableau(settings.tableau)
    _check_shapes(mechanism, scheme, steps)
    system = make_system(mechanism, _held(arrays, mechanism.model.nv))
    solution = result_type(
        mechanism,
        system,
        scheme,
        steps,
        dense=dense_output(system, scheme, steps, settings.backend),
        t_eval=arrays.get("t_eval"),
        attempts=arrays["attempts"],
        events=_events(meta["events"], arrays),
        status=meta["status"],
        message=meta["message"],
        stats=Statistics(**meta["stats"]),
        settings=settings,
    )
    solution.request = _request(meta.get("request"))
    return solution


def _mechanism(entry: dict[str, Any], arrays: Arrays, reach: Reach) -> Mechanism:
    if entry["source"] is not None:
        gravity = tuple(entry["source"]["gravity"])
        source = Source(**entry["source"] | {"gravity": gravity, "reach": reach})
        model = rebuild(source).model
    else:
        source, model = None, pin.Model()
        model.loadFromString(entry["model"])
    mechanism = Mechanism(
        model,
        tuple(_element(LoopClosure, loop) for loop in entry["loops"]),
        q0=arrays["q0"],
        v0=arrays["v0"],
        forces=tuple(map(_value, entry["forces"])),
        drives=tuple(_element(Drive, drive) for drive in entry["drives"]),
        friction_speed=entry["friction_speed"],
        name=entry["name"],
        source=source,
        defaults=SimulationDefaults(**entry["defaults"]),
        notes=tuple(entry["notes"]),
    )
    if entry.get("drive_starts"):
        curves = _drive_curves(mechanism.drives, entry["drive_starts"])
        return mechanism.with_drive_curves(curves)
    return mechanism


def _drive_curves(drives: tuple[Drive, ...], starts: dict[str, float]) -> dict[str, Curve]:
    curves = {}
    for drive in drives:
        curve = drive.curve(starts[drive.name])
        curves[drive.name] = curve.shifted(starts[drive.name] - curve(0.0)[0])
    return curves


def _structure(mechanism: Mechanism, entry: dict[str, Any], arrays: Arrays) -> Structure:
    eliminations = arrays.get("eliminations", np.zeros((0, 3))).tolist()
    values = {name: entry[name] for name in STRUCTURE_VALUES}
    return Structure(
        row_names(mechanism),
        arrays["row_scale"],
        arrays["kept"],
        **values | {"notes": tuple(entry["notes"])},
        units=Units(entry["length"], arrays["coordinate_unit"], entry["rate"]),
        eliminations=tuple(Elimination(int(i), int(j), factor) for i, j, factor in eliminations),
    )


def _events(count: int | None, arrays: Arrays) -> tuple[list[FloatArray], list[FloatArray]] | None:
    if count is None:
        return None
    times = [arrays[f"event_{k}_times"] for k in range(count)]
    states = [arrays[f"event_{k}_states"] for k in range(count)]
    for k in range(count):
        expected = (len(times[k]), arrays["states"].shape[1])
        if times[k].ndim != 1 or states[k].shape != expected:
            raise ValueError(f"event_{k}_states has shape {states[k].shape}, not {expected}")
    return times, states


def _held(arrays: Arrays, nv: int) -> HeldForce | None:
    """The output of a sampled controller."""
    if "held_times" not in arrays:
        return None
    times, values = arrays["held_times"], arrays["held_values"]
    if values.shape != (len(times), nv) or not len(times):
        raise ValueError(f"held_values has shape {values.shape}, not {(len(times), nv)}")
    held = HeldForce()
    for t, value in zip(times.tolist(), values):
        held.hold(t, value)
    return held


def _check_shapes(mechanism: Mechanism, scheme: ButcherTableau, steps: StepData) -> None:
    """Refuse arrays that do not belong together, before anything reads them."""
    n, s = steps.count, scheme.n_stages
    nq, m = mechanism.model.nq, 2 * mechanism.model.nv
    expected = {
        "states": (n + 1, nq + m // 2),
        "sigmas": (n, s + 1),
        "ranks": (n,),
        "error_ratios": (n,),
        "placements": (n,),
        "held": (n,),
        "end_rate": (m,),
        "break_rates": (len(steps.breaks), m),
    }
    for name, shape in expected.items():
        if getattr(steps, name).shape != shape:
            raise ValueError(f"{name} has shape {getattr(steps, name).shape}, not {shape}")
    # Methods with sweeps store the extra stages of the dense output as well.
    if steps.rates.shape not in ((n, s + 1, m), (n, scheme.dense.n_rates, m)):
        raise ValueError(f"rates has shape {steps.rates.shape}, not {(n, s + 1, m)}")
    if steps.corrections.shape not in ((n, m), (n, 0)):
        raise ValueError(f"corrections has shape {steps.corrections.shape}")
    if steps.stop is not None and not (n and steps.times[-2] <= steps.stop <= steps.times[-1]):
        raise ValueError(f"the run cannot have stopped at {steps.stop!r} s")
