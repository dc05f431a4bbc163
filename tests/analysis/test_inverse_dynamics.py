"""Forces that a prescribed motion needs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import null_space

import srm_mbs as srm
from srm_mbs.analysis import inverse_dynamics
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from srm_mbs.dynamics.observables import Observables
from srm_mbs.integration.kernel.observables import make_observables
from tests.support.backends import on_both
from tests.support.bundled import load
from tests.support.mechanisms import floating_ring


def driven(name: str, names: list[str], t_end: float = 1.0, **options):
    """A bundled mechanism, a run of it with torques on the joints ``names``, and these."""
    mechanism = load(name)
    columns = [mechanism.joint(joint).idx_v for joint in names]

    def torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        out = np.zeros(mechanism.model.nv)
        out[columns] = [3.0 * np.sin(4.0 * t + k) - 0.3 * v[c] for k, c in enumerate(columns)]
        return out

    run = srm.simulate(mechanism, t_end, rtol=1e-10, controller=torque, **options)
    given = np.array([torque(*state)[columns] for state in zip(run.t, run.q, run.v)])
    return mechanism, run, given


def terms(mechanism: srm.Mechanism, q: np.ndarray, v: np.ndarray):
    """M, nle and G of the kept rows."""
    model, data = mechanism.model, mechanism.model.createData()
    M = np.array(pin.crba(model, data, q, pin.Convention.WORLD))
    M = np.triu(M) + np.triu(M, 1).T
    nle = np.array(pin.nonLinearEffects(model, data, q, v))
    rows = LoopKinematics(model, mechanism.loops, keep=mechanism.structure.kept)
    rows.update(data, q, v)
    return M, nle, rows.G.copy()


@pytest.mark.parametrize(
    ("name", "names"),
    [
        ("four_bar", ["crank"]),
        ("four_bar", ["rocker"]),
        ("five_bar", ["crank_left", "crank_right"]),
        ("spatial_four_bar", ["crank"]),
        ("slider_crank", ["crank"]),
        ("pendulum_chain", ["link_0", "link_1", "link_2"]),
        ("differential", ["left_shaft", "pinion"]),
    ],
)
def test_the_torques_of_a_controller_are_recovered(name: str, names: list[str]) -> None:
    mechanism, run, given = driven(name, names)
    found = srm.inverse_dynamics(mechanism, run, names)
    assert found.actuated == tuple(names)
    np.testing.assert_allclose(found.torques, given, atol=1e-8)
    for of_run, own in (
        (run.reactions, found.reactions),
        (run.reaction_multipliers, found.reaction_multipliers),
    ):
        assert own.keys() == of_run.keys()
        for loop, values in of_run.items():
            np.testing.assert_allclose(own[loop], values, atol=1e-6, rtol=1e-8)


def test_the_power_of_the_torques_is_what_the_energy_gains() -> None:
    mechanism, run, _ = driven("four_bar", ["crank"])
    times = np.linspace(0.0, 1.0, 401)
    dense = run.at(times)
    power = srm.inverse_dynamics(mechanism, run, "crank", t=times).power
    h = times[1]
    energy = dense.energy
    slope = (8.0 * (energy[3:-1] - energy[1:-3]) - energy[4:] + energy[:-4]) / (12.0 * h)
    np.testing.assert_allclose(power[2:-2], slope, atol=1e-5 * np.abs(power).max())


def test_overactuated_torques_are_those_of_least_norm() -> None:
    mechanism, run, _ = driven("four_bar", ["crank"])
    names = ["crank", "coupler", "rocker"]
    found = srm.inverse_dynamics(mechanism, run, names)
    weighted = srm.inverse_dynamics(mechanism, run, names, weights=[1.0, 4.0, 9.0])
    for i in range(0, len(run.t), 7):
        M, nle, G = terms(mechanism, run.q[i], run.v[i])
        right = M @ run.accelerations[i] + nle
        # numpy's pinv of the stacked problem with the multipliers eliminated by SciPy
        Z = null_space(G)
        least = np.linalg.pinv(Z.T) @ (Z.T @ right)
        np.testing.assert_allclose(found.torques[i], least, atol=1e-8)
        # and the same as a saddle point: min |tau|^2 subject to tau - G^T lam = right
        for W, torques in (
            (np.eye(3), found.torques[i]),
            (np.diag([1, 4, 9]), weighted.torques[i]),
        ):
            m = len(G)
            saddle = np.block(
                [
                    [2.0 * W, np.zeros((3, m)), np.eye(3)],
                    [np.zeros((m, 3 + m)), -G],
                    [np.eye(3), -G.T, np.zeros((3, 3))],
                ]
            )
            exact = np.linalg.solve(saddle, np.concatenate([np.zeros(3 + m), right]))[:3]
            np.testing.assert_allclose(torques, exact, atol=1e-8)
    single = srm.inverse_dynamics(mechanism, run, "crank")
    assert np.linalg.norm(found.torques) < np.linalg.norm(single.torques)


def test_fewer_actuators_than_degrees_of_freedom_do_where_the_motion_needs_no_more() -> None:
    mechanism, run, given = driven("five_bar", ["crank_left"])
    found = srm.inverse_dynamics(mechanism, run, "crank_left")
    np.testing.assert_allclose(found.torques, given, atol=1e-8)


def test_a_free_motion_of_ball_joints_needs_nothing() -> None:
    mechanism = floating_ring()
    run = srm.simulate(mechanism, 1.0, rtol=1e-9)
    found = srm.inverse_dynamics(mechanism, run)
    assert len(found.actuated) == mechanism.model.nv
    np.testing.assert_allclose(found.torques, 0.0, atol=1e-9)


def test_a_prescribed_crank_turns_uniformly() -> None:
    """theta = 2 t on the slider-crank whose reduced equation is known."""
    mechanism = load("slider_crank")
    w, times = 2.0, np.linspace(0.0, 0.5, 6)

    def motion(t: float):
        theta = 0.3 + w * t
        return [theta, -2.0 * theta], [w, -2.0 * w], [0.0, 0.0]

    found = srm.inverse_dynamics(mechanism, motion, "crank", t=times)
    theta = 0.3 + w * times
    # twice tests.support.reduced.slider_crank, which is divided by 2 kg m^2
    exact = 2.0 * (4.0 * np.sin(theta) * np.cos(theta) * w**2 + 9.81 * np.cos(theta))
    np.testing.assert_allclose(found.torques[:, 0], exact, atol=1e-10)
    arrays = [times, *(np.array(part) for part in zip(*map(motion, times)))]
    same = srm.inverse_dynamics(mechanism, arrays, "crank")
    np.testing.assert_array_equal(same.torques, found.torques)


@pytest.mark.parametrize("observables", [make_observables, Observables])
def test_reactions_are_those_of_each_sample_alone(observables, monkeypatch) -> None:
    """Two runs of a four-bar with a spring, whose samples have the same times, in one motion of
    which the second half goes back in time."""
    monkeypatch.setattr(inverse_dynamics, "make_observables", observables)
    anchors = srm.Anchor("coupler"), srm.Anchor("world", xyz=(0.1, 0.0, 0.5))
    spring = srm.SpringDamper(*anchors, 30.0, 2.0, 0.2, "spring")
    mechanism = replace(load("four_bar"), forces=(spring,))
    runs = [
        srm.simulate(mechanism, 0.3, rtol=1e-10, controller=lambda t, q, v, k=k: [k, 0.0, 0.0])
        for k in (1.0, -2.0)
    ]
    parts = [(run.t, run.q, run.v, run.accelerations) for run in runs]
    motion = [np.concatenate([one, other[::-1]]) for one, other in zip(*parts)]
    found = srm.inverse_dynamics(mechanism, motion, "crank")
    np.testing.assert_allclose(
        found.torques[:, 0], np.repeat([1.0, -2.0], [len(run.t) for run in runs]), atol=1e-8
    )
    for name in ("reactions", "reaction_multipliers", "joint_reactions"):
        for key, own in getattr(found, name).items():
            first, second = (getattr(run, name)[key] for run in runs)
            expected = np.concatenate([first, second[::-1]])
            np.testing.assert_allclose(own, expected, atol=1e-8 * np.abs(expected).max())


def test_a_motion_given_as_a_function_may_be_read_at_no_time() -> None:
    mechanism, run, _ = driven("four_bar", ["crank"], 0.2)
    for motion in (run, lambda t: (run.q[0], run.v[0], run.accelerations[0])):
        found = srm.inverse_dynamics(mechanism, motion, "crank", t=[])
        assert found.torques.shape == (0, 1)
        assert found.reactions["pin"].shape == (0, 6)


@on_both
@pytest.mark.parametrize("name", ["four_bar", "quick_return", "squeezing_mechanism"])
def test_torques_are_recovered_from_a_run_with_a_loose_tolerance(name: str, backend: str) -> None:
    """Its states violate the closures by up to 1e-3.  The rest is the damping of the torque, whose
    rates are moved by a part of the tolerance."""
    mechanism, rtol = load(name).undriven, 1e-3
    crank = mechanism.joint_names[0]

    def torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        out = np.zeros(mechanism.model.nv)
        out[0] = 0.5 * np.sin(9.0 * t) - 0.01 * v[0]
        return out

    span = 0.03 if name == "squeezing_mechanism" else 1.0
    run = srm.simulate(mechanism, span, rtol=rtol, controller=torque, backend=backend)
    run = run.at(np.linspace(0.0, span, 40))
    assert run.drift.max() > 1e-5
    found = srm.inverse_dynamics(mechanism, run, crank)
    assert 0.0 < found.moved.max() < 1.0
    assert f"{(found.moved > 0.0).sum()} states moved onto the closures" in repr(found)
    given = [torque(*state)[0] for state in zip(run.t, run.q, run.v)]
    size = 0.01 * np.abs(run.v).max()
    np.testing.assert_allclose(found.torques[:, 0], given, rtol=0.0, atol=rtol * size)


def test_states_within_the_tolerance_stay_as_they_are() -> None:
    mechanism, run, _ = driven("four_bar", ["crank"])
    found = srm.inverse_dynamics(mechanism, run, "crank")
    assert not found.moved.any()
    motion = run.t, run.q, run.v, run.accelerations
    np.testing.assert_array_equal(
        found.torques, srm.inverse_dynamics(mechanism, motion, "crank").torques
    )


def test_the_states_of_a_run_with_actions_are_moved_in_each_segment() -> None:
    """An event halves the rates of a run, without a torque before and after it."""
    mechanism, half = load("four_bar"), 0.6
    slower = srm.Event(lambda t, q, v: t - half, action=lambda t, q, v: (q, 0.5 * v))
    run = srm.simulate(mechanism, 2.0 * half, rtol=1e-2, events=[slower])
    run = run.at(np.linspace(0.0, 2.0 * half, 40))
    found = srm.inverse_dynamics(mechanism, run)
    for part in (run.t < half, run.t > half):
        assert (found.moved[part] > 0.0).any()
    np.testing.assert_allclose(found.torques, 0.0, atol=1e-12)


def test_a_run_of_a_mechanism_with_other_closures_stays_refused() -> None:
    mechanism = load("four_bar")
    run = srm.simulate(load("slider_crank_regular"), 0.2, rtol=1e-3)
    with pytest.raises(srm.InputError, match="another mechanism"):
        srm.inverse_dynamics(mechanism, run)
    (pin_closure,) = mechanism.loops
    longer = replace(
        mechanism, loops=(replace(pin_closure, b=srm.Anchor("world", xyz=(2.1, 0.0, 0.0))),)
    )
    run = srm.simulate(mechanism, 0.2, rtol=1e-3)
    with pytest.raises(srm.InputError, match="positions of the motion violate the closures"):
        srm.inverse_dynamics(longer, run)


@pytest.mark.parametrize("size", [1e155, 1e200, 1e300])
def test_rates_whose_accelerations_overflow_are_refused(size: float) -> None:
    mechanism = load("four_bar")
    v = size * srm.assemble(mechanism, mechanism.q0, {"crank": 1.0}).v
    for motion in (([0.0], [mechanism.q0], [v], [v]), ([0.0], [mechanism.q0], [v], [0.0 * v])):
        with pytest.raises(srm.InputError, match="so fast that its accelerations overflow"):
            srm.inverse_dynamics(mechanism, motion)


def test_inverse_dynamics_are_shown_in_one_line() -> None:
    mechanism = load("four_bar")
    found = srm.inverse_dynamics(mechanism, srm.simulate(mechanism, 0.5))
    shown = repr(found)
    assert shown.startswith(f"InverseDynamics({len(found.t)} times, 3 actuated coordinates, resid")
    assert float(shown.split()[-1].rstrip(")")) == pytest.approx(found.residual.max(), rel=0.05)
