"""A run in a notebook: the page of ``export_html`` inside the output of a cell.

Nothing here needs IPython: notebooks ask what they show for ``_repr_html_``.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from srm_mbs.anchors import Anchor
from srm_mbs.errors import InputError
from srm_mbs.overlays import Wanted
from srm_mbs.playback import page_of

if TYPE_CHECKING:
    from srm_mbs.motion import Playable


@dataclass(frozen=True)
class Embedded:
    """A page that a notebook shows where it is the value of a cell.

    It stands in the notebook itself, needs neither a server nor a network, and plays in exported
    HTML too.

    Attributes
    ----------
    page
        The page of :func:`srm_mbs.playback.export_html`.
    height
        Of the frame, pixels; it is as wide as the cell.
    """

    page: str = field(repr=False)
    height: int

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" title="animation" width="100%" '
            f'height="{self.height}" style="border: 0"></iframe>'
        )


def show(
    solution: Playable,
    *,
    height: int = 420,
    fps: float = 60.0,
    trace: Sequence[Anchor] = (),
    gaps: bool = False,
    reactions: bool = False,
    panel: bool = True,
) -> Embedded:
    """The animation of a run for a notebook: let it be the value of a cell.

    Parameters
    ----------
    solution
        The run, or a motion.
    height
        Of the frame, pixels.
    fps, trace, gaps, reactions, panel
        Those of :func:`srm_mbs.playback.export_html`.

    Raises
    ------
    InputError
        If ``height`` is not a positive whole number, or as for
        :func:`srm_mbs.playback.export_html`.
    """
    if not isinstance(height, int) or height <= 0:
        raise InputError(
            f"height = {height!r} is not a positive whole number of pixels",
            element="height",
            remedy="Give for example height=420",
        )
    page = page_of(solution, fps, Wanted(trace, gaps, reactions), panel=panel)
    return Embedded(page, height)
