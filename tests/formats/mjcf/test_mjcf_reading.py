"""MJCF files without MuJoCo: what is read, what is noted, and one clear error for each fault."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.formats.mjcf import attributes
from tests.support.mjcf_files import BODY, TWO, file, model_of, translated


def test_an_inactive_constraint_is_left_out_with_a_note() -> None:
    for more in (
        '<equality><joint joint1="j" joint2="k" active="false"/></equality>',
        '<default><equality active="false"/></default>'
        '<equality><joint joint1="j" joint2="k"/></equality>',
        '<option><flag equality="disable"/></option>'
        '<equality><joint joint1="j" joint2="k"/></equality>',
    ):
        made = translated(file(more=more))
        assert "loop" not in made.entries
        assert any("not active" in note for note in made.notes)


def test_a_joint_equality_alone_locks_the_joint_where_it_says(tmp_path: Path) -> None:
    text = file(more='<equality><joint joint1="j" polycoef="0.3 0 0 0 0"/></equality>')
    path = tmp_path / "robot.xml"
    path.write_text(text)
    mechanism = srm.load(path)
    assert mechanism.joint_names == ("k",)
    model = mechanism.model
    frame = model.frames[model.getFrameId("one", pin.FrameType.BODY)]
    np.testing.assert_allclose(frame.placement.rotation, pin.rpy.rpyToMatrix(0, 0, 0.3), atol=1e-14)


def test_limits_count_from_the_pose_of_the_file() -> None:
    text = file(BODY.format("one", 'j" ref="20" range="-10 50" axis="1 0 0'))
    model = model_of(text)
    np.testing.assert_allclose(model.lowerPositionLimit, np.deg2rad([-30.0]), rtol=1e-14)
    np.testing.assert_allclose(model.upperPositionLimit, np.deg2rad([30.0]), rtol=1e-14)


def test_included_files_stand_in_the_place_of_the_include(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(f"<mujocoinclude>{BODY.format('one', 'j')}</mujocoinclude>")
    path = tmp_path / "robot.xml"
    path.write_text(file('<include file="arm.xml"/>' + BODY.format("two", "k")))
    assert srm.load(path).joint_names == ("j", "k")


def test_what_gives_no_force_is_noted() -> None:
    more = (
        '<actuator><motor joint="j"/></actuator><sensor/><keyframe/>'
        '<contact><exclude body1="one" body2="two"/></contact>'
        '<equality><weld body1="one" body2="two" torquescale="2" solref="0.1 1"/></equality>'
    )
    notes = " ".join(translated(file(more=more)).notes)
    for word in ("actuators", "contact", "<sensor>", "<keyframe>", "torquescale", "solref"):
        assert word in notes


def test_a_joint_may_have_an_armature_alone() -> None:
    model = model_of(file(BODY.format("one", 'j" armature="0.3')))
    np.testing.assert_array_equal(model.armature, [0.3])


def test_simple_shapes_are_drawn() -> None:
    geoms = (
        '<geom type="box" size="0.1 0.2 0.3" rgba="1 0 0 1"/><geom type="cylinder" size="0.1 0.2"/>'
        '<geom type="capsule" size="0.1 0.2"/><geom type="mesh" mesh="hull" mass="0"/>'
    )
    text = file(
        BODY.format("one", "j").replace("</body>", geoms + "</body>"),
        '<compiler meshdir="meshes"/>'
        '<asset><mesh name="hull" file="hull.stl" scale="2 2 2"/></asset>',
    )
    urdf = translated(text).urdf
    for shape in (
        '<box size="0.2 0.4 0.6" />',
        '<cylinder radius="0.1" length="0.4" />',
        '<mesh filename="meshes/hull.stl" scale="2.0 2.0 2.0" />',
        '<color rgba="1.0 0.0 0.0 1.0" />',
    ):
        assert shape in urdf
    assert urdf.count("<sphere") == 3


JOINT = '<joint name="j"/>'
FAULTS = {
    "section": ("<worldbody>", "<world/><worldbody>", "<mujoco>", "unknown element <world>"),
    "no body": (TWO, "", "<worldbody>", "there is no <body>"),
    "element": (JOINT, "<hinge/>" + JOINT, "body 'one'", "unknown element <hinge>"),
    "attribute": (JOINT, '<joint name="j" angle="3"/>', "joint 'j'", "unknown attribute 'angle'"),
    "type": (JOINT, '<joint name="j" type="revolute"/>', "joint 'j'", "type is 'revolute'"),
    "number": (JOINT, '<joint name="j" pos="0 0"/>', "joint 'j'", "pos is '0 0', not 3 finite"),
    "axis": (JOINT, '<joint name="j" axis="0 0 0"/>', "joint 'j'", "axis is zero"),
    "negative": (JOINT, '<joint name="j" damping="-1"/>', "joint 'j'", "damping is negative"),
    "spring damper": (JOINT, '<joint name="j" springdamper="1 1"/>', "joint 'j'", "springdamper"),
    "range": (JOINT, '<joint name="j" range="1 -1"/>', "joint 'j'", "does not increase"),
    "class": (JOINT, '<joint name="j" class="x"/>', "joint 'j'", "no default class 'x'"),
    "free": (JOINT, JOINT + "<freejoint/>", "joint", "moves freely"),
    "twice": ('name="two"', 'name="one"', "body 'one'", "two bodies have this name"),
    "two joints": ('name="k"', 'name="j"', "joint 'j'", "two joints have this name"),
    "world": ('name="two"', 'name="world"', "body 'world'", "the ground"),
    "mocap": ('name="two"', 'name="two" mocap="true"', "body 'two'", "mocap"),
    "gravcomp": ('name="two"', 'name="two" gravcomp="1"', "body 'two'", "gravcomp"),
    "two ways": ('name="two"', 'name="two" euler="0 0 1" zaxis="1 0 0"', "'two'", "both given"),
    "size": ('size="0.1"', 'size="0"', "geom ''", "1 positive size"),
    "mesh": ('type="sphere" size="0.1"', 'type="mesh" mesh="m"', "geom", "inertia of a mesh"),
    "world joint": ("<worldbody>", "<worldbody><joint/>", "<worldbody>", "the world has no joints"),
    "replicate": (JOINT, JOINT + '<replicate count="2"/>', "body 'one'", "<replicate>"),
    "global": ("<worldbody>", '<compiler coordinate="global"/><worldbody>', "<compiler>", "global"),
    "order": ("<worldbody>", '<compiler eulerseq="xyw"/><worldbody>', "<compiler>", "eulerseq"),
    "angle": ("<worldbody>", '<compiler angle="grad"/><worldbody>', "<compiler>", "'grad'"),
    "medium": ("<worldbody>", '<option density="1.2"/><worldbody>', "<option>", "medium"),
    "flag": ("<worldbody>", '<option><flag spring="disable"/></option><worldbody>', "<option>",
             "not read"),
    "default": ("<worldbody>", "<default><jount/></default><worldbody>", "default", "<jount>"),
    "soft": ("<worldbody>", "<deformable/><worldbody>", "<deformable>", "deformable"),
    "include": ("<worldbody>", '<include file="x.xml"/><worldbody>', "<include>", "cannot be read"),
}  # fmt: skip
EQUALITIES = {
    "unknown": ("<glue/>", "<equality>", "unknown element <glue>"),
    "refused": ('<tendon tendon1="t"/>', "equality 'tendon_1'", "<tendon> equality"),
    "body": ('<connect body1="x" anchor="0 0 0"/>', "connect_1", "no body 'x'"),
    "no body": ('<connect anchor="0 0 0"/>', "connect_1", "no body1"),
    "no anchor": ('<connect body1="one"/>', "connect_1", "no anchor"),
    "same": ('<connect body1="one" body2="one" anchor="0 0 0"/>', "connect_1", "both ends"),
    "site": ('<connect site1="x" site2="y"/>', "connect_1", "no site 'x'"),
    "one site": ('<weld site1="x"/>', "weld_1", "two sites"),
    "joint": ('<joint joint1="x"/>', "joint_1", "no hinge or slide 'x'"),
    "no joint": ("<joint/>", "joint_1", "no joint1"),
    "same joint": ('<joint joint1="j" joint2="j"/>', "joint_1", "the same"),
    "nonlinear": ('<joint joint1="j" joint2="k" polycoef="0 1 2"/>', "joint_1", "powers 2 to 4"),
    "active": ('<weld body1="one" active="perhaps"/>', "weld_1", "active is 'perhaps'"),
}


def refused(text: str, tmp_path: Path, element: str, problem: str) -> None:
    path = tmp_path / "faulty.xml"
    path.write_text(text)
    with pytest.raises(srm.InputError, match=problem) as caught:
        srm.load(path)
    assert caught.value.file == str(path)
    assert element in (caught.value.element or "")
    assert caught.value.remedy


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_with_its_place(name: str, tmp_path: Path) -> None:
    old, new, element, problem = FAULTS[name]
    assert old in file()
    refused(file().replace(old, new, 1), tmp_path, element, problem)


@pytest.mark.parametrize("name", EQUALITIES)
def test_a_fault_in_a_constraint_is_named(name: str, tmp_path: Path) -> None:
    node, element, problem = EQUALITIES[name]
    refused(file(more=f"<equality>{node}</equality>"), tmp_path, element, problem)


def test_a_tendon_whose_force_cannot_act_is_refused(tmp_path: Path) -> None:
    tendon = '<tendon><fixed stiffness="2"><joint joint="j" coef="1"/></fixed></tendon>'
    refused(file(more=tendon), tmp_path, "fixed_tendon_1", "between two sites")


def test_elements_too_deep_in_each_other_are_refused_before_the_stack_ends(tmp_path: Path) -> None:
    chain = "<body>" * 5000 + "</body>" * 5000
    refused(file(chain), tmp_path, "<body>", "more than 300 elements are nested")
    frames = "<frame>" * 299 + "</frame>" * 299
    refused(file(frames), tmp_path, "<worldbody>", "there is no <body>")


def test_a_chain_of_290_bodies_loads() -> None:
    body = '<body pos="0 0 -0.1"><joint/><geom type="sphere" size="0.05" pos="0 0 -0.1"/>'
    assert model_of(file(body * 290 + "</body>" * 290)).nv == 290


def test_the_page_of_formats_tells_of_everything_that_is_read() -> None:
    page = (Path(__file__).parents[3] / "docs" / "formats.md").read_text()
    page = page[page.index("## MJCF") :]
    sections = (*attributes.SECTIONS, *attributes.IGNORED_SECTIONS)
    tags = (*sections, *attributes.BODY_READ, *attributes.BODY_IGNORED, *attributes.ATTRIBUTES)
    missing = [tag for tag in tags if f"<{tag}" not in page]
    words = [word for words in attributes.ATTRIBUTES.values() for word in words]
    words += [*attributes.JOINT_EQUALITY, *attributes.IGNORED_ATTRIBUTES["compiler"]]
    plain = ("name", "mesh", "scale", "file", "size")
    missing += [word for word in words if word not in plain and not re.search(rf"\b{word}\b", page)]
    assert not missing
