"""Controllers that name the joints on which they act."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.errors import ControllerError
from tests.support.bundled import load
from tests.support.mechanisms import floating_ring

T_END = 0.3
"""Length (s) of the runs."""


@pytest.mark.parametrize("backend", ["python", "kernel"])
@pytest.mark.parametrize("sample_time", [None, 0.02])
def test_forces_by_joint_name_act_as_the_array_of_the_same_forces(
    backend: str, sample_time: float | None
) -> None:
    mechanism = load("four_bar")
    last = mechanism.joint_names[-1]

    def by_name(t: float, q: FloatArray, v: FloatArray) -> dict[str, Any]:
        return {last: -0.3 * v[-1], "crank": 5.0 * np.cos(t)}

    def array(t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        return np.array([5.0 * np.cos(t), 0.0, -0.3 * v[-1]])

    options = {"backend": backend, "sample_time": sample_time}
    named, listed, free = (
        srm.simulate(mechanism, T_END, controller=controller, **options)
        for controller in (by_name, array, lambda t, q, v: {})
    )
    np.testing.assert_array_equal(named.q, listed.q)
    np.testing.assert_array_equal(named.v, listed.v)
    assert np.abs(named.v[-1] - free.v[-1]).max() > 0.01


def test_joints_of_several_degrees_of_freedom_take_arrays() -> None:
    ring = floating_ring()
    joint = ring.joint("c")
    own = slice(joint.idx_v, joint.idx_v + joint.nv)

    def array(t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        tau = np.zeros(len(v))
        tau[own] = 1.0, -0.5, 0.2
        return tau

    named = srm.simulate(ring, T_END, controller=lambda t, q, v: {"c": [1.0, -0.5, 0.2]})
    listed = srm.simulate(ring, T_END, controller=array)
    np.testing.assert_array_equal(named.q, listed.q)
    np.testing.assert_array_equal(named.v, listed.v)


def test_a_linearisation_takes_forces_by_joint_name() -> None:
    mechanism = srm.load("pendulum_chain")
    first = mechanism.joint_names[0]
    rest = np.zeros(mechanism.model.nv)
    named = srm.linearise(mechanism, v=rest, controller=lambda t, q, v: {first: -0.3 * v[0]})
    listed = srm.linearise(mechanism, v=rest, controller=lambda t, q, v: [-0.3 * v[0], 0.0, 0.0])
    np.testing.assert_array_equal(named.A, listed.A)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"hip": 1.0},
            r"force of the joint 'hip' at t = 0 s: there is no joint 'hip'\. Known: a, b",
        ),
        ({3: 1.0}, r"there is no joint 3\. Known: a, b, c, d"),
        ({"b": 1.0}, r"'b' is given as 1\.0 at t = 0 s; it must be 3 finite numbers"),
        ({"b": [1.0, np.nan, 0.0]}, "'b' is given as values that are not finite"),
        ({"a": np.zeros(3)}, r"'a' is given as an array of shape \(3,\) .* 6 finite numbers"),
        ({"c": "much"}, "'c' is given as 'much' at t = 0 s; it must be 3 finite numbers"),
    ],
    ids=str,
)
def test_forces_that_do_not_fit_the_joints_are_named(given: Any, said: str) -> None:
    with pytest.raises(ControllerError, match=said):
        srm.simulate(floating_ring(), T_END, controller=lambda t, q, v: given)


@pytest.mark.parametrize("backend", ["python", "kernel"])
def test_a_force_of_the_user_that_returns_a_mapping_is_told_what_it_returned(backend: str) -> None:
    force = srm.UserForce(lambda t, q, v: {"crank": 1.0}, name="push")
    mechanism = replace(load("four_bar"), forces=[force])
    said = r"'push' returned {'crank': 1.0} at t = 0 s; it must return 3 finite numbers"
    with pytest.raises(ControllerError, match=said):
        srm.simulate(mechanism, T_END, backend=backend)


@pytest.mark.filterwarnings("ignore:Casting complex values")  # would be an error of its own
@pytest.mark.parametrize("backend", ["python", "kernel"])
@pytest.mark.parametrize("sample_time", [None, 0.01])
@pytest.mark.parametrize("imaginary", [0.0, 2.0])
def test_complex_forces_are_refused_as_other_wrong_ones_are(
    backend: str, sample_time: float | None, imaginary: float
) -> None:
    mechanism = load("four_bar")
    for given in (np.full(3, 1.0 + 1j * imaginary), [0.0, 1.0 + 1j * imaginary, np.complex128(0)]):
        with pytest.raises(ControllerError, match=r"controller returned .*j.* must return 3 fin"):
            srm.simulate(
                mechanism,
                T_END,
                controller=lambda t, q, v: given,  # noqa: B023
                sample_time=sample_time,
                backend=backend,
            )
    pushed = replace(mechanism, forces=[srm.UserForce(lambda t, q, v: v + 1j * imaginary)])
    with pytest.raises(ControllerError, match=r"force .* returned .*j.* must return 3 finite"):
        srm.simulate(pushed, T_END, backend=backend)


@pytest.mark.filterwarnings("ignore:Casting complex values")
def test_a_simulator_takes_no_complex_forces() -> None:
    simulator = srm.Simulator(load("four_bar"))
    with pytest.raises(srm.InputError, match=r"tau = .* is not a vector of finite generalised"):
        simulator.step(0.01, np.full(3, 1.0 + 2.0j))


def test_a_joint_of_one_degree_of_freedom_takes_one_number() -> None:
    mechanism = load("four_bar")
    with pytest.raises(
        ControllerError, match=r"shape \(2,\) at t = 0 s; it must be a finite number"
    ):
        srm.simulate(mechanism, T_END, controller=lambda t, q, v: {"crank": [1.0, 2.0]})


def test_a_name_that_is_unknown_later_ends_the_run_with_the_reason() -> None:
    def renamed(t: float, q: FloatArray, v: FloatArray) -> dict[str, float]:
        return {"crank" if t < 0.1 else "shaft": 1.0}

    with pytest.warns(srm.SrmWarning, match="there is no joint 'shaft'"):
        run = srm.simulate(load("four_bar"), T_END, controller=renamed)
    assert isinstance(run.error, ControllerError)
