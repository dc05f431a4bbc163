"""The larger bundled mechanisms, against references that share nothing with the package."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.special import ellipj, ellipk

import srm_mbs as srm
from tests.support import reduced
from tests.support.bundled import load
from tools.models import made

ROOT = Path(__file__).parents[2]
MADE = made()
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
DEGREES = {
    "watt_six_bar": 1,
    "stephenson_six_bar": 1,
    "jansen_walker": 1,
    "simple_pendulum": 1,
    "bricard": 1,
    "flyball_governor": 4,
    "spatial_slider_crank": 1,
    "stewart_platform": 6,
    "delta_robot": 3,
    "differential": 2,
}
ONE_DEGREE = {
    "watt_six_bar": ("crank", 0.4),
    "stephenson_six_bar": ("crank", 0.4),
    "jansen_walker": ("crank", 0.15),
    "bricard": ("hinge_1", 1.0),
    "spatial_slider_crank": ("crank", 0.6),
}
"""Joint and time (s)."""


@cache
def run(name: str, t_end: float, rtol: float = 1e-9) -> srm.Solution:
    solution = srm.simulate(load(name), t_end, rtol=rtol)
    assert solution.success
    return solution


@pytest.mark.parametrize("name", MADE)
def test_the_files_are_those_that_the_generator_writes(name: str) -> None:
    """But for the last digits, which come out differently on other processors."""
    for written, file in zip(MADE[name](), (f"urdf/{name}.urdf", f"models/{name}.toml")):
        if not written:  # of a linkage
            assert not (ROOT / file).exists()
            continue
        kept = (ROOT / file).read_text(encoding="utf-8")
        assert NUMBER.split(kept) == NUMBER.split(written)
        found, expected = (np.array(NUMBER.findall(text), dtype=float) for text in (kept, written))
        # Sums of some tens of products of numbers up to 10, each rounded to 2e-16.
        np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("name", DEGREES)
def test_it_has_the_degrees_of_freedom_of_its_kind_and_does_not_drift(name: str) -> None:
    mechanism = load(name)
    assert mechanism.degrees_of_freedom == DEGREES[name]
    solution = run(name, 1.0)
    assert np.abs(solution.drift[:, 0]).max() < 1e-13
    assert np.abs(solution.drift[:, 1]).max() < 1e-9


@pytest.mark.parametrize("name", ONE_DEGREE)
def test_one_degree_of_freedom_moves_as_the_equation_of_that_one(name: str) -> None:
    mechanism = load(name)
    joint, t_end = ONE_DEGREE[name]
    i = mechanism.joint(joint).idx_q
    times = np.linspace(0.0, t_end, 5)
    expected = solve_ivp(
        reduced.OneDegree(mechanism, joint),
        (0.0, t_end),
        [mechanism.q0[i], mechanism.v0[i]],
        method="DOP853",
        t_eval=times,
        rtol=1e-9,
        atol=1e-10,
    ).y
    q, v = run(name, 1.0)(times)
    np.testing.assert_allclose(q[:, i], expected[0], atol=3e-8)
    np.testing.assert_allclose(v[:, i], expected[1], atol=1e-6)


@pytest.mark.parametrize("leg", ["left_0", "right_1"])
def test_the_feet_of_jansens_walker_draw_his_curve_with_a_flat_bottom(leg: str) -> None:
    solution = run("jansen_walker", 1.6)
    mechanism, model = solution.mechanism, solution.mechanism.model
    turned = solution.q[:, mechanism.joint("crank").idx_q]
    assert np.ptp(turned) > 2.0 * np.pi

    # The foot is a triangle of bars g, h and i; its frame is in the pin between g and i.
    g, h, i = 0.367, 0.657, 0.49
    foot = model.getJointId(f"{leg}_foot")
    (ankle,) = (loop.b.xyz for loop in mechanism.loops if loop.name == f"{leg}_ankle")
    assert np.linalg.norm(ankle) == pytest.approx(g)
    middles = (g + h + i) * model.inertias[foot].lever  # of the bars, weighted
    tip = (2.0 * middles - (g + h) * np.array(ankle)) / (h + i)
    assert np.linalg.norm(tip) == pytest.approx(i)
    assert np.linalg.norm(tip - ankle) == pytest.approx(h)

    data = model.createData()

    def place(q: np.ndarray) -> np.ndarray:
        pin.forwardKinematics(model, data, q)
        return data.oMi[foot].act(tip)

    x, _, z = np.array([place(solution(t)[0]) for t in np.linspace(0.0, 1.6, 400)]).T
    assert np.ptp(x[z < z.min() + 0.005]) > 0.4
    assert np.ptp(x) == pytest.approx(0.68, abs=0.03)
    assert np.ptp(z) == pytest.approx(0.225, abs=0.02)


def test_the_simple_pendulum_follows_its_elliptic_function() -> None:
    """From rest at 90 degrees from hanging: sin(phi / 2) = k sn(K - w t), k = sin(45 degrees)."""
    t = np.linspace(0.0, 10.0, 101)
    w, m = np.sqrt(9.81), 0.5
    sn = ellipj(ellipk(m) - w * t, m)[0]
    phi = -2.0 * np.arcsin(np.sqrt(m) * sn)  # from hanging, towards +x
    q, _ = run("simple_pendulum", 10.0, 1e-11)(t)
    np.testing.assert_allclose(q[:, 0], 1.5 * np.pi + phi, atol=1e-9)


def test_bricard_has_one_redundant_row_that_no_list_can_name() -> None:
    mechanism = load("bricard")
    assert mechanism.model.nv == 5
    assert mechanism.structure.rank == 4
    assert mechanism.redundant_rows == ()
    solution = run("bricard", 2.0)
    assert np.ptp(solution.joint("hinge_1")[0]) > 1.0, "it really moves"


def test_hinges_of_bricard_turn_in_two_threes() -> None:
    """Trihedral: cos a + cos b + cos a cos b = 0 of neighbours, each 90 degrees on from here."""
    solution = run("bricard", 2.0)
    one, two = (solution.joint(f"hinge_{k}")[0] for k in (1, 2))
    for k, other in ((3, one), (5, one), (4, two)):
        np.testing.assert_allclose(
            np.abs(solution.joint(f"hinge_{k}")[0]), np.abs(other), atol=1e-9
        )
    a, b = np.sin(one), np.sin(two)
    np.testing.assert_allclose(a - b, a * b, atol=1e-9)


def test_the_governor_follows_a_stiff_integration_of_its_tree() -> None:
    """Radau on Pinocchio's aba, spring forces by hand, to 0.3 s: the springs have settled."""
    mechanism = load("flyball_governor")
    model, data = mechanism.model, mechanism.model.createData()
    frames = {
        name: model.getFrameId(name, pin.FrameType.BODY)
        for name in ("slider", "left_rod", "right_rod")
    }
    down = np.array([np.cos(np.pi / 6.0), 0.0, -0.5])

    def field(t: float, y: np.ndarray) -> np.ndarray:
        q, v = y[:4], y[4:]
        pin.forwardKinematics(model, data, q, v)
        pin.updateFramePlacements(model, data)
        pin.computeJointJacobians(model, data, q)
        tau = np.zeros(4)
        for name, sign in (("left_rod", -1.0), ("right_rod", 1.0)):
            ends = []
            for frame, at in ((name, 0.5 * down * [sign, 1, 1]), ("slider", [0.05 * sign, 0, 0])):
                place = data.oMf[frames[frame]]
                J = pin.getFrameJacobian(
                    model, data, frames[frame], pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
                )
                arm = place.rotation @ np.asarray(at, dtype=float)
                ends.append((place.translation + arm, J[:3] - pin.skew(arm) @ J[3:]))
            (pa, Ja), (pb, Jb) = ends
            length = np.linalg.norm(pa - pb)
            along = (pa - pb) / length @ (Ja - Jb)
            tau -= along * (8e5 * (length - 0.5) + 4e4 * along @ v)
        return np.concatenate([v, pin.aba(model, data, q, v, tau)])

    start = np.concatenate([mechanism.q0, mechanism.v0])
    stiff = solve_ivp(field, (0.0, 0.3), start, method="Radau", rtol=1e-10, atol=1e-12)
    q, v = run("flyball_governor", 0.3, 1e-9)(0.3)
    np.testing.assert_allclose(q, stiff.y[:4, -1], atol=1e-7)
    np.testing.assert_allclose(v, stiff.y[4:, -1], atol=1e-6)


def test_the_governor_swings_symmetrically() -> None:
    solution = run("flyball_governor", 1.0)
    left, right = (solution.joint(f"{side}_rod")[0] for side in ("left", "right"))
    np.testing.assert_allclose(left, right, atol=1e-9)
    assert np.ptp(solution.joint("slider")[0]) > 0.05


def test_the_plate_of_the_delta_robot_never_turns() -> None:
    solution = run("delta_robot", 2.0)
    start = solution.mechanism.joint("tool").idx_q
    turned = solution.q[:, start + 3 : start + 6]
    np.testing.assert_allclose(turned, 0.0, atol=1e-10)
    assert np.ptp(solution.q[:, start : start + 3], axis=0).max() > 0.05


def test_the_stewart_platform_comes_to_rest_under_its_weight() -> None:
    """Symmetry: upright again, the springs carrying all the weight on one axis."""
    solution = run("stewart_platform", 60.0, 1e-6)
    start = solution.mechanism.joint("platform").idx_q
    place = solution.q[-1, start : start + 7]
    np.testing.assert_allclose(place[[0, 1, 3, 4]], 0.0, atol=1e-5)
    assert np.abs(solution.v[-1]).max() < 1e-5
    energy = solution.energy
    assert energy[-1] < energy[0]


def test_the_differential_solves_its_linear_equations() -> None:
    """Two coordinates, constant inertia and damping: y' = A y + b by the matrix exponential."""
    mechanism = load("differential")
    model = mechanism.model
    names = mechanism.joint_names
    # Rates of all joints by those of the left and the right shaft.
    rates = {
        "pinion": (1.5, 1.5),
        "carrier": (0.5, 0.5),
        "upper_spider": (1.0 / 1.5, -1.0 / 1.5),
        "lower_spider": (-1.0 / 1.5, 1.0 / 1.5),
        "left_shaft": (1.0, 0.0),
        "right_shaft": (0.0, 1.0),
    }
    T = np.array([rates[name] for name in names])
    M = T.T @ pin.crba(model, model.createData(), mechanism.q0) @ T
    M = np.triu(M) + np.triu(M, 1).T
    D = T.T @ np.diag(model.damping) @ T
    torque = np.array([0.5 if name == "pinion" else 0.0 for name in names])
    A = np.zeros((5, 5))
    A[:2, 2:4] = np.eye(2)
    A[2:4, 2:4] = -np.linalg.solve(M, D)
    A[2:4, 4] = np.linalg.solve(M, T.T @ torque)
    for t in (1.0, 5.0):
        expected = expm(t * A)[:, 4]
        q, v = run("differential", 5.0)(t)
        order = [
            model.joints[model.getJointId(f"{side}_shaft")].idx_q for side in ("left", "right")
        ]
        np.testing.assert_allclose(q[order], expected[:2], rtol=1e-8)
        np.testing.assert_allclose(v[order], expected[2:4], rtol=1e-8)
        np.testing.assert_allclose(v, T @ expected[2:4], rtol=1e-8)


def test_the_differential_gives_both_wheels_the_same_torque() -> None:
    """At steady speed each wheel takes 3/2 of the motor's torque, whatever its speed."""
    solution = run("differential", 200.0, 1e-6)
    for side, damping in (("left", 0.1), ("right", 0.4)):
        rate = solution.joint(f"{side}_shaft")[1][-1]
        assert damping * rate == pytest.approx(1.5 * 0.5, rel=1e-6)


@pytest.mark.parametrize("name", DEGREES)
def test_the_energy_balance_closes(name: str) -> None:
    balance = run(name, 1.0).energy_balance
    assert np.abs(balance.residual).max() < 1e-8 * balance.scale
