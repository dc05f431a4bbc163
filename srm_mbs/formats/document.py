"""A file that is being read: its text, parsed at most once in each language."""

from __future__ import annotations

from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from srm_mbs.errors import InputError
from srm_mbs.formats.files import open_regular, read_text
from srm_mbs.formats.toml.description import parse_toml
from srm_mbs.formats.xml import parse_xml, root_tag
from srm_mbs.model.lazy import cached_property


class Document:
    """Text of a file, and the results of parsing it.

    Parameters
    ----------
    text, file
        The text, and its name for messages.

    Attributes
    ----------
    toml
        The tables of a TOML text.
    xml
        The root element of an XML text; whoever translates it may change it.
    root_tag
        The tag of the root element, found without parsing; None if the text is no XML.
    notes
        Sentences about faults that were passed over in parsing.
    """

    def __init__(self, text: str, file: str) -> None:
        self.text, self.file = text, file
        self.notes: list[str] = []

    @classmethod
    def read(cls, path: Path) -> Document:
        """The document in the file ``path``.

        Raises
        ------
        InputError
            As :func:`~srm_mbs.formats.files.read_text`.
        """
        if path.suffix.lower() == ".npz":
            open_regular(path).close()
            raise InputError(
                "it is not the file of a mechanism",
                file=str(path),
                remedy="Give a saved run to srm.load_solution, or to srm-mbs plot, play or report",
            )
        return cls(read_text(path), str(path))

    @classmethod
    def of_tables(cls, tables: dict[str, Any], name: str) -> Document:
        """The document of these tables, which no file has, called ``name``; its text is empty."""
        own = cls("", name)
        own.toml = tables
        return own

    @cached_property
    def toml(self) -> dict[str, Any]:
        return parse_toml(self.text, self.file)

    @cached_property
    def xml(self) -> Element:
        return parse_xml(self.text, self.file, self.notes)

    @property
    def root_tag(self) -> str | None:
        return root_tag(self.text)


class RepeatedDocument(Document):
    """A document that is read for one variant after the other: its XML is parsed once, and copied,
    because translations change it."""

    @cached_property
    def xml(self) -> Element:
        root, notes = _parsed_once(self.text, self.file)
        self.notes += notes
        return deepcopy(root)


@lru_cache(maxsize=2)
def _parsed_once(text: str, file: str) -> tuple[Element, tuple[str, ...]]:
    notes: list[str] = []
    return parse_xml(text, file, notes), tuple(notes)
