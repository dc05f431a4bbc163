"""Bad SDF files: one clear error each, naming file, element and remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

import srm_mbs as srm
from srm_mbs.formats.sdf import joints
from srm_mbs.formats.sdf import links as sdf_links
from srm_mbs.formats.sdf import reader as sdf_module
from tests.support.sdf_files import four_bar, joint, link, sdf

PENDULUM = sdf(link("arm", "0 0 1 0 0 0"), joint("hinge", "revolute", "world", "arm"))
ARM = '<link name="arm">'
LAST = "</model>"

FAULTS = {
    "no xml": ("</sdf>", "", "", "not well-formed XML"),
    "version": ('version="1.9"', 'version="7"', "<sdf>", "SDF version '7' is not read"),
    "no version": ('version="1.9"', "", "<sdf>", "SDF version '' is not read"),
    "two models": ("</sdf>", '<world name="w"/></sdf>', "<sdf>", "one <model> or one <world>"),
    "unknown element": (LAST, "<spring/></model>", "model 'robot'", "unknown element <spring>"),
    "unknown in link": ("<inertial>", "<Pose/><inertial>", "link 'arm'", "unknown element <Pose>"),
    "attribute": ('name="arm"', 'name="arm" weight="2"', "link 'arm'", "unknown attribute"),
    "no name": (ARM, "<link>", "<link>", "it has no name"),
    "reserved": (ARM, '<link name="world">', "<link>", "reserved"),
    "twice": (LAST, link("arm") + LAST, "link 'arm'", "are called 'arm'"),
    "pose": ("0 0 1 0 0 0", "0 0 1 0 0", "link 'arm'", "not 6 finite numbers"),
    "pose nan": ("0 0 1 0 0 0", "0 0 1 0 0 nan", "link 'arm'", "not 6 finite numbers"),
    "relative": ("<pose>0 0 1", '<pose relative_to="x">0 0 1', "link 'arm'", "no link.*'x'"),
    "ring": ("<pose>", '<pose relative_to="hinge">', "joint 'hinge'", "relative to itself"),
    "rotation": ("<pose>0 0 1", '<pose rotation_format="x">0 0 1', "link 'arm'", "rotation_format"),
    "two poses": ("<inertial>", "<pose/><inertial>", "link 'arm'", "<pose> is given twice"),
    "mass": ("<mass>1.0</mass>", "<mass>heavy</mass>", "link 'arm'", "<mass> is 'heavy'"),
    "negative": ("<mass>1.0</mass>", "<mass>-1</mass>", "link 'arm'", "negative"),
    "auto": ("<inertial>", '<inertial auto="true">', "link 'arm'", "inertial auto"),
    "gravity": ("<inertial>", "<gravity>0</gravity><inertial>", "link 'arm'", "not simulated"),
    "type": ('type="revolute"', 'type="hinge"', "joint 'hinge'", "there is no joint type 'hinge'"),
    "parent": ("<parent>world", "<parent>wall", "joint 'hinge'", "no link.*'wall'"),
    "no parent": ("<parent>world</parent>", "", "joint 'hinge'", "it has no <parent>"),
    "self": ("<parent>world", "<parent>arm", "joint 'hinge'", "both 'arm'"),
    "no axis": ("<axis><xyz>0 1 0</xyz></axis>", "", "joint 'hinge'", "it has no <axis>"),
    "zero axis": ("0 1 0</xyz>", "0 0 0</xyz>", "joint 'hinge'", "the axis is zero"),
    "older": ("<xyz>", "<use_parent_model_frame>1</use_parent_model_frame><xyz>", "hinge",
              "does not exist in SDF 1.9"),
    "expressed": ("<xyz>", '<xyz expressed_in="x">', "joint 'hinge'", "no link.*'x'"),
    "initial": ("<xyz>", "<initial_position>1</initial_position><xyz>", "hinge", "Pose the links"),
    "damping": ("<xyz>", "<dynamics><damping>-1</damping></dynamics><xyz>", "hinge", "negative"),
    "limits": ("<xyz>", "<limit><lower>2</lower><upper>1</upper></limit><xyz>", "hinge", "above"),
    "screw": (LAST, link("n") + joint("s", "screw", "arm", "n") + LAST, "joint 's'", "pitch"),
    "thread": (LAST, link("n") + joint("s", "screw", "arm", "n",
               "<thread_pitch>0</thread_pitch>") + LAST, "joint 's'", "<thread_pitch> is zero"),
    "parallel": (LAST, link("n") + joint("u", "universal", "arm", "n",
                 "<axis2><xyz>0 -2 0</xyz></axis2>") + LAST, "joint 'u'", "parallel"),
    "one axis": (LAST, link("n") + joint("u", "universal", "arm", "n") + LAST, "'u'", "<axis2>"),
    "gear body": (LAST, link("n") + joint("g", "gearbox", "arm", "n") + LAST, "'g'",
                  "gearbox_reference_body"),
    "gear hinge": (LAST, link("n") + joint("h", "revolute", "arm", "n") + joint(
        "g", "gearbox", "arm", "n", "<axis2><xyz>0 1 0</xyz></axis2><gearbox_reference_body>n"
        "</gearbox_reference_body>") + LAST, "joint 'g'", "no revolute joint about its axis"),
    "mimic": ("<xyz>", '<mimic joint="x" axis="axis"/><xyz>', "'hinge'", "prismatic joint 'x'"),
    "include": (LAST, "<include><uri>model://nowhere</uri></include></model>", "<include>",
                "no such model beside"),
    "far": (LAST, "<include><uri>https://a.b/c</uri></include></model>", "<include>",
            "from this machine only"),
    "merge": (LAST, '<include merge="true"><uri>a</uri></include></model>', "<include>", "merge"),
    "canonical": ('name="robot"', 'name="robot" canonical_link="x"', "model", "no link 'x'"),
    "placement": ('name="robot"', 'name="robot" placement_frame="arm"', "model", "placement_frame"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_with_its_place(name: str, tmp_path: Path) -> None:
    old, new, element, problem = FAULTS[name]
    assert old in PENDULUM
    path = tmp_path / "faulty.sdf"
    path.write_text(PENDULUM.replace(old, new, 1))
    with pytest.raises(srm.InputError, match=problem) as caught:
        srm.load(path)
    error = caught.value
    assert error.file == str(path)
    assert element in (error.element or "")
    assert error.remedy


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
        *(joints.DYNAMICS_READ, joints.LIMIT_READ, joints.LIMIT_IGNORED),
    )
    missing = [tag for tags in lists for tag in tags if f"<{tag}" not in page]
    missing += [kind for kind in joints.TYPES if f"`{kind}`" not in page]
    assert not missing
