"""What is looked at from the command line: pages, pictures, films, and the command ``play``."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import srm_mbs
from srm_mbs.cli.output import BAD_INPUT, Run, check_output, reported, write_files
from srm_mbs.errors import InputError

if TYPE_CHECKING:
    from srm_mbs.api import Solution
    from srm_mbs.dynamics.mechanism import Mechanism
    from srm_mbs.visualization.animation.live import LiveView

Image = Annotated[
    Path | None,
    typer.Option(metavar="FILE.png", help="Write a picture of the run at the time --at."),
]
At = Annotated[
    float | None,
    typer.Option(
        "--at", metavar="S", help="Time of the picture in the run (s).", show_default="the end"
    ),
]
Video = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Write a film of the run as .gif or .mp4."),
]
Trace = Annotated[
    list[str] | None,
    typer.Option(
        "--trace",
        metavar="LINK:X,Y,Z",
        help="Draw the path of a point of a link (m, in the link's frame). May be given several "
        "times.",
    ),
]
Gaps = Annotated[bool, typer.Option("--gaps", help="Draw the gaps of the closures, exaggerated.")]
Live = Annotated[
    bool,
    typer.Option("--live", help="Show the run in the browser while it is computed, then play it."),
]
Reactions = Annotated[
    bool, typer.Option("--reactions", help="Colour the closures by the force in them.")
]


def check_pictures(image: Path | None, at: float | None, video: Path | None) -> None:
    """Refuse files that could not be written after the run.

    Raises
    ------
    InputError
        If one cannot be, its encoder is missing, or there is a time and no picture.
    """
    from srm_mbs.visualization.animation.video import FILMS, encoder_of

    if image is not None:
        check_output(image, "--image", (".png",))
    elif at is not None:
        raise InputError(
            "it is the time of a picture, and none is asked for",
            element="--at",
            remedy="Give --image FILE.png too",
        )
    if video is not None:
        check_output(video, "--video", FILMS)
        encoder_of(video)


def check_time(at: float | None, t_end: float, start: float = 0.0) -> None:
    """Refuse a picture of a time (s) that a run from ``start`` to ``t_end`` (s) does not have.

    Raises
    ------
    InputError
        If it has not.
    """
    if at is not None and not (start <= at <= t_end or t_end <= start):
        raise InputError(
            f"{at:g} s lies outside the run, from {start:g} to {t_end:g} s",
            element="--at",
            remedy="Give a time of the run",
        )


def check_overlays(
    trace: list[str] | None, gaps: bool, reactions: bool, seen: Iterable[object]
) -> None:
    """Refuse what would be drawn where nothing is: none of the options ``seen`` is given.

    Raises
    ------
    InputError
        If so.
    """
    if any(seen):
        return
    for option, given in {"--trace": trace, "--gaps": gaps, "--reactions": reactions}.items():
        if given:
            raise InputError(
                "it is drawn in the animation, and none is asked for",
                element=option,
                remedy="Give --html, --image, --video, --play or --live too",
            )


def drawn(
    mechanism: Mechanism, trace: list[str] | None, gaps: bool, reactions: bool
) -> dict[str, Any]:
    """The options of playback, checked before a long run.

    Raises
    ------
    InputError
        If a trace is none, its point is not there or does not move, or no closure has reactions.
    """
    from srm_mbs.visualization.animation.overlays import OverlayOptions

    anchors = given_points(trace or [], "--trace")
    OverlayOptions(anchors, gaps, reactions).check(mechanism)
    return {"trace": anchors, "gaps": gaps, "reactions": reactions}


def given_points(texts: list[str], option: str) -> list[srm_mbs.Anchor]:
    """The points LINK:X,Y,Z that were given to ``option``.

    Raises
    ------
    InputError
        If one is none.
    """
    found = []
    for text in texts:
        link, colon, numbers = text.rpartition(":")
        try:
            x, y, z = (float(number) for number in numbers.split(","))
        except ValueError:
            colon = ""
        else:
            colon = colon if math.isfinite(x + y + z) else ""
        if not colon:
            raise InputError(
                f"{text!r} is not a point of a link",
                element=option,
                remedy="Write LINK:X,Y,Z, for example rod:0.5,0,0",
            )
        found.append(srm_mbs.Anchor(link, xyz=(x, y, z)))
    return found


@reported()
def play(
    run: Run,
    image: Image = None,
    at: At = None,
    video: Video = None,
    trace: Trace = None,
    gaps: Gaps = False,
    reactions: Reactions = False,
) -> None:
    """Play a saved run in the browser.

    With --image or --video, write these instead.
    """
    check_pictures(image, at, video)
    solution = srm_mbs.load_solution(run)
    check_time(at, solution.span[1], solution.span[0])
    options = drawn(solution.mechanism, trace, gaps, reactions)
    if image is None and video is None:
        play_run(solution, options)
        return
    written, failed = write_files(
        [
            (image, partial(solution.export_image, t=at, **options)),
            (video, partial(solution.export_video, **options)),
        ]
    )
    for path in written:
        typer.echo(f"written: {path}")
    if failed:
        raise typer.Exit(BAD_INPUT)


def live_view(mechanism: Mechanism) -> LiveView:
    """The page of a run that is about to be computed."""
    from srm_mbs.visualization.animation.live import LiveView

    _tell_address()
    return LiveView(mechanism)


def play_run(solution: Solution, options: dict[str, Any], view: LiveView | None = None) -> None:
    """Play a run until Ctrl-C, in its live view if it has one."""
    _tell_address()
    typer.echo("Ctrl-C ends the playback.", err=True)
    with suppress(KeyboardInterrupt):  # while the page is being made; later, play() takes it
        if view is None:
            solution.play(**options)
        else:
            with view:
                view.play(solution, **options)
                view.wait()


def _tell_address() -> None:
    # Its messages are few, and one of them is the address of the page.
    logging.getLogger("srm_mbs.visualization.animation.playback").setLevel(logging.INFO)
