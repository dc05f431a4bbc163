"""Notebooks, run as Jupyter runs them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


def code_cells(path: Path) -> list[dict[str, Any]]:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def executed_cells(notebook: Path, folder: Path) -> list[dict[str, Any]]:
    """The code cells of a notebook, run in a folder, each with what it gave."""
    names = ("HOME", "IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR")
    source = folder / notebook.name
    source.write_bytes(notebook.read_bytes())
    target = folder / "run"
    done = subprocess.run(
        [sys.executable, "-m", "jupyter", "execute", "--output", str(target), str(source)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
        | {name: str(folder) for name in names},
    )
    assert done.returncode == 0, done.stderr
    return code_cells(folder / "run.ipynb")


def printed(cell: dict[str, Any]) -> str:
    """What a cell printed."""
    return "".join("".join(out.get("text", "")) for out in cell["outputs"])
