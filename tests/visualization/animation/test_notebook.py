"""The example notebook, run as Jupyter runs it, and its view in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import srm_mbs as srm
from tests.support.browsing import LARGE, assert_in_place, opened
from tests.support.notebooks import code_cells, executed_cells

ROOT = Path(__file__).parents[3]
NOTEBOOK = ROOT / "examples" / "slider_crank_notebook.ipynb"


def output(cell: dict[str, Any], kind: str) -> str:
    """What a cell gave of one MIME type."""
    found = [data[kind] for out in cell["outputs"] if kind in (data := out.get("data", {}))]
    return "".join(found[0])


@pytest.fixture(scope="module")
def executed(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """The code cells, each with what it gave."""
    return executed_cells(NOTEBOOK, tmp_path_factory.mktemp("notebook"))


def test_the_committed_notebook_is_short_and_holds_no_outputs() -> None:
    text = NOTEBOOK.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 100
    for cell in code_cells(NOTEBOOK):
        assert cell["outputs"] == []
        assert cell["execution_count"] is None


def test_the_notebook_runs_from_its_first_cell_to_its_last(
    executed: list[dict[str, Any]],
) -> None:
    assert [cell["execution_count"] for cell in executed] == [1, 2, 3]
    said = "".join("".join(out.get("text", "")) for out in executed[0]["outputs"])
    assert said.count("singular configuration passed") == 5
    assert len(output(executed[2], "image/png")) > 10_000


@pytest.mark.browser
def test_the_view_in_the_notebook_shows_the_bodies_where_forward_kinematics_puts_them(
    browser: Any, executed: list[dict[str, Any]], tmp_path: Path
) -> None:
    page = tmp_path / "notebook.html"
    cell = output(executed[1], "text/html")
    page.write_text(f"<!DOCTYPE html><meta charset='utf-8'><body>{cell}</body>", encoding="utf-8")
    solution = srm.simulate(srm.load("slider_crank"), 10.0, rtol=1e-8)
    with opened(browser, page.as_uri(), LARGE) as shown:
        view = shown.frames[1]
        box = shown.locator("iframe").bounding_box()
        for t in (0.0, 2.5, 10.0):
            assert {"crank", "rod"} <= assert_in_place(view, solution, t)
        assert view.locator("#panel").inner_text().count("sigma") == 1
        picture = shown.screenshot(path=tmp_path / "notebook.png")
    assert box["width"] > 800
    assert box["height"] == 420
    assert len(picture) > 20_000


def test_a_prescribed_motion_can_be_shown_too() -> None:
    mechanism = srm.load("four_bar")
    run = srm.simulate(mechanism, 0.1)
    motion = srm.JointMotion(mechanism, run.t, run.q)
    assert motion.show(height=300)._repr_html_().startswith("<iframe")
    assert len(repr(motion.show())) < 100
