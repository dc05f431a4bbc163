"""Pages in a real browser."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def opened(browser: Any, address: str) -> Iterator[Any]:
    """The loaded page; whatever it complains about, or asks the network for, is an error."""
    context = browser.new_context(viewport={"width": 900, "height": 600})
    page = context.new_page()
    complaints: list[str] = []

    def complain(kind: str, text: str, location: dict[str, Any]) -> None:
        if kind == "error" and not location["url"].endswith("favicon.ico"):  # meshcat serves none
            complaints.append(text)

    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda message: complain(message.type, message.text, message.location))
    allowed = ("file:", "data:", "blob:", address)
    page.on(
        "request",
        lambda request: request.url.startswith(allowed) or complaints.append(request.url),
    )
    if address.startswith("file:"):
        context.set_offline(True)
    page.goto(address)
    page.wait_for_function("viewer.scene_tree.children.mechanism !== undefined")
    yield page
    context.close()
    assert complaints == []
