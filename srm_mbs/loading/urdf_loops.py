"""Loops inside a URDF: taken out of it and written as closures."""

from __future__ import annotations

from srm_mbs.loading.translation import Options, Translation


def translate(text: str, file: str, options: Options) -> Translation:
    """The URDF ``text`` without its loops, and these as entries of a description."""
    return Translation(text)
