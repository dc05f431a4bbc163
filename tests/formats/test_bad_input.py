"""Bad descriptions, URDFs and arguments: one clear error each, naming file, element and remedy."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support.snapshots import check_messages, refused

URDF = """<?xml version="1.0"?>
<robot name="two_bars">
  <link name="base"/>
  <link name="crank">
    <inertial>
      <origin xyz="0.5 0 0" rpy="0 0 0"/>
      <mass value="1"/>
      <inertia ixx="0.001" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <link name="rod">
    <inertial>
      <origin xyz="0.75 0 0"/>
      <mass value="1.5"/>
      <inertia ixx="0.002" iyy="0.3" izz="0.3" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="hinge" type="revolute">
    <parent link="base"/>
    <child link="crank"/>
    <origin xyz="0 0 0" rpy="0 0 0"/>
    <axis xyz="0 -1 0"/>
    <limit lower="-10" upper="10" effort="1" velocity="1"/>
    <dynamics damping="0.5"/>
  </joint>
  <joint name="knee" type="continuous">
    <parent link="crank"/>
    <child link="rod"/>
    <origin xyz="1 0 0"/>
    <axis xyz="0 -1 0"/>
  </joint>
</robot>
"""

TOML = """format = 1
name = "two_bars"
urdf = "two_bars.urdf"
base = "fixed"
gravity = [0.0, 0.0, -9.81]
lock = []

[[loop]]
name = "pin"
type = "point_on_line"
a = { link = "rod", xyz = [1.5, 0.0, 0.0] }
b = { link = "world" }
axis = [1.0, 0.0, 0.0]

[initial]
q = { hinge = 1.0 }
v = { hinge = 2.0 }
guess = { knee = -1.6 }

[simulation]
t_end = 1.0
"""

INERTIAL = """<inertial><origin xyz="1 0 0"/><mass value="1"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>"""
POINT_MASS = '<inertial><mass value="1"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>'


def changed(text: str, old: str, new: str) -> str:
    assert text.count(old) >= 1, f"{old!r} is not in the text to be changed"
    return text.replace(old, new, 1)


def write(folder: Path, toml: str | bytes = TOML, urdf: str | bytes = URDF) -> Path:
    for name, content in (("two_bars.urdf", urdf), ("two_bars.toml", toml)):
        data = content.encode() if isinstance(content, str) else content
        (folder / name).write_bytes(data)
    return folder / "two_bars.toml"


def loaded_or_refused(path: Path) -> srm.Mechanism | None:
    """The mechanism of ``path``, or None if that was refused in our own words."""
    try:
        return srm.load(path)
    except srm.SrmWarning:
        return None
    except srm.InputError as error:
        text = str(error)
    assert str(path.with_suffix("")) in text
    assert "Pinocchio cannot read" not in text
    return None


@pytest.fixture(autouse=True)
def parsers_are_silent(capfd: pytest.CaptureFixture[str]) -> Any:
    """What goes wrong is in the error, and not on the terminal in the words of a C++ library."""
    yield
    out, err = capfd.readouterr()
    assert out == ""
    assert err == ""


def check_refusals(
    family: str, folder: Path, faults: Mapping[str, tuple[str, str, dict[str, str]]]
) -> None:
    """Compare the messages about mechanisms, by case: TOML, URDF and options of ``srm.load``.

    Where the description is empty, the URDF is loaded by itself.
    """
    messages = {}
    for case, (toml, urdf, options) in faults.items():
        path = write(folder, toml, urdf)
        path = path if toml else path.with_suffix(".urdf")
        messages[case] = refused(partial(srm.load, path, **options), folder)
        assert messages[case].startswith(path.name)
    check_messages(family, messages)


def test_the_unchanged_mechanism_loads(tmp_path: Path) -> None:
    mechanism = srm.load(write(tmp_path))
    assert mechanism.joint_names == ("hinge", "knee")
    assert mechanism.degrees_of_freedom == 1


# --- the description ----------------------------------------------------------------------------

DESCRIPTION_FAULTS = {
    # case: (old, new) in the text of the description
    "unknown key": ("base =", "bases ="),
    "unknown key in a loop": ("axis =", "axes ="),
    "unknown key in an anchor": ('{ link = "world"', '{ lnk = "world"'),
    "unknown key in initial": ("v = {", "w = {"),
    "unknown key in simulation": ("t_end", "tend"),
    "unknown table": ("[simulation]", "[simulations]"),
    "a drive without a law": ("[simulation]", '[[drive]]\njoint = "hinge"\n[simulation]'),
    "an SDF": ("urdf =", 'sdf = "a.sdf"\nurdf ='),
    "an MJCF": ("urdf =", 'mjcf = "a.xml"\nurdf ='),
    "no format": ("format = 1\n", ""),
    "a later format": ("format = 1", "format = 2"),
    "a text for format": ("format = 1", 'format = "1"'),
    "no urdf": ('urdf = "two_bars.urdf"\n', ""),
    "an absent urdf": ("two_bars.urdf", "other.urdf"),
    "an absent urdf of Windows": ('"two_bars.urdf"', r"'C:\cad\other.urdf'"),
    "backslashes in double quotes": ("two_bars.urdf", r"C:\cad\other.urdf"),
    "a user of Windows": ("two_bars.urdf", r"C:\Users\other.urdf"),
    "a mistyped key": ('type = "point_on_line"', 'typ = "point_on_line"'),
    "a folder as urdf": ('"two_bars.urdf"', '"."'),
    "an empty urdf": ('"two_bars.urdf"', '""'),
    "a null in urdf": ("two_bars.urdf", "two\\u0000bars.urdf"),
    "an overlong urdf": ("two_bars.urdf", "a" * 5000),
    "an unknown base": ('"fixed"', '"fixd"'),
    "a number for base": ('"fixed"', "1"),
    "short gravity": ("[0.0, 0.0, -9.81]", "[0.0, -9.81]"),
    "long gravity": ("[0.0, 0.0, -9.81]", "[0, 0, 0, -9.81]"),
    "scalar gravity": ("[0.0, 0.0, -9.81]", "-9.81"),
    "a text in gravity": ("-9.81]", '"down"]'),
    "nan gravity": ("-9.81]", "nan]"),
    "infinite gravity": ("-9.81]", "-inf]"),
    "a huge gravity": ("-9.81]", "1e200]"),
    "a huge integer": ("-9.81]", "1" + "0" * 400 + "]"),
    "an endless integer": ("-9.81]", "1" + "0" * 9000 + "]"),
    "a text for lock": ("lock = []", 'lock = "knee"'),
    "an unknown lock": ("lock = []", 'lock = ["kneee"]'),
    "locked twice": ("lock = []", 'lock = ["knee", "knee"]'),
    "a link in lock": ("lock = []", 'lock = ["rod"]'),
    "a locked rate": ("lock = []", 'lock = ["hinge"]'),
    "one bracket": ("[[loop]]", "[loop]"),
    "no loop type": ('type = "point_on_line"\n', ""),
    "an unknown loop type": ('"point_on_line"', '"pointonline"'),
    "a number for type": ('"point_on_line"', "3"),
    "no anchor": ('b = { link = "world" }\n', ""),
    "an anchor that is a text": ('{ link = "world" }', '"world"'),
    "an empty anchor": ('{ link = "world" }', "{}"),
    "link and frame": ('{ link = "world" }', '{ link = "world", frame = "universe" }'),
    "an unknown link": ('"rod",', '"rd",'),
    "a joint as link": ('"rod",', '"knee",'),
    "an unknown frame": ('link = "world"', 'frame = "wrld"'),
    "short xyz": ("[1.5, 0.0, 0.0]", "[1.5, 0.0]"),
    "nan xyz": ("[1.5, 0.0, 0.0]", "[nan, 0, 0]"),
    "huge xyz": ("[1.5, 0.0, 0.0]", "[1e300, 0, 0]"),
    "xyz as in URDF": ("[1.5, 0.0, 0.0]", '"1.5 0 0"'),
    "no axis": ("axis = [1.0, 0.0, 0.0]\n", ""),
    "a zero axis": ("axis = [1.0", "axis = [0.0"),
    "a superfluous axis": ('"point_on_line"', '"point"'),
    "both ends on one body": ('"world" }', '"rod" }'),
    "an unknown joint in q": ("hinge = 1.0", "hing = 1.0"),
    "an unknown joint in v": ("hinge = 2.0", "hing = 2.0"),
    "an unknown guess": ("knee = -1.6", "kne = 0"),
    "held and guessed": ("knee = -1.6", "hinge = 1.0"),
    "a text as angle": ("hinge = 1.0", 'hinge = "1"'),
    "true as angle": ("hinge = 1.0", "hinge = true"),
    "nan as angle": ("hinge = 1.0", "hinge = nan"),
    "a table as angle": ("hinge = 1.0", "hinge = {}"),
    "a date as angle": ("= 1.0", "= 1979-05-27"),
    "no angle": ("hinge = 1.0", "hinge = []"),
    "two angles": ("= 1.0 }", "= [1, 2] }"),
    "two guesses": ("= -1.6", "= [1, 2]"),
    "two rates": ("= 2.0", "= [1, 2]"),
    "a list as initial": ("[initial]", "[[initial]]"),
    "zero friction speed": ("lock = []", "friction_speed = 0"),
    "weight of an unknown link": ("lock = []", "gravity_compensation = { arm = 1.0 }"),
    "weight that is no number": ("lock = []", 'gravity_compensation = { rod = "all" }'),
    "negative t_end": ("t_end = 1.0", "t_end = -1"),
    "zero rtol": ("t_end = 1.0", "rtol = 0"),
    "infinite t_end": ("t_end = 1.0", "t_end = inf"),
    "a text as atol": ("t_end = 1.0", 'atol = "1"'),
    "a number as name": ('"two_bars"', "2"),
    "a key twice": ("base =", "name = 'x'\nbase ="),
    "broken TOML": ("format = 1", "format = = 1"),
    "endless nesting": ("lock = []", "lock = " + "[" * 20000),
    **{
        f"a key like a type, {name}": ("hinge = 1.0", f'"{name}" = "x"')
        for name in ("float_arm", "int_1", "function_x", "constrained", "list[a]")
    },
}
LOOP = TOML[TOML.index("[[loop]]") : TOML.index("[initial]")]
NAMELESS = changed(LOOP, 'name = "pin"\n', "")
LOCKED = TOML.replace("lock = []", 'lock = ["knee"]').replace("knee = -1.6", "knee = 0.3")
CONTRADICTIONS = {
    # case: TOML, URDF
    "a loop without name and axis": (
        changed(TOML, LOOP, NAMELESS.replace("axis = [1.0", "axis = [0.0")),
        URDF,
    ),
    "a loop without name and anchor": (
        changed(TOML, LOOP, NAMELESS.replace('{ link = "world" }', "{ }")),
        URDF,
    ),
    "a loop name twice": (changed(TOML, LOOP, LOOP + LOOP), URDF),
    "a default loop name twice": (changed(TOML, LOOP, NAMELESS + NAMELESS), URDF),
    # A joint called as the link of the other joint: the two frames differ.
    "a frame name with two meanings": (
        TOML.replace("hinge", "rod").replace('link = "rod"', 'frame = "rod"'),
        URDF.replace('"hinge"', '"rod"'),
    ),
    "everything locked": (
        TOML.replace("lock = []", 'lock = ["hinge", "knee"]')
        .replace("v = { hinge = 2.0 }", "")
        .replace(LOOP, ""),
        URDF,
    ),
    "a loop that locking holds open": (LOCKED, URDF),
    "a loop within a locked body": (LOCKED.replace('"world"', '"crank"'), URDF),
    # Three axes of one ball, the outer two in line: the mass matrix is singular there.
    "a start in gimbal lock": (
        'format = 1\nurdf = "two_bars.urdf"\n[[loop]]\nname = "hook"\ntype = "point"\n'
        'a = { link = "rod", xyz = [1.0, 0.0, 0.0] }\nb = { link = "world", xyz = [0, 0, -1.0] }\n'
        "[initial]\nq = { y = 1.5707963267948966 }\n",
        f'<robot name="ball"><link name="base"/><link name="u"/><link name="w"/>'
        f'<link name="rod">{INERTIAL.replace("1 0 0", "1 0.2 0.1")}</link>'
        + "".join(
            f'<joint name="{name}" type="continuous"><parent link="{parent}"/>'
            f'<child link="{child}"/><axis xyz="{axis}"/></joint>'
            for name, parent, child, axis in (
                ("z", "base", "u", "0 0 1"),
                ("y", "u", "w", "0 1 0"),
                ("x", "w", "rod", "1 0 0"),
            )
        )
        + "</robot>",
    ),
}


def test_a_faulty_description_is_refused_by_key(tmp_path: Path) -> None:
    faults = {
        fault: (changed(TOML, old, new), URDF, {})
        for fault, (old, new) in DESCRIPTION_FAULTS.items()
    }
    check_refusals("descriptions", tmp_path, faults)


def test_a_description_that_contradicts_itself_or_its_urdf_is_refused(tmp_path: Path) -> None:
    faults = {fault: (*texts, {}) for fault, texts in CONTRADICTIONS.items()}
    check_refusals("contradictions", tmp_path, faults)


def test_a_loop_that_locking_holds_open_has_the_gap_of_its_anchors(tmp_path: Path) -> None:
    with pytest.raises(srm.AssemblyError) as caught:
        srm.load(write(tmp_path, LOCKED))
    height = np.sin(1.0) + 1.5 * np.sin(1.3)  # of the tip
    assert caught.value.residuals == {"pin": (pytest.approx(height, rel=1e-12), None)}
    assert caught.value.held == ("hinge",)


def test_cutting_a_description_anywhere_raises_nothing_else(tmp_path: Path) -> None:
    for at in range(0, len(TOML), 7):
        for text in (TOML[:at], TOML[:at] + TOML[at + 5 :]):
            loaded_or_refused(write(tmp_path, text))


# --- files --------------------------------------------------------------------------------------


CONTENTS = {
    # not UTF-8
    "every byte": bytes(range(256)),
    "UTF-16": TOML.encode("utf-16"),
    "a mark of UTF-16": b"\xff\xfe",
    "Latin": "grün".encode("latin-1"),
    # another kind of file
    "zeros": b"\0\0\0\0",
    "a program": b"\x7fELF\x02\x01",
    "a word": b"hello",
    "nothing": b"",
    "COLLADA": b'<?xml version="1.0"?><!-- a --><COLLADA/>',
}


def test_what_is_no_file_of_a_mechanism_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = {}

    def load(case: str, name: str) -> None:
        messages[case] = refused(partial(srm.load, tmp_path / name), tmp_path)

    for name in ("absent.toml", "absent.urdf"):
        load(name, name)
    for name in ("folder.toml", "folder.urdf", "folder"):
        (tmp_path / name).mkdir()
        load(name, name)
    for case, content in CONTENTS.items():
        for name in ("file.toml", "file.urdf", "file"):
            (tmp_path / name).write_bytes(content)
            load(f"{case} in {name}", name)
    srm.simulate(srm.load("four_bar"), 0.1).save(tmp_path / "run.npz")
    load("a saved run", "run.npz")
    load("a binary URDF of a description", write(tmp_path, urdf=bytes(range(256))).name)

    def denied(*_: Any, **__: Any) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", denied)
    for name in ("secret.toml", "secret.urdf"):
        load(name, name)
    monkeypatch.undo()
    check_messages("files", messages)


def test_a_path_relative_to_the_working_folder_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "robot.txt").write_text("links and joints")
    monkeypatch.chdir(tmp_path)
    message = refused(partial(srm.load, "./robot.txt"))
    assert message.startswith("robot.txt: a file of type '.txt'")


@pytest.mark.parametrize("name", ["slider-crank", "", "n_four_bar_0", "n_four_bar_x", "Four_bar"])
def test_an_unknown_bundled_name_lists_the_known_ones(name: str) -> None:
    with pytest.raises(srm.InputError) as caught:
        srm.load(name)
    for needle in (repr(name), "slider_crank", "four_bar", "the path of a file"):
        assert needle in str(caught.value)


@pytest.mark.parametrize("path", [None, 3, 1.5, "a\0b.toml", "a\0b.urdf", "a\0b", "/\0"])
def test_what_cannot_be_a_path_is_refused(path: Any) -> None:
    with pytest.raises(srm.InputError):
        srm.load(path)


@pytest.mark.parametrize("n", [0, -1, 1.5, "2", None])
def test_an_n_four_bar_needs_a_positive_number_of_loops(n: Any) -> None:
    with pytest.raises(srm.InputError, match="is not a positive whole number of loops"):
        srm.n_four_bar(n)


# --- arguments ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "gravity",
    [
        "down",
        9.81,
        [],
        [0.0, -9.81],
        [0.0, 0.0, 0.0, -9.81],
        [0.0, 0.0, "x"],
        [0.0, 0.0, float("nan")],
        [0.0, 0.0, float("-inf")],
        [0.0, 0.0, 1e200],
        [0, 0, 10**400],
        [[0.0], [0.0], [1.0]],
        [0.0, [0.0, 1.0], 0.0],
        {"z": -9.81},
        object(),
    ],
    ids=lambda value: str(value)[:20],
)
def test_a_gravity_that_is_not_three_finite_numbers_is_refused(
    gravity: Any, tmp_path: Path
) -> None:
    message = refused(partial(srm.load, write(tmp_path), gravity=gravity), tmp_path)
    assert "gravity = " in message
    assert message.endswith("is not three finite numbers. Give [x, y, z] in m/s^2")


@pytest.mark.parametrize("base", ["", "Fixed", 1, ["fixed"], True, b"fixed"], ids=repr)
def test_an_unknown_base_is_refused(base: Any, tmp_path: Path) -> None:
    message = refused(partial(srm.load, write(tmp_path), base=base), tmp_path)
    assert message.endswith(f"there is no base {base!r}. Known: fixed, floating, planar")


# --- the URDF -----------------------------------------------------------------------------------

END = "</robot>"
LINK_C = f'<link name="c">{INERTIAL}</link>'


def joint_c(kind: str, inside: str = "", link: str = LINK_C, name: str = "c") -> str:
    ends = '<parent link="rod"/><child link="c"/>'
    return f'{link}<joint name="{name}" type="{kind}">{ends}{inside}</joint>{END}'


AXIS = '<axis xyz="0 -1 0"/>\n    <limit'
URDF_FAULTS = {
    # loops and couplings of other tools
    # (those that are read, and their faults: test_urdf_loops.py)
    "loop in a joint": (AXIS, "<loop/>" + AXIS),
    "drake with a namespace": (END, '<drake:loop_joint xmlns:drake="http://drake.mit.edu"/>' + END),
    "drake bushing": (END, '<drake:linear_bushing_rpy xmlns:drake="http://drake.mit.edu"/>' + END),
    "drake without a namespace": (END, "<drake:loop/>" + END),
    "gazebo joint": (END, '<gazebo><joint name="x" type="revolute"/></gazebo>' + END),
    "gazebo joint inside a model": (
        END,
        '<gazebo><model><joint name="x"><child>rod</child></joint></model></gazebo>' + END,
    ),
    "mimic": (AXIS, '<mimic joint="knee" multiplier="x"/>' + AXIS),
    "xacro": (END, '<xacro:macro xmlns:xacro="http://wiki.ros.org/xacro"/>' + END),
    # elements and attributes
    "unknown element": (END, "<lnk/>" + END),
    "unknown element in a link": ("<inertial>", "<inertal/><inertial>"),
    "unknown element in a joint": (AXIS, "<axes/>" + AXIS),
    "unknown element in inertial": ("<mass", "<weight/><mass"),
    "origin in a link": ('<link name="base"/>', '<link name="base"><origin xyz="0 0 1"/></link>'),
    "xzy": ('xyz="0.5', 'xzy="0.5'),
    "xzy in a joint": ('xyz="1 0 0"/>', 'xzy="1 0 0"/>'),
    "xzy in an axis": ('axis xyz="0', 'axis xzy="0'),
    "valeu": ("mass value", "mass valeu"),
    "ixyy": ('ixy="0"', 'ixyy="0"'),
    "lnk": ("parent link", "parent lnk"),
    "lowr": ("lower", "lowr"),
    "dampin": ("damping", "dampin"),
    "nameless robot": ("two_bars", ""),
    "a later version": ('"two_bars"', '"two_bars" version="2.0"'),
    "a default namespace": ('"two_bars"', '"two_bars" xmlns="http://x"'),
    "two masses": ('<mass value="1"/>', '<mass value="1"/><mass value="2"/>'),
    "two inertials": ("<inertial>", INERTIAL + "<inertial>"),
    "two axes": (AXIS, '<axis xyz="1 0 0"/>' + AXIS),
    "two children": ('<child link="crank"/>', '<child link="crank"/><child link="rod"/>'),
    # numbers
    "nan mass": ('mass value="1"', 'mass value="nan"'),
    "infinite mass": ('mass value="1"', 'mass value="inf"'),
    "overflowing mass": ('mass value="1"', 'mass value="1e400"'),
    "huge mass": ('mass value="1"', 'mass value="1e31"'),
    "negative mass": ('mass value="1"', 'mass value="-1"'),
    "textual mass": ('mass value="1"', 'mass value="one"'),
    "empty mass": ('mass value="1"', 'mass value=""'),
    "mass with a unit": ('mass value="1"', 'mass value="1 kg"'),
    "decimal comma": ('mass value="1"', 'mass value="1,5"'),
    "grouped digits": ('mass value="1"', 'mass value="1_0"'),
    "hexadecimal mass": ('mass value="1"', 'mass value="0x1"'),
    "other digits": ('mass value="1"', 'mass value="\uff11"'),
    "no mass": ('<mass value="1"/>', ""),
    "no mass value": ('<mass value="1"/>', "<mass/>"),
    "no inertia": ('<inertia ixx="0.001" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>', ""),
    "no iyz": (' iyz="0"', ""),
    "nan inertia": ('iyy="0.1"', 'iyy="nan"'),
    "negative inertia": ('iyy="0.1"', 'iyy="-0.1"'),
    "indefinite inertia": ('ixy="0"', 'ixy="0.2"'),
    "two coordinates": ('xyz="0.5 0 0"', 'xyz="0.5 0"'),
    "four coordinates": ('xyz="1 0 0"', 'xyz="1 0 0 0"'),
    "commas": ('xyz="1 0 0"', 'xyz="1, 0, 0"'),
    "nan rpy": ('rpy="0 0 0"/>\n    <axis', 'rpy="0 0 nan"/>\n    <axis'),
    "zero axis": ("0 -1 0", "0 0 0"),
    "nan axis": ("0 -1 0", "0 nan 0"),
    "turned axis": ('xyz="0 -1 0"', 'xyz="0 -1 0" rpy="0 0 1"'),
    "nan limit": ('lower="-10"', 'lower="nan"'),
    "negative effort": ('effort="1"', 'effort="-1"'),
    "negative velocity": ('velocity="1"', 'velocity="-2"'),
    "negative damping": ('"0.5"', '"-0.5"'),
    "nan damping": ('"0.5"', '"nan"'),
    "negative friction": ('"0.5"', '"0.5" friction="-1"'),
    "nan friction": ('"0.5"', '"0.5" friction="nan"'),
    # the tree
    "no limit": ('<limit lower="-10" upper="10" effort="1" velocity="1"/>', ""),
    "no effort": (' effort="1"', ""),
    "no joint type": (' type="revolute"', ""),
    "unknown joint type": ('"revolute"', '"hinge"'),
    "ball joint": (END, joint_c("ball")),
    "planar along x": (END, joint_c("planar")),
    "planar along y": (END, joint_c("planar", '<axis xyz="0 1 0"/>')),
    "planar downwards": (END, joint_c("planar", '<axis xyz="0 0 -1"/>')),
    "joint without name": ('name="hinge" ', ""),
    "link without name": ('<link name="base"/>', "<link/>"),
    "two joints of one name": ('"knee"', '"hinge"'),
    "two links of one name": ('<link name="rod"', '<link name="crank"'),
    "no parent": ('<parent link="base"/>', ""),
    "unknown parent": ('parent link="base"', 'parent link="bas"'),
    "unknown child": ('child link="rod"', 'child link="rd"'),
    "its own parent": ('parent link="crank"', 'parent link="rod"'),
    "ring": ('parent link="base"', 'parent link="rod"'),
    "two roots": (END, '<link name="spare"/>' + END),
    "moving world": (END, joint_c("fixed").replace('"c"', '"world"')),
    "moving universe": (END, joint_c("fixed").replace('"c"', '"universe"')),
    "joint called universe": (END, joint_c("fixed", name="universe")),
    # inertia
    "massless end": (END, joint_c("continuous", link='<link name="c"/>')),
    "massless chain at the end": (
        END,
        joint_c("fixed", link='<link name="c"/><link name="d"/>').replace(END, "")
        + '<joint name="d" type="prismatic"><parent link="c"/><child link="d"/>'
        + '<limit effort="1" velocity="1"/></joint>'
        + END,
    ),
    "point mass on its axis": (
        END,
        joint_c("continuous", link=f'<link name="c">{POINT_MASS}</inertial></link>'),
    ),
    # the file
    "another root element": ("<robot", "<model"),
    "entities": ('<?xml version="1.0"?>', '<!DOCTYPE robot [<!ENTITY a "b">]>'),
    "truncated": ("</robot>", ""),
    "unquoted attribute": ('"two_bars"', "two_bars"),
}


def test_a_faulty_urdf_is_refused_by_element(tmp_path: Path) -> None:
    messages = {}
    for fault, (old, new) in URDF_FAULTS.items():
        path = write(tmp_path, urdf=changed(URDF, old, new))
        messages[fault] = refused(partial(srm.load, path.with_suffix(".urdf")), tmp_path)
        assert messages[fault].startswith("two_bars.urdf: ")
        # The same through a description, whose own faults come later.
        assert refused(partial(srm.load, path), tmp_path) == messages[fault]
    check_messages("urdf", messages)


def with_fixed_chain(links: int) -> str:
    chain = "".join(
        f'<link name="l{i}"/><joint name="l{i}" type="fixed">'
        f'<parent link="{f"l{i - 1}" if i else "rod"}"/><child link="l{i}"/></joint>'
        for i in range(links)
    )
    return changed(URDF, END, chain + END)


ROCK = f'<robot name="rock"><link name="base">{INERTIAL}</link></robot>'
ROOT_JOINT = URDF.replace('"knee"', '"root_joint"')
WORLD = URDF.replace('<link name="base"/>', f'<link name="world">{INERTIAL}</link>').replace(
    '"base"', '"world"'
)
RING = "".join(
    f'<link name="r{i}"/><joint name="r{i}" type="fixed"><parent link="r{(i + 1) % 3}"/>'
    f'<child link="r{i}"/></joint>'
    for i in range(3)
)
ENDS = {"gazebo><plugin": "</plugin></gazebo>"}
WHOLE_URDFS: dict[str, tuple[str, dict[str, str]]] = {
    # case: URDF, options of load
    **{f"another root {root}": (root, {}) for root in ("<world version='1.6'/>", "<gazebo/>")},
    "no links": ('<robot name="nothing"/>', {}),
    "no joints": (ROCK, {}),
    "a ring beside the tree": (changed(URDF, END, RING + END), {}),
    "a chain of 1200 joints": (with_fixed_chain(1200), {}),
    "a chain of 30000 joints": (with_fixed_chain(30000), {}),
    "deeply nested": ("<robot>" * 100_000, {}),
    **{
        f"{case}, {base}": (urdf, {"base": base})
        for case, urdf in (("a joint called root_joint", ROOT_JOINT), ("a link world", WORLD))
        for base in ("floating", "planar")
    },
    # Of a massless base, the turn about the first hinge is not determined.
    "a floating base without inertia": (URDF, {"base": "floating"}),
    # A renamed <inertial> would leave a massless link behind, without a word.
    **{
        f"inertia inside {drawn}": (
            URDF.replace("<inertial>", f"<{drawn}>", 1).replace("</inertial>", f"</{drawn}>", 1),
            {},
        )
        for drawn in ("visual", "collision")
    },
    **{
        f"{inner} inside {outer}": (
            changed(
                URDF, END, f'<{outer}><{inner} name="x"/>{ENDS.get(outer, f"</{outer}>")}{END}'
            ),
            {},
        )
        for outer in ("gazebo", "transmission", "gazebo><plugin", "sensor")
        for inner in ("loop_joint", "loop", "constraint", "coupling", "mimic")
    },
}


def test_a_urdf_that_is_wrong_as_a_whole_is_refused(tmp_path: Path) -> None:
    faults = {case: ("", *fault) for case, fault in WHOLE_URDFS.items()}
    check_refusals("whole_urdfs", tmp_path, faults)


@pytest.mark.parametrize(
    ("urdf", "base", "joints"),
    [
        (with_fixed_chain(900), "fixed", ("hinge", "knee")),
        (ROCK, "floating", ("root_joint",)),
        (ROOT_JOINT, "fixed", ("hinge", "root_joint")),
        (WORLD, "fixed", ("hinge", "knee")),
    ],
    ids=["deep chain", "rock", "root_joint", "world"],
)
def test_what_resembles_such_a_urdf_loads(
    urdf: str, base: str, joints: tuple[str, ...], tmp_path: Path
) -> None:
    path = write(tmp_path, urdf=urdf).with_suffix(".urdf")
    assert srm.load(path, base=base).joint_names == joints


def test_a_point_mass_off_its_axis_is_no_fault(tmp_path: Path) -> None:
    """Zero principal moments are those of a pendulum's bob."""
    link = POINT_MASS.replace("<inertial>", '<inertial><origin xyz="0.3 0 0"/>') + "</inertial>"
    joint = joint_c("continuous", '<axis xyz="0 1 0"/>', f'<link name="c">{link}</link>')
    path = write(tmp_path, urdf=changed(URDF, END, joint)).with_suffix(".urdf")
    assert srm.load(path).model.inertias[3].mass == 1.0


def test_inertia_that_no_body_has_is_a_warning(tmp_path: Path) -> None:
    path = write(tmp_path, urdf=changed(URDF, 'iyy="0.1"', 'iyy="0.3"')).with_suffix(".urdf")
    with pytest.warns(srm.SrmWarning, match=r"two_bars\.urdf: link 'crank'.*triangle inequality"):
        mechanism = srm.load(path)
    assert any("'crank'" in note and "triangle" in note for note in mechanism.notes)


def test_limits_that_leave_nothing_between_them_are_noted(tmp_path: Path) -> None:
    (tmp_path / "two_bars.urdf").write_text(URDF.replace('lower="-10"', 'lower="11"'))
    (note,) = srm.load(tmp_path / "two_bars.urdf").notes
    assert note == "joint 'hinge': its limits are none: lower = 11 is above upper = 10"


def test_cutting_a_urdf_anywhere_raises_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "cut.urdf"
    for at in range(0, len(URDF), 13):
        for text in (URDF[:at], URDF[:at] + URDF[at + 6 :], URDF[:at] + "x" + URDF[at:]):
            path.write_text(text)
            loaded_or_refused(path)


@pytest.mark.parametrize("seed", range(4))
def test_damaged_urdfs_load_or_are_refused(seed: int, tmp_path: Path) -> None:
    """Words of the file replaced by words of the file, and numbers by odd numbers."""
    rng = np.random.default_rng(seed)
    words = URDF.split('"')
    odd = ["-1", "0", "1e30", "-1e-30", "nan", "", "0 0 0", "1 2 3", "base", "rod", "knee", "\t"]
    path = tmp_path / "damaged.urdf"
    for _ in range(60):
        damaged = list(words)
        for _ in range(rng.integers(1, 4)):
            at = 2 * int(rng.integers(len(words) // 2)) + 1
            damaged[at] = str(rng.choice(odd))
        path.write_text('"'.join(damaged))
        mechanism = loaded_or_refused(path)
        if mechanism is not None:
            M = pin.crba(mechanism.model, mechanism.model.createData(), mechanism.q0)
            assert np.isfinite(M).all()


def test_joints_out_of_depth_first_order_are_refused() -> None:
    """Pinocchio's crba takes them without a word and returns a wrong mass matrix."""
    model = pin.Model()
    body = pin.Inertia(1.0, np.array([0.5, 0.0, 0.0]), 0.1 * np.eye(3))
    for name, parent in (("a", 0), ("b", 1), ("c", 1), ("d", 2)):  # d continues b after c
        joint = model.addJoint(parent, pin.JointModelRY(), pin.SE3.Identity(), name)
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    with pytest.raises(srm.InputError, match=r"'d' continues a branch.*'c'.*depth first"):
        srm.Mechanism(model)


@pytest.mark.parametrize(
    "made",
    [
        lambda: srm.LoopClosure("point", "rod", srm.Anchor("world")),
        lambda: srm.SpringDamper("crank", "world", 1.0, rest_length=1.0),
        lambda: srm.Bushing(srm.Anchor("crank"), "world", (1.0,) * 6),
        lambda: srm.Wrench("crank", (1.0, 0.0, 0.0)),
        lambda: srm.UserForce(lambda t, q, v: np.zeros(6), at="crank"),
        lambda: srm.Drive(srm.ConstantSpeed(1.0), a="crank", b="world", distance=True),
    ],
)
def test_a_name_in_the_place_of_an_anchor_is_refused(made: Any) -> None:
    with pytest.raises(srm.InputError, match=r"is not an anchor. Give for example srm.Anchor\("):
        made()


@pytest.mark.parametrize("given", [pin.Model(), None, 3, b"four_bar", ["four_bar"]], ids=repr)
def test_what_is_no_name_and_no_path_is_not_searched_among_the_bundled_names(given: Any) -> None:
    with pytest.raises(srm.InputError) as caught:
        srm.load(given)
    assert f"{type(given).__name__} is not a type of names and paths" in str(caught.value)
    assert "srm.Mechanism takes a pinocchio.Model" in str(caught.value)


def test_numbers_with_masked_elements_are_refused() -> None:
    """What lies below the mask is no number of the state."""
    mechanism = srm.load("four_bar")
    whole = np.ma.array(mechanism.q0)
    assert srm.simulate(mechanism, 0.1, q0=whole).success
    with pytest.raises(srm.InputError, match="q0 does not consist of 3 finite numbers"):
        srm.simulate(mechanism, 0.1, q0=np.ma.array(mechanism.q0, mask=[False, True, False]))


def chain_of_two(first: str, second: str) -> pin.Model:
    model = pin.Model()
    for parent, name in enumerate((first, second)):
        joint = model.addJoint(parent, pin.JointModelRY(), pin.SE3.Random(), name)
        body = pin.Inertia(1.0, np.array([0.5, 0.0, 0.0]), 0.1 * np.eye(3))
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    return model


def test_joints_of_one_name_are_refused() -> None:
    with pytest.raises(srm.InputError, match="model: 2 joints have the name 'knee'"):
        srm.Mechanism(chain_of_two("knee", "knee"))
    with pytest.raises(srm.InputError, match="model: 2 joints have the name 'universe'"):
        srm.Mechanism(chain_of_two("knee", "universe"))


def test_a_mimic_joint_is_refused_by_name_with_the_closure_that_does_the_same() -> None:
    model = chain_of_two("hip", "knee")
    mimicking = pin.transformJointIntoMimic(model, 1, 2, 2.0, 0.0)
    with pytest.raises(srm.InputError, match=r"'knee' is a Pinocchio mimic joint.*\"coupling\""):
        srm.Mechanism(mimicking)


class OwnSpring(srm.TorsionSpring):
    """Another law would be neither in the kernel nor in saved runs."""


class OwnForce(srm.ForceElement):
    """A force element whose force the equations do not know."""

    type, name = "own", "own"

    def check(self, model: pin.Model) -> None:
        pass


@pytest.mark.parametrize(
    ("what", "given"),
    [
        ("forces", srm.TorsionSpring("crank", 1.0)),
        ("forces", ["torsion_spring"]),
        ("forces", [lambda t, q, v: v]),
        ("drives", srm.Drive(srm.ConstantSpeed(1.0), "crank")),
        ("drives", "crank"),
        ("loops", srm.LoopClosure("point", srm.Anchor("coupler"), srm.Anchor("world"))),
        ("loops", [srm.TorsionSpring("crank", 1.0)]),
        ("drives", [srm.TorsionSpring("crank", 1.0)]),
        ("forces", [srm.Drive(srm.ConstantSpeed(1.0), "crank")]),
        ("forces", [OwnForce()]),
    ],
)
def test_elements_that_are_no_list_of_them_are_refused(what: str, given: Any) -> None:
    mechanism = srm.load("four_bar")
    with pytest.raises(srm.InputError, match=f"{what} = .* is not a list of {what}"):
        replace(mechanism, **{what: given})


class OwnClosure(srm.LoopClosure):
    """Would have other rows, if anything read them."""


class OwnDrive(srm.Drive):
    """Would have another motion."""


@pytest.mark.parametrize(
    ("what", "given"),
    [
        ("loops", OwnClosure("point", srm.Anchor("coupler"), srm.Anchor("world"))),
        ("drives", OwnDrive(srm.ConstantSpeed(1.0), "crank")),
        ("forces", OwnSpring("crank", 1.0)),
    ],
)
def test_an_element_of_a_subclass_is_refused_by_the_name_of_its_class(
    what: str, given: Any
) -> None:
    kind, base = type(given).__name__, type(given).__mro__[1].__name__
    said = (
        rf"{what}\[0\]: the class '{kind}' inherits from {base}, .* Give an object of {base} itself"
    )
    with pytest.raises(srm.InputError, match=said):
        replace(srm.load("four_bar"), **{what: [given]})


def test_a_force_element_of_ones_own_is_answered_with_the_user_force() -> None:
    with pytest.raises(srm.InputError, match=r"srm\.UserForce\(\.\.\.\)"):
        replace(srm.load("four_bar"), forces=[OwnForce()])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"gravity": [np.nan, 0.0, 0.0]}, "the gravity of the model is not finite"),
        ({"damping": [np.nan, 0.0, 0.0]}, "the damping of the model is not finite"),
        ({"damping": [0.0, -0.1, 0.0]}, "damping of the joint 'coupler' is negative"),
    ],
)
def test_gravity_and_damping_are_finite_and_damping_does_not_drive(
    change: dict[str, list[float]], problem: str
) -> None:
    mechanism = srm.load("four_bar")
    model = mechanism.model.copy()
    model.gravity.linear = np.array(change.get("gravity", model.gravity.linear))
    model.damping = np.array(change.get("damping", model.damping))
    with pytest.raises(srm.InputError, match=problem):
        replace(mechanism, model=model)


@pytest.mark.parametrize("progress", [3, "yes", None])
def test_progress_is_a_boolean_or_a_function(progress: Any) -> None:
    four_bar = srm.load("four_bar")
    circle = srm.SemiExplicitDAE(
        f=lambda t, x: np.array([x[0] - x[1], x[0] + x[1]]),
        B=lambda t, x: x,
        g=lambda t, x: 0.5 * (x @ x - 1.0),
        G=lambda t, x: x,
    )
    for call in (
        lambda: srm.simulate(four_bar, 0.1, progress=progress),
        lambda: srm.sweep(four_bar, [{}], 0.1, progress=progress),
        lambda: srm.solve_dae(circle, (0.0, 0.1), [1.0, 0.0], progress=progress),
    ):
        with pytest.raises(srm.InputError, match=f"progress = {progress!r} is neither"):
            call()
