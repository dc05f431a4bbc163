"""Pieces of HTML.  Texts are escaped here, and only here: names in them are the user's."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence


def text(value: object) -> str:
    """``value`` as text."""
    return html.escape(str(value))


def paragraph(words: object, kind: str = "") -> str:
    """A paragraph of the class ``kind``."""
    return f"<p{_class(kind)}>{text(words)}</p>"


def table(
    rows: Iterable[Sequence[object]],
    header: Sequence[str] = (),
    *,
    caption: str = "",
    numbers: Iterable[int] = (),
) -> str:
    """A table in a box that scrolls where it is too wide; empty without rows.

    Parameters
    ----------
    rows
        Cells; the first of each row is its heading.
    header
        Headings of the columns.
    caption
        One sentence above it.
    numbers
        Columns that are set to the right.
    """
    right = set(numbers)
    body = []
    for row in rows:
        cells = [f'<th scope="row">{text(row[0])}</th>']
        cells += [
            f"<td{_class('number' * (k in right))}>{text(cell)}</td>"
            for k, cell in enumerate(row[1:], start=1)
        ]
        body.append(f"<tr>{''.join(cells)}</tr>")
    if not body:
        return ""
    head = "".join(
        f'<th scope="col"{_class("number" * (k in right))}>{text(name)}</th>'
        for k, name in enumerate(header)
    )
    parts = [f"<caption>{text(caption)}</caption>" if caption else ""]
    parts += [
        f"<thead><tr>{head}</tr></thead>" if header else "",
        f"<tbody>{''.join(body)}</tbody>",
    ]
    label = f' role="region" aria-label="{text(caption or "table")}" tabindex="0"'
    return f'<div class="wide"{label}><table>{"".join(parts)}</table></div>'


def section(name: str, title: str, lead: str, *content: str) -> str:
    """A section with a heading, a sentence that says what it is about, and its content."""
    inner = "\n".join(part for part in content if part)
    heading = f'<h2 id="{text(name)}-title">{text(title)}</h2>'
    return (
        f'<section id="{text(name)}" aria-labelledby="{text(name)}-title">{heading}\n'
        f"{paragraph(lead, 'lead')}\n{inner}\n</section>"
    )


def subsection(title: str, *content: str) -> str:
    """A heading of the third rank with its content; empty where that is."""
    inner = "\n".join(part for part in content if part)
    return f"<h3>{text(title)}</h3>\n{inner}" if inner else ""


def picture(data: bytes, kind: str, description: str, caption: str) -> str:
    """A picture within the page.

    Parameters
    ----------
    data
        The file.
    kind
        Its media type, such as ``image/png``.
    description
        What is on it, for who does not see it.
    caption
        What is below it.
    """
    source = f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
    return (
        f'<figure><img src="{source}" alt="{text(description)}">'
        f"<figcaption>{text(caption)}</figcaption></figure>"
    )


def _class(kind: str) -> str:
    return f' class="{text(kind)}"' if kind else ""
