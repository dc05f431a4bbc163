"""Options of animations, images and videos, and the command ``play``."""

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
from srm_mbs.cli.output import (
    BAD_INPUT,
    HTML_SUFFIXES,
    AllowOutside,
    Html,
    Run,
    check_output,
    echo,
    option,
    reported,
    say_written,
    several,
    write_files,
)
from srm_mbs.errors import InputError

if TYPE_CHECKING:
    from srm_mbs.api import Solution
    from srm_mbs.dynamics.mechanism import Mechanism
    from srm_mbs.visualization.animation.live import LiveView

POINT = "LINK:X,Y,Z"
NAMED_POINT = f"NAME|{POINT}"
"""Form of a point of a link; coordinates in m, in the link's frame."""
Image = Annotated[Path | None, option("FILE.png", "Write a picture of the run at the time --at.")]
At = Annotated[
    float | None, option("S", "Time of the picture in the run (s).", show_default="the end")
]
Size = Annotated[
    str | None,
    option(
        "column|page|W,H",
        "Size of the picture of --image: that of a journal's column or page, or width and height "
        "in pixels, with --dpi in inches.",
        show_default="900,600",
    ),
]
Dpi = Annotated[
    float | None,
    option("N", "Dots per inch of the picture of --image.", show_default="300 for column and page"),
]
Video = Annotated[
    Path | None,
    option("FILE", "Write a film of the run as .gif or .mp4, or its pictures into this folder."),
]
Trace = Annotated[
    list[str] | None,
    several("--trace", POINT, "Draw the path of a point of a link (m, in the link's frame)."),
]
Gaps = Annotated[bool, typer.Option("--gaps", help="Draw the gaps of the closures, exaggerated.")]
Live = Annotated[
    bool,
    typer.Option("--live", help="Show the run in the browser while it is computed, then play it."),
]
Reactions = Annotated[
    bool, typer.Option("--reactions", help="Colour the closures by the force in them.")
]

Arrows = Annotated[
    bool,
    typer.Option(
        "--arrows", help="Draw the forces in joints and closures, of drives and force elements."
    ),
]


def image_options(
    image: Path | None, at: float | None, size: str | None, dpi: float | None
) -> dict[str, Any]:
    """The time and size of an image as options of ``export_image``, checked before the run.

    Raises
    ------
    InputError
        If the file cannot be written, the size is not valid, or one is given without an image.
    """
    from srm_mbs.visualization.animation.video import image_pixels

    check_output(image, "--image", (".png",))
    for name, given in (("--at", at), ("--size", size), ("--dpi", dpi)):
        if image is None and given is not None:
            raise InputError(
                "it is about a picture, and none is asked for",
                element=name,
                remedy="Give --image FILE.png too",
            )
    options: dict[str, Any] = {"t": at, "dpi": dpi}
    if size is not None:
        # Matplotlib, which this imports, is slow to import.
        from srm_mbs.visualization.plotting.print_size import WIDTHS

        options["size"] = size
        if size not in WIDTHS:
            try:
                numbers = tuple(float(number) for number in size.split(","))
            except ValueError:
                raise InputError(
                    f"{size!r} is not a size", element="--size", remedy="Write 900,600 or column"
                ) from None
            whole = dpi is None and all(number.is_integer() for number in numbers)
            options["size"] = tuple(int(number) for number in numbers) if whole else numbers
    elif dpi is not None:
        raise InputError(
            "the size in inches is missing",
            element="--dpi",
            remedy="Give --size too, for example --size 3.5,2.5",
        )
    if size is not None:
        image_pixels(options["size"], dpi)
    return options


def check_video(video: Path | None) -> None:
    """Refuse a video file that cannot be written, before the run.

    Raises
    ------
    InputError
        If it cannot be written, or its encoder is missing.
    """
    from srm_mbs.visualization.animation.video import (
        FILMS,
        check_frames_folder,
        encoder_of,
    )

    if video is not None and not video.suffix:
        check_frames_folder(video, "--video")
    elif video is not None:
        check_output(video, "--video", FILMS)
        encoder_of(video)


def check_time(at: float | None, t_end: float, start: float = 0.0) -> None:
    """Refuse the time ``at`` (s) of an image outside a run from ``start`` to ``t_end`` (s).

    Raises
    ------
    InputError
        If it lies outside.
    """
    from srm_mbs.integration.dense_output import checked_time

    if at is not None and start < t_end:
        checked_time(at, start, t_end, "--at")


def check_overlays(
    trace: list[str] | None,
    gaps: bool,
    reactions: bool,
    arrows: bool,
    animations: Iterable[object],
) -> None:
    """Refuse overlays without an animation.

    Parameters
    ----------
    trace, gaps, reactions, arrows
        Options of overlays.
    animations
        Options that ask for an animation, image or video.

    Raises
    ------
    InputError
        If an overlay is requested, and none of ``animations``.
    """
    if any(animations):
        return
    overlays = {
        "--trace": trace,
        "--gaps": gaps,
        "--reactions": reactions,
        "--arrows": arrows,
    }
    for name, given in overlays.items():
        if given:
            raise InputError(
                "it is drawn in the animation, and none is asked for",
                element=name,
                remedy="Give --html, --image, --video, --play or --live too",
            )


def overlay_options(
    mechanism: Mechanism, trace: list[str] | None, gaps: bool, reactions: bool, arrows: bool
) -> dict[str, Any]:
    """The overlays as options of playback, checked before a long run.

    Raises
    ------
    InputError
        If a trace is malformed, its point does not exist or does not move, or no closure has
        reactions.
    """
    from srm_mbs.visualization.animation.overlays import ViewOptions

    anchors = given_points(trace or [], "--trace")
    ViewOptions(anchors, gaps, reactions, arrows).check(mechanism)
    return {"trace": anchors, "gaps": gaps, "reactions": reactions, "arrows": arrows}


def points_or_names(texts: list[str] | None) -> list[srm_mbs.Anchor | str]:
    """The points LINK:X,Y,Z of ``--point``, and the names of points of the mechanism, which have
    no colon.

    Raises
    ------
    InputError
        If one is malformed.
    """
    return [given_points([text], "--point")[0] if ":" in text else text for text in texts or []]


def given_points(texts: list[str], element: str) -> list[srm_mbs.Anchor]:
    """The points LINK:X,Y,Z of the argument ``element``.

    Raises
    ------
    InputError
        If one is malformed.
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
                element=element,
                remedy="Write LINK:X,Y,Z, for example rod:0.5,0,0",
            )
        found.append(srm_mbs.Anchor(link, xyz=(x, y, z)))
    return found


@reported
def play(
    run: Run,
    html: Html = None,
    image: Image = None,
    at: At = None,
    size: Size = None,
    dpi: Dpi = None,
    video: Video = None,
    trace: Trace = None,
    gaps: Gaps = False,
    reactions: Reactions = False,
    arrows: Arrows = False,
    allow_outside: AllowOutside = False,
) -> None:
    """Play a saved run in the browser.

    With --html, --image or --video, write these instead.
    """
    check_output(html, "--html", HTML_SUFFIXES)
    picture = image_options(image, at, size, dpi)
    check_video(video)
    solution = srm_mbs.load_solution(run, allow_outside=allow_outside)
    check_time(at, solution.span[1], solution.span[0])
    options = overlay_options(solution.mechanism, trace, gaps, reactions, arrows)
    if html is None and image is None and video is None:
        play_run(solution, options)
        return
    written, failed = write_files(
        [
            (html, partial(solution.export_html, **options)),
            (image, partial(solution.export_image, **picture, **options)),
            (video, partial(solution.export_video, progress=True, **options)),
        ]
    )
    for path in written:
        say_written(path)
    if failed:
        raise typer.Exit(BAD_INPUT)


def live_view(mechanism: Mechanism) -> LiveView:
    """The live view of a run that is going to be computed."""
    from srm_mbs.visualization.animation.live import LiveView

    _log_address()
    return LiveView(mechanism)


def play_run(solution: Solution, options: dict[str, Any], view: LiveView | None = None) -> None:
    """Play a run until Ctrl-C, in its live view if it has one."""
    _log_address()
    echo("Ctrl-C ends the playback.", err=True)
    with suppress(KeyboardInterrupt):  # while the page is made; later play() handles it
        if view is None:
            solution.play(**options)
        else:
            with view:
                view.play(solution, **options)
                view.wait()


def _log_address() -> None:
    # One of its few messages is the address of the page.
    logging.getLogger("srm_mbs.visualization.animation.playback").setLevel(logging.INFO)
