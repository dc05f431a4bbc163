"""The table of formats: how each is recognised by its content, and the function that translates it.

A new format is one more entry of :data:`FORMATS` and a function
``translate(document, options) -> Translation``.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from srm_mbs.errors import InputError, known_names
from srm_mbs.formats import gepetto
from srm_mbs.formats.document import Document
from srm_mbs.formats.files import shortened
from srm_mbs.formats.mjcf import reader as mjcf
from srm_mbs.formats.planar import reader as planar
from srm_mbs.formats.sdf import reader as sdf
from srm_mbs.formats.translation import PLANAR, Options, Translation
from srm_mbs.formats.urdf import loops

Translate = Callable[[Document, Options], Translation]


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
        Whether a document is of this format, by its content.
    translate
        Document and options to a translation; raises InputError.
    key
        Of a description that names such a file; empty if none does.
    """

    name: str
    suffixes: tuple[str, ...]
    recognises: Callable[[Document], bool]
    translate: Translate
    key: str = ""


def _rooted(tag: str) -> Callable[[Document], bool]:
    """Whether the root element is ``tag``, in any namespace."""
    return lambda document: (document.root_tag or "").rsplit(":", 1)[-1] == tag


def _is_description(document: Document) -> bool:
    if not re.search(r"^[ \t]*+format[ \t]*+=", document.text, re.MULTILINE):
        return False
    try:
        return "format" in document.toml
    except InputError:
        return False


def _refuse_description(document: Document, options: Options) -> Translation:
    raise InputError(
        "a description cannot be the model file of another",
        file=document.file,
        remedy="Give the description itself to srm.load",
    )


DESCRIPTION = Format("TOML description", (".toml",), _is_description, _refuse_description)
LINKAGE = Format("planar linkage", (), lambda document: False, planar.translate, key=PLANAR)
"""The section of a description that holds links and joints itself."""
FORMATS: tuple[Format, ...] = (
    DESCRIPTION,
    Format("URDF", (".urdf",), _rooted("robot"), loops.translate, key="urdf"),
    Format("SDF", (".sdf", ".world"), _rooted("sdf"), sdf.translate, key="sdf"),
    Format("MJCF", (".mjcf",), _rooted("mujoco"), mjcf.translate, key="mjcf"),
    Format("Gepetto YAML", (".yaml", ".yml"), gepetto.recognises, gepetto.translate),
)


def _by_content(document: Document) -> Format | None:
    return next((known for known in FORMATS if known.recognises(document)), None)


def find_format(path: Path, document: Document) -> Format:
    """The format of a file: by its content or, failing that, its suffix.

    Raises
    ------
    InputError
        If it is none that is read.
    """
    by_suffix = (known for known in FORMATS if path.suffix.lower() in known.suffixes)
    found = _by_content(document) or next(by_suffix, None)
    if found is not None:
        return found
    tag = document.root_tag
    suffix = shortened(path.suffix)
    what = f"a file of type {suffix!r}" if document.text.strip() else "an empty file"
    if tag:
        what = f"a file with the root element <{shortened(tag)}>"
    raise InputError(
        f"{what} is not of a format that is read",
        file=str(path),
        remedy=known_names(known.name for known in FORMATS),
    )


def of_key(key: str, path: Path, document: Document) -> Format:
    """The format of the file that a description names under ``key``.

    Raises
    ------
    InputError
        If the file is of another format.
    """
    wanted = next(known for known in FORMATS if known.key == key)
    if wanted.recognises(document):
        return wanted
    other, tag, remedy = _by_content(document), document.root_tag, f"Give a {wanted.name}"
    if other is not None:
        raise InputError(
            f"{path.name!r} is a {other.name}, not a {wanted.name}",
            element=key,
            remedy=f'Write {other.key} = "{path.name}"' if other.key else remedy,
        )
    if tag is not None and key != "urdf":  # the URDF reader names the fault
        raise InputError(
            f"the root element of {path.name!r} is <{shortened(tag)}>: it is not a {wanted.name}",
            element=key,
            remedy=remedy,
        )
    return wanted
