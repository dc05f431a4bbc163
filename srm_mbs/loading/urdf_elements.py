"""Elements, attributes and numbers of a URDF: the unknown is refused, the ignored is counted."""

from __future__ import annotations

import sys
from xml.etree.ElementTree import Element

from srm_mbs.errors import InputError
from srm_mbs.loading.entries import LARGEST
from srm_mbs.loading.urdf_schema import (
    ATTRIBUTES,
    DRAWN_ONLY,
    IGNORED,
    INFORMATIVE,
    LOOP_ELEMENTS,
    READ,
)
from srm_mbs.loading.xml_values import NUMBER


class ElementChecker:
    """What every check of elements and attributes needs; faults are :class:`InputError`."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.notes: list[str] = []
        self.ignored: dict[str, int] = {}

    def fault(self, element: str, problem: str, remedy: str) -> InputError:
        return InputError(problem, file=self.file, element=element, remedy=remedy)

    def numbers(self, node: Element, key: str, count: int, where: str) -> list[float]:
        """``count`` finite numbers of attribute ``key``, which is rewritten in one form."""
        text = node.get(key)
        parts = (text or "").split()
        values = [float(part) for part in parts] if all(map(NUMBER.fullmatch, parts)) else []
        # Limits do not act, and exporters write the largest double there.
        largest = sys.float_info.max if node.tag == "limit" else LARGEST
        if len(values) != count or not all(abs(value) <= largest for value in values):
            tag = node.tag.rsplit("}", 1)[-1]
            wanted = "a finite number" if count == 1 else f"{count} finite numbers in a row"
            raise self.fault(
                where,
                f"<{tag}> has no {key!r}"
                if text is None
                else f"<{tag} {key}={text!r}> is not {wanted}",
                f"Write {wanted}",
            )
        node.set(key, " ".join(map(repr, values)))
        return values

    def attributes(self, node: Element, where: str) -> None:
        known = ATTRIBUTES.get(node.tag)
        ignored = INFORMATIVE.get(node.tag, ())
        for key in list(node.attrib):
            if key in ignored:
                self.ignore(f"<{node.tag} {key}> attribute")
                del node.attrib[key]
            elif known is not None and key not in known:
                raise self.fault(
                    where,
                    f"<{node.tag}> has an unknown attribute {key!r}",
                    f"Known: {', '.join(known)}",
                )

    def ignore(self, what: str) -> None:
        self.ignored[what] = self.ignored.get(what, 0) + 1

    def ignored_notes(self) -> tuple[str, ...]:
        """What was ignored, one sentence for each kind."""
        return tuple(
            f"{count} {what}(s) do not act and are ignored" for what, count in self.ignored.items()
        )

    def children(self, node: Element, where: str) -> None:
        """Refuse unknown elements of ``node``; count and remove those that are ignored."""
        read, ignored = READ[node.tag], IGNORED.get(node.tag, ())
        for child in list(node):
            tag = child.tag
            local = tag.rsplit("}", 1)[-1].rsplit(":", 1)[-1]
            if tag in read:
                self.attributes(child, where)
                if tag not in READ and len(child):
                    raise self.fault(
                        where, f"unknown element <{child[0].tag}> in <{tag}>", "Remove it"
                    )
            elif tag in ignored:
                self.no_loop_inside(child, where)
                self.no_inertia_inside(child, where)
                if tag not in DRAWN_ONLY:
                    self.ignore(f"<{tag}> element")
                node.remove(child)
            elif "xacro" in tag.rsplit("}", 1)[0] and tag != local:
                raise self.fault(
                    f"{where}, <xacro:{local}>" if where else f"<xacro:{local}>",
                    "this is a xacro macro, not URDF",
                    "Run xacro on the file first",
                )
            elif local in LOOP_ELEMENTS or tag != local:
                raise self.fault(
                    f"{where}, <{local}>" if where else f"<{local}>",
                    f"the element <{local}> (a loop, coupling or force of another tool) is not "
                    "read by this version",
                    "Describe the loop as [[loop]] in a TOML description and remove the element",
                )
            else:
                raise self.fault(
                    where or f"<{tag}>",
                    f"unknown element <{tag}> in <{node.tag}>",
                    f"Known: {', '.join((*read, *ignored))}",
                )
        for tag in set(read) - {"link", "joint"}:
            if len(node.findall(tag)) > 1:
                raise self.fault(where, f"<{tag}> is given twice", "Keep one")

    def no_loop_inside(self, node: Element, where: str) -> None:
        """Refuse loops and couplings inside an element that is ignored as a whole."""
        for inner in node.iter():
            if inner.tag in (*LOOP_ELEMENTS, "mimic"):
                raise self.fault(
                    ", ".join(part for part in (where, f"<{node.tag}>, <{inner.tag}>") if part),
                    f"the element <{inner.tag}> (a loop or coupling) inside <{node.tag}> is not "
                    "read by this version",
                    "Describe the loop as [[loop]] in a TOML description and remove the element",
                )

    def no_inertia_inside(self, node: Element, where: str) -> None:
        """Refuse inertia inside an element that is only drawn: the link would lose it."""
        if node.tag not in DRAWN_ONLY:
            return
        for inner in node.iter():
            if inner.tag in ("inertial", "mass", "inertia"):
                raise self.fault(
                    where or f"<{node.tag}>",
                    f"<{inner.tag}> inside <{node.tag}> would not act",
                    "Put <mass> and <inertia> into the <inertial> of the link",
                )

    def named(self, root: Element, tag: str) -> dict[str, Element]:
        found: dict[str, Element] = {}
        for node in root.findall(tag):
            self.attributes(node, f"<{tag}>")
            name = node.get("name")
            if not name:
                raise self.fault(f"<{tag}>", "it has no name", 'Give name="..."')
            if name in found:
                raise self.fault(
                    f"{tag} {name!r}", f"two {tag}s have this name", "Rename one of them"
                )
            found[name] = node
        return found

    def origin(self, node: Element, where: str) -> None:
        origin = node.find("origin")
        if origin is None:
            return
        for key in ("xyz", "rpy"):
            if origin.get(key) is not None:
                self.numbers(origin, key, 3, where)
