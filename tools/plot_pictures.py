"""Pictures of runs for ``docs/plots.md``.

    python -m tools.plot_pictures [DIR]

Run from a checkout with the test requirements; writes into ``docs/plots``, or DIR.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import srm_mbs as srm
from benchmarks.thesis.drawing import save

FOLDER = Path(__file__).parents[1] / "docs" / "plots"
PICTURES: dict[str, tuple[str, float, dict[str, Any]]] = {
    "path": ("watt_six_bar", 3.0, {}),
    "reactions": ("n_four_bar_2", 5.0, {}),
    "poses": (
        "four_bar",
        1.2,
        {
            **{"at": [0, 60, 120], "crank": "crank", "unit": "mm"},
            **{"points": [srm.Anchor("coupler", xyz=(1.0, 0.0, 0.6))], "size": (5.0, 4.2)},
        },
    ),
    "sigma": ("slider_crank", 10.0, {}),
}
"""Kind of picture -> mechanism, end of its run (s), options."""


def draw(folder: Path) -> None:
    """All pictures, as ``folder/KIND.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind, (name, t_end, options) in PICTURES.items():
        solution = srm.simulate(srm.load(name), t_end)
        save(solution.plot(kind=kind, **options), folder / f"{kind}.png")


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
