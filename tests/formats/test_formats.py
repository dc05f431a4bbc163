"""Which format a file is of, what a description may name, and the page that says what is read."""

from __future__ import annotations

from pathlib import Path

import pytest

import srm_mbs as srm
from srm_mbs.formats import gepetto
from srm_mbs.formats.document import Document
from srm_mbs.formats.graph.spanning_tree_to_urdf import CLOSURE_OF
from srm_mbs.formats.registry import FORMATS, find_format
from srm_mbs.formats.urdf import loop_elements, validation
from srm_mbs.formats.urdf.joint_types import EXTENDED_TYPES
from srm_mbs.formats.xml import root_tag
from tests.support import sdf_files
from tests.support.urdf_files import tree

TEXTS = {
    "URDF": tree(),
    "SDF": sdf_files.four_bar(),
    "MJCF": "<mujoco/>",
    "Gepetto YAML": "# loops\nclosed_loop: []\ntype: []\n",
    "TOML description": 'format = 1\nurdf = "a.urdf"\n',
}


@pytest.mark.parametrize("suffix", ["", ".xml", ".urdf", ".sdf", ".toml", ".yaml", ".txt"])
@pytest.mark.parametrize("name", TEXTS)
def test_a_format_is_found_by_its_content(name: str, suffix: str) -> None:
    assert find_format(Path(f"file{suffix}"), Document(TEXTS[name], "file")).name == name


@pytest.mark.parametrize("found", FORMATS, ids=lambda found: found.name)
def test_a_file_that_says_nothing_is_judged_by_its_suffix(found: object) -> None:
    suffix = found.suffixes[0]  # type: ignore[attr-defined]
    assert suffix in find_format(Path(f"file{suffix}"), Document("?", "file")).suffixes


@pytest.mark.parametrize(
    ("text", "tag"),
    [
        ("<robot/>", "robot"),
        ('\ufeff<?xml version="1.0"?>\n<!-- <sdf> -->\n<robot name="a">', "robot"),
        ('<!DOCTYPE robot [<!ENTITY a "<b>">]><robot>', "robot"),
        ("<drake:robot x=''>", "drake:robot"),
        ("robot", None),
        ("< 3", None),
        ("", None),
    ],
)
def test_the_root_element_is_found_behind_the_prolog(text: str, tag: str | None) -> None:
    assert root_tag(text) == tag


# --- what a description names --------------------------------------------------------------------


def described(folder: Path, line: str) -> Path:
    (folder / "robot.urdf").write_text(TEXTS["URDF"])
    (folder / "robot.sdf").write_text(TEXTS["SDF"])
    path = folder / "robot.toml"
    path.write_text(f"format = 1\n{line}\n")
    return path


def test_a_description_names_a_file_of_another_format(tmp_path: Path) -> None:
    mechanism = srm.load(described(tmp_path, 'sdf = "robot.sdf"\nname = "mine"'))
    assert mechanism.name == "mine"
    assert mechanism.loops
    assert mechanism.source is not None
    assert mechanism.source.format == "SDF"


@pytest.mark.parametrize(
    ("line", "needle"),
    [
        ('urdf = "robot.sdf"', "'robot.sdf' is a SDF, not a URDF. Write sdf = \"robot.sdf\""),
        ('sdf = "robot.urdf"', "'robot.urdf' is a URDF, not a SDF. Write urdf = \"robot.urdf\""),
        ('urdf = "robot.toml"', "'robot.toml' is a TOML description, not a URDF"),
        ('sdf = "none.sdf"', "the SDF 'none.sdf' cannot be read"),
        ('sdf = "robot.sdf"\ncut = "joint"', "cut: a list is wanted"),
        ('sdf = "robot.sdf"\ncut = ["no such joint"]', "no such joint"),
    ],
)
def test_a_wrong_name_is_one_clear_error(line: str, needle: str, tmp_path: Path) -> None:
    path = described(tmp_path, line)
    with pytest.raises(srm.InputError) as caught:
        srm.load(path)
    assert str(caught.value).startswith(str(tmp_path))
    assert needle in str(caught.value)


# --- the page ------------------------------------------------------------------------------------


def test_the_page_of_formats_tells_of_every_element_that_is_known() -> None:
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()
    elements = [tag for owner in ("robot", "link", "joint") for tag in validation.IGNORED[owner]]
    elements += [tag for tags in validation.READ.values() for tag in tags]
    attributes = [key for keys in validation.INFORMATIVE.values() for key in keys]
    attributes += validation.ATTRIBUTES["limit"] + validation.ATTRIBUTES["dynamics"]
    loops = [*validation.LOOP_ELEMENTS, *(f"drake:{tag}" for tag in loop_elements.DRAKE_ELEMENTS)]
    missing = [tag for tag in (*elements, *loops) if f"<{tag}" not in page]
    words = (*attributes, *EXTENDED_TYPES, *CLOSURE_OF, *gepetto.KEYS)
    missing += [word for word in words if f"`{word}`" not in page]
    assert not missing
