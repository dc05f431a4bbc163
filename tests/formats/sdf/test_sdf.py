"""SDF files: poses, joints and graphs are what the file says, checked by naive references."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.formats.document import Document
from srm_mbs.formats.graph.joint_graph import Joint, spanning_tree
from srm_mbs.formats.graph.spanning_tree_to_urdf import numbers, rpy
from srm_mbs.formats.sdf.reader import translate
from srm_mbs.formats.translation import Options, Translation
from srm_mbs.formats.urdf.parser import build_urdf
from tests.support.backends import on_both
from tests.support.sdf_files import CASSIES, cassie, four_bar, joint, link, sdf


def translated(text: str, *cut: str, file: str = "robot.sdf") -> Translation:
    return translate(Document(text, file), Options(cut))


def tree(text: str, *cut: str) -> pin.Model:
    made = translated(text, *cut)
    return build_urdf(made.tree, "robot.urdf", made.entries.get("base", "fixed")).model


def loaded(folder: Path, text: str, **options: Any) -> srm.Mechanism:
    path = folder / "robot.sdf"
    path.write_text(text)
    return srm.load(path, **options)


def placed(model: pin.Model, name: str, q: FloatArray | None = None) -> pin.SE3:
    """Placement in the world of the link ``name``."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model) if q is None else q)
    return data.oMf[model.getFrameId(name, pin.FrameType.BODY)].copy()


def at(x: float, y: float, z: float, r: float = 0.0, p: float = 0.0, w: float = 0.0) -> pin.SE3:
    return pin.SE3(pin.rpy.rpyToMatrix(r, p, w), np.array([x, y, z]))


def same(a: pin.SE3, b: pin.SE3, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(a.homogeneous, b.homogeneous, rtol=0.0, atol=tolerance)


# Poses --------------------------------------------------------------------------------------

ONE, TWO, THREE = "0.1 0.2 0.3 0.4 -0.5 0.6", "-0.3 0.1 0.5 1.2 0.3 -0.7", "0 0.4 -0.2 2 1.1 0.1"


def of(text: str) -> pin.SE3:
    return at(*map(float, text.split()))


def test_links_are_placed_relative_to_frames_joints_and_nested_models() -> None:
    text = sdf(
        f"<pose>{THREE}</pose>",
        link("base", ONE),
        '<frame name="mount" attached_to="base"><pose>' + TWO + "</pose></frame>",
        f'<frame name="free"><pose relative_to="inner">{TWO}</pose></frame>',
        f'<link name="arm"><pose relative_to="mount">{ONE}</pose></link>',
        f'<link name="hand"><pose relative_to="wrist">{TWO}</pose></link>',
        f'<link name="far"><pose relative_to="free">{THREE}</pose></link>',
        joint("hinge", "revolute", "base", "arm"),
        joint("wrist", "revolute", "mount", "hand", f'<pose relative_to="arm">{THREE}</pose>'),
        joint("inside", "revolute", "hand", "inner::box"),
        joint("weld", "fixed", "base", "far", axis=""),
        f'<model name="inner"><pose relative_to="mount">{ONE}</pose>{link("box", TWO)}</model>',
        f'<model name="outer"><pose>{ONE}</pose><model name="deep"><pose>{TWO}</pose>'
        f"{link('end', THREE)}</model></model>",
        joint("deep_weld", "fixed", "base", "outer::deep::end", axis=""),
    )
    model = tree(text)
    world = of(THREE)
    base = world * of(ONE)
    arm = base * of(TWO) * of(ONE)
    inner = base * of(TWO) * of(ONE)
    for name, expected in {
        "base": base,
        "arm": arm,
        "hand": arm * of(THREE) * of(TWO),
        "inner::box": inner * of(TWO),
        "far": inner * of(TWO) * of(THREE),
        "outer::deep::end": world * of(ONE) * of(TWO) * of(THREE),
    }.items():
        same(placed(model, name), expected)


def test_poses_may_be_in_degrees_or_quaternions() -> None:
    quaternion = pin.Quaternion(pin.rpy.rpyToMatrix(0.3, 0.2, -0.4))
    x, y, z, w = quaternion.coeffs()
    text = sdf(
        '<link name="base"><pose degrees="true">1 2 3 30 -40 50</pose></link>',
        '<link name="arm"><pose relative_to="base" rotation_format="quat_xyzw">'
        f"1 0 0 {x} {y} {z} {w}</pose></link>",
        joint("hinge", "revolute", "base", "arm"),
    )
    model = tree(text)
    base = at(1, 2, 3, *np.deg2rad([30.0, -40.0, 50.0]))
    same(placed(model, "base"), base)
    same(placed(model, "arm"), base * at(1, 0, 0, 0.3, 0.2, -0.4))


@pytest.mark.parametrize(
    ("version", "xyz", "turn"),
    [
        ("1.9", "<xyz>", of(ONE) * of(TWO) * of(THREE)),
        ("1.9", '<xyz expressed_in="__model__">', pin.SE3.Identity()),
        ("1.9", '<xyz expressed_in="base">', of(ONE)),
        ("1.6", "<xyz>", of(ONE) * of(TWO) * of(THREE)),
        ("1.6", "<use_parent_model_frame>1</use_parent_model_frame><xyz>", pin.SE3.Identity()),
        ("1.4", "<xyz>", pin.SE3.Identity()),
    ],
)
def test_an_axis_is_expressed_in_the_frame_that_the_version_says(
    version: str, xyz: str, turn: pin.SE3
) -> None:
    arm = of(ONE) * of(TWO)
    at_arm = numbers([*arm.translation, *rpy(arm.rotation)])
    text = sdf(
        link("base", ONE),
        link("arm", at_arm),
        joint("hinge", "revolute", "base", "arm", f"<pose>{THREE}</pose>", axis="1 2 -2"),
        version=version,
    ).replace("<xyz>", xyz)
    model = tree(text)
    data = model.createData()
    J = pin.computeFrameJacobian(
        model,
        data,
        pin.neutral(model),
        model.getFrameId("arm", pin.FrameType.BODY),
        pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
    )
    np.testing.assert_allclose(J[3:, -1], turn.rotation @ [1 / 3, 2 / 3, -2 / 3], atol=1e-12)


def test_a_joint_and_a_link_of_an_older_file_may_have_one_name() -> None:
    text = sdf(link("arm", ONE), joint("arm", "revolute", "world", "arm"), version="1.6")
    assert list(tree(text).names)[1:] == ["arm"]
    with pytest.raises(srm.InputError, match="are called 'arm'"):
        tree(text.replace("1.6", "1.9"))


@pytest.mark.parametrize("angle", [0.5 * np.pi, 0.5 * np.pi - 1e-9, 1.5708, -0.5 * np.pi, 0.3])
def test_roll_pitch_and_yaw_are_accurate_at_any_pitch(angle: float) -> None:
    rotation = pin.rpy.rpyToMatrix(0.4, angle, -1.3)
    np.testing.assert_allclose(pin.rpy.rpyToMatrix(*rpy(rotation)), rotation, atol=1e-15)


# Joints -------------------------------------------------------------------------------------

MOTIONS = {
    "revolute": lambda q: at(0, 0, 0, 0, 0, q[0]),
    "prismatic": lambda q: at(0, 0, q[0]),
    "screw": lambda q: at(0, 0, 0.2 * q[0] / (2 * np.pi), 0, 0, q[0]),
    "universal": lambda q: at(0, 0, 0, 0, 0, q[0]) * at(0, 0, 0, q[1]),
    "ball": lambda q: pin.SE3(pin.Quaternion(q).matrix(), np.zeros(3)),
    "fixed": lambda q: pin.SE3.Identity(),
}
SECOND = {"universal": "<axis2><xyz>1 0 0</xyz></axis2>"}
PITCH = {"screw": "<screw_thread_pitch>0.2</screw_thread_pitch>"}


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("kind", MOTIONS)
def test_a_joint_moves_its_child_against_its_parent_whichever_is_nearer_to_the_root(
    kind: str, backwards: bool
) -> None:
    """The moving joint's parent is not the root's side if ``backwards``."""
    inside = f"<pose>{THREE}</pose>" + SECOND.get(kind, "") + PITCH.get(kind, "")
    first, second = ("hand", "arm") if backwards else ("arm", "hand")
    text = sdf(
        link("arm", ONE),
        link("hand", TWO),
        joint("held", "revolute", "world", "arm"),
        joint("moving", kind, first, second, inside, "" if kind in ("ball", "fixed") else "0 0 1"),
    )
    model = tree(text)
    q = pin.neutral(model)
    rng = np.random.default_rng(1)
    if kind != "fixed":
        own = model.joints[model.getJointId("moving")]
        q[own.idx_q :] = pin.integrate(model, q, rng.uniform(-1.0, 1.0, model.nv))[own.idx_q :]
    value = q[1:].copy()
    if backwards and kind == "universal":
        value = value[::-1]  # the two angles change places
    if backwards and kind == "ball":
        value[:3] *= -1.0
    between = placed(model, first, q).actInv(placed(model, second, q))
    second_at = of(TWO) if second == "hand" else of(ONE)
    first_at = of(ONE) if first == "arm" else of(TWO)
    J = second_at * of(THREE)
    expected = first_at.actInv(J) * MOTIONS[kind](value) * J.actInv(second_at)
    same(between, expected)


def test_two_axes_that_are_oblique_or_damped_become_two_hinges() -> None:
    inside = "<axis2><xyz>1 0 1</xyz><dynamics><damping>0.3</damping></dynamics></axis2>"
    model = tree(
        sdf(link("arm"), joint("cross", "revolute2", "world", "arm", inside, axis="0 0 1"))
    )
    assert list(model.names)[1:] == ["cross", "cross::axis2"]
    np.testing.assert_array_equal(model.damping, [0.0, 0.3])
    turn = placed(model, "arm", np.array([0.4, 0.9])).rotation
    oblique = pin.AngleAxis(0.9, np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0)).matrix()
    np.testing.assert_allclose(turn, pin.rpy.rpyToMatrix(0, 0, 0.4) @ oblique, atol=1e-12)


def test_an_older_thread_pitch_counts_turns_as_libsdformat_does() -> None:
    text = sdf(
        link("nut"),
        joint("thread", "screw", "world", "nut", "<thread_pitch>-5</thread_pitch>", axis="0 0 1"),
        version="1.6",
    )
    made = translated(text)
    model = build_urdf(made.tree, "robot.urdf", "fixed").model
    np.testing.assert_allclose(placed(model, "nut", np.array([1.0])).translation, [0, 0, 0.2])
    assert any("thread_pitch" in note for note in made.notes)


def test_masses_and_moments_are_those_of_the_file() -> None:
    text = sdf(
        '<link name="arm"><inertial><pose>0.1 0 0.2 0.3 0.4 0</pose><mass>2</mass><inertia>'
        "<ixx>0.2</ixx><iyy>0.3</iyy><izz>0.4</izz><ixy>0.01</ixy></inertia></inertial></link>",
        '<link name="bare"/>',
        joint("hinge", "revolute", "world", "arm"),
        joint("other", "revolute", "world", "bare"),
    )
    made = translated(text)
    model = build_urdf(made.tree, "robot.urdf", "fixed").model
    turn = pin.rpy.rpyToMatrix(0.3, 0.4, 0.0)
    own = np.array([[0.2, 0.01, 0.0], [0.01, 0.3, 0.0], [0.0, 0.0, 0.4]])
    arm = model.inertias[model.getJointId("hinge")]
    assert arm.mass == 2.0
    np.testing.assert_allclose(arm.lever, [0.1, 0.0, 0.2], atol=1e-15)
    np.testing.assert_allclose(arm.inertia, turn @ own @ turn.T, atol=1e-15)
    assert model.inertias[model.getJointId("other")].mass == 1.0
    assert any("defaults" in note and "'bare'" in note for note in made.notes)


def test_a_double_pendulum_accelerates_as_its_equations_say(tmp_path: Path) -> None:
    """Lagrange's equations of two rods, with a spring, damping and gravity, written out here."""
    m1, m2, l1, c1, c2, damping, k, rest = 1.3, 0.8, 1.0, 0.45, 0.6, 0.2, 7.0, 0.3
    spring = f"<spring_stiffness>{k}</spring_stiffness><spring_reference>{rest}</spring_reference>"
    text = sdf(
        link("upper", "0 0 2 0 0 0", m1, f"0 0 {-c1} 0 0 0"),
        link("lower", "0 0 1 0 0 0", m2, f"0 0 {-c2} 0 0 0"),
        joint("shoulder", "revolute", "world", "upper"),
        joint(
            "elbow",
            "revolute",
            "upper",
            "lower",
            f"|<dynamics><damping>{damping}</damping>{spring}</dynamics>",
        ),
    )
    mechanism = loaded(tmp_path, text, gravity=[0.0, 0.0, -9.81])
    q, v, g = np.array([0.4, -0.9]), np.array([0.7, 1.6]), 9.81
    i1, i2 = 0.01 * m1, 0.01 * m2
    cos, sin = np.cos(q[1]), np.sin(q[1])
    m12 = i2 + m2 * c2 * (c2 + l1 * cos)
    M = np.array(
        [[i1 + i2 + m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2 * cos), m12],
         [m12, i2 + m2 * c2**2]]
    )  # fmt: skip
    h = m2 * l1 * c2 * sin
    coriolis = np.array([-h * (2 * v[0] * v[1] + v[1] ** 2), h * v[0] ** 2])
    both = m2 * c2 * np.sin(q.sum())
    weight = g * np.array([(m1 * c1 + m2 * l1) * np.sin(q[0]) + both, both])
    elbow = np.array([0.0, -k * (q[1] - rest) - damping * v[1]])
    expected = np.linalg.solve(M, elbow - coriolis - weight)
    step = 1e-4
    run = srm.simulate(mechanism, step, q0=q, v0=v, rtol=1e-12, atol=1e-14)
    back = srm.simulate(mechanism, 2 * step, q0=q, v0=v, rtol=1e-12, atol=1e-14)
    found = (4 * run.v[-1] - back.v[-1] - 3 * v) / (2 * step)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@on_both
def test_gravity_does_not_act_on_a_link_that_says_so(tmp_path: Path, backend: str) -> None:
    """A double pendulum whose lower rod has no weight, by SciPy on its equations; and the base."""
    m1, m2, l1, c1, c2, g = 1.3, 0.8, 1.0, 0.45, 0.6, 3.7
    off = "<gravity>false</gravity>"
    text = sdf(
        link("foot").replace("<inertial>", off + "<inertial>"),
        link("upper", "0 0 2 0 0 0", m1, f"0 0 {-c1} 0 0 0"),
        link("lower", "0 0 1 0 0 0", m2, f"0 0 {-c2} 0 0 0").replace("<in", off + "<in", 1),
        joint("weld", "fixed", "world", "foot", axis=""),
        joint("shoulder", "revolute", "foot", "upper"),
        joint("elbow", "revolute", "upper", "lower"),
    )
    mechanism = loaded(tmp_path, text, gravity=[0.0, 0.0, -g])
    assert any("gravity does not act" in note and "lower" in note for note in mechanism.notes)
    assert [force.name for force in mechanism.forces] == ["lower::gravity_compensation"]
    i1, i2 = 0.01 * m1, 0.01 * m2

    def rates(t: float, y: FloatArray) -> FloatArray:
        q, v = y[:2], y[2:]
        cos, sin = np.cos(q[1]), np.sin(q[1])
        m12 = i2 + m2 * c2 * (c2 + l1 * cos)
        m11 = i1 + i2 + m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2 * cos)
        M = np.array([[m11, m12], [m12, i2 + m2 * c2**2]])
        h = m2 * l1 * c2 * sin
        coriolis = np.array([-h * (2 * v[0] * v[1] + v[1] ** 2), h * v[0] ** 2])
        weight = np.array([g * m1 * c1 * np.sin(q[0]), 0.0])
        return np.concatenate([v, np.linalg.solve(M, -coriolis - weight)])

    start = np.array([0.4, -0.9, 0.7, 1.6])
    reference = solve_ivp(rates, (0.0, 1.0), start, rtol=1e-12, atol=1e-13).y[:, -1]
    run = srm.simulate(mechanism, 1.0, q0=start[:2], v0=start[2:], rtol=1e-10, backend=backend)
    np.testing.assert_allclose(np.concatenate([run.q[-1], run.v[-1]]), reference, atol=1e-8)
    assert run.energy_balance.relative < 1e-9
    assert np.abs(run.energy_balance.works["force lower::gravity_compensation"]).max() > 0.1


def test_gravity_of_a_link_survives_conversion(tmp_path: Path) -> None:
    text = four_bar().replace("<inertial>", "<gravity>0</gravity><inertial>", 1)
    mechanism = loaded(tmp_path, text)
    srm.convert(tmp_path / "robot.sdf", tmp_path / "out.toml")
    assert srm.load(tmp_path / "out.toml").forces == mechanism.forces
    assert len(mechanism.forces) == 1
    assert not loaded(tmp_path, text, gravity=[0.0, 0.0, 0.0]).forces


# Inertia of collisions ------------------------------------------------------------------------

SHAPES = {
    "box": ("<size>0.2 0.4 0.6</size>", lambda x, y, z: (abs(2 * np.array([x, y, z]))
            <= [[0.2], [0.4], [0.6]]).all(axis=0)),
    "sphere": ("<radius>0.3</radius>", lambda x, y, z: x**2 + y**2 + z**2 <= 0.09),
    "cylinder": ("<radius>0.2</radius><length>0.5</length>",
                 lambda x, y, z: (x**2 + y**2 <= 0.04) & (abs(z) <= 0.25)),
    "capsule": ("<radius>0.2</radius><length>0.2</length>",
                lambda x, y, z: x**2 + y**2 + np.maximum(abs(z) - 0.1, 0.0) ** 2 <= 0.04),
    "ellipsoid": ("<radii>0.1 0.2 0.3</radii>",
                  lambda x, y, z: (x / 0.1) ** 2 + (y / 0.2) ** 2 + (z / 0.3) ** 2 <= 1.0),
}  # fmt: skip


def auto(shape: str, inside: str = "", density: str = "", pose: str = "", more: str = "") -> str:
    """A link without numbers, whose collision is of this shape."""
    return (
        f'<link name="arm"><collision name="c"><pose>{pose}</pose>{density}<geometry>'
        f'<{shape}>{inside}</{shape}></geometry></collision>{more}<inertial auto="true"/></link>'
    )


def of_arm(text: str) -> pin.Inertia:
    return tree(sdf(text, joint("hinge", "revolute", "world", "arm"))).inertias[1]


@pytest.mark.parametrize("shape", SHAPES)
def test_inertia_of_a_collision_is_that_of_its_solid(shape: str) -> None:
    """Against the sum over cubes of 5 mm."""
    inside, contains = SHAPES[shape]
    n, half = 120, 0.3
    axis = (np.arange(n) + 0.5) / n * 2.0 * half - half
    x, y, z = (part[None] for part in np.meshgrid(axis, axis, axis, indexing="ij"))
    points = np.array([part.ravel() for part in (x, y, z)])
    points = points[:, contains(*points)]
    mass = 500.0 * points.shape[1] * (2.0 * half / n) ** 3
    second = mass * points @ points.T / points.shape[1]
    found = of_arm(auto(shape, inside, "<density>500</density>"))
    assert found.mass == pytest.approx(mass, rel=0.005)
    expected = np.trace(second) * np.eye(3) - second
    np.testing.assert_allclose(found.inertia, expected, rtol=0.01, atol=1e-3 * expected.max())


def test_collisions_add_up_and_a_mass_is_that_of_all() -> None:
    """Two boxes side by side are one of twice the length; the density of <inertial> counts last."""
    half = "<size>0.5 0.2 0.1</size>"
    right = (
        '<collision name="right"><pose>0.25 0 1 0 0 0</pose><geometry><box>'
        f"{half}</box></geometry></collision>"
    )
    two = auto("box", half, "<density>300</density>", "-0.25 0 1 0 0 0", right).replace(
        "/></link>", "><density>300</density><pose>9 9 9 0 0 0</pose></inertial></link>"
    )
    one = auto("box", "<size>1 0.2 0.1</size>", "<density>300</density>", "0 0 1 0 0 0")
    both, single = of_arm(two), of_arm(one)
    assert both.isApprox(single, 1e-12)
    assert single.mass == pytest.approx(6.0)
    heavy = of_arm(one.replace("/></link>", "><mass>12</mass></inertial></link>"))
    assert heavy.isApprox(pin.Inertia(12.0, single.lever, 2.0 * single.inertia), 1e-12)


def test_inertia_of_a_mesh_is_that_of_the_solid_it_encloses(tmp_path: Path) -> None:
    """A box of 1 m x 2 m x 3 m as a mesh of 1 m, scaled; turned inside out it is refused."""
    corners = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    for name, order in (("box.obj", 1), ("out.obj", -1)):
        lines = [f"v {x} {y} {z}" for x, y, z in corners]
        lines += [f"f {' '.join(face.split()[::order])}" for face in faces]
        (tmp_path / name).write_text("\n".join(lines))

    def text(name: str) -> str:
        arm = auto("mesh", f"<uri>{name}</uri><scale>1 2 3</scale>", pose="-0.5 -1 -1.5 0 0 0")
        return sdf(arm, joint("hinge", "revolute", "world", "arm"))

    found = loaded(tmp_path, text("box.obj")).model.inertias[1]
    own = 6000.0 / 12.0 * np.diag([13.0, 10.0, 5.0])
    np.testing.assert_allclose(found.inertia, own, atol=1e-9)
    assert found.mass == pytest.approx(6000.0)
    np.testing.assert_allclose(found.lever, 0.0, atol=1e-12)
    with pytest.raises(srm.InputError, match="inside out"):
        loaded(tmp_path, text("out.obj"))


# Names and merged models ------------------------------------------------------------------------


def test_a_visual_and_an_inertial_may_be_placed_relative_to_any_frame() -> None:
    shape = "<geometry><box><size>1 1 1</size></box></geometry>"
    arm = link("arm", ONE).replace(
        "</link>", f"<visual name='v'><pose relative_to='hand'>{TWO}</pose>{shape}</visual></link>"
    )
    arm = arm.replace("<inertial><pose>", "<inertial><pose relative_to='hand'>")
    text = sdf(
        arm,
        f"<frame name='hand' attached_to='arm'><pose>{THREE}</pose></frame>",
        joint("hinge", "revolute", "world", "arm"),
    )
    made = translated(text)
    origin = made.tree.find("link[@name='arm']/visual/origin")
    assert origin is not None
    xyz, turn = (list(map(float, origin.get(key, "").split())) for key in ("xyz", "rpy"))
    same(at(*xyz, *turn), of(THREE) * of(TWO))
    np.testing.assert_allclose(tree(text).inertias[1].lever, of(THREE).translation, atol=1e-14)


def test_names_may_hold_the_separator() -> None:
    """As flattened nested models of older files have it."""
    text = sdf(
        link("base"),
        link("left::arm", ONE),
        link("left::hand", TWO),
        '<frame name="left::__model__"/>',
        joint("left::hinge", "revolute", "base", "left::arm"),
        joint("left::wrist", "revolute", "left::arm", "left::hand"),
        version="1.7",
    )
    model = tree(text)
    assert list(model.names)[2:] == ["left::hinge", "left::wrist"]
    same(placed(model, "left::hand"), of(TWO))


def test_a_merged_model_is_part_of_the_model_around_it(tmp_path: Path) -> None:
    """Its own frame stays that of its elements; they have no prefix."""
    (tmp_path / "arm.sdf").write_text(
        sdf(
            link("upper", ONE),
            link("lower", TWO),
            "<frame name='tip' attached_to='lower'/>",
            f"<frame name='own'><pose relative_to='__model__'>{THREE}</pose></frame>",
            joint("elbow", "revolute", "upper", "lower").replace(
                "<xyz>", "<xyz expressed_in='__model__'>"
            ),
            f'<model name="deep"><pose>{ONE}</pose>{link("box")}</model>',
            joint("weld", "fixed", "lower", "deep::box", axis=""),
            name="arm",
        )
    )
    include = f"<include merge='true'><uri>arm.sdf</uri><pose>{THREE}</pose></include>"
    text = sdf(
        link("base"),
        include,
        link("hand", "").replace("<inertial>", "<pose relative_to='own'/><inertial>"),
        joint("shoulder", "revolute", "base", "upper"),
        joint("wrist", "revolute", "tip", "hand"),
    )
    mechanism = loaded(tmp_path, text)
    assert mechanism.joint_names[1:] == ("shoulder", "elbow", "wrist")
    for name, expected in {
        "base": pin.SE3.Identity(),
        "upper": of(THREE) * of(ONE),
        "lower": of(THREE) * of(TWO),
        "deep::box": of(THREE) * of(ONE),
        "hand": of(THREE) * of(THREE),
    }.items():
        same(placed(mechanism.model, name, mechanism.q0), expected)
    urdf = ElementTree.fromstring(mechanism.source.urdf)  # type: ignore[union-attr]
    axis = urdf.find("joint[@name='elbow']/axis").get("xyz", "")  # type: ignore[union-attr]
    expected = of(TWO).rotation.T @ [0.0, 1.0, 0.0]
    np.testing.assert_allclose(list(map(float, axis.split())), expected, atol=1e-12)
    twice = text.replace(include, include * 2)
    with pytest.raises(srm.InputError, match=r"'upper'"):
        loaded(tmp_path, twice)


def test_a_pose_may_be_that_of_a_frame_of_the_model(tmp_path: Path) -> None:
    """``placement_frame`` of a model and of an include, and an include posed by another frame."""
    inside = (
        link("base", ONE),
        link("tool", TWO),
        joint("hinge", "revolute", "base", "tool"),
        f"<frame name='grip' attached_to='tool'><pose>{THREE}</pose></frame>",
    )
    (tmp_path / "arm.sdf").write_text(sdf(*inside, name="arm"))
    named = "<placement_frame>grip</placement_frame>"
    here = f"<pose relative_to='stand'>{ONE}</pose>"
    text = sdf(
        link("stand", THREE),
        f"<include><uri>arm.sdf</uri><name>a</name>{here}</include>",
        f"<include><uri>arm.sdf</uri><name>b</name>{here}{named}</include>",
        f"<model name='c' placement_frame='grip'>{here}{''.join(inside)}</model>",
        *(joint(f"weld_{k}", "fixed", "stand", f"{k}::base", axis="") for k in "abc"),
    )
    mechanism = loaded(tmp_path, text)
    for name in "abc":
        found = placed(mechanism.model, f"{name}::tool", mechanism.q0) * of(THREE)
        model = pin.SE3.Identity() if name != "a" else of(TWO) * of(THREE)
        same(found, of(THREE) * of(ONE) * model)


def test_a_world_merges_models(tmp_path: Path) -> None:
    (tmp_path / "arm.sdf").write_text(
        sdf(link("upper", ONE), joint("hinge", "revolute", "world", "upper"), name="arm")
    )
    text = (
        '<sdf version="1.10"><world name="w"><include merge="1"><uri>arm.sdf</uri>'
        f"<pose>{THREE}</pose></include></world></sdf>"
    )
    same(placed(loaded(tmp_path, text).model, "upper"), of(THREE) * of(ONE))


# Graphs -------------------------------------------------------------------------------------


SQUARE = [
    Joint("a", "revolute", "world", "crank"),
    Joint("c", "revolute", "rocker", "coupler"),
    Joint("b", "revolute", "crank", "coupler"),
    Joint("d", "revolute", "rocker", "world"),
]


def test_a_loop_of_equal_joints_is_cut_far_from_the_root() -> None:
    found = spanning_tree(SQUARE, "world")
    assert [joint.name for joint in found.cut] == ["b"]
    assert [joint.name for joint in found.joints] == ["a", "d", "c"]
    assert found.reversed == ("d",)


def test_the_joint_with_the_most_freedom_is_cut() -> None:
    near = [Joint("a", "spherical", "world", "crank"), *SQUARE[1:]]
    assert [joint.name for joint in spanning_tree(near, "world").cut] == ["a"]


def test_a_joint_between_bodies_that_are_held_together_is_left_out() -> None:
    text = sdf(
        link("base"),
        link("arm", ONE),
        link("plate", TWO),
        link("badge", THREE),
        joint("hinge", "revolute", "base", "arm"),
        joint("one", "fixed", "arm", "plate", axis=""),
        joint("two", "fixed", "plate", "badge", axis=""),
        joint("three", "fixed", "badge", "arm", axis=""),
        joint("four", "revolute", "badge", "arm", "|<dynamics><damping>1</damping></dynamics>"),
    )
    made = translated(text)
    assert not {"loop", "force"} & made.entries.keys()
    (note,) = (note for note in made.notes if "left out" in note)
    assert "'four'" in note
    assert sum(f"'{name}'" in note for name in ("one", "two", "three")) == 1


def test_a_joint_that_no_closure_can_replace_is_kept() -> None:
    rubbing = [Joint("b", "revolute", "crank", "coupler", friction=0.1), *SQUARE[:2], SQUARE[3]]
    assert [joint.name for joint in spanning_tree(rubbing, "world").cut] == ["c"]


def test_the_users_cut_counts() -> None:
    found = spanning_tree(SQUARE, "world", ["a"])
    assert [joint.name for joint in found.joints] == ["d", "c", "b"]
    assert found.joints[-1].parent == "coupler"


@pytest.mark.parametrize(
    ("cut", "problem"), [(["a", "b"], "separates"), (["e"], "there is no joint 'e'")]
)
def test_a_cut_that_leaves_no_tree_is_refused(cut: list[str], problem: str) -> None:
    with pytest.raises(srm.InputError, match=problem):
        spanning_tree(SQUARE, "world", cut)


def test_a_cut_that_leaves_a_loop_is_refused_with_the_proposal(tmp_path: Path) -> None:
    hinge = joint("e", "revolute", "crank", "beam")
    ball = joint("f", "ball", "beam", "rocker", "<pose>0 0 1 0 0 0</pose>", axis="")
    two = link("beam", "0 0 1 0 0 0") + hinge + ball
    with pytest.raises(srm.InputError, match=r"leaves a loop through joint 'f'.*\['c', 'f'\]"):
        loaded(tmp_path, four_bar(two), cut=["c"])


@pytest.mark.parametrize("cut", ["a", "b", "c", "d"])
def test_a_four_bar_is_the_same_wherever_it_is_cut(tmp_path: Path, cut: str) -> None:
    """With a spring and a damper in joint c, which become a bushing where it is cut."""
    acting = (
        "|<dynamics><damping>0.4</damping><spring_stiffness>3</spring_stiffness>"
        "<spring_reference>0.2</spring_reference></dynamics>"
    )
    mechanism = loaded(tmp_path, four_bar(closing=acting), cut=[cut])
    assert mechanism.degrees_of_freedom == 1
    np.testing.assert_allclose(mechanism.initial_errors[0], 0.0, atol=1e-14)
    run = srm.simulate(mechanism, 0.5, rtol=1e-10, atol=1e-12)
    # Of the parallelogram only the angle phi of crank and rocker is left; joint c turns by phi.
    # Its spring acts from the start: rest 0.2 against q = 0.
    model = mechanism.model
    place = placed(model, "crank", run.q[-1])
    phi = np.arctan2(place.rotation[0, 2], place.rotation[2, 2])
    from scipy.integrate import solve_ivp

    inertia = 2 * (0.01 + 0.25) + 1.0
    g = 9.81

    def rate(_: float, y: FloatArray) -> list[float]:
        moment = g * (0.5 + 1.0 + 0.5) * np.sin(y[0]) - 0.4 * y[1] - 3.0 * (y[0] - 0.2)
        return [y[1], moment / inertia]

    exact = solve_ivp(rate, (0.0, 0.5), [0.0, 0.0], rtol=1e-12, atol=1e-13).y[0, -1]
    assert abs(phi) > 0.01
    np.testing.assert_allclose(phi, exact, rtol=1e-7)


def test_friction_in_a_joint_that_must_be_cut_is_refused_by_name(tmp_path: Path) -> None:
    text = four_bar(closing="|<dynamics><friction>0.1</friction></dynamics>")
    assert [loop.name for loop in loaded(tmp_path, text).loops] == ["b"]
    with pytest.raises(srm.InputError, match="joint 'c': it closes a loop and has friction"):
        loaded(tmp_path, text, cut=["c"])


def test_the_root_floats_where_nothing_holds_it_and_starts_at_its_pose(tmp_path: Path) -> None:
    text = sdf(link("torso", ONE), link("arm", TWO), joint("hinge", "revolute", "torso", "arm"))
    mechanism = loaded(tmp_path, text)
    assert mechanism.model.names[1] == "root_joint"
    same(placed(mechanism.model, "torso", mechanism.q0), of(ONE))
    same(placed(mechanism.model, "arm", mechanism.q0), of(TWO))
    held = loaded(tmp_path, text, base="fixed")
    assert held.model.nv == 1
    same(placed(held.model, "arm", held.q0), of(TWO))


def test_bodies_that_nothing_holds_beside_others_move_freely(tmp_path: Path) -> None:
    mechanism = loaded(
        tmp_path, sdf(link("arm"), link("ball", ONE), joint("hinge", "revolute", "world", "arm"))
    )
    assert mechanism.joint_names == ("ball::free", "hinge")
    assert any("moves freely" in note for note in mechanism.notes)
    same(placed(mechanism.model, "ball", mechanism.q0), of(ONE))


def test_a_world_has_gravity_models_and_joints_between_them(tmp_path: Path) -> None:
    text = (
        '<sdf version="1.10"><world name="yard"><gravity>0 0 -1.62</gravity><light name="sun"/>'
        f'<model name="one"><pose>{ONE}</pose>{link("arm", TWO)}'
        f"{joint('hinge', 'revolute', 'world', 'arm')}</model>"
        f'<model name="two"><static>1</static>{link("wall", THREE)}</model></world></sdf>'
    )
    mechanism = loaded(tmp_path, text)
    np.testing.assert_array_equal(mechanism.model.gravity.linear, [0.0, 0.0, -1.62])
    same(placed(mechanism.model, "one::arm", mechanism.q0), of(ONE) * of(TWO))
    same(placed(mechanism.model, "two::wall"), of(THREE))
    assert any("light" in note for note in mechanism.notes)


def test_an_included_model_is_found_beside_the_file(tmp_path: Path) -> None:
    folder = tmp_path / "gripper"
    folder.mkdir()
    (folder / "model.config").write_text("<model><sdf version='1.9'>own.sdf</sdf></model>")
    (folder / "own.sdf").write_text(sdf(f"<pose>{TWO}</pose>", link("finger", ONE)))
    text = sdf(
        link("base"),
        joint("weld", "revolute", "base", "left::finger"),
        "<include><uri>model://gripper</uri><name>left</name><pose>" + THREE + "</pose></include>",
    )
    mechanism = loaded(tmp_path, text)
    same(placed(mechanism.model, "left::finger", mechanism.q0), of(THREE) * of(ONE))


def test_the_largest_numbers_as_limits_mean_no_limit(tmp_path: Path) -> None:
    """Exporters write the largest double, rounded up or down, or 1e16."""

    def limited(name: str, low: str, high: str) -> str:
        more = f"<velocity>{high}</velocity><effort>{high}</effort>"
        limit = f"<limit><lower>{low}</lower><upper>{high}</upper>{more}</limit>"
        return link(f"{name}_link") + joint(name, "revolute", "world", f"{name}_link", "|" + limit)

    text = sdf(
        limited("a", "-1.79769e+308", "1.79769e308"),
        limited("b", "-1.797693135e308", "1.797693135e308"),
        limited("c", "-1e16", "10000000000000000.000000"),
        limited("d", "-inf", "inf"),
        limited("e", "-1e16", "0.5"),
    )
    path = tmp_path / "robot.toml"
    loaded(tmp_path, text)
    path.write_text('format = 1\nsdf = "robot.sdf"\nlimits = "spring"\n')
    springs = srm.load(path).forces
    assert [spring.name for spring in springs] == ["limit_e"]
    assert isinstance(springs[0], srm.LimitSpring)
    low, high, _ = springs[0].resolved(srm.load(path).model)
    assert (low, high) == (-np.inf, 0.5)


def test_a_gearbox_is_a_coupling_of_two_hinges() -> None:
    gear = (
        "<gearbox_ratio>3</gearbox_ratio><gearbox_reference_body>base</gearbox_reference_body>"
        "<axis2><xyz>0 -1 0</xyz></axis2>"
    )
    text = sdf(
        link("base"),
        link("motor"),
        link("wheel", "0 0 1 0 0 0"),
        joint("m", "revolute", "base", "motor"),
        joint("w", "revolute", "wheel", "base", axis="0 1 0"),
        joint("gear", "gearbox", "motor", "wheel", gear),
    )
    # theta_1 = q_m; theta_2 is the angle of the wheel about -y, where w turns the base about +y
    # against the wheel: theta_2 = q_w = -3 theta_1.
    loops = translated(text).entries["loop"]
    assert loops == [{"name": "gear", "type": "coupling", "joints": ["w", "m"], "ratio": -3.0}]


# Cassie -------------------------------------------------------------------------------------


def anchored(entry: dict[str, Any]) -> pin.SE3:
    """Placement of an anchor in its link."""
    zero = [0.0, 0.0, 0.0]
    return at(*entry.get("xyz", zero), *entry.get("rpy", zero))


@pytest.mark.filterwarnings("ignore:.*triangle inequality:srm_mbs.errors.SrmWarning")
@pytest.mark.parametrize("name", CASSIES)
def test_every_cassie_file_is_posed_and_weighs_what_it_says(name: str) -> None:
    """The files place all links in the model's frame."""
    path = cassie(name)
    made = translated(path.read_text(), file=str(path))
    model = build_urdf(made.tree, str(path), made.entries.get("base", "fixed")).model
    root = ElementTree.parse(path).getroot()
    mass = 0.0
    for node in root.iter("link"):
        same(placed(model, node.get("name", "")), of(node.findtext("pose", "")))
        mass += float(node.findtext("inertial/mass", ""))
    np.testing.assert_allclose(pin.computeTotalMass(model), mass, rtol=1e-14)
    joints = [node for node in root.iter("joint") if node.get("type") != "gearbox"]
    links = len(root.findall("model/link"))
    cut = [loop for loop in made.entries["loop"] if loop["type"] != "coupling"]
    hangs = any(node.findtext("parent") == "world" for node in joints)
    assert len(joints) - len(cut) == (links if hangs else links - 1)
    # Each closure holds where the file poses the links.
    for entry in cut:
        if entry["type"] == "point":
            a, b = (
                placed(model, anchor["link"]) * anchored(anchor)
                for anchor in (entry["a"], entry["b"])
            )
            same(a, b)


def test_a_link_called_world_without_inertia_is_the_ground(tmp_path: Path) -> None:
    path = tmp_path / "robot.sdf"
    path.write_text(four_bar())
    plain = srm.load(path)
    path.write_text(four_bar('<link name="world"><pose>0 0 3 0 0 0</pose></link>'))
    grounded = srm.load(path)
    assert grounded.model == plain.model
    assert "a link called 'world' without <inertial> is the ground: the file" in grounded.notes
