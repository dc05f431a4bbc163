"""A picture as nodes and animations of a meshcat scene.

``/mechanism/<joint>`` is the body that the joint moves, ``/mechanism/world`` the ground, and
``/overlays`` has the overlays.  The transforms of ``/mechanism`` and ``/overlays`` place the centre
of the picture at the origin, about which meshcat's camera rotates.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError
from srm_mbs.model.anchors import WORLD
from srm_mbs.visualization.animation.scene import FIELD_OF_VIEW, Picture
from srm_mbs.visualization.animation.shapes import Box, Colour, Cylinder, Mesh, Shape, Sphere
from srm_mbs.visualization.animation.trajectory import ActiveIntervals

BACKGROUNDS = (
    ((1.0, 1.0, 1.0), (0.90, 0.92, 0.94)),
    ((0.42, 0.45, 0.49), (0.27, 0.30, 0.33)),
)
"""Colours at the top and bottom of the picture, where the browser prefers light and dark pages."""
LAMPS = {
    "PointLightNegativeX": ((-0.6, 0.9, -1.0), 0.55),
    "PointLightPositiveX": ((1.0, 0.3, -0.5), 0.25),
    "FillLight": ((0.0, 1.0, 1.0), 0.2),
    "AmbientLight": ((0.0, 0.0, 0.0), 0.55),
}
"""Directions (right, up, forward) and intensities: two lamps on the side of the camera, upper left
and right, a faint one opposite to it, and light from all sides."""
TRACK_TYPES = {"quaternion": "quaternion", "material.color": "color"}
"""Types in three.js of animated properties that are no vectors."""
Y_TO_Z = pin.SE3(pin.rpy.rpyToMatrix(0.5 * np.pi, 0.0, 0.0), np.zeros(3)).homogeneous
"""Rotation (4, 4) of a cylinder, whose axis is y in three.js, to URDF's z."""


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


def draw_picture(scene: Any, picture: Picture) -> None:
    """Send the whole picture, the motion included, to ``scene``, a meshcat Visualizer."""
    drawing = _Drawing(scene, picture)
    drawing.light_scene()
    drawing.draw_bodies()
    drawing.draw_overlays()
    if drawing.animation.clips:
        # Repeated without end: a page that is opened late still moves; "pause" stops it.
        scene.set_animation(drawing.animation, play=True, repetitions=math.inf)


def _number(colour: Sequence[float]) -> int:
    """Red, green and blue, 0 to 1, as 0xrrggbb."""
    return sum(round(255.0 * c) << s for c, s in zip(colour, (16, 8, 0)))


class _Drawing:
    """A picture, the scene that it is sent to, and the animation of the nodes there."""

    def __init__(self, scene: Any, picture: Picture) -> None:
        self.meshcat = import_meshcat()
        self.scene = scene
        self.picture = picture
        self.motion = picture.motion
        self.frames = picture.motion.frames
        self.animation = self.meshcat.animation.Animation(default_framerate=self.motion.rate)

    def light_scene(self) -> None:
        """Background, lights and camera."""
        scene, view = self.scene, self.picture.view
        scene["/Background"].set_property("top_color", list(BACKGROUNDS[0][0]))
        scene["/Background"].set_property("bottom_color", list(BACKGROUNDS[0][1]))
        scene["/Axes"].set_property("visible", False)
        scene["/Grid"].set_property("visible", False)
        for name, (position, intensity) in LAMPS.items():
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

    def draw_bodies(self) -> None:
        """The shapes of the bodies, and the motion of the joints that carry them."""
        names, root = node_names(self.picture.mechanism), self.scene["/mechanism"]
        self._centre(root)
        moved = {visual.joint for visual in self.picture.visuals} - {0}
        if self.picture.overlays.arrows is not None:  # which start at points of the bodies
            moved.update(arrow.joint for arrow in self.picture.overlays.arrows.arrows)
        for k, joint in enumerate(self.motion.joints):
            if joint in moved:
                positions, quaternions = self.motion.positions[:, k], self.motion.quaternions[:, k]
                self._animate(root[names[joint]], position=positions, quaternion=quaternions)
        for number, visual in enumerate(self.picture.visuals):
            node = root[f"{names[visual.joint]}/shape_{number}"]
            self._add_shape(node, visual.shape, visual.placement, visual.colour)
            self._show_while_active(node, visual.active)

    def draw_overlays(self) -> None:
        """Animated shapes, and paths."""
        overlays, root = self.picture.overlays, self.scene["/overlays"]
        if overlays.shapes:
            self._centre(root)
        for group in overlays.shapes:
            node = root[group.name]
            for number, (shape, at, colour) in enumerate(group.parts):
                part = node[f"part_{number}"]
                self._add_shape(part, shape, at, colour, group.in_front)
                if group.colours is not None:
                    self._animate(part["<object>"], **{"material.color": group.colours})
            scale = {} if group.scales is None else {"scale": group.scales}
            self._animate(node, position=group.positions, quaternion=group.quaternions, **scale)
            self._show_while_active(node, group.active)
        geometry = self.meshcat.geometry
        for trace in overlays.traces:
            points = geometry.PointsGeometry(trace.points.T.astype(np.float32))
            material = geometry.LineBasicMaterial(color=_number(trace.colour))
            root[trace.name].set_object(geometry.Line(points, material))

    def _centre(self, root: Any) -> None:
        """Keep the target of the camera at the origin."""
        shift = np.eye(4)
        shift[:3, 3] = -self.picture.view.target
        root.set_transform(shift)
        if self.picture.along is not None:
            self._animate(root, position=-self.picture.view.target - self.picture.along)

    def _add_shape(
        self, node: Any, shape: Shape, at: pin.SE3, colour: Colour, in_front: bool = False
    ) -> None:
        shapes = self.meshcat.geometry
        placement = np.array(at.homogeneous)
        match shape:
            case Box(size):
                geometry = shapes.Box(list(size))
            case Sphere(radius):
                geometry = shapes.Sphere(radius)
            case Cylinder(radius, length):
                geometry = shapes.Cylinder(length, radius)
                placement = placement @ Y_TO_Z
            case Mesh(vertices, faces):
                geometry = shapes.TriangularMeshGeometry(vertices, faces)
        material = shapes.MeshPhongMaterial(
            color=_number(colour),
            opacity=colour[3],
            shininess=20.0,
            flatShading=isinstance(shape, Mesh),
        )
        if in_front:
            # Transparent objects are drawn last; without depth test, only front faces are drawn.
            material.transparent, material.side = True, 0
            material.properties["depthTest"] = False
        node.set_object(geometry, material)
        node.set_transform(placement)

    def _animate(self, node: Any, **values: FloatArray) -> None:
        """Set ``node`` to the first of its values, and add a clip if they change.

        ``values`` are the properties, one row for each key frame.
        """
        animation, tracks = self.meshcat.animation, {}
        for name, rows in values.items():
            kept = np.arange(len(rows))
            if np.ptp(rows, axis=0).max() <= 1e-12:
                # A constant value has one key: the pivot of a crank, the direction of a slider.
                kept = kept[:1]
            elif name in ("position", "quaternion"):
                kept = kept[self.motion.needed_frames(rows)]
            kind = TRACK_TYPES.get(name, "vector3")
            frames = [self.frames[i] for i in kept.tolist()]
            tracks[name] = animation.AnimationTrack(name, kind, frames, rows[kept].tolist())
            if name != "material.color":
                node.set_property(name, rows[0].tolist())
        if any(len(track.frames) > 1 for track in tracks.values()):
            self.animation.clips[node.path] = animation.AnimationClip(tracks, fps=self.motion.rate)

    def _show_while_active(self, node: Any, active: ActiveIntervals | None) -> None:
        """Show ``node`` during its ``active`` intervals only, exact in time, not to a key frame."""
        if active is None:
            return
        times = self.motion.times
        start, end = float(times[0]), float(times[-1])
        changes = {start: False, end: False}
        for first, last in active:
            changes |= {first: True, last: last >= end}
        *changing, _ = sorted(changes)
        node.set_property("visible", changes[start])
        # All clips have the same last key, so that they have the same duration.
        frames = [(t - start) * self.motion.rate for t in changing] + [len(times) - 1]
        visible = [changes[t] for t in (*changing, end)]
        animation = self.meshcat.animation
        clip = animation.AnimationClip({}, fps=self.motion.rate)
        clip = self.animation.clips.setdefault(node.path, clip)
        clip.tracks["visible"] = animation.AnimationTrack("visible", "bool", frames, visible)
