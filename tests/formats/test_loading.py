"""Loading: what a description and a URDF say is what the mechanism is."""

from __future__ import annotations

import itertools
import re
import tomllib
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.formats.build import rebuild
from srm_mbs.formats.load import models_folder, n_four_bar_texts
from srm_mbs.formats.toml.description import check_description
from srm_mbs.model.closures import CLOSURE_TYPES
from srm_mbs.model.coordinates import set_position, set_rate
from tests.support.bundled import load, rewritten
from tests.support.dynamics import (
    assert_same_dynamics,
    closure,
    mass_matrix,
    nonlinear_effects,
    states,
)
from tests.support.mechanisms import DISTINCT_MODELS
from tests.support.snapshots import check_messages, refused
from tests.support.urdf_files import placement, text
from tools.models import made

PI = np.pi
NAMES = DISTINCT_MODELS

# A tree with every kind of joint, oblique axes and placements, and a link welded on.
INERTIAL = """<inertial><origin xyz="{c}" rpy="{r}"/><mass value="{m}"/>
  <inertia ixx="{i[0]}" iyy="{i[1]}" izz="{i[2]}"
    ixy="{i[3]}" ixz="{i[4]}" iyz="{i[5]}"/></inertial>
"""
LINKS: dict[str, dict[str, Any]] = {
    "arm": {
        "c": "0.3 0.1 -0.2",
        "r": "0.3 -0.2 0.5",
        "m": 1.5,
        "i": (0.3, 0.4, 0.5, 0.02, 0, 0.01),
    },
    "slide": {"c": "0.1 0 0", "r": "0 0 0", "m": 0.7, "i": (0.1, 0.2, 0.15, 0, 0.01, 0)},
    "wheel": {"c": "0 0.05 0", "r": "0 0 0", "m": 0.4, "i": (0.05, 0.09, 0.05, 0, 0, 0)},
    "badge": {"c": "0 0 0.1", "r": "0 0.4 0", "m": 0.2, "i": (0.01, 0.01, 0.01, 0, 0, 0)},
    "raft": {"c": "0 0 0", "r": "0 0 0", "m": 2.0, "i": (0.2, 0.3, 0.4, 0, 0, 0)},
}
JOINTS: tuple[dict[str, Any], ...] = (
    {"name": "shoulder", "type": "revolute", "parent": "base", "child": "arm",
     "xyz": (0.1, 0.2, 0.3), "rpy": (0.4, -0.3, 1.2), "axis": (1.0, 2.0, -2.0), "damping": 0.7},
    {"name": "track", "type": "prismatic", "parent": "arm", "child": "slide",
     "xyz": (0.5, 0.0, 0.1), "rpy": (0.0, 0.7, 0.0), "axis": (0.0, 3.0, 4.0), "damping": 1.3},
    {"name": "axle", "type": "continuous", "parent": "slide", "child": "wheel",
     "xyz": (0.0, 0.2, 0.0), "rpy": (0.2, 0.0, -0.4), "axis": (0.0, 5.0, 0.0), "damping": 0.0},
    {"name": "glue", "type": "fixed", "parent": "wheel", "child": "badge",
     "xyz": (0.1, 0.0, 0.2), "rpy": (0.0, 0.0, 0.9), "axis": None, "damping": 0.0},
    {"name": "pond", "type": "planar", "parent": "slide", "child": "raft",
     "xyz": (0.3, 0.1, 0.0), "rpy": (0.5, 0.1, 0.0), "axis": (0.0, 0.0, 2.0), "damping": 0.0},
)  # fmt: skip


def zoo_urdf() -> str:
    out = ['<robot name="zoo">', '<link name="base"/>']
    for name, inertia in LINKS.items():
        out.append(f'<link name="{name}">{INERTIAL.format(**inertia)}</link>')
    for joint in JOINTS:
        axis = "" if joint["axis"] is None else f'<axis xyz="{text(joint["axis"])}"/>'
        limit = '<limit lower="-9" upper="9" effort="1" velocity="1"/>'
        out.append(
            f'<joint name="{joint["name"]}" type="{joint["type"]}">'
            f'<parent link="{joint["parent"]}"/><child link="{joint["child"]}"/>'
            f'<origin xyz="{text(joint["xyz"])}" rpy="{text(joint["rpy"])}"/>'
            f"{axis}{limit if joint['type'] in ('revolute', 'prismatic') else ''}"
            + (f'<dynamics damping="{joint["damping"]}"/>' if joint["damping"] else "")
            + "</joint>"
        )
    return "\n".join([*out, "</robot>"])


def inertia_of(link: str) -> tuple[pin.SE3, pin.Inertia]:
    data = LINKS[link]
    xx, yy, zz, xy, xz, yz = data["i"]
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=float)
    at = placement(data["c"].split(), [float(x) for x in data["r"].split()])
    return at, pin.Inertia(data["m"], np.zeros(3), tensor)


def zoo_model() -> pin.Model:
    """The same tree by Pinocchio's own calls, joints in the same order."""
    model = pin.Model()
    at: dict[str, tuple[int, pin.SE3]] = {"base": (0, pin.SE3.Identity())}
    for joint in JOINTS:
        parent, offset = at[joint["parent"]]
        here = offset * placement(joint["xyz"], joint["rpy"])
        if joint["axis"] is not None:
            axis = np.array(joint["axis"]) / np.linalg.norm(joint["axis"])
        index, inside = parent, here
        if joint["type"] != "fixed":
            kind = {
                "revolute": lambda axis=axis: pin.JointModelRevoluteUnaligned(axis),
                "prismatic": lambda axis=axis: pin.JointModelPrismaticUnaligned(axis),
                "continuous": pin.JointModelRUBY,
                "planar": pin.JointModelPlanar,
            }[joint["type"]]()
            index, inside = model.addJoint(parent, kind, here, joint["name"]), pin.SE3.Identity()
        at[joint["child"]] = (index, inside)
        centre, inertia = inertia_of(joint["child"])
        model.appendBodyToJoint(index, inertia, inside * centre)
    return model


def write(folder: Path, urdf: str, toml: str = "", name: str = "zoo") -> Path:
    (folder / f"{name}.urdf").write_text(urdf, encoding="utf-8")
    path = folder / f"{name}.toml"
    path.write_text(f'format = 1\nurdf = "{name}.urdf"\n{toml}', encoding="utf-8")
    return path


# --- the same mechanism, by its physics ---------------------------------------------------------


def test_a_urdf_is_the_model_that_it_describes(tmp_path: Path) -> None:
    loaded = srm.load(write(tmp_path, zoo_urdf()).with_suffix(".urdf")).model
    model = zoo_model()
    assert list(loaded.names) == ["universe", "shoulder", "track", "axle", "pond"]
    assert (loaded.nq, loaded.nv) == (model.nq, model.nv) == (8, 6)
    assert_same_dynamics(loaded, model)


ANCHOR_A = ((0.2, -0.1, 0.4), (0.3, 0.8, -0.5))
ANCHOR_B = ((-0.3, 0.2, 0.1), (1.1, -0.4, 0.2))
AXIS = (2.0, -1.0, 2.0)
CLOSURES = {
    "point": 3,
    "frame": 6,
    "revolute": 5,
    "prismatic": 5,
    "cylindrical": 4,
    "universal": 4,
    "planar": 3,
    "distance": 1,
    "point_on_line": 2,
    "point_on_plane": 1,
}


def relative(model: pin.Model, q: FloatArray) -> pin.SE3:
    """Placement of an anchor on the badge in an anchor on the arm, from the hand-made model."""
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    glue = JOINTS[3]
    wheel = data.oMi[model.getJointId("axle")]
    a = wheel * placement(glue["xyz"], glue["rpy"]) * placement(*ANCHOR_A)
    b = data.oMi[model.getJointId("shoulder")] * placement(*ANCHOR_B)
    return b.actInv(a)


def rows_by_hand(kind: str, between: pin.SE3) -> tuple[FloatArray, int]:
    """What vanishes when the closure is closed, and how many values of it are positions."""
    p, R = between.translation, between.rotation
    n = np.array(AXIS) / 3.0
    across, tilt, turns = p - n * (n @ p), R @ n - n * (n @ R @ n), [R[2, 1], R[0, 2], R[1, 0]]
    return {
        "point": (p, 3),
        "frame": (np.concatenate([p, turns]), 3),
        "revolute": (np.concatenate([p, tilt]), 3),
        "prismatic": (np.concatenate([across, turns]), 3),
        "cylindrical": (np.concatenate([across, tilt]), 3),
        "universal": (np.concatenate([p, [R[2, 1]]]), 3),
        "planar": (np.concatenate([[n @ p], tilt]), 1),
        "distance": (np.array([np.linalg.norm(p) - 0.6]), 1),
        "point_on_line": (across, 3),
        "point_on_plane": (np.array([n @ p]), 1),
    }[kind]


@pytest.mark.parametrize("kind", CLOSURES)
def test_a_closure_is_what_it_says_between_the_anchors_of_the_file(
    kind: str, tmp_path: Path
) -> None:
    """g against the placements of a model built by hand: anchors on a welded link, with rpy."""
    axis = f"axis = {list(AXIS)}\n" if "axis" in CLOSURE_TYPES[kind].needs else ""
    axis += {
        "universal": "axis_a = [0, 3, 0]\naxis_b = [0.0, 0.0, 0.1]\n",
        "distance": "length = 0.6\n",
    }.get(kind, "")
    loop = (
        f'[[loop]]\nname = "ring"\ntype = "{kind}"\n{axis}'
        f'a = {{ link = "badge", xyz = {list(ANCHOR_A[0])}, rpy = {list(ANCHOR_A[1])} }}\n'
        f'b = {{ link = "arm", xyz = {list(ANCHOR_B[0])}, rpy = {list(ANCHOR_B[1])} }}\n'
    )
    source_path = write(tmp_path, zoo_urdf(), loop)
    try:
        mechanism = srm.load(source_path)
    except srm.AssemblyError:  # closed or not: the rows are what counts here
        plain = srm.load(source_path.with_suffix(".urdf"))
        closures = _closures(source_path)
        mechanism = srm.Mechanism(plain.model, closures)
    (closure_of_file,) = mechanism.loops
    assert closure_of_file.name == "ring"
    assert closure_of_file.rows.count == CLOSURES[kind]
    model = zoo_model()
    for q, v in states(model):
        ours = closure(mechanism, q, v)[: CLOSURES[kind]]
        theirs, positions = rows_by_hand(kind, relative(model, q))
        # Up to the choice of two directions across the axis.
        split = closure_of_file.rows.blocks[0].stop
        assert np.linalg.norm(ours[:split]) == pytest.approx(
            np.linalg.norm(theirs[:positions]), abs=1e-13
        )
        assert np.linalg.norm(ours[split:]) == pytest.approx(
            np.linalg.norm(theirs[positions:]), abs=1e-13
        )


def _closures(path: Path) -> tuple[srm.LoopClosure, ...]:
    return check_description(tomllib.loads(path.read_text()), str(path)).closures()


def test_joint_damping_of_the_file_acts(tmp_path: Path) -> None:
    """One hinge along gravity: its rate decays by exp(-d t / I)."""
    inertial = INERTIAL.format(c="0 0 0", r="0 0 0", m=1, i=(1, 1, 2.0, 0, 0, 0))
    urdf = (
        f'<robot name="top"><link name="base"/><link name="top">{inertial}</link>'
        '<joint name="spin" type="continuous"><parent link="base"/><child link="top"/>'
        '<axis xyz="0 0 1"/><dynamics damping="0.6"/></joint></robot>'
    )
    path = write(tmp_path, urdf, "[initial]\nv = { spin = 3.0 }\n")
    mechanism = srm.load(path)
    np.testing.assert_array_equal(mechanism.model.damping, [0.6])
    solution = srm.simulate(mechanism, 2.0, rtol=1e-9)
    assert solution.v[-1][0] == pytest.approx(3.0 * np.exp(-0.6 * 2.0 / 2.0), rel=1e-8)


def test_damping_goes_to_the_joint_that_has_it(tmp_path: Path) -> None:
    model = srm.load(write(tmp_path, zoo_urdf())).model
    by_name = {joint["name"]: joint["damping"] for joint in JOINTS if joint["type"] != "fixed"}
    for name, damping in by_name.items():
        joint = model.joints[model.getJointId(name)]
        assert set(model.damping[joint.idx_v : joint.idx_v + joint.nv]) == {damping}


@pytest.mark.parametrize("locked", ["", 'lock = ["track"]\n'])
def test_friction_goes_to_the_joint_that_has_it(locked: str, tmp_path: Path) -> None:
    text = zoo_urdf().replace('damping="0.7"', 'damping="0.7" friction="0.2"')
    axle = '<axis xyz="0.0 5.0 0.0"/>'
    assert axle in text
    text = text.replace(axle, f'{axle}<dynamics friction="0.3"/>')
    mechanism = srm.load(write(tmp_path, text, f"friction_speed = 0.05\n{locked}"))
    track = [] if locked else [0.0]
    np.testing.assert_array_equal(mechanism.model.friction, [0.2, *track, 0.3, 0.0, 0.0, 0.0])
    assert mechanism.friction_speed == 0.05
    (note,) = mechanism.notes
    assert "v_s = 0.05 rad/s" in note
    assert "friction_speed" in note
    bare = srm.load(tmp_path / "zoo.urdf")
    assert bare.friction_speed == 0.01


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('mass value="0.7"', 'mass value="\n0.7 "'),
        ('mass value="0.7"', 'mass value="7e-1"'),
        ('mass value="0.7"', 'mass value="+.7"'),
        ('xyz="0.3 0.1 -0.2"', 'xyz=" 0.3\n\t 0.1   -0.2\n"'),
        ('rpy="0.4 -0.3 1.2"', 'rpy="0.4\t-0.3\n1.2"'),
        ('xyz="1.0 2.0 -2.0"', 'xyz="1e-200 2e-200 -2e-200"'),
        ('xyz="1.0 2.0 -2.0"', 'xyz="1e20\n2e20 -2e20"'),
        ('<link name="base"/>', '<link name="base"><visual/><collision/></link>'),
        ('<link name="base"/>', '<link name="base" type="dummy"><origin xyz="0 0 0"/></link>'),
        (
            '<link name="base"/>',
            '<material name="m"/><material name="m"/><link name="base"><visual><geometry>'
            '<box size="wide"/></geometry></visual></link>',
        ),
        ("</robot>", "<transmission/><gazebo/><sensor/></robot>"),
        ("</robot>", "<gazebo><plugin><joint>track</joint></plugin></gazebo></robot>"),
        ('<dynamics damping="0.7"/>', '<dynamics damping="0.7" friction="0"/><safety_controller/>'),
        ('<dynamics damping="0.7"/>', '<calibration/><dynamics damping="0.7" D="1" K="7000"/>'),
        (
            '<limit lower="-9"',
            '<limit command_effort="40" current="10" gear_velocity="10" '
            'lower="-1.7976931348623157e308"',
        ),
        ('<limit lower="-9"', '<limit twist="0.3" lower="-9"'),
        ('<link name="base"/>', '<link name="base" concave="yes"/>'),
        ('<dynamics damping="0.7"/>', '<dynamics damping="0.7"/><dynamics damping="0.7"/>'),
        ('type="fixed">', 'type="fixed"><axis xyz="0 0 0"/><limit/><mimic joint="axle"/>'),
        ('type="continuous">', 'type="continuous"><limit velocity="3"/>'),
        ('<robot name="zoo">', '<?xml version="1.0"?><robot name="zoo" version="1.0">'),
        ('<robot name="zoo">', '<robot name="zoo" xmlns:xacro="http://wiki.ros.org/xacro">'),
        ('<robot name="zoo">', '<!-- <loop/> --><robot name="zoo">'),
    ],
)  # fmt: skip
def test_another_way_to_write_it_is_the_same_mechanism(
    old: str, new: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Pinocchio's own reader drops inertias over a newline, and joints over a safety controller."""
    text = zoo_urdf()
    assert old in text
    original = srm.load(write(tmp_path, text).with_suffix(".urdf")).model
    model = srm.load(write(tmp_path, text.replace(old, new, 1)).with_suffix(".urdf")).model
    assert list(model.names) == list(original.names)
    np.testing.assert_array_equal(model.damping, original.damping)
    assert_same_dynamics(model, original, 2, atol=1e-13, rtol=0)
    assert capfd.readouterr().err == ""


def test_the_rounding_of_a_point_mass_is_no_negative_inertia(tmp_path: Path) -> None:
    """Exporters write products of inertia of 1e-20 kg m^2 where they mean none."""
    text = zoo_urdf()
    badge = INERTIAL.format(**LINKS["badge"])
    point = INERTIAL.format(c="0 0 0", r="0 0 0", m=0.2, i=(0, 0, 0, 0, 1e-20, 0))
    assert badge in text
    assert srm.load(write(tmp_path, text.replace(badge, point))).model.nv == 6


def test_a_negative_moment_counts_only_in_the_whole_body(tmp_path: Path) -> None:
    """The badge is glued to the wheel; the raft is a body of its own."""
    text = zoo_urdf()
    badge = INERTIAL.format(**LINKS["badge"])
    odd = INERTIAL.format(c="0 0 0.1", r="0 0.4 0", m=0.2, i=(-0.002, 0.01, 0.01, 0, 0, 0))
    with pytest.warns(srm.SrmWarning, match="moment of inertia is negative"):
        mechanism = srm.load(write(tmp_path, text.replace(badge, odd)))
    (note,) = mechanism.notes
    assert "link 'badge': a principal moment of inertia is negative (-0.002 kg m^2)" in note
    wheel = mechanism.model.inertias[mechanism.model.getJointId("axle")]
    plain = srm.load(write(tmp_path, text)).model
    change = wheel.inertia - plain.inertias[plain.getJointId("axle")].inertia
    assert np.linalg.eigvalsh(change) == pytest.approx([-0.012, 0.0, 0.0], abs=1e-12)
    assert np.linalg.eigvalsh(wheel.inertia)[0] > 0.0
    worse = odd.replace("-0.002", "-5")
    for old, new in ((badge, worse), (INERTIAL.format(**LINKS["raft"]), odd)):
        with pytest.raises(srm.InputError, match="principal moment of inertia is negative"):
            srm.load(write(tmp_path, text.replace(old, new)))


def test_what_is_ignored_is_noted(tmp_path: Path) -> None:
    text = zoo_urdf().replace(
        "</robot>",
        '<transmission/><transmission/><gazebo><plugin name="a"/><plugin name="b"/></gazebo>'
        '<material name="m"/></robot>',
    )
    text = text.replace('<link name="base"/>', '<link name="base"><collision/></link>')
    text = text.replace('<dynamics damping="0.7"/>', '<dynamics damping="0.7" K="3"/>')
    notes = srm.load(write(tmp_path, text)).notes
    assert sum("2 <transmission>" in note for note in notes) == 1
    assert sum("1 <gazebo>" in note for note in notes) == 1
    assert sum("2 <plugin>" in note for note in notes) == 1
    assert sum("1 <collision>" in note for note in notes) == 1
    assert sum("<dynamics K>" in note for note in notes) == 1
    assert not any("material" in note for note in notes)
    assert srm.load(write(tmp_path, zoo_urdf())).notes == ()


# --- names --------------------------------------------------------------------------------------


def test_names_may_be_anything_that_xml_allows(tmp_path: Path) -> None:
    odd = {"arm": "Ärm & <Bein>", "shoulder": 'joint "ß" 日本', "track": " track "}
    text = zoo_urdf()
    for old, new in odd.items():
        escaped = new.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
        text = text.replace(f'"{old}"', f'"{escaped}"')
    toml = (
        'lock = [" track "]\n[[loop]]\ntype = "point_on_plane"\naxis = [0, 0, 1]\n'
        'a = { link = "Ärm & <Bein>", xyz = [1, 0, 0] }\nb = { link = "world" }\n'
        "[initial]\nguess = { 'joint \"ß\" 日本' = 0.4 }\n"
    )
    mechanism = srm.load(write(tmp_path, text, toml))
    assert mechanism.joint_names == ('joint "ß" 日本', "axle", "pond")
    assert mechanism.loops[0].name == "point_on_plane_Ärm & <Bein>_world"


@pytest.mark.parametrize("name", ['with "quotes"', "back\\slash", "tab\there", "ünï", "a b", "#x"])
def test_a_urdf_may_have_any_file_name(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"{name}.urdf"
    path.write_text(zoo_urdf())
    assert srm.load(path).joint_names == ("shoulder", "track", "axle", "pond")
    assert srm.load(str(path)).model.nv == 6
    source = srm.load(path).source
    assert source is not None
    assert (source.path, source.urdf_path) == (str(path), str(path))


@pytest.mark.parametrize("suffix", [".TOML", ".Urdf"])
def test_the_case_of_a_suffix_does_not_matter(suffix: str, tmp_path: Path) -> None:
    path = write(tmp_path, zoo_urdf())
    target = tmp_path / f"other{suffix}"
    target.write_text(path.with_suffix(suffix.lower()).read_text())
    assert srm.load(target).model.nv == 6


@pytest.mark.parametrize("ending", ["\r\n", "\n"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_files_of_windows_editors_are_read(mark: bytes, ending: str, tmp_path: Path) -> None:
    path = write(tmp_path, zoo_urdf(), 'name = "ü"\n')
    for file in (path, path.with_suffix(".urdf")):
        file.write_bytes(mark + file.read_text().replace("\n", ending).encode())
        assert srm.load(file).model.nv == 6
    assert srm.load(path).name == "ü"


def test_the_urdf_is_looked_for_beside_the_description(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    path = write(tmp_path / "here", zoo_urdf())
    path.with_suffix(".urdf").rename(tmp_path / "there" / "zoo.urdf")
    path.write_text('format = 1\nurdf = "../there/zoo.urdf"\n')
    load = partial(srm.load, allow_outside=True)
    assert load(path).model.nv == 6
    monkeypatch.chdir(tmp_path)
    assert load("here/zoo.toml").model.nv == 6
    assert load(Path("here") / "zoo.toml").model.nv == 6
    path.write_text(f"format = 1\nurdf = '{tmp_path / 'there' / 'zoo.urdf'}'\n")
    assert load(path).model.nv == 6


def test_a_loop_without_name_gets_one_from_its_type_and_links(tmp_path: Path) -> None:
    loops = "".join(
        f'[[loop]]\ntype = "point_on_plane"\naxis = [0, 0, 1]\na = {{ {a} }}\nb = {{ {b} }}\n'
        for a, b in (('link = "arm"', 'link = "world"'), ('frame = "axle"', 'link = "arm"'))
    )
    mechanism = srm.Mechanism(zoo_named().model, _closures(write(tmp_path, zoo_urdf(), loops)))
    names = [loop.name for loop in mechanism.loops]
    assert names == ["point_on_plane_arm_world", "point_on_plane_axle_arm"]
    assert mechanism.loops[0].row_names == ("point_on_plane_arm_world.normal",)


@cache
def zoo_named() -> srm.Mechanism:
    """The zoo with the frames of its links, as loaded."""
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        return srm.load(write(Path(folder), zoo_urdf()))


@pytest.mark.parametrize(
    ("frame", "link"),
    [("shoulder", "arm"), ("glue", "badge"), ("badge", "badge"), ("pond", "raft")],
)
def test_a_frame_may_stand_for_a_link(frame: str, link: str) -> None:
    """A joint's frame is that of the link it moves; a fixed joint has one too."""
    model = zoo_named().model
    offset = {"xyz": (0.1, 0.2, 0.3), "rpy": (0.3, 0.2, 0.1)}
    by_frame = srm.Anchor(frame=frame, **offset).resolve(model)
    by_link = srm.Anchor(link=link, **offset).resolve(model)
    assert by_frame[0] == by_link[0]
    assert by_frame[1].isApprox(by_link[1], 1e-14)


@pytest.mark.parametrize(
    "anchor", [srm.Anchor("base"), srm.Anchor("world"), srm.Anchor(None, "universe")]
)
def test_the_ground_has_three_names(anchor: srm.Anchor) -> None:
    joint, at = anchor.resolve(zoo_named().model)
    assert joint == 0
    assert at.isIdentity()


def test_a_file_of_the_working_folder_needs_no_suffix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("zoo").write_text(zoo_urdf(), encoding="utf-8")
    assert srm.load("zoo").joint_names == ("shoulder", "track", "axle", "pond")
    Path("folder").mkdir()
    with pytest.raises(srm.InputError, match=r"^folder: it is a directory"):
        srm.load("folder")


# --- bundled mechanisms -------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_every_bundled_mechanism_loads(name: str) -> None:
    mechanism = load(name)
    assert mechanism.name == name
    assert mechanism.notes == ()
    assert mechanism.structure.notes == ()
    assert mechanism.defaults.t_end is not None
    gravity = 0.0 if name == "squeezing_mechanism" else -9.81
    np.testing.assert_array_equal(mechanism.model.gravity.linear, [0.0, 0.0, gravity])
    if mechanism.loops:
        assert mechanism.degrees_of_freedom < mechanism.model.nv
        state = closure(mechanism, mechanism.q0, mechanism.v0)
        rows = sum(loop.rows.count for loop in mechanism.loops)
        assert np.abs(state[: 2 * rows]).max() < 1e-12
    else:
        assert mechanism.degrees_of_freedom == mechanism.model.nv


@pytest.mark.parametrize("name", NAMES)
def test_a_bundled_name_and_its_path_are_the_same_mechanism(name: str) -> None:
    path = models_folder() / f"{name}.toml"
    by_path = srm.load(path)
    np.testing.assert_array_equal(by_path.q0, load(name).q0)
    np.testing.assert_array_equal(by_path.v0, load(name).v0)
    assert by_path.source == load(name).source


# joint, its link's length, its pivot
CRANKS = {
    "five_bar": [("crank_left", 0.8, 0.0), ("crank_right", 0.8, 1.2)],
    "four_bar": [("crank", 1.0, 0.0), ("rocker", 1.5, 2.2)],
    "n_four_bar_1": [("crank_0", 1.0, 0.0), ("crank_1", 1.0, 1.0)],
    "n_four_bar_2": [("crank_0", 1.0, 0.0), ("crank_1", 1.0, 1.0), ("crank_2", 1.0, 2.0)],
    "parallelogram": [("crank", 1.0, 0.0), ("rocker", 1.0, 2.0)],
    "pendulum_chain": [("link_0", 1.0, 0.0)],
    "slider_crank": [("crank", 2.0, 0.0)],
    "slider_crank_regular": [("crank", 1.0, 0.0)],
    "slider_crank_slider": [("crank", 2.0, 0.0)],
    "slider_crank_whirl": [("crank", 2.0, 0.0)],
}
TYPED_IN = {"klann_walker", "quick_return", "scissor_lift", "toggle_press", "wiper"}
OTHERS = {"spatial_four_bar", "spatial_dead_point", "squeezing_mechanism", *made(), *TYPED_IN}
"""Tested elsewhere."""


def test_the_conventions_of_all_planar_bundled_mechanisms_are_tested() -> None:
    assert set(CRANKS) == set(NAMES) - OTHERS


@pytest.mark.parametrize("name", [*CRANKS, *sorted(TYPED_IN)])
def test_bundled_planar_mechanisms_lie_in_the_x_z_plane(name: str) -> None:
    mechanism = load(name)
    data = mechanism.model.createData()
    for q, _ in states(mechanism.model):
        pin.forwardKinematics(mechanism.model, data, q)
        for place in list(data.oMi)[1:]:
            assert place.translation[1] == 0.0
            np.testing.assert_allclose(place.rotation[1], [0.0, 1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("name", CRANKS)
def test_a_crank_points_along_cos_q_sin_q_from_x_to_z(name: str) -> None:
    mechanism = load(name)
    model = mechanism.model
    data = model.createData()
    for joint, length, pivot in CRANKS[name]:
        for angle in (0.0, 0.3, PI / 2, -2.0, 5.0):
            q = np.array(mechanism.q0)
            set_position(mechanism, q, joint, angle)
            pin.framesForwardKinematics(model, data, q)
            body = data.oMf[model.getFrameId(joint, pin.FrameType.BODY)]
            np.testing.assert_allclose(
                body.act(np.array([length, 0.0, 0.0])),
                [pivot + length * np.cos(angle), 0.0, length * np.sin(angle)],
                atol=1e-14,
            )


@pytest.mark.parametrize("name", CRANKS)
def test_a_crank_is_a_uniform_bar_of_its_length(name: str) -> None:
    mechanism = load(name)
    for joint, length, _ in CRANKS[name]:
        inertia = mechanism.model.inertias[mechanism.model.getJointId(joint)]
        np.testing.assert_allclose(inertia.lever, [length / 2, 0.0, 0.0])
        expected = inertia.mass * length**2 / 12
        np.testing.assert_allclose(np.diag(inertia.inertia)[1:], expected, rtol=1e-12)


@pytest.mark.parametrize("n", [1, 2])
def test_generated_texts_equal_the_files(n: int) -> None:
    toml, urdf = n_four_bar_texts(n)
    folder = models_folder()
    assert (folder / f"n_four_bar_{n}.toml").read_text() == toml
    assert (folder.parent / "urdf" / f"n_four_bar_{n}.urdf").read_text() == urdf


@pytest.mark.parametrize("n", [1, 2, 7])
def test_an_n_four_bar_has_one_freedom_and_starts_upright(n: int) -> None:
    mechanism = load(f"n_four_bar_{n}")
    assert mechanism.name == f"n_four_bar_{n}"
    assert (mechanism.model.nv, mechanism.degrees_of_freedom) == (2 * n + 1, 1)
    assert mechanism.redundant_rows == tuple(f"pin_{i}.y" for i in range(n))
    for i in range(n + 1):
        joint = mechanism.joint(f"crank_{i}")
        assert mechanism.q0[joint.idx_q] == pytest.approx(PI / 2, abs=1e-12)
        assert mechanism.v0[joint.idx_v] == pytest.approx(-1.0, abs=1e-12)
    same = srm.n_four_bar(n)
    np.testing.assert_array_equal(same.q0, mechanism.q0)
    assert same.loops == mechanism.loops


def test_other_sizes_of_the_n_four_bar_are_generated() -> None:
    assert "n_four_bar_7" not in NAMES
    assert len(load("n_four_bar_7").loops) == 7
    assert srm.load("n_four_bar_7", gravity=[0, 0, 0]).model.gravity.linear[2] == 0.0


# --- overrides ----------------------------------------------------------------------------------


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), [1.0, -2.0, 3.5], np.array([0, 0, -1])])
def test_gravity_can_be_given_instead(gravity: Any) -> None:
    mechanism = srm.load("four_bar", gravity=gravity)
    np.testing.assert_array_equal(mechanism.model.gravity.linear, gravity)
    np.testing.assert_array_equal(mechanism.source.gravity, gravity)  # type: ignore[union-attr]
    np.testing.assert_array_equal(mechanism.q0, load("four_bar").q0)
    # It is the mechanism's, not the class's.
    np.testing.assert_array_equal(srm.load("four_bar").model.gravity.linear, [0, 0, -9.81])


def test_gravity_of_the_file_is_used(tmp_path: Path) -> None:
    path = write(tmp_path, zoo_urdf(), "gravity = [1, 2.5, -3]\n")
    np.testing.assert_array_equal(srm.load(path).model.gravity.linear, [1.0, 2.5, -3.0])
    bare = srm.load(path.with_suffix(".urdf"))
    np.testing.assert_array_equal(bare.model.gravity.linear, [0.0, 0.0, -9.81])


BASED = zoo_urdf().replace(
    '<link name="base"/>', f'<link name="base">{INERTIAL.format(**LINKS["raft"])}</link>'
)


@pytest.mark.parametrize("how", ["description", "argument", "argument over description"])
@pytest.mark.parametrize(("base", "nq", "nv"), [("floating", 7, 6), ("planar", 4, 3)])
def test_a_moving_base_is_a_root_joint(
    base: str, nq: int, nv: int, how: str, tmp_path: Path
) -> None:
    other = {"floating": "planar", "planar": "floating"}[base]
    given = {"description": base, "argument": "fixed", "argument over description": other}[how]
    path = write(tmp_path, BASED, f'base = "{given}"\n')
    mechanism = srm.load(path) if how == "description" else srm.load(path, base=base)
    model = mechanism.model
    assert mechanism.joint_names[0] == "root_joint"
    assert (model.nq, model.nv) == (8 + nq, 6 + nv)
    assert mechanism.source.base == base  # type: ignore[union-attr]
    # Lifting the base lifts everything, and its inertia counts.
    fixed = srm.load(path, base="fixed")
    assert fixed.joint_names[0] == "shoulder"
    q = pin.neutral(model)
    M = mass_matrix(model, q)
    np.testing.assert_allclose(M[nv:, nv:], mass_matrix(fixed.model, pin.neutral(fixed.model)))
    total = sum(data["m"] for data in LINKS.values()) + LINKS["raft"]["m"]
    assert M[0, 0] == M[1, 1] == pytest.approx(total)


def test_a_planar_base_moves_in_x_and_y_and_turns_about_z(tmp_path: Path) -> None:
    mechanism = srm.load(write(tmp_path, BASED), base="planar")
    model = mechanism.model
    data = model.createData()
    q = np.array(mechanism.q0)
    set_position(mechanism, q, "root_joint", [1.0, 2.0, 0.3])
    pin.forwardKinematics(model, data, q)
    expected = pin.SE3(pin.utils.rotate("z", 0.3), np.array([1.0, 2.0, 0.0]))
    assert data.oMi[1].isApprox(expected, 1e-14)


# --- values of joints ---------------------------------------------------------------------------


def test_values_of_every_kind_of_joint_are_taken(tmp_path: Path) -> None:
    quaternion = np.array([0.2, -0.4, 0.4, 0.8])
    toml = (
        'base = "floating"\n[initial.q]\nshoulder = 0.3\ntrack = [0.2]\naxle = 4.0\n'
        f"pond = [0.5, -0.6, 2.0]\nroot_joint = [1, 2, 3, {', '.join(map(str, quaternion))}]\n"
        "[initial.v]\nshoulder = 1.0\naxle = -2.0\npond = [0.1, 0.2, 0.3]\n"
        "root_joint = [1, 2, 3, 4, 5, 6]\n"
    )
    mechanism = srm.load(write(tmp_path, BASED, toml))
    q, v = mechanism.q0, mechanism.v0
    expected_q = [1, 2, 3, *quaternion, 0.3, 0.2, np.cos(4.0), np.sin(4.0)]
    np.testing.assert_allclose(q, [*expected_q, 0.5, -0.6, np.cos(2.0), np.sin(2.0)], atol=1e-15)
    np.testing.assert_allclose(v, [1, 2, 3, 4, 5, 6, 1.0, 0.0, -2.0, 0.1, 0.2, 0.3])


def test_a_planar_joint_also_takes_cosine_and_sine(tmp_path: Path) -> None:
    toml = "[initial.guess]\npond = [0.5, -0.6, 0.6, 0.8]\n"
    mechanism = srm.load(write(tmp_path, zoo_urdf(), toml))
    np.testing.assert_allclose(mechanism.q0[-4:], [0.5, -0.6, 0.6, 0.8], atol=1e-15)


def test_a_root_joint_is_a_free_flyer_in_the_world(tmp_path: Path) -> None:
    """Position xyz and quaternion xyzw; rates linear then angular in the moving frame."""
    half = np.sqrt(0.5)
    toml = (
        f'base = "floating"\n[initial]\nq = {{ root_joint = [1, 2, 3, 0, 0, {half}, {half}] }}\n'
        "v = { root_joint = [1, 0, 0, 0, 0, 2] }\n"
    )
    mechanism = srm.load(write(tmp_path, BASED, toml))
    model = mechanism.model
    data = model.createData()
    pin.forwardKinematics(model, data, mechanism.q0, mechanism.v0)
    np.testing.assert_allclose(data.oMi[1].translation, [1, 2, 3])
    np.testing.assert_allclose(data.oMi[1].rotation @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    velocity = data.oMi[1].rotation @ data.v[1].linear
    np.testing.assert_allclose(velocity, [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(data.v[1].angular, [0, 0, 2], atol=1e-15)


BAD_VALUES: list[tuple[str, Any]] = [
    ("root_joint", [1, 2, 3]),
    ("root_joint", 1.0),
    ("root_joint", [0, 0, 0, 0, 0, 0, 0]),
    ("root_joint", [0, 0, 0, 0, 0, 1, 1]),
    ("pond", [1, 2]),
    ("pond", [1, 2, 1, 1]),
    ("axle", [1, 0]),
]


def test_malformed_values_of_joints_are_named(tmp_path: Path) -> None:
    messages = {}
    for (joint, value), where in itertools.product(BAD_VALUES, ("q", "guess")):
        line = f"{where} = {{ {joint} = {value} }}"
        path = write(tmp_path, BASED, f'base = "floating"\n[initial]\n{line}\n')
        messages[line] = refused(partial(srm.load, path), tmp_path)
    check_messages("joint_values", messages)


def test_a_nearly_normalised_quaternion_is_normalised(tmp_path: Path) -> None:
    toml = 'base = "floating"\n[initial]\nq = { root_joint = [0, 0, 0, 0.5, 0.5, 0.5, 0.5001] }\n'
    mechanism = srm.load(write(tmp_path, BASED, toml))
    assert np.linalg.norm(mechanism.q0[3:7]) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize(
    ("setter", "value"),
    [(set_position, [1.0, 2.0]), (set_position, "x"), (set_position, np.nan), (set_rate, [])],
)
def test_setting_a_malformed_value_changes_nothing(setter: Any, value: Any) -> None:
    mechanism = load("four_bar")
    target = np.array([1.0, 2.0, 3.0])
    with pytest.raises(srm.InputError):
        setter(mechanism, target, "coupler", value)
    np.testing.assert_array_equal(target, [1.0, 2.0, 3.0])


def test_continuous_joints_take_an_angle_in_assembly_too(tmp_path: Path) -> None:
    text = zoo_urdf()
    mechanism = srm.load(write(tmp_path, text))
    state = srm.assemble(mechanism, q={"axle": 7.0}, v={"axle": 1.5})
    index = mechanism.joint("axle").idx_q
    np.testing.assert_allclose(state.q[index : index + 2], [np.cos(7.0), np.sin(7.0)])
    assert state.v[mechanism.joint("axle").idx_v] == 1.5


def test_continuous_joints_close_loops_like_revolute_ones(tmp_path: Path) -> None:
    endless = ('type="revolute"', 'type="continuous"')
    mechanism = srm.load(rewritten(tmp_path, "four_bar", urdf=(endless,)))
    assert (mechanism.model.nq, mechanism.model.nv) == (6, 3)
    reference = load("four_bar")
    angles = np.arctan2(mechanism.q0[1::2], mechanism.q0[::2])
    np.testing.assert_allclose(angles, reference.q0, atol=1e-12)
    np.testing.assert_allclose(mechanism.v0, reference.v0, atol=1e-12)
    assert mechanism.redundant_rows == reference.redundant_rows
    assert mechanism.degrees_of_freedom == 1


# --- locking ------------------------------------------------------------------------------------

LOOP = (
    '[[loop]]\nname = "ring"\ntype = "point"\n'
    'a = { link = "badge", xyz = [0.2, -0.1, 0.4], rpy = [0.3, 0.8, -0.5] }\n'
    'b = { link = "base", xyz = [0.8, 0.4, 0.3] }\n'
)
VALUES: dict[str, Any] = {"shoulder": 0.4, "track": -0.3, "axle": 2.5, "pond": [0.2, 0.1, -0.7]}


@pytest.mark.parametrize(
    "locked", [("shoulder",), ("track",), ("axle",), ("pond",), ("track", "pond"), ("axle", "pond")]
)
@pytest.mark.parametrize("where", ["q", "guess"])
def test_locking_is_the_same_as_holding_a_joint_at_its_value(
    locked: tuple[str, ...], where: str, tmp_path: Path
) -> None:
    """M, forces and closure of the locked model are sub-blocks of the unlocked one's."""
    loops = _closures(write(tmp_path, zoo_urdf(), LOOP))
    free = srm.Mechanism(zoo_named().model, loops)
    values = "\n".join(f"{name} = {VALUES[name]}" for name in locked)
    text = f"lock = {list(locked)}\n[initial.{where}]\n{values}\n".replace("'", '"')
    tree = srm.load(write(tmp_path, zoo_urdf(), text))  # without the loop: any q will do
    mechanism = srm.Mechanism(tree.model, loops)
    kept = [name for name in free.joint_names if name not in locked]
    assert list(mechanism.joint_names) == kept
    whole = np.array(free.q0)
    for name in locked:
        set_position(free, whole, name, VALUES[name])
    rows = sum(loop.rows.count for loop in loops)
    for q, v in states(mechanism.model):
        full_q, full_v, index = np.array(whole), np.zeros(free.model.nv), []
        for name in kept:
            ours, theirs = mechanism.joint(name), free.joint(name)
            full_q[theirs.idx_q : theirs.idx_q + theirs.nq] = q[ours.idx_q : ours.idx_q + ours.nq]
            full_v[theirs.idx_v : theirs.idx_v + theirs.nv] = v[ours.idx_v : ours.idx_v + ours.nv]
            index += range(theirs.idx_v, theirs.idx_v + theirs.nv)
        M = mass_matrix(free.model, full_q)[np.ix_(index, index)]
        np.testing.assert_allclose(mass_matrix(mechanism.model, q), M, atol=1e-13)
        np.testing.assert_allclose(
            nonlinear_effects(mechanism.model, q, v),
            nonlinear_effects(free.model, full_q, full_v)[index],
            atol=1e-12,
        )
        np.testing.assert_allclose(
            closure(mechanism, q, v), closure(free, full_q, full_v), atol=1e-13
        )
        np.testing.assert_array_equal(mechanism.model.damping, free.model.damping[index])
    assert rows == 3


def test_a_joint_locked_without_a_value_stays_at_zero(tmp_path: Path) -> None:
    bare = srm.load(write(tmp_path, zoo_urdf(), 'lock = ["track"]\n'))
    zero = srm.load(write(tmp_path, zoo_urdf(), 'lock = ["track"]\n[initial]\nq = { track = 0 }\n'))
    for q, _ in states(bare.model):
        np.testing.assert_array_equal(mass_matrix(bare.model, q), mass_matrix(zero.model, q))


def test_a_locked_joint_may_have_a_rate_of_zero(tmp_path: Path) -> None:
    toml = 'lock = ["track"]\n[initial]\nv = { track = 0.0, axle = 1.0 }\n'
    assert srm.load(write(tmp_path, zoo_urdf(), toml)).v0[1] == 1.0


def test_gravity_and_links_survive_locking(tmp_path: Path) -> None:
    toml = 'gravity = [1, 2, 3]\nlock = ["axle", "shoulder"]\n'
    model = srm.load(write(tmp_path, zoo_urdf(), toml)).model
    np.testing.assert_array_equal(model.gravity.linear, [1, 2, 3])
    bodies = {f.name for f in model.frames if f.type == pin.FrameType.BODY}
    assert bodies == {"base", *LINKS}
    assert not any("\0" in frame.name for frame in model.frames)


def test_locking_the_root_joint_fixes_the_base(tmp_path: Path) -> None:
    toml = (
        'base = "floating"\nlock = ["root_joint"]\n'
        "[initial]\nq = { root_joint = [1, 2, 3, 0, 0, 0, 1] }\n"
    )
    locked = srm.load(write(tmp_path, BASED, toml)).model
    fixed = srm.load(write(tmp_path, BASED)).model
    for q, _ in states(fixed):
        np.testing.assert_allclose(mass_matrix(locked, q), mass_matrix(fixed, q), atol=1e-13)
    assert locked.jointPlacements[1].translation[2] == pytest.approx(3.3)


def test_what_a_joint_would_do_does_not_matter_when_it_is_locked(tmp_path: Path) -> None:
    mimic = '<mimic joint="shoulder" multiplier="2"/>'
    text = zoo_urdf().replace('<dynamics damping="1.3"/>', mimic)
    assert len(srm.load(write(tmp_path, text)).loops) == 1
    mechanism = srm.load(write(tmp_path, text, 'lock = ["track"]\n'))
    assert mechanism.joint_names == ("shoulder", "axle", "pond")
    assert not mechanism.loops


def test_a_massless_end_may_be_locked(tmp_path: Path) -> None:
    end = (
        '<link name="flag"/><joint name="pole" type="continuous"><parent link="raft"/>'
        '<child link="flag"/></joint></robot>'
    )
    text = zoo_urdf().replace("</robot>", end)
    with pytest.raises(srm.InputError, match=r"'pole'.*inertia"):
        srm.load(write(tmp_path, text))
    assert srm.load(write(tmp_path, text, 'lock = ["pole"]\n')).model.nv == 6


def with_flag() -> str:
    """The zoo with a massless chain of two links, whose tip follows its first joint."""
    end = (
        '<link name="flag"/><joint name="pole" type="continuous"><parent link="raft"/>'
        '<child link="flag"/><axis xyz="0 0 1"/></joint><link name="pennant"/>'
        '<joint name="rope" type="revolute"><parent link="flag"/><child link="pennant"/>'
        '<axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/>'
        '<mimic joint="pole" multiplier="2"/></joint></robot>'
    )
    return zoo_urdf().replace("</robot>", end)


def test_joints_of_massless_ends_are_locked_on_request_and_named(tmp_path: Path) -> None:
    with pytest.raises(srm.InputError, match=r'massless="fix".*massless={"mass"') as caught:
        srm.load(write(tmp_path, with_flag()))
    assert caught.value.element == "joint 'pole'"
    plain_zoo = srm.load(write(tmp_path, zoo_urdf()))
    path = write(tmp_path, with_flag())
    described = write(tmp_path, with_flag(), 'massless = "fix"\n')
    for mechanism in (srm.load(path, massless="fix"), srm.load(described)):
        assert mechanism.joint_names == plain_zoo.joint_names
        assert mechanism.loops == ()
        (note,) = (note for note in mechanism.notes if "massless" in note)
        assert "'pole', 'rope', and their couplings left out: 'pole', 'rope'" in note


def test_links_of_massless_ends_get_a_stated_inertia(tmp_path: Path) -> None:
    """As the same file with these balls written into it."""
    ball = (
        '<inertial><mass value="0.25"/>'
        '<inertia ixx="0.5" iyy="0.5" izz="0.5" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    written = with_flag()
    for name in ("flag", "pennant"):
        written = written.replace(f'<link name="{name}"/>', f'<link name="{name}">{ball}</link>')
    expected = srm.load(write(tmp_path, written))
    given = {"mass": 0.25, "inertia": 0.5}
    mechanism = srm.load(write(tmp_path, with_flag()), massless=given)
    assert any("0.25 kg and 0.5 kg m^2" in note and "'rope'" in note for note in mechanism.notes)
    for q, _ in states(mechanism.model):
        found, wanted = (mass_matrix(m.model, q) for m in (mechanism, expected))
        np.testing.assert_allclose(found, wanted, atol=1e-14)
    run = srm.simulate(mechanism, 0.1)
    run.save(tmp_path / "run.npz")
    again = srm.load_solution(tmp_path / "run.npz")
    np.testing.assert_array_equal(again.q, run.q)
    assert again.mechanism.model.inertias[-1].mass == 0.25


@pytest.mark.parametrize("given", ["weld", {"mass": 1.0}, {"mass": -1.0, "inertia": 1.0}])
def test_other_treatments_of_massless_ends_are_refused(given: Any, tmp_path: Path) -> None:
    with pytest.raises(srm.InputError, match=r'Write "fix", or \{ mass') as caught:
        srm.load(write(tmp_path, with_flag()), massless=given)
    assert caught.value.element == "massless"


def test_a_file_without_inertia_is_told_what_moves_it(tmp_path: Path) -> None:
    """As most URDFs of industry are, whose joints would all be locked."""
    text = re.sub(r"<inertial>.*?</inertial>", "", zoo_urdf(), flags=re.DOTALL)
    with pytest.raises(srm.InputError, match=r"nothing in this mechanism can move") as caught:
        srm.load(write(tmp_path, text), massless="fix")
    assert 'massless={"mass"' in caught.value.remedy
    given = {"mass": 1.0, "inertia": 0.1}
    assert srm.load(write(tmp_path, text), massless=given).model.nv == zoo_model().nv


def test_an_axis_that_is_turned_by_zero_is_an_axis(tmp_path: Path) -> None:
    turned = zoo_urdf().replace("<axis ", '<axis rpy="0 0 0" ')
    models = [srm.load(write(tmp_path, text)).model for text in (zoo_urdf(), turned)]
    assert models[0] == models[1]


def test_a_massless_link_inside_a_chain_is_no_fault(tmp_path: Path) -> None:
    text = zoo_urdf()
    inertial = INERTIAL.format(**LINKS["slide"])
    assert inertial in text
    assert srm.load(write(tmp_path, text.replace(inertial, ""))).model.nv == 6


def test_locking_one_bar_of_a_loop_leaves_its_freedom(tmp_path: Path) -> None:
    """A five-bar with a locked crank is a four-bar."""
    locked = ("format = 1", 'format = 1\nlock = ["crank_right"]')
    path = rewritten(tmp_path, "five_bar", locked, (", crank_right = 0.0", ""))
    mechanism = srm.load(path)
    assert mechanism.joint_names == ("crank_left", "coupler_left", "coupler_right")
    assert mechanism.degrees_of_freedom == 1
    full = load("five_bar")
    by_name = dict(zip(full.joint_names, full.q0))
    np.testing.assert_allclose(
        mechanism.q0, [by_name[name] for name in mechanism.joint_names], atol=1e-10
    )


# --- what loading keeps -------------------------------------------------------------------------


def test_simulation_defaults_are_kept(tmp_path: Path) -> None:
    toml = "[simulation]\nt_end = 3\nrtol = 1e-7\natol = 1e-9\n"
    defaults = srm.load(write(tmp_path, zoo_urdf(), toml)).defaults
    assert (defaults.t_end, defaults.rtol, defaults.atol) == (3.0, 1e-7, 1e-9)
    silent = srm.load(write(tmp_path, zoo_urdf())).defaults
    assert (silent.t_end, silent.rtol, silent.atol) == (None, None, None)


def test_the_name_is_the_descriptions_or_else_the_robots(tmp_path: Path) -> None:
    assert srm.load(write(tmp_path, zoo_urdf(), 'name = "mine"\n')).name == "mine"
    assert srm.load(write(tmp_path, zoo_urdf())).name == "zoo"


def test_a_mechanism_is_rebuilt_from_its_texts_alone(tmp_path: Path) -> None:
    toml = 'lock = ["track"]\n[initial]\nguess = { axle = 0.5 }\n'
    mechanism = srm.load(write(tmp_path, BASED, toml), base="planar", gravity=[0, 1, 0])
    for file in tmp_path.iterdir():
        file.unlink()
    assert mechanism.source is not None
    again = rebuild(mechanism.source)
    assert again.joint_names == mechanism.joint_names
    np.testing.assert_array_equal(again.model.gravity.linear, [0, 1, 0])
    for q, _ in states(again.model):
        np.testing.assert_array_equal(mass_matrix(again.model, q), mass_matrix(mechanism.model, q))


def test_loading_is_deterministic_and_shares_nothing() -> None:
    first, second = srm.load("four_bar"), srm.load("four_bar")
    np.testing.assert_array_equal(first.q0, second.q0)
    assert first.model is not second.model
    second.model.gravity.linear = np.zeros(3)
    assert first.model.gravity.linear[2] == -9.81


def test_an_identical_loop_is_refused_with_both_names(tmp_path: Path) -> None:
    loop = _loop_of_the_four_bar()
    double = (loop, loop + loop.replace('"pin"', '"again"'))
    with pytest.raises(srm.InputError, match="loop 'again': it is the same closure as loop 'pin'"):
        srm.load(rewritten(tmp_path, "four_bar", double))


def _loop_of_the_four_bar() -> str:
    text = (models_folder() / "four_bar.toml").read_text()
    return text[text.index("[[loop]]") : text.index("[initial]")]


def test_a_loop_that_repeats_another_is_redundant_but_harmless(tmp_path: Path) -> None:
    loop = _loop_of_the_four_bar()
    exchanged = loop.replace("\na =", "\nc =").replace("\nb =", "\na =").replace("\nc =", "\nb =")
    double = (loop, loop + exchanged.replace('"pin"', '"again"'))
    mechanism = srm.load(rewritten(tmp_path, "four_bar", double))
    assert mechanism.degrees_of_freedom == 1
    assert mechanism.redundant_rows == ("pin.y", "again.y")
    np.testing.assert_allclose(mechanism.q0, load("four_bar").q0, atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "axis", "redundant"),
    [
        ("point", None, ("pin.y",)),
        ("revolute", [0.0, 1.0, 0.0], ("pin.y", "pin.axis_1", "pin.axis_2")),
        ("revolute", [0.0, -3.0, 0.0], ("pin.y", "pin.axis_1", "pin.axis_2")),
    ],
)
def test_redundant_rows_of_a_planar_loop_are_named_and_left_out(
    kind: str, axis: list[float] | None, redundant: tuple[str, ...], tmp_path: Path
) -> None:
    line = "" if axis is None else f"\naxis = {axis}"
    closure = ('type = "point"', f'type = "{kind}"{line}')
    mechanism = srm.load(rewritten(tmp_path, "four_bar", closure))
    assert mechanism.redundant_rows == redundant
    assert mechanism.degrees_of_freedom == 1
    np.testing.assert_allclose(mechanism.q0, load("four_bar").q0, atol=1e-12)


# --- robots of other people ---------------------------------------------------------------------


def robots_folder() -> Path:
    """Of example-robot-data, which ships data and no Python module."""
    try:
        files = metadata.files("example-robot-data") or []
    except metadata.PackageNotFoundError:  # pragma: no cover
        files = []
    for file in files:
        parts = file.parts
        if "robots" in parts and file.suffix == ".urdf":
            at = Path(str(file.locate()))
            return at.parents[len(parts) - parts.index("robots") - 2]
    pytest.skip("example-robot-data lists no URDF")


def robots() -> list[Path]:
    return sorted(robots_folder().rglob("*.urdf"))


# Why a published robot is refused: what the file asks for acts, and this version cannot do it.
JUSTIFIED = {
    "mimic": re.compile(r"joint '.+', <mimic>: there is no joint '.+'"),  # names without prefix
    "inertia": re.compile(r"link '.+': a principal moment of inertia is negative"),
    "empty": re.compile(r"<robot>: it has no name"),  # an empty file by a failed xacro run
    "massless": re.compile(r"neither '.+' nor anything that it carries has inertia"),
    "rigid": re.compile(r"nothing in this mechanism can move"),
}


@pytest.mark.filterwarnings("ignore::srm_mbs.errors.SrmWarning")
def test_published_robots_load_or_are_refused_for_what_acts(
    capfd: pytest.CaptureFixture[str],
) -> None:
    found = robots()
    assert len(found) > 50
    reasons: dict[str, list[str]] = {}
    loaded = 0
    for path in found:
        try:
            mechanism = srm.load(path)
        except srm.InputError as error:
            text = str(error)
            assert text.startswith(str(path))
            reason = next((key for key, form in JUSTIFIED.items() if form.search(text)), None)
            assert reason, f"refused for no good reason: {text}"
            reasons.setdefault(reason, []).append(path.name)
        else:
            loaded += 1
            assert {loop.type for loop in mechanism.loops} <= {"coupling"}  # mimic joints
            assert mechanism.degrees_of_freedom == mechanism.model.nv - len(mechanism.loops) > 0
            assert mechanism.joint_names == tuple(pin.buildModelFromUrdf(str(path)).names)[1:]
    capfd.readouterr()  # Pinocchio's own reader, called for comparison, may complain
    assert loaded > len(found) / 2, reasons
    assert len(reasons.get("empty", [])) <= 1
    # Reading a file again with our reader writes nothing to the terminal.
    srm.load(found[0])
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "name", ["ur5_robot.urdf", "anymal.urdf", "so101.urdf", "double_pendulum_continuous.urdf"]
)
@pytest.mark.filterwarnings("ignore::srm_mbs.errors.SrmWarning")
def test_published_robots_are_pinocchios_models(name: str) -> None:
    path = next(path for path in robots() if path.name == name)
    ours, theirs = srm.load(path).model, pin.buildModelFromUrdf(str(path))
    assert_same_dynamics(ours, theirs, atol=1e-10)


@pytest.mark.filterwarnings("ignore::srm_mbs.errors.SrmWarning")
def test_a_legged_robot_floats_and_stands_on_a_loop() -> None:
    """Four feet on the ground: closures on frames of a published robot."""
    path = next(path for path in robots() if path.name == "solo12.urdf")
    mechanism = srm.load(path, base="floating")
    assert mechanism.model.nv == 18
    model = mechanism.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, mechanism.q0)
    feet = [f"{a}{b}_FOOT" for a, b in itertools.product("FH", "LR")]
    loops = [
        srm.LoopClosure(
            "point",
            srm.Anchor(foot),
            srm.Anchor("world", xyz=tuple(data.oMf[model.getFrameId(foot)].translation)),
        )
        for foot in feet
    ]
    standing = srm.Mechanism(model, loops, q0=mechanism.q0)
    state = srm.assemble(standing, guess={"root_joint": [0, 0, -0.05, 0, 0, 0, 1]})
    assert np.abs(state.residuals).max() < 1e-12


@pytest.mark.parametrize("n", [1001, 9999, 123456789])
def test_an_n_four_bar_that_would_not_fit_is_refused(n: int) -> None:
    with pytest.raises(srm.InputError, match=f"N = {n} is too large.*N <= 1000"):
        srm.load(f"n_four_bar_{n}")
    with pytest.raises(srm.InputError, match="too large"):
        srm.n_four_bar(n)


def test_without_the_kernel_an_n_four_bar_must_be_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("srm_mbs._kernel.core", None)
    with pytest.raises(srm.InputError, match=r"too large.*N <= 300, or N <= 1000 with the comp"):
        srm.n_four_bar(301)


def test_a_table_that_is_there_twice_is_refused_with_the_brackets_of_a_list(tmp_path: Path) -> None:
    path = tmp_path / "two.toml"
    path.write_text('format = 1\n[loop]\nname = "a"\n[loop]\nname = "b"\n', encoding="utf-8")
    with pytest.raises(srm.InputError, match=r"double brackets .* as \[\[loop\]\]"):
        srm.load(path)
