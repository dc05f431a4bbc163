"""Snapshot of a run without a browser, by a software rasteriser with a depth buffer in NumPy.

It shows bodies and springs as the page of the animation does, from the same view
(:func:`srm_mbs.visualization.animation.scene.choose_view`) or, if the mechanism travels far, from a
closer one.  Reports need it for print, and where no Chromium is installed.

Matplotlib's mplot3d has no depth buffer: it sorts whole polygons by distance, so that a rod shows
through the sleeve around it unless both are divided into pieces about as small as their clearance,
which takes many times as long.  meshcat renders in a browser only.
"""

from __future__ import annotations

import io
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.animation.overlays import ViewOptions
from srm_mbs.visualization.animation.scene import FIELD_OF_VIEW, View, choose_view, make_picture
from srm_mbs.visualization.animation.shapes import Box, Colour, Cylinder, Mesh, Shape
from srm_mbs.visualization.animation.trajectory import active_at

SIZE = (900, 600)
"""Width and largest height of the image, pixels."""
SUPERSAMPLING = 2
"""Samples per pixel in each direction."""
SIDES = 20
"""Number of faces around a cylinder, and around the equator of a sphere."""
VIEW_FRAMES = 200
"""Key frames of the motion from which the view is computed."""
BATCH_SIZES = (4, 8, 16, 32)
"""Triangles of up to these sizes (samples) are rasterised in batches."""
MAX_BATCH_SAMPLES = 1_000_000
"""Most samples of a batch."""
FARTHEST_VIEW = 4.0
"""Largest distance of the camera that shows the whole motion, over that which shows the mechanism
at the time of the snapshot."""
MARGIN = 24
"""Pixels of background above and below."""
LIGHT = np.array([-0.4, 0.65, -0.65]) / np.linalg.norm([-0.4, 0.65, -0.65])
"""Direction to the light: right, up, forward as the camera sees them."""
AMBIENT = 0.45
"""Intensity of ambient light; that of the directed light is 1 - AMBIENT."""
BACKGROUND = (1.0, 1.0, 1.0)


def draw_snapshot(solution: SimulationResult, t: float) -> bytes:
    """The bodies and springs at ``t`` (s) as a PNG file.

    Raises
    ------
    InputError
        If the visuals of its description cannot be read.
    """
    from PIL import Image

    start, end = solution.span
    fps = VIEW_FRAMES / (end - start) if end > start else 1.0
    picture = make_picture(solution, fps, ViewOptions(), [t])
    motion, view = picture.motion, picture.view
    frame = int(np.abs(motion.times - t).argmin())
    triangles, colours = [np.zeros((0, 3, 3))], [np.zeros((0, 3))]

    def add(shape_triangles: FloatArray, placement: pin.SE3, colour: Colour) -> None:
        triangles.append(_placed(shape_triangles, placement))
        colours.append(np.tile(colour[:3], (len(shape_triangles), 1)))

    for visual in picture.visuals:
        if active_at(np.array([t]), visual.active, end).all():
            placement = motion.placement(visual.joint, frame) * visual.placement
            add(_triangles(visual.shape), placement, visual.colour)
    for spring in picture.overlays.shapes:
        if active_at(np.array([t]), spring.active, end).all():
            rotation = pin.Quaternion(spring.quaternions[frame]).matrix()
            place = pin.SE3(rotation, spring.positions[frame])
            scale = 1.0 if spring.scales is None else spring.scales[frame]
            for shape, within, colour in spring.parts:
                add(_placed(_triangles(shape), within) * scale, place, colour)
    corners = np.concatenate(triangles)
    if picture.along is not None:
        view = replace(view, target=view.target + picture.along[frame])
    if len(corners):
        here = choose_view(solution.mechanism, corners.reshape(-1, 3))
        view = here if FARTHEST_VIEW * here.distance < view.distance else view
    pixels = _rasterised(corners, np.concatenate(colours), view)
    out = io.BytesIO()
    image = Image.fromarray((255.0 * _trimmed(pixels)).round().astype(np.uint8))
    # 128 colours: a third of the size without visible loss.
    image.quantize(128, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
    return out.getvalue()


# --- shapes --------------------------------------------------------------------------------------


def _triangles(shape: Shape) -> FloatArray:
    """Corners (n, 3, 3) m of the triangles of a shape, in its own frame."""
    if isinstance(shape, Mesh):
        corners: FloatArray = np.asarray(shape.vertices, dtype=float)[np.asarray(shape.faces)]
        return corners
    if isinstance(shape, Box):
        corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
        sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        return _of_quads(corners[np.array(sides)] * np.array(shape.size))
    turn = np.linspace(0.0, 2.0 * np.pi, SIDES + 1)
    if isinstance(shape, Cylinder):
        # The outline from axis to axis, which is rotated about the axis.
        r, half = shape.radius, 0.5 * shape.length
        outline = np.array([(0.0, -half), (r, -half), (r, half), (0.0, half)])
    else:
        rise = np.linspace(-0.5 * np.pi, 0.5 * np.pi, SIDES // 2 + 1)
        outline = shape.radius * np.column_stack([np.cos(rise), np.sin(rise)])
    grid = np.stack(
        [
            np.outer(outline[:, 0], np.cos(turn)),
            np.outer(outline[:, 0], np.sin(turn)),
            np.repeat(outline[:, 1:], len(turn), axis=1),
        ],
        axis=-1,
    )
    quads = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2)
    return _of_quads(quads.reshape(-1, 4, 3))


def _of_quads(quads: FloatArray) -> FloatArray:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _placed(triangles: FloatArray, placement: pin.SE3) -> FloatArray:
    return np.asarray(triangles @ placement.rotation.T + placement.translation)


# --- drawing -------------------------------------------------------------------------------------


class _Canvas:
    """An image with a depth buffer."""

    def __init__(self) -> None:
        self.width, self.height = SUPERSAMPLING * SIZE[0], SUPERSAMPLING * SIZE[1]
        self._depths = np.full(self.height * self.width, np.inf)
        self._image = np.tile(np.array(BACKGROUND), (self.height * self.width, 1))

    def paint(self, corners: FloatArray, colours: FloatArray, columns: Any, rows: Any) -> None:
        """Rasterise triangles with corners (n, 3, 3), x, y and depth, on the samples (n, h, w) at
        ``columns`` and ``rows``.

        1/depth is linear on the screen.
        """
        (xa, ya), (xb, yb), (xc, yc) = corners[:, :, :2, None, None].transpose(1, 2, 0, 3, 4)
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        dx, dy = columns + 0.5 - xa, rows + 0.5 - ya
        with np.errstate(divide="ignore", invalid="ignore"):  # edge-on: covers no sample
            b = (dx * (yc - ya) - (xc - xa) * dy) / area
            c = ((xb - xa) * dy - dx * (yb - ya)) / area
            inside = (b >= 0.0) & (c >= 0.0) & (b + c <= 1.0)
        inside &= (columns >= 0) & (columns < self.width) & (rows >= 0) & (rows < self.height)
        owner, *_ = np.nonzero(inside)
        b, c, near = b[inside], c[inside], 1.0 / corners[owner, :, 2]
        depth = 1.0 / ((1.0 - b - c) * near[:, 0] + b * near[:, 1] + c * near[:, 2])
        place = (rows * self.width + columns)[inside]
        nearer = np.flatnonzero(depth < self._depths[place])
        order = nearer[np.argsort(-depth[nearer], kind="stable")]  # the nearest is written last
        self._depths[place[order]] = depth[order]
        self._image[place[order]] = colours[owner[order]]

    def pixels(self) -> FloatArray:
        """(height, width, 3), 0 to 1."""
        fine = self._image.reshape(SIZE[1], SUPERSAMPLING, SIZE[0], SUPERSAMPLING, 3)
        return np.asarray(fine.mean(axis=(1, 3)))


def _rasterised(triangles: FloatArray, colours: FloatArray, view: View) -> FloatArray:
    """Pixels (height, width, 3), 0 to 1, of triangles (n, 3, 3) m with colours (n, 3)."""
    canvas = _Canvas()
    seen = (triangles - view.target) @ view.axes.T
    normals = np.cross(seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0])
    sizes = np.linalg.norm(normals, axis=1)
    far = view.distance + seen[:, :, 2]
    kept = (sizes > 0.0) & (far > 0.0).all(axis=1)
    seen, colours, far = seen[kept], colours[kept], far[kept]
    normals = normals[kept] / sizes[kept, None]
    # Both sides are lit, because meshes have triangles of either orientation.
    towards = seen.mean(axis=1) + np.array([0.0, 0.0, view.distance])
    normals *= -np.sign(np.sum(normals * towards, axis=1))[:, None]
    light = AMBIENT + (1.0 - AMBIENT) * np.clip(normals @ LIGHT, 0.0, None)
    shaded = np.clip(colours * light[:, None], 0.0, 1.0)
    scale = 0.5 * canvas.height / math.tan(math.radians(0.5 * FIELD_OF_VIEW))
    x = 0.5 * canvas.width + scale * seen[:, :, 0] / far
    y = 0.5 * canvas.height - scale * seen[:, :, 1] / far
    corners = np.stack([x, y, far], axis=2)
    low = np.floor(corners[:, :, :2].min(axis=1)).astype(int)
    high = np.ceil(corners[:, :, :2].max(axis=1)).astype(int)
    visible = ((low < [canvas.width, canvas.height]) & (high > 0)).all(axis=1)
    corners, shaded, low, high = corners[visible], shaded[visible], low[visible], high[visible]
    widest = (high - low).max(axis=1)
    before = -1
    for side in BATCH_SIZES:
        chosen = np.flatnonzero((widest > before) & (widest <= side))
        before = side
        rows, columns = np.mgrid[:side, :side]
        for part in np.array_split(chosen, 1 + len(chosen) * side**2 // MAX_BATCH_SAMPLES):
            around = low[part][:, :, None, None]
            canvas.paint(corners[part], shaded[part], around[:, 0] + columns, around[:, 1] + rows)
    for k in np.flatnonzero(widest > before):
        (left, top), (right, bottom) = low[k].clip(0), high[k]
        rows, columns = np.mgrid[top : min(bottom, canvas.height), left : min(right, canvas.width)]
        canvas.paint(corners[k : k + 1], shaded[k : k + 1], columns[None], rows[None])
    return canvas.pixels()


def _trimmed(pixels: FloatArray) -> FloatArray:
    """The image without most of the background above and below."""
    rows = np.flatnonzero((pixels < 1.0).any(axis=(1, 2)))
    if not len(rows):
        return pixels
    return pixels[max(rows[0] - MARGIN, 0) : rows[-1] + MARGIN + 1]
