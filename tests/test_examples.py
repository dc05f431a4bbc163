"""Every example runs by itself, warnings as errors, and says what it should."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def run(path: Path, folder: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", str(path)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "agg"},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_runs(path: Path, tmp_path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 100
    assert run(path, tmp_path)


def test_the_slider_crank_example_passes_singular_configurations(tmp_path: Path) -> None:
    output = run(ROOT / "examples" / "slider_crank.py", tmp_path)
    assert output.count("singular configuration passed") == 9
    assert (tmp_path / "slider_crank.png").stat().st_size > 10_000
    assert (tmp_path / "slider_crank.html").stat().st_size > 500_000


def test_the_own_mechanism_is_the_bundled_four_bar(tmp_path: Path) -> None:
    output = run(ROOT / "examples" / "own_mechanism.py", tmp_path)
    assert "crank is at 27.0904" in output


def test_the_loop_inside_a_urdf_is_read_and_converted(tmp_path: Path) -> None:
    output = run(ROOT / "examples" / "loops_inside_a_urdf.py", tmp_path)
    assert "read: ['tip (revolute)']" in output
    assert "degrees of freedom: 1" in output
    assert (tmp_path / "four_bar_converted.toml").is_file()


def test_the_drift_of_scipy_grows_and_ours_does_not(tmp_path: Path) -> None:
    rows = run(ROOT / "examples" / "drift_against_scipy.py", tmp_path).splitlines()[1:]
    scipy, ours = zip(*(map(float, row.split()[1:]) for row in rows))
    assert scipy[-1] > 1e-5
    assert max(ours) < 1e-13


def test_the_controller_holds_the_five_bar_on_its_path(tmp_path: Path) -> None:
    output = run(ROOT / "examples" / "five_bar_controller.py", tmp_path)
    assert float(output.split("error of the cranks ")[1].split()[0]) < 2e-2


def test_the_feed_of_the_reactor_is_the_exact_one(tmp_path: Path) -> None:
    output = run(ROOT / "examples" / "not_a_mechanism.py", tmp_path)
    found, exact = (float(part.split()[-1]) for part in output.splitlines()[1].split(","))
    assert abs(found - exact) < 1e-7


def test_the_platform_has_six_damped_modes(tmp_path: Path) -> None:
    output = run(ROOT / "examples" / "stewart_platform.py", tmp_path)
    assert "stable: True" in output
    assert len([line for line in output.splitlines() if line[:6].strip().isdigit()]) == 6


def test_the_sweep_finds_which_cases_overload_the_pin(tmp_path: Path) -> None:
    output = run(ROOT / "examples" / "parameter_sweep.py", tmp_path)
    assert "9 reached the end, 3 failures, 0 resumed" in output
    rows = [line.split() for line in output.splitlines() if line[:7].strip()[:1].isdigit()]
    forces = {(float(row[0]), float(row[1])): float(row[2]) for row in rows}
    assert len(forces) == 9
    for mass, speed in forces:
        # Without a faster crank or a heavier coupler there is no larger force.
        assert forces[mass, speed] <= forces[mass, 6.0]
        assert forces[mass, speed] <= forces[2.0, speed]
    assert 0 < output.count("too much") < 9
    again = run(ROOT / "examples" / "parameter_sweep.py", tmp_path)
    assert "3 failures, 9 resumed" in again
    assert again.splitlines()[1:] == output.splitlines()[1:]
