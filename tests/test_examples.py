"""Every example runs by itself, warnings as errors, and says what it should."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from tests.support.notebooks import executed_cells, printed
from tools import tutorials
from tools.pages import DOCS, PRINTS

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
TUTORIALS = sorted(tutorials.PICTURES)
NAMES = ("SRM_MBS_BACKEND", "SRM_MBS_CACHE")
Ran = Callable[[str], tuple[str, Path]]


def run(path: Path, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", str(path)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "agg"}
        | {name: os.environ[name] for name in NAMES if name in os.environ},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """Run an example, once: what it printed, and the folder that it was run in."""

    @cache
    def outcome(name: str) -> tuple[str, Path]:
        folder = tmp_path_factory.mktemp(name)
        return run(ROOT / "examples" / f"{name}.py", folder), folder

    return outcome


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_runs(path: Path, ran: Ran) -> None:
    assert len(path.read_text().splitlines()) <= 100
    assert ran(path.stem)[0]


def test_the_slider_crank_example_passes_singular_configurations(ran: Ran) -> None:
    output, folder = ran("slider_crank")
    assert output.count("singular configuration passed") == 9
    assert (folder / "slider_crank.png").stat().st_size > 10_000
    assert (folder / "slider_crank.html").stat().st_size > 500_000


def test_the_own_mechanism_is_the_bundled_four_bar(ran: Ran) -> None:
    output, _ = ran("own_mechanism")
    assert "crank is at 27.0904" in output


def test_the_loop_inside_a_urdf_is_read_and_converted(ran: Ran) -> None:
    output, folder = ran("loops_inside_a_urdf")
    assert "read: ['tip (revolute)']" in output
    assert "degrees of freedom: 1" in output
    assert (folder / "four_bar_converted.toml").is_file()


def test_the_drift_of_scipy_grows_and_ours_does_not(ran: Ran) -> None:
    rows = ran("drift_against_scipy")[0].splitlines()[1:]
    scipy, ours = zip(*(map(float, row.split()[1:]) for row in rows))
    assert scipy[-1] > 1e-5
    assert max(ours) < 1e-13


def test_the_controller_holds_the_five_bar_on_its_path(ran: Ran) -> None:
    output, _ = ran("five_bar_controller")
    assert float(output.split("error of the cranks ")[1].split()[0]) < 2e-2


def test_the_feed_of_the_reactor_is_the_exact_one(ran: Ran) -> None:
    output, _ = ran("not_a_mechanism")
    found, exact = (float(part.split()[-1]) for part in output.splitlines()[1].split(","))
    assert abs(found - exact) < 1e-7


def test_the_platform_has_six_damped_modes(ran: Ran) -> None:
    output, _ = ran("stewart_platform")
    assert "stable: True" in output
    assert len([line for line in output.splitlines() if line[:6].strip().isdigit()]) == 6


def test_the_sweep_finds_which_cases_overload_the_pin(ran: Ran) -> None:
    output, folder = ran("parameter_sweep")
    assert "9 reached the end, 3 failures, 0 resumed" in output
    rows = [line.split() for line in output.splitlines() if line[:7].strip()[:1].isdigit()]
    forces = {(float(row[0]), float(row[1])): float(row[2]) for row in rows}
    assert len(forces) == 9
    for mass, speed in forces:
        # Without a faster crank or a heavier coupler there is no larger force.
        assert forces[mass, speed] <= forces[mass, 6.0]
        assert forces[mass, speed] <= forces[2.0, speed]
    assert 0 < output.count("too much") < 9
    again = run(ROOT / "examples" / "parameter_sweep.py", folder)
    assert "3 failures, 9 resumed" in again
    assert again.splitlines()[1:] == output.splitlines()[1:]


# --- the notebooks of the tutorials --------------------------------------------------------------


@pytest.mark.parametrize("name", TUTORIALS)
def test_the_notebook_of_a_tutorial_has_the_steps_of_its_page(name: str) -> None:
    text = (DOCS / "tutorials" / f"{name}.md").read_text(encoding="utf-8")
    committed = (ROOT / "examples" / f"{name}_notebook.ipynb").read_text(encoding="utf-8")
    assert committed == tutorials.notebook(name, text), "run python -m tools.tutorials"


# By default the blocks of the page itself are run (tests/test_documentation.py).
@pytest.mark.stress
@pytest.mark.parametrize("name", TUTORIALS)
def test_the_notebook_of_a_tutorial_prints_and_draws_what_its_page_shows(
    name: str, tmp_path: Path
) -> None:
    text = (DOCS / "tutorials" / f"{name}.md").read_text(encoding="utf-8")
    cells = executed_cells(ROOT / "examples" / f"{name}_notebook.ipynb", tmp_path)
    said = [printed(cell) for cell in cells if "%%writefile" not in cell["source"][0]]
    assert [text for text in said if text] == [shown for _, shown, _ in PRINTS.findall(text)]
    given = {"".join(cell["source"]): cell["outputs"] for cell in cells}
    for variable in tutorials.PICTURES[name].values():
        assert [out for out in given[variable] if "image/png" in out["data"]], variable
    views = [outputs for source, outputs in given.items() if source.endswith(".show()")]
    assert len(views) == text.count("<iframe ")
    for view in views:
        assert [out for out in view if "text/html" in out["data"]]
