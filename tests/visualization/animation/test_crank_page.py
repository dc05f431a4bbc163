"""The page in which a hand turns the crank of a mechanism."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.browsing import (
    BODIES,
    POINT_OF,
    assert_in_place,
    bodies_in,
    exported,
    placements,
)
from tests.support.bundled import load

A, B, C, D = 1.0, 2.0, 1.5, 2.2
"""Bars of the bundled four-bar: crank, coupler, rocker, ground (m)."""
TIP = [1.0, 0.0, 0.0]
"""The pin of the crank, in its axes."""
FRAME = "new Promise(resolve => requestAnimationFrame(() => requestAnimationFrame(resolve)))"


@pytest.fixture(scope="module")
def motion() -> srm.CrankMotion:
    return srm.kinematics(load("four_bar"), "crank")


@pytest.fixture(scope="module")
def page(
    browser: Any, motion: srm.CrankMotion, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("crank")
    with exported(browser, folder, motion, (660, 400)) as shown:
        shown.wait_for_function("document.querySelector('output').value.startsWith('crank ')")
        yield shown


def clock(page: Any) -> float:
    """Position of the crank (degrees) beside the slider, after the next picture."""
    page.evaluate(FRAME)
    name, number = page.evaluate("clock.value").split(" ")
    assert name == "crank"
    return float(number.rstrip("°").replace("\u2212", "-"))


def crank_angle(page: Any) -> float:
    """Angle (degrees, 0 to 360) of the crank in the scene, from x towards z."""
    x = bodies_in(page)["crank"][:3, 0]
    return float(np.degrees(np.arctan2(x[2], x[0])) % 360.0)


@pytest.mark.browser
def test_the_page_waits_where_the_mechanism_begins_and_the_slider_turns_the_crank(
    page: Any, motion: srm.CrankMotion
) -> None:
    start = placements(motion.mechanism, motion.mechanism.q0)
    assert page.evaluate("animator.playing") is False
    found = bodies_in(page)
    for name, place in zip(("crank", "coupler", "rocker"), start[1:]):
        np.testing.assert_allclose(found[name], place.homogeneous, atol=1e-3)
    first = np.degrees(motion.mechanism.q0[0])
    assert clock(page) == pytest.approx(first, abs=0.051)
    line = page.locator("#time").bounding_box()
    thumb = line["x"] + 8.0 + first / 360.0 * (line["width"] - 16.0)
    middle = line["y"] + 0.5 * line["height"]
    page.mouse.move(thumb, middle)
    page.mouse.down()
    for part in (0.3, 0.5, 0.75):
        page.mouse.move(line["x"] + 8.0 + part * (line["width"] - 16.0), middle)
        degrees = clock(page)
        assert degrees == pytest.approx(360.0 * part, abs=1.0)
        assert crank_angle(page) == pytest.approx(degrees, abs=0.06)
        # Closed where the triangle of the diagonal says.
        bodies = bodies_in(page)
        tip = bodies["crank"] @ [A, 0.0, 0.0, 1.0]
        end = bodies["rocker"] @ [C, 0.0, 0.0, 1.0]
        assert np.linalg.norm((tip - end)[:3]) == pytest.approx(B, abs=1e-4)
    page.mouse.up()
    for k in (0, 77, 200, 360):
        page.evaluate("t => seek(t)", motion.t[k])
        assert_in_place(page, motion, motion.t[k], within=1e-3)  # between key frames


@pytest.mark.browser
def test_arrows_turn_by_a_degree_and_on_over_the_end_of_a_turn(page: Any) -> None:
    page.keyboard.press("Home")
    assert clock(page) == 0.0
    page.keyboard.press("ArrowRight")
    assert clock(page) == 1.0
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    assert clock(page) == 359.0
    page.keyboard.press("End")
    page.keyboard.press("ArrowRight")
    assert clock(page) == 1.0
    page.keyboard.press("Space")
    page.wait_for_function("animator.playing && animator.time > 0.1")
    page.keyboard.press("Space")
    # Screen readers hear which joint, and where it is.
    slider = page.get_by_role("slider", name="position of crank")
    assert slider.count() == 1
    text = f"crank {clock(page):.1f}°"
    assert slider.get_attribute("aria-valuetext") == text
    assert page.get_by_role("group", name="values of the position").count() == 1


@pytest.mark.browser
def test_a_dragged_body_follows_the_pointer_and_the_picture_stays(page: Any) -> None:
    page.evaluate("t => seek(t)", 4.0 * 30.0 / 360.0)
    before = page.evaluate("viewer.camera.matrixWorld.elements")
    camera = page.evaluate("viewer.camera.position.toArray()")
    centre = page.evaluate(POINT_OF, ["crank", [0.0, 0.0, 0.0]])
    tip = page.evaluate(POINT_OF, ["crank", TIP])
    radius = np.hypot(tip[0] - centre[0], tip[1] - centre[1])
    page.mouse.move(*tip)
    page.mouse.down()
    # The hand need not keep to the path: twice as far out is the same angle.
    for degrees, out in [(50, 1.0), (90, 2.0), (150, 1.0), (220, 0.6), (300, 1.0), (370, 1.0)]:
        angle = np.radians(degrees)
        x = centre[0] + out * radius * np.cos(angle)
        page.mouse.move(x, centre[1] - out * radius * np.sin(angle), steps=3)
        assert crank_angle(page) == pytest.approx(degrees % 360, abs=2.0)
        assert clock(page) == pytest.approx(crank_angle(page), abs=0.06)
    page.mouse.up()
    page.mouse.move(centre[0] + radius, centre[1] - radius)
    assert crank_angle(page) == pytest.approx(10.0, abs=2.0)  # let go
    assert page.evaluate("viewer.camera.matrixWorld.elements") == before
    assert page.evaluate("chosen") == ""
    # The output at its dead centre: pulled farther, it stays.
    tip = page.evaluate(POINT_OF, ["rocker", [C, 0.0, 0.0]])
    page.mouse.move(*tip)
    page.mouse.down()
    page.mouse.move(tip[0] + 2.0 * radius, tip[1] + 2.0 * radius, steps=10)
    page.mouse.up()
    bodies = bodies_in(page)
    along = [bodies[name][:3, 0] for name in ("crank", "coupler")]
    assert abs(along[0] @ along[1]) == pytest.approx(1.0, abs=2e-3)  # crank and coupler in line
    # Beside the bodies the picture turns, as ever.
    page.mouse.move(20.0, 200.0)
    page.mouse.down()
    page.mouse.move(50.0, 220.0, steps=3)
    page.mouse.up()
    assert page.evaluate("viewer.camera.matrixWorld.elements") != before
    page.evaluate("p => { viewer.camera.position.fromArray(p); viewer.set_dirty(); }", camera)
    page.evaluate(FRAME)


@pytest.mark.browser
def test_a_click_shows_positions_in_degrees_and_the_ratio_of_the_rates(
    page: Any, motion: srm.CrankMotion
) -> None:
    page.evaluate("t => seek(t)", motion.t[100])
    page.mouse.click(*page.evaluate(POINT_OF, ["rocker", [0.7, 0.0, 0.0]]))
    assert page.locator("#body").input_value() == "rocker"
    clock(page)
    rows = page.evaluate(
        "[...document.querySelectorAll('#panel tr')].map(r => [...r.cells].map(c => c.textContent))"
    )
    cells = {name: (text.replace("\u2212", "-"), unit) for name, text, unit in rows}
    psi = np.degrees(motion.track("rocker"))
    assert cells["crank"] == ("100.0", "°")
    # The body has the name of its joint: the last row of that name is the position.
    assert float(cells["rocker"][0]) == pytest.approx(psi[100], rel=6e-3)
    slope = 0.5 * (psi[101] - psi[99])
    assert float(cells["rocker per crank"][0]) == pytest.approx(slope, rel=6e-3, abs=1e-3)
    assert cells["rocker per crank"][1] == ""
    assert float(cells["transmission angle"][0]) == pytest.approx(
        np.degrees(motion.transmission_angle[100]), rel=6e-3
    )
    page.keyboard.press("c")
    plot = page.locator(".curve svg").first
    assert "over crank" in plot.get_attribute("aria-label")
    box = plot.bounding_box()
    page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 10.0)
    assert clock(page) == pytest.approx(90.0, abs=360.0 / box["width"])
    page.keyboard.press("c")
    page.keyboard.press("Escape")


@pytest.mark.stress
@pytest.mark.browser
def test_a_finger_turns_a_rocker_over_its_dead_points_on_a_phone(
    browser: Any, tmp_path: Path
) -> None:
    path = tmp_path / "page.html"
    motion = srm.kinematics(load("four_bar"), "rocker")
    motion.export_html(path)
    assert path.stat().st_size < 2.5e6
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True)
    phone = context.new_page()
    errors: list[str] = []
    phone.on("pageerror", lambda error: errors.append(str(error)))
    phone.goto(path.as_uri())
    phone.wait_for_function("away > 1.5 && element('time').max > 0")
    marks = phone.locator("#marks button")
    texts = [mark.get_attribute("title") for mark in marks.all()]
    for text, dead in zip(texts, motion.dead_points):
        assert text == f"dead point at rocker = {np.degrees(dead):.4g}°: rocker turns back"
    assert len(texts) == len(motion.dead_points) == 2
    for name in ("#bar", "#time", "output"):
        box = phone.locator(name).bounding_box()
        assert box["x"] >= 0.0
        assert box["x"] + box["width"] <= 390.0
    # Where things are is tested, not how they look: a coarse picture is drawn sooner.
    phone.evaluate("viewer.renderer.setPixelRatio(0.2); viewer.set_3d_pane_size()")
    # The crank of the linkage is carried round by a finger.
    centre = phone.evaluate(POINT_OF, ["crank", [0.0, 0.0, 0.0]])
    tip = phone.evaluate(POINT_OF, ["crank", [0.9, 0.0, 0.0]])
    start = np.arctan2(centre[1] - tip[1], tip[0] - centre[0])
    radius = np.hypot(tip[0] - centre[0], tip[1] - centre[1])
    finger = context.new_cdp_session(phone)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        at = [{"x": x, "y": y} for x, y in points]
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

    touch("touchStart", (tip[0], tip[1]))
    seen = []
    for turn in np.radians(np.arange(20.0, 361.0, 20.0)):
        angle = start + turn
        point = centre[0] + radius * np.cos(angle), centre[1] - radius * np.sin(angle)
        touch("touchMove", point)
        phone.evaluate(FRAME)
        if turn < 0.5:  # a finger that has hardly moved may still be a tap
            continue
        x = np.array(phone.evaluate(BODIES, None)["crank"])[:3]
        off = np.degrees(np.arctan2(x[2], x[0]) - angle)
        assert abs((off + 180.0) % 360.0 - 180.0) < 4.0
        seen.append(phone.evaluate("value_at(about.crank, animator.time)"))
    touch("touchEnd")
    # Over both dead points, and back to the start.
    low, high = np.degrees(sorted(motion.dead_points))
    assert [min(seen), max(seen)] == pytest.approx([low, high], abs=4.0)
    assert phone.evaluate("viewer.controls.enabled") is True
    assert errors == []
    context.close()
