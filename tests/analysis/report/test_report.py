"""The report of a run: its content, and that it opens anywhere."""

from __future__ import annotations

import io
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from PIL import Image

import srm_mbs as srm
from srm_mbs.analysis.report.report import report_page
from srm_mbs.analysis.report.sections import pictures_data, run_data
from srm_mbs.visualization.animation.overlays import ViewOptions
from srm_mbs.visualization.animation.scene import FIELD_OF_VIEW, make_picture
from srm_mbs.visualization.animation.shapes import ANCHOR_COLOUR
from srm_mbs.visualization.animation.snapshot import draw_snapshot
from tests.support.browsing import LARGE, opened
from tests.support.bundled import load
from tests.support.commands import run as run_command
from tests.support.mechanisms import DISTINCT_MODELS

VOID = {"meta", "link", "img", "br", "input", "hr"}
MEGABYTES = 1_000_000


class Page(HTMLParser):
    """Checks that tags are closed in order; collects tables, headings, ids, and addresses."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.alternatives: list[str] = []
        self.text = ""
        self.srcdoc = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = dict(attributes)
        self.ids += [values["id"]] if values.get("id") else []
        self.links += [value for key in ("src", "href") if (value := values.get(key))]
        self.srcdoc = values.get("srcdoc") or self.srcdoc
        if tag == "img":
            self.alternatives.append(values.get("alt") or "")
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[-1][-1][-1] += data
        if not {"style", "script"} & set(self.open):
            self.text += data

    def cell(self, row: str, column: int = 1) -> str:
        """The cell of the first table that has such a row."""
        return next(
            line[column] for table in self.tables for line in table if line and line[0] == row
        )


@pytest.fixture(scope="module")
def run() -> srm.Solution:
    return srm.simulate(load("slider_crank"), 4.0)


@pytest.fixture(scope="module")
def certificate(run: srm.Solution) -> srm.Certificate:
    return srm.certify(run)


@pytest.fixture(scope="module")
def path(
    run: srm.Solution, certificate: srm.Certificate, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    run.report(path, certificate=certificate, pictures=["run", "sigma"])
    return path


@pytest.fixture(scope="module")
def page(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def test_the_page_is_well_formed_and_its_contents_lead_to_its_sections(page: Page) -> None:
    targets = [link[1:] for link in page.links if link.startswith("#")]
    assert targets == ["mechanism", "animation", "freedom", "run", "accuracy", "pictures"]
    assert set(targets) <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))


@pytest.mark.parametrize(("pictures", "count"), [("sigma", 1), (np.array([]), 0)])
def test_pictures_are_given_by_one_name_or_any_list(
    run: srm.Solution, certificate: srm.Certificate, tmp_path: Path, pictures: Any, count: int
) -> None:
    run.report(
        tmp_path / "report.html", certificate=certificate, animation=False, pictures=pictures
    )
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert page.links.count("#pictures") == count


def test_the_page_asks_for_nothing_from_elsewhere_and_is_small(page: Page, path: Path) -> None:
    assert all(link.startswith(("#", "data:")) for link in page.links)
    assert path.stat().st_size < 5 * MEGABYTES
    text = path.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert '<html lang="en">' in text
    assert "@import" not in text


def test_every_picture_says_what_it_shows(page: Page) -> None:
    assert len(page.alternatives) >= 3
    assert all(len(words) > 20 for words in page.alternatives)


def test_the_tables_have_the_numbers_of_the_run(page: Page, run: srm.Solution) -> None:
    assert page.cell("degrees of freedom") == "1"
    assert page.cell("rank") == "1"
    assert page.cell("steps") == str(run.stats.steps)
    assert page.cell("evaluations") == str(run.stats.evaluations)
    assert page.cell("relative tolerance") == "1e-06"
    assert page.cell("crank") == "revolute"
    passages = next(table for table in page.tables if table[0][0] == "time (s)")
    times = [float(row[0]) for row in passages[1:]]
    assert times == pytest.approx([crossing.time for crossing in run.crossings], rel=1e-8)
    assert len(times) == 2
    assert {row[4] for row in passages[1:]} == {"kept (2 meet)"}
    assert {row[3] for row in passages[1:]} == {"0.0e+00"}


def test_the_certificate_in_the_page_is_that_of_the_run(
    page: Page, certificate: srm.Certificate
) -> None:
    for found in certificate.findings:
        assert found.text in page.text
    estimate = certificate.estimate
    table = next(table for table in page.tables if table[0][:2] == ["joint", "position"])
    for row, joint in zip(table[1:], estimate.joints, strict=True):
        assert row[0] == joint.joint
        assert row[1] == f"{joint.position:.2e} {joint.unit}"
        assert row[3] == f"{joint.rate:.2e} {joint.unit}/s"
    table = next(table for table in page.tables if table[0][0] == "relative tolerance")
    assert [row[1] for row in table[1:]] == [str(trial.steps) for trial in estimate.trials]
    (drift,) = certificate.drift
    assert page.cell("closure errors in m") == f"{drift.position:.2e} m"


@pytest.mark.browser
def test_the_page_opens_from_disk_without_complaint_and_its_animation_plays(
    browser: Any, path: Path
) -> None:
    with opened(browser, path.as_uri(), LARGE, plays=True) as shown:
        inner = shown.frames[-1]
        assert inner.evaluate("animator.duration") == pytest.approx(4.0)
        before = inner.evaluate("animator.time")
        inner.wait_for_function(f"animator.time > {before} + 0.1")
        # Nothing is wider than the window, however narrow; tables scroll in their boxes.
        for width in (1200, 360):
            shown.set_viewport_size({"width": width, "height": 700})
            shown.wait_for_function(f"innerWidth === {width}")
            assert shown.evaluate("document.documentElement.scrollWidth") <= width
        shown.emulate_media(media="print")
        shown.locator("iframe").wait_for(state="hidden")
        assert shown.locator("figure img").first.is_visible()


def test_names_of_the_user_are_text_in_the_page(run: srm.Solution) -> None:
    mechanism = replace(run.mechanism, name="<script>alert(1)</script> & co", notes=("a <b>",))
    named = srm.simulate(mechanism, 0.1)
    page = report_page(named, srm.certify(named, again=False), pictures=())
    assert "<script>alert(1)" not in page
    parsed = Page(page)
    assert "<script>alert(1)</script> & co: report of a run" in parsed.text
    assert "a <b>" in parsed.text
    assert "<script>alert(1)" not in parsed.srcdoc


def short_page(run: srm.Solution, *, again: bool = True) -> Page:
    """The page of a run, without its animation and pictures."""
    certificate = srm.certify(run, again=again)
    return Page(report_page(run, certificate, animation=False, pictures=()))


def test_a_run_that_failed_has_a_page_that_says_so() -> None:
    def breaks(t: float, q: Any, v: Any) -> list[float]:
        if t > 0.5:
            raise ValueError("it <broke>")
        return [0.0]

    failed = srm.simulate(load("simple_pendulum"), 1.0, controller=breaks)
    assert not failed.success
    page = short_page(failed)
    assert "it <broke>" in page.text
    assert "Accuracy, overall ✗ poor" in page.text
    assert page.srcdoc == ""
    # It is an open chain, too.
    assert "There are none: it is an open chain." in page.text


def test_a_run_that_failed_at_its_start_has_a_page() -> None:
    def broken(t: float, q: Any, v: Any) -> list[float]:
        if t > 0.0:
            raise ValueError("never")
        return [0.0] * 3

    failed = srm.simulate(load("four_bar"), 1.0, controller=broken)
    page = short_page(failed)
    assert "failed at its start" in page.text


def test_the_page_of_many_loops_leaves_out_what_takes_minutes_and_says_so() -> None:
    run = srm.simulate(srm.n_four_bar(40), 1.5)
    crossing, *_ = run.crossings
    page = short_page(run, again=False)
    passages = next(table for table in page.tables if table[0][0] == "time (s)")
    assert passages[1][0] == f"{crossing.time:.9g}"
    assert passages[1][1] == passages[1][3] == passages[1][4] == "not computed"
    assert "takes minutes to compute" in page.text
    # They were not asked for: one passage takes 9 s.
    assert not {"participants", "_tangents", "singular"} & vars(crossing).keys()


def test_a_run_with_event_actions_and_drives_has_a_page() -> None:
    drive = srm.Drive(srm.ConstantSpeed(speed=6.0), joint="crank")
    mechanism = replace(load("slider_crank_regular"), drives=[drive])
    start = srm.assemble(mechanism)
    event = srm.Event(lambda t, q, v: t - 0.2, action=lambda t, q, v: None)
    driven = srm.simulate(mechanism, 0.4, q0=start.q, v0=start.v, events=[event])
    page = short_page(driven)
    assert page.cell("drives") == "1"
    assert "At the jump by an event action the times differ" in page.text


def test_tables_without_rows_and_headings_without_content_are_left_out() -> None:
    pendulum = srm.simulate(load("simple_pendulum"), 0.1)
    page = report_page(
        pendulum, srm.certify(pendulum, again=False), animation=False, pictures=["sigma"]
    )
    assert all(Page(page).tables)
    headings = re.findall("<h3>(.*?)</h3>", page)
    run_headings = ["Settings", "Statistics", "Largest reactions"]
    assert headings == ["Joints", "Bodies", "Loops", *run_headings, "Energy balance"]


# --- the snapshot ---------------------------------------------------------------------------------


def test_the_snapshot_shows_a_sphere_as_large_as_the_camera_sees_it() -> None:
    run = srm.simulate(load("simple_pendulum"), 0.1)
    pixels = seen(run)
    height, width, _ = pixels.shape
    assert width == 900
    rows, columns = np.nonzero((pixels < 250.0).any(axis=2))
    # The camera's place is chosen so that the motion fills 84 % of the width or the height.
    assert 0.6 < max(np.ptp(columns) / 900.0, np.ptp(rows) / 600.0) < 0.9
    assert rows.min() <= 24
    assert height - rows.max() <= 26


TWO_SHAPES = """<robot name="two"><link name="base"/>
  <link name="body">
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    {visuals}
  </link>
  <joint name="hinge" type="continuous">
    <parent link="base"/><child link="body"/><axis xyz="0 1 0"/>
  </joint>
</robot>
"""
VISUAL = """<visual><origin xyz="0 {y} 0" rpy="{tilt} 0 0"/><geometry>{shape}</geometry>
    <material name="{colour}"><color rgba="{colour}"/></material></visual>"""
RED, BLUE = "1 0 0 1", "0 0 1 1"


def two_shapes(folder: Path, *visuals: str) -> srm.Solution:
    """A body at rest that turns about y, and so is seen from -y, and has these visuals."""
    path = folder / "two.urdf"
    path.write_text(TWO_SHAPES.format(visuals="".join(visuals)), encoding="utf-8")
    return srm.simulate(srm.load(path), 0.01)


def seen(run: srm.Solution, t: float = 0.0) -> Any:
    """Pixels (height, width, 3) of the snapshot, 0 to 255."""
    picture = Image.open(io.BytesIO(draw_snapshot(run, t))).convert("RGB")
    return np.asarray(picture, dtype=float)


def coloured(pixels: Any, colour: Any) -> Any:
    """Which pixels have the hue of ``colour``, lit in whatever way."""
    lengths = np.linalg.norm(pixels, axis=2)
    colour = np.array(colour) / np.linalg.norm(colour)
    return (pixels @ colour > 0.997 * lengths) & (lengths > 40.0)


@pytest.mark.parametrize("red_first", [True, False])
def test_a_nearer_body_covers_a_farther_one_whichever_comes_first(
    tmp_path: Path, red_first: bool
) -> None:
    small, large = '<box size="0.2 0.02 0.2"/>', '<box size="0.6 0.02 0.6"/>'
    for red_y in (-0.1, 0.1):
        red = VISUAL.format(y=red_y, tilt=0, shape=small, colour=RED)
        blue = VISUAL.format(y=0.0, tilt=0, shape=large, colour=BLUE)
        pixels = seen(two_shapes(tmp_path, *((red, blue) if red_first else (blue, red))))
        reds, blues = coloured(pixels, (1, 0, 0)), coloured(pixels, (0, 0, 1))
        if red_y < 0.0:
            assert reds[len(reds) // 2, 450]
            # The edges are in the ratio of the sizes, but for the perspective.
            assert 2.6 < blues.any(axis=0).sum() / reds.any(axis=0).sum() < 3.0
        else:
            assert blues[len(blues) // 2, 450]
            assert not reds.any()


def test_a_rod_does_not_show_through_the_sleeve_that_is_hardly_wider(tmp_path: Path) -> None:
    rod, sleeve = (
        VISUAL.format(y=0, tilt=0.7, colour=colour, shape=f"<cylinder {sizes}/>")
        for colour, sizes in (
            (RED, 'radius="0.048" length="1"'),
            (BLUE, 'radius="0.05" length="0.6"'),
        )
    )
    pixels = seen(two_shapes(tmp_path, sleeve, rod))
    reds, blues = coloured(pixels, (1, 0, 0)), coloured(pixels, (0, 0, 1))
    rows = np.flatnonzero(blues.any(axis=1))
    assert reds[: rows[0]].any()
    assert reds[rows[-1] + 1 :].any()
    quarter = len(rows) // 4  # the ends are round
    assert not reds[rows[quarter] : rows[-quarter]].any()


def test_a_spring_around_a_rod_is_the_coil_of_the_page_and_leaves_the_rod_in_sight(
    tmp_path: Path,
) -> None:
    rod = VISUAL.format(y=0, tilt=0, colour=RED, shape='<cylinder radius="0.01" length="1"/>')
    bare = two_shapes(tmp_path, rod).mechanism
    ends = srm.Anchor("world", xyz=(0.0, 0.0, -0.5)), srm.Anchor("body", xyz=(0.0, 0.0, 0.5))
    sprung = replace(bare, forces=[srm.SpringDamper(*ends, stiffness=1.0, rest_length=1.0)])
    without, around = (
        coloured(seen(srm.simulate(mechanism, 0.01)), (1, 0, 0)) for mechanism in (bare, sprung)
    )
    assert 0.5 * without.sum() < around.sum() < 0.95 * without.sum()


def test_a_mechanism_that_is_about_to_drive_far_away_fills_its_snapshot() -> None:
    pendulum = load("simple_pendulum").model
    model = pin.Model()
    track = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "track")
    model.appendBodyToJoint(track, pin.Inertia(1.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    arm = model.addJoint(track, pin.JointModelRY(), pin.SE3.Identity(), "arm")
    model.appendBodyToJoint(arm, pendulum.inertias[1], pin.SE3.Identity())
    run = srm.simulate(srm.Mechanism(model, v0=np.array([50.0, 0.0])), 20.0)
    rows, columns = np.nonzero((seen(run) < 250.0).any(axis=2))
    assert max(np.ptp(columns) / 900.0, np.ptp(rows) / 600.0) > 0.6


@pytest.mark.parametrize("t", [0.0, 0.5])
def test_the_bob_stands_in_the_snapshot_where_kinematics_puts_it(t: float) -> None:
    run = srm.simulate(load("simple_pendulum"), 1.0)
    _, columns = np.nonzero(coloured(seen(run, t), (0.902, 0.624, 0.0)))
    angle = run(t)[0][0]
    bob = np.array([math.cos(angle), 0.0, math.sin(angle)])
    view = make_picture(run, 200.0, ViewOptions()).view
    right, _, forward = view.axes @ (bob - view.target)
    scale = 300.0 / math.tan(math.radians(0.5 * FIELD_OF_VIEW))
    assert 0.5 * (columns.min() + columns.max() + 1) == pytest.approx(
        450.0 + scale * right / (view.distance + forward), abs=1.5
    )


def test_what_an_event_takes_away_is_missing_from_then_on() -> None:
    loaded = load("slider_crank")
    # Without visuals: bars, and a ball at each anchor of a closure.
    mechanism = srm.Mechanism(loaded.model, loaded.loops, loaded.q0, loaded.v0)
    freed = mechanism.without_loop("pin")
    event = srm.Event(lambda t, q, v: t - 0.1, action=lambda t, q, v: srm.Switch(freed))
    run = srm.simulate(mechanism, 0.2, events=[event])
    before, after = (coloured(seen(run, t), ANCHOR_COLOUR[:3]).sum() for t in (0.05, 0.15))
    assert before > 50
    assert after == 0


# --- the command ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(run: srm.Solution, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "run.npz"
    run.save(path)
    return path


def test_the_command_writes_the_page_beside_the_run(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "srm_mbs.analysis.report.report.pictures_data", lambda *_: {"images": [], "missing": []}
    )  # they take a second
    output = run_command("report", saved, "--no-animation")
    path = saved.with_name(f"{saved.stem}_report.html")
    assert f"written: {path}" in output
    assert re.search(r"^estimated error +good +No joint is off", output, re.MULTILINE)
    assert "repeating the run" in output
    page = Page(path.read_text(encoding="utf-8"))
    assert page.srcdoc == ""
    assert "iframe" not in path.read_text(encoding="utf-8").split("</style>")[1]


def test_a_picture_that_a_loaded_run_has_not_is_named_in_the_page(tmp_path: Path) -> None:
    controlled = srm.simulate(load("four_bar"), 0.1, controller=lambda t, q, v: 0.0 * v)
    controlled.save(tmp_path / "run.npz")
    found = pictures_data(srm.load_solution(tmp_path / "run.npz"), ["reactions"])
    (sentence,) = found["missing"]
    assert "Not drawn: the reactions of a loaded run with a controller" in sentence


def test_an_open_chain_has_pictures_of_the_reactions_of_its_joints() -> None:
    pendulum = srm.simulate(load("simple_pendulum"), 0.1)
    found = pictures_data(pendulum, ["reactions", "sigma"])
    assert len(found["images"]) == 1
    assert found["missing"] == []


def test_runs_of_the_same_steps_have_no_error_of_zero_and_no_empty_picture() -> None:
    sampled = srm.simulate(
        load("four_bar"), 0.5, controller=lambda t, q, v: [-v[0], 0.0, 0.0], sample_time=2e-3
    )
    certificate = srm.certify(sampled)
    [error] = [part for part in certificate.findings if part.topic == "estimated error"]
    assert "samples, breakpoints or max_step bound the steps of both" in error.text
    assert "0.0e+00 rad" not in error.text
    page = Page(report_page(sampled, pictures=[], certificate=certificate))
    assert not any("difference to the other run" in words for words in page.alternatives)
    free = srm.simulate(load("four_bar"), 0.5)
    page = Page(report_page(free, pictures=[], certificate=srm.certify(free)))
    assert any("difference to the other run" in words for words in page.alternatives)


def test_the_largest_reactions_are_listed_with_their_times(tmp_path: Path) -> None:
    solution = srm.simulate(load("four_bar"), 1.0)
    rows = {name: cells for name, *cells in run_data(solution)["reactions"]}
    assert list(rows) == ["closure pin", "joint crank", "joint coupler", "joint rocker"]
    sizes = np.linalg.norm(solution.joint_reactions["crank"][:, :3], axis=1)
    assert rows["joint crank"][0] == f"{sizes.max():.4g}"
    assert rows["joint crank"][1] == f"{solution.t[sizes.argmax()]:.4g}"
    controlled = srm.simulate(load("four_bar"), 0.1, controller=lambda t, q, v: 0.0 * v)
    controlled.save(tmp_path / "run.npz")
    assert run_data(srm.load_solution(tmp_path / "run.npz"))["reactions"] == []


@pytest.mark.stress
@pytest.mark.parametrize("name", DISTINCT_MODELS)
def test_every_bundled_mechanism_has_a_page_below_five_megabytes(name: str, tmp_path: Path) -> None:
    mechanism = load(name)
    run = srm.simulate(mechanism, min(2.0, mechanism.defaults.t_end or 2.0))
    run.report(tmp_path / "report.html")
    assert (tmp_path / "report.html").stat().st_size < 5 * MEGABYTES
    Page((tmp_path / "report.html").read_text(encoding="utf-8"))


def test_a_report_names_files_and_folders_only_if_asked(tmp_path: Path) -> None:
    folder = tmp_path / "home of the author"
    folder.mkdir()
    srm.convert("four_bar", folder / "mine.toml")
    urdf = folder / "mine.urdf"
    visual = '<visual><geometry><mesh filename="no.stl"/></geometry></visual>'
    urdf.write_text(urdf.read_text().replace("</link>", f"{visual}</link>"))
    solution = srm.simulate(srm.load(folder / "mine.toml"), 0.2)

    solution.report(tmp_path / "a.html", again=False, pictures=())
    solution.report(tmp_path / "b.html", again=False, full_paths=True, pictures=())
    solution.save(tmp_path / "run.npz")
    run_command("report", tmp_path / "run.npz", "--no-second-run", "--out", tmp_path / "c.html")

    for name in ("a.html", "c.html"):
        page = (tmp_path / name).read_text(encoding="utf-8")
        assert "mine.toml" in page
        assert folder.name not in page
    assert str(folder / "mine.toml") in (tmp_path / "b.html").read_text(encoding="utf-8")
