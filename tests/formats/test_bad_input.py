"""Bad descriptions, URDFs and arguments: one clear error each, naming file, element and remedy."""

from __future__ import annotations

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


def refusal(path: Any, *needles: str, file: str | None = None, **options: Any) -> srm.InputError:
    """The error of ``srm.load(path)``; it names the file, every needle, and a remedy."""
    with pytest.raises(srm.InputError) as caught:
        srm.load(path, **options)
    error = caught.value
    assert type(error) in (srm.InputError, srm.AssemblyError)
    text = str(error)
    expected = Path(path).name if file is None else file
    assert error.file is not None
    assert error.file.endswith(expected)
    assert text.startswith(error.file)
    for needle in needles:
        assert needle in text, f"{needle!r} is not in: {text}"
    assert error.remedy, f"no remedy in: {text}"
    assert text.endswith(error.remedy)
    assert "Traceback" not in text
    assert "pydantic" not in text.lower()
    return error


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
    "negative t_end": ("t_end = 1.0", "t_end = -1"),
    "zero rtol": ("t_end = 1.0", "rtol = 0"),
    "infinite t_end": ("t_end = 1.0", "t_end = inf"),
    "a text as atol": ("t_end = 1.0", 'atol = "1"'),
    "a number as name": ('"two_bars"', "2"),
    "a key twice": ("base =", "name = 'x'\nbase ="),
    "broken TOML": ("format = 1", "format = = 1"),
    "endless nesting": ("lock = []", "lock = " + "[" * 20000),
}


def test_a_faulty_description_is_refused_by_key(tmp_path: Path) -> None:
    messages = {}
    for fault, (old, new) in DESCRIPTION_FAULTS.items():
        path = write(tmp_path, changed(TOML, old, new))
        messages[fault] = refused(partial(srm.load, path), tmp_path)
        assert messages[fault].startswith(path.name)
    check_messages("descriptions", messages)


@pytest.mark.parametrize("name", ["float_arm", "int_1", "function_x", "constrained", "list[a]"])
def test_a_key_is_named_even_where_it_resembles_a_type(name: str, tmp_path: Path) -> None:
    path = write(tmp_path, changed(TOML, "hinge = 1.0", f'"{name}" = "x"'))
    refusal(path, f"initial.q.{name}:")


def test_a_loop_without_name_is_called_by_its_number(tmp_path: Path) -> None:
    text = changed(changed(TOML, 'name = "pin"\n', ""), "axis = [1.0", "axis = [0.0")
    refusal(write(tmp_path, text), "loop", "the axis is zero")
    text = changed(changed(TOML, 'name = "pin"\n', ""), '{ link = "world" }', "{ }")
    refusal(write(tmp_path, text), "loop[0], anchor b", "link or a frame")


LOOP = TOML[TOML.index("[[loop]]") : TOML.index("[initial]")]


def test_a_loop_name_used_twice_is_refused(tmp_path: Path) -> None:
    refusal(write(tmp_path, changed(TOML, "[initial]", LOOP + "[initial]")), "'pin'", "twice")


def test_a_default_loop_name_used_twice_is_refused(tmp_path: Path) -> None:
    nameless = changed(LOOP, 'name = "pin"\n', "")
    text = changed(TOML, LOOP, nameless + nameless)
    refusal(write(tmp_path, text), "'point_on_line_rod_world'", "Give every loop its own name")


def test_a_frame_name_with_two_meanings_is_refused(tmp_path: Path) -> None:
    # A joint called as the link of the other joint: the two frames differ.
    urdf = URDF.replace('"hinge"', '"rod"')
    text = TOML.replace("hinge", "rod").replace('link = "rod"', 'frame = "rod"')
    refusal(write(tmp_path, text, urdf), "loop[0].a.frame", "'rod'", "write link =")


def test_locking_everything_leaves_nothing_to_simulate(tmp_path: Path) -> None:
    text = TOML.replace("lock = []", 'lock = ["hinge", "knee"]').replace("v = { hinge = 2.0 }", "")
    refusal(write(tmp_path, text.replace(LOOP, "")), "can move", "locked")


def test_a_loop_that_locking_holds_open_names_the_locked_joints(tmp_path: Path) -> None:
    text = TOML.replace("lock = []", 'lock = ["knee"]').replace("knee = -1.6", "knee = 0.3")
    error = refusal(write(tmp_path, text), "'hinge'", "pin: 2.29 m", "Locked", "'knee'")
    # The height of the tip.
    height = np.sin(1.0) + 1.5 * np.sin(1.3)
    assert isinstance(error, srm.AssemblyError)
    assert error.residuals == {"pin": (pytest.approx(height, rel=1e-12), None)}
    assert error.held == ("hinge",)


def test_a_loop_within_a_locked_body_is_refused(tmp_path: Path) -> None:
    text = TOML.replace("lock = []", 'lock = ["knee"]').replace("knee = -1.6", "knee = 0.3")
    refusal(write(tmp_path, text.replace('"world"', '"crank"')), "'pin'", "same body")


def test_cutting_a_description_anywhere_raises_nothing_else(tmp_path: Path) -> None:
    for at in range(0, len(TOML), 7):
        for text in (TOML[:at], TOML[:at] + TOML[at + 5 :]):
            loaded_or_refused(write(tmp_path, text))


# --- files --------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".toml", ".urdf"])
def test_an_absent_file_is_named(suffix: str, tmp_path: Path) -> None:
    refusal(tmp_path / f"absent{suffix}", "no such file", "Check the path")


@pytest.mark.parametrize("name", ["folder.toml", "folder.urdf", "folder"])
def test_a_folder_is_not_a_mechanism(name: str, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    refusal(tmp_path / name, "irectory")


@pytest.mark.parametrize("suffix", [".toml", ".urdf"])
def test_an_unreadable_file_is_named(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(*_: Any, **__: Any) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_text", denied)
    refusal(tmp_path / f"secret{suffix}", "cannot be read: Permission denied", "readable file")


@pytest.mark.parametrize("suffix", [".toml", ".urdf"])
@pytest.mark.parametrize(
    "content", [bytes(range(256)), TOML.encode("utf-16"), b"\xff\xfe", "grün".encode("latin-1")]
)
def test_a_file_that_is_not_utf8_is_named(content: bytes, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"binary{suffix}"
    path.write_bytes(content)
    refusal(path, "not UTF-8", "Save it as UTF-8")


def test_a_saved_run_in_place_of_a_mechanism_is_told_what_it_is_for(tmp_path: Path) -> None:
    srm.simulate(srm.load("four_bar"), 0.1).save(tmp_path / "run.npz")
    refusal(tmp_path / "run.npz", "not the file of a mechanism", "srm-mbs plot, play")


@pytest.mark.parametrize("content", [b"\0\0\0\0", b"\x7fELF\x02\x01", b"hello", b""])
@pytest.mark.parametrize("suffix", [".toml", ".urdf"])
def test_a_file_of_another_kind_is_named(content: bytes, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"other{suffix}"
    path.write_bytes(content)
    refusal(path)


def test_a_binary_urdf_is_named_with_the_description(tmp_path: Path) -> None:
    refusal(write(tmp_path, urdf=bytes(range(256))), "two_bars.urdf", "not UTF-8")


@pytest.mark.parametrize(
    ("name", "text", "needle"),
    [
        ("robot.dae", '<?xml version="1.0"?><!-- a --><COLLADA/>', "<COLLADA>"),
        ("robot.txt", "links and joints", "'.txt'"),
        ("robot", "", "''"),
    ],
)
def test_files_of_other_formats_are_refused_by_their_content(
    name: str, text: str, needle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).write_text(text)
    refusal(tmp_path / name, needle, "Known: ", "URDF")
    monkeypatch.chdir(tmp_path)
    refusal(f"./{name}", needle, "Known: ", "URDF", file=name)


@pytest.mark.parametrize("name", ["robot.xml", "robot.urdf.xacro", "robot.yaml", "robot.toml"])
def test_a_urdf_is_known_by_its_content(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(URDF)
    assert srm.load(tmp_path / name).joint_names == ("hinge", "knee")


def test_a_description_is_known_by_its_content(tmp_path: Path) -> None:
    path = write(tmp_path).rename(tmp_path / "bars.txt")
    assert [loop.name for loop in srm.load(path).loops] == ["pin"]


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
    with pytest.raises(srm.InputError, match="n >= 1"):
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
    refusal(write(tmp_path), "gravity", "three finite numbers", "m/s^2", gravity=gravity)


@pytest.mark.parametrize("base", ["", "Fixed", 1, ["fixed"], True, b"fixed"], ids=repr)
def test_an_unknown_base_is_refused(base: Any, tmp_path: Path) -> None:
    refusal(write(tmp_path), "base", repr(base), "fixed, floating, planar", base=base)


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
    "two children": ('<child link="crank"/>', '<child link="crank"/>' * 2),
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
    "nan limit": ('lower="-10"', 'lower="nan"'),
    "negative effort": ('effort="1"', 'effort="-1"'),
    "negative velocity": ('velocity="1"', 'velocity="-2"'),
    "negative damping": ('"0.5"', '"-0.5"'),
    "nan damping": ('"0.5"', '"nan"'),
    "negative friction": ('"0.5"', '"0.5" friction="-1"'),
    "nan friction": ('"0.5"', '"0.5" friction="nan"'),
    "friction of a floating joint": (END, joint_c("floating", '<dynamics friction="2"/>')),
    # the tree
    "no limit": ('<limit lower="-10" upper="10" effort="1" velocity="1"/>', ""),
    "no effort": (' effort="1"', ""),
    "no joint type": (' type="revolute"', ""),
    "unknown joint type": ('"revolute"', '"hinge"'),
    "ball joint": (END, joint_c("ball")),
    "planar along x": (END, joint_c("planar")),
    "planar along y": (END, joint_c("planar", '<axis xyz="0 1 0"/>')),
    "planar downwards": (END, joint_c("planar", '<axis xyz="0 0 -1"/>')),
    "damped floating joint": (END, joint_c("floating", '<dynamics damping="2"/>')),
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


@pytest.mark.parametrize("root", ["<world version='1.6'/>", "<COLLADA/>", "<gazebo/>"])
def test_another_format_is_recognised_by_its_root_element(root: str, tmp_path: Path) -> None:
    path = write(tmp_path, urdf=root).with_suffix(".urdf")
    refusal(path, root[: root.index(" ") if " " in root else -2], "not <robot>", "URDF")


def test_a_robot_without_links_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, urdf='<robot name="nothing"/>').with_suffix(".urdf")
    refusal(path, "there is no <link>")


def test_a_robot_that_cannot_move_is_refused(tmp_path: Path) -> None:
    urdf = f'<robot name="rock"><link name="base">{INERTIAL}</link></robot>'
    path = write(tmp_path, urdf=urdf).with_suffix(".urdf")
    refusal(path, "can move", "joint")
    assert srm.load(path, base="floating").joint_names == ("root_joint",)


def test_a_ring_beside_the_tree_is_found(tmp_path: Path) -> None:
    ring = "".join(
        f'<link name="r{i}"/><joint name="r{i}" type="fixed"><parent link="r{(i + 1) % 3}"/>'
        f'<child link="r{i}"/></joint>'
        for i in range(3)
    )
    path = write(tmp_path, urdf=changed(URDF, END, ring + END)).with_suffix(".urdf")
    refusal(path, "ancestor", "'r", "ring")


def with_fixed_chain(links: int) -> str:
    chain = "".join(
        f'<link name="l{i}"/><joint name="l{i}" type="fixed">'
        f'<parent link="{f"l{i - 1}" if i else "rod"}"/><child link="l{i}"/></joint>'
        for i in range(links)
    )
    return changed(URDF, END, chain + END)


@pytest.mark.parametrize("links", [1200, 30000])
def test_a_chain_too_deep_for_the_parser_is_refused_before_it_crashes(
    links: int, tmp_path: Path
) -> None:
    path = write(tmp_path, urdf=with_fixed_chain(links)).with_suffix(".urdf")
    refusal(path, "more than 1000 joints", "Split the chain")


def test_a_deep_chain_loads(tmp_path: Path) -> None:
    path = write(tmp_path, urdf=with_fixed_chain(900)).with_suffix(".urdf")
    assert srm.load(path).joint_names == ("hinge", "knee")


def test_deeply_nested_xml_does_not_crash(tmp_path: Path) -> None:
    path = write(tmp_path, urdf="<robot>" * 100_000).with_suffix(".urdf")
    refusal(path, "XML")


@pytest.mark.parametrize("base", ["floating", "planar"])
def test_a_joint_named_as_the_root_joint_is_refused(base: str, tmp_path: Path) -> None:
    path = write(tmp_path, urdf=URDF.replace('"knee"', '"root_joint"')).with_suffix(".urdf")
    refusal(path, "'root_joint'", "reserved", base, "Rename", base=base)
    assert srm.load(path).joint_names == ("hinge", "root_joint")


@pytest.mark.parametrize("base", ["floating", "planar"])
def test_a_link_called_world_cannot_float(base: str, tmp_path: Path) -> None:
    urdf = URDF.replace('<link name="base"/>', f'<link name="world">{INERTIAL}</link>')
    path = write(tmp_path, urdf=urdf.replace('"base"', '"world"')).with_suffix(".urdf")
    refusal(path, "'world'", "reserved", 'base = "fixed"', base=base)
    assert srm.load(path).joint_names == ("hinge", "knee")


def test_a_floating_base_needs_inertia_about_every_axis(tmp_path: Path) -> None:
    """Of a massless base, the turn about the first hinge is not determined."""
    path = write(tmp_path).with_suffix(".urdf")
    refusal(path, "'root_joint'", "moves mass", "inertia", base="floating")


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


@pytest.mark.parametrize("outer", ["gazebo", "transmission", "gazebo><plugin", "sensor"])
@pytest.mark.parametrize("inner", ["loop_joint", "loop", "constraint", "coupling", "mimic"])
def test_loops_inside_ignored_elements_are_refused(outer: str, inner: str, tmp_path: Path) -> None:
    source = srm.load("four_bar").source
    assert source is not None
    end = ">".join(f"</{tag}" for tag in reversed(outer.split("><"))) + ">"
    block = f'<{outer}><{inner} name="x"/>{end}</robot>'
    path = tmp_path / "nested.urdf"
    path.write_text(source.urdf.replace("</robot>", block))
    with pytest.raises(srm.InputError, match=rf"nested\.urdf: .*<{inner}>.*not read") as caught:
        srm.load(path)
    assert caught.value.remedy


@pytest.mark.parametrize("drawn", ["visual", "collision"])
def test_inertia_inside_what_is_only_drawn_is_refused(drawn: str, tmp_path: Path) -> None:
    """Otherwise a renamed <inertial> would leave a massless link behind, without a word."""
    urdf = URDF.replace("<inertial>", f"<{drawn}>", 1).replace("</inertial>", f"</{drawn}>", 1)
    path = write(tmp_path, urdf=urdf).with_suffix(".urdf")
    refusal(path, "'crank'", f"<mass> inside <{drawn}>", "<inertial> of the link")


def test_a_start_in_gimbal_lock_of_massless_links_is_bad_input(tmp_path: Path) -> None:
    """Three axes of one ball, the outer two in line: the mass matrix is singular there."""
    inertial = POINT_MASS.replace("<inertial>", '<inertial><origin xyz="1 0.2 0.1"/>')
    inertial = inertial.replace('ixx="0" iyy="0" izz="0"', 'ixx="1" iyy="1" izz="1"')
    links = '<link name="base"/><link name="u"/><link name="w"/>'
    links += f'<link name="rod">{inertial}</inertial></link>'
    joints = "".join(
        f'<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/></joint>'
        for name, parent, child, axis in (
            ("z", "base", "u", "0 0 1"),
            ("y", "u", "w", "0 1 0"),
            ("x", "w", "rod", "1 0 0"),
        )
    )
    toml = (
        'format = 1\nurdf = "two_bars.urdf"\n[[loop]]\nname = "hook"\ntype = "point"\n'
        'a = { link = "rod", xyz = [1.0, 0.0, 0.0] }\nb = { link = "world", xyz = [0, 0, -1.0] }\n'
        "[initial]\nq = { y = 1.5707963267948966 }\n"
    )
    path = write(tmp_path, toml, f'<robot name="ball">{links}{joints}</robot>')
    refusal(path, "initial", "'z' moves no inertia", "gimbal lock")


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


@pytest.mark.parametrize(
    ("what", "given"),
    [
        ("forces", srm.TorsionSpring("crank", 1.0)),
        ("forces", ["torsion_spring"]),
        ("forces", [lambda t, q, v: v]),
        ("drives", srm.Drive(srm.ConstantSpeed(1.0), "crank")),
        ("drives", "crank"),
        ("loops", srm.LoopClosure("point", srm.Anchor("coupler"), srm.Anchor("world"))),
    ],
)
def test_elements_that_are_no_list_of_them_are_refused(what: str, given: Any) -> None:
    mechanism = srm.load("four_bar")
    with pytest.raises(srm.InputError, match=f"{what} = .* is not a list of {what}"):
        replace(mechanism, **{what: given})


@pytest.mark.parametrize("what", ["gravity", "damping"])
def test_gravity_and_damping_that_are_not_finite_are_refused(what: str) -> None:
    mechanism = srm.load("four_bar")
    model = mechanism.model.copy()
    numbers = model.gravity.linear if what == "gravity" else model.damping
    numbers[0] = np.nan
    if what == "gravity":
        model.gravity.linear = numbers
    with pytest.raises(srm.InputError, match=f"the {what} of the model is not finite"):
        replace(mechanism, model=model)


def test_joint_damping_that_would_drive_is_refused_with_the_joint() -> None:
    mechanism = srm.load("four_bar")
    model = mechanism.model.copy()
    model.damping = np.array([0.0, -0.1, 0.0])
    with pytest.raises(srm.InputError, match="damping of the joint 'coupler' is negative"):
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
