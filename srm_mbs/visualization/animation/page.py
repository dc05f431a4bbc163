"""The page that plays a motion: meshcat's viewer with a panel of values and a bar of controls.

:func:`page_data` computes the values over time, the singular passages and the notes; with them
:func:`make_page` fills the files of the folder ``web`` into one self-contained page.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import is_angle, row_dimensions
from srm_mbs.errors import get_logger, unwritable
from srm_mbs.formats.files import write_bytes
from srm_mbs.integration.singular_passages import Crossing
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.animation.crank_motion import CrankMark, CrankPositions
from srm_mbs.visualization.animation.meshcat_scene import (
    BACKGROUNDS,
    import_meshcat,
    node_names,
)
from srm_mbs.visualization.animation.scene import (
    ASPECT,
    FIELD_OF_VIEW,
    Picture,
    points_in_view,
)
from srm_mbs.visualization.animation.trajectory import DrawableMotion
from srm_mbs.visualization.joint_components import components

log = get_logger(__name__)

FOLDER = Path(__file__).with_name("web")

MAX_SAMPLES = 3000
"""Times at which the values are sampled: some 100 kB in a page."""
MAX_JOINT_NUMBERS = 24_000
"""Positions and rates of all joints together: some 200 kB in a page."""
FEWEST_JOINT_SAMPLES = 50
"""Times of the positions and rates of mechanisms of very many joints."""
SCRIPTS = (
    *("page.js", "arrows.js", "bodies.js", "crank.js", "curves.js", "passages.js", "ground.js"),
)
"""Files of :data:`FOLDER` that are the script of the page, in this order."""
GROUND_GAP = 2e-3
"""Distance of the ground from the lowest point of the motion, over the height of the picture."""
NAMED_LOOPS, NAMED_PASSAGES = 12, 100
"""Numbers of loops and of passages up to which the passages name their loops."""
CRANK_STEPS = 360
"""Steps of the arrow keys in a motion back and forth of a crank; of a turn they are degrees."""
DRIFT, ENERGY = "drift |g|", "energy change"
BETWEEN_STEPS = f"{DRIFT} between steps"
"""Drift of the dense output, which the page shows: at steps it is smaller."""
FLOAT32_ARRAY = 0x17
"""Type of an array of single precision in the MessagePack of msgpack-lite, with which meshcat
reads."""
DIGITS = 4
"""Significant digits of a value in the page, which shows three; and of its range, for curves."""
CONSTANT = 1e-9
"""Range of a value, over its size, that is rounding."""


def page_data(motion: DrawableMotion, picture: Picture, *, panel: bool = True) -> dict[str, Any]:
    """The data of the panel and the bar, ready for JSON.

    Parameters
    ----------
    motion
        A run, or a prescribed motion, which has no values.
    picture
        Its picture.
    panel
        Whether the page shows the values and passages; otherwise they are not computed.

    Returns
    -------
    dict
        Those of :func:`values_over_time` or :func:`values_over_crank`, and ``start`` (s),
        ``panel``, ``notes``, ``arrows``, ``bodies`` with the name of each node that has shapes,
        ``ground``, ``aspect``, ``ends`` and ``background``.
    """
    times = picture.motion.times
    data: dict[str, Any] = {"times": [], "joint_times": [], "values": [], "passages": []}
    if panel and isinstance(motion, SimulationResult):
        data = values_over_time(motion, times)
    elif panel and isinstance(motion, CrankPositions):
        data = values_over_crank(motion)
    return data | {
        "start": float(times[0]),
        "panel": panel,
        "notes": picture.overlays.notes + _hint(motion, panel=panel),
        "arrows": _arrows(picture),
        "bodies": _bodies(picture) if panel else [],
        "ground": _ground(picture) if panel else None,
        "aspect": ASPECT,
        "ends": picture.view.ends,
        "background": BACKGROUNDS,
    }


def _hint(motion: DrawableMotion, *, panel: bool) -> list[dict[str, Any]]:
    by_hand = panel and isinstance(motion, CrankPositions)
    return [{"text": "drag a body or the slider"}] if by_hand else []


def _ground(picture: Picture) -> dict[str, Any] | None:
    """The plane below the motion, perpendicular to gravity; None without gravity.

    ``up`` is its normal, ``height`` (m) its coordinate along ``up``, and ``size`` (m) that of the
    picture.
    """
    gravity = np.array(picture.mechanism.model.gravity.linear)
    size = float(np.linalg.norm(gravity))
    points = points_in_view(picture.visuals, picture.motion)
    if not size or not len(points):
        return None
    up = -gravity / size
    width = 2.0 * picture.view.distance * math.tan(math.radians(0.5 * FIELD_OF_VIEW))
    # Not within the shapes that lie on it.
    height = float((points @ up).min()) - GROUND_GAP * width
    return {"up": up.tolist(), "height": height, "size": width}


def _arrows(picture: Picture) -> dict[str, Any] | None:
    arrows = picture.overlays.arrows
    return None if arrows is None else arrows.data(node_names(picture.mechanism))


def _bodies(picture: Picture) -> list[dict[str, str]]:
    """The nodes of the page that have shapes, with the names of their links."""
    model = picture.mechanism.model
    links: dict[int, list[str]] = {}
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY:
            links.setdefault(int(frame.parentJoint), []).append(frame.name)
    nodes = node_names(picture.mechanism)
    joints = sorted({visual.joint for visual in picture.visuals})
    # A model without links has joints only.
    named = {joint: ", ".join(links.get(joint, [nodes[joint]])) for joint in joints}
    return [{"node": nodes[joint], "name": name} for joint, name in named.items()]


def values_over_time(solution: SimulationResult, times: FloatArray) -> dict[str, Any]:
    """Drift, energy and sigma of a run at the ``times`` (n,) s of its key frames, and the positions
    and rates of its joints.

    Returns
    -------
    dict
        ``times`` and ``joint_times`` (s), and ``values``, each with ``label``, ``unit`` and
        ``samples``, null where they are not finite.  Values of a joint have ``body``, the node of
        the body that it moves, and are sampled at ``joint_times``, the others at ``times``.
        ``passages``, each with ``time`` (s) and ``text``.
    """
    crossings = solution.crossings
    few = len(solution.mechanism.loops) <= NAMED_LOOPS and len(crossings) <= NAMED_PASSAGES
    passages = [
        {"time": crossing.time, "text": _passage_text(crossing, named=few)}
        for crossing in crossings
    ]
    if len(times) > MAX_SAMPLES:
        times = np.linspace(times[0], times[-1], MAX_SAMPLES)
    times = np.union1d(times, [crossing.time for crossing in crossings])
    run = solution.at(times)
    unit = drift_unit(solution)
    values = []

    def add(label: str, unit: str, samples: FloatArray, **more: str) -> None:
        values.append({"label": label, "unit": unit, "samples": _rounded(samples)} | more)

    with np.errstate(over="ignore", invalid="ignore"):
        if unit:
            add(BETWEEN_STEPS, unit, run.drift[:, 0])
        add(ENERGY, "J", run.energy - solution.at(times[:1]).energy)
        if unit and solution.steps.count:
            add("sigma", "", sigma_at(solution, times))
        joint_times = _joint_times(solution.mechanism, times)
        run = run if joint_times is times else solution.at(joint_times)
        for joint, node in zip(solution.mechanism.joint_names, node_names(solution.mechanism)[1:]):
            for part in components(run, joint):
                for k, axis in enumerate(part.names):
                    label = " ".join(word for word in (joint, part.part, axis) if word)
                    add(label, part.unit, part.positions[:, k], body=node)
                    add(f"{label} rate", f"{part.unit}/s", part.rates[:, k], body=node)
    seconds, joint_seconds = (
        [float(f"{t:.9g}") for t in some.tolist()] for some in (times, joint_times)
    )
    return {
        "times": seconds,
        "joint_times": joint_seconds,
        "values": values,
        "passages": passages,
    }


def _rounded(samples: FloatArray) -> list[float | None]:
    known = samples[np.isfinite(samples)]
    size, extent = np.abs(known).max(initial=0.0), np.ptp(known) if len(known) else 0.0
    digits = DIGITS
    if extent > CONSTANT * size:
        digits += max(0, math.ceil(math.log10(size / extent)))
    return [float(f"{x:.{digits}g}") if math.isfinite(x) else None for x in samples.tolist()]


def values_over_crank(motion: CrankPositions) -> dict[str, Any]:
    """The position of the crank, the transmission angle, and positions and rates of the joints.

    Returns
    -------
    dict
        As :func:`values_over_time`, angles in degrees, and ``crank`` with ``label``, ``unit``,
        ``samples`` at ``times``, ``start`` (s) of the initial configuration, ``step`` (s) of an
        arrow key, and whether the motion is ``closed``.
    """
    model = motion.mechanism.model
    names = [name for name in motion.mechanism.joint_names if motion.mechanism.joint(name).nv == 1]
    numbers = 2 * len(names) * len(motion.t)
    kept = slice(None, None, math.ceil(numbers / (2 * MAX_JOINT_NUMBERS)))
    times = motion.t[kept].tolist()

    def in_unit(name: str) -> tuple[str, float]:
        return ("°", math.degrees(1.0)) if is_angle(model, name) else ("m", 1.0)

    unit, factor = in_unit(motion.crank)
    values: list[dict[str, Any]] = []
    if motion.transmission_angle is not None:
        angle = _rounded(np.degrees(motion.transmission_angle[kept]))
        values.append({"label": "transmission angle", "unit": "°", "samples": angle})
    for name, node in zip(motion.mechanism.joint_names, node_names(motion.mechanism)[1:]):
        if name not in names:
            continue
        own, scale = in_unit(name)
        position, rate = (
            scale * motion.track(name),
            motion.rates[:, motion.mechanism.joint(name).idx_v],
        )
        values.append(
            {"label": name, "unit": own, "samples": _rounded(position[kept]), "body": node}
        )
        if name != motion.crank:
            samples = _rounded(rate[kept] * scale / factor)
            per = "" if own == unit else f"{own}/{unit}"
            label = f"{name} per {motion.crank}"
            values.append({"label": label, "unit": per, "samples": samples, "body": node})
    # A crank that turns begins at a whole turn, which is written as 0.
    position = motion.positions - motion.positions[0] if motion.turns else motion.positions
    turns = round(np.ptp(motion.positions) / (2.0 * np.pi)) if motion.turns else 1
    return {
        "times": times,
        "joint_times": times,
        "values": values,
        "passages": [
            {"time": mark.time, "text": _mark_text(mark, motion, factor, unit)}
            for mark in motion.marks
        ],
        "crank": {
            "label": motion.crank,
            "unit": unit,
            "times": times,
            "samples": (factor * position[kept]).tolist(),
            "start": motion.start,
            "step": float(motion.t[-1]) / (CRANK_STEPS * turns),
            "closed": motion.closed,
        },
    }


def _mark_text(mark: CrankMark, motion: CrankPositions, factor: float, unit: str) -> str:
    position = mark.position - motion.positions[0] * motion.turns
    at = f"{motion.crank} = {factor * position:.4g}{'' if unit == '°' else ' '}{unit}"
    if mark.loops:
        return f"singular configuration at {at}: {', '.join(mark.loops)}"
    return f"dead point at {at}: {motion.crank} turns back"


def _joint_times(mechanism: Mechanism, times: FloatArray) -> FloatArray:
    """Times (s) of the values of joints: ``times``, or fewer if there are many joints."""
    allowed = max(MAX_JOINT_NUMBERS // max(2 * mechanism.model.nv, 1), FEWEST_JOINT_SAMPLES)
    return times if len(times) <= allowed else np.linspace(times[0], times[-1], allowed)


def drift_unit(motion: DrawableMotion) -> str:
    """Units of the closure errors of a motion, "" if it never has closures or drives."""
    units: dict[str, None] = {}
    for segment in motion.segments:
        if segment.mechanism.constrained:
            units |= dict.fromkeys(row_dimensions(segment.mechanism))
    return ", ".join(units)


def _passage_text(crossing: Crossing, *, named: bool) -> str:
    """Text at the mark of a passage: its time and, where loops and passages are few, the loops and
    drives that lose rank.

    To find them among dozens of loops takes a second.
    """
    text = f"singular configuration passed at t = {crossing.time:.4g} s"
    return f"{text}: {crossing.participants.names}" if named else text


def sigma_at(solution: SimulationResult, times: FloatArray) -> FloatArray:
    """sigma (relative) at ``times`` (n,) s.

    Linear interpolation between the stages of the run, which record it, as in the plot of the run,
    and zero at the singular passages, which lie between stages.
    """
    steps, passages = solution.steps, [crossing.time for crossing in solution.crossings]
    stages = steps.stage_times(solution.scheme)
    known, sigmas = np.append(stages, passages), np.append(steps.sigmas, np.zeros(len(passages)))
    order = np.argsort(known, kind="stable")
    return np.interp(times, known[order], sigmas[order])


def make_page(title: str, data: dict[str, Any], commands: Sequence[dict[str, Any]] | None) -> str:
    """One self-contained page.

    Parameters
    ----------
    title
        Of the window.
    data
        Data of the panel and the bar (:func:`page_data`).
    commands
        meshcat's commands, which the page holds and, unlike that of meshcat's own
        ``static_html``, applies in their order; None for a page that takes them from the server
        that it comes from.
    """
    root = Path(import_meshcat().servers.zmqserver.VIEWER_ROOT)
    return render(
        FOLDER,
        "page.html.j2",
        title=title,
        viewer=(root / "main.min.js").read_text(encoding="utf-8"),
        commands=None if commands is None else _packed(commands),
        data=data,
        script="".join((FOLDER / name).read_text(encoding="utf-8") for name in SCRIPTS),
    )


def render(folder: Path, template: str, **values: Any) -> str:
    """A Jinja2 template of ``folder``, filled with ``values``.

    Values are escaped as HTML, or as JavaScript by the filter ``tojson``: names in them are the
    user's.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False}
    return environment.get_template(template).render(values)


def _packed(commands: Sequence[dict[str, Any]]) -> list[str]:
    import umsgpack  # type: ignore[import-untyped]

    packed = []
    for command in commands:
        if command["type"] == "set_animation":
            command = command | {"animations": [_compact(clip) for clip in command["animations"]]}
        packed.append(base64.b64encode(umsgpack.packb(command)).decode("ascii"))
    return packed


def _compact(animation: dict[str, Any]) -> dict[str, Any]:
    """One animated node of meshcat's command, with the times and values of each track as one array.

    Animations are most of the file.  three.js reads arrays of single precision, in which it plays
    them, as well as the objects of one key each that meshcat writes, and these take twice as much.
    """
    import umsgpack

    def array(values: Any) -> Any:
        return umsgpack.Ext(FLOAT32_ARRAY, np.asarray(values, dtype="<f4").tobytes())

    tracks = []
    for track in animation["clip"]["tracks"]:
        keys = track["keys"]
        # three.js keeps what is no number as it is.
        values = [key["value"] for key in keys]
        arrays = {
            "times": array([key["time"] for key in keys]),
            "values": values if track["type"] == "bool" else array(values),
        }
        tracks.append({name: x for name, x in track.items() if name != "keys"} | arrays)
    return animation | {"clip": animation["clip"] | {"tracks": tracks}}


def write_file(path: Path, content: bytes) -> None:
    """Write a page, image or video, whole or not at all; an existing file is replaced.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    try:
        write_bytes(path, content)
    except OSError as error:
        raise unwritable(path, error) from error
    log.info("written: %s", path)
