"""Couplings: linear relations of joint coordinates, against exact solutions."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs.analysis.summary import loop_rows
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from srm_mbs.dynamics.multibody import ClosedSystem
from srm_mbs.dynamics.scaling import row_angles, row_dimensions, row_units
from srm_mbs.integration.kernel import backend as kernel
from srm_mbs.integration.kernel.marshalling import system_struct
from srm_mbs.visualization.animation.shapes import visuals_of
from tests.support.backends import needs_kernel, on_both
from tests.support.dynamics import evaluate_rows
from tests.support.mechanisms import random_state
from tests.support.snapshots import check_messages, refused

assert_close = partial(np.testing.assert_allclose, rtol=0.0)

WHEEL = (
    '<link name="{name}"><inertial><origin xyz="{com}"/><mass value="{mass}"/>'
    '<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="{name}_joint" type="{kind}"><parent link="{parent}"/><child link="{name}"/>'
    '<origin xyz="{at}"/><axis xyz="{axis}"/>{limit}</joint>'
)
LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


def wheel(name: str, inertia: float, kind: str = "continuous", **others: Any) -> str:
    values: dict[str, Any] = {
        "parent": "base",
        "axis": "0 0 1",
        "at": "0 0 0",
        "com": "0 0 0",
        "mass": 1.0,
        "limit": "" if kind == "continuous" else LIMIT,
    }
    return WHEEL.format(name=name, i=inertia, kind=kind, **values | others)


def load(folder: Path, wheels: str, text: str) -> srm.Mechanism:
    """A mechanism from <link> and <joint> elements on a base, and the rest of a description."""
    urdf = f'<robot name="wheels"><link name="base"/>{wheels}</robot>'
    (folder / "wheels.urdf").write_text(urdf)
    (folder / "wheels.toml").write_text(f'format = 1\nurdf = "wheels.urdf"\n{text}')
    return srm.load(folder / "wheels.toml")


GEARS = wheel("a", 0.5) + wheel("b", 0.2, at="1 0 0")
GEAR = '[[loop]]\nname = "gear"\ntype = "coupling"\njoints = ["a_joint", "b_joint"]\n'
MOTOR = '[[force]]\ntype = "torque"\njoint = "a_joint"\ntorque = 2.0\n'


@on_both
def test_a_gear_pair_turns_as_one_wheel_with_the_effective_inertia(
    backend: str, tmp_path: Path
) -> None:
    """q_a = -3 q_b + 0.4 under a torque on a: a'' = T/(I_a + I_b/9), exactly quadratic in time."""
    mechanism = load(tmp_path, GEARS, f"{GEAR}ratio = -3.0\noffset = 0.4\n{MOTOR}")
    assert mechanism.degrees_of_freedom == 1
    assert mechanism.redundant_rows == ()
    run = srm.simulate(mechanism, 8.0, rtol=1e-9, backend=backend, t_eval=np.linspace(0, 8, 17))
    a, a_rate = run.joint("a_joint")
    b, _ = run.joint("b_joint")
    acceleration = 2.0 / (0.5 + 0.2 / 9.0)
    assert a[-1] - a[0] > 6 * 2 * np.pi  # its turns are counted
    assert_close(a - a[0], 0.5 * acceleration * run.t**2, atol=1e-9)
    assert_close(a_rate, acceleration * run.t, atol=1e-9)
    assert_close(a, -3.0 * b + 0.4, atol=1e-12)
    # The tooth force: what a feels is T - I_a a'', of which b gets -3 times the opposite.
    (lam,) = run.reaction_multipliers["gear"][0]
    assert -lam == pytest.approx(0.5 * acceleration - 2.0, rel=1e-9)
    assert "gear" not in run.reactions
    forces = run.coupling_forces["gear"]
    assert forces.shape == (17, 2)
    assert_close(forces[:, 0], 0.5 * acceleration - 2.0, atol=1e-9)
    assert_close(forces[:, 1], 0.2 * (acceleration / -3.0), atol=1e-9)
    assert run.indeterminate_reactions == ()


@on_both
def test_a_differential_relates_three_joints(backend: str, tmp_path: Path) -> None:
    """2 q_carrier = q_left + q_right + s: the multiplier follows from three scalar equations."""
    wheels = wheel("carrier", 0.7) + wheel("left", 0.2) + wheel("right", 0.3)
    text = (
        '[[loop]]\nname = "differential"\ntype = "coupling"\n'
        'joints = ["carrier_joint", "left_joint", "right_joint"]\n'
        "coefficients = [2.0, -1.0, -1.0]\noffset = 0.3\n"
        '[[force]]\ntype = "torque"\njoint = "carrier_joint"\ntorque = 1.5\n'
        '[[force]]\ntype = "torque"\njoint = "left_joint"\ntorque = -0.2\n'
        "[initial]\nv = { left_joint = 1.0, right_joint = -2.0 }\n"
    )
    mechanism = load(tmp_path, wheels, text)
    assert mechanism.degrees_of_freedom == 2
    run = srm.simulate(mechanism, 4.0, rtol=1e-9, backend=backend)
    c, torque, inertia = np.array([2.0, -1.0, -1.0]), np.array([1.5, -0.2, 0.0]), [0.7, 0.2, 0.3]
    lam = (c @ (torque / inertia)) / (c @ (c / inertia))
    acceleration = (torque - c * lam) / inertia
    t = run.t[:, None]
    assert_close(run.v, run.v[0] + acceleration * t, atol=1e-9)
    assert_close(run.q, run.q[0] + run.v[0] * t + 0.5 * acceleration * t**2, atol=1e-9)
    assert_close(run.v[0], [-0.5, 1.0, -2.0], atol=1e-12)
    assert_close(run.reaction_multipliers["differential"][:, 0], lam, atol=1e-9)
    assert_close(run.coupling_forces["differential"], run.t[:, None] * 0.0 - c * lam, atol=1e-9)
    assert_close(run.q @ c, 0.3, atol=1e-12)
    assert run.drift.max() < 1e-11


@on_both
def test_a_rack_falls_and_turns_its_pinion(backend: str, tmp_path: Path) -> None:
    """x = r phi: x'' = -g m/(m + I/r^2), and the rows are in m."""
    radius, mass, inertia = 0.05, 1.3, 0.02
    wheels = wheel("rack", 0.01, "prismatic", mass=mass) + wheel("pinion", inertia, axis="1 0 0")
    gear = f'[[loop]]\ntype = "coupling"\njoints = ["rack_joint", "pinion_joint"]\nratio = {radius}'
    mechanism = load(tmp_path, wheels, gear)
    (loop,) = mechanism.loops
    assert loop.name == "coupling_rack_joint_pinion_joint"
    assert row_dimensions(mechanism) == ("m",)
    run = srm.simulate(mechanism, 2.0, rtol=1e-9, backend=backend)
    expected = -9.81 * mass / (mass + inertia / radius**2)
    assert_close(run.joint("rack_joint")[0], 0.5 * expected * run.t**2, atol=1e-9)
    assert_close(run.joint("pinion_joint")[0], 0.5 * expected / radius * run.t**2, atol=2e-8)
    assert np.abs(run.energy - run.energy[0]).max() < 1e-9
    swapped = replace(loop, joints=loop.joints[::-1], ratio=1.0 / radius)
    other = srm.Mechanism(mechanism.model, (swapped,), mechanism.q0, mechanism.v0)
    assert row_dimensions(other) == ("rad",)
    again = srm.simulate(other, 2.0, rtol=1e-9, backend=backend)
    assert_close(again(run.t)[0], run.q, atol=1e-8)


def lead_screw(pitch: float) -> srm.Mechanism:
    model = pin.Model()
    for joint in (pin.JointModelRZ(), pin.JointModelPZ()):
        k = model.addJoint(0, joint, pin.SE3.Identity(), f"j{model.njoints}")
        model.appendBodyToJoint(k, pin.Inertia.FromSphere(1.0, 0.3), pin.SE3.Identity())
    loop = srm.LoopClosure("coupling", joints=("j1", "j2"), ratio=2.0 * np.pi / pitch, name="nut")
    mechanism = srm.Mechanism(model, (loop,))
    state = srm.assemble(mechanism, q={"j2": 0.7})
    return mechanism.with_state(state.q, state.v)


@pytest.mark.parametrize("pitch", [1e-1, 1e-3, 1e-5])
def test_a_row_is_as_large_as_its_largest_term(pitch: float) -> None:
    """A fine thread closes to the rounding of its large ratio, which is more than 1e-12 rad."""
    mechanism = lead_screw(pitch)
    units = mechanism.structure.units
    (unit,) = row_units(mechanism, units)
    assert unit == pytest.approx(max(1.0, 2.0 * np.pi / pitch * units.length))
    assert row_angles(mechanism).tolist() == [True]
    q = mechanism.q0
    assert abs(q[0] - 2.0 * np.pi / pitch * q[1]) <= 1e-12 * unit


def joints_of_many_kinds(seed: int) -> tuple[pin.Model, tuple[str, ...]]:
    """A chain with ball and free joints between the hinges and sliders, whose names come too."""
    model = pin.Model()
    rng = np.random.default_rng(seed)
    joints = [
        pin.JointModelRZ(),
        pin.JointModelFreeFlyer(),
        pin.JointModelPX(),
        pin.JointModelSpherical(),
        pin.JointModelRUBY(),
        pin.JointModelRevoluteUnaligned(np.array([0.6, 0.0, 0.8])),
    ]
    rng.shuffle(joints)  # type: ignore[arg-type]
    parent = 0
    names = []
    for k, joint in enumerate(joints):
        parent = model.addJoint(parent, joint, pin.SE3.Random(), f"joint_{k}")
        model.appendBodyToJoint(parent, pin.Inertia.FromSphere(1.0, 0.3), pin.SE3.Identity())
        if joint.nq == joint.nv == 1:
            names.append(f"joint_{k}")
    return model, tuple(names)


@pytest.mark.parametrize("seed", range(3))
def test_rows_have_constant_entries_at_the_coordinates_of_their_joints(seed: int) -> None:
    model, names = joints_of_many_kinds(seed)
    rng = np.random.default_rng([seed, 1])
    c = rng.uniform(0.5, 2.0, 3)
    loops = (
        srm.LoopClosure("coupling", joints=names, coefficients=c, offset=0.7, name="three"),
        srm.LoopClosure("coupling", joints=names[1::-1], ratio=-1.7, offset=-0.2, name="two"),
    )
    scale = np.array([0.3, 2.5])
    for keep in ([True, True], [False, True], [True, False], [False, False]):
        rows = LoopKinematics(model, loops, scale, np.array(keep))
        q, v = random_state(model, rng)
        g, G, bias = evaluate_rows(model, rows, q, v)
        angle = {name: q[model.joints[model.getJointId(name)].idx_q] for name in names}
        expected = [
            c @ list(angle.values()) - 0.7,
            angle[names[1]] + 1.7 * angle[names[0]] + 0.2,
        ]
        assert_close(g, (np.array(expected) / scale)[keep], atol=1e-14)
        assert not bias.any()
        step = 1e-3
        for column, e in enumerate(np.eye(model.nv)):
            forward, back = (
                evaluate_rows(model, rows, pin.integrate(model, q, h * e), v)[0]
                for h in (step, -step)
            )
            assert_close(G[:, column], (forward - back) / (2.0 * step), atol=1e-12)


def test_a_continuous_joint_counts_its_turns_only_where_it_is_coupled(tmp_path: Path) -> None:
    plain = wheel("c", 0.1)
    limited = wheel("b", 0.2).replace("<axis", '<limit effort="4" velocity="5"/><axis')
    text = f"{GEAR}ratio = 2.0\n[initial]\nq = {{ b_joint = 31.0, c_joint = 31.0 }}\n"
    with pytest.warns(srm.SrmWarning, match="more than two turns: angles are in rad"):
        mechanism = load(tmp_path, wheel("a", 0.5) + limited + plain, text)
    kinds = [mechanism.joint(name) for name in ("a_joint", "b_joint", "c_joint")]
    assert [joint.nq for joint in kinds] == [1, 1, 2]
    assert mechanism.q0[kinds[0].idx_q] == pytest.approx(62.0, abs=1e-12)  # not unwound
    model = mechanism.model
    for joint, effort, velocity in zip(kinds[:2], (np.inf, 4.0), (np.inf, 5.0)):
        assert model.lowerPositionLimit[joint.idx_q] == -np.inf
        assert model.upperPositionLimit[joint.idx_q] == np.inf
        assert model.effortLimit[joint.idx_v] == effort
        assert model.velocityLimit[joint.idx_v] == velocity


BOTH = 'joints = ["a_joint", "b_joint"]\n'
WRONG = {
    "no joints": "ratio = 1.0",
    "one joint for a ratio": 'joints = ["a_joint"]\nratio = 1.0',
    "neither": BOTH,
    "both": f"{BOTH}ratio = 1.0\ncoefficients = [1.0, 2.0]",
    "too few": f"{BOTH}coefficients = [1.0]",
    "a zero": f"{BOTH}ratio = 0.0",
    "twice": 'joints = ["a_joint", "a_joint"]\nratio = 1.0',
    "none": "joints = []\ncoefficients = []",
    "unknown": 'joints = ["a_joint", "c"]\nratio = 1.0',
    "locked": f"{BOTH}ratio = 1.0",
    "anchors": f'{BOTH}ratio = 1.0\na = {{ link = "a" }}',
    "not finite": f"{BOTH}ratio = nan",
    "constant polynomial": f"{BOTH}polynomial = [0.3]",
    "polynomial and ratio": f"{BOTH}polynomial = [0.3, 1.0, 2.0]\nratio = 2.0",
    "polynomial and offset": f"{BOTH}polynomial = [0.3, 1.0, 2.0]\noffset = 2.0",
    "polynomial of one joint": 'joints = ["a_joint"]\npolynomial = [0.3, 1.0, 2.0]',
    "polynomial of no numbers": f"{BOTH}polynomial = [0.3, inf]",
    "arguments alone": f"{BOTH}arguments = [0.3, 1.0]",
    "arguments without coefficients": f"{BOTH}polynomial = [0.0, 1.0, 1.0]\narguments = [0.0, 1.0]",
    "a joint on neither side": (
        f"{BOTH}polynomial = [0.0, 1.0, 1.0]\ncoefficients = [1.0, 0.0]\narguments = [1.0, 0.0]"
    ),
    "held positions that contradict it": (
        f"{BOTH}ratio = 2.0\n[initial]\nq = {{ a_joint = 1.0, b_joint = 1.0 }}"
    ),
    "held rates that contradict it": (
        f"{BOTH}ratio = 2.0\n[initial]\nv = {{ a_joint = 1.0, b_joint = 1.0 }}"
    ),
}


def test_a_wrong_coupling_is_refused_by_name(tmp_path: Path) -> None:
    messages = {}
    for case, keys in WRONG.items():
        lock = 'lock = ["b_joint"]\n' if case == "locked" else ""
        text = f'{lock}[[loop]]\nname = "gear"\ntype = "coupling"\n{keys}\n'
        messages[case] = refused(partial(load, tmp_path, GEARS, text), tmp_path)
    model, names = joints_of_many_kinds(0)
    kinds = {joint.shortname(): name for joint, name in zip(model.joints, model.names)}
    others = {
        "a joint without turns": kinds["JointModelRUBY"],
        "a ball": kinds["JointModelSpherical"],
        "no joint": "nobody",
    }
    for case, name in others.items():
        loop = srm.LoopClosure("coupling", joints=(names[0], name), ratio=1.0, name="gear")
        messages[f"in a model: {case}"] = refused(partial(srm.Mechanism, model, [loop]))
    check_messages("couplings", messages)


def test_a_saved_run_with_couplings_is_the_same(tmp_path: Path) -> None:
    mechanism = load(tmp_path, GEARS, f"{GEAR}ratio = -3.0\n{MOTOR}")
    run = srm.simulate(mechanism, 1.0)
    run.save(tmp_path / "run.npz")
    again = srm.load_solution(tmp_path / "run.npz")
    assert again.mechanism.loops == mechanism.loops
    t = np.linspace(0.0, 1.0, 7)
    np.testing.assert_array_equal(np.hstack(again(t)), np.hstack(run(t)))
    run.to_csv(tmp_path / "run.csv")
    assert "||g|| (rad),||G v|| (rad/s)" in (tmp_path / "run.csv").read_text()


def test_two_gears_that_say_the_same_share_their_force(tmp_path: Path) -> None:
    """Known as indeterminate, with the sum that the wheels need."""
    exchanged = GEAR.replace("gear", "twin").replace('"a_joint", "b_joint"', '"b_joint", "a_joint"')
    text = f"{GEAR}ratio = 2.0\n{exchanged}ratio = 0.5\n{MOTOR}"
    mechanism = load(tmp_path, GEARS, text)
    assert mechanism.mobility.pivoted_redundancy == 1
    run = srm.simulate(mechanism, 0.5, rtol=1e-9)
    assert run.indeterminate_reactions == ("gear.coupling", "twin.coupling")
    acceleration = 2.0 / (0.5 + 0.2 / 4.0)
    gear, twin = (run.coupling_forces[name] for name in ("gear", "twin"))
    twin = twin[:, ::-1]
    assert_close((gear + twin)[:, 1], 0.1 * acceleration, atol=1e-9)
    assert_close(gear, twin, atol=1e-12)


def test_a_mechanism_with_couplings_is_drawn_and_described(tmp_path: Path) -> None:
    mechanism = load(tmp_path, GEARS, f"{GEAR}ratio = -3.0\noffset = 0.4\n")
    (row,) = loop_rows(mechanism)
    assert row[:4] == ("gear", "coupling", "a_joint, b_joint", "a_joint = -3 b_joint +0.4")
    assert row[4].endswith(" rad")
    assert len(visuals_of(mechanism)) > 0
    general = '[[loop]]\ntype = "coupling"\njoints = ["a_joint", "b_joint"]\n'
    text = f"{general}coefficients = [1.0, 2.5]\noffset = 0.25\n"
    (row,) = loop_rows(load(tmp_path, GEARS, text))
    assert row[3] == "+1 a_joint +2.5 b_joint = 0.25"


@needs_kernel
@pytest.mark.parametrize("algebra", ["dense", "sparse"])
def test_the_kernel_evaluates_couplings_like_the_reference(algebra: str) -> None:
    """Beside a closure between anchors, whose rows come before and after."""
    model, names = joints_of_many_kinds(1)
    for k in range(1, model.njoints):
        model.addBodyFrame(f"link_{k}", k, pin.SE3.Random(), 0)
    first, last = srm.Anchor("link_1"), srm.Anchor("link_6", xyz=(0.1, 0.2, -0.3))
    world = srm.Anchor("world", xyz=(0.2, 0.0, 0.1))
    loops = (
        srm.LoopClosure("point_on_plane", last, world, (0.0, 0.6, 0.8), name="plane"),
        srm.LoopClosure("coupling", joints=names, coefficients=(1.0, 0.4, -2.0), name="three"),
        srm.LoopClosure("distance", first, last, length=0.8, name="rod"),
        srm.LoopClosure("coupling", joints=names[:2], ratio=3.0, offset=0.1, name="two"),
        srm.LoopClosure(
            "coupling",
            joints=names,
            polynomial=(0.1, 0.4, -0.3, 0.2),
            coefficients=(1.0, 0.0, 0.5),
            arguments=(0.3, 1.0, 0.0),
            name="cam",
        ),
    )
    mechanism = srm.Mechanism(model, loops)
    system = ClosedSystem(mechanism)
    kernel_system = kernel.core.System(  # type: ignore[union-attr]
        model, system_struct(system.constants() | {"algebra": algebra}), None
    )
    rng = np.random.default_rng(3)
    for _ in range(5):
        x = np.concatenate(random_state(model, rng))
        terms = system.evaluate(0.0, x)
        found = kernel_system.terms(0.0, x, -1.0)
        for what in ("rate", "correction", "multiplier", "sigma", "constraint_residual"):
            theirs = getattr(terms, what)
            theirs = theirs if what == "sigma" else theirs()
            np.testing.assert_allclose(found[what], theirs, rtol=1e-9, atol=1e-10)


def test_a_rod_between_wheels_takes_its_length_from_the_guess_and_keeps_it(tmp_path: Path) -> None:
    """Held and guessed angles count; a saved run has the length, not a new guess."""
    text = (
        '[[loop]]\ntype = "distance"\nname = "rod"\n'
        'a = { link = "b", xyz = [0.2, 0.0, 0.0] }\nb = { link = "a", xyz = [0.3, 0.0, 0.0] }\n'
        "[initial]\nq = { a_joint = 0.5 }\nguess = { b_joint = -0.4 }\nv = { a_joint = 1.0 }\n"
    )
    mechanism = load(tmp_path, GEARS, text)
    tips = [1.0 + 0.2 * np.exp(-0.4j), 0.3 * np.exp(0.5j)]
    (rod,) = mechanism.loops
    assert rod.length == pytest.approx(abs(tips[0] - tips[1]), rel=1e-15)
    assert mechanism.q0[mechanism.joint("b_joint").idx_q] == pytest.approx(np.cos(0.4))
    run = srm.simulate(mechanism, 0.5)
    run.save(tmp_path / "run.npz")
    assert srm.load_solution(tmp_path / "run.npz").mechanism.loops == (rod,)
    with pytest.raises(srm.InputError, match=r"wheels\.toml: loop 'rod': a distance of 0 has no"):
        load(tmp_path, GEARS, text.replace('name = "rod"', 'name = "rod"\nlength = 0.0'))


CAM = (
    '[[loop]]\nname = "cam"\ntype = "coupling"\njoints = ["slider_joint", "cam_joint"]\n'
    "polynomial = [0.1, 0.05, 0.2, -0.03]\n"
    "[initial]\nq = { cam_joint = -0.7 }\nv = { cam_joint = 2.0 }\n"
)
CAM_WHEELS = wheel("slider", 0.1, "prismatic", mass=1.3) + wheel("cam", 0.3, axis="0 1 0")


def along_a_cam(phi: float, rate: float, times: np.ndarray) -> np.ndarray:
    """(phi, phi') at ``times`` of a wheel I that lifts a mass m by x = p(phi), reduced to phi:
    (I + m p'^2) phi'' = -m p' (p'' phi'^2 + g), integrated by SciPy."""
    p = np.polynomial.Polynomial([0.1, 0.05, 0.2, -0.03])
    slope, curvature = p.deriv(), p.deriv(2)
    mass, inertia = 1.3, 0.3

    def field(_: float, y: np.ndarray) -> list[float]:
        phi, rate = y
        force = -mass * slope(phi) * (curvature(phi) * rate**2 + 9.81)
        return [rate, force / (inertia + mass * slope(phi) ** 2)]

    span = (times[0], times[-1])
    return solve_ivp(field, span, [phi, rate], "DOP853", times, rtol=1e-12, atol=1e-12).y


@on_both
def test_a_cam_lifts_a_mass_as_the_reduced_equation_has_it(backend: str, tmp_path: Path) -> None:
    """The force on the slider is m (x'' + g), and on the cam -p' times that."""
    mechanism = load(tmp_path, CAM_WHEELS, CAM)
    assert mechanism.degrees_of_freedom == 1
    assert mechanism.redundant_rows == ()
    assert row_dimensions(mechanism) == ("m",)
    times = np.linspace(0.0, 2.0, 41)
    run = srm.simulate(mechanism, 2.0, rtol=1e-10, backend=backend, t_eval=times)
    expected, rates = along_a_cam(-0.7, 2.0, times)
    x, x_rate = run.joint("slider_joint")
    phi, phi_rate = run.joint("cam_joint")
    assert_close(phi, expected, atol=1e-8)
    assert_close(phi_rate, rates, atol=1e-7)
    p = np.polynomial.Polynomial([0.1, 0.05, 0.2, -0.03])
    assert_close(x, p(phi), atol=1e-12)
    assert_close(x_rate, p.deriv()(phi) * phi_rate, atol=1e-11)
    assert np.abs(run.energy - run.energy[0]).max() < 1e-8
    forces = run.coupling_forces["cam"]
    assert_close(forces[:, 1], -p.deriv()(phi) * forces[:, 0], atol=1e-9)
    # Power of gravity and of the coupling is the rate of the slider's kinetic energy.
    gained = 0.5 * 1.3 * x_rate**2
    work = np.gradient(gained, times, edge_order=2)[5:-5]
    assert_close(((forces[:, 0] - 1.3 * 9.81) * x_rate)[5:-5], work, atol=0.3)


POLYNOMIALS = {
    "two": {"polynomial": (0.3, -0.4, 0.0, 0.25, -0.1)},
    "three": {"polynomial": (0.1, 0.5, -0.3), "coefficients": (1.0, 0.6, 0.0),
              "arguments": (0.0, 0.2, -1.5)},
    "linear": {"polynomial": (0.2, 1.5)},
}  # fmt: skip


@pytest.mark.parametrize("name", POLYNOMIALS)
def test_rows_of_polynomials_are_the_derivatives_of_their_values(name: str) -> None:
    """G by central differences, Gdot v by those of G v along the motion q + h v."""
    model, names = joints_of_many_kinds(1)
    keys = POLYNOMIALS[name]
    joints = names[: len(keys.get("arguments", (0, 0)))]
    loop = srm.LoopClosure("coupling", joints=joints, name=name, **keys)
    rows = LoopKinematics(model, [loop], np.array([0.4]))
    rng = np.random.default_rng(5)
    left = np.array(keys.get("coefficients", (1.0, 0.0)))
    right = np.array(keys.get("arguments", (0.0, 1.0)))
    for _ in range(4):
        q, v = random_state(model, rng)
        g, G, bias = evaluate_rows(model, rows, q, v)
        x = np.array([q[model.joints[model.getJointId(joint)].idx_q] for joint in joints])
        value = left @ x - np.polynomial.Polynomial(keys["polynomial"])(right @ x)
        assert_close(g, [value / 0.4], atol=1e-13)
        step = 1e-4
        for column, e in enumerate(np.eye(model.nv)):
            near = [pin.integrate(model, q, h * e) for h in (step, -step)]
            (forward, *_), (back, *_) = (evaluate_rows(model, rows, at, v) for at in near)
            assert_close(G[:, column], (forward - back) / (2.0 * step), atol=1e-6)
        near = [pin.integrate(model, q, h * v) for h in (step, -step)]
        forward, back = (evaluate_rows(model, rows, at, v)[1] @ v for at in near)
        assert_close(bias, (forward - back) / (2.0 * step), atol=1e-5)
        assert rows.pattern()[:, np.flatnonzero(G[0])].all()
        (row,) = loop.rows.joint_rows
        own = [model.joints[model.getJointId(joint)].idx_v for joint in joints]
        assert_close(row.gradient(x[None])[0], 0.4 * G[0, own], atol=1e-13)
    assert rows.is_constant == (name == "linear")


@on_both
def test_the_same_cam_twice_is_redundant_and_a_locked_one_has_no_row(
    backend: str, tmp_path: Path
) -> None:
    """Two equal relations, one times 2, share their force; the motion is that of one."""
    general = (
        '[[loop]]\nname = "twin"\ntype = "coupling"\njoints = ["cam_joint", "slider_joint"]\n'
        "coefficients = [0.0, 2.0]\narguments = [1.0, 0.0]\npolynomial = [0.2, 0.1, 0.4, -0.06]\n"
    )
    mechanism = load(tmp_path, CAM_WHEELS, general + CAM)
    assert mechanism.degrees_of_freedom == 1
    assert mechanism.mobility.pivoted_redundancy == 1
    run = srm.simulate(mechanism, 1.0, rtol=1e-9, backend=backend)
    assert_close(run.joint("cam_joint")[0], along_a_cam(-0.7, 2.0, run.t)[0], atol=1e-7)
    assert run.indeterminate_reactions == ("twin.coupling", "cam.coupling")


def test_a_description_with_a_polynomial_is_converted_saved_and_shown(tmp_path: Path) -> None:
    mechanism = load(tmp_path, CAM_WHEELS, CAM)
    (row,) = loop_rows(mechanism)
    assert row[3] == "slider_joint = +0.1 +0.05 y +0.2 y^2 -0.03 y^3, y = cam_joint"
    srm.convert(tmp_path / "wheels.toml", tmp_path / "again.toml")
    assert srm.load(tmp_path / "again.toml").loops == mechanism.loops
    run = srm.simulate(mechanism, 0.5)
    run.save(tmp_path / "run.npz")
    again = srm.load_solution(tmp_path / "run.npz")
    assert again.mechanism.loops == mechanism.loops
    assert_close(again.coupling_forces["cam"], run.coupling_forces["cam"], atol=1e-12)


@on_both
def test_a_stiff_spring_on_a_cam_runs_as_the_reduced_equation_has_it(
    backend: str, tmp_path: Path
) -> None:
    """Implicit steps have no closed form of its derivatives, and need none."""
    damper = (
        '[[force]]\ntype = "torsion_spring"\njoint = "cam_joint"\ndamping = 3000.0\n'
        "stiffness = 10.0\n"
    )
    mechanism = load(tmp_path, CAM_WHEELS, damper + CAM)
    p = np.polynomial.Polynomial([0.1, 0.05, 0.2, -0.03])

    def field(_: float, y: np.ndarray) -> list[float]:
        slope = p.deriv()(y[0])
        force = -1.3 * slope * (p.deriv(2)(y[0]) * y[1] ** 2 + 9.81)
        return [y[1], (force - 3000.0 * y[1] - 10.0 * y[0]) / (0.3 + 1.3 * slope**2)]

    times = np.linspace(0.0, 1.0, 11)
    run = srm.simulate(mechanism, 1.0, rtol=1e-8, backend=backend, t_eval=times)
    expected = solve_ivp(field, (0.0, 1.0), [-0.7, 2.0], "Radau", times, rtol=1e-10, atol=1e-12)
    assert_close(run.joint("cam_joint")[0], expected.y[0], atol=1e-6)


def test_a_cam_is_linearised_with_the_curvature_of_its_polynomial(tmp_path: Path) -> None:
    """In motion, against differences of the reduced equation."""
    spring = (
        '[[force]]\ntype = "torsion_spring"\njoint = "cam_joint"\nstiffness = 40.0\ndamping = 0.5\n'
    )
    mechanism = load(tmp_path, CAM_WHEELS, spring + CAM)
    p = np.polynomial.Polynomial([0.1, 0.05, 0.2, -0.03])
    slope, curvature = p.deriv(), p.deriv(2)

    def acceleration(phi: float, rate: float) -> float:
        force = -1.3 * slope(phi) * (curvature(phi) * rate**2 + 9.81) - 40.0 * phi - 0.5 * rate
        return float(force / (0.3 + 1.3 * slope(phi) ** 2))

    found = srm.linearise(mechanism, mechanism.q0, mechanism.v0, coordinates="cam_joint")
    h = 1e-5
    expected = [
        (acceleration(-0.7 + h, 2.0) - acceleration(-0.7 - h, 2.0)) / (2.0 * h),
        (acceleration(-0.7, 2.0 + h) - acceleration(-0.7, 2.0 - h)) / (2.0 * h),
    ]
    assert_close(found.A, [[0.0, 1.0], expected], atol=1e-6)
