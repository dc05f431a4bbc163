"""What a page shows beside the bodies: values, passages, springs, paths, gaps, reactions."""

from __future__ import annotations

import io
import math
import re
import sys
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from PIL import Image

import srm_mbs as srm
from srm_mbs.dynamics.constraints.rheonomic import constraint_errors
from srm_mbs.visualization.animation import overlays
from srm_mbs.visualization.animation.overlays import (
    ViewOptions,
    gaps_of,
    ramp_colours,
    turns_along,
)
from srm_mbs.visualization.animation.page import SCRIPTS, make_page, page_data, values_over_time
from srm_mbs.visualization.animation.scene import ASPECT, FIELD_OF_VIEW, FILLED_PART, make_picture
from srm_mbs.visualization.animation.snapshot import draw_snapshot
from srm_mbs.visualization.animation.video import BARE
from tests.support.browsing import DRAWN, POINT_OF, exported, opened, placements
from tests.support.bundled import load
from tests.support.commands import run
from tests.support.mechanisms import floating_ring
from tests.support.pacing import assert_pace
from tests.support.snapshots import check_messages, refused

ROD = srm.Anchor("rod", xyz=(0.5, 0.0, 0.2))


def place(solution: srm.Solution, t: float, anchor: srm.Anchor) -> Any:
    """Where an anchor is at t, by forward kinematics of the dense output."""
    joint, placement = anchor.resolve(solution.mechanism.model)
    return (placements(solution.mechanism, solution(t)[0])[joint] * placement).translation


@pytest.fixture(scope="module")
def slider_crank() -> srm.Solution:
    return srm.simulate(load("slider_crank"), 8.0)


@pytest.fixture(scope="module")
def page(
    browser: Any,
    slider_crank: srm.Solution,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Any]:
    """The slider-crank with the path of a point of its rod, at whole 1/64 s."""
    folder, options = tmp_path_factory.mktemp("page"), {"fps": 64.0, "trace": [ROD]}
    with exported(browser, folder, slider_crank, (660, 400), **options) as shown:
        yield shown


READ = """async t => {
  seek(t);
  const frame = () => new Promise(resolve => requestAnimationFrame(resolve));
  await frame(); await frame();
  return [...document.querySelectorAll("#panel tr")].map(row =>
    [...row.cells].map(cell => cell.textContent));
}"""


def panel(page: Any, t: float) -> dict[str, tuple[float, str]]:
    """Values and units in the panel at the animation's time t."""
    rows = page.evaluate(READ, t)
    return {name: (float(text.replace("\u2212", "-")), unit) for name, text, unit in rows}


@pytest.mark.browser
@pytest.mark.parametrize("t", [0.0, 0.640625, 2.5, 5.015625, 8.0])
def test_the_panel_shows_time_drift_energy_and_sigma_of_the_run_at_that_time(
    page: Any, slider_crank: srm.Solution, t: float
) -> None:
    there = slider_crank.at([0.0, t])
    found = panel(page, t)
    assert found["t"] == (pytest.approx(t, abs=5.1e-4), "s")
    assert found["drift |g| between steps"] == (pytest.approx(there.drift[1, 0], rel=6e-3), "m")
    change = there.energy[1] - there.energy[0]
    assert found["energy change"] == (pytest.approx(change, rel=6e-3), "J")
    # Evaluated there; in the panel it is recorded at the stages.
    q, v = slider_crank(t)
    sigma = slider_crank._system.evaluate(t, np.concatenate([q, v])).sigma
    assert found["sigma"][0] == pytest.approx(sigma, abs=4e-3)
    assert found["sigma"][1] == ""


@pytest.mark.browser
def test_passages_are_marked_on_the_slider_where_its_thumb_is_at_their_times(
    page: Any, slider_crank: srm.Solution
) -> None:
    crossings = slider_crank.crossings
    assert len(crossings) == 4
    line = page.locator("#time").bounding_box()
    marks = page.locator("#marks button")
    assert marks.count() == len(crossings)
    for mark, crossing in zip(marks.all(), crossings):
        box = mark.bounding_box()
        middle = box["x"] + 0.5 * box["width"]
        thumb = line["x"] + 8.0 + crossing.time / 8.0 * (line["width"] - 16.0)
        assert middle == pytest.approx(thumb, abs=0.6)
        said = mark.get_attribute("title")
        assert f"t = {crossing.time:.4g} s: {', '.join(crossing.loops)}" in said
        assert crossing.loops
        mark.click()
        assert page.evaluate("animator.time") == pytest.approx(crossing.time, rel=1e-9)
        assert page.evaluate("animator.playing") is False
        assert panel(page, crossing.time)["sigma"][0] < 1e-6


def choose_speed(page: Any, speed: str) -> None:
    page.locator("#speed").select_option(speed)


@pytest.mark.browser
@pytest.mark.parametrize(
    "seconds", [1.0, pytest.param(7.3, marks=pytest.mark.stress)], ids=["short", "all"]
)
def test_the_run_is_played_in_real_time_to_two_percent(page: Any, seconds: float) -> None:
    page.evaluate("seek(0.1)")
    assert_pace(page, seconds)


@pytest.mark.browser
@pytest.mark.parametrize("speed", ["0.25", pytest.param("4", marks=pytest.mark.stress)])
def test_the_motion_is_played_at_the_chosen_speed_after_scrubbing(page: Any, speed: str) -> None:
    page.locator("#time").fill("2.5")
    assert page.evaluate("[animator.playing, animator.time]") == [False, 2.5]
    choose_speed(page, speed)
    assert_pace(page, 0.8, float(speed))
    choose_speed(page, "1")
    page.locator("#time").fill("1")
    assert_pace(page, 0.8)


@pytest.mark.stress
@pytest.mark.browser
def test_a_page_that_cannot_keep_up_leaves_pictures_out_and_keeps_the_time(page: Any) -> None:
    page.evaluate("""() => {
      seek(0.5);
      window.heavy = true;
      (function burn() {
        const until = performance.now() + 120;
        while (performance.now() < until);
        if (window.heavy) requestAnimationFrame(burn);
      })();
    }""")
    assert_pace(page, 1.2)
    page.evaluate("window.heavy = false")


@pytest.mark.browser
def test_keys_play_pause_and_scrub(page: Any) -> None:
    def now() -> tuple[bool, float]:
        playing, t = page.evaluate("[animator.playing, animator.time]")
        return playing, t

    page.evaluate("seek(2)")
    page.locator("#meshcat-pane").click(position={"x": 300, "y": 200})  # the focus is nowhere
    page.keyboard.press("Space")
    page.wait_for_function("animator.playing && animator.time > 2.05")
    page.keyboard.press("Space")
    assert now()[0] is False
    for key, t in [("Home", 0.0), ("ArrowRight", 0.08), ("ArrowRight", 0.16), ("ArrowLeft", 0.08)]:
        page.keyboard.press(key)
        assert now() == (False, pytest.approx(t, abs=1e-9))
    page.keyboard.press("End")
    assert now() == (False, 8.0)
    page.keyboard.press("ArrowRight")
    assert now() == (False, 8.0)
    # The keys of a control are its own.
    page.locator("#speed").focus()
    page.keyboard.press("ArrowDown")
    assert page.locator("#speed").input_value() == "2"
    assert now() == (False, 8.0)
    page.keyboard.press("ArrowUp")
    page.locator("#loop").focus()
    page.keyboard.press("Space")
    assert page.locator("#loop").is_checked() is False
    page.keyboard.press("Space")
    assert now()[0] is False
    page.locator("#toggle").focus()
    page.keyboard.press("Space")
    assert now()[0] is True
    page.keyboard.press("Enter")
    assert now()[0] is False
    first = page.evaluate("about.passages[0].time")
    page.locator("#marks button").first.focus()
    page.keyboard.press("Enter")
    assert page.evaluate("animator.time") == pytest.approx(first)
    # A click of the mouse on a mark leaves the keys to the motion.
    page.evaluate("seek(0)")
    page.locator("#marks button").first.click()
    assert now() == (False, pytest.approx(first))
    page.keyboard.press("Space")
    page.wait_for_function(f"animator.playing && animator.time > {first} + 0.05")
    page.keyboard.press("Space")
    assert now()[0] is False


@pytest.mark.browser
def test_the_controls_are_reached_by_tab_and_have_names_to_be_read_aloud(page: Any) -> None:
    named = {
        page.get_by_role("slider", name="time"): "#time",
        page.get_by_role("combobox", name="speed"): "#speed",
        page.get_by_role("checkbox", name="Loop"): "#loop",
        page.get_by_role("img", name="slider_crank"): "#meshcat-pane",
        page.get_by_role("group", name="values of the run"): "#panel",
    }
    for found, selector in named.items():
        assert found.count() == 1, selector
        assert found.evaluate("(node, s) => node.matches(s)", selector)
    page.evaluate(READ, 2.0)
    assert page.get_by_role("slider").get_attribute("aria-valuetext") == "2.00 / 8.00 s"
    assert page.get_by_role("button", name="Play", exact=True).count() == 1
    assert page.get_by_role("button", name="singular configuration passed").count() == 4
    page.locator("#toggle").focus()
    reached = []
    for _ in range(4):
        reached.append(page.evaluate("document.activeElement.id"))
        page.keyboard.press("Tab")
    assert reached == ["toggle", "speed", "loop", "time"]


@pytest.mark.browser
def test_the_pointer_names_a_body_and_a_click_or_touch_shows_the_values_of_its_joint(
    page: Any, slider_crank: srm.Solution
) -> None:
    page.evaluate("seek(2.5)")
    x, y = page.evaluate(POINT_OF, ["rod", [1.0, 0.0, 0.0]])
    tip = page.locator("#tip")
    page.mouse.move(x, y)
    assert tip.is_visible()
    assert tip.inner_text() == "rod"
    page.mouse.move(5.0, 390.0)  # the bar
    assert not tip.is_visible()
    page.mouse.click(x, y)
    q, v = slider_crank.at([2.5]).joint("rod")
    found = {name: text for name, text, _ in page.evaluate(READ, 2.5)}
    assert float(found["rod rate"].replace("\u2212", "-")) == pytest.approx(v[0], rel=6e-3)
    # The name of the body stands above its values.
    rows = page.evaluate(READ, 2.5)
    assert [row[0] for row in rows][-3:] == ["rod", "rod", "rod rate"]
    assert float(rows[-2][1].replace("\u2212", "-")) == pytest.approx(q[0], rel=6e-3)
    assert [row[2] for row in rows][-3:] == ["", "rad", "rad/s"]
    opacity = """n => Object.values(body_root().children[n].children)[0]
        .children["<object>"].object.material.opacity"""
    assert page.evaluate(opacity, "crank") < 0.5
    assert page.evaluate(opacity, "rod") == 1.0
    # Turning the picture is no click.
    page.mouse.move(30.0, 250.0)
    page.mouse.down()
    page.mouse.move(60.0, 250.0)
    page.mouse.up()
    assert page.locator("#body").input_value() == "rod"
    page.mouse.move(60.0, 250.0)
    page.mouse.down()
    page.mouse.move(30.0, 250.0)
    page.mouse.up()
    page.keyboard.press("Escape")
    assert "rod rate" not in {row[0] for row in page.evaluate(READ, 2.5)}
    assert page.evaluate(opacity, "crank") == 1.0
    # For keyboards and screen readers there is a list.
    page.get_by_role("combobox", name="body").select_option("crank")
    assert "crank rate" in {row[0] for row in page.evaluate(READ, 2.5)}
    page.get_by_role("combobox", name="body").select_option("")


@pytest.mark.browser
def test_a_touch_chooses_a_body_on_a_phone(
    browser: Any, slider_crank: srm.Solution, tmp_path: Path
) -> None:
    path = tmp_path / "page.html"
    slider_crank.export_html(path, fps=20.0)
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True)
    shown = context.new_page()
    shown.goto(path.as_uri())
    shown.wait_for_function("away > 1.5")
    shown.evaluate("seek(2.5)")
    x, y = shown.evaluate(POINT_OF, ["crank", [1.0, 0.0, 0.0]])
    shown.touchscreen.tap(x, y)
    shown.wait_for_function("chosen === 'crank'")
    boxes = [shown.locator(name).bounding_box() for name in ("#panel", "#corner", "#bar")]
    for above, below in pairwise(boxes):
        assert above["y"] + above["height"] <= below["y"]
    assert all(box["x"] >= 0.0 and box["x"] + box["width"] <= 390.0 for box in boxes)
    context.close()


@pytest.mark.browser
def test_curves_are_in_step_with_the_motion_and_a_click_on_one_moves_the_time(page: Any) -> None:
    page.keyboard.press("c")
    page.wait_for_selector(".curve")
    page.locator("#quantity").select_option("rod rate")
    page.locator("#quantity").select_option("rod rate")  # there is one of each
    heads = page.locator(".curve .head span:first-child")
    assert heads.all_inner_texts() == ["sigma", "rod rate (rad/s)"]
    plot = page.locator(".curve svg").last
    box = plot.bounding_box()
    page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 20.0)
    assert page.evaluate("[animator.playing, animator.time]") == [
        False,
        pytest.approx(2.0, abs=8.0 / box["width"]),
    ]
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 20.0)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + 20.0)
    page.mouse.up()
    time = page.evaluate("animator.time")
    assert time == pytest.approx(6.0, abs=8.0 / box["width"])
    page.wait_for_function(
        "t => Math.abs(curves[1].cursor.x1.baseVal.value - 125 * t) < 1", arg=time
    )
    # The curve is where the panel says: the height of its point there, between its ends.
    high, low = page.evaluate("[Math.max, Math.min].map(f => f(...curves[1].value.samples))")
    points = page.evaluate(
        "[...document.querySelectorAll('.plot path')].at(-1).getAttribute('d').slice(1).split('L')"
    )
    x, y = np.array([[float(c) for c in point.split(" ")] for point in points]).T
    here = page.evaluate("t => value_at(curves[1].value, t)", time)
    height = high - (np.interp(125.0 * time, x, y) - 4.0) / 76.0 * (high - low)
    assert height == pytest.approx(here, abs=0.01 * (high - low))
    assert page.locator(".curve").last.locator(".passage").count() == 4
    page.get_by_role("button", name="remove the curve of rod rate").click()
    assert heads.all_inner_texts() == ["sigma"]
    page.locator("#show-curves").click()
    assert not page.locator("#curves").is_visible()


@pytest.mark.browser
def test_the_picture_says_when_a_singular_configuration_is_passed(
    page: Any, slider_crank: srm.Solution
) -> None:
    flash, time = page.locator("#flash"), slider_crank.crossings[1].time
    page.evaluate("t => seek(t)", time - 0.5)
    page.wait_for_selector("#flash", state="hidden")
    page.evaluate("t => seek(t)", time)
    page.wait_for_selector("#flash", state="visible")
    assert f"t = {time:.4g} s" in flash.inner_text()
    # While it plays, long enough to be read, at any speed.
    page.evaluate("t => seek(t)", time - 0.2)
    page.wait_for_selector("#flash", state="hidden")
    page.locator("#toggle").click()
    page.wait_for_selector("#flash", state="visible")
    page.wait_for_function("t => animator.time > t + 0.5", arg=time)
    page.wait_for_selector("#flash", state="hidden")


LOWEST = """times => Math.min(...times.map(t => {
  seek(t);
  viewer.scene.updateMatrixWorld(true);
  const up = ground.userData.up, world = body_root().object.matrixWorld.clone().invert();
  let lowest = Infinity;
  for (const node of Object.values(body_root().children)) node.object.traverse(mesh => {
    if (!mesh.isMesh) return;
    mesh.geometry.computeBoundingBox();
    const {min, max} = mesh.geometry.boundingBox;
    for (const x of [min.x, max.x]) for (const y of [min.y, max.y]) for (const z of [min.z, max.z])
      lowest = Math.min(lowest, new MeshCat.THREE.Vector3(x, y, z)
        .applyMatrix4(mesh.matrixWorld).applyMatrix4(world).dot(up));
  });
  return lowest;
}))"""
"""The lowest point of the bodies at some times (m), against gravity."""


@pytest.mark.browser
def test_the_ground_lies_below_the_motion_across_gravity_and_has_shadows(
    page: Any, slider_crank: srm.Solution
) -> None:
    gravity = slider_crank.mechanism.model.gravity.linear
    up = np.array(page.evaluate("ground.userData.up.toArray()"))
    np.testing.assert_allclose(up, -gravity / np.linalg.norm(gravity), atol=1e-12)
    lowest = page.evaluate(LOWEST, np.linspace(0.0, 8.0, 41).tolist())
    height, size = page.evaluate("[about.ground.height, about.ground.size]")
    assert 0.0 < lowest - height < 0.02 * size

    def picture() -> Any:
        page.evaluate(READ, 2.5)
        image = Image.open(io.BytesIO(page.locator("#meshcat-pane").screenshot()))
        return np.asarray(image.convert("L"), dtype=float)

    page.evaluate('hover("")')  # a body below the pointer would be brighter
    lit = "on => { ground.children.find(c => c.isLight).castShadow = on; viewer.set_dirty(); }"
    page.evaluate(lit, False)  # compiles materials that earlier tests have changed
    plain = picture()
    page.evaluate(lit, True)
    shaded = picture()
    assert (plain - shaded).max() > 10.0
    assert (shaded - plain).max() < 10.0  # nothing is brighter


@pytest.mark.browser
def test_the_bar_is_as_long_as_it_says_and_the_axes_are_those_of_the_world(page: Any) -> None:
    page.wait_for_function("element('length').textContent !== ''")

    def bar() -> tuple[float, float]:
        number, unit = page.locator("#length").inner_text().split()
        metres = float(number) * {"m": 1.0, "mm": 1e-3}[unit]
        return metres, page.locator("#length").bounding_box()["width"]

    length, pixels = bar()
    # Two points beside the target of the camera, across the direction of view.
    seen = page.evaluate(
        """length => {
          const camera = viewer.camera, at = viewer.controls.target.clone()
            .applyMatrix4(camera.parent.matrixWorld).applyMatrix4(camera.matrixWorldInverse);
          const x = [0, length].map(d => new MeshCat.THREE.Vector3(at.x + d, at.y, at.z)
            .applyMatrix4(camera.projectionMatrix).x);
          return 0.5 * (x[1] - x[0]) * pane.clientWidth;
        }""",
        length,
    )
    assert pixels == pytest.approx(seen, rel=0.01)
    assert f"{length:.0e}"[0] in "125"
    page.evaluate("viewer.camera.position.multiplyScalar(0.125); viewer.set_dirty()")
    page.wait_for_function("text => element('length').textContent !== text", arg=f"{length:g} m")
    assert bar()[0] < 0.3 * length
    page.evaluate("viewer.camera.position.multiplyScalar(8); viewer.set_dirty()")
    ends = page.evaluate(
        "['x', 'y', 'z'].map(n => [element(`axis-${n}`).x2.baseVal.value - 28,"
        " 28 - element(`axis-${n}`).y2.baseVal.value])"
    )
    view = make_picture(srm.simulate(load("slider_crank"), 0.1), 20.0, ViewOptions()).view
    np.testing.assert_allclose(np.array(ends), 18.0 * view.axes[:2].T, atol=0.1)


def test_without_gravity_there_is_no_ground() -> None:
    floating = srm.simulate(floating_ring(), 0.1)
    data = page_data(floating, make_picture(floating, 20.0, ViewOptions()))
    assert data["ground"] is None
    assert (
        page_data(floating, make_picture(floating, 20.0, ViewOptions()), panel=False)["bodies"]
        == []
    )


@pytest.mark.browser
def test_the_page_of_a_walker_with_its_forces_is_light_and_drawn_in_few_calls(
    browser: Any, tmp_path: Path
) -> None:
    solution = srm.simulate(load("jansen_walker"), 5.0)
    with exported(browser, tmp_path, solution, arrows=True) as page:
        assert (tmp_path / "page.html").stat().st_size < 2.5e6
        calls, triangles = page.evaluate(DRAWN)
    assert 100 < calls < 300
    assert 1e4 < triangles < 2e5


@pytest.mark.browser
def test_the_controls_of_meshcat_are_hidden_until_the_key_or_the_button_shows_them(
    page: Any,
) -> None:
    controls, button = page.locator(".dg.main"), page.locator("#controls")
    assert not controls.is_visible()
    page.locator("#toggle").focus()
    for press in (lambda: page.keyboard.press("g"), button.click):
        press()
        assert controls.is_visible()
        assert button.get_attribute("aria-pressed") == "true"
        assert page.get_by_text("Animations", exact=True).is_visible()
        press()
        assert not controls.is_visible()
        assert button.get_attribute("aria-pressed") == "false"


@pytest.mark.browser
def test_the_page_is_dark_where_the_browser_prefers_it_and_light_again(page: Any) -> None:
    def colours() -> list[float]:
        top = page.evaluate("viewer.scene_tree.find(['Background']).object.top_color[0] / 255")
        css = "getComputedStyle(document.querySelector('#bar')).backgroundColor.match(/\\d+/)[0]"
        return [top, int(page.evaluate(css)) / 255.0]

    assert min(colours()) > 0.9
    page.emulate_media(color_scheme="dark")
    page.wait_for_function("viewer.scene_tree.find(['Background']).object.top_color[0] < 128")
    assert max(colours()) < 0.5
    page.emulate_media(color_scheme="light")
    page.wait_for_function("viewer.scene_tree.find(['Background']).object.top_color[0] > 230")
    assert min(colours()) > 0.9


COLOURS = """([name, ...attribute]) => {
  const node = element(name), before = attribute.length && node.getAttribute(attribute[0]);
  if (attribute.length) node.setAttribute(...attribute);
  const { color, backgroundColor } = getComputedStyle(node);
  if (attribute.length) node.setAttribute(attribute[0], before);
  return [color, backgroundColor].map(text => text.match(/\\d+/g).map(Number));
}"""


def luminance(colour: list[int]) -> float:
    """Relative luminance of sRGB (0 to 255), WCAG 2.2."""
    parts = np.array(colour) / 255.0
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_on_coloured_ground_has_the_contrast_of_readable_text(page: Any, scheme: Any) -> None:
    page.emulate_media(color_scheme=scheme)
    for place in (
        ("flash",),
        ("show-curves", "aria-pressed", "true"),
        ("unfold", "aria-expanded", "true"),
    ):
        low, high = sorted(map(luminance, page.evaluate(COLOURS, place)))
        assert (high + 0.05) / (low + 0.05) >= 4.5, place
    page.emulate_media(color_scheme="light")


@pytest.mark.browser
@pytest.mark.parametrize("size", [(1280, 720), (400, 760)])
def test_nothing_covers_the_picture_or_leaves_the_window(page: Any, size: tuple[int, int]) -> None:
    before = page.viewport_size
    page.evaluate("seek(2.5)")  # at a singular passage the picture has a frame
    page.set_viewport_size({"width": size[0], "height": size[1]})
    # The canvas follows in the handler of the window's event, a frame later or more.
    for element in ("window.inner", "pane.client", "viewer.renderer.domElement.client"):
        page.wait_for_function(f"{element}Width === {size[0]}")
    boxes = {
        name: page.locator(name).bounding_box()
        for name in ("#meshcat-pane canvas", "#bar", "#panel", "#time", "output", "#toggle")
    }
    for name, box in boxes.items():
        assert box["x"] >= 0.0, name
        assert box["x"] + box["width"] <= size[0] + 0.5, name
        assert box["y"] + box["height"] <= size[1] + 0.5, name
    canvas, bar = boxes["#meshcat-pane canvas"], boxes["#bar"]
    assert canvas["y"] + canvas["height"] == pytest.approx(bar["y"], abs=1.0)
    assert boxes["#panel"]["height"] < 0.2 * size[1]
    assert page.evaluate("parseFloat(getComputedStyle(element('panel')).fontSize)") >= 13.0
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    page.set_viewport_size(before)


MANY = """() => {
  for (let i = 0; i < 40; i++) {
    about.values.push({ label: `value ${i}`, unit: "N", body: "crank",
      samples: about.joint_times.map(t => 1500 + Math.cos(t)) });
  }
  add_curve(about.values.at(-1));
}"""


@pytest.mark.browser
def test_a_long_panel_is_scrolled_and_a_curve_has_the_digits_of_its_range(page: Any) -> None:
    before = page.viewport_size
    page.evaluate("choose(''); toggle_curves()")
    page.evaluate(MANY)
    ends = page.locator(".curve").last.locator(".ends span").all_inner_texts()
    assert ends == ["1501.0", "1499.0"]
    page.evaluate("toggle_curves()")
    for size in (before, {"width": 390, "height": 600}):
        page.set_viewport_size(size)
        page.wait_for_function("!element('panel').classList.contains('long')")
        assert page.evaluate("getComputedStyle(element('panel')).pointerEvents") == "none"
        page.evaluate("choose('crank')")
        page.wait_for_function("element('panel').classList.contains('long')")
        panel, scale = (page.locator(name).bounding_box() for name in ("#panel", "#scale"))
        assert panel["y"] + panel["height"] < scale["y"]
        page.mouse.move(panel["x"] + 30.0, panel["y"] + 30.0)
        page.mouse.wheel(0.0, 2000.0)
        page.wait_for_function(
            "document.querySelector('#panel tr:last-child').getBoundingClientRect().bottom"
            " <= element('panel').getBoundingClientRect().bottom"
        )
        bare = page.add_style_tag(content=BARE)  # pictures show all of it
        page.wait_for_function("!element('panel').classList.contains('long')")
        bare.evaluate("tag => tag.remove()")
        page.evaluate("choose('')")
    page.evaluate("about.values.splice(-40); lay_out()")
    page.set_viewport_size(before)


@pytest.mark.browser
@pytest.mark.parametrize(
    ("span", "panel", "clock"),
    [
        pytest.param((5.0, 9.0), "6.000", "6.00 / 9.00 s", marks=pytest.mark.stress),
        ((-3.0, 1.0), "\u22122.000", "\u22122.00 / 1.00 s"),
        ((0.0, 4e-6), "0.000001000", "0.00000100 / 0.00000400 s"),
    ],
)
def test_panel_and_slider_tell_the_time_of_the_run_with_the_digits_that_it_needs(
    browser: Any, tmp_path: Path, span: tuple[float, float], panel: str, clock: str
) -> None:
    solution = srm.simulate(load("slider_crank"), span[1], t0=span[0])
    with exported(browser, tmp_path, solution) as page:
        # Where the page stopped playing, the clock may have the same digits already.
        [_, shown, _], *_ = page.evaluate(READ, 0.25 * (span[1] - span[0]))
        assert shown == panel
        assert page.evaluate("clock.value") == clock
        assert page.locator("#time").get_attribute("aria-valuetext") == clock


@pytest.mark.browser
def test_without_the_loop_the_motion_stops_at_its_end_and_can_be_played_again(page: Any) -> None:
    page.locator("#loop").uncheck()
    page.evaluate("seek(7.8)")
    page.locator("#toggle").click()
    page.wait_for_function("!viewer.animator.playing")
    assert page.evaluate("viewer.animator.time") == pytest.approx(8.0, abs=1e-6)
    page.locator("#toggle").click()
    page.wait_for_function("viewer.animator.playing && viewer.animator.time < 2")
    page.locator("#loop").check()
    page.evaluate("seek(7.9)")
    page.locator("#toggle").click()
    page.wait_for_function("viewer.animator.playing && viewer.animator.time < 2")


@pytest.mark.browser
def test_the_path_of_a_traced_point_is_where_forward_kinematics_puts_it(
    page: Any, slider_crank: srm.Solution
) -> None:
    points = np.array(
        page.evaluate("""() => [...viewer.scene_tree.find(["overlays", "trace_0"])
            .children["<object>"].object.geometry.attributes.position.array]""")
    ).reshape(-1, 3)
    assert len(points) == 513
    for i in range(0, 513, 37):
        assert np.abs(points[i] - place(slider_crank, i / 64.0, ROD)).max() < 1e-6
    ball = ends_in(page, "point_", 2.5)[0, 0]
    assert np.abs(ball - place(slider_crank, 2.5, ROD)).max() < 1e-6


ENDS = """([kind, t]) => {
  seek(t);
  viewer.scene.updateMatrixWorld(true);
  const root = viewer.scene_tree.find(["overlays"]);
  const world = root.object.matrixWorld.clone().invert();
  return Object.entries(root.children).filter(([name, _]) => name.startsWith(kind))
    .map(([_, node]) => [0, 1].map(z => new MeshCat.THREE.Vector3(0, 0, z)
      .applyMatrix4(node.object.matrixWorld).applyMatrix4(world).toArray()));
}"""


def ends_in(page: Any, kind: str, t: float) -> Any:
    """Where the overlays of a kind have their points (0, 0, 0) and (0, 0, 1), (k, 2, 3), at the
    animation's time t."""
    return np.array(page.evaluate(ENDS, [kind, t]))


@pytest.mark.browser
def test_springs_reach_from_anchor_to_anchor_and_closures_have_the_colour_of_their_reaction(
    browser: Any,
    tmp_path: Path,
) -> None:
    solution = srm.simulate(load("stewart_platform"), 1.0)
    springs = [spring for spring, _ in overlays.active_springs(solution)]
    with exported(browser, tmp_path, solution, fps=64.0, reactions=True) as page:
        for t in (0.0, 0.515625, 1.0):
            ends = ends_in(page, "spring_", t)
            assert len(ends) == len(springs) == 6
            for spring, (a, b) in zip(springs, ends):
                assert np.abs(a - place(solution, t, spring.a)).max() < 1e-6
                assert np.abs(b - place(solution, t, spring.b)).max() < 1e-6
        legend = page.locator("#notes").inner_text()
        colour = page.evaluate("""() => [...viewer.scene_tree.find(["overlays", "closure_3",
            "part_0", "<object>"]).object.material.color.toArray()]""")
    sizes = [
        np.linalg.norm(wrench[:, :3], axis=1)
        for wrench in solution.at(np.arange(65) / 64.0).reactions.values()
    ]
    top = np.percentile(np.concatenate(sizes), overlays.FORCE_PERCENTILE)
    assert float(re.findall(r"([\d.]+) N", legend)[0]) == pytest.approx(top, rel=6e-3)
    expected = ramp_colours(sizes[3][-1:] / top)[0]
    assert np.abs(np.array(colour) - expected).max() < 1e-6


@pytest.mark.browser
def test_massless_rods_reach_from_anchor_to_anchor_in_page_picture_and_poses(
    browser: Any, tmp_path: Path
) -> None:
    linkage = srm.planar(
        points={"O": (0, 0), "A": (0, 1), "C": (2, 0), "B": (2, 1.5)},
        bars={"crank": ("O", "A"), "rocker": ("C", "B")},
        ground=("O", "C"),
        mass_per_length=1.0,
    )
    a, b = linkage.points["A"], linkage.points["B"]
    rod = srm.LoopClosure("distance", a, b, length=math.hypot(2.0, 0.5), name="rod")
    tied = linkage.with_loop(rod)
    solution = srm.simulate(tied, 1.0)
    with exported(browser, tmp_path, solution, fps=64.0) as page:
        for t in (0.0, 0.515625, 1.0):
            [(start, end)] = ends_in(page, "rod_", t)
            assert np.abs(start - place(solution, t, a)).max() < 1e-6
            assert np.abs(end - place(solution, t, b)).max() < 1e-6
    without = srm.simulate(linkage, 0.01)
    assert [
        shape.name for shape in make_picture(solution, 60.0, ViewOptions()).overlays.shapes
    ] == ["rod_0"]
    assert not make_picture(without, 60.0, ViewOptions()).overlays.shapes
    ends = np.array([place(solution, 0.5, side)[[0, 2]] for side in (a, b)])
    [axes] = solution.plot(kind="poses", at=[0.5], view="y").axes[:1]
    lines = [np.array(line.get_xydata()) for line in axes.lines]
    assert any(line.shape == (2, 2) and np.allclose(line, ends, atol=1e-9) for line in lines)


@pytest.mark.browser
def test_gaps_are_drawn_as_many_times_larger_as_the_panel_says(
    browser: Any,
    tmp_path: Path,
) -> None:
    solution = srm.simulate(load("spatial_four_bar"), 1.0, rtol=1e-4)
    with exported(browser, tmp_path, solution, fps=64.0, gaps=True) as page:
        words = page.locator("#notes").inner_text()
        ((start, end),) = ends_in(page, "gap_", 0.75)
    power = words.split("10")[-1].split()[0].translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
    (gap,) = gaps_of(solution, np.array([0.75]))
    assert np.linalg.norm(gap.arrows) > 1e-9  # there is one
    np.testing.assert_allclose(end - start, 10.0 ** int(power) * gap.arrows[0], atol=1e-5)


@pytest.fixture(scope="module")
def let_go_and_tied() -> srm.Solution:
    """The slider-crank, whose pin lets go at 0.5 s and which a rope ties at 0.9 s."""
    mechanism = load("slider_crank")
    mechanism = srm.Mechanism(mechanism.model, mechanism.loops, mechanism.q0, mechanism.v0)
    freed = mechanism.without_loop("pin")
    post, end = srm.Anchor("world", xyz=(0.0, 0.0, -5.0)), srm.Anchor("rod", xyz=(2.0, 0.0, 0.0))

    def tie(t: float, q: Any, v: Any) -> srm.Switch:
        joint, placement = end.resolve(freed.model)
        way = (placements(freed, q)[joint] * placement).translation - np.array(post.xyz)
        length = float(np.linalg.norm(way))
        return srm.Switch(
            freed.with_loop(srm.LoopClosure("distance", end, post, name="rope", length=length))
        )

    events = [
        srm.Event(lambda t, q, v: t - 0.5, action=lambda t, q, v: srm.Switch(freed)),
        srm.Event(lambda t, q, v: t - 0.9, action=tie),
    ]
    return srm.simulate(mechanism, 1.5, events=events, rtol=1e-5)


SEEN = """t => {
  seek(t);
  const seen = {};
  const overlays = Object.entries(viewer.scene_tree.find(["overlays"]).children);
  const shapes = Object.entries(viewer.scene_tree.find(["mechanism", "rod"]).children);
  for (const [name, node] of [...overlays, ...shapes]) seen[name] = node.object.visible;
  return seen;
}"""


@pytest.mark.browser
def test_closures_are_drawn_while_they_are_there_and_not_before_or_after(
    browser: Any, tmp_path: Path, let_go_and_tied: srm.Solution
) -> None:
    options = {"fps": 10.0, "reactions": True, "gaps": True}
    with exported(browser, tmp_path, let_go_and_tied, **options) as page:
        # Between the key frames at 0.4, 0.5, ...: to the very time.
        for t, pinned, tied in [
            (0.0, True, False),
            (0.499, True, False),
            (0.501, False, False),
            (0.899, False, False),
            (0.901, False, True),
            (1.5, False, True),
        ]:
            seen = page.evaluate(SEEN, t)
            assert (seen["closure_0"], seen["gap_0"]) == (pinned, pinned), t
            assert (seen["closure_1"], seen["gap_1"]) == (tied, tied), t
            # Bars, as there are no visuals: both closures end on the rod, whose bar stays.
            balls = [seen[name] for name in sorted(seen) if name.startswith("shape_")]
            assert balls.count(False) == (not pinned) + (not tied), t
        rope = ends_in(page, "closure_1", 1.2)[0, 0]
        end = srm.Anchor("rod", xyz=(2.0, 0.0, 0.0))
        assert np.abs(rope - place(let_go_and_tied, 1.2, end)).max() < 1e-6
        rows = {name: value for name, value, _ in page.evaluate(READ, 0.7)}
        assert (rows["drift |g| between steps"], rows["sigma"]) == (
            "0",
            "\u2013",
        )  # there are no closures
        page.evaluate("seek(1.45)")
        page.evaluate("animator.play()")
        page.wait_for_function("animator.time < 0.4")  # over again
        assert page.evaluate(SEEN, 0.2)["closure_0"] is True


def test_what_is_not_there_has_no_gap_and_no_part_in_the_scale(
    let_go_and_tied: srm.Solution,
) -> None:
    times = np.linspace(0.0, 1.5, 31)
    pinned, tied = gaps_of(let_go_and_tied, times)
    assert (pinned.loop.name, tied.loop.name) == ("pin", "rope")
    assert pinned.active == ((0.0, pytest.approx(0.5)),)
    assert tied.active == ((pytest.approx(0.9), 1.5),)
    assert np.all(pinned.arrows[times > 0.51] == 0.0)
    assert np.all(tied.arrows[times < 0.89] == 0.0)
    assert np.linalg.norm(pinned.arrows, axis=1).max() < 1e-3


@pytest.mark.browser
def test_a_motion_that_was_not_simulated_has_its_time_only(
    browser: Any,
    tmp_path: Path,
) -> None:
    mechanism = load("four_bar")
    simulated = srm.simulate(mechanism, 1.0)
    motion = srm.JointMotion(mechanism, simulated.t, simulated.q)
    with exported(browser, tmp_path, motion, fps=20.0) as page:
        assert panel(page, 0.5) == {"t": (0.5, "s")}
        assert page.locator("#marks button").count() == 0


@pytest.mark.parametrize("name", ["slider_crank", "spatial_four_bar", "bricard", "delta_robot"])
def test_gaps_are_as_large_as_the_errors_of_the_rows_of_length(name: str) -> None:
    solution = srm.simulate(load(name), 0.3)
    q = np.array([solution.mechanism.model.nq * [0.0]]) + solution.q[-1]
    q[0, -1] += 0.03  # opened: rounding would show nothing
    opened_loops = srm.JointMotion(solution.mechanism, np.zeros(1), q)
    errors = constraint_errors(solution.mechanism, np.zeros(1), q, solution.v[-1:])[0][0]
    at = 0
    gaps = {gap.loop.name: gap.arrows for gap in gaps_of(opened_loops, np.zeros(1))}
    assert gaps
    for loop in solution.mechanism.loops:
        rows = errors[at : at + loop.rows.count][loop.rows.blocks[0]]
        at += loop.rows.count
        if len(rows):
            size = np.linalg.norm(gaps[loop.name])
            assert size == pytest.approx(np.linalg.norm(rows), rel=1e-9, abs=1e-15)


def test_quaternions_along_a_turning_direction_turn_z_to_it_without_twist() -> None:
    angle = np.linspace(0.0, 4.0 * np.pi, 200)  # through -z, where the shortest turn is not unique
    directions = np.column_stack([np.sin(angle), 0.0 * angle, np.cos(angle)])
    quaternions = turns_along(directions)
    for quaternion, direction in zip(quaternions, directions):
        turned = pin.Quaternion(quaternion).matrix()
        np.testing.assert_allclose(turned[:, 2], direction, atol=1e-12)
        np.testing.assert_allclose(turned[:, 1], [0.0, 1.0, 0.0], atol=1e-12)
    assert np.all(np.sum(quaternions[1:] * quaternions[:-1], axis=1) > 0.9)


def test_animations_that_cannot_be_made_are_refused(
    slider_crank: srm.Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pendulum = srm.simulate(load("simple_pendulum"), 1.5)
    motion = srm.JointMotion(slider_crank.mechanism, slider_crank.t, slider_crank.q)
    ground = srm.Anchor("world", xyz=(1.0, 0.0, 0.0))
    page = partial(slider_crank.export_html, tmp_path / "page.html")
    frame = slider_crank.show
    image, film = pendulum.export_image, pendulum.export_video
    cases: dict[str, Callable[[], object]] = {
        "a trace of no point": partial(page, trace=["rod"]),
        "one trace": partial(page, trace=ROD),
        "a trace of an unknown link": partial(page, trace=[srm.Anchor("nothing")]),
        "a trace on the ground": partial(page, trace=[ground]),
        "reactions of an open chain": partial(pendulum.show, reactions=True),
        "gaps of an open chain": partial(pendulum.show, gaps=True),
        "reactions of a prescribed motion": partial(motion.show, reactions=True),
        **{f"{fps} frames": partial(page, fps=fps) for fps in (0.0, -1.0, math.nan, math.inf)},
        **{f"{fps} frames": partial(page, fps=fps) for fps in ("fast", None)},
        "no frames of playback": partial(slider_crank.play, fps=0.0),
        **{f"height {height}": partial(frame, height=height) for height in (0, -9, 42.5, "tall")},
        "an image after the end": partial(image, "a.png", t=1.6),
        "an image at no time": partial(image, "a.png", t=math.nan),
        "an image without width": partial(image, "a.png", size=(0, 10)),
        "an image of no known size": partial(image, "a.png", size="poster"),
        "an image too large for print": partial(image, "a.png", size="page", dpi=2000),
        "a film without frames": partial(film, "film.gif", fps=0.0),
        "a film without speed": partial(film, "film.gif", speed=0.0),
        "a film of infinite speed": partial(film, "film.gif", speed=math.inf),
    }
    messages = {case: refused(call) for case, call in cases.items()}
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    files = {
        "a page in no folder": (slider_crank.export_html, "nowhere/page.html"),
        "an image of another format": (image, "a.jpg"),
        "a film of another format": (film, "film.avi"),
        "a film without its encoder": (film, "film.mp4"),
    }
    for case, (export, name) in files.items():
        messages[case] = refused(partial(export, tmp_path / name), tmp_path)
    check_messages("animation", messages)
    assert not list(tmp_path.iterdir())


def test_the_camera_sees_the_whole_path_of_a_point_far_out(slider_crank: srm.Solution) -> None:
    far = srm.Anchor("rod", xyz=(9.0, 0.0, 0.0))
    view = make_picture(slider_crank, 20.0, ViewOptions([far])).view
    path = np.array([place(slider_crank, t, far) for t in np.linspace(0.0, 8.0, 161)])
    x, y, depth = view.axes @ (path - view.target).T
    slope = np.tan(np.radians(0.5 * FIELD_OF_VIEW)) * (view.distance + depth)
    reach = max(np.abs(x / slope).max() / ASPECT, np.abs(y / slope).max())
    assert reach == pytest.approx(FILLED_PART, abs=0.02)


@pytest.fixture(scope="module")
def flight() -> srm.Solution:
    """A ring of four rods that crosses 200 m in 4 s."""
    ring = floating_ring()
    v = np.array(ring.v0)
    v[:3] += 50.0 * np.array([1.0, 0.0, 0.0])  # a free joint's rates are in its body's axes
    return srm.simulate(ring, 4.0, v0=v)


def test_the_picture_goes_along_with_a_mechanism_that_travels_far(flight: srm.Solution) -> None:
    picture = make_picture(flight, 30.0, ViewOptions())
    assert picture.along is not None
    assert picture.along[0] == pytest.approx(0.0, abs=1e-12)
    assert 150.0 < np.linalg.norm(picture.along[-1]) < 210.0
    assert picture.view.distance < 20.0
    (note,) = picture.overlays.notes
    assert re.fullmatch(r"the picture goes along with .* which travels \d+ m", note["text"])


def test_a_free_mechanism_that_travels_about_its_own_size_is_followed_from_the_start() -> None:
    ring = floating_ring()
    v = np.array(ring.v0)
    v[:3] += [4.0, 0.0, 0.0]
    slow = srm.simulate(ring, 1.0, v0=v)
    picture = make_picture(slow, 30.0, ViewOptions())
    assert picture.along is not None
    np.testing.assert_allclose(picture.along[0], 0.0, atol=1e-12)
    assert 2.0 < np.linalg.norm(picture.along[-1]) < 6.0


@pytest.mark.parametrize("t", [0.05, 2.0])
def test_the_snapshot_of_a_mechanism_that_travels_far_shows_it_at_any_time(
    flight: srm.Solution, t: float
) -> None:
    with Image.open(io.BytesIO(draw_snapshot(flight, t))) as picture:
        drawn = (np.asarray(picture.convert("RGB")) < 250).any(axis=2)
    rows, columns = np.nonzero(drawn)
    assert max(np.ptp(columns) / 900.0, np.ptp(rows) / 600.0) > 0.3
    assert 0 < columns.min() < columns.max() < 899


def test_the_picture_stands_still_where_a_joint_holds_to_the_ground_or_little_is_gained(
    slider_crank: srm.Solution,
) -> None:
    assert make_picture(slider_crank, 30.0, ViewOptions()).along is None
    assert make_picture(srm.simulate(floating_ring(), 1.0), 30.0, ViewOptions()).along is None


@pytest.mark.browser
def test_bodies_and_paths_of_a_mechanism_that_travels_far_stay_before_the_camera(
    browser: Any, flight: srm.Solution, tmp_path: Path
) -> None:
    point = srm.Anchor("d", xyz=(1.0, 0.0, 0.0))
    with exported(browser, tmp_path, flight, trace=[point]) as page:
        for t in (0.0, 1.0, 2.5, 4.0):
            middles, ball = page.evaluate(
                """t => {
                  seek(t);
                  viewer.scene.updateMatrixWorld(true);
                  const at = node => new MeshCat.THREE.Vector3().setFromMatrixPosition(
                    node.object.matrixWorld).toArray();
                  const {mechanism, overlays} = viewer.scene_tree.children;
                  return [Object.values(mechanism.children).filter(x => x.children.shape_0 ||
                    Object.keys(x.children).length > 1).map(at), at(overlays.children.point_0)];
                }""",
                t,
            )
            assert len(middles) >= 4
            assert np.abs(middles).max() < 3.0
            assert min(np.linalg.norm(np.array(ball) - middle) for middle in middles) < 1.0 + 1e-3


def test_a_value_that_hardly_varies_has_the_digits_that_its_curve_needs() -> None:
    mechanism = load("four_bar")
    start = srm.assemble(mechanism, v={"crank": 0.1})
    solution = srm.simulate(mechanism, 0.01, q0=start.q, v0=start.v)
    times = np.linspace(0.0, 0.01, 50)
    angles = {name: solution.at(times).joint(name)[0] for name in mechanism.joint_names}
    shown = {
        value["label"]: value["samples"] for value in values_over_time(solution, times)["values"]
    }
    for name, angle in angles.items():
        assert np.ptp(angle) < 2e-3  # four digits would make it a staircase
        np.testing.assert_allclose(shown[name], angle, rtol=0.0, atol=1e-3 * np.ptp(angle))


def test_marks_of_many_loops_or_many_passages_have_their_times_only() -> None:
    for name, t_end, named in [("n_four_bar_2", 2.0, True), ("n_four_bar_13", 2.0, False)]:
        solution = srm.simulate(load(name), t_end)
        about = values_over_time(solution, np.linspace(0.0, t_end, 5))
        assert len(about["passages"]) == len(solution.crossings) > 0
        assert all((": " in passage["text"]) == named for passage in about["passages"])
    solution = srm.simulate(load("slider_crank"), 240.0)
    assert len(solution.crossings) > 100
    texts = [
        passage["text"]
        for passage in values_over_time(solution, np.linspace(0, 240, 5))["passages"]
    ]
    assert not any(": " in text for text in texts)


def test_names_do_not_end_the_script_of_a_page() -> None:
    about = {"notes": [{"text": "</script><script>alert(1)</script>"}]}
    page = make_page("a</title>b", about, [])
    assert "</script><script>alert(1)" not in page
    assert "a</title>b" not in page


def test_what_the_page_is_made_of_is_package_data() -> None:
    folder = Path(srm.__file__).parent / "visualization/animation/web"
    names = {file.name for file in folder.iterdir()}
    assert {"page.html.j2", "notebook.html.j2", *SCRIPTS} <= names


@pytest.mark.browser
def test_the_command_line_draws_the_path_of_a_point_of_a_link(
    browser: Any, tmp_path: Path, slider_crank: srm.Solution
) -> None:
    path = tmp_path / "page.html"
    options = ["--t-end", "8", "--html", str(path), "--trace", "rod:0.5,0,0.2"]
    run("simulate", "slider_crank", *options)
    with opened(browser, path.as_uri()) as page:
        ball = ends_in(page, "point_", 2.5)[0, 0]
    assert np.abs(ball - place(slider_crank, 2.5, ROD)).max() < 1e-6


@pytest.mark.parametrize(
    ("model", "options", "words"),
    [
        ("slider_crank", ["--trace", "rod"], "'rod' is not a point of a link"),
        ("slider_crank", ["--trace", "rod:1,2"], "'rod:1,2' is not a point of a link"),
        ("slider_crank", ["--trace", "bar:1,2,3"], "--trace: there is no link 'bar'"),
        ("slider_crank", ["--trace", "rod:1,2,nan"], "--trace: 'rod:1,2,nan' is not a point"),
        ("simple_pendulum", ["--reactions"], "--reactions: the mechanism has no closures"),
    ],
)
def test_what_cannot_be_drawn_is_refused_before_the_run(
    model: str, options: list[str], words: str, tmp_path: Path
) -> None:
    said = run("simulate", model, "--html", tmp_path / "page.html", *options, status=2)
    assert words in said
    assert "steps" not in said


@pytest.mark.parametrize(
    "options", [["--trace", "rod:1,0,0"], ["--gaps"], ["--reactions"], ["--arrows"]]
)
def test_what_would_be_drawn_nowhere_is_refused_before_the_run(options: list[str]) -> None:
    said = run("simulate", "slider_crank", *options, status=2)
    assert f"error: {options[0]}: it is drawn in the animation" in said
    assert "--html" in said
    assert "steps" not in said


@pytest.mark.browser
@pytest.mark.parametrize(
    ("size", "aside"),
    [((730, 500), True), pytest.param((360, 640), False, marks=pytest.mark.stress)],
)
def test_the_motion_is_beside_or_below_the_panel(
    browser: Any, tmp_path: Path, size: tuple[int, int], aside: bool
) -> None:
    """In a frame of a site the picture moves aside, on a phone there is room below the panel."""
    links = {"A": (0, 0), "B": (0, 30), "C": (20, 30), "D": (20, 0)}
    bars = {"left": ("A", "B"), "top": ("B", "C"), "right": ("C", "D")}
    linkage = srm.planar(points=links, bars=bars, ground=("A", "D"), unit="mm", mass_per_length=1.0)
    motion = srm.simulate(linkage, 0.02)
    with exported(browser, tmp_path, motion, size, fps=50.0) as page:
        page.wait_for_function(f"pane.clientWidth === {size[0]}")
        box = page.locator("#panel").bounding_box()
        corners = [page.evaluate(POINT_OF, [bar, [0.0, 0.0, 0.0]]) for bar in ("A", "B", "C")]
        right, bottom = box["x"] + box["width"], box["y"] + box["height"]
        assert all(x > right or y > bottom for x, y in corners)
        moved = page.evaluate("viewer.camera.view.offsetX") < 0.0
        assert moved == aside
        # What is seen at a point is what lies there.
        x, y = page.evaluate(POINT_OF, ["A", [0.01, 0.0, 0.0]])
        assert page.evaluate(f"name_of(body_at({x}, {y}))") == "left"
