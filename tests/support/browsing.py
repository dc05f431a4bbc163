"""Pages in a real browser."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from srm_mbs.visualization.animation.meshcat_scene import node_names

SMALL, LARGE = (300, 200), (900, 600)
"""Windows (pixels): Chromium draws without a graphics card, a large one several times as long."""


@contextlib.contextmanager
def opened(
    browser: Any, address: str, size: tuple[int, int] = SMALL, plays: bool = False
) -> Iterator[Any]:
    """The loaded page, which is stopped unless it ``plays``; whatever it complains about, or asks
    the network for, is an error."""
    # Waiting for functions evaluates them in the page, which the policy of served pages forbids.
    viewport = {"width": size[0], "height": size[1]}
    context = browser.new_context(viewport=viewport, bypass_csp=True)
    page = context.new_page()
    complaints: list[str] = []

    def complain(kind: str, text: str, location: dict[str, Any]) -> None:
        if kind == "error" and not location["url"].endswith("favicon.ico"):  # meshcat serves none
            complaints.append(text)

    page.set_default_timeout(120_000.0)  # ms: machines may be busy
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda message: complain(message.type, message.text, message.location))
    allowed = ("file:", "data:", "blob:", address)
    page.on(
        "request",
        lambda request: request.url.startswith(allowed) or complaints.append(request.url),
    )
    if address.startswith("file:"):
        context.set_offline(True)
    page.goto(address)
    # The last frame: the page itself, or one in it.
    page.frames[-1].wait_for_function("viewer.scene_tree.children.mechanism !== undefined")
    if not plays:  # drawing a motion that nobody looks at would take a whole processor
        page.frames[-1].evaluate("viewer.animator.pause()")
    yield page
    context.close()
    assert complaints == []


@contextlib.contextmanager
def exported(
    browser: Any, folder: Path, motion: Any, size: tuple[int, int] = SMALL, **options: Any
) -> Iterator[Any]:
    """The page of a run or prescribed motion, exported with ``options`` to ``folder``."""
    path = folder / "page.html"
    motion.export_html(path, **options)
    with opened(browser, path.as_uri(), size) as page:
        yield page


BODIES = """t => {
  if (t !== null) { viewer.animator.pause(); viewer.animator.seek(t); }
  viewer.scene.updateMatrixWorld(true);
  const root = viewer.scene_tree.find(["mechanism"]);
  const world = root.object.matrixWorld.clone().invert();
  const found = {};
  for (const [name, node] of Object.entries(root.children))
    found[name] = world.clone().multiply(node.object.matrixWorld).toArray();
  return found;
}"""


POINT_OF = """([node, at]) => {
  viewer.render();
  viewer.scene.updateMatrixWorld(true);
  const place = new MeshCat.THREE.Vector3(...at).applyMatrix4(
    viewer.scene_tree.find(["mechanism", node]).object.matrixWorld).project(viewer.camera);
  const box = pane.getBoundingClientRect();
  return [box.left + 0.5 * (1 + place.x) * box.width, box.top + 0.5 * (1 - place.y) * box.height];
}"""
"""Where a point of a body is seen in the window (pixels)."""


DRAWN = """() => {
  const info = viewer.renderer.info;
  info.autoReset = false;
  info.reset();
  viewer.render();  // with the pass of the shadows
  return [info.render.calls, info.render.triangles];
}"""
"""Calls and triangles of one picture."""


def bodies_in(page: Any, t: float | None = None) -> dict[str, Any]:
    """Placement (4, 4) of each body in a page or frame, at the animation's time ``t``."""
    found = page.evaluate(BODIES, t)
    return {name: np.array(matrix).reshape(4, 4).T for name, matrix in found.items()}


def assert_in_place(page: Any, motion: Any, t: float, within: float = 1e-6) -> set[str]:
    """The bodies in a page at t are where forward kinematics puts them; returns their names."""
    found, (q, _) = bodies_in(page, t), motion(t)
    for name, placement in zip(node_names(motion.mechanism), placements(motion.mechanism, q)):
        if name in found:
            assert np.abs(found[name] - placement.homogeneous).max() < within, (name, t)
    return set(found)


def placements(mechanism: srm.Mechanism, q: Any) -> list[pin.SE3]:
    """Of the ground and all joints, by Pinocchio's forward kinematics."""
    data = mechanism.model.createData()
    pin.forwardKinematics(mechanism.model, data, np.array(q))
    return [pin.SE3(placement) for placement in data.oMi]
