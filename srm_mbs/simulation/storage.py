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
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, fields
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import pinocchio as pin

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
from srm_mbs.integration.events import acting
from srm_mbs.integration.kernel.dense_output import dense_output
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
from srm_mbs.simulation.options import REPEATED, RunOptions
from srm_mbs.simulation.result import ATTEMPT, Settings, SimulationResult, Statistics
from srm_mbs.simulation.segmented_result import R, ResultTypes, SegmentedResult

_KINDS = {"PSRM": PSRM, "SRM": SRM}


def request_entry(solution: SimulationResult) -> dict[str, Any] | None:
    """The options of a run as JSON, and the names of those that JSON cannot hold."""
    request = solution.request
    if request is None:
        return None
    options = {name: getattr(request, name) for name in REPEATED}
    lost = list(request.lost)
    if options.pop("controller") is not None:
        lost.append("the controller")
    if acting(options.pop("events")):
        lost.append("the actions of events")
    user = [f.name for f in solution.mechanism.forces if f.type not in FORCE_TYPES]
    lost += [f"the function of the force {name!r}" for name in user]
    method = options["method"]
    if type(method) in _KINDS.values():
        fields = asdict(method) | {"tableau": method.scheme.name}
        options["method"] = {"kind": type(method).__name__} | fields
    elif not isinstance(method, str):
        options["method"] = None
        lost.append(f"the method {type(method).__name__}")
    tableau = options["tableau"]
    options["tableau"] = getattr(tableau, "name", tableau)
    for name in ("breakpoints", "singular_times"):
        options[name] = np.asarray(options[name], dtype=float).tolist()
    # Without its events a run does not know where one of them ended it.
    end = solution.span[1] if solution.status == "event" else float(request.t_end)
    return {"t_end": end, "options": options, "lost": lost}


def request_from(entry: dict[str, Any] | None) -> RunOptions | None:
    """The options in a saved run; None if it has none."""
    if entry is None:
        return None
    options = dict(entry["options"]) | {"controller": None, "events": None}
    if "the controller" in entry["lost"]:
        options["sample_time"] = None
    if isinstance(options["method"], dict):
        values = dict(options["method"])
        options["method"] = _KINDS[values.pop("kind")](**values)
    return RunOptions(entry["t_end"], **options, lost=tuple(entry["lost"]))


log = logging.getLogger(__name__)

FORMAT = 4
SAVED_BY = "Give a file written by solution.save or srm-mbs simulate --out"
OTHER_VERSION = "Load it with the version of srm_mbs that wrote it, or simulate again"
_STEP_ARRAYS = (
    "times",
    "states",
    "rates",
    "corrections",
    "sigmas",
    "ranks",
    "error_ratios",
    "placements",
    "held",
    "end_rate",
    "breaks",
    "break_rates",
)


def save_solution(solution: SimulationResult, path: Path | IO[bytes]) -> None:
    """Write ``solution`` to ``path``, a file name or an open file; see
    :meth:`srm_mbs.Solution.save`.

    Raises
    ------
    InputError
        If the run used a tableau that is not in TABLEAUS, or a closure type of one's own.
    OSError
        If the file cannot be written.
    """
    mechanism = solution.mechanism
    structure = mechanism.structure
    if TABLEAUS.get(solution.scheme.name) is not solution.scheme:
        raise InputError(
            f"the tableau {solution.scheme.name!r} is not one of the package's and is not saved",
            file=str(path),
            remedy="Save the arrays t, q and v instead",
        )
    for loop in mechanism.loops:
        if not isinstance(loop.type, str):
            raise InputError(
                f"the closure type {loop.type_name!r} is not one of the package's and is not saved",
                file=str(path),
                remedy="Save the arrays t, q and v instead",
            )
    zones = solution.steps.zones
    meta = {
        "format": FORMAT,
        "pin": pin.__version__,
        "mechanism": {
            "name": mechanism.name,
            "source": None if mechanism.source is None else asdict(mechanism.source),
            "model": mechanism.model.saveToString() if mechanism.source is None else None,
            "loops": [to_plain(loop) for loop in mechanism.loops],
            "forces": [force_to_plain(f) for f in mechanism.forces if f.type in FORCE_TYPES],
            "drives": [to_plain(drive) for drive in mechanism.drives],
            "drive_starts": _drive_starts(solution),
            "friction_speed": mechanism.friction_speed,
            "defaults": asdict(mechanism.defaults),
            "notes": mechanism.notes,
        },
        "structure": {
            "rank": structure.rank,
            "loop_rank": structure.loop_rank,
            "sigma_ref": structure.sigma_ref,
            "samples": structure.samples,
            "notes": structure.notes,
            "length": structure.units.length,
            "rate": structure.units.rate,
        },
        "settings": asdict(solution.settings),
        "stats": asdict(solution.stats),
        "request": request_entry(solution),
        "status": solution.status,
        "message": solution.message,
        "zones": [[index, threshold] for index, (threshold, _) in zones.items()],
        "stop": solution.steps.stop,
        "events": None if solution.t_events is None else len(solution.t_events),
    }
    steps = solution.steps_to_save
    arrays: dict[str, Any] = {name: getattr(steps, name) for name in _STEP_ARRAYS}
    for k, (_, history) in enumerate(zones.values()):
        arrays[f"zone_{k}_times"] = history.times
        arrays[f"zone_{k}_values"] = history.values
    found = (solution.t_events or [], solution.q_events or [], solution.v_events or [])
    for k, (times, q, v) in enumerate(zip(*found)):
        arrays[f"event_{k}_times"] = times
        arrays[f"event_{k}_states"] = np.hstack([q, v])
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
    opened = path.open("wb") if isinstance(path, Path) else nullcontext(path)
    with opened as file:  # given a name, numpy would append ".npz" to it
        np.savez_compressed(file, meta=np.array(json.dumps(meta)), **arrays)
    if isinstance(path, Path):
        log.info("written: %s", path)


# -- closures, forces and drives: the fields of their classes ---------------------------------
# An anchor is an object without "type", a law one with its "type"; tuples are lists.

Element = TypeVar("Element")


def to_plain(element: Any) -> dict[str, Any]:
    """The fields of a closure, force or drive as JSON has them."""
    return {key.name: _plain(getattr(element, key.name)) for key in fields(element)}


def force_to_plain(force: ForceElement) -> dict[str, Any]:
    """:func:`to_plain` of a force, with its type."""
    return {"type": force.type} | to_plain(force)


def from_plain(kind: type[Element], values: Mapping[str, Any]) -> Element:
    """The element of the class ``kind`` from what :func:`to_plain` made of it."""
    return kind(**{key: _value(value) for key, value in values.items()})


def force_from_plain(values: Mapping[str, Any]) -> ForceElement:
    """The force from what :func:`force_to_plain` made of it."""
    rest = {key: _value(value) for key, value in values.items() if key != "type"}
    return FORCE_TYPES[values["type"]](**rest)


def _plain(value: Any) -> Any:
    if isinstance(value, Law):
        return {"type": value.type} | asdict(value)  # type: ignore[call-overload]
    if isinstance(value, Anchor):
        return asdict(value)
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


def _value(plain: Any) -> Any:
    if isinstance(plain, list):
        return tuple(map(_value, plain))
    if not isinstance(plain, Mapping):
        return plain
    if "type" not in plain:
        return Anchor(**plain)
    values = dict(plain)
    return LAW_TYPES[values.pop("type")](**values)


def _drive_starts(solution: SimulationResult) -> dict[str, float] | None:
    """The driven coordinates at t = 0 of a run that starts later: its q0 does not have them."""
    if solution.span[0] == 0.0:
        return None
    return {name: curve(0.0)[0] for name, curve in solution.mechanism.drive_curves.items()}


def _drive_curves(drives: tuple[Drive, ...], starts: dict[str, float]) -> dict[str, Curve]:
    curves = {}
    for drive in drives:
        curve = drive.curve(starts[drive.name])
        curves[drive.name] = curve.shifted(starts[drive.name] - curve(0.0)[0])
    return curves


def _mechanism(entry: dict[str, Any], arrays: dict[str, FloatArray]) -> Mechanism:
    if entry["source"] is not None:
        source = Source(**entry["source"] | {"gravity": tuple(entry["source"]["gravity"])})
        base = rebuild(source)
        model = base.model
    else:
        source, model = None, pin.Model()
        model.loadFromString(entry["model"])
    mechanism = Mechanism(
        model,
        tuple(from_plain(LoopClosure, loop) for loop in entry["loops"]),
        q0=arrays["q0"],
        v0=arrays["v0"],
        forces=tuple(force_from_plain(force) for force in entry["forces"]),
        drives=tuple(from_plain(Drive, drive) for drive in entry["drives"]),
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


def _events(
    count: int | None, arrays: dict[str, FloatArray]
) -> tuple[list[FloatArray], list[FloatArray]] | None:
    if count is None:
        return None
    times = [arrays[f"event_{k}_times"] for k in range(count)]
    states = [arrays[f"event_{k}_states"] for k in range(count)]
    for k in range(count):
        expected = (len(times[k]), arrays["states"].shape[1])
        if times[k].ndim != 1 or states[k].shape != expected:
            raise ValueError(f"event_{k}_states has shape {states[k].shape}, not {expected}")
    return times, states


def _held(arrays: dict[str, FloatArray], nv: int) -> HeldForce | None:
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


def _check_shapes(mechanism: Mechanism, tableau: str, steps: StepData) -> None:
    """Refuse arrays that do not belong together, before anything reads them."""
    n, s = steps.count, get_tableau(tableau).n_stages
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
    if steps.rates.shape not in ((n, s + 1, m), (n, get_tableau(tableau).dense.n_rates, m)):
        raise ValueError(f"rates has shape {steps.rates.shape}, not {(n, s + 1, m)}")
    if steps.corrections.shape not in ((n, m), (n, 0)):
        raise ValueError(f"corrections has shape {steps.corrections.shape}")
    if steps.stop is not None and not (n and steps.times[-2] <= steps.stop <= steps.times[-1]):
        raise ValueError(f"the run cannot have stopped at {steps.stop!r} s")


def load_result(path: Path, types: ResultTypes[R]) -> R:
    """Read a saved run; see :func:`srm_mbs.load_solution`.

    Parameters
    ----------
    types
        Classes of the result.

    Raises
    ------
    InputError
        If the file is missing, is no saved run, or is of another format.
    """
    segments = load_segments(path, types) if path.is_file() else None
    return load_plain(path, str(path), types.plain) if segments is None else segments


def load_plain(path: Path | IO[bytes], name: str, result_type: type[R]) -> R:
    """A run without segments from a file name or an open file, which messages call ``name``.

    Raises
    ------
    InputError
        As :func:`load_result`.
    """
    try:
        opened = path.open("rb") if isinstance(path, Path) else nullcontext(path)
        with opened as source:
            if not zipfile.is_zipfile(
                source
            ):  # NumPy would speak of pickles, and how to trust them
                raise ValueError("no archive of arrays")
            source.seek(0)
            with np.load(source, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        meta = json.loads(str(arrays.pop("meta")))
        if meta["format"] != FORMAT:
            raise InputError(
                f"it has format {meta['format']}, this version reads {FORMAT}",
                file=name,
                remedy=OTHER_VERSION,
            )
        mechanism = _mechanism(meta["mechanism"], arrays)
        structure = meta["structure"]
        # The analysis of the run itself, so that the dense output is the same to the last bit.
        analysis = Structure(
            row_names(mechanism),
            arrays["row_scale"],
            arrays["kept"],
            structure["rank"],
            structure["loop_rank"],
            structure["sigma_ref"],
            Units(structure["length"], arrays["coordinate_unit"], structure["rate"]),
            structure["samples"],
            tuple(structure["notes"]),
            tuple(
                Elimination(int(row), int(other), factor)
                for row, other, factor in arrays.get("eliminations", np.zeros((0, 3))).tolist()
            ),
        )
        mechanism = mechanism.with_structure(analysis)
        zones = {
            int(index): (
                float(threshold),
                MultiplierHistory(arrays[f"zone_{k}_times"], arrays[f"zone_{k}_values"]),
            )
            for k, (index, threshold) in enumerate(meta["zones"])
        }
        if arrays["attempts"].dtype != ATTEMPT:
            raise ValueError(f"attempts has the fields {arrays['attempts'].dtype}")
        steps = StepData(
            **{name: arrays[name] for name in _STEP_ARRAYS}, zones=zones, stop=meta["stop"]
        )
        _check_shapes(mechanism, meta["settings"]["tableau"], steps)
        tuples = {key: tuple(meta["settings"][key]) for key in ("atol", "singular_times")}
        settings = Settings(**meta["settings"] | tuples)
        system = make_system(mechanism, _held(arrays, mechanism.model.nv))
        scheme = get_tableau(settings.tableau)
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
        solution.request = request_from(meta.get("request"))
        return solution
    except FileNotFoundError as error:
        raise InputError("there is no such file", file=name, remedy="Check the path") from error
    except OSError as error:
        raise InputError(
            f"it cannot be read: {error.strerror or error}", file=name, remedy=SAVED_BY
        ) from error
    except InputError as error:
        raise error.located(name) from error
    except Exception as error:  # a damaged file makes NumPy and zipfile raise almost anything
        raise InputError(
            f"it is not a saved run: {error}",
            file=name,
            remedy=SAVED_BY,
        ) from error


CONTENTS = "segments.json"
SEGMENTS_FORMAT = 1


def save_segments(solution: SegmentedResult, path: Path) -> None:
    """Write ``solution`` to ``path``.

    Raises
    ------
    InputError
        As :func:`srm_mbs.simulation.storage.save_solution`.
    OSError
        If the file cannot be written.
    """
    contents = {
        "format": SEGMENTS_FORMAT,
        "count": len(solution.segments),
        "status": solution.status,
        "message": solution.message,
        "request": request_entry(solution),
        "t_eval": None if solution.t_eval is None else solution.t_eval.tolist(),
    }
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(CONTENTS, json.dumps(contents))
        for k, segment in enumerate(solution.segments):
            kept = io.BytesIO()
            save_solution(segment, kept)
            archive.writestr(f"{k}.npz", kept.getvalue())


def load_segments(path: Path, types: ResultTypes[R]) -> R | None:
    """The run in ``path``; None if it is no archive of segments.

    Raises
    ------
    InputError
        If it is one, but damaged or of another format.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            segmented = CONTENTS in archive.namelist()
    except Exception:  # what is damaged is named by the reader of plain runs
        return None
    if not segmented:
        return None
    with zipfile.ZipFile(path) as archive:
        try:
            contents = json.loads(archive.read(CONTENTS))
            if contents["format"] != SEGMENTS_FORMAT:
                raise InputError(
                    f"its segments have format {contents['format']}, this version reads {FORMAT}",
                    remedy=OTHER_VERSION,
                )
            t_eval = contents["t_eval"]
            whole = types.segmented(
                [
                    load_plain(
                        io.BytesIO(archive.read(f"{k}.npz")), f"{path}, segment {k}", types.plain
                    )
                    for k in range(contents["count"])
                ],
                t_eval=None if t_eval is None else np.array(t_eval),
                status=contents["status"],
                message=contents["message"],
            )
            whole.request = request_from(contents.get("request"))
            return whole
        except InputError as error:
            raise error.located(str(path)) from error
        except Exception as error:
            raise InputError(
                f"it is not a saved run: {error}", file=str(path), remedy=SAVED_BY
            ) from error
