"""The compiled kernel agrees with the Python reference: attempt by attempt, and whole runs."""

from __future__ import annotations

import gc
import re
import sys
import threading
import time
import weakref
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.integration.breakpoints import smooth_intervals
from srm_mbs.integration.control.step_size import initial_step
from srm_mbs.integration.dense_output import DenseOutput
from srm_mbs.integration.kernel import backend as kernel
from srm_mbs.integration.kernel.marshalling import state_struct
from srm_mbs.integration.kernel.run import CompiledRun
from srm_mbs.integration.kernel.system import make_kernel_system
from srm_mbs.integration.methods.base import ErrorNorm
from srm_mbs.simulation.runner import absolute_tolerance
from tests.support.bundled import load
from tests.support.lockstep import Comparison, compare
from tests.support.mechanisms import floating_ring

pytestmark = pytest.mark.skipif(kernel.core is None, reason=f"no kernel: {kernel.missing}")

MODELS = (
    ("slider_crank", 4.0),
    ("slider_crank_whirl", 2.0),
    ("slider_crank_slider", 2.0),
    ("parallelogram", 3.0),
    ("n_four_bar_2", 4.0),
    ("spatial_dead_point", 1.5),
    ("spatial_four_bar", 1.0),
    ("five_bar", 1.0),
    ("squeezing_mechanism", 0.01),
    ("pendulum_chain", 1.0),
)


def agree(found: Comparison, thin: bool = False) -> None:
    """Steps to 1e-13 of their size, 2e-12 over sigma^2 next to singular configurations; all
    decisions alike.

    ``thin``: bodies that all but lack inertia about an axis.  In the norm of the kinetic energy
    they are no exception; on single coordinates the rounding of M counts with its condition.
    """
    assert found.attempts >= 10
    assert found.h < 1e-13
    assert found.decisions == []
    assert found.energy < 2e-14
    assert found.state < (np.finfo(float).eps * found.condition if thin else 1e-13)
    assert found.near < 2e-12
    assert found.correction < 1e-13
    assert found.error < 1e-12


@pytest.mark.parametrize(("name", "t_end"), MODELS)
@pytest.mark.parametrize(("tableau", "rtol"), [("dop853", 1e-6), ("dopr54", 1e-8), ("tvd32", 1e-5)])
def test_every_attempt_of_the_reference_is_repeated(
    name: str, t_end: float, tableau: str, rtol: float
) -> None:
    thin = name == "spatial_dead_point"
    agree(compare(load(name), t_end, rtol=rtol, tableau=tableau), thin)


@pytest.mark.parametrize("placement", ["automatic", "off"])
@pytest.mark.parametrize("tableau", ["fe", "erk4", "dop853"])
def test_fixed_steps_are_repeated(tableau: str, placement: str) -> None:
    """Over grid points and stages on a singular configuration; placement "off" enters the zone."""
    found = compare(
        load("slider_crank"), 1.5, rtol=1e-6, tableau=tableau, step=0.01, placement=placement
    )
    agree(found)


def test_steps_in_the_zone_are_repeated() -> None:
    mechanism = load("slider_crank")
    crossing = srm.simulate(mechanism, 2.0, rtol=1e-10, backend="python").crossings[0].time
    found = compare(mechanism, 2.0, rtol=1e-6, step=crossing / 64.0, placement="off")
    assert found.zones > 0
    agree(found)


def test_a_finite_eps_is_repeated() -> None:
    for eps in (1e-3, "h", "h^(2/3)"):
        agree(compare(load("four_bar"), 0.5, rtol=1e-6, eps=eps, step=0.005, tableau="erk4"))


def test_free_and_ball_joints_are_repeated() -> None:
    agree(compare(floating_ring(), 1.0, rtol=1e-7))


def random_state(mechanism: srm.Mechanism, rng: np.random.Generator) -> np.ndarray:
    model = mechanism.model
    q = pin.integrate(model, mechanism.q0, rng.uniform(-1.0, 1.0, model.nv))
    return np.concatenate([q, rng.standard_normal(model.nv)])


@pytest.mark.parametrize("name", [name for name, _ in MODELS])
def test_the_terms_of_a_stage_agree_anywhere(name: str) -> None:
    mechanism = load(name)
    system = make_system(mechanism)
    kernel_system = make_kernel_system(system)
    rng = np.random.default_rng(5)
    for _ in range(20):
        x = random_state(mechanism, rng)
        terms = system.evaluate(0.3, x)
        expected: dict[str, Any] = {
            "rate": terms.rate(),
            "multiplier": terms.multiplier(),
            "correction": terms.correction(),
        }
        found = kernel_system.terms(0.3, x)
        assert found["rank"] == terms.rank
        if system.has_constraints:
            assert abs(found["sigma"] - terms.sigma) < 1e-12
        for key, value in expected.items():
            size = np.abs(value).max() + 1.0
            lowest = min(1.0, terms.sigma) ** 2
            assert np.abs(found[key] - value).max() < 1e-12 * size / lowest, key


def both(mechanism: srm.Mechanism, t_end: float, **options: Any) -> tuple[srm.Solution, ...]:
    return tuple(
        srm.simulate(mechanism, t_end, backend=backend, **options)
        for backend in ("python", "kernel")
    )


def test_whole_runs_and_their_dense_output_agree() -> None:
    for name, t_end in MODELS:
        python, compiled = both(load(name), t_end, rtol=1e-8)
        t = np.linspace(0.0, t_end, 101)
        unit = python.mechanism.structure.units.coordinate.max()
        assert np.abs(python(t)[0] - compiled(t)[0]).max() < 1e-7 * unit
        assert compiled.status == python.status
        assert compiled.message == python.message
        assert len(compiled.crossings) == len(python.crossings)


def test_dense_output_of_the_same_steps_agrees_to_rounding() -> None:
    """Regular steps, and steps next to singular configurations (Hermite interpolation)."""
    for name, t_end in MODELS:
        mechanism = load(name)
        solution = srm.simulate(mechanism, t_end, rtol=1e-7, backend="kernel")
        system = make_system(mechanism)
        t = np.linspace(0.0, t_end, 137)
        reference = DenseOutput(system, solution.scheme, solution.steps)(t)
        q, v = solution(t)
        size = np.abs(reference).max(axis=0) + 1.0
        # Stages next to singular configurations carry rounding over sigma.
        assert np.abs((np.hstack([q, v]) - reference) / size).max() < 1e-11


def test_force_elements_friction_damping_and_a_controller_act_alike() -> None:
    mechanism = load("four_bar")
    model = mechanism.model.copy()
    model.damping[:] = 0.05
    model.friction[:] = 0.02
    joint, links = mechanism.joint_names[0], [loop.a.link for loop in mechanism.loops]
    a = srm.Anchor(links[0], xyz=(0.1, 0.0, 0.2))
    b = srm.Anchor("world", xyz=(0.3, 0.1, -0.4))
    forces = (
        srm.SpringDamper(a, b, stiffness=20.0, damping=0.3, rest_length=0.4, name="spring"),
        srm.TorsionSpring(joint, stiffness=2.0, damping=0.1, rest_angle=0.3, name="torsion"),
        srm.CouplingSpring(mechanism.joint_names[:2], (0.5, -1.5), 1.0, 0.2, 0.1, name="cable"),
        srm.CouplingSpring(
            mechanism.joint_names[:2], (0.3, 1.0), 1.0, 0.0, 0.1, "belt", slack=0.2, friction=0.02
        ),
        srm.JointTorque(joint, 0.2, name="motor"),
        srm.Wrench(a, force=(1.0, 0.0, 2.0), moment=(0.0, 0.3, 0.0), frame="link", name="jet"),
        srm.Wrench(a, force=(0.0, 0.0, 0.5), moment=(0.1, 0.0, 0.0), frame="world", name="wind"),
        srm.Bushing(a, b, stiffness=(5.0,) * 6, damping=(0.2,) * 6, name="mount"),
    )
    loaded = srm.Mechanism(
        model, mechanism.loops, q0=mechanism.q0, v0=mechanism.v0, forces=forces, name="loaded"
    )
    agree(compare(loaded, 0.5, rtol=1e-7))
    runs = both(
        loaded,
        1.0,
        rtol=1e-9,
        controller=lambda t, q, v: 0.3 * np.sin(3.0 * t) - 0.1 * v,
        t_eval=np.linspace(0.0, 1.0, 20),
    )
    assert np.abs(runs[0].q - runs[1].q).max() < 1e-8
    assert runs[0].stats.steps == runs[1].stats.steps


def test_events_end_runs_alike() -> None:
    def upright(t: float, q: np.ndarray, v: np.ndarray) -> float:
        return float(np.sin(q[0]))

    upright.terminal = 3  # type: ignore[attr-defined]
    python, compiled = both(load("four_bar"), 10.0, rtol=1e-9, events=upright)
    assert python.t_events is not None
    assert compiled.t_events is not None
    assert compiled.status == python.status == "event"
    assert np.abs(python.t_events[0] - compiled.t_events[0]).max() < 1e-8
    assert compiled.t[-1] == compiled.t_events[0][-1]


NUMBER = re.compile(r"[-+]?[\d.]+(e[-+]?\d+)?")


def failing(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    if t > 0.5:
        raise RuntimeError("no power")
    return np.zeros_like(v)


def test_failures_keep_what_was_computed_and_say_the_same() -> None:
    mechanism = load("four_bar")
    for options in (
        {"controller": failing},
        {"controller": lambda t, q, v: np.full(len(v), np.nan if t > 0.3 else 0.0)},
        {"step": 0.5, "tableau": "fe"},
    ):
        python, compiled = both(mechanism, 5.0, **options)
        assert not python.success
        assert compiled.status == python.status == "failed"
        assert NUMBER.sub("#", compiled.message) == NUMBER.sub("#", python.message)
        assert compiled.t[-1] == pytest.approx(python.t[-1], rel=1e-6)


def test_an_interrupt_in_a_controller_keeps_the_run() -> None:
    def interrupting(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        if t > 0.5:
            raise KeyboardInterrupt
        return np.zeros_like(v)

    solution = srm.simulate(load("four_bar"), 5.0, backend="kernel", controller=interrupting)
    assert solution.status == "interrupted"
    assert 0.3 < solution.t[-1] <= 0.5


def test_runs_in_threads_do_not_disturb_each_other() -> None:
    mechanism = load("slider_crank_whirl")
    alone = srm.simulate(mechanism, 5.0, rtol=1e-9, backend="kernel").q[-1]
    ends: list[np.ndarray] = []

    def run() -> None:
        ends.append(srm.simulate(mechanism, 5.0, rtol=1e-9, backend="kernel").q[-1])

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(ends) == 4
    assert all(np.array_equal(end, alone) for end in ends)


def test_the_interpreter_is_free_while_the_kernel_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another thread goes on inside a call of the kernel: the GIL is released."""
    counted, during = [0], [0]
    done = threading.Event()
    advance = CompiledRun.advance

    def count() -> None:
        while not done.is_set():
            counted[0] += 1
            time.sleep(1e-3)

    def watched(run: CompiledRun, *given: Any) -> Any:
        before = counted[0]
        try:
            return advance(run, *given)
        finally:
            during[0] += counted[0] - before

    monkeypatch.setattr(CompiledRun, "advance", watched)
    mechanism = load("spatial_dead_point")
    thread = threading.Thread(target=count)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1000.0)  # s: who holds the lock is not asked for it
    thread.start()
    try:
        for _ in range(30):  # on a busy machine the other thread may miss some
            assert srm.simulate(mechanism, 20.0, rtol=1e-11, backend="kernel").success
            if during[0]:
                break
    finally:
        sys.setswitchinterval(interval)
        done.set()
        thread.join()
    assert during[0] > 0


def test_a_run_whose_controller_leads_back_to_it_is_collected() -> None:
    class Plant:
        solution: srm.Solution | None = None

        def __call__(self, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
            return np.zeros_like(v)

    plant = Plant()
    plant.solution = srm.simulate(load("four_bar"), 0.2, backend="kernel", controller=plant)
    plant.solution(0.1)
    alive = weakref.ref(plant)
    del plant
    gc.collect()
    assert alive() is None


def test_the_backend_is_named_and_can_be_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SRM_MBS_BACKEND", "python")
    assert srm.backend() == "python"
    assert srm.simulate(load("four_bar"), 0.1).settings.backend == "python"
    monkeypatch.setenv("SRM_MBS_BACKEND", "kernel")
    assert srm.backend() == "kernel"
    assert srm.simulate(load("four_bar"), 0.1).settings.backend == "kernel"
    monkeypatch.delenv("SRM_MBS_BACKEND")
    assert srm.backend() == "kernel"
    assert srm.simulate(load("four_bar"), 0.1, backend="python").settings.backend == "python"
    assert srm.simulate(load("four_bar"), 0.1, method="srm").settings.backend == "python"
    monkeypatch.setenv("SRM_MBS_BACKEND", "kernl")
    for asks in (srm.backend, partial(srm.simulate, load("four_bar"), 0.1)):
        with pytest.raises(srm.InputError, match="SRM_MBS_BACKEND = 'kernl' names no backend"):
            asks()


@pytest.mark.parametrize("name", [name for name, _ in MODELS])
def test_the_first_step_agrees(name: str) -> None:
    mechanism = load(name)
    system = make_system(mechanism)
    method = srm.PSRM()
    rng = np.random.default_rng(3)
    for span, rtol in ((10.0, 1e-3), (10.0, 1e-9), (1e-9, 1e-6)):
        norm = ErrorNorm(absolute_tolerance(mechanism, None, rtol), rtol)
        state = random_state(mechanism, rng)
        memory = method.start(system, 0.2, state, norm)
        expected = initial_step(system, state, memory, norm, span, 8, 0.2)
        run = CompiledRun(
            make_kernel_system(system),
            method,
            norm,
            state_struct(memory),
            state,
            smooth_intervals(np.zeros(0), np.zeros(0), 0.2, 0.2 + span),
            t0=0.2,
            step=None,
            first_step=None,
            max_step=np.inf,
            placed="automatic",
        )
        found = run.core.snapshot().control.h
        assert found == pytest.approx(expected, rel=1e-9 / min(1.0, memory.sigma) ** 2)
