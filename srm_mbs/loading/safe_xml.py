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
        # Drake's own reader takes <drake:...> without a declaration; expat does not.
        declared = _with_prefixes(text) if "unbound prefix" in str(error) else text
        if declared != text:
            return parse_urdf(declared, file)
        raise InputError(
            f"this is not well-formed XML: {error}", file=file, remedy="Correct the file there"
        ) from error
    except DefusedXmlException as error:
        raise InputError(
            f"the XML uses entities or external references: {error}",
            file=file,
            remedy="Remove them; they are refused for safety",
        ) from error


def _with_prefixes(text: str) -> str:
    """``text`` with every namespace prefix that it uses and does not declare declared."""
    root = _PROLOG.match(text)
    if root is None:
        return text
    used = set(re.findall(r"[<\s/]([A-Za-z_][\w.-]*):[A-Za-z_]", text))
    missing = used - set(re.findall(r"\sxmlns:([\w.-]+)\s*=", text)) - {"xml", "xmlns"}
    declarations = "".join(f' xmlns:{prefix}="{prefix}"' for prefix in sorted(missing))
    return text[: root.end()] + declarations + text[root.end() :]
