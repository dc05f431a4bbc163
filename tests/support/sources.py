"""The modules of the package as their sources have them."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import srm_mbs as srm

PACKAGE = Path(srm.__file__).parent
MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
"""Path of each module, by its name within the package."""


@cache
def syntax_tree(module: str) -> ast.Module:
    """The parsed source of ``module``, once for all tests of a process that read it."""
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))
