"""Workspaces of the compiled kernel that the runs of a mechanism hand on to each other."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._kernel.workspace import KEPT_SYSTEMS, LARGE
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.errors import ControllerError
from srm_mbs.integration.kernel import backend as kernel
from srm_mbs.integration.kernel import system as kernel_systems
from tests.support.mechanisms import along_x, rod

pytestmark = pytest.mark.skipif(kernel.core is None, reason="needs the compiled kernel")


def idle(mechanism: srm.Mechanism) -> list[Any]:
    return list(kernel_systems.idle_workspaces(mechanism))


def run(mechanism: srm.Mechanism, **options: Any) -> srm.Solution:
    return srm.simulate(mechanism, 0.02, backend="kernel", rtol=1e-6, **options)


def fresh() -> srm.Mechanism:
    return srm.load("squeezing_mechanism")


def test_a_run_in_a_used_workspace_is_that_in_a_new_one() -> None:
    mechanism = fresh()
    expected = run(fresh())
    other = mechanism.with_state(mechanism.q0, 1.0e-3 * np.zeros(7))
    used = run(other, step=1e-3)
    assert idle(mechanism) == idle(other)
    (workspace,) = idle(mechanism)
    found = run(mechanism)
    assert idle(mechanism) == [workspace]
    assert used.stats.evaluations > 0
    for name in ("times", "states", "rates", "sigmas", "error_ratios"):
        assert np.array_equal(getattr(found.steps, name), getattr(expected.steps, name)), name
    assert found.stats.evaluations == expected.stats.evaluations
    assert found.stats.factorisations == expected.stats.factorisations
    t = np.linspace(0.0, 0.02, 50)
    assert np.array_equal(found(t)[0], expected(t)[0])


BARS = """format = 1
[parameters]
crank = 0.4
[planar]
ground = ["O", "C"]
mass_per_length = 1.0
rates = { O = 3.0 }
points = { O = [0, 0], A = ["=0.6*crank", "=0.8*crank"], B = [1.0, 0.6], C = [1.0, 0] }
bar = [
  { name = "crank", points = ["O", "A"] },
  { name = "coupler", points = ["A", "B"] },
  { name = "rocker", points = ["B", "C"] },
]
"""


def test_variants_run_in_workspaces_of_each_other_as_in_new_ones(tmp_path: Path) -> None:
    """Each takes its own numbers to a workspace that another one left."""
    path = tmp_path / "bars.toml"
    path.write_text(BARS, encoding="utf-8")
    base = srm.load(path)
    variants = [base.with_parameters(crank=crank) for crank in (0.38, 0.4, 0.42)]
    expected = [run(pickle.loads(pickle.dumps(variant))) for variant in variants]

    def check(number: int) -> None:
        found, own = run(variants[number]), expected[number]
        assert np.array_equal(found.steps.states, own.steps.states)
        for joint, wrenches in own.joint_reactions.items():
            assert np.array_equal(found.joint_reactions[joint], wrenches), joint

    for number in (0, 1, 2, 0):
        check(number)
    (workspace,) = idle(base)
    assert all(idle(variant) == [workspace] for variant in variants)
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(check, [0, 1, 2] * 10))


def test_runs_at_the_same_time_do_not_share() -> None:
    mechanism = fresh()
    expected = run(fresh())
    inner: list[srm.Solution] = []

    def event(t: float, q: Any, v: Any) -> float:
        if not inner:
            run(mechanism)  # leaves its workspace
        inner.append(run(mechanism))
        return 1.0

    srm.simulate(mechanism, 0.005, backend="kernel", events=event)
    assert len(inner) > 1
    assert all(np.array_equal(one.steps.states, expected.steps.states) for one in inner)
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: run(mechanism), range(40)):
            assert np.array_equal(found.steps.states, expected.steps.states)
    assert 1 <= len(idle(mechanism)) <= KEPT_SYSTEMS


def test_no_more_than_a_few_are_kept() -> None:
    system = make_system(fresh())
    with ExitStack() as stack:
        borrowed = [
            stack.enter_context(kernel_systems.workspace(system)) for _ in range(2 * KEPT_SYSTEMS)
        ]
        assert len(set(map(id, borrowed))) == 2 * KEPT_SYSTEMS
    assert len(idle(system.mechanism)) == KEPT_SYSTEMS


def test_pickles_and_copies_carry_none() -> None:
    mechanism = fresh()
    run(mechanism)
    assert idle(mechanism)
    assert not idle(pickle.loads(pickle.dumps(mechanism)))
    assert not idle(copy.copy(mechanism))


def test_a_mechanism_with_many_loops_keeps_one_with_which_runs_are_those_of_a_new_one() -> None:
    mechanism = srm.n_four_bar(40)
    assert mechanism.model.nv > LARGE
    expected = run(srm.n_four_bar(40))
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda _: run(mechanism), range(4)))
    (kept,) = idle(mechanism)
    assert np.array_equal(run(mechanism).steps.states, expected.steps.states)
    assert idle(mechanism) == [kept]


def test_the_largest_mechanisms_keep_none() -> None:
    model = pin.Model()
    for i in range(kernel_systems.LARGEST_KEPT + 1):
        model.addJoint(i, pin.JointModelRY(), along_x(0.1), f"j{i}")
        model.appendBodyToJoint(i + 1, rod(), pin.SE3.Identity())
    mechanism = srm.Mechanism(model)
    solution = srm.simulate(mechanism, 1e-3, backend="kernel")
    assert np.isfinite(solution(5e-4)[0]).all()
    assert not idle(mechanism)


def test_workspaces_in_which_functions_of_the_user_or_drives_act_are_not_kept() -> None:
    mechanism = fresh()

    def push(t: float, q: Any, v: Any) -> Any:
        return np.full(7, 1e-3)

    run(mechanism, controller=push)
    run(mechanism, controller=push, sample_time=1e-3)
    assert not idle(mechanism)
    drive = srm.Drive(srm.Sine(0.1, omega=3.0), mechanism.joint_names[0])
    driven = srm.Mechanism(mechanism.model, drives=(drive,))
    assert driven.drives
    assert not kernel_systems.shared(make_system(driven))


def test_a_run_that_raises_does_not_spoil_the_next() -> None:
    mechanism = fresh()
    expected = run(fresh())

    def event(t: float, q: Any, v: Any) -> float:
        if t > 0.01:
            raise RuntimeError("stop")
        return 1.0

    with pytest.raises(srm.SimulationError):
        run(mechanism, events=event, raise_on_failure=True)
    assert np.array_equal(run(mechanism).steps.states, expected.steps.states)


def test_forces_held_in_one_run_do_not_act_in_the_next() -> None:
    mechanism = fresh()
    system = make_system(mechanism)
    with kernel_systems.workspace(system) as kernel_system:
        state = np.concatenate([mechanism.q0, mechanism.v0])
        free = kernel_system.terms(0.0, state)["rate"]
        kernel_system.hold(0.0, np.full(7, 1.0), True)
        kernel_system.between(5.0, 6.0)
        assert not np.array_equal(kernel_system.terms(0.0, state)["rate"], free)
    with kernel_systems.workspace(system) as again:
        assert again is kernel_system
        assert again.evaluations == 0
        assert np.array_equal(again.terms(0.0, state)["rate"], free)


def test_stages_that_could_not_be_evaluated_are_not_read_as_zeros_later() -> None:
    mechanism = fresh()
    broken = False

    def controller(t: float, q: Any, v: Any) -> Any:
        if broken:
            raise ValueError("no longer there")
        return np.zeros(7)

    solution = run(mechanism, controller=controller)
    expected = run(mechanism, controller=controller)
    t = np.linspace(0.001, 0.019, 7)
    broken = True
    for _ in range(2):
        with pytest.raises(ControllerError):
            solution(t)
    broken = False
    assert np.array_equal(solution(t)[0], expected(t)[0])


def test_times_outside_the_run_are_refused_by_the_kernel_too() -> None:
    solution = run(fresh())
    for t in (-1e-6, 0.02 + 1e-6, np.nan):
        with pytest.raises(ValueError, match="the run covers"):
            solution(np.array([0.01, t]))
    assert np.isfinite(solution(0.02 * (1.0 + 1e-14))[0]).all()


def test_a_mechanism_and_its_kernel_systems_are_freed_with_its_last_run() -> None:
    mechanism = fresh()
    freed = weakref.ref(mechanism)
    gc.disable()  # which would free what refers to itself, but later
    try:
        solution = run(mechanism)
        _ = solution.joint_reactions, solution.message
        del mechanism, solution
        assert freed() is None
    finally:
        gc.enable()
