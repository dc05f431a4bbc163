"""What Drake adds to URDF and SDF: joints, motors, frames, filters of collisions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support import sdf_files
from tests.support.dynamics import mass_matrix
from tests.support.urdf_files import LINK, tree

DRAKE = 'xmlns:drake="http://drake.mit.edu"'


def loaded(folder: Path, text: str, name: str = "robot.urdf") -> srm.Mechanism:
    path = folder / name
    path.write_text(text)
    return srm.load(path)


def motor(joint: str, inside: str, kind: str = "SimpleTransmission") -> str:
    return (
        f"<transmission {DRAKE}><type>{kind}</type><joint name='{joint}'/>"
        f"<actuator name='m'>{inside}</actuator></transmission>"
    )


ROTOR = '<drake:rotor_inertia value="0.002"/>'
GEAR = '<drake:gear_ratio value="-30"/>'


def added(folder: Path, text: str, name: str = "robot.urdf") -> list[float]:
    """What is added to the diagonal of the mass matrix of the two branches, and nothing else."""
    mechanism, plain = loaded(folder, text, name), loaded(folder, tree())
    M, bare = (mass_matrix(each.model, each.q0) for each in (mechanism, plain))
    np.testing.assert_allclose(M - np.diag(np.diag(M - bare)), bare, rtol=1e-14)
    return np.diag(M - bare).tolist()  # type: ignore[no-any-return]


def test_the_inertia_of_a_motor_is_seen_through_its_gear(tmp_path: Path) -> None:
    """By hip, knee, track, wheel: I n^2 of every motor on a joint, n = 1 without a gear."""
    armature = {"wheel": '<dynamics armature="0.25"/>'}
    urdf = tree(motor("knee", ROTOR + GEAR) + motor("wheel", ROTOR) * 2, armature)
    assert added(tmp_path, urdf) == pytest.approx([0.0, 1.8, 0.0, 0.254], rel=1e-12)
    notes = loaded(tmp_path, urdf).notes
    assert any("acts as armature of the joints 'knee', 'wheel'" in note for note in notes)


def test_where_drake_has_no_motor_its_inertia_does_not_act(tmp_path: Path) -> None:
    other = motor("knee", ROTOR, "Differential") + motor("hip", GEAR)
    assert added(tmp_path, tree(other)) == [0.0] * 4
    idle = tree(motor("knee", ROTOR)).replace('effort="1"', 'effort="0"')
    assert added(tmp_path, idle) == [0.0] * 4


def test_a_converted_motor_counts_once(tmp_path: Path) -> None:
    mechanism = loaded(tmp_path, tree(motor("knee", ROTOR + GEAR)))
    srm.convert(tmp_path / "robot.urdf", tmp_path / "out.toml")
    np.testing.assert_array_equal(
        srm.load(tmp_path / "out.toml").model.armature, mechanism.model.armature
    )


@pytest.mark.parametrize(
    ("inside", "problem"),
    [
        (motor("ankle", ROTOR), "there is no joint 'ankle'"),
        (motor("hip", '<drake:rotor_inertia value="-1"/>'), "is negative"),
        (motor("hip", "<drake:rotor_inertia/>"), "has no 'value'"),
        (motor("hip", ROTOR + '<drake:gear_ratio value="x"/>'), "not a finite number"),
        (f'<drake:joint {DRAKE} name="c" type="curvilinear"/>', "no type 'curvilinear'"),
    ],
)
def test_what_is_wrong_is_named(inside: str, problem: str, tmp_path: Path) -> None:
    with pytest.raises(srm.InputError, match=problem):
        loaded(tmp_path, tree(inside))


@pytest.mark.parametrize(
    ("drake", "own", "inside"),
    [
        ("ball", "spherical", ""),
        ("universal", "universal", '<axis xyz="1 0 0"/><axis2 xyz="0 1 0"/>'),
        ("planar", "planar", '<axis xyz="0 0 1"/>'),
        ("screw", "screw", '<axis xyz="0 1 0"/><thread_pitch value="0.02"/>'),
    ],
)
def test_a_joint_of_drake_is_that_of_this_package(
    drake: str, own: str, inside: str, tmp_path: Path
) -> None:
    hand = LINK.format(name="hand", mass=0.4, y=0.3)
    ends = '<parent link="shin"/><child link="hand"/>'
    given = '<axis xyz="0 1 0"/>'
    if drake == "screw":
        given += '<drake:screw_thread_pitch value="0.02"/>'
    written = f'<drake:joint {DRAKE} name="wrist" type="{drake}">{ends}{given}</drake:joint>'
    same = f'<joint name="wrist" type="{own}">{ends}{inside}</joint>'
    mechanism, plain = (loaded(tmp_path, tree(hand + each)) for each in (written, same))
    step = np.random.default_rng(3).uniform(-1.0, 1.0, mechanism.model.nv)
    q = pin.integrate(mechanism.model, mechanism.q0, step)
    np.testing.assert_array_equal(mass_matrix(mechanism.model, q), mass_matrix(plain.model, q))


def test_the_ground_needs_no_link(tmp_path: Path) -> None:
    held = '<joint name="bolt" type="fixed"><parent link="world"/><child link="base"/></joint>'
    mechanism, plain = loaded(tmp_path, tree(held)), loaded(tmp_path, tree())
    np.testing.assert_array_equal(
        mass_matrix(mechanism.model, mechanism.q0), mass_matrix(plain.model, plain.q0)
    )


def test_a_mimic_of_drake_in_sdf_is_a_coupling(tmp_path: Path) -> None:
    mimic = '<drake:mimic joint="hinge" multiplier="-2.5" offset="0.3"/>'
    text = sdf_files.sdf(
        sdf_files.link("arm", "0 0 1 0 0 0"),
        sdf_files.link("hand", "0 0 2 0 0 0"),
        sdf_files.joint("hinge", "revolute", "world", "arm"),
        sdf_files.joint("wrist", "revolute", "arm", "hand", mimic),
    ).replace("<sdf ", f"<sdf {DRAKE} ")
    (loop,) = loaded(tmp_path, text, "robot.sdf").loops
    assert (loop.name, loop.joints) == ("wrist::mimic", ("wrist", "hinge"))
    assert (loop.ratio, loop.offset) == (-2.5, 0.3)
    with pytest.raises(srm.InputError, match=r"<multiplier>.*'x'"):
        loaded(tmp_path, text.replace('"-2.5"', '"x"'), "robot.sdf")


def test_frames_filters_and_limits_of_acceleration_are_noted(tmp_path: Path) -> None:
    extra = (
        '<frame name="grasp" link="rim" xyz="0 0 1" rpy="0 0 0"/>'
        f'<drake:collision_filter_group {DRAKE} name="g"><drake:member link="rim"/>'
        '</drake:collision_filter_group><collision_filter_group name="old"/>'
    )
    text = tree(extra).replace("<robot ", f"<robot {DRAKE} ")
    text = text.replace('velocity="1"', 'velocity="1" drake:acceleration="9"', 1)
    text = text.replace('velocity="1"/>', 'velocity="1" acceleration="9"/>', 1)
    notes = loaded(tmp_path, text).notes
    assert set(notes) == {
        "1 <frame> element(s) do not act and are ignored",
        "2 <collision_filter_group> element(s) do not act and are ignored",
        "2 <limit acceleration> attribute(s) do not act and are ignored",
    }


def test_a_motor_in_sdf_acts_likewise(tmp_path: Path) -> None:
    def arm(inside: str) -> srm.Mechanism:
        text = sdf_files.sdf(
            sdf_files.link("arm", "0 0 1 0 0 0"),
            sdf_files.joint("hinge", "revolute", "world", "arm", inside),
        ).replace("<sdf ", f"<sdf {DRAKE} ")
        return loaded(tmp_path, text, "robot.sdf")

    inside = "<drake:rotor_inertia>0.002</drake:rotor_inertia>"
    inside += "<drake:gear_ratio>30</drake:gear_ratio>"
    idle = "|<limit><effort>0</effort></limit>"
    for more, armature in ((inside, 1.8), (inside + idle, 0.0)):
        assert arm(more).model.armature == pytest.approx([armature], rel=1e-12)
    assert any("acts as armature" in note and "hinge" in note for note in arm(inside).notes)
