"""Archives of arrays (``.npz``) read within bounds.

The directory of an archive and the headers of its arrays say how large everything is; both are
checked before memory is allocated, and nothing is unpickled.
"""

from __future__ import annotations

import ast
import json
import math
import re
import struct
import zipfile
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

LARGEST_CONTENT = 2 * 10**9
"""Bytes of all members of an archive, unpacked; larger ones would have a list of members of another
kind."""
USUAL_CONTENT, LARGEST_RATIO = 64 * 10**6, 20
"""Bytes of all members, unpacked, that any archive may have, and how often its own size a larger
one: numbers do not compress further, zeros do."""
MOST_MEMBERS = 65_000
LARGEST_DIRECTORY = 8 * 10**6
"""Bytes of the list of the members."""
LONGEST_NAME = 1000
"""Characters of the name of a member."""
DEEPEST_JSON = 64
"""Objects and lists inside each other."""
MOST_OBJECTS, MOST_COMMAS = 500_000, 5 * 10**6
"""Objects and lists of a JSON text, and its commas: of each value much memory is made."""

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Ways of packing whose unpacking is bounded."""
_END = struct.Struct("<4s4H2LH")
"""Record at the end of an archive: sizes and place of its list of members."""
_ZIP64_END = b"PK\x06\x07"
_MAGIC = b"\x93NUMPY"
_HEADER = re.compile(
    r"\{'descr': (?P<descr>'[^']{1,32}'|\[[^\[\]]{1,400}\]), "
    r"'fortran_order': (?P<fortran>True|False), "
    r"'shape': \((?P<shape>[0-9, ]{0,200})\), \} *\n"
)
_SCALAR = re.compile(r"[<>|]([fiu][1248]|b1|U[0-9]{1,10})")
# A text need not end: an expression that fails at the end of the file begins anew at every quote.
_TEXT_OR_BRACKET = re.compile(r'"[^"\\]*+(?:\\.[^"\\]*+)*+"?|[\[{]|[\]}]', re.DOTALL)


class Archive:
    """An archive whose members are read one by one.

    Parameters
    ----------
    file
        The archive, opened in binary mode.
    budget
        Largest number of bytes of all members together; by default what the size of the file
        allows.

    Raises
    ------
    ValueError
        If it is no archive, or has more members or bytes than that, members of one name, encrypted
        members, or members packed in an unusual way.
    """

    def __init__(self, file: IO[bytes], budget: int | None = None) -> None:
        size = _checked_end(file)
        self._zip = zipfile.ZipFile(file)
        if budget is None:
            budget = min(max(USUAL_CONTENT, LARGEST_RATIO * size), LARGEST_CONTENT)
        self.budget = budget
        """Bytes that its members may have together."""
        self._members: dict[str, zipfile.ZipInfo] = {}
        for member in self._zip.infolist():
            name = member.filename
            if len(name) > LONGEST_NAME or not name.isprintable():
                raise ValueError("a member has no usable name")
            if name in self._members:
                raise ValueError(f"two members have the name {name!r}")
            if member.flag_bits & 1 or member.compress_type not in _METHODS:
                raise ValueError(f"the member {name!r} is packed in a way that is not read")
            self._members[name] = member
        self.content = sum(member.file_size for member in self._members.values())
        """Bytes of all members together."""
        if self.content > budget:
            raise ValueError(
                f"it unpacks to {self.content / 1e6:.0f} MB, of which at most "
                f"{budget / 1e6:.0f} MB are read"
            )

    @property
    def names(self) -> list[str]:
        """Names of the members."""
        return list(self._members)

    def read(self, name: str) -> bytes:
        """The content of a member.

        Raises
        ------
        ValueError, KeyError, OSError, zipfile.BadZipFile, zlib.error
            If there is none, or it is damaged.
        """
        member = self._members[name]
        with self._zip.open(member) as opened:
            content = opened.read(member.file_size + 1)
        if len(content) != member.file_size:
            raise ValueError(f"the member {name!r} has another size than the archive says")
        return content

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Its members, all of which are arrays, by name.

        Raises
        ------
        ValueError, OSError, zipfile.BadZipFile, zlib.error
            If one of them is not.
        """
        found = {}
        for name in self._members:
            if not name.endswith(".npy"):
                raise ValueError(f"the member {name!r} is no array")
            key = name.removesuffix(".npy")
            found[key] = array_from(self.read(name), key)
        return found


def _checked_end(file: IO[bytes]) -> int:
    """Size of the archive ``file`` (bytes); refuses one with a long list of members."""
    size = file.seek(0, 2)
    file.seek(max(0, size - _END.size - 20))
    tail = file.read()
    file.seek(0)
    if len(tail) < _END.size or tail[-_END.size :][:4] != b"PK\x05\x06":
        raise ValueError("no archive of arrays")
    end = _END.unpack(tail[-_END.size :])
    members, directory, comment = end[4], end[5], end[7]
    if comment or tail[:4] == _ZIP64_END or members > MOST_MEMBERS or directory > LARGEST_DIRECTORY:
        raise ValueError(f"it has more than {MOST_MEMBERS} members, or is no archive of arrays")
    return size


def array_from(content: bytes, name: str) -> NDArray[Any]:
    """The array in ``content``, a file of NumPy (``.npy``) of numbers, truth values or text.

    Raises
    ------
    ValueError
        If it is none, or its shape does not fit the bytes that are there; ``name`` is its name.
    """
    wide = content[6:7] in (b"\x02", b"\x03")
    at = 12 if wide else 10
    if (
        content[:6] != _MAGIC
        or content[6:8] not in (b"\1\0", b"\2\0", b"\3\0")
        or len(content) < at
    ):
        raise ValueError(f"{name} is no array")
    start = at + int.from_bytes(content[8:at], "little")
    found = _HEADER.fullmatch(content[at:start].decode("latin-1")) if start - at <= 1000 else None
    if found is None:
        raise ValueError(f"{name} is an array without a readable header")
    dtype = _dtype(found["descr"], name)
    shape = tuple(int(part) for part in found["shape"].split(",") if part.strip())
    there = len(content) - start
    if math.prod(shape) * dtype.itemsize != there or max(shape, default=0) > LARGEST_CONTENT:
        raise ValueError(f"{name} has the shape {shape}, which its {there} bytes do not fill")
    fortran = found["fortran"] == "True"
    flat = np.frombuffer(content, dtype, math.prod(shape), start)
    array = flat.reshape(shape, order="F" if fortran else "C")
    array = array.astype(dtype.newbyteorder("="), order="K")  # a copy, which may be written to
    _check_items(array, name)
    return array


def _dtype(text: str, name: str) -> np.dtype[Any]:
    """The dtype that a header describes: of scalars, or of fields of scalars."""
    described = ast.literal_eval(text)
    fields = [("", described)] if isinstance(described, str) else described
    for field in fields:
        pair = isinstance(field, tuple) and len(field) == 2
        if not (pair and isinstance(field[1], str) and _SCALAR.fullmatch(field[1])):
            raise ValueError(f"{name} has the items {text}")
    out: np.dtype[Any] = np.dtype(described)
    return out


def _check_items(array: NDArray[Any], name: str) -> None:
    """Refuse bytes that are no truth value or no character."""
    for field in array.dtype.names or ():
        _check_items(np.ascontiguousarray(array[field]), name)
    if array.dtype.kind == "b" and (array.view(np.uint8) > 1).any():
        raise ValueError(f"{name} has truth values that are neither true nor false")
    if array.dtype.kind == "U" and array.dtype.itemsize and array.size:
        codes = np.ascontiguousarray(array).reshape(-1).view(array.dtype.str[0] + "u4")
        if (codes > 0x10FFFF).any():
            raise ValueError(f"{name} has text that is none")


def json_object(text: str | bytes, name: str) -> dict[str, Any]:
    """The object that the JSON ``text`` describes.

    Raises
    ------
    ValueError
        If it describes none, one with more than DEEPEST_JSON objects and lists inside each other,
        or one with more values than a run has; ``name`` is its name.
    """
    text = text if isinstance(text, str) else text.decode("utf-8")
    depth = opened = 0
    for found in _TEXT_OR_BRACKET.finditer(text):
        character = text[found.start()]
        opened += character in "[{"
        depth += (character in "[{") - (character in "]}")
        if depth > DEEPEST_JSON:
            raise ValueError(f"{name} has more than {DEEPEST_JSON} objects inside each other")
        if opened > MOST_OBJECTS:
            break
    if opened > MOST_OBJECTS or text.count(",") > MOST_COMMAS:
        raise ValueError(f"{name} has more values than a run has")
    found_object = json.loads(text)
    if not isinstance(found_object, dict):
        raise ValueError(f"{name} is no object")
    return found_object


def content_of(arrays: Mapping[str, Any]) -> int:
    """Bytes that ``arrays`` fill in an archive."""
    return sum(np.asarray(array).nbytes for array in arrays.values())
