"""The page that plays a run: meshcat's viewer with a panel of values and a bar of controls.

The files of the folder ``page`` are put together with meshcat's viewer into one that needs nothing
else.
"""

from __future__ import annotations

import base64
import html
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from srm_mbs.errors import CHECK_WRITING, InputError

log = logging.getLogger(__name__)

FOLDER = Path(__file__).with_name("page")


def make_page(
    meshcat: Any, title: str, about: dict[str, Any], commands: Sequence[dict[str, Any]] | None
) -> str:
    """One self-contained page.

    Parameters
    ----------
    meshcat
        The package.
    title
        Of the window.
    about
        What the panel and the bar show (:func:`srm_mbs.readout.read_out`).
    commands
        meshcat's commands, which the page holds and, unlike that of meshcat's own
        ``static_html``, applies in their order; None for a page that takes them from the server
        that it comes from.
    """
    root = Path(meshcat.servers.zmqserver.VIEWER_ROOT)
    parts = {
        "title": html.escape(title),
        "viewer": (root / "main.min.js").read_text(encoding="utf-8"),
        "commands": json.dumps(None if commands is None else _packed(commands)),
        # Names are the user's: they must not end the script.
        "about": as_json(about).replace("<", "\\u003c"),
        "script": (FOLDER / "page.js").read_text(encoding="utf-8"),
    }
    return filled("page.html", parts)


def filled(template: str, parts: Mapping[str, str]) -> str:
    """A file of the folder ``page`` with each mark ``@name@`` replaced by what it stands for.

    Parameters
    ----------
    template
        Name of the file.
    parts
        What is put in, in the order of the marks.
    """
    page = (FOLDER / template).read_text(encoding="utf-8")
    # The last first: what is put in may itself hold marks.
    for name in reversed(list(parts)):
        before, after = page.split(f"@{name}@", 1)
        page = before + parts[name] + after
    return page


def as_json(about: dict[str, Any]) -> str:
    """``about`` of :func:`make_page` as text."""
    return json.dumps(about, allow_nan=False)


def _packed(commands: Sequence[dict[str, Any]]) -> list[str]:
    import umsgpack  # type: ignore[import-untyped]

    packed = []
    for command in commands:
        # Animations are played in single precision anyway, and are most of the file.
        precision = "single" if command["type"] == "set_animation" else "double"
        content = umsgpack.packb(command, force_float_precision=precision)
        packed.append(base64.b64encode(content).decode("ascii"))
    return packed


def write_page(page: str, path: Path) -> None:
    """Write a page to ``path``; an existing file is replaced.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"the page cannot be written: {error.strerror}", file=str(path), remedy=CHECK_WRITING
        ) from error
    log.info("written: %s", path)
