"""Gepetto's robot.yaml: closures of frames and joints of other types than the URDF says."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.formats.urdf.test_urdf_loops import PAIR, gaps, measured, random_positions
from tests.support.dynamics import assert_same_dynamics
from tests.support.snapshots import check_messages, refused
from tests.support.urdf_files import BRANCHES, MASSES, open_mechanism, placement, relative, tree

FRAMES = PAIR.replace("closing_ring", "loop1")  # links loop1_1 and loop1_2 on fixed joints


def write(folder: Path, yaml: str, urdf: str | None = None) -> Path:
    (folder / "robot.urdf").write_text(tree(FRAMES) if urdf is None else urdf)
    path = folder / "robot.yaml"
    path.write_text(yaml)
    return path


@pytest.mark.parametrize(("kind", "closed"), [("3d", "point"), ("3D", "point"), ("6d", "frame")])
def test_a_pair_of_frames_is_closed(kind: str, closed: str, tmp_path: Path) -> None:
    yaml = f"closed_loop: [['loop1_2', 'loop1_1']]\ntype: ['{kind}']\nname_mot: [hip]\n"
    mechanism = open_mechanism(write(tmp_path, yaml))
    assert [(loop.name, loop.type) for loop in mechanism.loops] == [("loop1_2_loop1_1", closed)]
    assert any("motors" in note and "hip" in note for note in mechanism.notes)
    for q in random_positions():
        assert measured(mechanism, q) == pytest.approx(gaps(closed, relative(q)), abs=1e-12)


def test_a_pair_may_name_joints(tmp_path: Path) -> None:
    """The frame of a joint lies on its child."""
    yaml = "closed_loop:\n  [\n    [wheel, knee],\n  ]\ntype: ['3d']\n"
    mechanism = open_mechanism(write(tmp_path, yaml))
    origins = ((0, 0, 0), (0, 0, 0))
    for q in random_positions():
        expected = gaps("point", relative(q, origins, origins))
        assert measured(mechanism, q) == pytest.approx(expected, abs=1e-12)


def test_joints_take_the_types_of_the_yaml(tmp_path: Path) -> None:
    """Hip a ball, wheel two hinges about z and the turned x, track held at zero."""
    yaml = (
        "joint_name: [hip, wheel, track]\njoint_type: [SPHERICAL, UJOINT_ZX, FIXED]\n"
        "closed_loop: []\ntype: []\n"
    )
    mechanism = srm.load(write(tmp_path, yaml, tree().replace('"continuous"', '"revolute"')))
    assert mechanism.joint_names == ("hip", "knee", "wheel")
    model = pin.Model()
    at = {"base": (0, pin.SE3.Identity())}
    for i, (name, _, parent, child, xyz, rpy, _) in enumerate(BRANCHES):
        joint, offset = at[parent]
        here = offset * placement(xyz.split(), rpy.split())
        kinds = {
            "hip": [pin.JointModelSpherical()],
            "knee": [pin.JointModelRevoluteUnaligned(np.array([2.0, 1.0, 2.0]) / 3.0)],
            "track": [],
            "wheel": [pin.JointModelRZ(), pin.JointModelRX()],
        }[name]
        for k, kind in enumerate(kinds):
            joint, here = model.addJoint(joint, kind, here, f"{name}_{k}"), pin.SE3.Identity()
        at[child] = (joint, here)
        tensor = np.array([[0.03, 0.002, 0.0], [0.002, 0.05, 0.001], [0.0, 0.001, 0.06]])
        centre = placement((0.2, 0.1 * i, 0.1), (0.3, 0.0, 0.1))
        model.appendBodyToJoint(
            joint, pin.Inertia(MASSES[child], np.zeros(3), tensor), here * centre
        )
    model.gravity.linear = mechanism.model.gravity.linear
    assert_same_dynamics(mechanism.model, model)


def test_the_urdf_may_have_the_name_of_the_yaml_or_be_the_only_one(tmp_path: Path) -> None:
    yaml = "closed_loop: [[loop1_1, loop1_2]]\ntype: [3d]\n"
    path = write(tmp_path, yaml)
    (tmp_path / "robot.urdf").rename(tmp_path / "legs.urdf")
    assert len(open_mechanism(path).loops) == 1
    path = path.rename(tmp_path / "legs.yaml")
    (tmp_path / "robot.urdf").write_text("<robot/>")
    assert len(open_mechanism(path).loops) == 1


def test_meshes_and_faults_belong_to_the_urdf(tmp_path: Path) -> None:
    path = write(tmp_path, "closed_loop: []\ntype: []\n", tree().replace('"1.5"', '"-1.5"'))
    with pytest.raises(srm.InputError, match=r"robot\.urdf: link 'thigh': the mass"):
        srm.load(path)
    source = open_mechanism(write(tmp_path, "name_mot: []\n")).source
    assert source is not None
    assert source.urdf_path == str(tmp_path / "robot.urdf")


FAULTS = {
    "unequal closures": "closed_loop: [[a, b]]\ntype: []\n",
    "unequal joints": "joint_name: [hip]\n",
    "no pair": "closed_loop: [[loop1_1]]\ntype: [3d]\n",
    "no frame": "closed_loop: [[loop1_1, loop3]]\ntype: [3d]\n",
    "another type": "closed_loop: [[loop1_1, loop1_2]]\ntype: [5d]\n",
    "a number for a type": "closed_loop: [[loop1_1, loop1_2]]\ntype: [6]\n",
    "no joint": "joint_name: [hop]\njoint_type: [FIXED]\n",
    "a fixed joint": "joint_name: [loop1_1_frame]\njoint_type: [FIXED]\n",
    "another joint type": "joint_name: [hip]\njoint_type: [BALL]\n",
    "axes in line": "joint_name: [hip]\njoint_type: [UJOINT_XX]\n",
    "a joint twice": "joint_name: [hip, hip]\njoint_type: [FIXED, FIXED]\n",
    "an unknown key": "closed_loop: []\ntype: []\nmotors: []\n",
    "no list": "closed_loop: ring\n",
    "no YAML": "closed_loop: [[\n",
    "no keys": "- closed_loop\n",
    "nothing": "",
    "aliases of aliases": (
        "closed_loop: [&a [x, x, x], &b [*a, *a, *a], &c [*b, *b, *b], &d [*c, *c, *c], [*d, *d]]\n"
        "type: [3d, 3d, 3d, 3d, 3d]\n"
    ),
    "an object": "closed_loop: !!python/object:os.system []\n",
}


def test_a_faulty_yaml_is_one_clear_error(tmp_path: Path) -> None:
    messages = {}
    for fault, yaml in FAULTS.items():
        path = write(tmp_path, yaml)
        messages[fault] = refused(partial(srm.load, path), tmp_path)
        assert messages[fault].startswith(path.name)
    check_messages("gepetto", messages)


def test_a_yaml_without_urdf_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "closed_loop: []\ntype: []\n")
    (tmp_path / "robot.urdf").unlink()
    with pytest.raises(srm.InputError, match=r"no 'robot\.urdf' .*and no 'robot\.urdf' beside it"):
        srm.load(path)
