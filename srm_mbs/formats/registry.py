"""The table of formats: how each is recognised by its content, and who translates it.

A new format is one more entry of :data:`FORMATS` and a function
``translate(text, file, options) -> Translation``.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from srm_mbs.errors import InputError
from srm_mbs.formats import gepetto
from srm_mbs.formats.mjcf import reader as mjcf
from srm_mbs.formats.sdf import reader as sdf
from srm_mbs.formats.translation import Options, Translation
from srm_mbs.formats.urdf import loops
from srm_mbs.formats.xml import root_tag

Translate = Callable[[str, str, Options], Translation]


@dataclass(frozen=True)
class Format:
    """One format of mechanism files.

    Attributes
    ----------
    name
        For messages.
    suffixes
        Of its files; they decide only where the content does not.
    recognises
        Whether a file (path, text) is of this format, by its content.
    translate
        Text, file name for messages, and options to a translation; raises InputError.
    key
        Of a description that names such a file; empty if none does.
    """

    name: str
    suffixes: tuple[str, ...]
    recognises: Callable[[Path, str], bool]
    translate: Translate
    key: str = ""


def _rooted(tag: str) -> Callable[[Path, str], bool]:
    """Whether the root element is ``tag``, in any namespace."""
    return lambda _, text: (root_tag(text) or "").rsplit(":", 1)[-1] == tag


def _is_description(_: Path, text: str) -> bool:
    if not re.search(r"^\s*format\s*=", text, re.MULTILINE):
        return False
    try:
        return "format" in tomllib.loads(text)
    except (ValueError, RecursionError):
        return False


def _own_words(text: str, file: str, options: Options) -> Translation:
    raise InputError(
        "a description cannot stand for a model file",
        file=file,
        remedy="Give the description itself to srm.load",
    )


DESCRIPTION = Format("TOML description", (".toml",), _is_description, _own_words)
FORMATS: tuple[Format, ...] = (
    DESCRIPTION,
    Format("URDF", (".urdf",), _rooted("robot"), loops.translate, key="urdf"),
    Format("SDF", (".sdf", ".world"), _rooted("sdf"), sdf.translate, key="sdf"),
    Format("MJCF", (".mjcf",), _rooted("mujoco"), mjcf.translate, key="mjcf"),
    Format("Gepetto YAML", (".yaml", ".yml"), gepetto.recognises, gepetto.translate),
)


def find_format(path: Path, text: str) -> Format:
    """The format of a file: by its content or, failing that, its suffix.

    Raises
    ------
    InputError
        If it is none that is read.
    """
    for found in FORMATS:
        if found.recognises(path, text):
            return found
    for found in FORMATS:
        if path.suffix.lower() in found.suffixes:
            return found
    tag = root_tag(text)
    what = f"a file with the root element <{tag}>" if tag else f"a file of type {path.suffix!r}"
    raise InputError(
        f"{what} is not of a format that is read",
        file=str(path),
        remedy=f"Known: {', '.join(known.name for known in FORMATS)}",
    )


def of_key(key: str, path: Path, text: str) -> Format:
    """The format of the file that a description names under ``key``.

    Raises
    ------
    InputError
        If this version does not read that format, or the file is of another one.
    """
    wanted = next((known for known in FORMATS if known.key == key), None)
    if wanted is None:
        raise InputError(
            f"files of this format ({key}) are not read by this version",
            element=key,
            remedy="Convert the file to one of the formats in docs/formats.md",
        )
    tag = root_tag(text)
    if not wanted.recognises(path, text):
        other = next((known for known in FORMATS if known.recognises(path, text)), None)
        if other is not None:
            raise InputError(
                f"{path.name!r} is a {other.name}, not a {wanted.name}",
                element=key,
                remedy=f'Write {other.key} = "{path.name}"'
                if other.key
                else f"Give a {wanted.name}",
            )
        if tag is not None and wanted.key != "urdf":
            raise InputError(
                f"the root element of {path.name!r} is <{tag}>: it is not a {wanted.name}",
                element=key,
                remedy=f"Give a {wanted.name}",
            )
    return wanted
