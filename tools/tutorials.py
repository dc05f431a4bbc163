"""What the tutorials print, their pictures, films and notebooks.

    python -m tools.tutorials [NAME ...]

Run from a checkout with ``srm-mbs[render]``: runs the code of ``docs/tutorials/NAME.md`` and writes
what it prints below its blocks, the pictures and the film of the page beside it, and the same steps
as ``examples/NAME_notebook.ipynb``.  Of ``docs/machine_design.md`` it writes what its blocks print.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import srm_mbs as srm
from benchmarks.thesis.drawing import save
from tools.pages import DOCS, FENCE, ROOT, name_of_file, run_page, with_printed

FOLDER = DOCS / "tutorials"
GLOSSARY = DOCS / "machine_design.md"
"""Page that shows what its code prints, without pictures of its own."""
PICTURES = {
    "press": {"press_forces": "forces", "press_poses": "poses"},
    "leg": {"leg_joints": "moved", "leg_poses": "poses"},
}
"""Page -> picture -> variable of the page that has its figure."""
FILMS = {
    "press": ("run", srm.Anchor("upper", xyz=(0.32, 0.0, 0.0)), (420, 320)),
    "leg": ("squat", srm.Anchor("shank"), (300, 360)),
}
"""Page -> variable of a run that ends as it begins, point whose path is drawn, size in pixels."""
SHOWN = re.compile(r"^(\w+)\.export_html\(", re.MULTILINE)
"""Runs whose page a notebook shows."""
FPS = 25.0
COLOURS = 64
BACKGROUND = 205
"""Smallest channel of the background, whose gradient would take most of the colours."""


def draw(page: str, names: dict[str, Any], folder: Path) -> None:
    """The pictures of a page, as ``folder/PICTURE.png``, from the variables that its code left."""
    for picture, variable in PICTURES[page].items():
        save(names[variable], folder / f"{picture}.png")


def notebook(page: str, text: str) -> str:
    """The text of the notebook of a page: its sections, files and code, with views of its results.

    Installation, printed text and films are left out; pictures become cells that draw them.
    """
    body = re.sub(r"^## Installation\n.*?(?=^## )", "", text, flags=re.DOTALL | re.MULTILINE)
    body = re.sub(r"^The code blocks are one program\..*?\n\n", "", body, flags=re.DOTALL | re.M)
    cells = [_cell("code", "%matplotlib inline")]
    end = 0
    for match in FENCE.finditer(body):
        cells += _prose(page, body[end : match.start()])
        end = match.end()
        language, block = match.groups()
        if language == "python":
            cells.append(_cell("code", block))
            cells += [_cell("code", f"{run}.show()") for run in SHOWN.findall(block)]
        elif file := name_of_file(block):
            cells.append(_cell("code", f"%%writefile {file}\n{block}"))
    cells += _prose(page, body[end:])
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    whole = {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1, ensure_ascii=False, sort_keys=True) + "\n"


def _prose(page: str, text: str) -> list[dict[str, Any]]:
    """Cells of the text between two blocks."""
    cells = []
    text = re.sub(r"^<iframe .*\n", "", text, flags=re.MULTILINE)
    text = text.replace("](../", "](../docs/")
    for part in re.split(r"^(!\[.*\]\(.*\))$", text, flags=re.MULTILINE):
        picture = re.fullmatch(r"!\[.*\]\((\w+)\.(png|gif)\)", part)
        if picture is None:
            cells += [_cell("markdown", part)] if part.strip() else []
        elif picture[2] == "png":
            cells.append(_cell("code", PICTURES[page][picture[1]]))
    return cells


def _cell(kind: str, text: str) -> dict[str, Any]:
    source = text.strip("\n").splitlines(keepends=True)
    code = {"execution_count": None, "outputs": []} if kind == "code" else {}
    return {"cell_type": kind, "metadata": {}, "source": source, **code}


def film(page: str, names: dict[str, Any], path: Path) -> None:
    """The film of a page, in few colours, to keep the repository small."""
    from PIL import Image

    variable, point, size = FILMS[page]
    with tempfile.TemporaryDirectory() as folder:
        frames = Path(folder) / "frames"
        names[variable].export_video(frames, fps=FPS, size=size, trace=[point])
        pictures = []
        for file in sorted(frames.iterdir()):
            pixels = np.array(Image.open(file).convert("RGB"))
            pixels[pixels.min(axis=2) > BACKGROUND] = 255
            pictures.append(Image.fromarray(pixels))
    palette = pictures[0].quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
    # The last picture is the first one again.
    few = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures[:-1]]
    few[0].save(path, save_all=True, append_images=few[1:], duration=round(1e3 / FPS), loop=0)


if __name__ == "__main__":
    for chosen in sys.argv[1:] or (*PICTURES, GLOSSARY.stem):
        source = GLOSSARY if chosen == GLOSSARY.stem else FOLDER / f"{chosen}.md"
        text = source.read_text(encoding="utf-8")
        with tempfile.TemporaryDirectory() as where:
            left, printed = run_page(text, source.name, Path(where))
        source.write_text(with_printed(text, printed), encoding="utf-8")
        if source == GLOSSARY:
            continue
        draw(chosen, left, FOLDER)
        film(chosen, left, FOLDER / f"{chosen}.gif")
        book = ROOT / "examples" / f"{chosen}_notebook.ipynb"
        book.write_text(notebook(chosen, text), encoding="utf-8")
