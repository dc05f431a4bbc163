"""Saved runs: one ``.npz`` with everything needed to interpolate, replay and plot a run.

Arrays are stored as they are; the rest (description, URDF, closures, settings, options of the run
but Python functions) as one JSON text.  Nothing is pickled.  A run of several segments is one
archive of the files of its segments.

Format 5 holds a model made in Python as data (:mod:`srm_mbs.model.model_data`); format 4, which is
read as well, as Pinocchio's archive.  :mod:`srm_mbs.simulation.saved_run` checks what is read.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import pinocchio as pin

from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.errors import InputError, get_logger, joined_names
from srm_mbs.formats.archive import (
    LARGEST_CONTENT,
    LARGEST_RATIO,
    MOST_MEMBERS,
    USUAL_CONTENT,
    Archive,
    content_of,
    json_object,
)
from srm_mbs.formats.build import rebuild
from srm_mbs.formats.files import file_name, open_regular, writing
from srm_mbs.integration.dense_output import StepData
from srm_mbs.integration.driver import RunStatus
from srm_mbs.integration.events import acting
from srm_mbs.integration.kernel.dense_output import dense_output
from srm_mbs.integration.methods.psrm import PSRM
from srm_mbs.integration.methods.tableaus import TABLEAUS, get_tableau
from srm_mbs.integration.methods.thesis.srm import SRM
from srm_mbs.model.actuators import Actuator
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.drives import Drive
from srm_mbs.model.forces import FORCE_TYPES, ForceElement, UserForce
from srm_mbs.model.laws import Curve, Law, Samples, is_of_package
from srm_mbs.model.mechanism import SimulationDefaults, Source, SourceTexts
from srm_mbs.model.model_data import model_from_data, model_to_data
from srm_mbs.model.pinocchio_archive import model_from_archive
from srm_mbs.model.reach import Reach
from srm_mbs.simulation import saved_run
from srm_mbs.simulation.options import REPEATED, RunOptions
from srm_mbs.simulation.result import KnownRunData, Settings, SimulationResult, Statistics
from srm_mbs.simulation.saved_run import Arrays
from srm_mbs.simulation.segmented_result import R, ResultTypes, SegmentedResult

log = get_logger(__name__)

FORMAT = 5
ARCHIVED_MODEL_FORMAT = 4
"""The format that holds models made in Python as archives of Pinocchio."""
SEGMENTS_FORMAT = 1
CONTENTS = "segments.json"
"""Entry of an archive of segments that describes the whole run."""
SAVED_BY = "Give a file written by solution.save or srm-mbs simulate --out"
OTHER_VERSION = "Load it with the version of srm_mbs that wrote it, or simulate again"
SAVE_ARRAYS = "Save the arrays t, q and v instead"
LOST_CONTROLLER = "the controller"
METHODS = {"PSRM": PSRM, "SRM": SRM}
"""Methods that are saved, by their kind."""
STEP_ARRAYS = tuple(key.name for key in fields(StepData) if key.name not in ("zones", "stop"))
STRUCTURE_VALUES = ("rank", "loop_rank", "sigma_ref", "samples", "notes")
"""Fields of :class:`Structure` that are neither arrays nor names of rows."""


# -- elements: closures, forces, drives, laws and anchors as JSON -----------------------------


def _plain(value: Any) -> Any:
    """An element as an object of its fields, tuples as lists."""
    if is_dataclass(value):
        kind: dict[str, Any] = {"type": value.type} if isinstance(value, Law | ForceElement) else {}
        return kind | {key.name: _plain(getattr(value, key.name)) for key in fields(value)}
    return [_plain(part) for part in value] if isinstance(value, tuple | Samples) else value


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


def _request(entry: saved_run.RequestEntry | None) -> RunOptions | None:
    """The options in a saved run; None if it has none."""
    if entry is None:
        return None
    options = entry.options.model_dump()
    if LOST_CONTROLLER in entry.lost:
        options["sample_time"] = None
    if isinstance(options["method"], dict):
        values = dict(options["method"])
        options["method"] = METHODS[values.pop("kind")](**values)
    return RunOptions(entry.t_end, **options, lost=tuple(entry.lost))


def _settings_entry(settings: Settings) -> dict[str, Any]:
    """The settings as JSON, without what the steps tell."""
    entry = asdict(settings)
    del entry["stiff"]
    return entry


# -- writing ----------------------------------------------------------------------------------


def save_solution(solution: SimulationResult, path: Path, full_paths: bool) -> None:
    """Write a run of one segment to ``path``; see :meth:`srm_mbs.Solution.save`.

    Raises
    ------
    InputError
        If the run used a tableau that is not in TABLEAUS, or a closure type of one's own; if it is
        too large to be read again.
    OSError
        If the file cannot be written; the file that was there is then as it was.
    """
    (segment,) = _packed([_run_arrays(solution, path, full_paths)], path)
    with writing(path) as file:
        file.write(segment)
    log.info("written: %s", path)


def save_segments(solution: SegmentedResult, path: Path, full_paths: bool) -> None:
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
    segments = _packed(
        [_run_arrays(segment, path, full_paths) for segment in solution.segments], path
    )
    with writing(path) as file, zipfile.ZipFile(file, "w") as archive:
        archive.writestr(CONTENTS, json.dumps(contents, default=float))
        for k, segment in enumerate(segments):
            archive.writestr(f"{k}.npz", segment)
    log.info("written: %s", path)


def _packed(segments: Sequence[dict[str, Any]], path: Path) -> list[bytes]:
    """The ``.npz`` of each segment, from its arrays; compressed, unless they compress so far that
    reading takes them for an attack."""
    # What is in an archive inside another counts twice.
    content = 2 * sum(map(content_of, segments))
    if content > LARGEST_CONTENT or max(map(len, (*segments, segments))) > MOST_MEMBERS:
        raise InputError(
            f"the run has {content / 2e6:.0f} MB in {len(segments)} segments, more than is read",
            file=str(path),
            remedy=SAVE_ARRAYS,
        )
    packed = [_npz(arrays, np.savez_compressed) for arrays in segments]
    if content > max(USUAL_CONTENT, LARGEST_RATIO * sum(map(len, packed))):
        packed = [_npz(arrays, np.savez) for arrays in segments]
    return packed


def _npz(arrays: dict[str, Any], write: Any) -> bytes:
    file = io.BytesIO()
    write(file, **arrays)
    return file.getvalue()


def _source_entry(source: Source, full_paths: bool) -> dict[str, Any]:
    """``source`` as JSON, without the folders that its files lay in unless asked for."""
    entry = source.entries()
    if not full_paths:
        entry |= {key: source.without_folders(entry[key]) for key in ("description", "urdf")}
        entry |= {key: file_name(entry[key]) for key in ("path", "urdf_path")}
    return entry


def _notes(mechanism: Mechanism, full_paths: bool) -> list[str]:
    source, notes = mechanism.source, list(mechanism.notes)
    if source is not None and not full_paths:
        notes = list(map(source.without_folders, notes))
    lost = [repr(force.name) for force in mechanism.forces if isinstance(force, UserForce)]
    if lost:
        notes.append(
            f"functions of the user are not saved, so that these forces do not act: "
            f"{joined_names(lost)}"
        )
    return notes


def _with_own_laws(mechanism: Mechanism) -> Iterator[Drive | ForceElement]:
    """The drives and forces whose laws are those of the user."""
    parts: tuple[Drive | ForceElement, ...] = (*mechanism.drives, *mechanism.forces)
    for part in parts:
        law = getattr(part, "law", None)
        laws = law if isinstance(law, tuple) else () if law is None else (law,)
        if not all(map(is_of_package, laws)):
            yield part


def _run_arrays(solution: SimulationResult, path: Path, full_paths: bool) -> dict[str, Any]:
    """The arrays of a run of one segment, its JSON text among them; messages call it ``path``."""
    mechanism = solution.mechanism
    own = [loop.type_name for loop in mechanism.loops if not isinstance(loop.type, str)]
    refused = [f"closure type {name!r}" for name in own]
    refused += [f"law of {part.name!r}" for part in _with_own_laws(mechanism)]
    if TABLEAUS.get(solution.scheme.name) is not solution.scheme:
        refused.insert(0, f"tableau {solution.scheme.name!r}")
    if refused:
        raise InputError(
            f"the {refused[0]} is not one of the package's and is not saved",
            file=str(path),
            remedy=SAVE_ARRAYS,
        )
    structure, source = mechanism.structure, mechanism.source
    zones = solution.steps.zones
    meta = {
        "format": FORMAT,
        "pin": pin.__version__,
        "mechanism": {
            "name": mechanism.name,
            "source": None if source is None else _source_entry(source, full_paths),
            "model": model_to_data(mechanism.model) if source is None else None,
            "loops": [_plain(loop) for loop in mechanism.loops],
            "forces": [_plain(force) for force in mechanism.forces if force.type in FORCE_TYPES],
            "drives": [_plain(drive) for drive in mechanism.drives],
            "drive_starts": _drive_starts(solution),
            "friction_speed": mechanism.friction_speed,
            "defaults": asdict(mechanism.defaults),
            "notes": _notes(mechanism, full_paths),
            "points": {name: _plain(anchor) for name, anchor in mechanism.points.items()},
            "actuators": {name: _plain(one) for name, one in mechanism.actuators.items()},
        },
        "structure": {name: getattr(structure, name) for name in STRUCTURE_VALUES}
        | {"length": structure.units.length, "rate": structure.units.rate},
        "settings": _settings_entry(solution.settings),
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
    return {"meta": np.array(json.dumps(meta, default=float)), **arrays}


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
        If the file is missing, is no saved run, is of another format, or unpacks to more than
        :mod:`srm_mbs.formats.archive` allows.
    """
    with _naming(str(path)), open_regular(path, LARGEST_CONTENT, SAVED_BY) as file:
        return load_from(file, path, types, reach)


def load_from(file: IO[bytes], path: Path, types: ResultTypes[R], reach: Reach) -> R:
    """The result that :func:`load_result` reads, from an open file; ``path`` names it, and its
    folder is searched for meshes."""
    with _naming(str(path)):
        archive = Archive(file)
        if CONTENTS in archive.names:
            return _segments(archive, path, types, reach)
        return run_from(archive.arrays(), path, types.plain, reach)


@contextmanager
def _naming(name: str) -> Iterator[None]:
    """Turns every error of reading a saved run into an :class:`InputError` about ``name``."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"it cannot be read: {error.strerror or error}", file=name, remedy=SAVED_BY
        ) from error
    except InputError as error:
        raise error.located(name) from error
    except Exception as error:  # a damaged file makes NumPy and zipfile raise almost anything
        raise InputError(f"it is not a saved run: {error}", file=name, remedy=SAVED_BY) from error


def _check_format(what: str, found: Any, known: tuple[int, ...]) -> None:
    if type(found) is not int or found not in known:
        readable = " and ".join(map(str, sorted(known)))
        raise InputError(
            f"{what} format {str(found)[:20]}, this version reads {readable}",
            remedy=OTHER_VERSION,
        )


def _segments(archive: Archive, path: Path, types: ResultTypes[R], reach: Reach) -> R:
    """A run of several segments."""
    contents = json_object(archive.read(CONTENTS), CONTENTS)
    _check_format("its segments have", contents.get("format"), (SEGMENTS_FORMAT,))
    entry = saved_run.checked_entry(saved_run.SegmentsEntry, contents)
    if entry.count != len(archive.names) - 1:
        raise ValueError(f"it has {len(archive.names) - 1} segments, not {entry.count}")
    budget = archive.budget - archive.content
    segments: list[R] = []
    for k in range(entry.count):
        with _naming(f"{path}, segment {k}"):
            inner = Archive(io.BytesIO(archive.read(f"{k}.npz")), budget)
            budget -= inner.content
            segments.append(run_from(inner.arrays(), path, types.plain, reach))
            _check_continues(segments)
    start = float(segments[0].steps.times[0])
    t_eval = None
    if entry.t_eval is not None:
        t_eval = saved_run.output_times_from({"t_eval": np.array(entry.t_eval, float)}, start)
    whole = types.segmented(segments, t_eval=t_eval, status=entry.status, message=entry.message)
    whole.request = _request(entry.request)
    return whole


def _check_continues(segments: Sequence[SimulationResult]) -> None:
    """Refuse a last segment that is not one of the same run as the first, after the one before."""
    first, last = segments[0], segments[-1]
    sizes = [
        (
            segment.mechanism.model.nq,
            segment.mechanism.model.nv,
            segment.scheme.name,
            None if segment.t_events is None else len(segment.t_events),
        )
        for segment in (first, last)
    ]
    if sizes[0] != sizes[1]:
        raise ValueError("it has another model, tableau or number of events than the first segment")
    if len(segments) > 1 and last.span[0] < segments[-2].span[1]:
        raise ValueError("it begins before the end of the segment before it")


def run_from(arrays: Arrays, path: Path, result_type: type[R], reach: Reach) -> R:
    """The run of one segment in the ``arrays`` of the file ``path``.

    Raises
    ------
    InputError, ValueError
        If they are none.
    """
    if "meta" not in arrays:
        raise ValueError(f"it has the arrays {', '.join(arrays)[:200]} only")
    text = arrays["meta"]
    if text.dtype.kind != "U" or text.shape != ():
        raise ValueError("meta is no text")
    meta = json_object(str(text[()]), "meta")
    _check_format("it has", meta.get("format"), (FORMAT, ARCHIVED_MODEL_FORMAT))
    entry = saved_run.checked_entry(saved_run.RunEntry, meta)
    mechanism = _mechanism(entry, arrays, path, reach)
    # The analysis of the run itself, so that the dense output is the same to the last bit.
    structure = saved_run.structure_from(mechanism, entry.structure, arrays)
    mechanism = mechanism.with_structure(structure)
    settings = Settings(
        **entry.settings.model_dump()
        | {key: tuple(getattr(entry.settings, key)) for key in ("atol", "singular_times")}
    )
    if len(settings.atol) not in (1, 2 * mechanism.model.nv):
        raise ValueError(f"settings.atol has {len(settings.atol)} numbers")
    scheme = get_tableau(settings.tableau)
    steps = saved_run.steps_from(mechanism, scheme, entry, arrays)
    settings = replace(settings, stiff=tuple(steps.stiff_intervals))
    events = saved_run.events_from(mechanism.model, entry.events, steps, arrays)
    system = make_system(mechanism, saved_run.held_from(arrays, mechanism.model.nv))
    saved_run.check_steps_join(system, scheme, steps)
    dense = dense_output(system, scheme, steps, settings.backend)
    dense.file = str(path)
    solution = result_type(
        mechanism,
        system,
        scheme,
        KnownRunData(
            steps,
            dense,
            saved_run.attempts_from(arrays),
            entry.message,
            Statistics(**entry.stats.model_dump()),
            settings,
        ),
        t_eval=saved_run.output_times_from(arrays, float(steps.times[0])),
        events=events,
        status=entry.status,
    )
    solution.request = _request(entry.request)
    return solution


def _model_of(entry: saved_run.RunEntry) -> pin.Model:
    """The model of a mechanism made in Python."""
    model = entry.mechanism.model
    if entry.format == ARCHIVED_MODEL_FORMAT and isinstance(model, str):
        return model_from_archive(model)
    if entry.format == FORMAT and isinstance(model, dict):
        return model_from_data(model)
    raise ValueError("it has neither the source of its mechanism nor its model")


def _source(entry: saved_run.SourceEntry, path: Path, reach: Reach) -> Source:
    """The source of the mechanism in the file ``path``: its meshes are looked for beside that
    file, wherever the URDF lay when it was written."""
    values = entry.model_dump() | {
        "gravity": tuple(entry.gravity),
        "urdf_path": str(path.parent / file_name(entry.urdf_path)),
        "reach": reach,
    }
    texts = SourceTexts(values.pop("description"), values.pop("urdf"))
    return Source(texts, **values)


def _mechanism(run: saved_run.RunEntry, arrays: Arrays, path: Path, reach: Reach) -> Mechanism:
    entry = run.mechanism
    source = None if entry.source is None else _source(entry.source, path, reach)
    model = _model_of(run) if source is None else rebuild(source).model
    q0, v0 = saved_run.checked_start(arrays, model)
    forces = tuple(map(saved_run.value_of, entry.forces))
    if not all(isinstance(force, ForceElement) for force in forces):
        raise ValueError("one of its forces is no force")
    mechanism = Mechanism(
        model,
        tuple(saved_run.element(LoopClosure, loop) for loop in entry.loops),
        q0=q0,
        v0=v0,
        forces=forces,
        drives=tuple(saved_run.element(Drive, drive) for drive in entry.drives),
        friction_speed=entry.friction_speed,
        name=entry.name,
        source=source,
        defaults=SimulationDefaults(**entry.defaults.model_dump()),
        notes=tuple(entry.notes),
        points={name: saved_run.element(Anchor, point) for name, point in entry.points.items()},
        actuators={name: saved_run.element(Actuator, a) for name, a in entry.actuators.items()},
    )
    if entry.drive_starts:
        return mechanism.with_drive_curves(_drive_curves(mechanism.drives, entry.drive_starts))
    return mechanism


def _drive_curves(drives: tuple[Drive, ...], starts: dict[str, float]) -> dict[str, Curve]:
    curves = {}
    for drive in drives:
        if drive.name not in starts:
            raise ValueError(f"drive_starts lacks the drive {drive.name!r}")
        curve = drive.curve(starts[drive.name])
        curves[drive.name] = curve.shifted(starts[drive.name] - curve(0.0)[0])
    return curves
