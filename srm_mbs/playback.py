"""Playing a run in the browser: live with :func:`play`, or from one file with :func:`export_html`.

Both draw with meshcat and hand the motion to its animation, so that the browser plays it in real
time and its time slider scrubs through it.  In the page, ``/mechanism/<joint>`` is the body that
the joint moves, ``/mechanism/world`` the ground; the transform of ``/mechanism`` itself puts the
centre of the picture at the origin, about which meshcat's camera turns.
"""

from __future__ import annotations

import atexit
import base64
import contextlib
import html
import io
import json
import logging
import math
import sys
import time
import warnings
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.mechanism import WORLD, Mechanism
from srm_mbs.visuals import Box, Cylinder, Mesh, Sphere, Visual, visuals_of

if TYPE_CHECKING:
    from srm_mbs.solution import Solution

log = logging.getLogger(__name__)

MAX_BODY_FRAMES = 30_000
"""Key frames of all bodies together; in a page one costs up to 90 bytes, so 2.7 MB at most."""
MIN_FPS = 10.0
"""Key frames per second below which the limit above is not kept: motion would look wrong."""

FIELD_OF_VIEW = 25.0  # degrees, vertical: narrow, so that planar mechanisms look planar
ASPECT = 1.5  # width by height of the window that the picture is made for
FILLED = 0.84  # of the window
TOP_COLOUR, BOTTOM_COLOUR = (1.0, 1.0, 1.0), (0.90, 0.92, 0.94)
SAMPLES = 300  # frames that are looked at to find the camera's place
REPLY_TIME = 30.0  # s, for meshcat's server to accept one command


# Motion -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Motion:
    """Placements of bodies over a run.

    Attributes
    ----------
    joints
        Indices of the joints that carry the bodies, k of them.
    times : (n,) s
        Uniform, from the start to the end of the run; one only if the run has no length.
    positions : (n, k, 3) m
        Origins of the joint frames in the world.
    quaternions : (n, k, 4)
        Their rotations, (x, y, z, w), of continuous sign.
    """

    joints: tuple[int, ...]
    times: FloatArray
    positions: FloatArray
    quaternions: FloatArray

    @property
    def rate(self) -> float:
        """Key frames per second; 1 if there is only one."""
        if len(self.times) == 1:
            return 1.0
        return float((len(self.times) - 1) / (self.times[-1] - self.times[0]))


def sample_motion(solution: Solution, joints: tuple[int, ...], fps: float) -> Motion:
    """Forward kinematics of the dense output at uniform times.

    Parameters
    ----------
    solution
        The run.
    joints
        Indices of joints of its model.
    fps
        Wanted key frames per second.  There are fewer if otherwise all bodies together had more
        than :data:`MAX_BODY_FRAMES`, but at least :data:`MIN_FPS` or ``fps``, the smaller one.
    """
    start, end = (float(t) for t in solution.steps.times[[0, -1]])
    duration = end - start
    wanted = duration * fps * (1.0 - 1e-12)  # rounding must not add one to a whole number
    allowed = max(MAX_BODY_FRAMES // max(1, len(joints)), math.ceil(MIN_FPS * duration))
    intervals = math.ceil(min(wanted, allowed))
    if wanted > allowed:
        log.info(
            "%d bodies over %g s: %.3g key frames per second instead of %g",
            len(joints),
            duration,
            intervals / duration,
            fps,
        )
    times = np.linspace(start, end, intervals + 1)
    model = solution.mechanism.model
    data = model.createData()
    placements = np.empty((len(times), len(joints), 7))
    for i, q in enumerate(solution(times)[0]):
        pin.forwardKinematics(model, data, q)
        for k, joint in enumerate(joints):
            placements[i, k] = pin.SE3ToXYZQUAT(data.oMi[joint])
    quaternions = placements[:, :, 3:]
    # q and -q are the same rotation: take the one near its predecessor.
    flips = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=2) < 0.0, -1.0, 1.0)
    quaternions[1:] *= np.cumprod(flips, axis=0)[:, :, None]
    return Motion(joints, times, placements[:, :, :3], quaternions)


# Camera -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class View:
    """Where the camera looks, and from where.

    Attributes
    ----------
    target : (3,) m
        The point in the world that it looks at.
    axes : (3, 3)
        Unit vectors to the right, upwards and forward as its rows.
    distance
        From the camera to the target, m.
    """

    target: FloatArray
    axes: FloatArray
    distance: float


def choose_view(mechanism: Mechanism, points: FloatArray) -> View:
    """The view that shows all ``points`` (n, 3) m.

    Planar mechanisms are seen along the normal of their plane: from -y, +z or +x.  Others are
    seen from the front, the right and above.
    """
    forward = _view_direction(mechanism)
    up = np.array([0.0, 0.0, 1.0]) if forward[2] > -0.99 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(right, forward), forward])
    seen = points @ axes.T
    centre = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    offsets = seen - centre
    slope = FILLED * math.tan(math.radians(0.5 * FIELD_OF_VIEW))
    needed = np.abs(offsets[:, :2]) / [slope * ASPECT, slope] - offsets[:, 2:]
    return View(centre @ axes, axes, max(float(needed.max()), 1e-3))


def _view_direction(mechanism: Mechanism) -> FloatArray:
    """Unit vector from the camera to the mechanism."""
    model = mechanism.model
    jacobian = pin.computeJointJacobians(model, model.createData(), np.array(mechanism.q0))
    size = np.abs(jacobian).max(initial=0.0)
    for normal, forward in ((1, (0.0, 1.0, 0.0)), (2, (0.0, 0.0, -1.0)), (0, (-1.0, 0.0, 0.0))):
        # Planar: no joint moves along the normal, or turns about anything else.
        out_of_plane = [normal, *(3 + axis for axis in range(3) if axis != normal)]
        if np.abs(jacobian[out_of_plane]).max(initial=0.0) <= 1e-9 * size:
            return np.array(forward)
    direction = np.array([-0.62, 1.0, -0.5])
    return np.asarray(direction / np.linalg.norm(direction))


# Drawing ------------------------------------------------------------------------------------


def _import_meshcat() -> Any:
    try:
        with warnings.catch_warnings():
            # Its imports are not the reader's to mend: it takes a deprecated module of pyzmq.
            warnings.simplefilter("ignore", DeprecationWarning)
            import meshcat
            import meshcat.animation
            import meshcat.geometry
            import meshcat.path
            import meshcat.servers.zmqserver
    except ImportError as error:
        raise InputError(
            f"playback needs meshcat, which cannot be imported: {error}",
            remedy="Install it: pip install meshcat",
        ) from error
    return meshcat


def _node_names(mechanism: Mechanism) -> list[str]:
    """Name in the page of the ground and of each joint's body, unique and without slashes."""
    names: list[str] = []
    for name in (WORLD, *mechanism.joint_names):
        plain = name.replace("/", "_") or "_"
        while plain in names:
            plain += "_"
        names.append(plain)
    return names


def _geometry(meshcat: Any, visual: Visual) -> tuple[Any, FloatArray]:
    """meshcat's geometry of a shape, and its homogeneous placement (4, 4) in the joint frame."""
    shapes = meshcat.geometry
    placement = np.array(visual.placement.homogeneous)
    match visual.shape:
        case Box(size):
            return shapes.Box(list(size)), placement
        case Sphere(radius):
            return shapes.Sphere(radius), placement
        case Cylinder(radius, length):
            # Its axis is z in URDF and y in three.js.
            turn = pin.SE3(pin.rpy.rpyToMatrix(0.5 * np.pi, 0.0, 0.0), np.zeros(3))
            return shapes.Cylinder(length, radius), placement @ turn.homogeneous
        case Mesh(vertices, faces):
            return shapes.TriangularMeshGeometry(vertices, faces), placement


def _material(meshcat: Any, visual: Visual) -> Any:
    red, green, blue, opacity = visual.colour
    number = sum(round(255.0 * c) << s for c, s in ((red, 16), (green, 8), (blue, 0)))
    return meshcat.geometry.MeshPhongMaterial(
        color=number, opacity=opacity, shininess=20.0, flatShading=isinstance(visual.shape, Mesh)
    )


def _draw(meshcat: Any, scene: Any, solution: Solution, fps: float) -> None:
    """Send the whole scene, the motion included, to ``scene``, a meshcat Visualizer."""
    mechanism = solution.mechanism
    visuals = visuals_of(mechanism)
    names = _node_names(mechanism)
    joints = tuple(sorted({visual.joint for visual in visuals} - {0}))
    motion = sample_motion(solution, joints, fps)
    view = choose_view(mechanism, _seen_points(visuals, motion))
    _light(scene, view)

    root = scene["/mechanism"]
    shift = np.eye(4)
    shift[:3, 3] = -view.target
    root.set_transform(shift)
    for k, joint in enumerate(joints):
        start = pin.XYZQUATToSE3(np.concatenate([motion.positions[0, k], motion.quaternions[0, k]]))
        root[names[joint]].set_transform(start.homogeneous)
    for number, visual in enumerate(visuals):
        node = root[f"{names[visual.joint]}/shape_{number}"]
        geometry, placement = _geometry(meshcat, visual)
        node.set_object(geometry, _material(meshcat, visual))
        node.set_transform(placement)
    animation = _animation(meshcat, motion, [f"/mechanism/{names[j]}" for j in joints])
    if animation.clips:
        # For ever: a page that is looked at late still moves; "pause" stops it.
        scene.set_animation(animation, play=True, repetitions=math.inf)


def _seen_points(visuals: list[Visual], motion: Motion) -> FloatArray:
    """Corners (n, 3) m of all shapes at sampled times."""
    chosen = np.unique(np.linspace(0, len(motion.times) - 1, SAMPLES).astype(int))
    corners: dict[int, list[FloatArray]] = {0: [np.empty((0, 3))]}
    for visual in visuals:
        corners.setdefault(visual.joint, []).append(visual.corners())
    points = [np.concatenate(corners.pop(0))]
    for joint, own in corners.items():
        k = motion.joints.index(joint)
        together = np.concatenate(own)
        for i in chosen:
            rotation = pin.Quaternion(motion.quaternions[i, k]).matrix()
            points.append(together @ rotation.T + motion.positions[i, k])
    return np.concatenate(points)


def _light(scene: Any, view: View) -> None:
    """Background, lights and camera."""
    scene["/Background"].set_property("top_color", list(TOP_COLOUR))
    scene["/Background"].set_property("bottom_color", list(BOTTOM_COLOUR))
    scene["/Axes"].set_property("visible", False)
    scene["/Grid"].set_property("visible", False)
    # Two lamps on the camera's side, to the left above and to the right, and a faint one behind.
    lamps = {
        "PointLightNegativeX": ((-0.6, 0.9, -1.0), 0.55),
        "PointLightPositiveX": ((1.0, 0.3, -0.5), 0.25),
        "FillLight": ((0.0, 1.0, 1.0), 0.2),
        "AmbientLight": ((0.0, 0.0, 0.0), 0.55),
    }
    for name, (position, intensity) in lamps.items():
        lamp = scene[f"/Lights/{name}/<object>"]
        lamp.set_property("intensity", intensity)
        lamp.set_property("distance", 0.0)  # it does not fade with the distance
        lamp.set_property("position", (view.distance * np.array(position) @ view.axes).tolist())
    camera = scene["/Cameras/default/rotated/<object>"]
    camera.set_property("fov", FIELD_OF_VIEW)
    camera.set_property("near", 0.02 * view.distance)
    camera.set_property("far", 50.0 * view.distance)
    # Cameras live in three.js's own axes, y up.
    x, y, z = (-view.distance * view.axes[2]).tolist()
    camera.set_property("position", [x, z, -y])


def _animation(meshcat: Any, motion: Motion, paths: list[str]) -> Any:
    """meshcat's animation: one clip per body that moves."""
    animation = meshcat.animation.Animation(default_framerate=motion.rate)
    for k, path in enumerate(paths):
        tracks = {}
        for name, kind, values in (
            ("position", "vector3", motion.positions[:, k]),
            ("quaternion", "quaternion", motion.quaternions[:, k]),
        ):
            # What stays is said once: the pivot of a crank, the direction of a slider.
            count = len(values) if np.ptp(values, axis=0).max() > 1e-12 else 1
            tracks[name] = meshcat.animation.AnimationTrack(
                name, kind, list(range(count)), values[:count].tolist()
            )
        if any(len(track.frames) > 1 for track in tracks.values()):
            clip = meshcat.animation.AnimationClip(tracks, fps=motion.rate)
            animation.clips[meshcat.path.Path().append(path)] = clip
    return animation


# Playing ------------------------------------------------------------------------------------


def _check_fps(fps: Any) -> float:
    try:
        value = float(fps)
    except (TypeError, ValueError):
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(
            f"fps = {fps!r} is not a positive number of key frames per second",
            element="fps",
            remedy="Give for example fps=60",
        )
    return value


_open_visualizers: list[Any] = []


def play(
    solution: Solution,
    *,
    fps: float = 60.0,
    open_browser: bool = True,
    block: bool | None = None,
) -> Any:
    """Play a run in the browser, in real time, over and over.

    "Open Controls" in the page has pause, play, the time slider and the speed (``timeScale``).
    The page is served by a local process of meshcat's.

    Parameters
    ----------
    solution
        The run; one that failed is played up to its end.
    fps
        Key frames per second; between them the browser interpolates.  Fewer are taken where
        their number would get too large (:data:`MAX_BODY_FRAMES`).
    open_browser
        Open a browser window; otherwise only serve the page.  Its address is logged.
    block
        Wait until Ctrl+C, and then stop serving.  By default in a script, whose end would also be
        that of the page, and not in an interactive session.

    Returns
    -------
    meshcat.Visualizer
        To add to the scene, or for :func:`close`.

    Raises
    ------
    InputError
        If ``fps`` is not a positive number, or meshcat is missing or cannot start.
    """
    fps = _check_fps(fps)
    meshcat = _import_meshcat()
    visualizer = _start_server(meshcat)
    try:
        # Without a limit, sending to a server that has died would wait for ever.
        visualizer.window.zmq_socket.setsockopt(_zmq().RCVTIMEO, int(1000.0 * REPLY_TIME))
        _draw(meshcat, visualizer, solution, fps)
        visualizer.window.zmq_socket.setsockopt(_zmq().RCVTIMEO, -1)
    except _zmq().ZMQError as error:
        close(visualizer)
        raise InputError(f"meshcat's server does not answer: {error}") from error
    except BaseException:
        close(visualizer)
        raise
    address = visualizer.url()
    log.info("%s is played at %s", solution.mechanism.name, address)
    if open_browser and not webbrowser.open(address, new=2):
        log.warning("no browser could be opened; open %s", address)
    if block is None:
        block = not (hasattr(sys, "ps1") or sys.flags.interactive)
    if block:
        try:
            while visualizer.window.server_proc.poll() is None:
                time.sleep(0.1)
        except KeyboardInterrupt:
            log.info("stopped")
        finally:
            close(visualizer)
    return visualizer


def close(visualizer: Any) -> None:
    """Stop serving the page of :func:`play`; a page that is open goes on playing.

    Parameters
    ----------
    visualizer
        What :func:`play` returned; closing it twice is harmless.
    """
    window = visualizer.window
    if visualizer in _open_visualizers:
        _open_visualizers.remove(visualizer)
    process = window.server_proc
    process.kill()
    process.wait()
    for stream in (process.stdout, process.stderr):
        stream.close()
    window.zmq_socket.close(linger=0)


@atexit.register
def _close_all() -> None:
    while _open_visualizers:
        close(_open_visualizers[-1])


def _zmq() -> Any:
    import zmq

    return zmq


def _start_server(meshcat: Any) -> Any:
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):  # meshcat prints the address
            visualizer = meshcat.Visualizer()
    except Exception as error:  # a process, a port, a socket: anything may fail here
        details = " ".join([str(error), *printed.getvalue().split("\n")[-2:]]).strip()
        raise InputError(
            f"meshcat cannot start its server: {details}",
            remedy="solution.export_html(path) needs none",
        ) from error
    # Kept until closed: an abandoned process and socket would warn when collected.
    _open_visualizers.append(visualizer)
    return visualizer


# Export -------------------------------------------------------------------------------------


class _Recorder:
    """Stands in for meshcat's window: keeps the commands instead of sending them to a server."""

    def __init__(self) -> None:
        self.commands: list[dict[str, Any]] = []

    def send(self, command: Any) -> None:
        self.commands.append(command.lower())


def export_html(solution: Solution, path: str | Path, *, fps: float = 60.0) -> None:
    """Write one file that plays a run in any browser, without a network or a server.

    It starts at once and repeats for ever.  Below are pause, play and the time slider; the speed
    (``timeScale``) is under "Open Controls".  The mouse turns, shifts and zooms the picture.

    Parameters
    ----------
    solution
        The run; one that failed is shown up to its end, or as it stood.
    path
        Name of the file, usually ``.html``; an existing one is replaced.
    fps
        Key frames per second; between them the browser interpolates.  Fewer are taken where
        their number would get too large (:data:`MAX_BODY_FRAMES`), to keep the file below 5 MB
        unless there are mesh files or very many bodies.

    Raises
    ------
    InputError
        If ``fps`` is not a positive number, meshcat is missing, or the file cannot be written.
    """
    fps = _check_fps(fps)
    meshcat = _import_meshcat()
    recorder = _Recorder()
    _draw(meshcat, meshcat.Visualizer(window=recorder), solution, fps)
    page = _page(meshcat, solution.mechanism.name, recorder.commands)
    try:
        Path(path).write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(f"the page cannot be written: {error.strerror}", file=str(path)) from error


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>@title@</title>
<style>
body { margin: 0; background: #eef0f2; font: 15px system-ui, sans-serif; color: #333; }
#meshcat-pane { width: 100vw; height: 100vh; overflow: hidden; }
#bar { position: fixed; left: 0; right: 0; bottom: 0; padding: 10px 18px 12px; gap: 14px;
  align-items: center; background: rgba(255, 255, 255, 0.75); }
#bar:not([hidden]) { display: flex; }
#bar button { font: inherit; width: 5em; padding: 4px 0; cursor: pointer; }
#bar input { flex: 1; min-width: 0; accent-color: #0072b2; }
#bar output { min-width: 9em; text-align: right; font-variant-numeric: tabular-nums; }
</style>
</head>
<body>
<div id="meshcat-pane"></div>
<div id="bar" hidden><button id="toggle">Pause</button>
<input id="time" type="range" min="0" step="any" value="0" aria-label="time"><output></output></div>
<script>@viewer@</script>
<script>
var viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
for (const text of @commands@) {
  const bytes = atob(text), buffer = new Uint8Array(bytes.length);
  for (let i = 0; i < bytes.length; i++) buffer[i] = bytes.charCodeAt(i);
  viewer.handle_command_bytearray(buffer);
}
// The picture is made for one shape of window: step back in a narrower one.
const narrow = @aspect@ * window.innerHeight / window.innerWidth;
if (narrow > 1) viewer.camera.position.multiplyScalar(narrow);
// A wide slider over meshcat's animator; its own controls remain under "Open Controls".
const animator = viewer.animator, slider = document.getElementById("time");
const toggle = document.getElementById("toggle"), clock = document.querySelector("output");
document.getElementById("bar").hidden = animator.duration === 0;
slider.max = animator.duration;
slider.oninput = () => {
  animator.pause();
  animator.seek(+slider.value);
  animator.display_progress(+slider.value);
};
toggle.onclick = () => animator.playing ? animator.pause() : animator.play();
(function show() {
  slider.value = animator.time;
  toggle.textContent = animator.playing ? "Pause" : "Play";
  clock.value = `${animator.time.toFixed(2)} / ${animator.duration.toFixed(2)} s`;
  requestAnimationFrame(show);
})();
</script>
</body>
</html>
"""


def _page(meshcat: Any, title: str, commands: list[dict[str, Any]]) -> str:
    """meshcat's viewer with ``commands``, as one page.

    Unlike meshcat's own ``static_html``, which needs a running server, it applies the commands in
    order.
    """
    import umsgpack  # type: ignore[import-untyped]

    encoded = []
    for command in commands:
        # Animations are played in single precision anyway, and are most of the file.
        precision = "single" if command["type"] == "set_animation" else "double"
        packed = umsgpack.packb(command, force_float_precision=precision)
        encoded.append(base64.b64encode(packed).decode("ascii"))
    root = Path(meshcat.servers.zmqserver.VIEWER_ROOT)
    parts = {
        "title": html.escape(title),
        "viewer": (root / "main.min.js").read_text(encoding="utf-8"),
        "commands": json.dumps(encoded),
        "aspect": repr(ASPECT),
    }
    page = _PAGE
    # The last first: what is put in may itself hold marks.
    for name in reversed(parts):
        before, after = page.split(f"@{name}@", 1)
        page = before + parts[name] + after
    return page
