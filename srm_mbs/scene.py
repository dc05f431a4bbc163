"""What meshcat is given to draw: the bodies, their motion over a run, the camera and the light.

In the page, ``/mechanism/<joint>`` is the body that the joint moves, ``/mechanism/world`` the
ground; the transform of ``/mechanism`` itself puts the centre of the picture at the origin, about
which meshcat's camera turns.
"""

from __future__ import annotations

import logging
import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from srm_mbs.anchors import WORLD
from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.mechanism import Mechanism
from srm_mbs.visuals import Box, Cylinder, Mesh, Sphere, Visual, visuals_of

if TYPE_CHECKING:
    from srm_mbs.motion import Playable

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


def sample_motion(solution: Playable, joints: tuple[int, ...], fps: float) -> Motion:
    """Forward kinematics of the dense output at uniform times.

    Parameters
    ----------
    solution
        The run, or a motion.
    joints
        Indices of joints of its model.
    fps
        Wanted key frames per second.  There are fewer if otherwise all bodies together had more
        than :data:`MAX_BODY_FRAMES`, but at least :data:`MIN_FPS` or ``fps``, the smaller one.
    """
    start, end = solution.span
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


def import_meshcat() -> Any:
    """The meshcat package with the modules that playback uses.

    Raises
    ------
    InputError
        If it is not installed.
    """
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


def draw_scene(meshcat: Any, scene: Any, solution: Playable, fps: float) -> None:
    """Send the whole scene, the motion included, to ``scene``, a meshcat Visualizer.

    ``fps`` is the wanted number of key frames per second (:func:`sample_motion`).
    """
    mechanism = solution.mechanism
    visuals = visuals_of(mechanism)
    names = _node_names(mechanism)
    joints = tuple(sorted({visual.joint for visual in visuals} - {0}))
    motion = sample_motion(solution, joints, fps)
    view = choose_view(mechanism, seen_points(visuals, motion))
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


def seen_points(visuals: list[Visual], motion: Motion) -> FloatArray:
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
