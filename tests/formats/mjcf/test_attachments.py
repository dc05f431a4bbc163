"""Models attached to others, against MuJoCo loading the same files."""

from __future__ import annotations

import re
import struct
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.mujoco_twins import Twins, check_dynamics, check_residuals
from tests.support.snapshots import check_messages, refused

mujoco = pytest.importorskip("mujoco")

CHILD = """<mujoco model="limb">
  <compiler angle="radian" eulerseq="ZYX" meshdir="shapes" boundmass="0.5"/>
  <option gravity="0 0 -1"><flag spring="disable"/></option>
  <default><geom density="500"/><joint damping="0.7"/>
    <default class="stiff"><joint stiffness="3" armature="0.05"/></default></default>
  <asset><mesh file="wedge.stl" inertia="exact"/><material name="red" rgba="1 0 0 1"/>
    <model name="tip" file="deep/tip.xml"/></asset>
  <worldbody><geom name="plate" size="0.3" pos="1 0 0"/>
    <body name="upper" pos="0 0 0.5" euler="0.3 0.2 0.1" childclass="stiff">
      <joint name="j" ref="0.2"/><geom type="mesh" mesh="wedge" material="red"/>
      <frame pos="0.4 0 0" euler="0 0.5 0">
        <body name="lower" pos="0 0.1 0"><joint name="k" axis="0 1 0"/>
          <geom size="0.1" pos="0.1 0 0"/><site name="eye" pos="0.2 0 0"/>
          <frame pos="0.3 0 0"><attach model="tip" body="nail" prefix="tip_"/></frame></body>
      </frame></body>
    <body name="other" pos="0 2 0"><joint name="o"/><geom size="0.1" pos="0.1 0 0"/></body>
  </worldbody>
  <equality><joint joint1="j" joint2="k" polycoef="0.1 0.5 0.2"/>
    <joint name="apart" joint1="o" joint2="k"/><connect body1="lower" anchor="0.1 0 0"/>
    <weld body1="upper" body2="world" active="false"/></equality>
  <tendon><fixed name="t" stiffness="4"><joint joint="j" coef="1"/>
      <joint joint="o" coef="1"/></fixed>
    <fixed stiffness="5" damping="0.2"><joint joint="j" coef="0.5"/></fixed></tendon>
  <keyframe><key name="home" qpos="0.3 0.4 0.1 0.2"/></keyframe>
</mujoco>"""
TIP = """<mujoco><compiler angle="degree"/><worldbody>
  <body name="nail" euler="0 40 0"><joint name="k" axis="1 0 0" damping="0.1"/>
    <geom type="capsule" size="0.02 0.1"/></body></worldbody></mujoco>"""
PARENT = """<mujoco><compiler angle="degree" {compiler}/>
  <default><joint damping="0.3"/><geom density="900"/>
    <default class="own"><joint damping="0.2"/></default></default>
  <asset><model {name} file="parts/limb.xml" content_type="text/xml"/></asset>
  <worldbody><body name="base" pos="0 0 1" euler="0 0 90" childclass="own">
    <joint name="swing" axis="1 0 0"/><geom size="0.1"/>{attached}</body></worldbody>
  <keyframe><key name="all" qpos="{qpos}"/></keyframe></mujoco>"""


def wedge(path: Path) -> None:
    """A tetrahedron as a binary STL."""
    corners = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.4]], dtype=float)
    faces = corners[[[0, 2, 1], [0, 3, 2], [0, 1, 3], [1, 2, 3]]]
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *face.ravel(), 0) for face in faces)
    path.write_bytes(bytes(80) + struct.pack("<I", 4) + rows)


def files(
    folder: Path, attached: str, name: str = 'name="limb"', compiler: str = "", qpos: str = ""
) -> Path:
    (folder / "parts" / "deep").mkdir(parents=True, exist_ok=True)
    (folder / "parts" / "shapes").mkdir(exist_ok=True)
    (folder / "parts" / "limb.xml").write_text(CHILD)
    (folder / "parts" / "deep" / "tip.xml").write_text(TIP)
    wedge(folder / "parts" / "shapes" / "wedge.stl")
    path = folder / "robot.xml"
    path.write_text(PARENT.format(attached=attached, name=name, compiler=compiler, qpos=qpos))
    return path


CASES = {
    "body": ('<attach model="limb" body="upper" prefix="a-"/>', "1 2 3 4"),
    "world": (
        '<frame pos="0 1 0" euler="90 0 20"><attach model="limb" prefix="a-"/></frame>',
        "1 2 3 4 5",
    ),
    "world as a body": ('<attach model="limb" body="world" prefix="a-"/>', "1 2 3 4 5"),
    "body in a frame": ('<attach model="limb" body="lower" prefix="a-"/>', "1 2 3"),
    "twice": (
        '<attach model="limb" body="upper" prefix="a-"/><body name="mid"><joint name="m"/>'
        '<geom size="0.1"/></body><attach model="limb" body="lower" prefix="b/"/>',
        "1 2 3 4 5 6 7",
    ),
    "without prefix": ('<attach model="limb" body="upper" prefix=""/>', "1 2 3 4"),
}


@pytest.mark.parametrize("case", CASES)
def test_an_attached_model_is_that_of_mujoco(case: str, tmp_path: Path) -> None:
    """Poses, M, forces and constraints, with the settings of each file for its own elements."""
    attached, qpos = CASES[case]
    path = files(tmp_path, attached, qpos=qpos)
    twins = Twins(path.read_text(), path)
    check_dynamics(twins)
    check_residuals(twins)
    names = {
        mujoco.mj_id2name(twins.theirs, mujoco.mjtObj.mjOBJ_JOINT, i)
        for i in range(twins.theirs.njnt)
    }
    assert names == set(twins.model.names[1:])
    assert any("<option>" in note for note in twins.made.notes)
    left_out = [note for note in twins.made.notes if "not attached" in note]
    assert bool(left_out) == ("world" not in case)


def test_a_model_is_called_as_its_file_says(tmp_path: Path) -> None:
    path = files(tmp_path, CASES["body"][0], name="", qpos=CASES["body"][1])
    check_dynamics(Twins(path.read_text(), path))


def test_masses_are_rescaled_and_bounded_by_the_files_that_say_so(tmp_path: Path) -> None:
    attached, qpos = CASES["world"]
    path = files(tmp_path, attached, compiler='settotalmass="30"', qpos=qpos)
    check_dynamics(Twins(path.read_text(), path))


@pytest.mark.parametrize("key", ["all", "a-home"])
def test_keyframes_come_with_a_model(key: str, tmp_path: Path) -> None:
    """In MuJoCo's order of the joints, of which those of the model are all but the first."""
    open_ends = re.sub(r"<equality>.*</equality>", "", CHILD, flags=re.DOTALL)
    path = files(tmp_path, '<attach model="limb" prefix="a-"/>', qpos="1 2 3 4 5")
    (tmp_path / "parts" / "limb.xml").write_text(open_ends)
    mechanism = srm.load(path, keyframe=key)
    theirs = mujoco.MjModel.from_xml_path(str(path))
    number = mujoco.mj_name2id(theirs, mujoco.mjtObj.mjOBJ_KEY, key)
    for i in range(theirs.njnt):
        name = mujoco.mj_id2name(theirs, mujoco.mjtObj.mjOBJ_JOINT, i)
        expected = theirs.key_qpos[number][i] - theirs.qpos0[i]
        assert mechanism.q0[mechanism.joint(name).idx_q] == pytest.approx(expected, abs=1e-15)


def test_an_attached_model_runs_and_is_drawn_and_converted(tmp_path: Path) -> None:
    path = files(tmp_path, CASES["body"][0], qpos=CASES["body"][1])
    limb = CHILD.replace('<connect body1="lower" anchor="0.1 0 0"/>', "")
    (tmp_path / "parts" / "limb.xml").write_text(limb)
    mechanism = srm.load(path)
    assert mechanism.degrees_of_freedom == mechanism.model.nv - 1 == 3
    run = srm.simulate(mechanism, 0.2)
    assert run.success
    srm.convert(path, tmp_path / "again.toml")
    again = srm.load(tmp_path / "again.toml")
    np.testing.assert_allclose(again.q0, mechanism.q0, atol=1e-9)
    assert "parts/shapes/wedge.stl" in (tmp_path / "again.urdf").read_text()


FAULTS = {
    "no such model": ('<attach model="leg" prefix="a"/>', ""),
    "no such body": ('<attach model="limb" body="foot" prefix="a"/>', ""),
    "no prefix": ('<attach model="limb"/>', ""),
    "unknown attribute": ('<attach model="limb" prefix="a" pos="0 0 1"/>', ""),
    "name twice": ('<attach model="limb" body="upper" prefix=""/>' * 2, ""),
    "in a replicate": (
        '<replicate count="2"><attach model="limb" prefix="a"/></replicate>',
        "",
    ),
    "merged options": (CASES["body"][0], 'conflict="merge"'),
    "unknown treatment of conflicts": (CASES["body"][0], 'conflict="win"'),
}


def test_wrong_attachments_are_refused_by_name(tmp_path: Path) -> None:
    messages = {}
    for case, (attached, compiler) in FAULTS.items():
        path = files(tmp_path, attached, compiler=compiler)
        messages[case] = refused(partial(srm.load, path), tmp_path)
    path = files(tmp_path, CASES["body"][0])
    limb = tmp_path / "parts" / "limb.xml"
    for case, text in {
        "a URDF": '<robot name="r"><link name="l"/></robot>',
        "no such file below": CHILD.replace("deep/tip.xml", "deep/top.xml"),
        "in a circle": CHILD.replace("deep/tip.xml", "limb.xml").replace("nail", "upper"),
        "a fault in it": CHILD.replace('ref="0.2"', 'ref="far"'),
    }.items():
        limb.write_text(text)
        messages[case] = refused(partial(srm.load, path), tmp_path)
    limb.unlink()
    messages["no such file"] = refused(partial(srm.load, path), tmp_path)
    check_messages("mjcf_attachments", messages)
