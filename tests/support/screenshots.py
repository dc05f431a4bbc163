"""Reference pictures of runs; ``python -m tests.support.screenshots`` makes them again."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import srm_mbs as srm
from srm_mbs.visualization.animation.overlays import ViewOptions
from srm_mbs.visualization.animation.video import BARE, browser, photographer

FOLDER = Path(__file__).parents[1] / "data" / "screenshots"
SIZE = (330, 220)
BLUR = 2.0
"""Pixels: wider than what drivers of graphics cards and their antialiasing differ by."""
FOREGROUND = 0.1
"""Least difference of a pixel of a body from the background of its row."""
SLACK = 2
"""Pixels that an outline may lie beside the other."""
ALIKE = 0.16
"""Largest difference of two blurred pictures, of 1 from black to white: half a pixel makes 0.13,
the thinnest body that is missing 0.19."""
COVERED = 0.985
"""Part of each silhouette that lies within the other one."""


@cache
def slider_crank() -> srm.Solution:
    return srm.simulate(srm.load("slider_crank"), 3.0)


@dataclass(frozen=True)
class Shot:
    """A model (bars instead of its visuals if ``bare``), a time (s), and what is drawn."""

    model: str
    t: float | None
    drawn: tuple[str, ...] = ()
    bare: bool = False

    def run(self) -> srm.Solution:
        """The run that is photographed."""
        if self.model == "slider_crank" and not self.bare:
            return slider_crank()
        mechanism = srm.load(self.model)
        if self.bare:
            mechanism = srm.Mechanism(
                mechanism.model, mechanism.loops, mechanism.q0, mechanism.v0, name=self.model
            )
        return srm.simulate(mechanism, 1.0)

    def time(self, solution: srm.Solution) -> float:
        """The time, by default that of the first passage."""
        return solution.crossings[0].time if self.t is None else self.t


SHOTS = {
    "slider_crank_start": Shot("slider_crank", 0.0),
    "slider_crank_vertical": Shot("slider_crank", None),
    "slider_crank_behind": Shot("slider_crank", 2.0),
    "stewart_platform": Shot("stewart_platform", 0.75),
    "delta_robot_reactions": Shot("delta_robot", 0.5, ("reactions",)),
    "spatial_four_bar_bars": Shot("spatial_four_bar", 0.5, bare=True),
}


def taken(shot: Shot, chromium: Any) -> bytes:
    """The PNG of a shot."""
    solution = shot.run()
    view = ViewOptions(**dict.fromkeys(shot.drawn, True))
    # Fonts differ from machine to machine.
    style = f"{BARE} #panel {{ display: none; }}"
    t = shot.time(solution)
    with photographer(solution, SIZE, 60.0, view, [t], chromium, style) as photograph:
        return photograph(t)


def pixels(png: bytes) -> Any:
    """Red, green and blue (height, width, 3), 0 to 1."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")) / 255.0


def blurred(image: Any) -> Any:
    """``image`` as somebody sees it who is short-sighted."""
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(image, (BLUR, BLUR, 0.0), mode="nearest")


def silhouette(image: Any) -> Any:
    """Where there are bodies (height, width): not the colour of the left edge of the row."""
    background = np.median(image[:, :4], axis=1)[:, None]
    return np.abs(image - background).max(axis=2) > FOREGROUND


def covered(one: Any, other: Any) -> float:
    """Part of a silhouette that lies within another one, or SLACK beside it."""
    from scipy.ndimage import binary_dilation

    around = binary_dilation(other, np.ones((3, 3)), iterations=SLACK)
    return float((one & around).sum() / max(int(one.sum()), 1))


def differences(one: Any, other: Any) -> Iterator[str]:
    """In what two pictures are unlike, beyond what drivers, antialiasing and rounding do."""
    apart = float(np.abs(blurred(one) - blurred(other)).max())
    if apart > ALIKE:
        yield f"blurred, they differ by {apart:.2f}"
    shapes = silhouette(one), silhouette(other)
    for a, b in (shapes, shapes[::-1]):
        part = covered(a, b)
        if part < COVERED:
            yield f"only {part:.1%} of a silhouette is in the other one"


def main() -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    with browser() as chromium:
        for name, shot in SHOTS.items():
            (FOLDER / f"{name}.png").write_bytes(taken(shot, chromium))


if __name__ == "__main__":
    main()
