"""XML that expat refuses and robots are written in: comments with two dashes."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import tostring

import pytest

import srm_mbs as srm
from srm_mbs.formats import xml
from srm_mbs.formats.xml import DASHES, LATE_DECLARATION, NULL_END, parse_xml
from tests.support import sdf_files
from tests.support.urdf_files import tree

DASHED = "<!-- a -- b --- <link/> &x; \n -- --->"


@pytest.mark.parametrize(
    ("text", "same"),
    [
        (f"<a>{DASHED}<b/></a>", "<a><b/></a>"),
        (f"{DASHED}<a/>{DASHED}", "<a/>"),
        ("<a><!-- -- --><b/><!-- > --></a>", "<a><b/></a>"),
        # A comment ends at the first -->, and begins in no other part.
        (f"<a>{DASHED}<![CDATA[<!-- -- ]]>-->", None),
        (f"<a>{DASHED}<![CDATA[<!-- -- -->]]></a>", "<a>&lt;!-- -- --&gt;</a>"),
        (f"<a>{DASHED}<?x <!-- ?>--</a>", "<a>--</a>"),
        (f"<p:a>{DASHED}</p:a>", '<p:a xmlns:p="p"/>'),
    ],
)
def test_dashes_in_comments_are_skipped(text: str, same: str | None) -> None:
    notes: list[str] = []
    if same is None:
        with pytest.raises(srm.InputError, match="not well-formed"):
            parse_xml(text, "x", notes)
        return
    assert tostring(parse_xml(text, "x", notes)) == tostring(parse_xml(same, "x"))
    assert notes == [DASHES]


@pytest.mark.parametrize(
    "text", ["<a><!-- -- </a>", "<a><!-- -- --></b>", "<a b='<!-- -- -->'/>", "<a>&amp</a>"]
)
def test_other_faults_are_refused_where_they_are(text: str) -> None:
    with pytest.raises(srm.InputError, match="not well-formed XML"):
        parse_xml(text, "x")


@pytest.mark.parametrize(
    "text",
    [
        '<!-- -- --><!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>',
        '<!DOCTYPE a [<!-- -- --><!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>',
        '<!DOCTYPE a [<!ENTITY b "<!-- -- -->">]><!-- -- --><a>&b;</a>',
    ],
)
def test_dashes_do_not_let_entities_in(text: str) -> None:
    with pytest.raises(srm.InputError, match="refused for safety"):
        parse_xml(text, "x")


@pytest.mark.timeout(5)
@pytest.mark.parametrize("part", ["<!-- -- ", "<!-- -- -->", "<!-- -", "<![CDATA[", "<?"])
def test_a_file_of_comments_is_read_in_linear_time(
    part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(xml, "MOST_ELEMENTS", 10**7)
    text = "<a><!-- -- -->" + part * 200_000
    with pytest.raises(srm.InputError):
        parse_xml(text, "x")


def test_every_format_notes_it_once(tmp_path: Path) -> None:
    for name, text in (
        ("robot.urdf", tree().replace("<link", "<!-- -- --><link", 2)),
        ("robot.sdf", sdf_files.four_bar("<!-- -- -->")),
    ):
        path = tmp_path / name
        path.write_text(text)
        plain = path.with_stem("plain")
        plain.write_text(text.replace("<!-- -- -->", ""))
        assert srm.load(path).notes == (DASHES, *srm.load(plain).notes)


@pytest.mark.parametrize("before", ["\n\n", "<!-- a robot -->\n", "<!-- a -- b -->"])
def test_a_declaration_after_blank_lines_or_comments_is_skipped(before: str) -> None:
    notes: list[str] = []
    root = parse_xml(f'{before}<?xml version="1.0" ?>\n<a><b/></a>', "x.urdf", notes)
    assert [node.tag for node in root] == ["b"]
    assert LATE_DECLARATION in notes
    assert (DASHES in notes) == ("--" in before[4:-4])


def test_null_characters_at_the_end_are_left_out() -> None:
    notes: list[str] = []
    root = parse_xml("<a><b/></a>\n\0\0", "x.urdf", notes)
    assert [node.tag for node in root] == ["b"]
    assert notes == [NULL_END]


@pytest.mark.parametrize("text", ["<a>\0<b/></a>", "<a><b/></a>\0<c/>"])
def test_null_characters_elsewhere_are_refused(text: str) -> None:
    with pytest.raises(srm.InputError, match="not well-formed"):
        parse_xml(text, "x.urdf")


def test_a_second_declaration_is_refused() -> None:
    text = '<?xml version="1.0"?><a><?xml version="1.0"?></a>'
    with pytest.raises(srm.InputError, match="not well-formed"):
        parse_xml(text, "x.urdf")


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        ("${reach} 0 0", "Run xacro on the file first"),
        ("$(arg reach) 0 0", "Run xacro on the file first"),
        ("0,2 0,0 0", "Write 3 finite numbers with decimal points, and separated by spaces"),
        ("0.2, 0, 0", "Write 3 finite numbers with decimal points, and separated by spaces"),
        ("0.2 0", "Write 3 finite numbers"),
    ],
)
def test_numbers_that_are_none_are_refused_with_the_remedy_for_what_was_written(
    text: str, remedy: str
) -> None:
    with pytest.raises(srm.InputError) as refused:
        xml.XmlFile("x.urdf").numbers(text, 3, "joint 'a'", "<origin xyz>")
    assert refused.value.remedy == remedy
