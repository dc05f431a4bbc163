"""What a page shows beside the bodies: values, passages, springs, paths, gaps, reactions."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

import srm_mbs as srm
from srm_mbs import overlays
from srm_mbs.cli import app
from srm_mbs.overlays import Wanted, gaps_of, ramp_colours
from srm_mbs.scene import ASPECT, FIELD_OF_VIEW, FILLED, make_picture
from srm_mbs.systems.driven import constraint_errors
from srm_mbs.web_page import make_page
from tests.browsing import opened

ROD = srm.Anchor("rod", xyz=(0.5, 0.0, 0.2))


def place(solution: srm.Solution, t: float, anchor: srm.Anchor) -> Any:
    """Where an anchor is at t, by forward kinematics of the dense output."""
    model = solution.mechanism.model
    data = model.createData()
    pin.forwardKinematics(model, data, solution(t)[0])
    joint, placement = anchor.resolve(model)
    return (data.oMi[joint] * placement).translation


@pytest.fixture(scope="module")
def slider_crank() -> srm.Solution:
    return srm.simulate(srm.load("slider_crank"), 8.0)


@pytest.fixture(scope="module")
def page(
    browser: Any,
    slider_crank: srm.Solution,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Any]:
    """The slider-crank with the path of a point of its rod, at whole 1/64 s."""
    path = tmp_path_factory.mktemp("page") / "page.html"
    slider_crank.export_html(path, fps=64.0, trace=[ROD])
    with opened(browser, path.as_uri()) as shown:
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
    assert found["drift |g|"] == (pytest.approx(there.drift[1, 0], rel=6e-3), "m")
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
    marks = page.locator("#marks span")
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


PLAYED = """async seconds => {
  const frame = () => new Promise(resolve => requestAnimationFrame(resolve));
  const read = async () => { await frame(); return [performance.now(), viewer.animator.time]; };
  viewer.animator.play();
  await frame();
  const [wall, time] = await read();
  await new Promise(resolve => setTimeout(resolve, 1000 * seconds));
  const [wall_end, time_end] = await read();
  viewer.animator.pause();
  return [(wall_end - wall) / 1000, time_end - time];
}"""


@pytest.mark.browser
@pytest.mark.parametrize("speed", ["0.25", "4"])
def test_the_motion_is_played_at_the_chosen_speed(page: Any, speed: str) -> None:
    page.evaluate("seek(0.5)")
    page.locator("#speed").select_option(speed)
    wall, played = page.evaluate(PLAYED, 1.2)
    page.locator("#speed").select_option("1")
    assert played == pytest.approx(float(speed) * wall, rel=0.1)


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
    solution = srm.simulate(srm.load("stewart_platform"), 1.0)
    mechanism = solution.mechanism
    solution.export_html(tmp_path / "page.html", fps=64.0, reactions=True)
    with opened(browser, (tmp_path / "page.html").as_uri()) as page:
        for t in (0.0, 0.515625, 1.0):
            springs, ends = overlays.springs_of(mechanism), ends_in(page, "spring_", t)
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
    top = np.percentile(np.concatenate(sizes), overlays.HIGH)
    assert float(re.findall(r"([\d.]+) N", legend)[0]) == pytest.approx(top, rel=6e-3)
    expected = ramp_colours(sizes[3][-1:] / top)[0]
    assert np.abs(np.array(colour) - expected).max() < 1e-6


@pytest.mark.browser
def test_gaps_are_drawn_as_many_times_larger_as_the_panel_says(
    browser: Any,
    tmp_path: Path,
) -> None:
    solution = srm.simulate(srm.load("spatial_four_bar"), 1.0, rtol=1e-4)
    solution.export_html(tmp_path / "page.html", fps=64.0, gaps=True)
    with opened(browser, (tmp_path / "page.html").as_uri()) as page:
        words = page.locator("#notes").inner_text()
        ((start, end),) = ends_in(page, "gap_", 0.75)
    power = words.split("10")[-1].split()[0].translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
    ((_, gap),) = gaps_of(solution, np.array([0.75])).values()
    assert np.linalg.norm(gap) > 1e-9  # there is one
    np.testing.assert_allclose(end - start, 10.0 ** int(power) * gap[0], atol=1e-5)


@pytest.mark.browser
def test_a_motion_that_was_not_simulated_has_its_time_only(
    browser: Any,
    tmp_path: Path,
) -> None:
    mechanism = srm.load("four_bar")
    run = srm.simulate(mechanism, 1.0)
    srm.JointMotion(mechanism, run.t, run.q).export_html(tmp_path / "page.html", fps=20.0)
    with opened(browser, (tmp_path / "page.html").as_uri()) as page:
        assert panel(page, 0.5) == {"t": (0.5, "s")}
        assert page.locator("#marks span").count() == 0


@pytest.mark.parametrize("name", ["slider_crank", "spatial_four_bar", "bricard", "delta_robot"])
def test_gaps_are_as_large_as_the_errors_of_the_rows_of_length(name: str) -> None:
    solution = srm.simulate(srm.load(name), 0.3)
    q = np.array([solution.mechanism.model.nq * [0.0]]) + solution.q[-1]
    q[0, -1] += 0.03  # opened: rounding would show nothing
    opened_loops = srm.JointMotion(solution.mechanism, np.zeros(1), q)
    errors = constraint_errors(solution.mechanism, np.zeros(1), q, solution.v[-1:])[0][0]
    at = 0
    gaps = gaps_of(opened_loops, np.zeros(1))
    assert gaps
    for loop in solution.mechanism.loops:
        rows = errors[at : at + loop.rows.count][loop.rows.blocks[0]]
        at += loop.rows.count
        if len(rows):
            size = np.linalg.norm(gaps[loop.name][1])
            assert size == pytest.approx(np.linalg.norm(rows), rel=1e-9, abs=1e-15)


def test_quaternions_along_a_turning_direction_turn_z_to_it_without_twist() -> None:
    angle = np.linspace(0.0, 4.0 * np.pi, 200)  # through -z, where the shortest turn is not unique
    directions = np.column_stack([np.sin(angle), 0.0 * angle, np.cos(angle)])
    quaternions = overlays.turns_along(directions)
    for quaternion, direction in zip(quaternions, directions):
        turned = pin.Quaternion(quaternion).matrix()
        np.testing.assert_allclose(turned[:, 2], direction, atol=1e-12)
        np.testing.assert_allclose(turned[:, 1], [0.0, 1.0, 0.0], atol=1e-12)
    assert np.all(np.sum(quaternions[1:] * quaternions[:-1], axis=1) > 0.9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"trace": ["rod"]}, "'rod' cannot be traced"),
        ({"trace": ROD}, "trace is one anchor"),
        ({"trace": [srm.Anchor("nothing")]}, "no link 'nothing'"),
        ({"trace": [srm.Anchor("world", xyz=(1.0, 0.0, 0.0))]}, "lies on the ground"),
    ],
)
def test_what_cannot_be_traced_is_an_input_error(
    tmp_path: Path, slider_crank: srm.Solution, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(srm.InputError, match=words):
        slider_crank.export_html(tmp_path / "page.html", **options)
    assert not list(tmp_path.iterdir())


def test_reactions_of_an_open_chain_and_of_a_prescribed_motion_are_refused(
    tmp_path: Path, slider_crank: srm.Solution
) -> None:
    pendulum = srm.simulate(srm.load("simple_pendulum"), 0.1)
    with pytest.raises(srm.InputError, match="no closures with reactions"):
        pendulum.export_html(tmp_path / "page.html", reactions=True)
    motion = srm.JointMotion(slider_crank.mechanism, slider_crank.t, slider_crank.q)
    with pytest.raises(srm.InputError, match="not simulated has no reactions"):
        motion.export_html(tmp_path / "page.html", reactions=True)


def test_the_camera_sees_the_whole_path_of_a_point_far_out(slider_crank: srm.Solution) -> None:
    far = srm.Anchor("rod", xyz=(9.0, 0.0, 0.0))
    view = make_picture(slider_crank, 20.0, Wanted([far])).view
    path = np.array([place(slider_crank, t, far) for t in np.linspace(0.0, 8.0, 161)])
    x, y, depth = view.axes @ (path - view.target).T
    slope = np.tan(np.radians(0.5 * FIELD_OF_VIEW)) * (view.distance + depth)
    reach = max(np.abs(x / slope).max() / ASPECT, np.abs(y / slope).max())
    assert reach == pytest.approx(FILLED, abs=0.02)


def test_names_do_not_end_the_script_of_a_page() -> None:
    from srm_mbs.drawing import import_meshcat

    about = {"notes": [{"text": "</script><script>alert(1)</script>"}]}
    page = make_page(import_meshcat(), "a</title>b", about, [])
    assert "</script><script>alert(1)" not in page
    assert "a</title>b" not in page


def test_what_the_page_is_made_of_is_package_data() -> None:
    folder = Path(srm.__file__).with_name("page")
    assert {"page.html", "page.js"} <= {file.name for file in folder.iterdir()}


@pytest.mark.browser
def test_the_command_line_draws_the_path_of_a_point_of_a_link(
    browser: Any, tmp_path: Path, slider_crank: srm.Solution
) -> None:
    path = tmp_path / "page.html"
    options = ["--t-end", "8", "--html", str(path), "--trace", "rod:0.5,0,0.2"]
    done = CliRunner().invoke(app, ["simulate", "slider_crank", *options])
    assert done.exit_code == 0, done.output
    with opened(browser, path.as_uri()) as page:
        ball = ends_in(page, "point_", 2.5)[0, 0]
    assert np.abs(ball - place(slider_crank, 2.5, ROD)).max() < 1e-6


@pytest.mark.parametrize(
    ("model", "options", "words"),
    [
        ("slider_crank", ["--trace", "rod"], "'rod' is no point of a link"),
        ("slider_crank", ["--trace", "rod:1,2"], "'rod:1,2' is no point of a link"),
        ("slider_crank", ["--trace", "bar:1,2,3"], "--trace: there is no link 'bar'"),
        ("simple_pendulum", ["--reactions"], "--reactions: the mechanism has no closures"),
    ],
)
def test_what_cannot_be_drawn_is_refused_before_the_run(
    model: str, options: list[str], words: str
) -> None:
    done = CliRunner().invoke(app, ["simulate", model, *options])
    assert done.exit_code == 2
    assert words in done.output
    assert "steps" not in done.output
