"""The code on the README and the pages of docs/ runs, and the site has every page."""

from __future__ import annotations

import ast
import inspect
import json
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml
from defusedxml.ElementTree import fromstring
from PIL import Image, ImageSequence

import srm_mbs as srm
from srm_mbs.dynamics.constraints.rows import closure_errors
from srm_mbs.formats.toml.description import check_description, parse_toml
from srm_mbs.formats.toml.parameters import Resolved
from tools import closure_sketches, plot_pictures, singular_pictures, tutorials
from tools.method_tables import filled
from tools.pages import DOCS, PRINTS, ROOT, blocks, is_whole, run_page, with_printed
from tools.singular_pictures import by_scipy
from tools.site import add_animations

SOURCE = ROOT / "srm_mbs"
PAGES = {
    "README.md": (ROOT / "README.md").read_text(encoding="utf-8"),
    **{
        page.relative_to(DOCS).as_posix(): page.read_text(encoding="utf-8")
        for page in sorted(DOCS.rglob("*.md"))
    },
}
"""Text of each page, by the name of its file, relative to docs/."""
TUTORIALS = [page for page in PAGES if page.startswith("tutorials/")]
LANGUAGES = {"python", "toml", "xml", "sh", ""}
"""Of fenced blocks; one in another language would be run by no test."""
Ran = Callable[[str], tuple[dict[str, Any], Path]]


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Any]:
    """Run the blocks of a page, once: what they left behind, their folder, what they printed."""

    @cache
    def run(page: str) -> tuple[dict[str, Any], Path, list[str]]:
        folder = tmp_path_factory.mktemp("page")
        names, printed = run_page(PAGES[page], page, folder)
        return names, folder, printed

    return run


@pytest.fixture(scope="module")
def ran(outcome: Callable[[str], Any]) -> Ran:
    """What the blocks of a page left behind, and their folder."""
    return lambda page: outcome(page)[:2]


def with_code() -> list[str]:
    return [
        page
        for page, text in PAGES.items()
        if any(kind in ("python", "toml") for kind, _ in blocks(text))
    ]


@pytest.mark.parametrize("page", with_code())
def test_the_blocks_of_a_page_run_in_order(page: str, ran: Ran) -> None:
    names, _ = ran(page)
    for name, value in names.items():
        if isinstance(value, srm.Solution):
            assert value.success, (name, value.message)


@pytest.mark.parametrize("page", PAGES)
def test_every_block_of_a_page_is_in_a_language_that_is_known_here(page: str) -> None:
    text = PAGES[page]
    assert {language for language, _ in blocks(PAGES[page])} <= LANGUAGES
    assert 2 * len(blocks(PAGES[page])) == text.count("```")


def fragments() -> list[tuple[str, str]]:
    return [
        (page, text)
        for page in PAGES
        for language, text in blocks(PAGES[page])
        if language == "toml" and not is_whole(text)
    ]


@pytest.mark.parametrize(("page", "text"), fragments())
def test_the_tables_of_descriptions_on_a_page_are_valid(page: str, text: str) -> None:
    entries = parse_toml('format = 1\nurdf = "x.urdf"\n' + text, page)
    description = check_description(Resolved(entries, {}, page).entries, page)
    kinds = (description.loop, description.drive, description.force, description.override)
    assert sum(map(len, kinds)) == text.count("[[")


@pytest.mark.parametrize("page", PAGES)
def test_the_files_that_a_page_names_are_there(page: str) -> None:
    text = PAGES[page]
    folders = "srm_mbs|tests|benchmarks|tools|docs|models|urdf|examples"
    named = re.findall(rf"`((?:{folders})/[\w./]+)`", text)
    assert [path for path in named if not list(ROOT.glob(f"{path}*"))] == []


# --- the site ------------------------------------------------------------------------------------


def test_the_site_leads_to_every_page() -> None:
    def pages(entry: Any) -> list[str]:
        if isinstance(entry, str):
            return [entry]
        parts = entry.values() if isinstance(entry, dict) else entry
        return [page for part in parts for page in pages(part)]

    listed = pages(yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"])
    assert sorted(listed) == sorted(set(PAGES) - {"README.md"})


@pytest.mark.parametrize("page", PAGES)
def test_the_pictures_that_a_page_shows_are_there(page: str) -> None:
    folder = ROOT if page == "README.md" else (DOCS / page).parent
    shown = re.findall(r"!\[[^\]]*\]\(([^)#]+)\)", PAGES[page])
    assert [path for path in shown if not (folder / path).is_file()] == []


def test_the_page_of_the_api_has_every_public_name() -> None:
    listed = re.findall(r"^::: srm_mbs\.(\w+)$", PAGES["api.md"], re.MULTILINE)
    assert len(listed) == len(set(listed))
    assert set(listed) == set(srm.__all__)


def members(value: type) -> list[str]:
    """Public methods and properties that a class defines itself."""
    own = vars(value).items()
    code = (property, cached_property, classmethod, staticmethod)
    return [
        key
        for key, member in own
        if not key.startswith("_") and (isinstance(member, code) or inspect.isfunction(member))
    ]


@pytest.mark.parametrize("name", [name for name in srm.__all__ if callable(getattr(srm, name))])
def test_every_public_function_and_class_is_documented_with_its_members(name: str) -> None:
    value = getattr(srm, name)
    doc = value.__doc__ or ""
    assert len(doc) > 20
    assert not doc.startswith(f"{name}("), "a dataclass writes its signature where it has nothing"
    if isinstance(value, type):
        without = [key for key in members(value) if not inspect.getdoc(getattr(value, key))]
        assert not without


@pytest.mark.parametrize("name", [name for name in srm.__all__ if not callable(getattr(srm, name))])
def test_every_public_table_is_documented_in_its_module(name: str) -> None:
    home = SOURCE / f"{srm._HOME[name].replace('.', '/')}.py"
    body = ast.parse(home.read_text(encoding="utf-8")).body
    after = next(
        b for a, b in pairwise(body) if getattr(getattr(a, "target", None), "id", "") == name
    )
    assert isinstance(after, ast.Expr)
    assert isinstance(after.value, ast.Constant)


# --- what the README shows -----------------------------------------------------------------------


def test_the_readme_leaves_the_files_that_it_names(ran: Ran) -> None:
    _, folder = ran("README.md")
    assert (folder / "drift.png").stat().st_size > 10_000
    assert (folder / "slider_crank.html").stat().st_size > 500_000


def test_the_linkage_in_the_readme_turns_fully_and_is_saved(ran: Ran) -> None:
    names, folder = ran("README.md")
    assert np.ptp(names["run"].joint("O")[0]) == pytest.approx(6.28)
    assert srm.load(folder / "four_bar.toml").model == names["linkage"].model


def test_the_readme_starts_with_exactly_two_commands() -> None:
    language, first = blocks(PAGES["README.md"])[0]
    commands = [line for line in first.splitlines() if line and not line.startswith("#")]
    assert language == "sh"
    assert len(commands) == 2
    assert "pip install ." in commands[0]
    assert "srm-mbs simulate slider_crank" in commands[0]
    assert commands[1] == "tests/run"


# --- the tutorials -------------------------------------------------------------------------------


@pytest.mark.parametrize("page", [*TUTORIALS, "machine_design.md"])
def test_what_a_page_shows_below_a_block_is_what_the_block_prints(
    page: str, outcome: Callable[[str], Any]
) -> None:
    text = PAGES[page]
    assert len(PRINTS.findall(text)) > 5
    assert with_printed(text, outcome(page)[2]) == text, "run python -m tools.tutorials"


@pytest.mark.parametrize("page", TUTORIALS)
def test_a_tutorial_writes_its_figures_and_its_animations(page: str, ran: Ran) -> None:
    _, folder = ran(page)
    for name in re.findall(r'"(\w+\.pdf)"', PAGES[page]):
        head = (folder / name).read_bytes()[:5]
        assert head == b"%PDF-", name
    frames = re.findall(r'<iframe src="(\w+\.html)"', PAGES[page])
    assert f"{Path(page).stem}.html" in frames
    for frame in frames:
        assert (folder / frame).stat().st_size > 500_000


@pytest.mark.parametrize("page", TUTORIALS)
def test_the_pictures_of_a_tutorial_are_those_of_its_code(
    page: str, ran: Ran, tmp_path: Path
) -> None:
    names, _ = ran(page)
    tutorials.draw(Path(page).stem, names, tmp_path)
    for new in tmp_path.iterdir():
        with Image.open(new) as drawn, Image.open(DOCS / "tutorials" / new.name) as committed:
            assert drawn.size == committed.size, new.name
            difference = np.subtract(
                *(np.asarray(x.convert("L"), float) for x in (drawn, committed))
            )
        assert np.abs(difference).mean() < 2.0, f"{new.name}: run python -m tools.tutorials"
    shown = re.findall(r"\((\w+\.png)\)", PAGES[page])
    assert sorted(shown) == sorted(path.name for path in tmp_path.iterdir())


@pytest.mark.parametrize("page", TUTORIALS)
def test_the_film_of_a_tutorial_moves_and_is_small(page: str) -> None:
    path = DOCS / page.replace(".md", ".gif")
    assert path.stat().st_size < 200_000
    with Image.open(path) as film:
        frames = [np.asarray(frame.convert("L"), float) for frame in ImageSequence.Iterator(film)]
    assert len(frames) > 20
    assert all(np.abs(b - a).max() > 50.0 for a, b in pairwise(frames))


@pytest.mark.stress
def test_the_site_has_the_animations_that_its_frames_show(tmp_path: Path) -> None:
    (tmp_path / "tutorials").mkdir()
    written = add_animations(tmp_path)
    assert {path.stem for path in written} == {*tutorials.PICTURES, "press_by_hand"}
    assert all(path.stat().st_size > 500_000 for path in written)


def test_the_work_of_the_motor_in_the_press_is_that_on_the_workpiece(ran: Ran) -> None:
    names, _ = ran("tutorials/press.md")
    run = names["run"]
    turn, torque = run.joint("O")[0], run.drive_forces["O"]
    assert np.trapezoid(torque, turn) == pytest.approx(0.5 * 60e3 * 4e-3, rel=1e-3)


def test_the_pin_forces_of_the_press_are_those_of_its_statics(ran: Ran) -> None:
    """Turned slowly and without weight, the knee carries what a triangle of forces says."""
    names, _ = ran("tutorials/press.md")
    machine, ram = names["machine"], names["ram"]
    model = machine.model.copy()
    model.gravity.linear = np.zeros(3)
    slow = replace(machine, model=model, drives=[srm.Drive(srm.ConstantSpeed(1e-3), joint="O")])
    place = srm.assemble(slow, {"O": np.radians(160.0)}, {"O": 1e-3})
    slow = slow.with_state(place.q, place.v)
    run = srm.simulate(slow, 1.0, controller=names["workpiece"], t_eval=[0.0, 1.0])
    knee, pin = (run.point(machine.points[name]).position[:, [0, 2]] for name in "KD")
    slope = np.arctan2(*np.abs(knee - pin).T)
    load = 60e3 * (1.0 - (run.joint("ram")[0] - ram.lower) / 4e-3)
    found = np.linalg.norm(run.reactions["D"][:, :3], axis=1)
    np.testing.assert_allclose(found, load / np.cos(slope), rtol=1e-6)


def test_the_rod_of_the_leg_balances_the_torque_about_the_knee(ran: Ran) -> None:
    """The shank alone: force of the rod times its distance from the knee is the knee's torque."""
    names, _ = ran("tutorials/leg.md")
    run, needed, direct = names["squat"], names["geared"], names["direct"]
    rod, lever, knee = (
        run.point(srm.Anchor(link, xyz=xyz)).position
        for link, xyz in (("rod", (0, 0, 0)), ("shank", (-0.02, 0, -0.035)), ("shank", (0, 0, 0)))
    )
    pull = needed.reactions["rod_pin"][:, :3]
    torque = -np.cross(lever - knee, pull)[:, 1]
    # The rod has mass: without it the two agree exactly.
    np.testing.assert_allclose(torque, direct.torques[:, 1], rtol=0.02, atol=0.3)
    assert np.linalg.norm(lever - rod, axis=1) == pytest.approx(0.25)


# --- what single pages promise -------------------------------------------------------------------


def test_the_page_on_control_says_what_is_out_of_scope() -> None:
    page = PAGES["control.md"]
    assert "Contact between bodies" in page[page.index("## Out of scope") :]


def test_the_run_with_an_impact_on_the_page_on_control_has_segments(ran: Ran) -> None:
    names, _ = ran("control.md")
    assert len(names["bounced"].segments) > 1


@pytest.mark.parametrize(
    ("page", "names"),
    [
        ("forces_and_drives.md", [*srm.FORCE_TYPES, *srm.LAW_TYPES]),
        ("closures.md", srm.CLOSURE_TYPES),
        ("methods.md", srm.TABLEAUS),
    ],
)
def test_a_page_has_every_name_of_its_tables(page: str, names: Iterable[str]) -> None:
    text = PAGES[page]
    assert [name for name in names if f"`{name}`" not in text and f'"{name}"' not in text] == []


def test_the_joint_on_the_page_on_forces_and_drives_meets_its_stop(ran: Ran) -> None:
    names, _ = ran("forces_and_drives.md")
    assert names["solution"].energy_balance.relative < 1e-6
    assert 1.5 < names["stopped"].joint("crank")[0].max() < 1.7


def test_the_sweeps_on_their_page_give_a_row_per_case(ran: Ran) -> None:
    names, folder = ran("sweeps.md")
    assert (names["again"].resumed, len(names["again"])) == (4, 6)
    assert len(names["broken"].failures) == 1
    assert not any(names[name].failures for name in ("sweep", "same", "swings", "on_dask"))
    assert (folder / "swings.parquet").exists()


def test_the_table_on_the_page_on_methods_is_that_of_the_committed_benchmark() -> None:
    results = json.loads((DOCS / "work_precision.json").read_text(encoding="utf-8"))
    page = PAGES["methods.md"]
    assert filled(page, results) == page, "run python -m tools.method_tables"


def test_the_page_on_methods_has_every_tableau_with_its_order_and_stages() -> None:
    page = PAGES["methods.md"]
    for line in page[page.index("## Tableau") : page.index("the observed orders.")].splitlines():
        if line.startswith("| `"):
            names, orders, stages, estimate, _ = (
                cell.strip() for cell in line.strip("|").split("|")
            )
            for name, order, count in zip(
                re.findall(r"`(\w+)`", names), orders.split(","), stages.split(","), strict=True
            ):
                tableau = srm.TABLEAUS[name]
                own = tableau.n_stages - tableau.lead
                assert (tableau.order, own) == (int(order), int(count))
                assert (tableau.error is not None) == (estimate == "yes")


def test_the_run_that_jumps_on_the_page_on_singular_configurations_hardly_shows_it() -> None:
    mechanism = srm.load("slider_crank")
    model, data = mechanism.model, mechanism.model.createData()
    run = by_scipy(mechanism, 10.0)
    q, v = np.ascontiguousarray(run.y[:2].T), np.ascontiguousarray(run.y[2:].T)
    assert np.abs(q[:, 1] + 2.0 * q[:, 0]).max() > 1.0, "it stayed on its branch"
    gap, _ = closure_errors(model, mechanism.loops, q, v)
    energy = np.array([pin.computeMechanicalEnergy(model, data, *state) for state in zip(q, v)])
    assert np.abs(gap).max() < 5e-6
    assert np.abs(energy / energy[0] - 1.0).max() < 1e-3


@pytest.mark.parametrize(
    ("page", "folder", "draw"),
    [
        ("singular_configurations.md", "singular", singular_pictures.draw),
        ("plots.md", "plots", plot_pictures.draw),
    ],
)
def test_the_pictures_of_a_page_can_be_drawn_again(
    page: str, folder: str, draw: Callable[[Path], None], tmp_path: Path
) -> None:
    draw(tmp_path)
    shown = re.findall(rf"\({folder}/(\w+\.png)\)", PAGES[page])
    assert sorted(shown) == sorted(path.name for path in tmp_path.iterdir())
    for name in shown:
        with Image.open(tmp_path / name) as new, Image.open(DOCS / folder / name) as old:
            assert new.size == old.size, name
            assert np.std(np.asarray(new.convert("L"), dtype=float)) > 5.0, f"{name} is blank"
    assert sum(path.stat().st_size for path in (DOCS / folder).iterdir()) < 150_000


def test_the_page_on_closures_has_a_sketch_of_every_type(tmp_path: Path) -> None:
    closure_sketches.draw(tmp_path)
    shown = re.findall(r"\(closures/(\w+)\.svg\)<br>`(\w+)`", PAGES["closures.md"])
    assert [picture for picture, _ in shown] == [name for _, name in shown]
    assert sorted(name for _, name in shown) == sorted(srm.CLOSURE_TYPES)
    drawn = {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()}
    committed = (DOCS / "closures").iterdir()
    assert drawn == {path.name: path.read_text(encoding="utf-8") for path in committed}
    for text in drawn.values():
        assert "prefers-color-scheme:dark" in text
        assert fromstring(text).tag.endswith("svg")


# --- docstrings on the site ----------------------------------------------------------------------


def test_the_roles_of_docstrings_become_links_and_formulae_code() -> None:
    roles = pytest.importorskip("tools.docstring_roles", reason="needs the extra docs")
    text = roles.without_roles(
        r"See :class:`~srm_mbs.dynamics.mechanism.Mechanism`, :math:`\dot G v`."
    )
    link = (
        '<autoref optional identifier="srm_mbs.dynamics.mechanism.Mechanism">`Mechanism`</autoref>'
    )
    assert text == rf"See {link}, `\dot G v`."


def test_parameters_described_together_are_listed_by_all_their_names() -> None:
    roles = pytest.importorskip("tools.docstring_roles", reason="needs the extra docs")
    text = "    q0 : (nq,), v0 : (nv,)\n        Initial state."
    assert roles.listed_together(text) == "    q0, v0 : (nq,), (nv,)\n        Initial state."
    assert roles.listed_together("    t : (n,)\n        s") == "    t : (n,)\n        s"
