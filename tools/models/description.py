"""Pieces of mechanism descriptions (TOML)."""

from __future__ import annotations

from textwrap import fill

from tools.models.urdf_text import Vector


def header(name: str, text: str, gravity: str = "[0.0, 0.0, -9.81]") -> str:
    """First lines of a description; ``text`` becomes its comment."""
    comment = fill(text, 99, initial_indent="# ", subsequent_indent="# ")
    return (
        f'{comment}\n# Written by tools.models.\nformat = 1\nname = "{name}"\n'
        f'urdf = "../urdf/{name}.urdf"\nbase = "fixed"\ngravity = {gravity}\n'
    )


def toml(values: Vector) -> str:
    """A list of numbers."""
    return "[" + ", ".join(f"{float(v) + 0.0:.17g}" for v in values) + "]"


def point(name: str, a: str, at_a: Vector, b: str, at_b: Vector) -> str:
    return (
        f'[[loop]]\nname = "{name}"\ntype = "point"\n'
        f'a = {{ link = "{a}", xyz = {toml(at_a)} }}\nb = {{ link = "{b}", xyz = {toml(at_b)} }}\n'
    )


def join(*parts: str) -> str:
    return "\n\n".join(part.strip() for part in parts) + "\n"
