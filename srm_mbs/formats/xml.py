"""XML of unknown origin, read without entities or external references.

Numbers, words and known names in it, with errors that name file, element and remedy.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from xml.etree.ElementTree import Element, ParseError, TreeBuilder

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml import ElementTree as SafeTree

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, known_names, naming
from srm_mbs.formats.files import LARGEST_FILE, LONGEST_NAME, check_name, shortened
from srm_mbs.model.numbers import LARGEST_MAGNITUDE


def words(text: str) -> tuple[str, ...]:
    """The words of ``text``, for tables of names."""
    return tuple(text.split())


NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
LIMIT = re.compile(r"[+-]?inf(inity)?", re.IGNORECASE)
ACTING = words("joint constraint bushing spring damper inertia gear mimic coupling tendon")
"""Words in the names of other tools' elements that act, such as ``drake:rotor_inertia``."""
LARGEST_NESTING = 300
"""Largest depth of nested elements."""
LARGEST_INCLUDE_DEPTH = 20
"""Largest number of files that include each other."""
MOST_INCLUDES = 1000
"""Number of files that a file includes, directly and indirectly."""
MOST_ELEMENTS = 10**6
"""Number of elements, and of attributes, in a file."""
NAMING = ("name", "link", "joint", "body", "site", "body1", "body2", "joint1", "joint2", "frame")
"""Attributes that hold names."""
PIECE = 4 * 10**6
"""Characters that the parser gets at once."""
LARGEST_TAG = 4 * 10**6
"""Bytes of a tag with its attributes, or of a comment."""
BLANK = re.compile(r"\s*+")
ROOT = re.compile(r"<([^\s/><!?]++)")
OPAQUE = re.compile(r"<!--|<!\[CDATA\[|<\?")
"""Beginnings of parts in which no tag is read."""
ENDS = {"<!--": "-->", "<![CDATA[": "]]>", "<?": "?>"}
"""The end of each such part, by its beginning."""
NULL_END = "null characters at the end of the file are left out, as tinyxml reads it"
DASHES = "comments with -- inside, which XML does not allow, are skipped as tinyxml skips them"
LATE_DECLARATION = (
    "an XML declaration that is not at the start, which XML does not allow, is skipped"
)
DECLARATION = re.compile(r"<\?xml\s[^<>?]*+\?>")
NAMESPACED = re.compile(r"\{[^}]*\}")


def local_name(node: Element) -> str:
    """The tag without its namespace."""
    tag = node.tag
    return tag.rsplit("}", 1)[-1].rsplit(":", 1)[-1] if ":" in tag or "}" in tag else tag


def parse_numbers(text: str, largest: float = LARGEST_MAGNITUDE) -> list[float] | None:
    """The numbers in ``text``, separated by spaces; None if there is anything else, or a magnitude
    above ``largest``."""
    parts = text.split()
    if not all(map(NUMBER.fullmatch, parts)):
        return None
    values = list(map(float, parts))
    small = not values or (max(values) <= largest and min(values) >= -largest)
    return values if small else None


ONE_NUMBER = "a finite number"


def _writing(text: str, wanted: str) -> str:
    """The remedy for ``text``, which is not the numbers ``wanted``."""
    if "${" in text or "$(" in text:
        return "Run xacro on the file first"
    if "," in text:
        if wanted == ONE_NUMBER:
            return f"Write {wanted} with a decimal point"
        return f"Write {wanted} with decimal points, and separated by spaces"
    return f"Write {wanted}"


class XmlFile:
    """One XML file for messages: its faults, its numbers, and a count of what is ignored in it.

    Parameters
    ----------
    file
        Its name.
    """

    def __init__(self, file: str) -> None:
        self.file = file
        self._ignored: dict[str, int] = {}

    def fault(self, where: str, problem: str, remedy: str) -> InputError:
        """The error to raise about the element ``where``."""
        return InputError(problem, file=self.file, element=where, remedy=remedy)

    def unknown(self, where: str, problem: str, known: Iterable[str]) -> InputError:
        """The error to raise about a name in ``where`` that is none of those ``known``."""
        return self.fault(where, problem, known_names(known))

    def ignore(self, what: str) -> None:
        """Count something that is left out knowingly, as ``<sensor> element``."""
        self._ignored[what] = self._ignored.get(what, 0) + 1

    def ignored_notes(self) -> tuple[str, ...]:
        """One sentence for each kind of thing that was ignored."""
        return tuple(
            f"{count} {what}(s) do not act and are ignored" for what, count in self._ignored.items()
        )

    def only(
        self, node: Element, where: str, known: Iterable[str], passed: Iterable[str] = ()
    ) -> None:
        """Refuse attributes of ``node`` that are neither ``known`` nor ``passed`` over."""
        known = tuple(known)
        for key in node.attrib:
            if key not in known and key not in passed:
                problem = f"<{local_name(node)}> has an unknown attribute {key!r}"
                raise self.unknown(where, problem, known)

    def numbers(
        self,
        text: str | None,
        count: int | Sequence[int],
        where: str,
        what: str,
        largest: float = LARGEST_MAGNITUDE,
    ) -> FloatArray:
        """Exactly ``count`` finite numbers (or as many as one of several counts).

        Raises
        ------
        InputError
            Saying what stands there instead, if it is anything else.
        """
        counts = (count,) if isinstance(count, int) else tuple(count)
        values = parse_numbers(text or "", largest)
        if values is None or len(values) not in counts:
            wanted = " or ".join(ONE_NUMBER if n == 1 else f"{n} finite numbers" for n in counts)
            parts = (text or "").split()
            given = repr(" ".join(parts)[:60]) if parts else "nothing"
            raise self.fault(
                where, f"{what} is {given}, not {wanted}", _writing(text or "", wanted)
            )
        return np.array(values)


class XmlValues(XmlFile):
    """Reads values of one SDF or MJCF file, and collects notes of what it assumes or ignores.

    Parameters
    ----------
    file
        Its name.
    main
        The values of the file that it is a part of: notes and counts are kept together.
    """

    def __init__(self, file: str, main: XmlValues | None = None) -> None:
        super().__init__(file)
        self._remarks: dict[str, list[str]] = {}
        self._included: list[int] = []  # characters of each included file
        if main is not None:
            self._remarks, self._ignored = main._remarks, main._ignored
            self._included = main._included

    def remark(self, what: str, where: str) -> None:
        """Note an assumption or approximation at ``where``; one sentence lists all places."""
        self._remarks.setdefault(what, []).append(where)

    def notes(self) -> tuple[str, ...]:
        """One sentence for each kind of thing that was assumed or ignored."""
        remarks = (f"{what}: {', '.join(where)}" for what, where in self._remarks.items())
        return (*remarks, *self.ignored_notes())

    def limit(self, text: str, where: str, what: str) -> float:
        """A number of any size, as exporters write the largest double for "no limit"."""
        if LIMIT.fullmatch(text.strip()):
            return -np.inf if text.strip().startswith("-") else np.inf
        return float(self.numbers(text, 1, where, what, np.inf)[0])

    def truth(self, text: str | None, where: str, what: str) -> bool:
        """``true`` or ``1``, ``false`` or ``0``."""
        word = (text or "").strip().lower()
        if word not in ("true", "false", "1", "0"):
            raise self.fault(where, f"{what} is {word!r}", "Write true or false")
        return word in ("true", "1")

    def child_number(self, node: Element | None, tag: str, where: str, default: float) -> float:
        """The number in the child ``tag``; ``default`` without one."""
        text = None if node is None else node.findtext(tag)
        return default if text is None else float(self.numbers(text, 1, where, f"<{tag}>")[0])

    def child_truth(self, node: Element, tag: str, where: str, default: bool) -> bool:
        """The truth in the child ``tag``; ``default`` without one."""
        text = node.findtext(tag)
        return default if text is None else self.truth(text, where, f"<{tag}>")

    def direction(self, values: FloatArray, where: str, what: str) -> FloatArray:
        """``values`` (3,) as a unit vector."""
        length = float(np.linalg.norm(values))
        if length == 0.0:
            raise self.fault(where, f"{what} is zero", "Give a direction")
        out: FloatArray = values / length
        return out

    def check_include(self, depth: int, where: str) -> None:
        """Refuse the include ``where``, which is in ``depth`` others, if that are too many."""
        if depth >= LARGEST_INCLUDE_DEPTH:
            raise self.fault(
                where, f"more than {LARGEST_INCLUDE_DEPTH} files include each other", "Break it"
            )

    def count_included(self, text: str, where: str) -> None:
        """Count an included file with this ``text``, and refuse it, if it is one too many or they
        are too large together."""
        self._included.append(len(text))
        if len(self._included) > MOST_INCLUDES:
            raise self.fault(
                where,
                f"more than {MOST_INCLUDES} files are included",
                "Include fewer, and none in a circle",
            )
        if sum(self._included) > LARGEST_FILE:
            raise self.fault(
                where,
                f"the included files have more than {LARGEST_FILE / 1e6:.0f} MB together",
                "Include fewer or smaller ones",
            )

    def children(
        self,
        node: Element,
        where: str,
        read: Iterable[str],
        ignored: Iterable[str],
        many: Iterable[str] = (),
    ) -> None:
        """Refuse unknown children, and two where one is read; count those that are ignored.

        Parameters
        ----------
        node, where
            The element, and its name for messages.
        read, ignored
            Tags of both kinds.
        many
            Those of ``read`` that may stand there several times.
        """
        read, ignored, seen = tuple(read), tuple(ignored), set[str]()
        for child in node:
            tag = child.tag
            if not isinstance(tag, str):  # a comment or processing instruction
                continue
            if tag in read:
                if tag in seen and tag not in many:
                    raise self.fault(where, f"<{tag}> is given twice", "Keep one")
                seen.add(tag)
            elif tag in ignored:
                self.ignore(f"<{tag}> element")
            elif NAMESPACED.match(tag) or ":" in tag:
                self._other_tool(NAMESPACED.sub("", tag), where)
            else:
                problem = f"unknown element <{tag}> in <{node.tag}>"
                raise self.unknown(where or f"<{tag}>", problem, (*read, *ignored))

    def _other_tool(self, tag: str, where: str) -> None:
        """Refuse an element with a namespace prefix that acts, by its name; count the others."""
        found = next((word for word in ACTING if word in tag), None)
        if found is not None:
            raise self.fault(
                f"{where}, <{tag}>",
                f"this element of another tool (a {found}) is not read by this version",
                "Describe it in a TOML description and remove the element",
            )
        self.ignore(f"<{tag}> element of another tool")

    def attributes(self, node: Element, where: str, read: Iterable[str]) -> None:
        """Refuse unknown attributes; count those of other tools."""
        foreign = [key for key in node.attrib if NAMESPACED.match(key)]
        for key in foreign:
            self.ignore(f"<{node.tag} {NAMESPACED.sub('', key)}> attribute of another tool")
        self.only(node, where, read, foreign)


def _root(text: str) -> tuple[str, int] | None:
    """Name of the root element of ``text``, prefix included, and where it ends; None if ``text``
    does not look like XML."""
    at = 1 if text.startswith("\ufeff") else 0
    while True:
        at = BLANK.match(text, at).end()  # type: ignore[union-attr]
        if text.startswith("<!--", at):
            at = _after(text, "-->", at + 4)
        elif text.startswith("<?", at):
            at = _after(text, "?>", at + 2)
        elif text.startswith("<!DOCTYPE", at):
            subset, end = text.find("[", at), text.find(">", at)
            if 0 <= subset < end:
                at = _after(text, "]", subset)
            at = _after(text, ">", at)
        else:
            name = ROOT.match(text, at)
            return (name[1], name.end()) if name else None


def _after(text: str, mark: str, start: int) -> int:
    """Where the next ``mark`` ends; the end of ``text`` without one."""
    found = text.find(mark, start)
    return len(text) if found < 0 else found + len(mark)


def root_tag(text: str) -> str | None:
    """Name of the root element, prefix included; None if ``text`` does not look like XML."""
    root = _root(text)
    return None if root is None else root[0]


def parse_xml(text: str, file: str, notes: list[str] | None = None) -> Element:
    """Root element of ``text``; ``notes`` gets a sentence about faults that are passed over.

    Raises
    ------
    InputError
        If it is not well-formed XML, uses entities or external references, has more than
        :data:`MOST_ELEMENTS` elements or attributes, more than :data:`LARGEST_NESTING` nested ones,
        or a name that is no name.
    """
    if max(text.count("<") // 2, text.count('="') + text.count("='")) > MOST_ELEMENTS:
        raise InputError(
            f"the XML has more than {MOST_ELEMENTS} elements or attributes",
            file=file,
            remedy="Split the file, or remove what is not needed",
        )
    if not text.strip():
        raise InputError("the file has no content", file=file, remedy="Write the model into it")
    try:
        with naming(file=file):
            root = _parsed(text)
    except ParseError as error:
        # Drake's own reader takes <drake:...> without a declaration; expat does not.
        declared = _with_prefixes(text) if "unbound prefix" in str(error) else text
        if declared != text:
            return parse_xml(declared, file, notes)
        for mended, note in (
            (_without_late_declaration(text), LATE_DECLARATION),
            (_without_dashes(text), DASHES),
            (text.rstrip("\0"), NULL_END),
        ):
            if mended != text:
                root = parse_xml(mended, file, notes)
                if notes is not None:
                    notes.append(note)
                return root
        raise InputError(
            f"this is not well-formed XML: {_explained(error)}",
            file=file,
            remedy="Correct the file there",
        ) from error
    except DefusedXmlException as error:
        raise InputError(
            f"the XML uses entities or external references: {shortened(str(error))}",
            file=file,
            remedy="Remove them; they are refused for safety",
        ) from error
    except InputError:
        raise
    except ValueError as error:  # a surrogate, which no encoding has
        raise InputError(
            f"this is not well-formed XML: {shortened(str(error))}",
            file=file,
            remedy="Correct the file",
        ) from error
    with naming(file=file):
        check_tree(root)
    return root


class _ShallowTree(TreeBuilder):
    """Ends the parser at an element that is nested too deep, instead of building all of them."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def start(self, tag: str, attributes: dict[str, str], /) -> Element:
        self._depth += 1
        if self._depth > LARGEST_NESTING + 1:
            raise _too_deep(tag.rpartition("}")[2])
        return super().start(tag, attributes)

    def end(self, tag: str, /) -> Element:
        self._depth -= 1
        return super().end(tag)


def _too_deep(tag: str) -> InputError:
    """The error for elements nested deeper than the readers, which recurse, can follow."""
    return InputError(
        f"more than {LARGEST_NESTING} elements are nested",
        element=f"<{shortened(tag)}>",
        remedy="Write such a long chain as a URDF, which is flat",
    )


def _parsed(text: str) -> Element:
    """Root element of ``text``, which is handed over in pieces: the time of the parser would grow
    without bound with the length of an attribute or a comment."""
    parser = SafeTree.DefusedXMLParser(target=_ShallowTree())
    size = 0
    for start in range(0, len(text), PIECE):
        piece = text[start : start + PIECE].encode()
        parser.feed(piece)
        size += len(piece)
        if size - parser.parser.CurrentByteIndex > LARGEST_TAG + PIECE:
            raise ValueError(f"a tag or comment has more than {LARGEST_TAG / 1e6:.0f} MB")
    root: Element = parser.close()
    return root


def _explained(error: ParseError) -> str:
    """The message of expat, which may quote the file, with the position."""
    words, _, position = str(error).rpartition(": ")
    if words == "no element found":
        words = "the file ends before its root element is closed"
    return f"{shortened(words)}: {position}"


def check_tree(root: Element) -> None:
    """Refuse elements nested deeper than the readers, which recurse, can follow, and names that
    :func:`~srm_mbs.formats.files.check_name` refuses."""
    level, depth = [root], 0
    while level:
        if depth > LARGEST_NESTING:
            raise _too_deep(local_name(level[0]))
        for node in level:
            for text in (str(node.tag), *node.attrib):
                if len(text) > LONGEST_NAME:
                    raise InputError(
                        f"the name {shortened(text)!r} of an element or attribute has {len(text)} "
                        "characters",
                        remedy=f"Give at most {LONGEST_NAME} characters",
                    )
            for key in NAMING:
                if key in node.attrib:
                    check_name(node.attrib[key], f"<{local_name(node)} {key}>")
        level = [child for node in level for child in node]
        depth += 1


def _with_prefixes(text: str) -> str:
    """``text`` with every namespace prefix that it uses and does not declare declared."""
    root = _root(text)
    if root is None:
        return text
    used = set(re.findall(r"[<\s/]([A-Za-z_][\w.-]*):[A-Za-z_]", text))
    missing = used - set(re.findall(r"\sxmlns:([\w.-]+)\s*=", text)) - {"xml", "xmlns"}
    declarations = "".join(f' xmlns:{prefix}="{prefix}"' for prefix in sorted(missing))
    return text[: root[1]] + declarations + text[root[1] :]


def _without_late_declaration(text: str) -> str:
    """``text`` with spaces for an XML declaration that follows blank lines or comments: the text is
    decoded already, and tinyxml takes it there."""
    root = _root(text)
    late = DECLARATION.search(text, 1, root[1]) if root else None
    return text if late is None else text[: late.start()] + " " * len(late[0]) + text[late.end() :]


def _without_dashes(text: str) -> str:
    """``text`` with spaces for the dashes in its comments, which end at the first ``-->``: in XML
    they hold no ``--``, but tinyxml, which most robots are read by, takes it."""
    out: list[str] = []
    at = 0
    while (begin := OPAQUE.search(text, at)) is not None:
        inside, end = begin.end(), text.find(ENDS[begin[0]], begin.end())
        if end < 0:
            break
        content = text[inside:end]
        is_comment = begin[0] == "<!--"
        out += text[at:inside], content.replace("-", " ") if is_comment else content
        at = end
    return "".join((*out, text[at:]))
