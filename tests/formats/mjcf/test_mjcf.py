"""MJCF files against MuJoCo itself: M, bias, springs and residuals at random configurations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.visualization.animation.shapes import visuals_of
from tests.integration.kernel.test_kernel import agree
from tests.support.backends import on_both
from tests.support.dynamics import assert_same_dynamics, closure, states
from tests.support.lockstep import compare
from tests.support.mjcf_files import (
    BODY,
    FOUR_BAR,
    TREE,
    TWO,
    TWO_LOOPS,
    file,
    loaded,
    model_of,
)
from tests.support.mujoco_twins import Twins, check_dynamics, check_residuals, random_states
from tests.support.sdf_files import cassie

mujoco = pytest.importorskip("mujoco")

REPLICATES = """<mujoco><compiler angle="degree" balanceinertia="true"/><worldbody>
  <body name="hub"><joint name="turn" axis="0 0 1"/><geom size="0.1"/>
    <replicate count="11" offset="0.1 0 0.02" euler="0 20 30" sep="_">
      <body name="arm" pos="0.5 0 0" gravcomp="0.7"><joint name="bend" axis="0 1 0"/>
        <geom name="bar" type="box" size="0.2 0.01 0.02" pos="0.2 0 0"/>
        <replicate count="2" offset="0 0.1 0"><geom name="tip" size="0.02"/></replicate>
      </body></replicate>
    <body name="odd" pos="0 0 1" gravcomp="1"><joint name="j" axis="1 0 0"/>
      <inertial pos="0 0.1 0" mass="1" diaginertia="0.1 0.2 0.6"/></body>
  </body></worldbody></mujoco>"""
FREE = """<mujoco><worldbody>
  <body name="plate" pos="0.1 0 1" euler="20 0 40">
    <joint name="root" type="free" damping="0.4" armature="0.3" stiffness="2"/>
    <geom type="box" size="0.1 0.2 0.03" pos="0.1 0 0"/>
    <body name="arm" pos="0.1 0.2 0"><joint name="j" axis="0 1 0"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0"/></body>
  </body>
  <body name="stone" pos="1 0 1"><joint name="rolls" type="free" armature="0.2"/>
    <geom size="0.1"/></body>
  </worldbody></mujoco>"""
TENDONS = FOUR_BAR.replace('name="pin"', 'name="pin" active="false"').replace(
    "</equality>",
    '<tendon name="tied" tendon1="pair" polycoef="0.2"/>'
    '<tendon name="geared" tendon1="one" tendon2="other" polycoef="0.1 3"/></equality>'
    '<tendon><fixed name="pair"><joint joint="a" coef="1"/><joint joint="d" coef="-2"/></fixed>'
    '<fixed name="one"><joint joint="b" coef="1"/></fixed>'
    '<fixed name="other"><joint joint="d" coef="0.5"/></fixed></tendon>',
)
THREE = TENDONS.replace(
    '<joint joint="d" coef="-2"/></fixed>',
    '<joint joint="d" coef="-2"/><joint joint="b" coef="0.7"/></fixed>',
)
CURVED = THREE.replace('polycoef="0.1 3"', 'polycoef="0.1 0.5 -0.3 0.2 -0.1"').replace(
    '<tendon name="tied" tendon1="pair" polycoef="0.2"/>',
    '<joint joint1="a" joint2="d" polycoef="0.2 0.4 0 0.7"/>',
)
CABLES = """<mujoco><worldbody>
  <body name="hub"><joint name="a" axis="0 1 0" ref="20" springdamper="0.3 0.7"/>
    <geom type="capsule" size="0.1 0.2" pos="0.3 0 0.1"/>
    <body name="arm" pos="0.5 0 0">
      <joint name="b" axis="0 0 1" springref="-30" springdamper="0.2 1.5"/>
      <joint name="c" type="slide" axis="1 0 0" springref="0.1" ref="0.3" springdamper="0 0"/>
      <geom type="capsule" size="0.1 0.2" pos="0.3 0.1 0"/></body>
    <body name="wrist" pos="0 0.4 0"><joint name="d" type="ball" springdamper="0.4 0.5"/>
      <geom type="box" size="0.1 0.2 0.3" pos="0 0.1 0.2"/></body>
  </body>
  <body name="stone" pos="1 0 1"><freejoint name="rolls"/><geom size="0.1"/>
    <body name="lid" pos="0 0 0.2">
      <joint name="e" axis="1 0 0" armature="0.2" springdamper="0.1 1"/>
      <geom type="box" size="0.1 0.1 0.02" pos="0 0.2 0"/></body></body>
  </worldbody>
  <tendon><fixed stiffness="30" damping="2"><joint joint="a" coef="0.4"/>
      <joint joint="c" coef="2"/><joint joint="b" coef="-0.7"/></fixed>
    <fixed stiffness="12" springlength="0.3"><joint joint="e" coef="0.5"/>
      <joint joint="a" coef="-0.1"/></fixed>
    <fixed damping="3"><joint joint="e" coef="0.5"/><joint joint="b" coef="0.25"/></fixed></tendon>
  </mujoco>"""
SLACK = """<mujoco><worldbody><site name="hook" pos="0.1 0.2 0.9"/>
  <body name="hub"><joint name="a" axis="0 1 0" ref="20"/>
    <geom type="capsule" size="0.1 0.2" pos="0.3 0 0.1"/>
    <body name="arm" pos="0.5 0 0"><site name="tip" pos="0.3 0 0"/>
      <joint name="b" axis="0 0 1" springref="-30"/>
      <joint name="c" type="slide" axis="1 0 0" springref="0.1" ref="0.3"/>
      <geom type="capsule" size="0.1 0.2" pos="0.3 0.1 0"/></body></body></worldbody>
  <tendon><fixed name="cable" {}><joint joint="a" coef="0.4"/>
      <joint joint="c" coef="2"/><joint joint="b" coef="-0.7"/></fixed>
    <fixed name="own" stiffness="7" springlength="-1 0.2"><joint joint="b" coef="0.5"/></fixed>
    <spatial name="rope" stiffness="50" damping="3" springlength="0 0.7"><site site="hook"/>
      <site site="tip"/></spatial></tendon></mujoco>"""
GLOBAL = """<mujoco><compiler angle="radian" coordinate="global"/><worldbody>
  <body name="post" pos="1 2 0" axisangle="0 0 1 1.5707963267948966">
    <joint name="a" axis="0 1 0" pos="1 2.5 0.5" ref="0.2" armature="0.1"/>
    <geom type="capsule" size="0.1" fromto="1 2 0 1 3 0.5"/>
    <body name="bare"><joint name="b" type="slide" axis="0 0 1" pos="5 5 5"/>
      <geom type="box" size="0.1 0.2 0.3" pos="1 3 1" axisangle="0 0 1 1.5707963267948966"/>
      <body name="tip"><joint name="c" axis="1 0 0" pos="1 3 1.5"/>
        <inertial pos="1 3.25 1.5" mass="2" diaginertia="0.1 0.2 0.25"/>
        <site name="end" pos="1 3.5 1.5"/></body></body></body>
  <body name="strut" pos="1 4 0"><joint name="d" type="ball" pos="1 4 0"/>
    <geom type="capsule" size="0.1" fromto="1 4 0 1 3.5 1.5"/></body></worldbody>
  <equality><connect name="pin" body1="strut" body2="tip" anchor="1 3.5 1.5"/></equality>
  </mujoco>"""
LOCAL = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="post" pos="1 2 0" axisangle="0 0 1 1.5707963267948966">
    <joint name="a" axis="1 0 0" pos="0.5 0 0.5" ref="0.2" armature="0.1"/>
    <geom type="capsule" size="0.1" fromto="0 0 0 1 0 0.5"/>
    <body name="bare" pos="1 0 1"><joint name="b" type="slide" axis="0 0 1"/>
      <geom type="box" size="0.1 0.2 0.3"/>
      <body name="tip" pos="0.25 0 0.5"><joint name="c" axis="0 -1 0" pos="-0.25 0 0"/>
        <inertial pos="0 0 0" mass="2" diaginertia="0.2 0.1 0.25"/>
        <site name="end" pos="0.25 0 0"/></body></body></body>
  <body name="strut" pos="1 4 0"><joint name="d" type="ball"/>
    <geom type="capsule" size="0.1" fromto="0 0 0 0 -0.5 1.5"/></body></worldbody>
  <equality><connect name="pin" body1="strut" body2="tip" anchor="0 -0.5 1.5"/></equality>
  </mujoco>"""
FILES = {
    "slack": SLACK.format('stiffness="40" damping="2" springlength="0.6 0.9"'),
    "local": LOCAL,
    "tree": TREE,
    "cables": CABLES,
    "three": THREE,
    "curved": CURVED,
    "free": FREE,
    "tendons": TENDONS,
    "four_bar": FOUR_BAR,
    "two_loops": TWO_LOOPS,
    "replicates": REPLICATES,
}


@pytest.mark.parametrize("name", FILES)
def test_mass_matrix_and_forces_are_those_of_mujoco(name: str) -> None:
    check_dynamics(Twins(FILES[name]))


@pytest.mark.parametrize("name", ["four_bar", "tendons", "three", "curved", "two_loops", "local"])
def test_residuals_of_equality_constraints_are_those_of_mujoco(name: str) -> None:
    check_residuals(Twins(FILES[name]))


KEYED = """<mujoco><worldbody>
  <body name="base" pos="0.1 0.2 0.3" euler="0 0 30"><freejoint name="root"/><geom size="0.2"/>
    <body name="arm" pos="0.2 0 0"><joint name="hip" ref="20" axis="0 1 0"/><geom size="0.1"/>
      <body name="hand" pos="0.2 0 0"><joint name="wrist" type="ball"/>
        <geom type="box" size="0.1 0.02 0.03" pos="0.1 0 0"/></body></body></body>{}
  </worldbody>
  <keyframe><key name="home" qpos="1 2 3 0.8 0 0.6 0 0.5 0.6 0 0 0.8 {}"/></keyframe></mujoco>"""


@pytest.mark.parametrize(
    ("more", "own"),
    [
        ("", ""),
        (
            '<body name="far" pos="3 0 0"><joint name="far" type="slide"/><geom size="1"/></body>',
            "2",
        ),
    ],
)
def test_a_run_starts_in_a_keyframe(tmp_path: Path, more: str, own: str) -> None:
    """Alone, the base is on the root joint; beside another body, on a floating joint."""
    text = KEYED.format(more, own)
    path = tmp_path / "keyed.xml"
    path.write_text(text)
    mechanism = srm.load(path, keyframe="home")
    theirs = mujoco.MjModel.from_xml_string(text)
    state = mujoco.MjData(theirs)
    mujoco.mj_resetDataKeyframe(theirs, state, 0)
    mujoco.mj_forward(theirs, state)
    data = mechanism.model.createData()
    pin.framesForwardKinematics(mechanism.model, data, mechanism.q0)
    for i in range(1, theirs.nbody):
        name = mujoco.mj_id2name(theirs, mujoco.mjtObj.mjOBJ_BODY, i)
        found = data.oMf[mechanism.model.getFrameId(name, pin.FrameType.BODY)]
        np.testing.assert_allclose(found.translation, state.xpos[i], atol=1e-14)
        np.testing.assert_allclose(found.rotation.ravel(), state.xmat[i], atol=1e-14)


def test_a_keyframe_of_a_mechanism_with_closures_is_the_guess(tmp_path: Path) -> None:
    text = FOUR_BAR.replace(
        "</mujoco>",
        '<keyframe><key qpos="0.4 0 0.3" qvel="1 0 0"/><key name="other" qvel="0 0 2"/></keyframe>'
        "</mujoco>",
    )
    path = tmp_path / "keyed.xml"
    path.write_text(text)
    start, zero, other = (srm.load(path, keyframe=key) for key in (None, "0", "other"))
    assert any("--keyframe" in note and "other" in note for note in start.notes)
    assert np.abs(zero.q0 - start.q0).max() > 0.1
    np.testing.assert_array_equal(other.q0, start.q0)
    assert any("rates" in note for note in other.notes)


def test_a_weld_without_torque_holds_the_point_that_mujoco_holds() -> None:
    twins = Twins(TWO_LOOPS.replace("<weld", '<weld torquescale="0"'))
    state = twins.state
    assert [loop["type"] for loop in twins.entries["loop"][:2]] == ["point", "point"]
    for q, v in random_states(twins):
        twins.put(q, v)
        kind = state.efc_type[: state.nefc]
        rows = state.efc_pos[: state.nefc][kind == mujoco.mjtConstraint.mjCNSTR_EQUALITY]
        for ours, theirs in zip(twins.residuals(), rows[:12].reshape(2, 6)):
            np.testing.assert_allclose(theirs, [*ours, 0.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("name", FILES)
def test_each_file_loads_closes_and_runs_alike_on_both_backends(name: str, tmp_path: Path) -> None:
    """With armatures and dampers, which both must see."""
    acting = 'axis="0 1 0" armature="0.2" damping="1"'
    mechanism = loaded(tmp_path, FILES[name].replace('axis="0 1 0"', acting))
    assert mechanism.model.armature.any()
    agree(compare(mechanism, 0.5, rtol=1e-10))


@pytest.mark.parametrize(
    "more",
    [
        '<compiler settotalmass="7"/>',
        '<compiler boundmass="20" boundinertia="0.5"/>',
        '<compiler inertiagrouprange="1 2"/><default><geom group="1"/></default>',
        '<compiler inertiafromgeom="true" angle="radian"/>',
    ],
)
def test_masses_are_those_of_mujocos_compiler(more: str) -> None:
    text = file(TWO.replace("<geom", '<inertial pos="0 0 0.1" mass="3" diaginertia="1 1 1"/><geom'))
    text = text.replace("<worldbody>", more + "<worldbody>")
    ours, theirs = model_of(text), mujoco.MjModel.from_xml_string(text)
    for i, joint in ((1, "j"), (2, "k")):
        inertia = ours.inertias[ours.getJointId(joint)]
        np.testing.assert_allclose(inertia.mass, theirs.body_mass[i], rtol=1e-12)
        np.testing.assert_allclose(inertia.lever, theirs.body_ipos[i], atol=1e-12)
        np.testing.assert_allclose(
            np.linalg.eigvalsh(inertia.inertia), np.sort(theirs.body_inertia[i]), rtol=1e-12
        )


def test_one_free_body_is_a_floating_robot_at_its_pose(tmp_path: Path) -> None:
    body = BODY.format("base", "x").replace('<joint name="x"/>', "<freejoint/>")
    body = body.replace('name="base"', 'name="base" pos="1 2 3" euler="10 20 30"')
    arm = BODY.format("arm", "j")
    text = file(body.replace("</body>", arm + "</body>"))
    mechanism = loaded(tmp_path, text)
    assert mechanism.joint_names == ("root_joint", "j")
    theirs = mujoco.MjModel.from_xml_string(text)
    state = mujoco.MjData(theirs)
    mujoco.mj_forward(theirs, state)
    data = mechanism.model.createData()
    pin.framesForwardKinematics(mechanism.model, data, mechanism.q0)
    for i, name in ((1, "base"), (2, "arm")):
        found = data.oMf[mechanism.model.getFrameId(name, pin.FrameType.BODY)]
        np.testing.assert_allclose(found.translation, state.xpos[i], atol=1e-14)
        np.testing.assert_allclose(found.rotation.ravel(), state.xmat[i], atol=1e-14)


@pytest.mark.parametrize("moved", ["", 'refpos="0.3 -0.2 0.5" refquat="0.6 0.8 0 0"'])
@pytest.mark.parametrize("scale", ["1 2 1", "-1 1 0.5"])
@pytest.mark.parametrize("kind", ["legacy", "exact", "convex", "shell"])
def test_the_inertia_of_a_mesh_is_that_of_mujoco(
    tmp_path: Path, kind: str, scale: str, moved: str
) -> None:
    mesh = cassie("cassie").parents[1] / "meshes" / "knee.stl"
    geom = '<geom type="mesh" mesh="knee" pos="0.1 0 0" euler="30 0 0" density="500"/>'
    text = file(
        f'<body name="knee"><joint name="j"/>{geom}</body>'
        '<body name="wall"><geom type="mesh" mesh="knee"/></body>',
        f'<asset><mesh name="knee" inertia="{kind}" scale="{scale}" {moved} '
        f'file="{mesh}"/></asset>',
    )
    theirs = mujoco.MjModel.from_xml_string(text)
    inertia = loaded(tmp_path, text).model.inertias[1]
    np.testing.assert_allclose(inertia.mass, theirs.body_mass[1], rtol=1e-12)
    np.testing.assert_allclose(inertia.lever, theirs.body_ipos[1], atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(inertia.inertia), np.sort(theirs.body_inertia[1]), rtol=1e-9
    )


@pytest.mark.parametrize(
    "moved",
    [
        'refpos="0.3 -0.2 0.5" refquat="0.6 0.8 0 0" scale="2 2 2"',
        'refpos="0.3 -0.2 0.5" scale="2 0.5 1"',
        'refquat="2 0 0 1"',
    ],
)
def test_a_mesh_that_is_moved_first_is_drawn_where_mujoco_has_it(
    tmp_path: Path, moved: str
) -> None:
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
    sides = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
    (tmp_path / "tetra.obj").write_text(vertices + sides)
    text = file(
        '<body name="b" pos="0 0 1"><joint name="j"/><inertial pos="0 0 0" mass="1" '
        'diaginertia="1 1 1"/><geom type="mesh" mesh="t" pos="0.1 0.2 0.3" quat="0.8 0 0.6 0"/>'
        "</body>",
        f'<asset><mesh name="t" file="tetra.obj" {moved}/></asset>',
    )
    mechanism = loaded(tmp_path, text)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    own = model.mesh_vert.reshape(-1, 3)
    theirs = state.geom_xpos[0] + own @ state.geom_xmat[0].reshape(3, 3).T
    (visual,) = visuals_of(mechanism)
    data = mechanism.model.createData()
    pin.forwardKinematics(mechanism.model, data, mechanism.q0)
    place = data.oMi[visual.joint] * visual.placement
    ours = np.array([place.act(x) for x in np.array(visual.shape.vertices)])
    apart = np.linalg.norm(ours[:, None] - theirs[None], axis=2)
    assert apart.min(axis=0).max() < 1e-6
    assert apart.min(axis=1).max() < 1e-6


def test_what_a_mesh_cannot_be_drawn_with_is_noted(tmp_path: Path) -> None:
    asset = '<asset><mesh name="t" file="t.obj" refquat="1 1 0 0" scale="1 2 1"/></asset>'
    notes = loaded(tmp_path, file(more=asset)).notes
    assert any("refquat and an unequal scale" in note for note in notes)


@pytest.mark.parametrize("sequence", ["xyz", "XYZ", "zYx", "XyZ", "yXy"])
def test_euler_angles_turn_about_moving_and_fixed_axes_as_in_mujoco(sequence: str) -> None:
    twins = Twins(
        file(
            BODY.format("one", "j").replace("<body", '<body euler="20 -35 50"'),
            f'<compiler eulerseq="{sequence}"/>',
        )
    )
    twins.put(np.zeros(1), np.zeros(1))
    ours, theirs = twins.body("one")
    np.testing.assert_allclose(ours.homogeneous, theirs.homogeneous, atol=1e-14)


KNEE = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="thigh"><joint name="hip" axis="0 1 0" ref="0.2"/>
    <geom type="capsule" size="0.05" fromto="0 0 0 0 0 -0.4"/>
    <body name="sled" pos="0 0 -0.4"><joint name="shift" type="slide" axis="1 0 0"/>
      <geom size="0.03" mass="0.1"/>
      <body name="shank"><joint name="knee" axis="0 1 0" ref="0.1"/>
        <geom type="capsule" size="0.04" fromto="0 0 0 0 0 -0.4"/></body></body></body>
  </worldbody>
  <equality><joint joint1="shift" joint2="knee" polycoef="0.01 0.08 -0.05 0.03 -0.02"/></equality>
  </mujoco>"""


@on_both
def test_a_knee_that_slides_moves_as_the_constrained_equations_have_it(
    backend: str, tmp_path: Path
) -> None:
    """With M, bias and the row of MuJoCo, the rate of the row by differences."""
    mechanism = loaded(tmp_path, KNEE)
    theirs = mujoco.MjModel.from_xml_string(KNEE)
    theirs.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    state = mujoco.MjData(theirs)
    start = srm.assemble(mechanism, v={"hip": 1.0, "knee": -3.0})
    run = srm.simulate(mechanism, 1.0, q0=start.q, v0=start.v, rtol=1e-9, backend=backend)
    assert mechanism.joint_names == ("hip", "shift", "knee")

    def row(q: np.ndarray) -> np.ndarray:
        state.qpos[:] = q
        mujoco.mj_forward(theirs, state)
        return np.array(state.efc_J.reshape(state.nefc, -1)[0])

    step = 1e-4
    for t in (0.2, 0.5, 0.9):
        q, v = run(t)
        acceleration = (run(t + step)[1] - run(t - step)[1]) / (2.0 * step)
        q = q + theirs.qpos0
        rate = (row(q + step * v) - row(q - step * v)) @ v / (2.0 * step)
        J = row(q)[None]
        state.qvel[:] = v
        mujoco.mj_forward(theirs, state)
        assert abs(state.efc_pos[0]) < 1e-12
        M = np.zeros((3, 3))
        mujoco.mj_fullM(theirs, state, M)
        kkt = np.block([[M, J.T], [J, np.zeros((1, 1))]])
        expected = np.linalg.solve(kkt, np.append(-state.qfrc_bias, -rate))[:3]
        np.testing.assert_allclose(acceleration, expected, rtol=1e-5, atol=1e-5)


def test_global_coordinates_mean_the_same_model_as_local_ones(tmp_path: Path) -> None:
    """MuJoCo itself reads local ones only; the other tests compare those with it."""
    loaded = []
    for name, text in (("global", GLOBAL), ("local", LOCAL)):
        path = tmp_path / f"{name}.xml"
        path.write_text(text)
        loaded.append(srm.load(path))
    ours, local = loaded
    assert_same_dynamics(ours.model, local.model, atol=1e-10)
    for q, v in states(ours.model):
        # g, its rate and acceleration, whose components are in frames of their own.
        sizes = [np.linalg.norm(closure(each, q, v).reshape(3, 3), axis=1) for each in loaded]
        np.testing.assert_allclose(*sizes, rtol=1e-12)


@pytest.mark.parametrize(
    ("tendon", "friction"),
    [
        ('armature="3" damping="2" stiffness="40" springlength="0.7"', 0.0),
        ('frictionloss="6" stiffness="40" springlength="0.6 0.9"', 6.0),
    ],
)
def test_armature_friction_and_slack_of_a_fixed_tendon_act(
    tendon: str, friction: float, tmp_path: Path
) -> None:
    """The motion is that of MuJoCo's accelerations without its constraints, to which friction is
    added as this package smooths it."""
    path = tmp_path / "slack.xml"
    path.write_text(SLACK.format(tendon))
    mechanism = srm.load(path)
    assert mechanism.degrees_of_freedom == 3
    rates = {"a": 1.0, "b": -2.0, "c": 1.5}
    start = srm.assemble(mechanism, {"a": 0.0, "b": 0.0, "c": 0.0}, rates)
    run = srm.simulate(mechanism, 0.5, q0=start.q, v0=start.v, rtol=1e-9)
    assert run.success, run.message

    theirs = mujoco.MjModel.from_xml_path(str(path))
    theirs.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    state = mujoco.MjData(theirs)
    factors, speed = np.array([0.4, -0.7, 2.0]), mechanism.friction_speed

    def field(t: float, y: FloatArray) -> FloatArray:
        state.qpos[:], state.qvel[:] = theirs.qpos0 + y[:3], y[3:]
        mujoco.mj_forward(theirs, state)
        M = np.zeros((3, 3))
        mujoco.mj_fullM(theirs, state, M)
        held = -friction * np.tanh(factors @ y[3:] / speed) * factors
        return np.concatenate([y[3:], np.linalg.solve(M, state.qfrc_smooth + held)])

    start_y = np.concatenate([np.zeros(3), list(rates.values())])
    expected = solve_ivp(field, (0.0, 0.5), start_y, method="LSODA", rtol=1e-10, atol=1e-12)
    found = np.array([float(run.joint(name)[0][-1]) for name in rates])
    assert np.abs(expected.y[:3, -1]).max() > 0.2
    np.testing.assert_allclose(found, expected.y[:3, -1], atol=1e-7)
    assert run.energy_balance.relative < 1e-6
