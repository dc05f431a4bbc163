"""XML of unknown origin: read without entities or external references."""

from __future__ import annotations

import re
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml import ElementTree as SafeTree

from srm_mbs.errors import InputError

_PROLOG = re.compile(
    r"(?:\s+|<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^\[>]*(?:\[[^\]]*\])?[^>]*>)*<([^\s/><!?]+)", re.DOTALL
)


def root_tag(text: str) -> str | None:
    """Name of the root element, prefix included; None if ``text`` does not look like XML."""
    match = _PROLOG.match(text.lstrip("\ufeff"))
    return match[1] if match else None


def parse_urdf(text: str, file: str) -> Element:
    """Root element of ``text``.

    Raises
    ------
    InputError
        If it is not well-formed XML, or uses entities or external references.
    """
    try:
        return SafeTree.fromstring(text)  # type: ignore[no-any-return]
    except ParseError as error:
        hint = "Correct the file there"
        if "unbound prefix" in str(error):
            hint = "An element with a namespace prefix, such as <drake:...>, is not read"
        raise InputError(f"this is not well-formed XML: {error}", file=file, remedy=hint) from error
    except DefusedXmlException as error:
        raise InputError(
            f"the XML uses entities or external references: {error}",
            file=file,
            remedy="Remove them; they are refused for safety",
        ) from error
