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
