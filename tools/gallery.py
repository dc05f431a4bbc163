"""Pictures of the bundled mechanisms for ``docs/gallery.md``.

    python -m tools.gallery [NAME ...]

Run from a checkout with ``srm-mbs[render]``: simulates each mechanism, takes a picture with the
playback, and writes ``docs/gallery/NAME.png`` and the page.  Without names, all of them.
"""

from __future__ import annotations

import io
import re
import sys
from itertools import takewhile
from pathlib import Path

import srm_mbs as srm
from srm_mbs.formats.load import models_folder

DOCS = Path(__file__).parents[1] / "docs"
SIZE = (600, 400)
AT = {"slider_crank": 0.55, "jansen_walker": 0.35, "bricard": 1.0, "flyball_governor": 0.8}
"""Times (s) at which a mechanism shows best; elsewhere :data:`USUAL`."""
USUAL = 0.5


def summary(name: str) -> str:
    """The comment at the top of a description, as one paragraph."""
    lines = (models_folder() / f"{name}.toml").read_text(encoding="utf-8").splitlines()
    comment = takewhile(lambda line: line.startswith("#"), lines)
    text = " ".join(line.removeprefix("#").strip() for line in comment)
    return re.sub(r"\s*Written by [\w.]+\.$", "", re.sub(r"\s+", " ", text))


def picture(name: str) -> None:
    """Simulate and photograph one mechanism; few colours, to keep the repository small."""
    from PIL import Image

    mechanism = srm.load(name)
    t = min(AT.get(name, USUAL), mechanism.defaults.t_end or USUAL)
    if name == "squeezing_mechanism":
        t = 0.01
    solution = srm.simulate(mechanism, t)
    path = DOCS / "gallery" / f"{name}.png"
    path.parent.mkdir(exist_ok=True)
    solution.export_image(path, size=SIZE)
    with Image.open(io.BytesIO(path.read_bytes())) as image:
        few = image.convert("RGB").convert("P", palette=Image.Palette.ADAPTIVE, colors=96)
        few.save(path, optimize=True)


def _counted(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def page() -> str:
    """The page, from the descriptions and what the package finds in them."""
    parts = [
        "# Gallery",
        "The bundled mechanisms.  Each runs on the command line, for example with "
        '`srm-mbs simulate bricard --html bricard.html`, and loads with `srm.load("bricard")`.  '
        "[Terms](notation.md#terms) defines closures and their rank.  `python -m tools.gallery` "
        "writes this page and its pictures, `python -m tools.models` the larger mechanisms.",
    ]
    for name in srm.bundled_models():
        mechanism = srm.load(name)
        counted = (
            f"{_counted(mechanism.model.nv, 'joint coordinate')}, "
            f"{_counted(len(mechanism.loops), 'closure')} of rank {mechanism.structure.rank}, "
            f"{_counted(mechanism.degrees_of_freedom, 'degree')} of freedom."
        )
        parts += [f"## {name}", f"![{name}](gallery/{name}.png)", f"{summary(name)}  {counted}"]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    for chosen in sys.argv[1:] or srm.bundled_models():
        picture(chosen)
    (DOCS / "gallery.md").write_text(page(), encoding="utf-8")
