"""The page of every bundled mechanism, and of one with meshes and a floating base, in a browser."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.visualization.animation.meshcat_scene import node_names
from srm_mbs.visualization.animation.shapes import Mesh, visuals_of
from srm_mbs.visualization.animation.trajectory import MAX_BODY_FRAMES
from tests.support.browsing import DRAWN, assert_in_place, opened
from tests.support.bundled import load, problem
from tests.support.mechanisms import DISTINCT_MODELS

FPS = 32.0
SPANS = {"squeezing_mechanism": 0.03125, "cassie": 0.375}
"""Whole key frames (s); these two move fast, or far."""
PHONE = (200, 350)

REACH = """times => times.map(t => {
  seek(t);
  viewer.scene.updateMatrixWorld(true);
  viewer.camera.updateMatrixWorld(true);
  const reach = [0, 0, 0];
  const measure = o => {
    if (!o.isMesh || o.material.isShadowMaterial) return;  // the ground leaves the picture
    o.geometry.computeBoundingBox();
    const {min, max} = o.geometry.boundingBox;
    for (const x of [min.x, max.x]) for (const y of [min.y, max.y]) for (const z of [min.z, max.z])
      new MeshCat.THREE.Vector3(x, y, z).applyMatrix4(o.matrixWorld).project(viewer.camera)
        .toArray().forEach((c, i) => { reach[i] = Math.max(reach[i], Math.abs(c)); });
  };
  for (const name of ["mechanism", "overlays"])
    viewer.scene_tree.find([name]).object.traverse(measure);
  return reach;
})"""
"""How far the shapes reach in the picture at some times: across, up and in depth, 1 at its edges.
All at once, so that the pictures need not be drawn."""


@cache
def run(name: str) -> srm.Solution:
    span = SPANS.get(name, 1.5)
    if name == "cassie":
        return srm.simulate(problem("cassie").mechanism, span, rtol=1e-6)
    return srm.simulate(load(name), span)


CHOSEN = {"slider_crank"}
"""Beside cassie, which is spatial; all others take a minute."""


@pytest.mark.browser
@pytest.mark.parametrize(
    "name",
    [
        "cassie",
        *(
            pytest.param(name, marks=[] if name in CHOSEN else pytest.mark.stress)
            for name in DISTINCT_MODELS
        ),
    ],
)
def test_the_page_is_small_needs_no_network_and_shows_every_body_in_its_place(
    browser: Any, tmp_path: Path, name: str
) -> None:
    solution = run(name)
    end = solution.span[1]
    path = tmp_path / "page.html"
    solution.export_html(path, fps=FPS)
    names, visuals = node_names(solution.mechanism), visuals_of(solution.mechanism)
    meshes = [visual.shape for visual in visuals if isinstance(visual.shape, Mesh)]
    # In single precision, as text of 6 bits each.
    size = sum(4 * (mesh.vertices.size + mesh.faces.size) for mesh in meshes) * 8 // 6
    assert path.stat().st_size - size < 2.5e6
    drawn = {names[visual.joint] for visual in visuals}
    with opened(browser, path.as_uri()) as page:
        # On key frames: single precision; between them the browser goes straight.
        for t in {0.0, end, round(0.4 * end * FPS) / FPS}:
            assert drawn <= assert_in_place(page, solution, t)
        reach = np.array(page.evaluate(REACH, np.linspace(0.0, end, 7).tolist()))
        assert reach.shape == (7, 3)
        assert reach.max() < 1.0
        assert reach[:, :2].max() > 0.3  # it is not a speck either
        calls, triangles = page.evaluate(DRAWN)
        assert calls < 300
        assert triangles < 2e5
        if name in ("slider_crank", "stewart_platform"):
            page.set_viewport_size({"width": PHONE[0], "height": PHONE[1]})
            page.wait_for_function("away > 1.5")
            assert np.max(page.evaluate(REACH, [0.0, 0.5 * end, end])) < 1.0


def test_cassie_is_drawn_by_the_meshes_of_its_file_on_every_moving_body() -> None:
    mechanism = run("cassie").mechanism
    visuals = visuals_of(mechanism)
    assert sum(isinstance(visual.shape, Mesh) for visual in visuals) >= 20
    assert {visual.joint for visual in visuals} >= set(range(1, mechanism.model.njoints))


@pytest.mark.browser
def test_a_thousand_seconds_are_a_light_page(browser: Any, tmp_path: Path) -> None:
    solution = srm.simulate(srm.load("slider_crank"), 1000.0)
    path = tmp_path / "page.html"
    solution.export_html(path)
    assert path.stat().st_size < 5e6
    with opened(browser, path.as_uri()) as page:
        loaded = page.evaluate("performance.timing.loadEventEnd - performance.timing.fetchStart")
        assert loaded < 10e3  # 1 to 2.5 s on two cores that do six other things
        frames = page.evaluate(
            "Math.max(...animator.actions.flatMap(a => a._clip.tracks.map(t => t.times.length)))"
        )
        assert frames == 1 + MAX_BODY_FRAMES // 2
        # The page counts the time in single precision: 3e-5 s here, at up to 3 rad/s and 4 m.
        assert_in_place(page, solution, 1000.0 * 7503 / 15000, within=5e-4)
