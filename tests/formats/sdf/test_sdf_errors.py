"""Bad SDF files: one clear error each, naming file, element and remedy."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

import srm_mbs as srm
from srm_mbs.formats.sdf import joints
from srm_mbs.formats.sdf import links as sdf_links
from srm_mbs.formats.sdf import reader as sdf_module
from tests.support.sdf_files import four_bar, joint, link, sdf
from tests.support.snapshots import check_messages, refused

PENDULUM = sdf(link("arm", "0 0 1 0 0 0"), joint("hinge", "revolute", "world", "arm"))
ARM = '<link name="arm">'
LAST = "</model>"

FAULTS = {
    "no xml": ("</sdf>", ""),
    "version": ('version="1.9"', 'version="7"'),
    "no version": ('version="1.9"', ""),
    "two models": ("</sdf>", '<world name="w"/></sdf>'),
    "unknown element": (LAST, "<spring/></model>"),
    "unknown in link": ("<inertial>", "<Pose/><inertial>"),
    "attribute": ('name="arm"', 'name="arm" weight="2"'),
    "no name": (ARM, "<link>"),
    "reserved": (ARM, '<link name="world">'),
    "twice": (LAST, link("arm") + LAST),
    "pose": ("0 0 1 0 0 0", "0 0 1 0 0"),
    "pose nan": ("0 0 1 0 0 0", "0 0 1 0 0 nan"),
    "relative": ("<pose>0 0 1", '<pose relative_to="x">0 0 1'),
    "ring": ("<pose>", '<pose relative_to="hinge">'),
    "rotation": ("<pose>0 0 1", '<pose rotation_format="x">0 0 1'),
    "two poses": ("<inertial>", "<pose/><inertial>"),
    "mass": ("<mass>1.0</mass>", "<mass>heavy</mass>"),
    "negative": ("<mass>1.0</mass>", "<mass>-1</mass>"),
    "negative moment": ("<ixx>0.01", "<ixx>-0.01"),
    "auto": ("<inertial>", '<inertial auto="true">'),
    "auto of a plane": ("<inertial>", '<collision name="c"><geometry><plane/></geometry>'
                        '</collision><inertial auto="1">'),
    "auto of nothing": ("<inertial>", '<collision name="c"><geometry><sphere><radius>0</radius>'
                        '</sphere></geometry></collision><inertial auto="1">'),
    "auto of a submesh": ("<inertial>", '<collision name="c"><geometry><mesh><submesh/></mesh>'
                          '</geometry></collision><inertial auto="1">'),
    "auto without the mesh": ("<inertial>", '<collision name="c"><geometry><mesh><uri>no.stl</uri>'
                              '</mesh></geometry></collision><inertial auto="1">'),
    "gravity": ("<inertial>", "<gravity>off</gravity><inertial>"),
    "kinematic": ("<inertial>", "<kinematic>1</kinematic><inertial>"),
    "visual": ("<inertial>", '<visual name="v"><pose relative_to="x"/></visual><inertial>'),
    "type": ('type="revolute"', 'type="hinge"'),
    "parent": ("<parent>world", "<parent>wall"),
    "no parent": ("<parent>world</parent>", ""),
    "self": ("<parent>world", "<parent>arm"),
    "no axis": ("<axis><xyz>0 1 0</xyz></axis>", ""),
    "zero axis": ("0 1 0</xyz>", "0 0 0</xyz>"),
    "older": ("<xyz>", "<use_parent_model_frame>1</use_parent_model_frame><xyz>"),
    "expressed": ("<xyz>", '<xyz expressed_in="x">'),
    "initial": ("<xyz>", "<initial_position>1</initial_position><xyz>"),
    "damping": ("<xyz>", "<dynamics><damping>-1</damping></dynamics><xyz>"),
    "limits": ("<xyz>", "<limit><lower>2</lower><upper>1</upper></limit><xyz>"),
    "screw": (LAST, link("n") + joint("s", "screw", "arm", "n") + LAST),
    "thread": (LAST, link("n") + joint("s", "screw", "arm", "n",
               "<thread_pitch>0</thread_pitch>") + LAST),
    "parallel": (LAST, link("n") + joint("u", "universal", "arm", "n",
                 "<axis2><xyz>0 -2 0</xyz></axis2>") + LAST),
    "one axis": (LAST, link("n") + joint("u", "universal", "arm", "n") + LAST),
    "gear body": (LAST, link("n") + joint("g", "gearbox", "arm", "n") + LAST),
    "gear hinge": (LAST, link("n") + joint("h", "revolute", "arm", "n") + joint(
        "g", "gearbox", "arm", "n", "<axis2><xyz>0 1 0</xyz></axis2><gearbox_reference_body>n"
        "</gearbox_reference_body>") + LAST),
    "mimic": ("<xyz>", '<mimic joint="x" axis="axis"/><xyz>'),
    "include": (LAST, "<include><uri>model://nowhere</uri></include></model>"),
    "far": (LAST, "<include><uri>https://a.b/c</uri></include></model>"),
    "merge": (LAST, '<include merge="maybe"><uri>a</uri></include></model>'),
    "canonical": ('name="robot"', 'name="robot" canonical_link="x"'),
    "placement": ('name="robot"', 'name="robot" placement_frame="x"'),
    "ring of placement": ('name="robot">', 'name="robot" placement_frame="f"><frame name="f"><pose '
                          'relative_to="g"/></frame><frame name="g"><pose relative_to="f"/>'
                          '</frame>'),
}  # fmt: skip


def test_a_fault_is_named_with_its_place(tmp_path: Path) -> None:
    path, messages = tmp_path / "faulty.sdf", {}
    for name, (old, new) in FAULTS.items():
        assert old in PENDULUM
        path.write_text(PENDULUM.replace(old, new, 1))
        messages[name] = refused(partial(srm.load, path), tmp_path)
    check_messages("sdf", messages)


def test_an_element_of_another_tool_is_refused_if_it_acts(tmp_path: Path) -> None:
    path = tmp_path / "drake.sdf"
    prefixed = PENDULUM.replace("<sdf ", '<sdf xmlns:drake="drake.mit.edu" ')
    path.write_text(prefixed.replace("<axis>", "<drake:controller_gains/><axis>"))
    assert any("controller_gains" in note for note in srm.load(path).notes)
    path.write_text(prefixed.replace("<xyz>", "<drake:rotor_inertia>1</drake:rotor_inertia><xyz>"))
    with pytest.raises(srm.InputError, match=r"joint 'hinge'.*rotor_inertia.*not read"):
        srm.load(path)


def test_files_that_include_each_other_without_end_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "ring.sdf"
    path.write_text(sdf(link("a"), "<include><uri>ring.sdf</uri><name>inner</name></include>"))
    with pytest.raises(srm.InputError, match="include each other"):
        srm.load(path)


def test_what_does_not_act_is_counted_in_the_notes(tmp_path: Path) -> None:
    path = tmp_path / "notes.sdf"
    more = "<plugin name='p' filename='f'/><self_collide>0</self_collide>"
    path.write_text(
        PENDULUM.replace("<inertial>", '<collision name="c"/><inertial>').replace(LAST, more + LAST)
    )
    notes = " ".join(srm.load(path).notes)
    for what in ("<plugin>", "<self_collide>", "<collision>"):
        assert f"1 {what} element(s) do not act" in notes


def test_a_static_model_has_nothing_that_moves(tmp_path: Path) -> None:
    path = tmp_path / "still.sdf"
    path.write_text(four_bar("<static>true</static>"))
    with pytest.raises(srm.InputError, match="nothing in this mechanism can move"):
        srm.load(path)


def test_the_page_of_formats_tells_of_every_element_that_is_known() -> None:
    page = (Path(__file__).parents[3] / "docs" / "formats.md").read_text()
    page = page[page.index("## SDF") : page.index("## MJCF")]
    lists = (
        *(sdf_module.MODEL_READ, sdf_module.MODEL_IGNORED),
        *(sdf_module.WORLD_READ, sdf_module.WORLD_IGNORED),
        *(sdf_links.LINK_READ, sdf_links.LINK_IGNORED, sdf_links.INERTIAL_READ),
        *(joints.JOINT_READ, joints.JOINT_IGNORED, joints.AXIS_READ),
        *(joints.DYNAMICS.values(), joints.LIMITS.values(), joints.LIMIT_IGNORED),
    )
    missing = [tag for tags in lists for tag in tags if f"<{tag}" not in page]
    missing += [kind for kind in joints.TYPES if f"`{kind}`" not in page]
    assert not missing
