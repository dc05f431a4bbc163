r"""Docstrings on the documentation site, which is Markdown: roles and shapes in its language.

A cross-reference, such as one to ``~srm_mbs.dynamics.mechanism.Mechanism``, becomes a link where
the site has that name, and code elsewhere; formulae become code.  Parameters described together,
each with its own shape, are listed by all of their names.
"""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

ROLE = re.compile(r":(?P<role>[a-z]+):`(?P<short>~?)(?P<target>[^`]+)`")
TOGETHER = re.compile(
    r"^(?P<indent> *)(?P<a>\w+) : (?P<shape_a>\([^)]*\)), (?P<b>\w+) : (?P<shape_b>.*)$", re.M
)


def without_roles(text: str) -> str:
    """``text`` with every role replaced by a link or by code."""

    def plain(match: re.Match[str]) -> str:
        target = match["target"]
        shown = f"`{target.rpartition('.')[2] if match['short'] else target}`"
        if match["role"] == "math":
            return shown
        return f'<autoref optional identifier="{target}">{shown}</autoref>'

    return ROLE.sub(plain, text)


def listed_together(text: str) -> str:
    """``a : (n,), b : (m,)`` as ``a, b : (n,), (m,)``, which is numpy's style."""
    return TOGETHER.sub(r"\g<indent>\g<a>, \g<b> : \g<shape_a>, \g<shape_b>", text)


class DocstringRoles(Extension):
    """Translates every docstring that is read."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = listed_together(without_roles(obj.docstring.value))
