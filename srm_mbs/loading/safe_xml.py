"""XML of unknown origin: read without entities or external references."""

from __future__ import annotations

from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml import ElementTree as SafeTree

from srm_mbs.errors import InputError


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
