"""Loops that a URDF brings along, in the words of each tool: the closures are what these say."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from tests.support.dynamics import closure, mass_matrix
from tests.support.snapshots import check_messages, refused
from tests.support.urdf_files import (
    AXIS,
    ON_RIM,
    ON_SHIN,
    configuration,
    open_mechanism,
    placement,
    relative,
    text,
    tree,
)

SHIN = f'xyz="{text(ON_SHIN[0])}" rpy="{text(ON_SHIN[1])}"'
RIM = f'xyz="{text(ON_RIM[0])}" rpy="{text(ON_RIM[1])}"'
DIRECTION = f'<axis xyz="{text(AXIS)}"/>'
DRAKE = 'xmlns:drake="http://drake.mit.edu"'


def urdf_plus(kind: str) -> str:
    axis = "" if kind in ("fixed", "spherical") else DIRECTION
    return (
        f'<loop name="ring" type="{kind}"><predecessor link="shin"><origin {SHIN}/></predecessor>'
        f'<successor link="rim"><origin {RIM}/></successor>{axis}</loop>'
    )


def isaac(kind: str, second: str = "link2") -> str:
    axis = "" if kind in ("fixed", "spherical") else DIRECTION
    return (
        f'<loop_joint name="ring" type="{kind}"><link1 link="shin" {SHIN}/>'
        f'<{second} link="rim" {RIM}/>{axis}</loop_joint>'
    )


def urdfdom(kind: str, axes: str = "") -> str:
    return (
        f'<constraint name="ring" type="{kind}"><parent link="shin"/><parent_origin {SHIN}/>'
        f'<child link="rim"/><child_origin {RIM}/>{axes}</constraint>'
    )


BOTH_AXES = f'<parent_axis xyz="{text(AXIS)}"/><child_axis xyz="{text(AXIS)}"/>'


def ball_constraint(declared: str = DRAKE) -> str:
    return (
        f'<drake:ball_constraint name="ring" {declared}>'
        '<drake:ball_constraint_body_A name="shin"/><drake:ball_constraint_body_B name="rim"/>'
        f'<drake:ball_constraint_p_AP value="{text(ON_SHIN[0])}"/>'
        f'<drake:ball_constraint_p_BQ value="{text(ON_RIM[0])}"/></drake:ball_constraint>'
    )


# Element, type of the closure.
CASES = {
    **{f"URDF+ {kind}": (urdf_plus(kind), closed) for kind, closed in (
        ("revolute", "revolute"), ("continuous", "revolute"), ("fixed", "frame"),
        ("spherical", "point"), ("prismatic", "prismatic"), ("planar", "planar"),
    )},
    "Isaac spherical": (isaac("spherical"), "point"),
    "Isaac with link1 twice": (isaac("fixed", "link1"), "frame"),
    "Isaac revolute": (isaac("revolute"), "revolute"),
    "urdfdom revolute": (urdfdom("revolute", BOTH_AXES), "revolute"),
    "urdfdom prismatic": (urdfdom("prismatic", BOTH_AXES), "prismatic"),
    "urdfdom cylindrical": (urdfdom("cylindrical", BOTH_AXES), "cylindrical"),
    "urdfdom one axis": (urdfdom("revolute", f'<parent_axis xyz="{text(AXIS)}"/>'), "revolute"),
    "urdfdom spherical": (urdfdom("spherical"), "point"),
    "urdfdom fixed": (urdfdom("fixed"), "frame"),
    "Drake ball": (ball_constraint(), "point"),
    "Drake ball, prefix not declared": (ball_constraint(""), "point"),
}  # fmt: skip


def gaps(kind: str, between: pin.SE3) -> tuple[float, float]:
    """Norms of what vanishes when a joint is closed: of positions, and of angles."""
    p, R = between.translation, between.rotation
    n = np.array(AXIS) / 3.0
    tilt = float(np.linalg.norm(np.cross(n, R @ n)))
    turn = float(np.linalg.norm([R[2, 1], R[0, 2], R[1, 0]]))
    whole, across, along = (
        float(np.linalg.norm(part)) for part in (p, p - n * (n @ p), n * (n @ p))
    )
    return {
        "point": (whole, 0.0),
        "frame": (whole, turn),
        "revolute": (whole, tilt),
        "prismatic": (across, turn),
        "cylindrical": (across, tilt),
        "planar": (along, tilt),
    }[kind]


def write(folder: Path, urdf: str, name: str = "robot.urdf") -> Path:
    path = folder / name
    path.write_text(urdf, encoding="utf-8")
    return path


def random_positions(count: int = 3) -> FloatArray:
    return np.random.default_rng(7).uniform(-1.5, 1.5, (count, 4))


def measured(mechanism: srm.Mechanism, q: FloatArray) -> tuple[float, float]:
    """Norms of the position and of the other rows of the only loop."""
    model = mechanism.model
    (loop,) = mechanism.loops
    g = closure(mechanism, configuration(model, q), np.zeros(model.nv))[: loop.rows.count]
    split = len(loop.rows.directions)
    return float(np.linalg.norm(g[:split])), float(np.linalg.norm(g[split:]))


Rows = Callable[[FloatArray], tuple[float, float]]
"""Norms of the position and of the other rows at q (4,)."""


def check_rows(mechanism: srm.Mechanism, expected: Rows) -> None:
    for q in random_positions():
        assert measured(mechanism, q) == pytest.approx(expected(q), abs=1e-12)


def names_and_types(mechanism: srm.Mechanism) -> list[tuple[str, str]]:
    return [(loop.name, loop.type) for loop in mechanism.loops]


NOWHERE = ((0, 0, 0), (0, 0, 0))
"""The frame of a link itself."""


@pytest.mark.parametrize("case", CASES)
def test_a_loop_element_is_the_closure_that_it_says(case: str, tmp_path: Path) -> None:
    element, kind = CASES[case]
    mechanism = open_mechanism(write(tmp_path, tree(element)))
    assert names_and_types(mechanism) == [("ring", kind)]
    # Drake places points, not frames.
    ends = (ON_SHIN, ON_RIM)
    if "Drake" in case:
        ends = ((ON_SHIN[0], (0, 0, 0)), (ON_RIM[0], (0, 0, 0)))
    check_rows(mechanism, lambda q: gaps(kind, relative(q, *ends)))


def test_axes_that_differ_in_the_two_frames_are_brought_into_line(tmp_path: Path) -> None:
    """A hinge about x of one frame and y of the other; of a slider the same is an error."""
    axes = '<parent_axis xyz="1 0 0"/><child_axis xyz="0 1 0"/>'
    mechanism = open_mechanism(write(tmp_path, tree(urdfdom("revolute", axes))))

    def rows(q: FloatArray) -> tuple[float, float]:
        between = relative(q)
        tilt = np.linalg.norm(np.cross([1.0, 0.0, 0.0], between.rotation @ [0.0, 1.0, 0.0]))
        return np.linalg.norm(between.translation), tilt

    check_rows(mechanism, rows)
    with pytest.raises(srm.InputError, match=r"'ring'.*axes.*differ"):
        srm.load(write(tmp_path, tree(urdfdom("prismatic", axes))))


def test_the_cross_of_a_universal_closure_has_an_axis_on_either_side(tmp_path: Path) -> None:
    axes = '<parent_axis xyz="1 0 0"/><child_axis xyz="0 3 4"/>'
    mechanism = open_mechanism(write(tmp_path, tree(urdfdom("universal", axes))))

    def rows(q: FloatArray) -> tuple[float, float]:
        between = relative(q)
        return np.linalg.norm(between.translation), abs(between.rotation[0] @ [0.0, 0.6, 0.8])

    check_rows(mechanism, rows)


# --- a child of two parents, and joints inside <gazebo> ----------------------------------------

SECOND = """<joint name="{name}" type="{kind}"><parent link="shin"/><child link="rim"/>
  <origin {origin}/>{axis}{more}</joint>"""


def second(kind: str, more: str = "", name: str = "second") -> str:
    axis = "" if kind == "fixed" else DIRECTION
    return SECOND.format(name=name, kind=kind, origin=SHIN, axis=axis, more=more)


@pytest.mark.parametrize(
    ("kind", "closed"),
    [
        ("revolute", "revolute"),
        ("prismatic", "prismatic"),
        ("fixed", "frame"),
        ("spherical", "point"),
    ],
)
def test_the_second_joint_of_a_child_becomes_a_closure(
    kind: str, closed: str, tmp_path: Path
) -> None:
    """Its frame on the child is the child's own: the closure is closed at the joint's zero."""
    mechanism = open_mechanism(write(tmp_path, tree(second(kind))))
    assert names_and_types(mechanism) == [("second", closed)]
    assert "second" not in mechanism.joint_names
    check_rows(mechanism, lambda q: gaps(closed, relative(q, ON_SHIN, NOWHERE)))


GLUED = (
    '<link name="plate"/><joint name="glue" type="fixed"><parent link="rim"/><child link="plate"/>'
    '<origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/></joint>'
)
AGAIN = (
    '<joint name="again" type="{kind}"><parent link="rim"/><child link="plate"/>'
    '<origin xyz="0.1 {y} 0.3" rpy="0.4 0.5 0.6"/><axis xyz="1 0 0"/>{more}</joint>'
)


@pytest.mark.parametrize("kind", ["fixed", "revolute", "prismatic", "spherical"])
def test_a_joint_that_fixed_joints_satisfy_already_is_left_out(kind: str, tmp_path: Path) -> None:
    """To the rounding of the file."""
    for y in ("0.2", "0.2000003"):
        more = '<dynamics damping="0.1"/>' if kind in ("revolute", "prismatic") else ""
        again = AGAIN.format(kind=kind, y=y, more=more)
        mechanism = srm.load(write(tmp_path, tree(GLUED + again)))
        assert not mechanism.loops
        assert not mechanism.forces
        assert any("'again' join bodies that other joints already" in n for n in mechanism.notes)
    loop = (
        '<loop name="again" type="fixed"><predecessor link="plate"/><successor link="rim">'
        '<origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/></successor></loop>'
    )
    assert not srm.load(write(tmp_path, tree(GLUED + loop))).loops
    for wrong in (AGAIN.format(kind=kind, y="0.21", more=""), loop.replace("0.2 0.3", "0.2 0.4")):
        with pytest.raises(srm.InputError, match="'again'"):
            srm.load(write(tmp_path, tree(GLUED + wrong)))


def test_a_second_joint_that_restrains_nothing_is_left_out(tmp_path: Path) -> None:
    assert not open_mechanism(write(tmp_path, tree(second("floating")))).loops


def gazebo(kind: str, inside: str) -> str:
    return (
        f'<gazebo><joint name="ring" type="{kind}"><parent>shin</parent><child>rim</child>'
        f"{inside}</joint></gazebo>"
    )


POSE = f"<pose>{text(ON_RIM[0])} {text(ON_RIM[1])}</pose>"
GAZEBO = {
    "revolute": ("revolute", f"<axis><xyz>{text(AXIS)}</xyz></axis>"),
    "prismatic": ("prismatic", f"<axis><xyz>{text(AXIS)}</xyz></axis>"),
    "ball": ("point", ""),
    "fixed": ("frame", ""),
}


@pytest.mark.parametrize("pose", ["", POSE])
@pytest.mark.parametrize("kind", GAZEBO)
def test_a_joint_inside_gazebo_is_closed_where_it_stands_at_zero(
    kind: str, pose: str, tmp_path: Path
) -> None:
    closed, inside = GAZEBO[kind]
    mechanism = open_mechanism(write(tmp_path, tree(gazebo(kind, pose + inside))))
    assert mechanism.loops[0].type == closed
    on_rim = ON_RIM if pose else NOWHERE
    at_zero = relative(np.zeros(4), NOWHERE, on_rim)
    check_rows(mechanism, lambda q: gaps(closed, at_zero.actInv(relative(q, NOWHERE, on_rim))))
    assert measured(mechanism, np.zeros(4)) == pytest.approx((0.0, 0.0), abs=1e-14)


def test_an_axis_in_the_frame_of_the_model_is_turned_into_that_of_the_joint(tmp_path: Path) -> None:
    inside = "<axis><xyz>0 0 1</xyz><use_parent_model_frame>1</use_parent_model_frame></axis>"
    mechanism = open_mechanism(write(tmp_path, tree(gazebo("revolute", inside))))
    model = pin.buildModelFromXML(tree())
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    rim = data.oMf[model.getFrameId("rim")].rotation
    np.testing.assert_allclose(mechanism.loops[0].axis, rim.T @ [0.0, 0.0, 1.0], atol=1e-14)


# --- couplings -----------------------------------------------------------------------------------


NUT = """<robot name="nut">{links}
<joint name="track" type="prismatic"><parent link="base"/><child link="slide"/>
  <origin xyz="0 0.2 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
</joint><joint name="spin" type="continuous"><parent link="slide"/><child link="wheel"/>
  <origin xyz="0.1 0 0"/><axis xyz="0 1 0"/></joint>{thread}</robot>"""
NUT_LINK = (
    '<link name="{}"><inertial><origin xyz="0.1 0 0.05"/><mass value="1"/>'
    '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
THREAD = (
    '<gazebo><joint name="thread" type="screw"><parent>{}</parent><child>{}</child>{}'
    "<axis><xyz>0 1 0</xyz></axis>{}</joint></gazebo>"
)


@pytest.mark.parametrize(
    ("parent", "child", "pose", "pitch"),
    [
        ("base", "wheel", "", "<thread_pitch>50</thread_pitch>"),
        ("base", "wheel", "<pose>0 0.1 0 0 0 0</pose>", "<thread_pitch>50</thread_pitch>"),
        (
            "wheel",
            "base",
            "<pose>0.1 0.2 0 0 0 0</pose>",
            f"<screw_thread_pitch>{-2.0 * np.pi / 50.0}</screw_thread_pitch>",
        ),
        ("world", "wheel", "<pose>0 0.1 0 0 0 0</pose>", "<thread_pitch>50</thread_pitch>"),
        ("wheel", "world", "<pose>0.1 0.2 0 0 0 0</pose>", "<thread_pitch>50</thread_pitch>"),
    ],
)
def test_a_screw_of_gazebo_goes_into_the_tree_and_what_held_its_child_is_cut(
    parent: str, child: str, pose: str, pitch: str, tmp_path: Path
) -> None:
    """A nut that slides while it turns: a coupling of the two joints is the same."""
    links = "".join(NUT_LINK.format(name) for name in ("base", "slide", "wheel"))
    text = NUT.format(links=links, thread=THREAD.format(parent, child, pose, pitch))
    mechanism = srm.load(write(tmp_path, text), gravity=(0.0, 9.0, 0.0))
    assert mechanism.degrees_of_freedom == 1
    assert names_and_types(mechanism) == [("spin", "revolute")]
    coupled = NUT.format(links=links, thread="")
    mimic = '<mimic joint="spin" multiplier="-0.02"/></joint><joint name="spin"'
    reference = srm.load(
        write(tmp_path, coupled.replace('</joint><joint name="spin"', mimic), "coupled.urdf"),
        gravity=(0.0, 9.0, 0.0),
    )
    runs = [srm.simulate(m, 2.0, rtol=1e-10) for m in (mechanism, reference)]
    track, expected = (run(2.0)[0][run.mechanism.joint("track").idx_q] for run in runs)
    assert expected > 1e-3
    assert track == pytest.approx(expected, rel=1e-8)


def test_two_screws_of_gazebo_on_one_link_hold_one_link_each(tmp_path: Path) -> None:
    """A spindle with threads of both hands, as a gripper has it: couplings of the joints are the
    same."""
    links = "".join(NUT_LINK.format(name) for name in ("base", "slide", "wheel", "second"))
    other = (
        '<joint name="other" type="prismatic"><parent link="base"/><child link="second"/>'
        '<origin xyz="0.1 0.5 0"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/>{}</joint>'
    )
    threads = THREAD.format("base", "wheel", "", "<thread_pitch>50</thread_pitch>")
    threads += THREAD.format("second", "wheel", "", "<thread_pitch>-50</thread_pitch>").replace(
        '"thread"', '"left_thread"'
    )
    path = write(tmp_path, NUT.format(links=links, thread=other.format("") + threads))
    mechanism = srm.load(path, gravity=(0.0, 9.0, 0.0))
    assert mechanism.degrees_of_freedom == 1
    assert sorted(loop.type for loop in mechanism.loops) == ["prismatic", "revolute"]
    coupled = NUT.format(
        links=links, thread=other.format('<mimic joint="spin" multiplier="-0.04"/>')
    )
    mimic = '<mimic joint="spin" multiplier="-0.02"/></joint><joint name="spin"'
    reference = srm.load(
        write(tmp_path, coupled.replace('</joint><joint name="spin"', mimic, 1), "coupled.urdf"),
        gravity=(0.0, 9.0, 0.0),
    )
    runs = [srm.simulate(m, 2.0, rtol=1e-10) for m in (mechanism, reference)]
    places = []
    for run in runs:
        model, data = run.mechanism.model, run.mechanism.model.createData()
        pin.framesForwardKinematics(model, data, run(2.0)[0])
        places.append(data.oMf[model.getFrameId("second")].translation)
    assert abs(places[1][1] - 0.5) > 1e-3
    np.testing.assert_allclose(places[0], places[1], atol=1e-9)


def test_a_third_screw_between_two_links_that_screws_hold_gets_a_share_of_one(
    tmp_path: Path,
) -> None:
    """Here it repeats another one, and changes nothing."""
    links = "".join(NUT_LINK.format(name) for name in ("base", "slide", "wheel", "second"))
    other = (
        '<joint name="other" type="prismatic"><parent link="base"/><child link="second"/>'
        '<origin xyz="0.1 0.5 0"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )
    threads = THREAD.format("base", "wheel", "", "<thread_pitch>50</thread_pitch>")
    left = THREAD.format("second", "wheel", "{}", "<thread_pitch>-50</thread_pitch>")
    threads += left.format("").replace('"thread"', '"left"')
    ends = []
    for pose in (None, "", "<pose>0 0.1 0 0 0 0</pose>"):
        more = "" if pose is None else left.format(pose).replace('"thread"', '"again"')
        path = write(tmp_path, NUT.format(links=links, thread=other + threads + more))
        mechanism = srm.load(path, gravity=(0.0, 9.0, 0.0))
        assert mechanism.degrees_of_freedom == 1
        assert len(mechanism.loops) == (2 if pose is None else 3)
        ends.append(end_of(mechanism, "second", srm.simulate(mechanism, 1.0, rtol=1e-10).q[-1]))
    assert abs(ends[0][1] - 0.5) > 1e-3
    np.testing.assert_allclose(ends[1:], [ends[0]] * 2, atol=1e-9)


def test_a_screw_of_gazebo_on_the_ground_needs_a_base_that_the_ground_holds(tmp_path: Path) -> None:
    links = "".join(NUT_LINK.format(name) for name in ("base", "slide", "wheel"))
    thread = THREAD.format("world", "wheel", "", "<thread_pitch>50</thread_pitch>")
    path = write(tmp_path, NUT.format(links=links, thread=thread))
    with pytest.raises(srm.InputError, match="a base that is not fixed"):
        srm.load(path, base="floating")
    described = tmp_path / "nut.toml"
    described.write_text(f'format = 1\nurdf = "{path.name}"\nbase = "planar"\n')
    with pytest.raises(srm.InputError, match="a base that is not fixed"):
        srm.load(described)
    assert srm.load(described, base="fixed").degrees_of_freedom == 1


def relation(mechanism: srm.Mechanism, q: FloatArray) -> float:
    model = mechanism.model
    return float(closure(mechanism, configuration(model, q), np.zeros(model.nv))[0])


def check_relation(mechanism: srm.Mechanism, expected: Callable[[FloatArray], float]) -> None:
    """The row, up to its sign."""
    for q in random_positions():
        assert abs(relation(mechanism, q)) == pytest.approx(abs(expected(q)), abs=1e-13)


def test_a_mimic_joint_is_a_coupling(tmp_path: Path) -> None:
    mimic = '<mimic joint="hip" multiplier="-2.5" offset="0.3"/>'
    mechanism = open_mechanism(write(tmp_path, tree(joints={"wheel": mimic})))
    assert names_and_types(mechanism) == [("mimic_wheel", "coupling")]
    check_relation(mechanism, lambda q: q[3] + 2.5 * q[0] - 0.3)
    loaded = srm.load(tmp_path / "robot.urdf")
    assert loaded.degrees_of_freedom == 3
    assert closure(loaded, loaded.q0, loaded.v0)[0] == pytest.approx(0.0, abs=1e-12)


def test_a_mimic_of_defaults_ties_a_continuous_joint_that_counts_turns(tmp_path: Path) -> None:
    mechanism = open_mechanism(write(tmp_path, tree(joints={"knee": '<mimic joint="wheel"/>'})))
    assert mechanism.model.nq == mechanism.model.nv == 4
    q = np.array([0.1, 9.0, 0.2, 9.0])
    assert relation(mechanism, q) == pytest.approx(0.0, abs=1e-14)


def test_a_mimic_with_multiplier_zero_holds_the_joint_at_its_offset(tmp_path: Path) -> None:
    mimic = '<mimic joint="hip" multiplier="0" offset="0.4"/>'
    mechanism = srm.load(write(tmp_path, tree(joints={"wheel": mimic})))
    assert mechanism.q0[mechanism.joint("wheel").idx_q] == pytest.approx(0.4)


@pytest.mark.parametrize("kind", ["", 'type="rolling"'])
def test_a_coupling_sums_the_joints_of_both_branches(kind: str, tmp_path: Path) -> None:
    """URDF+: ratio times the sum down to the predecessor is the sum down to the successor."""
    element = (
        f'<coupling name="belt" {kind}><predecessor link="shin"/><successor link="slide"/>'
        '<ratio value="3"/></coupling>'
    )
    mechanism = open_mechanism(write(tmp_path, tree(element)))
    check_relation(mechanism, lambda q: q[2] - 3.0 * (q[0] + q[1]))


# --- springs of Drake ----------------------------------------------------------------------------

SPRING = (
    f"<drake:linear_spring_damper {DRAKE}>"
    '<drake:linear_spring_damper_body_A name="shin"/>'
    f'<drake:linear_spring_damper_p_AP value="{text(ON_SHIN[0])}"/>'
    '<drake:linear_spring_damper_body_B name="world"/>'
    '<drake:linear_spring_damper_p_BQ value="1 2 3"/>'
    '<drake:linear_spring_damper_free_length value="0.7"/>'
    '<drake:linear_spring_damper_stiffness value="80"/>'
    '<drake:linear_spring_damper_damping value="9"/></drake:linear_spring_damper>'
)


def test_a_spring_of_drake_is_a_spring_damper(tmp_path: Path) -> None:
    mechanism = srm.load(write(tmp_path, tree(SPRING)))
    (spring,) = mechanism.forces
    assert isinstance(spring, srm.SpringDamper)
    assert (spring.a.link, spring.a.xyz) == ("shin", ON_SHIN[0])
    assert (spring.b.link, spring.b.xyz) == ("world", (1.0, 2.0, 3.0))
    assert (spring.rest_length, spring.stiffness, spring.damping) == (0.7, 80.0, 9.0)
    assert spring.name == "spring_damper_shin_world"


# --- whole mechanisms ----------------------------------------------------------------------------

BAR = """<link name="{name}"><inertial><origin xyz="{half} 0 0"/><mass value="1"/>
  <inertia ixx="0.001" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
HINGE = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{xyz}"/><axis xyz="0 -1 0"/><limit lower="-9" upper="9" effort="1" velocity="1"/>
  {more}</joint>"""


SLIDER = """<link name="slider"><inertial><mass value="2"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
GUIDE = """<joint name="guide" type="prismatic"><parent link="ground"/><child link="slider"/>
  <axis xyz="1 0 0"/><limit lower="-9" upper="9" effort="1" velocity="1"/>{more}</joint>"""


def slider_crank(on_pin: str = "", on_guide: str = "") -> str:
    """All four joints are in the URDF: the slider has two parents, rod and ground."""
    crank, rod = BAR.format(name="crank", half=0.25), BAR.format(name="rod", half=0.5)
    joints = [
        HINGE.format(name="a", parent="ground", child="crank", xyz="0 0 0", more=""),
        HINGE.format(name="b", parent="crank", child="rod", xyz="0.5 0 0", more=""),
        HINGE.format(name="pin", parent="rod", child="slider", xyz="1 0 0", more=on_pin),
        GUIDE.format(more=on_guide),
    ]
    links = f'<link name="ground"/>{crank}{rod}{SLIDER}'
    return "\n".join(['<robot name="slider_crank">', links, *joints, "</robot>"])


def described(folder: Path, urdf: str, entries: str = "") -> Path:
    """A description with these entries of a URDF that is written beside it."""
    write(folder, urdf)
    return write(folder, f'format = 1\nurdf = "robot.urdf"\n{entries}', "robot.toml")


def end_of(mechanism: srm.Mechanism, link: str, q: FloatArray) -> FloatArray:
    """World position of a link's frame."""
    data = mechanism.model.createData()
    pin.framesForwardKinematics(mechanism.model, data, q)
    at: FloatArray = data.oMf[mechanism.model.getFrameId(link)].translation.copy()
    return at


START = "[initial]\nq = { a = 1.2 }\nv = { a = 1.0 }\nguess = { b = -1.6 }\n"


def test_the_motion_does_not_depend_on_where_the_loop_is_cut(tmp_path: Path) -> None:
    """Nor on whether a damped joint is the one: it then becomes a bushing."""
    damped = '<dynamics damping="0.6"/>'
    ends = []
    for cut, name in (("", "guide"), ('cut = ["pin"]\n', "pin")):
        mechanism = srm.load(described(tmp_path, slider_crank(damped, damped), cut + START))
        assert [loop.name for loop in mechanism.loops] == [name]
        assert [force.name for force in mechanism.forces] == [f"{name}::damping"]
        assert mechanism.degrees_of_freedom == 1
        solution = srm.simulate(mechanism, 1.0, rtol=1e-10)
        ends.append(end_of(mechanism, "slider", solution.q[-1]))
        assert solution.energy[-1] - solution.energy[0] < -0.05
    assert abs(ends[0][0] - 0.5) > 0.01
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-7)


@pytest.mark.parametrize(
    ("on_guide", "wheel"),
    [
        ('<dynamics damping="0.6" friction="0.9"/>', ""),
        ('<dynamics armature="0.7"/>', ""),
        ("", '<mimic joint="guide" multiplier="3" offset="0.2"/>'),
    ],
)
def test_a_joint_whose_coordinate_is_needed_is_cut_with_a_share_of_its_link(
    on_guide: str, wheel: str, tmp_path: Path
) -> None:
    """The motion and its energy are those with the loop cut at another joint."""
    urdf = slider_crank(on_guide=on_guide)
    if wheel:
        wheel = HINGE.format(name="turn", parent="ground", child="wheel", xyz="0 0 2", more=wheel)
        urdf = urdf.replace("</robot>", f"{BAR.format(name='wheel', half=0.1)}{wheel}</robot>")
    runs = []
    for cut, name in (("", "slider::guide"), ('cut = ["pin"]\n', "pin")):
        guess = "b = -1.6, guide = 1.1" + ", turn = 3.4" * bool(wheel)
        start = START.replace("b = -1.6", guess)
        mechanism = srm.load(described(tmp_path, urdf, cut + start))
        assert mechanism.loops[0].name == name
        assert mechanism.degrees_of_freedom == 1
        runs.append(srm.simulate(mechanism, 1.0, rtol=1e-10))
    assert any(
        "'guide' close loops and their coordinates are needed" in note
        for note in runs[0].mechanism.notes
    )
    for joint in ("a", "b", "guide"):
        here, there = (float(run.joint(joint)[0][-1]) for run in runs)
        assert here == pytest.approx(there, abs=1e-7)
    for link in ("slider", "wheel") if wheel else ("slider",):
        ends = [end_of(run.mechanism, link, run.q[-1]) for run in runs]
        np.testing.assert_allclose(ends[0], ends[1], atol=1e-7)
    lost = [run.energy[-1] - run.energy[0] for run in runs]
    assert lost[0] == pytest.approx(lost[1], abs=1e-7)
    assert runs[0].energy[0] == pytest.approx(runs[1].energy[0], rel=1e-9)


@pytest.mark.parametrize("order", [("crank", "bar"), ("bar", "crank")])
def test_a_link_inside_gazebo_hangs_on_the_first_joint_that_holds_it(
    order: tuple[str, str], tmp_path: Path
) -> None:
    """A parallelogram whose coupler is inside <gazebo>, without weight, and the same in URDF."""
    bars = "".join(BAR.format(name=name, half=0.25) for name in ("crank", "rocker"))
    hinges = "".join(
        HINGE.format(name=f"on_{child}", parent="ground", child=child, xyz=f"{x} 0 1", more="")
        for child, x in (("crank", 0.0), ("rocker", 1.0))
    )
    frame = f'<robot name="bars"><link name="ground"/>{bars}{hinges}{{}}</robot>'
    joint = (
        '<joint name="{}" type="revolute"><parent>{}</parent><child>{}</child><pose>{}</pose>'
        "<axis><xyz>0 -1 0</xyz><dynamics><damping>0.2</damping></dynamics></axis></joint>"
    )
    first = "0.5 0 0 0 0 0" if order[1] == "crank" else "0 0 0 0 0 0"
    inside = (
        '<gazebo><link name="bar"><pose>0.5 0 1 0 0 0</pose><gravity>0</gravity><inertial>'
        "<mass>2</mass><inertia><ixx>0.1</ixx><iyy>0.2</iyy><izz>0.2</izz></inertia>"
        "<pose>0.4 0 0 0 0 0</pose></inertial></link></gazebo>"
        f"<gazebo>{joint.format('near', *order, first)}"
        f"{joint.format('far', 'bar', 'rocker', '0.5 0 0 0 0 0')}</gazebo>"
    )
    link = (
        '<link name="bar"><inertial><origin xyz="0.4 0 0"/><mass value="2"/>'
        '<inertia ixx="0.1" iyy="0.2" izz="0.2" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )
    damped = '<dynamics damping="0.2"/>'
    near = HINGE.format(name="near", parent="crank", child="bar", xyz="0.5 0 0", more=damped)
    far = HINGE.format(name="far", parent="bar", child="tip", xyz="1 0 0", more=damped)
    tip = (
        '<link name="tip"/><joint name="held" type="fixed"><parent link="rocker"/>'
        '<child link="tip"/><origin xyz="0.5 0 0"/></joint>'
    )
    runs = []
    start = "[initial]\nv = { on_crank = 1.0 }\n"
    for urdf, more in (
        (frame.format(inside), ""),
        (frame.format(link + near + tip + far), "gravity_compensation = { bar = 1.0 }\n"),
    ):
        mechanism = srm.load(described(tmp_path, urdf, more + start))
        assert names_and_types(mechanism) == [("far", "revolute")]
        assert mechanism.model.getFrameId("bar") < mechanism.model.nframes
        runs.append(srm.simulate(mechanism, 0.6, rtol=1e-10))
    ends = [end_of(run.mechanism, "bar", run.q[-1]) for run in runs]
    assert abs(ends[0][0] - 0.5) > 0.01
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-7)
    energies = [run.energy[-1] - run.energy[0] for run in runs]
    assert energies[0] == pytest.approx(energies[1], abs=1e-7)


def test_the_caller_may_choose_the_cut(tmp_path: Path) -> None:
    path = write(tmp_path, slider_crank())
    assert srm.load(path, cut=["pin"]).joint_names == ("a", "b", "guide")


def test_a_description_adds_its_loops_to_those_of_the_file(tmp_path: Path) -> None:
    own = (
        '[[loop]]\nname = "own"\ntype = "point"\na = { link = "crank", xyz = [0.5, 0, 0] }\n'
        'b = { link = "rod" }\n'
    )
    with pytest.raises(srm.InputError, match="'own'"):  # on one joint: both anchors are the same
        srm.load(described(tmp_path, slider_crank(), own.replace('"rod"', '"crank"')))
    mechanism = srm.load(described(tmp_path, slider_crank(), own + START))
    assert [loop.name for loop in mechanism.loops] == ["own", "guide"]


def test_names_that_are_missing_are_made(tmp_path: Path) -> None:
    element = urdf_plus("spherical").replace(' name="ring"', "")
    mechanism = open_mechanism(write(tmp_path, tree(element + element)))
    assert [loop.name for loop in mechanism.loops] == ["point_rim_shin", "point_rim_shin_2"]


def test_a_saved_run_of_a_file_with_loops_is_read_again(tmp_path: Path) -> None:
    mechanism = srm.load(described(tmp_path, slider_crank(), START))
    solution = srm.simulate(mechanism, 0.2)
    solution.save(tmp_path / "run.npz")
    for file in tmp_path.glob("*.urdf"):
        file.unlink()
    read = srm.load_solution(tmp_path / "run.npz")
    np.testing.assert_array_equal(read(0.1)[0], solution(0.1)[0])
    assert [loop.name for loop in read.mechanism.loops] == ["guide"]


def test_what_a_robot_is_drawn_with_survives(tmp_path: Path) -> None:
    from srm_mbs.visualization.animation.shapes import Box, visuals_of

    box = '<visual><geometry><box size="1 2 3"/></geometry></visual></link>'
    urdf = slider_crank().replace("</link>", box, 1)
    (visual,) = visuals_of(srm.load(described(tmp_path, urdf, START)))
    assert isinstance(visual.shape, Box)
    assert visual.shape.size == (1.0, 2.0, 3.0)


def test_a_tree_without_loops_stays_as_it_is(tmp_path: Path) -> None:
    path = write(tmp_path, tree())
    source = srm.load(path).source
    assert source is not None
    assert source.urdf == tree()


# --- frames of onshape-to-robot ------------------------------------------------------------------


def frame(name: str, parent: str, at: tuple[Any, Any], lift: float = 0.0) -> str:
    here = placement(*at) * pin.SE3(np.eye(3), np.array([0.0, 0.0, lift]))
    rpy = pin.rpy.matrixToRpy(here.rotation)
    return (
        f'<link name="{name}"/><joint name="{name}_frame" type="fixed"><parent link="{parent}"/>'
        f'<child link="{name}"/><origin xyz="{text(here.translation)}" rpy="{text(rpy)}"/></joint>'
    )


PAIR = frame("closing_ring_1", "shin", ON_SHIN) + frame("closing_ring_2", "rim", ON_RIM)
HINGED = frame("closing_ring_1_z", "shin", ON_SHIN, 0.1) + frame(
    "closing_ring_2_z", "rim", ON_RIM, 0.1
)


def test_a_pair_of_closing_frames_joins_their_origins(tmp_path: Path) -> None:
    mechanism = open_mechanism(write(tmp_path, tree(PAIR)))
    assert names_and_types(mechanism) == [("closing_ring", "point")]
    assert any("closing_ring" in note and "type of this mate" in note for note in mechanism.notes)
    check_rows(mechanism, lambda q: gaps("point", relative(q)))


def test_with_two_more_frames_along_z_it_is_a_hinge(tmp_path: Path) -> None:
    mechanism = open_mechanism(write(tmp_path, tree(PAIR + HINGED)))
    assert names_and_types(mechanism) == [("closing_ring", "revolute")]

    def rows(q: FloatArray) -> tuple[float, float]:
        between = relative(q)
        return np.linalg.norm(between.translation), np.linalg.norm(between.rotation[:2, 2])

    check_rows(mechanism, rows)


def test_a_closure_of_the_description_replaces_the_pair(tmp_path: Path) -> None:
    own = (
        '[[loop]]\nname = "weld"\ntype = "frame"\na = { link = "closing_ring_2" }\n'
        'b = { frame = "closing_ring_1" }\n'
    )
    mechanism = open_mechanism(described(tmp_path, tree(PAIR), own))
    assert [loop.name for loop in mechanism.loops] == ["weld"]


def test_a_closing_frame_without_partner_is_noted(tmp_path: Path) -> None:
    mechanism = srm.load(write(tmp_path, tree(frame("closing_ring_1", "shin", ON_SHIN))))
    assert not mechanism.loops
    assert any("no partner 'closing_ring_2'" in note for note in mechanism.notes)


# --- one clear error each ------------------------------------------------------------------------

FAULTS = {
    "loop without type": urdf_plus("revolute").replace('type="revolute"', ""),
    "loop of unknown type": urdf_plus("bend"),
    "loop without predecessor": re.sub("<pred.*</predecessor>", "", urdf_plus("fixed")),
    "loop with two axes": urdf_plus("revolute").replace(DIRECTION, 2 * DIRECTION),
    "loop with a zero axis": urdf_plus("revolute").replace(text(AXIS), "0 0 0"),
    "loop with words for numbers": urdf_plus("fixed").replace(SHIN, 'xyz="a b c"'),
    "loop on no link": urdf_plus("fixed").replace('"shin"', '"sin"'),
    "loop without link": urdf_plus("fixed").replace('link="shin"', ""),
    "loop with more": urdf_plus("fixed").replace("</loop>", "<play/></loop>"),
    "loop with an attribute": urdf_plus("fixed").replace("<loop ", '<loop stiffness="1" '),
    "universal loop": urdf_plus("universal"),
    "loop on one body": urdf_plus("fixed").replace('"rim"', '"shin"'),
    "loop twice": 2 * urdf_plus("spherical"),
    "coupling without ratio": (
        '<coupling name="c"><predecessor link="shin"/><successor link="rim"/></coupling>'
    ),
    "coupling of ratio zero": (
        '<coupling name="c"><predecessor link="shin"/><successor link="rim"/>'
        '<ratio value="0"/></coupling>'
    ),
    "coupling on one branch": (
        '<coupling name="c"><predecessor link="thigh"/><successor link="shin"/>'
        '<ratio value="2"/></coupling>'
    ),
    "coupling of another type": '<coupling name="c" type="belt"/>',
    "loop joint without axis": isaac("revolute").replace(DIRECTION, ""),
    "loop joint of one link": isaac("fixed")
    .replace("<link2", "<link3")
    .replace("/link2", "/link3"),
    "loop joint without links": '<loop_joint name="l" type="fixed"/>',
    "constraint without child": urdfdom("fixed").replace('<child link="rim"/>', ""),
    "ball without point": re.sub("<drake:ball_constraint_p_AP.*?/>", "", ball_constraint()),
    "ball on no body": ball_constraint().replace('"rim"', '"brim"'),
    "spring of negative stiffness": SPRING.replace('"80"', '"-80"'),
    "spring with a word": SPRING.replace('"0.7"', '"long"'),
    "another element of Drake": f"<drake:tendon_constraint {DRAKE}/>",
    "gazebo joint without child": (
        "<gazebo><joint name='g' type='ball'><parent>rim</parent></joint></gazebo>"
    ),
    "gazebo joint of a gearbox": gazebo("gearbox", ""),
    "gazebo joint relative to another": gazebo(
        "ball", "<pose relative_to='base'>0 0 0 0 0 0</pose>"
    ),
    "gazebo pose of five numbers": gazebo("ball", "<pose>0 0 0 0 0</pose>"),
    "gazebo axis without direction": gazebo("revolute", "<axis/>"),
    "gazebo axis in another frame": gazebo(
        "revolute", "<axis><xyz expressed_in='__model__'>1 0 0</xyz></axis>"
    ),
    "gazebo joint with friction": gazebo(
        "revolute", "<axis><xyz>1 0 0</xyz><dynamics><friction>2</friction></dynamics></axis>"
    ),
    "gazebo screw without thread": gazebo("screw", "<axis><xyz>0 1 0</xyz></axis>"),
    "gazebo screw between the ground and the root link": gazebo(
        "screw", "<axis><xyz>0 1 0</xyz></axis><thread_pitch>3</thread_pitch>"
    )
    .replace("<parent>shin", "<parent>world")
    .replace("<child>rim", "<child>base"),
    "gazebo screw of a name that is taken": gazebo("screw", "").replace('"ring"', '"hip"'),
    "gazebo joint with more": gazebo("ball", "<plugin/>"),
    "second joint with damping": second("spherical", '<dynamics damping="2"/>'),
    "second joint with a friction that is no number": second(
        "revolute", '<dynamics friction="much"/>'
    ),
    "second joint with friction, of no link": (
        second("revolute") + second("revolute", '<dynamics friction="2"/>', "third")
    ).replace('"rim"', '"brim"'),
    "gazebo link without name": "<gazebo><link/></gazebo>",
    "gazebo link of a name that is taken": "<gazebo><link name='rim'/></gazebo>",
    "gazebo link that nothing holds": "<gazebo><link name='bar'/></gazebo>",
    "gazebo link relative to another": (
        "<gazebo><link name='bar'><pose relative_to='rim'>0 0 0 0 0 0</pose></link></gazebo>"
    ),
    "gazebo link with more": "<gazebo><link name='bar'><spin/></link></gazebo>",
    "gazebo link on a hinge without axis": "<gazebo><link name='bar'/>"
    + gazebo("revolute", "").replace("<gazebo>", "").replace(">rim<", ">bar<"),
    "second joint with more": second("revolute", "<play/>"),
}


MIMICS = {
    "of nothing": "",
    "of no joint": 'joint="hop"',
    "of itself": 'joint="wheel"',
    "with a word": 'joint="hip" multiplier="twice"',
    "with an attribute": 'joint="hip" ratio="2"',
}


def test_a_faulty_loop_or_mimic_is_one_clear_error(tmp_path: Path) -> None:
    texts = {fault: tree(closing) for fault, closing in FAULTS.items()}
    for fault, attributes in MIMICS.items():
        texts[f"mimic {fault}"] = tree(joints={"wheel": f"<mimic {attributes}/>"})
    messages = {}
    for fault, content in texts.items():
        messages[fault] = refused(partial(srm.load, write(tmp_path, content)), tmp_path)
    check_messages("urdf_loops", messages)


def test_a_mimic_of_a_locked_joint_is_refused_and_a_locked_mimic_is_ignored(tmp_path: Path) -> None:
    urdf = tree(joints={"wheel": '<mimic joint="hip"/>'})
    with pytest.raises(srm.InputError, match="'hip' is locked"):
        srm.load(described(tmp_path, urdf, 'lock = ["hip"]\n'))
    mechanism = srm.load(described(tmp_path, urdf, 'lock = ["wheel"]\n'))
    assert not mechanism.loops
    assert any("<mimic> is ignored" in note for note in mechanism.notes)


@pytest.mark.parametrize(
    ("cut", "needle"), [("hop", "no joint 'hop'"), ("hip", "no other joint holds the link 'thigh'")]
)
def test_a_joint_that_cannot_be_cut_is_named(cut: str, needle: str, tmp_path: Path) -> None:
    path = write(tmp_path, tree())
    with pytest.raises(srm.InputError, match=re.escape(needle)):
        srm.load(path, cut=[cut])


def test_the_tree_of_a_file_with_loops_is_that_without(tmp_path: Path) -> None:
    """Taking the loops out changes no mass, placement or joint."""
    everything = (
        urdf_plus("revolute") + gazebo("ball", "").replace("ring", "eye") + second("fixed") + SPRING
    )
    mechanism = open_mechanism(write(tmp_path, tree(everything)))
    model, plain = mechanism.model, pin.buildModelFromXML(tree())
    assert list(model.names) == list(plain.names)
    for q in random_positions():
        at = configuration(plain, q)
        np.testing.assert_allclose(mass_matrix(model, at), mass_matrix(plain, at), atol=1e-14)
