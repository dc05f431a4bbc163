r"""Docstrings on the documentation site: Sphinx roles become code, since the site is Markdown.

A cross-reference, such as one to ``~srm_mbs.mechanism.Mechanism``, is shown as ``Mechanism``;
formulae as they are written.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

ROLE = re.compile(r":(?P<role>[a-z]+):`(?P<short>~?)(?P<target>[^`]+)`")


def without_roles(text: str) -> str:
    """``text`` with every role replaced by code."""

    def plain(match: re.Match[str]) -> str:
        target = match["target"]
        return f"`{target.rpartition('.')[2] if match['short'] else target}`"

    return ROLE.sub(plain, text)


class DocstringRoles(Extension):
    """Replaces the roles of every docstring that is read."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = without_roles(obj.docstring.value)
