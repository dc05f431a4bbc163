"""The fenced blocks of the pages of the documentation, and how they run.

Python blocks run in order in one namespace.  A TOML block that is a whole description and an XML
block are files; the comment in their first line names them.  A block without a language directly
below a Python block is what that block prints.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import srm_mbs as srm

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
FENCE = re.compile(r"^```(\S*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PRINTS = re.compile(r"(^```python\n(?:.*?)^```\n\n```\n)(.*?)(^```$)", re.DOTALL | re.MULTILINE)
"""A Python block and the block of what it prints."""


def blocks(text: str) -> tuple[tuple[str, str], ...]:
    """Language and text of the fenced blocks of a page."""
    return tuple(FENCE.findall(text))


def is_whole(text: str) -> bool:
    """Whether a TOML block is a whole description, and not some tables of one."""
    return text.lstrip().startswith(("format", "#")) and "\nformat = " in f"\n{text}"


def name_of_file(text: str) -> str | None:
    """The name that the comment in the first line of a TOML or XML block gives."""
    named = re.match(r"(?:# (\S+\.toml)|<!-- (\S+) -->)\n", text)
    return None if named is None else named[1] or named[2]


def _describe(text: str, folder: Path) -> None:
    """Load a description as ``folder/[models/]NAME.toml``, where it finds its URDF."""
    named = name_of_file(text)
    path = folder / (named or f"models/{tomllib.loads(text)['name']}.toml")
    path.parent.mkdir(exist_ok=True)
    path.write_text(text, encoding="utf-8")
    if not named:
        (folder / "urdf").symlink_to(ROOT / "urdf")
    srm.load(path)


def run_page(text: str, page: str, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Run the blocks of a page in a folder.

    Returns
    -------
    names
        The namespace that the Python blocks left.
    printed
        What each Python block printed.
    """
    names: dict[str, Any] = {"__name__": "page"}
    printed = []
    with _working_in(folder):
        for number, (language, block) in enumerate(blocks(text), start=1):
            if language == "python":
                code = compile(block, f"{page}, block {number}", "exec", dont_inherit=True)
                with contextlib.redirect_stdout(io.StringIO()) as output:
                    exec(code, names)
                printed.append(output.getvalue())
            elif language == "toml" and is_whole(block):
                _describe(block, folder)
            elif language == "xml":
                (folder / str(name_of_file(block))).write_text(block, encoding="utf-8")
    return names, printed


def with_printed(text: str, printed: list[str]) -> str:
    """A page whose blocks of printed text are those of a run."""
    order = iter(printed)
    parts = []
    end = 0
    python = [match.start() for match in FENCE.finditer(text) if match[1] == "python"]
    said = dict(zip(python, order, strict=True))
    for match in FENCE.finditer(text):
        shown = PRINTS.match(text, match.start()) if match.start() in said else None
        if shown:
            parts += [text[end : shown.start(2)], said[match.start()]]
            end = shown.end(2)
    return "".join([*parts, text[end:]])


@contextlib.contextmanager
def _working_in(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
