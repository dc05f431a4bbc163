"""The site of the documentation, warnings as errors, with the animations of the tutorials.

    python -m tools.site

Run from a checkout with ``srm-mbs[docs]``: builds ``site/`` with Zensical from ``mkdocs.yml``, then
runs the code of the tutorials and puts the animations that it writes next to their pages, which
show them in a frame.  They are too large to be committed.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tools.pages import DOCS, ROOT, run_page

FRAME = re.compile(r'^<iframe src="([\w./]+)"', re.MULTILINE)
SITE = ROOT / "site"


def build() -> None:
    """The pages; links and names without a target are errors."""
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    done = subprocess.run(
        [*command, "-f", str(ROOT / "mkdocs.yml")], cwd=ROOT, check=False, capture_output=True
    )
    if done.returncode:
        said = (done.stdout + done.stderr).decode()
        raise SystemExit(said.split("Traceback", maxsplit=1)[0] + "the site was not built")


def add_animations(site: Path) -> list[Path]:
    """Write what the frames of the tutorials show; their addresses are relative to the source."""
    written = []
    for page in sorted((DOCS / "tutorials").glob("*.md")):
        text = page.read_text(encoding="utf-8")
        with tempfile.TemporaryDirectory() as folder:
            run_page(text, page.name, Path(folder))
            for name in FRAME.findall(text):
                target = site / page.parent.relative_to(DOCS) / name
                shutil.copyfile(Path(folder) / name, target)
                written.append(target)
    return written


if __name__ == "__main__":
    build()
    for file in add_animations(SITE):
        sys.stdout.write(f"{file.relative_to(ROOT)}\n")
