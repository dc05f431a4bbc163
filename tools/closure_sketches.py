"""Sketches of the closure types for ``docs/closures.md``.

    python -m tools.closure_sketches [DIR]

Writes ``docs/closures/TYPE.svg``, or into DIR.  Link a and its anchor are blue, link b and its
anchor orange, axes dash-dotted; arrows show what a may do.  Colours follow the scheme, light or
dark, that the reader prefers.
"""

from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "docs" / "closures"
WIDTH, HEIGHT = 180, 120
STYLE = """
.a{stroke:#0072b2;fill:#cfe6f5} .b{stroke:#c25700;fill:#fbe3cd} .axis,.free{stroke:#444;fill:none}
.tip{stroke:#444;fill:#444} text{font:italic 14px sans-serif;stroke:none}
.na{fill:#0072b2} .nb{fill:#c25700} .n{fill:#444}
@media(prefers-color-scheme:dark){.a{stroke:#6cc0f0;fill:#173d57} .b{stroke:#f0a060;fill:#553112}
.axis,.free{stroke:#ccc} .tip{stroke:#ccc;fill:#ccc} .na{fill:#6cc0f0} .nb{fill:#f0a060}
.n{fill:#ccc}}
path,circle,rect,ellipse,polygon,line{stroke-width:2;stroke-linejoin:round;stroke-linecap:round}
.axis{stroke-width:1.2;stroke-dasharray:9 3 2 3} .free{stroke-width:1.5;marker-end:url(#t)}
.both{marker-start:url(#t)} .bar{fill:none;stroke-width:9} .thin{fill:none;stroke-width:3}
""".strip()
TIP = (
    '<marker id="t" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="7" markerHeight="7" '
    'orient="auto-start-reverse"><path class="tip" d="M1 1 7 4 1 7z" style="stroke-width:1"/>'
    "</marker>"
)


def path(kind: str, data: str) -> str:
    return f'<path class="{kind}" d="{data}"/>'


def circle(kind: str, x: float, y: float, r: float) -> str:
    return f'<circle class="{kind}" cx="{x:g}" cy="{y:g}" r="{r:g}"/>'


def label(text: str, x: float, y: float) -> str:
    kind = {"a": "na", "b": "nb"}.get(text, "n")
    return f'<text class="{kind}" x="{x:g}" y="{y:g}">{text}</text>'


def both(data: str) -> str:
    """A motion in both directions."""
    return path("free both", data)


def plane() -> str:
    return path("b", "M12 92 62 62 172 62 122 92z")


SKETCHES = {
    "point": [
        path("b bar", "M168 100 112 70"),
        path("b", "M88 74a18 18 0 1 0 10-32l3 10a8 8 0 0 1 -6 15z"),
        path("a bar", "M14 28 76 52"),
        circle("a", 90, 58, 13),
        both("M52 70a40 26 0 0 0 30 26"),
        both("M58 22a44 30 0 0 1 44 -6"),
        label("a", 24, 22),
        label("b", 156, 84),
    ],
    "frame": [
        path("b bar", "M168 62 92 62"),
        path("a bar", "M12 62 88 62"),
        path("tip", "M82 55 90 44 98 55z"),
        path("tip", "M82 69 90 80 98 69z"),
        label("a", 30, 48),
        label("b", 142, 48),
    ],
    "revolute": [
        path("axis", "M90 6V114"),
        path("b bar", "M168 92 104 92"),
        path("b", "M78 84a12 5 0 0 1 24 0V102a12 5 0 0 1 -24 0z"),
        path("b", "M78 28a12 5 0 0 1 24 0V42a12 5 0 0 1 -24 0z"),
        path("b thin", "M102 35H132V92"),
        path("a bar", "M12 62 76 62"),
        path("a", "M78 47a12 5 0 0 1 24 0V79a12 5 0 0 1 -24 0z"),
        both("M64 18a28 9 0 1 0 52 0"),
        label("a", 24, 50),
        label("b", 150, 80),
    ],
    "prismatic": [
        path("axis", "M4 84 176 36"),
        path("b", "M20 74 158 36 166 41 166 50 28 88 20 83z"),
        path("b thin", "M20 74 28 79 166 41M28 79V88"),
        path("a", "M66 54 100 44 116 52 116 74 82 84 66 76z"),
        path("a thin", "M66 54 82 62 116 52M82 62V84"),
        both("M64 32 104 21"),
        label("a", 92, 102),
        label("b", 150, 68),
    ],
    "cylindrical": [
        path("axis", "M4 62H176"),
        path("b", "M20 55H160a3 7 0 0 1 0 14H20a3 7 0 0 1 0 -14z"),
        path("a", "M70 45H110a7 17 0 0 1 0 34H70a7 17 0 0 1 0 -34z"),
        path("a thin", "M70 45a7 17 0 0 0 0 34"),
        both("M66 28H114"),
        both("M134 42a9 22 0 0 1 0 40"),
        label("a", 86, 98),
        label("b", 26, 46),
    ],
    "universal": [
        path("b bar", "M172 60H138"),
        path("b thin", "M136 60H128V28H90V40M128 60V92H90V80"),
        path("a bar", "M8 60H42"),
        path("a thin", "M44 60H50V78L72 70M50 60V46H98L107 51"),
        path("axis", "M90 14V106"),
        path("axis", "M56 75 124 46"),
        path("b", "M86 40H94V80H86z"),
        path("a", "M70 64 106 49 110 56 74 71z"),
        label("a", 14, 48),
        label("b", 152, 48),
        label("axis_b", 96, 116),
        label("axis_a", 26, 98),
    ],
    "planar": [
        plane(),
        path("axis", "M92 10V76"),
        path("a", "M70 52 88 42 120 42 120 66 102 76 70 76z"),
        path("a thin", "M70 52H102L120 42M102 52V76"),
        both("M128 77H158"),
        both("M30 90 56 75"),
        both("M74 22a18 6 0 1 0 36 0"),
        label("a", 124, 40),
        label("b", 16, 110),
    ],
    "point_on_line": [
        path("b thin", "M8 84 172 40"),
        path("a bar", "M58 16 88 58"),
        circle("a", 92, 62, 8),
        both("M84 88 122 78"),
        label("a", 46, 30),
        label("b", 150, 36),
    ],
    "point_on_plane": [
        plane(),
        path("axis", "M92 78V20"),
        path("a bar", "M140 12 98 68"),
        circle("a", 92, 76, 8),
        both("M110 80H140"),
        both("M56 88 76 76"),
        label("a", 142, 30),
        label("b", 16, 110),
    ],
    "distance": [
        path("a bar", "M10 100 36 82"),
        path("b bar", "M170 100 146 48"),
        path("axis", "M42 78 142 42"),
        path("free", "M42 78 142 42").replace('"free"', '"tip thin" fill="none"'),
        circle("a", 42, 78, 8),
        circle("b", 142, 42, 8),
        label("a", 12, 84),
        label("b", 160, 56),
        label("length", 58, 48),
    ],
    "coupling": [
        circle("b", 66, 62, 40),
        circle("a", 128, 62, 22),
        circle("tip", 66, 62, 2),
        circle("tip", 128, 62, 2),
        path("free", "M40 50a28 28 0 0 1 44 -10"),
        path("free", "M140 54a14 14 0 0 0 -24 0"),
        label("q₁", 58, 86),
        label("q₂", 120, 80),
    ],
}
"""Type -> elements of its sketch, later ones above earlier ones."""


def sketch(kind: str) -> str:
    """The sketch of a closure type, as the text of an SVG file."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'width="{WIDTH}" height="{HEIGHT}" role="img"><title>closure {kind}</title>'
        f"<style>{STYLE}</style><defs>{TIP}</defs>\n" + "\n".join(SKETCHES[kind]) + "\n</svg>\n"
    )


def draw(folder: Path) -> None:
    """All sketches, as ``folder/TYPE.svg``."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind in SKETCHES:
        (folder / f"{kind}.svg").write_text(sketch(kind), encoding="utf-8")


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
