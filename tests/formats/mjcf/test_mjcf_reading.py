"""MJCF files without MuJoCo: what is read, what is noted, and one clear error for each fault."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from srm_mbs.formats.mjcf import attributes
from tests.support.mjcf_files import BODY, TWO, file, loaded, model_of, translated
from tests.support.snapshots import check_messages, refused


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
    equality = '<equality><joint joint1="j" polycoef="0.3 0 0 0 0"/></equality>'
    mechanism = loaded(tmp_path, file(more=equality))
    assert mechanism.joint_names == ("k",)
    model = mechanism.model
    frame = model.frames[model.getFrameId("one", pin.FrameType.BODY)]
    np.testing.assert_allclose(frame.placement.rotation, pin.rpy.rpyToMatrix(0, 0, 0.3), atol=1e-14)


def test_flags_switch_forces_off() -> None:
    one = BODY.format("one", 'j" damping="1" stiffness="2" frictionloss="3')
    for flag, left in (
        ("spring", (1.0, 0, 3.0)),
        ("damper", (0.0, 1, 3.0)),
        ("frictionloss", (1.0, 1, 0.0)),
        ("passive", (0.0, 0, 3.0)),
        ("constraint", (1.0, 1, 0.0)),
    ):
        text = file(one, f'<option><flag {flag}="disable"/></option>')
        model = model_of(text)
        springs = len(translated(text).entries.get("force", ()))
        assert (model.damping[0], springs, model.friction[0]) == left, flag


def test_a_free_joint_that_is_alone_keeps_its_damping(tmp_path: Path) -> None:
    one = '<body name="b" pos="0 0 1"><joint type="free" {}/><geom size="0.1"/></body>'
    plain, damped = (loaded(tmp_path, file(one.format(more))) for more in ("", 'damping="0.3"'))
    assert plain.joint_names == damped.joint_names == ("root_joint",)
    np.testing.assert_array_equal(plain.q0, damped.q0)
    np.testing.assert_array_equal(damped.model.damping, np.full(6, 0.3))


def test_limits_count_from_the_pose_of_the_file() -> None:
    text = file(BODY.format("one", 'j" ref="20" range="-10 50" axis="1 0 0'))
    model = model_of(text)
    np.testing.assert_allclose(model.lowerPositionLimit, np.deg2rad([-30.0]), rtol=1e-14)
    np.testing.assert_allclose(model.upperPositionLimit, np.deg2rad([30.0]), rtol=1e-14)


def test_included_files_stand_in_the_place_of_the_include(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(f"<mujocoinclude>{BODY.format('one', 'j')}</mujocoinclude>")
    text = file('<include file="arm.xml"/>' + BODY.format("two", "k"))
    assert loaded(tmp_path, text).joint_names == ("j", "k")


def test_what_gives_no_force_is_noted() -> None:
    more = (
        '<option density="1.2" viscosity="1.8e-5"/>'
        '<actuator><muscle joint="j"/></actuator><sensor/>'
        '<contact><exclude body1="one" body2="two"/></contact>'
        '<equality><weld body1="one" body2="two" torquescale="2" solref="0.1 1"/></equality>'
    )
    notes = " ".join(translated(file(TWO + '<body mocap="true"/>', more)).notes)
    words = "density viscosity mocap actuators contact <sensor> torquescale solref"
    for word in words.split():
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
    "section": ("<worldbody>", "<world/><worldbody>"),
    "no body": (TWO, ""),
    "element": (JOINT, "<hinge/>" + JOINT),
    "attribute": (JOINT, '<joint name="j" angle="3"/>'),
    "type": (JOINT, '<joint name="j" type="revolute"/>'),
    "number": (JOINT, '<joint name="j" pos="0 0"/>'),
    "axis": (JOINT, '<joint name="j" axis="0 0 0"/>'),
    "negative": (JOINT, '<joint name="j" damping="-1"/>'),
    "spring damper": (JOINT, '<joint name="j" springdamper="1"/>'),
    "spring damper of a free joint": (JOINT, '<joint name="j" type="free" springdamper="1 1"/>'),
    "range": (JOINT, '<joint name="j" range="1 -1"/>'),
    "class": (JOINT, '<joint name="j" class="x"/>'),
    "free": (JOINT, JOINT + "<freejoint/>"),
    "twice": ('name="two"', 'name="one"'),
    "two joints": ('name="k"', 'name="j"'),
    "world": ('name="two"', 'name="world"'),
    "two ways": ('name="two"', 'name="two" euler="0 0 1" zaxis="1 0 0"'),
    "size": ('size="0.1"', 'size="0"'),
    "mesh": ('type="sphere" size="0.1"', 'type="mesh" mesh="m"'),
    "world joint": ("<worldbody>", "<worldbody><joint/>"),
    "replicate of a joint": (JOINT, '<replicate count="2"><joint/></replicate>'),
    "replicate without count": (JOINT, JOINT + '<replicate><geom size="1"/></replicate>'),
    "replicates": (JOINT, JOINT + '<replicate count="999">' * 3 + "</replicate>" * 3),
    "composite": (JOINT, JOINT + "<composite/>"),
    "flexcomp": (JOINT, JOINT + "<flexcomp/>"),
    "attach": (JOINT, JOINT + '<attach model="arm"/>'),
    "global": ("<worldbody>", '<compiler coordinate="global"/><worldbody><frame/>'),
    "height field": ('type="sphere" size="0.1"', 'type="hfield" hfield="h"'),
    "order": ("<worldbody>", '<compiler eulerseq="xyw"/><worldbody>'),
    "angle": ("<worldbody>", '<compiler angle="grad"/><worldbody>'),
    "medium": ("<worldbody>", '<option density="1000"/><worldbody>'),
    "default": ("<worldbody>", "<default><jount/></default><worldbody>"),
    "soft": ("<worldbody>", "<deformable/><worldbody>"),
    "include": ("<worldbody>", '<include file="x.xml"/><worldbody>'),
}  # fmt: skip
EQUALITIES = {
    "unknown": "<glue/>",
    "refused": '<distance geom1="a" geom2="b"/>',
    "no tendon": '<tendon tendon1="t"/>',
    "tendon": "<tendon/>",
    "body": '<connect body1="x" anchor="0 0 0"/>',
    "no body": '<connect anchor="0 0 0"/>',
    "no anchor": '<connect body1="one"/>',
    "same": '<connect body1="one" body2="one" anchor="0 0 0"/>',
    "site": '<connect site1="x" site2="y"/>',
    "one site": '<weld site1="x"/>',
    "joint": '<joint joint1="x"/>',
    "no joint": "<joint/>",
    "same joint": '<joint joint1="j" joint2="j"/>',
    "active": '<weld body1="one" active="perhaps"/>',
}


TENDON = '<tendon><fixed {}><joint joint="{}" coef="{}"/></fixed></tendon>'
LINE = '<tendon><spatial {}><site site="s"/><site site="s"/></spatial></tendon>'
TENDONS = {
    "of decreasing length": TENDON.format('stiffness="2" springlength="1 0"', "j", 1),
    "along a line with friction": LINE.format('frictionloss="2"'),
    "along a line with armature": LINE.format('armature="2"'),
    "with friction on no such joint": TENDON.format('frictionloss="2"', "x", 1),
    "on no such joint": TENDON.format('stiffness="2"', "x", 1),
    "on no joint": TENDON.format('stiffness="2"', "j", 0),
}


def test_a_fault_is_named_with_its_place(tmp_path: Path) -> None:
    texts = {f"tendon {what}": file(more=tendon) for what, tendon in TENDONS.items()}
    for name, (old, new) in FAULTS.items():
        assert old in file()
        texts[name] = file().replace(old, new, 1)
    for name, node in EQUALITIES.items():
        texts[f"equality: {name}"] = file(more=f"<equality>{node}</equality>")
    # Refused before the stack ends.
    texts["nested too deep"] = file("<body>" * 5000 + "</body>" * 5000)
    texts["nested almost too deep"] = file("<frame>" * 299 + "</frame>" * 299)
    path, messages = tmp_path / "faulty.xml", {}
    for name, text in texts.items():
        path.write_text(text)
        messages[name] = refused(partial(srm.load, path), tmp_path)
    keyed = file(more='<keyframe><key name="home" qpos="1 2"/></keyframe>')
    for name, text, key in (
        ("no such keyframe", keyed, "away"),
        ("keyframe of another model", keyed.replace("1 2", "1 2 3"), "home"),
    ):
        path.write_text(text)
        messages[name] = refused(partial(srm.load, path, keyframe=key), tmp_path)
    path.write_text('<robot name="r"><link name="l"/></robot>')
    messages["keyframe of a URDF"] = refused(partial(srm.load, path, keyframe="a"), tmp_path)
    check_messages("mjcf", messages)


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
