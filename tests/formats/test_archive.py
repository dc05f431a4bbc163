"""Archives of arrays are read within bounds."""

from __future__ import annotations

import io
import struct
import time
import zipfile
from typing import Any

import numpy as np
import pytest

from srm_mbs.formats import archive
from srm_mbs.formats.archive import Archive, array_from, json_object


def npy(array: Any, **changes: tuple[str, str]) -> bytes:
    """The file of ``array``, with texts of its header replaced by others of the same length."""
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
    content = file.getvalue()
    for old, new in changes.values():
        content = content.replace(old.encode(), new.encode().ljust(len(old)))
    return content


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> io.BytesIO:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as out:
        for name, content in members.items():
            out.writestr(name, content)
    return file


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.array(3.0),
        np.zeros((0, 4)),
        np.array([True, False]),
        np.array("text\u00e4"),
        np.array([(1.0, "a")], dtype=[("t", float), ("verdict", "U8")]),
        np.arange(3),
        np.arange(3.0).astype(">f8"),
    ],
)
def test_an_array_is_the_one_that_was_written(array: Any) -> None:
    found = array_from(npy(array), "x")

    assert found.dtype == array.dtype.newbyteorder("=")
    assert found.flags.writeable
    np.testing.assert_array_equal(found, array)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is no array"),
        (npy(np.zeros(3))[:-1], "do not fill"),
        (npy(np.zeros(3)) + b"0", "do not fill"),
        (npy(np.zeros(300), a=("(300,)", "(10**9,)")), "without a readable header"),
        (npy(np.zeros(300), a=("(300,)", "(999,)")), "do not fill"),
        (npy(np.zeros(0), a=("(0,), }     ", "(0,10**20,)}")), "without a readable header"),
        (npy(np.zeros(0), a=("(0,), }                 ", "(0, 99999999999999,), } ")), "do not"),
        (npy(np.zeros(3), a=("<f8", "|O8")), "has the items"),
        (npy(np.zeros(3), a=("<f8", "<c8")), "has the items"),
        (npy(np.zeros(3), a=("False", "()   ")), "without a readable header"),
        (npy(np.zeros(3, bool))[:-1] + b"\x07", "neither true nor false"),
        (npy(np.array(["a"]))[:-1] + b"\x7f", "text that is none"),
    ],
)
def test_bytes_that_are_no_array_of_numbers_are_refused(content: bytes, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        array_from(content, "x")


def test_a_bomb_is_refused_by_its_list_of_members() -> None:
    bomb = zipped({"x.npy": b"\0" * 10**8})
    assert len(bomb.getvalue()) < 10**6

    with pytest.raises(ValueError, match="unpacks to 100 MB, of which at most 64 MB"):
        Archive(bomb)


def test_a_member_that_is_longer_than_the_list_says_is_refused() -> None:
    content = bytearray(zipped({"x.npy": npy(np.zeros(10**5))}).getvalue())
    at = content.rindex(b"PK\x01\x02")
    content[at + 24 : at + 28] = struct.pack("<L", 1000)

    with pytest.raises((ValueError, zipfile.BadZipFile)):
        Archive(io.BytesIO(bytes(content))).arrays()


def test_numbers_that_hardly_compress_are_read_beyond_the_usual_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(archive, "USUAL_CONTENT", 1000)
    numbers = np.random.default_rng(0).random(1000)

    found = Archive(zipped({"x.npy": npy(numbers)})).arrays()["x"]

    np.testing.assert_array_equal(found, numbers)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_members_whose_unpacking_has_no_bound_are_refused(method: int) -> None:
    with pytest.raises(ValueError, match="packed in a way that is not read"):
        Archive(zipped({"x.npy": npy(np.zeros(3))}, method))


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_members_of_one_name_are_refused() -> None:
    file = zipped({"x.npy": npy(np.zeros(3))})
    with zipfile.ZipFile(file, "a") as out:
        out.writestr("x.npy", npy(np.ones(3)))

    with pytest.raises(ValueError, match="two members have the name"):
        Archive(file)


def test_an_archive_of_very_many_members_is_refused_before_they_are_listed() -> None:
    file = zipped({f"{k}": b"" for k in range(archive.MOST_MEMBERS + 1)}, zipfile.ZIP_STORED)

    with pytest.raises(ValueError, match="more than 65000 members"):
        Archive(file)


@pytest.mark.parametrize("name", ["x" * 2000, "a\nb", "\u202ex.npy"])
def test_a_member_with_a_name_that_cannot_be_shown_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="no usable name"):
        Archive(zipped({name: b""}))


def test_json_of_great_depth_is_refused_and_brackets_in_texts_are_not_counted() -> None:
    deep = '{"a": ' * 100 + "1" + "}" * 100

    assert json_object('{"a": "[[[[\\"' + "[" * 100 + '"}', "meta")
    with pytest.raises(ValueError, match="more than 64 objects inside each other"):
        json_object(deep, "meta")
    with pytest.raises(ValueError, match="is no object"):
        json_object("[1]", "meta")


def test_json_of_many_values_or_a_text_that_does_not_end_is_refused_in_little_time() -> None:
    begun = time.process_time()
    for text in (
        '{"a": [' + "[]," * 10**6 + "[]]}",
        '{"a": [' + "0," * (archive.MOST_COMMAS + 1) + "0]}",
        '{"a": "' + '\\"' * 10**6,
    ):
        with pytest.raises(ValueError, match=r"more values than a run has|Unterminated string"):
            json_object(text, "meta")
    assert time.process_time() - begun < 5.0
