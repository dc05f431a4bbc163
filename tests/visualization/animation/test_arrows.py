"""Arrows of forces and moments: what the page draws, against equations of motion and laws."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.visualization.animation.arrows import CUT, LONGEST, Arrows
from srm_mbs.visualization.animation.overlays import ViewOptions
from srm_mbs.visualization.animation.scene import make_picture
from srm_mbs.visualization.animation.video import BARE, photographer
from tests.support.browsing import exported, placements
from tests.support.bundled import load
from tests.support.screenshots import pixels

DRAWN = """async t => {
  seek(t);
  const frame = () => new Promise(resolve => requestAnimationFrame(resolve));
  await frame(); await frame(); await frame();
  const matrices = (mesh) => Array.from({ length: mesh.count }, (_, i) =>
    Array.from(mesh.instanceMatrix.array.slice(16 * i, 16 * i + 16)));
  const { shafts, arcs, heads, all } = arrows;
  return { labels: all.map(({ label }) => label), kinds: all.map(({ kind }) => kind),
    shafts: matrices(shafts), arcs: matrices(arcs), heads: matrices(heads),
    scales: about.arrows.scales };
}"""


def drawn(page: Any, t: float) -> dict[str, tuple[Any, Any]]:
    """Start (3,) m and vector (3,) of each arrow that the page draws at t, by its label."""
    found = page.evaluate(DRAWN, t)
    next_of = {"force": iter(found["shafts"]), "moment": iter(found["arcs"])}
    out = {}
    for label, kind, head in zip(found["labels"], found["kinds"], found["heads"]):
        line = np.array(next(next_of[kind])).reshape(4, 4).T
        tip = np.linalg.norm(np.array(head).reshape(4, 4).T[:3, 1])
        if not tip:
            continue
        along = line[:3, 1 if kind == "force" else 2]
        size = np.linalg.norm(along)
        length = size + tip if kind == "force" else size
        out[label] = (line[:3, 3], along / size * length / found["scales"][kind]["length"])
    return out


@pytest.fixture(scope="module")
def driven() -> srm.Solution:
    linkage = srm.planar(
        points={"O": (0, 0), "A": (40, 0), "B": (120, 80), "C": (150, 0)},
        bars={"crank": ("O", "A"), "coupler": ("A", "B"), "rocker": ("B", "C")},
        ground=("O", "C"),
        unit="mm",
        mass_per_length=1.0,
        drives={"O": 6.28},
    )
    return srm.simulate(linkage, 1.0)


@pytest.fixture(scope="module")
def page(
    browser: Any, driven: srm.Solution, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("page")
    with exported(browser, folder, driven, (660, 440), fps=64.0, arrows=True) as shown:
        yield shown


@pytest.mark.browser
@pytest.mark.parametrize("t", [0.0, 0.25, 0.640625])
def test_an_arrow_starts_at_its_joint_and_is_the_force_there_to_scale(
    page: Any, driven: srm.Solution, t: float
) -> None:
    found, there = drawn(page, t), driven.at([t])
    model = driven.mechanism.model
    places = placements(driven.mechanism, there.q[0])
    assert {"force in A", "force in B", "force in C", "force in O", "moment of O"} <= set(found)
    for name in ("A", "C", "O"):
        start, force = found[f"force in {name}"]
        assert start == pytest.approx(places[model.getJointId(name)].translation, abs=1e-7)
        assert force == pytest.approx(there.joint_reactions[name][0, :3], rel=1e-4, abs=1e-4)
    start, force = found["force in B"]  # the closure
    assert force == pytest.approx(there.reactions["B"][0, :3], rel=1e-4, abs=1e-4)
    _, torque = found["moment of O"]
    # The drive is the only moment on the crank, whose joint carries none otherwise.
    assert torque == pytest.approx(there.joint_reactions["O"][0, 3:], rel=1e-4, abs=1e-5)
    assert np.linalg.norm(torque) == pytest.approx(abs(there.drive_forces["O"][0]), rel=1e-4)
    assert "moment in O" not in found


@pytest.mark.browser
@pytest.mark.parametrize("joint", ["O", "A", "C"])
def test_the_arrows_on_a_chosen_body_and_its_weight_are_mass_times_acceleration(
    page: Any, driven: srm.Solution, joint: str
) -> None:
    t, model = 0.25, driven.mechanism.model
    page.locator("#body").select_option(joint)
    try:
        on_body = drawn(page, t)
        rows = page.locator("#panel tr").all_inner_texts()
    finally:
        page.keyboard.press("Escape")
    total = sum(vector for label, (_, vector) in on_body.items() if label.startswith("force"))
    # Positions of the centre of mass, differentiated twice: no equation of motion.
    body, h = model.getJointId(joint), 1e-3
    at = [
        placements(driven.mechanism, driven(t + k * h)[0])[body].act(model.inertias[body].lever)
        for k in (-1, 0, 1)
    ]
    acceleration = (at[0] - 2.0 * at[1] + at[2]) / h**2
    wanted = model.inertias[body].mass * (acceleration - model.gravity.linear)
    assert total == pytest.approx(wanted, rel=2e-3, abs=1e-3)
    size = np.linalg.norm(driven.at([t]).joint_reactions[joint][0, :3])
    (row,) = [text for text in rows if text.startswith(f"force in {joint}\t")]
    assert float(row.split("\t")[1]) == pytest.approx(size, rel=6e-3)


@pytest.mark.browser
def test_the_key_f_and_its_button_hide_and_show_the_arrows(page: Any) -> None:
    button = page.get_by_role("button", name="Forces")
    assert drawn(page, 0.25)
    assert button.get_attribute("aria-pressed") == "true"
    page.keyboard.press("f")
    assert not drawn(page, 0.25)
    assert button.get_attribute("aria-pressed") == "false"
    button.click()
    assert drawn(page, 0.25)


@pytest.mark.browser
def test_the_bar_of_the_legend_is_as_long_as_an_arrow_of_its_force(page: Any) -> None:
    drawn(page, 0.25)
    bar = page.locator("#notes .bar[data-kind=force]")
    number, unit = bar.inner_text().split()
    assert unit == "N"
    width = bar.locator("span").first.bounding_box()["width"]
    scale = page.evaluate("about.arrows.scales.force.length")
    # The picture looks along y: a pixel of its middle plane, by the projection of the camera.
    pixels = page.evaluate(
        """length => {
          const camera = viewer.camera, p = (x) => new MeshCat.THREE.Vector3(x, 0, 0)
            .applyMatrix4(viewer.scene.matrixWorld).project(camera).x;
          return (p(length) - p(0)) / 2 * pane.clientWidth;
        }""",
        scale * float(number),
    )
    assert width == pytest.approx(pixels, abs=1.0)


def arrows_in(solution: srm.Solution) -> Arrows:
    found = make_picture(solution, 60.0, ViewOptions(arrows=True)).overlays.arrows
    assert found is not None
    return found


def test_a_spring_has_an_arrow_at_each_end_that_is_its_law() -> None:
    solution = srm.simulate(load("flyball_governor"), 0.5)
    found = arrows_in(solution)
    spring = next(f for f in solution.mechanism.forces if isinstance(f, srm.SpringDamper))
    first, second = (a for a in found.arrows if a.label == f"force of {spring.name}")
    frame = len(found.times) // 2

    t = found.times[frame]
    ends = [solution.at([t]).point(side) for side in (spring.a, spring.b)]
    a, b = (end.position[0] for end in ends)
    length = float(np.linalg.norm(a - b))
    rate = (ends[0].velocity[0] - ends[1].velocity[0]) @ (a - b) / length
    size = spring.stiffness * (length - spring.rest_length)
    size += spring.damping * rate
    assert first.vectors[frame] == pytest.approx(-size * (a - b) / length, rel=1e-9)
    assert second.vectors[frame] == pytest.approx(size * (a - b) / length, rel=1e-9)
    places = placements(solution.mechanism, solution(t)[0])
    for arrow, end in ((first, a), (second, b)):
        start = places[arrow.joint].act(arrow.point)
        assert start == pytest.approx(end, abs=1e-12)


def test_a_closure_that_an_event_removes_has_no_arrow_afterwards() -> None:
    ring = load("four_bar")
    freed = ring.without_loop("pin")
    cut = srm.Event(lambda t, q, v: t - 0.25, action=lambda t, q, v: srm.Switch(freed))
    found = arrows_in(srm.simulate(ring, 0.5, events=[cut]))
    (arrow,) = (a for a in found.arrows if a.label == "force in pin")
    acts = np.isfinite(arrow.vectors).all(axis=1)
    assert acts.tolist() == (found.times < 0.25 - 1e-12).tolist()


def test_the_largest_robust_force_has_the_largest_length_and_peaks_are_cut() -> None:
    found = arrows_in(srm.simulate(load("slider_crank"), 4.0))
    sizes = [np.linalg.norm(a.vectors, axis=1) for a in found.arrows if a.kind == "force"]
    robust = max(np.percentile(own, 98.0) for own in sizes)
    assert found.length("force") * robust == pytest.approx(LONGEST["force"] * found.extent)
    data = found.data([f"node_{i}" for i in range(20)])
    assert data["scales"]["force"]["longest"] == CUT * LONGEST["force"] * found.extent


def test_forces_that_equilibrium_does_not_determine_are_grey_and_those_in_a_plane_are_not() -> None:
    groups = {a.group for a in arrows_in(srm.simulate(load("four_bar"), 0.5)).arrows}
    assert groups == {"reactions"}  # its redundant components, across the plane, are zero
    bricard = arrows_in(srm.simulate(load("bricard"), 0.5))
    assert "indeterminate reactions" in {a.group for a in bricard.arrows}
    assert bricard.note()["more"].startswith("indeterminate")


def test_arrows_are_refused_where_no_forces_are_known() -> None:
    mechanism = load("four_bar")
    motion = srm.JointMotion(mechanism, np.array([0.0]), mechanism.q0[None])
    with pytest.raises(srm.InputError, match="not simulated has no forces"):
        motion.show(arrows=True)
    with pytest.raises(srm.InputError, match="arrows"):
        ViewOptions(arrows="yes").check(mechanism)  # type: ignore[arg-type]


@pytest.mark.browser
def test_a_picture_has_the_arrows_of_its_time_and_their_legend(
    browser: Any, driven: srm.Solution, tmp_path: Path
) -> None:
    """As a photograph of the page at that time, which shows both."""
    view, size = ViewOptions(arrows=True), (300, 200)
    with photographer(driven, size, 60.0, view, [0.3, 0.8], browser) as photograph:
        pictures = [pixels(photograph(t)) for t in (0.3, 0.8)]
    with exported(browser, tmp_path, driven, size, arrows=True, panel=False) as page:
        page.add_style_tag(content=BARE)
        page.evaluate("viewer.renderer.setPixelRatio(2); viewer.set_3d_pane_size()")
        for t, picture in zip((0.3, 0.8), pictures):
            page.evaluate(DRAWN, t)
            assert np.abs(pixels(page.screenshot()) - picture).max() < 0.05
    assert np.abs(pictures[0] - pictures[1]).max() > 0.5


@pytest.mark.browser
def test_on_a_phone_the_legend_covers_the_motion_only_when_it_is_asked_for(page: Any) -> None:
    before = page.viewport_size
    legend, button = page.locator("#notes"), page.get_by_role("button", name="Legend")
    assert legend.is_visible()
    assert not button.is_visible()
    page.set_viewport_size({"width": 360, "height": 560})
    button.wait_for()
    assert not legend.is_visible()
    assert button.get_attribute("aria-expanded") == "false"
    covered = page.locator("#panel").bounding_box()["height"]
    button.click()
    assert legend.is_visible()
    assert "reactions" in legend.inner_text()
    assert page.locator("#panel").bounding_box()["height"] > covered
    button.click()
    assert not legend.is_visible()
    page.set_viewport_size(before)
    legend.wait_for()
