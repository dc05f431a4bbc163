"""The page that shows everything: docs/thesis.md."""

from __future__ import annotations

import os
import textwrap
from pathlib import Path
from typing import Any

from benchmarks.thesis.entries import FIGURES, Entry

INTRODUCTION = """# The thesis, regenerated

C. B. Macdonald, *The Predicted Sequential Regularization Method for Differential-Algebraic
Equations*, Acadia University 2001: tables 5.1 to 5.7 and figures 1.3 and 5.1 to 5.16, computed
again by

```sh
python -m benchmarks.thesis --out DIR
```

(two processes, a few minutes), which writes `DIR/thesis.json`, a PNG for each of them, and with
`--page FILE` this page.  "Print" is the printed thesis; its values are in
`benchmarks/thesis/printed.json`, and all others are computed.  Tables 5.2 to 5.7 come from
`srm.solve_dae`, table 5.1 from its operations written out, and figures 5.3 and 5.13 to 5.16 from
the package's sweeps over steps; `benchmarks/thesis` has the parts that only the thesis needs (own
histories with an estimate across sweeps, forced steps, index 2).  An asterisk marks a value that
differs from print by more than 0.1, or in any digit of table 5.1.  [Methods](methods.md#method)
describes the methods, [Notation and equations](notation.md#sweeps) has the sweeps.
"""


def _line(value: Any) -> str:
    """Values in one line."""
    if isinstance(value, dict):
        if set(value) == {"statement"}:
            return f"(in our words) {value['statement']}"
        return "; ".join(f"{key}: {_line(item)}" for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_line, value))
    return str(value)


def _filled(text: str) -> str:
    """A paragraph."""
    return textwrap.fill(text, 100, break_long_words=False, break_on_hyphens=False) + "\n"


def write_page(entries: list[Entry], pictures: Path, path: Path) -> None:
    """Write the page to ``path``, with links to the PNGs in ``pictures``."""
    folder = Path(os.path.relpath(pictures, path.parent)).as_posix()
    parts = [INTRODUCTION]
    for entry in entries:
        parts.append(f"## {entry.title}\n\n![{entry.key}]({folder}/{entry.png})\n")
        # Numbers of tables and slopes stand in the pictures.
        if entry.key in FIGURES and not entry.slopes:
            parts.append(_filled(f"Print: {_line(entry.printed)}.  Ours: {_line(entry.ours)}."))
        parts.append(_filled(f"{entry.setup}  {entry.difference}"))
    path.write_text("\n".join(parts), encoding="utf-8")
