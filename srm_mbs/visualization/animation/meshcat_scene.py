"""A picture as nodes and animations of a meshcat scene.

``/mechanism/<joint>`` is the body that the joint moves, ``/mechanism/world`` the ground, and
``/overlays`` has the overlays.  The transforms of ``/mechanism`` and ``/overlays`` place the centre
of the picture at the origin, about which meshcat's camera rotates.
"""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError
from srm_mbs.model.anchors import WORLD
from srm_mbs.visualization.animation.scene import FIELD_OF_VIEW, Picture, View
from srm_mbs.visualization.animation.shapes import Box, Colour, Cylinder, Mesh, Shape, Sphere
from srm_mbs.visualization.animation.trajectory import ActiveIntervals, BodyMotion

TOP_COLOUR, BOTTOM_COLOUR = (1.0, 1.0, 1.0), (0.90, 0.92, 0.94)


def import_meshcat() -> Any:
    """The meshcat package with the modules that playback uses.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        with warnings.catch_warnings():
            # meshcat imports a deprecated module of pyzmq.
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


def node_names(mechanism: Mechanism) -> list[str]:
    """Name in the page of the ground and of each joint's body, unique and without slashes."""
    names: list[str] = []
    for name in (WORLD, *mechanism.joint_names):
        plain = name.replace("/", "_") or "_"
        while plain in names:
            plain += "_"
        names.append(plain)
    return names


def _geometry(meshcat: Any, shape: Shape, at: pin.SE3) -> tuple[Any, FloatArray]:
    """meshcat's geometry of a shape, and its homogeneous placement (4, 4)."""
    shapes = meshcat.geometry
    placement = np.array(at.homogeneous)
    match shape:
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


def _number(colour: Colour) -> int:
    return sum(round(255.0 * c) << s for c, s in zip(colour, (16, 8, 0)))


def _material(meshcat: Any, shape: Shape, colour: Colour, in_front: bool) -> Any:
    flat = isinstance(shape, Mesh)
    material = meshcat.geometry.MeshPhongMaterial(
        color=_number(colour), opacity=colour[3], shininess=20.0, flatShading=flat
    )
    if in_front:
        # Transparent objects are drawn last; without depth test, only front faces are drawn.
        material.transparent, material.side = True, 0
        material.properties["depthTest"] = False
    return material


def draw_picture(meshcat: Any, scene: Any, picture: Picture) -> None:
    """Send the whole picture, the motion included, to ``scene``, a meshcat Visualizer."""
    motion, view = picture.motion, picture.view
    names = node_names(picture.mechanism)
    _light_scene(scene, view)
    root = scene["/mechanism"]
    animation = meshcat.animation.Animation(default_framerate=motion.rate)
    _centre(meshcat, animation, root, picture)
    drawn = {visual.joint for visual in picture.visuals} - {0}
    for k, joint in enumerate(motion.joints):
        if joint in drawn:
            tracks = {
                "position": ("vector3", motion.positions[:, k]),
                "quaternion": ("quaternion", motion.quaternions[:, k]),
            }
            _animate(meshcat, animation, root[names[joint]], tracks, motion)
    for number, visual in enumerate(picture.visuals):
        node = root[f"{names[visual.joint]}/shape_{number}"]
        _add_shape(meshcat, node, visual.shape, visual.placement, visual.colour)
        _show_while_active(meshcat, animation, node, visual.active, motion)
    _draw_overlays(meshcat, scene["/overlays"], picture, animation)
    if animation.clips:
        # Repeated without end: a page that is opened late still moves; "pause" stops it.
        scene.set_animation(animation, play=True, repetitions=math.inf)


def _add_shape(
    meshcat: Any,
    node: Any,
    shape: Shape,
    at: pin.SE3,
    colour: Colour,
    in_front: bool = False,
) -> None:
    geometry, placement = _geometry(meshcat, shape, at)
    node.set_object(geometry, _material(meshcat, shape, colour, in_front))
    node.set_transform(placement)


def _centre(meshcat: Any, animation: Any, root: Any, picture: Picture) -> None:
    """Keep the target of the camera at the origin."""
    shift = np.eye(4)
    shift[:3, 3] = -picture.view.target
    root.set_transform(shift)
    if picture.along is not None:
        places = -picture.view.target - picture.along
        _animate(meshcat, animation, root, {"position": ("vector3", places)}, picture.motion)


def _draw_overlays(meshcat: Any, root: Any, picture: Picture, animation: Any) -> None:
    """Animated shapes, and paths."""
    overlays = picture.overlays
    if overlays.shapes:
        _centre(meshcat, animation, root, picture)
    for group in overlays.shapes:
        node = root[group.name]
        for number, (shape, at, colour) in enumerate(group.parts):
            part = node[f"part_{number}"]
            _add_shape(meshcat, part, shape, at, colour, group.in_front)
            if group.colours is not None:
                tracks = {"material.color": ("color", group.colours)}
                _animate(meshcat, animation, part["<object>"], tracks, picture.motion)
        tracks = {
            "position": ("vector3", group.positions),
            "quaternion": ("quaternion", group.quaternions),
        }
        if group.scales is not None:
            tracks["scale"] = ("vector3", group.scales)
        _animate(meshcat, animation, node, tracks, picture.motion)
        _show_while_active(meshcat, animation, node, group.active, picture.motion)
    for trace in overlays.traces:
        points = meshcat.geometry.PointsGeometry(trace.points.T.astype(np.float32))
        material = meshcat.geometry.LineBasicMaterial(color=_number(trace.colour))
        root[trace.name].set_object(meshcat.geometry.Line(points, material))


def _light_scene(scene: Any, view: View) -> None:
    """Background, lights and camera."""
    scene["/Background"].set_property("top_color", list(TOP_COLOUR))
    scene["/Background"].set_property("bottom_color", list(BOTTOM_COLOUR))
    scene["/Axes"].set_property("visible", False)
    scene["/Grid"].set_property("visible", False)
    # Two lamps on the side of the camera, upper left and right, and a faint one opposite to it.
    lamps = {
        "PointLightNegativeX": ((-0.6, 0.9, -1.0), 0.55),
        "PointLightPositiveX": ((1.0, 0.3, -0.5), 0.25),
        "FillLight": ((0.0, 1.0, 1.0), 0.2),
        "AmbientLight": ((0.0, 0.0, 0.0), 0.55),
    }
    for name, (position, intensity) in lamps.items():
        lamp = scene[f"/Lights/{name}/<object>"]
        lamp.set_property("intensity", intensity)
        lamp.set_property("distance", 0.0)  # intensity independent of the distance
        lamp.set_property("position", (view.distance * np.array(position) @ view.axes).tolist())
    camera = scene["/Cameras/default/rotated/<object>"]
    camera.set_property("fov", FIELD_OF_VIEW)
    camera.set_property("near", 0.02 * view.distance)
    camera.set_property("far", 50.0 * view.distance)
    # Cameras are placed in the axes of three.js, y up.
    x, y, z = (-view.distance * view.axes[2]).tolist()
    camera.set_property("position", [x, z, -y])


def _animate(
    meshcat: Any,
    animation: Any,
    node: Any,
    values: dict[str, tuple[str, FloatArray]],
    motion: BodyMotion,
) -> None:
    """Set ``node`` to the first of its values, and add a clip if they change.

    ``values`` are property, three.js's type and one row for each key frame.
    """
    tracks, frames = {}, motion.frames
    for name, (kind, rows) in values.items():
        # A constant value has one key: the pivot of a crank, the direction of a slider.
        count = len(rows) if np.ptp(rows, axis=0).max() > 1e-12 else 1
        tracks[name] = meshcat.animation.AnimationTrack(
            name, kind, frames[:count], rows[:count].tolist()
        )
        if name != "material.color":
            node.set_property(name, rows[0].tolist())
    if any(len(track.frames) > 1 for track in tracks.values()):
        fps = animation.default_framerate
        animation.clips[node.path] = meshcat.animation.AnimationClip(tracks, fps=fps)


def _show_while_active(
    meshcat: Any, animation: Any, node: Any, active: ActiveIntervals | None, motion: BodyMotion
) -> None:
    """Show ``node`` during its ``active`` intervals only, exact in time, not to a key frame."""
    if active is None:
        return
    start, end = float(motion.times[0]), float(motion.times[-1])
    changes = {start: False, end: False}
    for first, last in active:
        changes |= {first: True, last: last >= end}
    times = sorted(changes)
    node.set_property("visible", changes[times[0]])
    clip = animation.clips.setdefault(
        node.path, meshcat.animation.AnimationClip({}, fps=animation.default_framerate)
    )
    # All clips have the same last key, so that they have the same duration.
    frames = [(t - start) * motion.rate for t in times[:-1]] + [len(motion.times) - 1]
    clip.tracks["visible"] = meshcat.animation.AnimationTrack(
        "visible", "bool", frames, [changes[t] for t in times]
    )
