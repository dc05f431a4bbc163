"""Linearised equations of stiff steps by generated code, against differences of the reference."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from benchmarks.work_precision.problems.stiff import friction
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.integration.generated import linearisation
from srm_mbs.integration.generated.code import load_code
from srm_mbs.integration.kernel import backend
from srm_mbs.integration.kernel.marshalling import CONSTANTS
from srm_mbs.integration.kernel.system import make_kernel_system
from srm_mbs.integration.methods.base import ErrorNorm
from srm_mbs.integration.methods.linear_split_step import LinearSplitStep, linearised
from srm_mbs.integration.methods.tableaus import get_tableau
from tests.support.bundled import load
from tests.support.dynamics import states_around
from tests.support.mechanisms import rod
from tests.support.stiff import bushed_four_bar

pytestmark = [
    pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}"),
    pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler"),
]


def _chain(*closures: srm.LoopClosure, forces: tuple[Any, ...] = ()) -> srm.Mechanism:
    """A hinge, a ball joint and a slider, one after the other."""
    rng = np.random.default_rng(5)
    model = pin.Model()
    joint = 0
    for i, kind in enumerate([pin.JointModelRX(), pin.JointModelSpherical(), pin.JointModelPY()]):
        at = pin.SE3(pin.rpy.rpyToMatrix(rng.uniform(-1, 1, 3)), rng.uniform(-1, 1, 3))
        joint = model.addJoint(joint, kind, at, f"j{i}")
        body = rod(rng.uniform(0.5, 2.0))
        body.lever = rng.uniform(-0.5, 0.5, 3)
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
        model.addBodyFrame(f"body_{i}", joint, pin.SE3.Identity(), 0)
    model.gravity.linear = np.array([0.3, -1.0, -9.0])
    return srm.Mechanism(model, closures, q0=pin.neutral(model), forces=forces)


_TIP = srm.Anchor("body_2", xyz=(0.1, 0.2, 0.3), rpy=(0.1, -0.4, 0.2))
_ROOT = srm.Anchor("body_0", xyz=(0.3, 0.0, 0.1), rpy=(0.3, 0.0, 0.1))
_SLOTTED = srm.LoopClosure("point_on_plane", _TIP, srm.Anchor("world"), axis=(0.6, 0.0, 0.8))
_CAM = srm.LoopClosure("coupling", joints=("j0", "j2"), polynomial=(0.1, -0.7, 0.3, 0.2))
FORCES = (
    srm.Bushing(
        _TIP,
        _ROOT,
        stiffness=(10.0, 0.0, 0.0, 1.0, 0.0, 3.0),
        damping=(1.0, 0.0, 0.0, 0.1, 0.0, 0.3),
    ),
    srm.SpringDamper(_TIP, _ROOT, stiffness=40.0, damping=3.0, rest_length=0.7),
)
OTHER_FORCES = (
    srm.SpringDamper(_TIP, srm.Anchor("world"), stiffness=40.0, damping=3.0, rest_length=0.0),
    srm.Wrench(
        srm.Anchor("body_1", xyz=(0.1, 0.0, 0.0)),
        force=(1.0, 2.0, 3.0),
        moment=(0.5, -1.0, 2.0),
        frame="link",
        law=srm.Sine(1.0, frequency_hz=2.0),
    ),
    srm.TorsionSpring("j0", stiffness=4.0, damping=0.3, rest_angle=0.2),
    srm.LimitSpring("j2", lower=-0.3, upper=0.2, stiffness=50.0, damping=2.0, depth=0.4),
    srm.CouplingSpring(("j0", "j2"), (1.0, -0.6), 30.0, 0.0, -0.2, slack=0.3, friction=2.0),
    srm.Bushing(_TIP, srm.Anchor("world"), stiffness=(0.0, 9.0, 0.0, 0.0, 2.0, 0.0)),
)


def _damped(mechanism: srm.Mechanism, name: str) -> srm.Mechanism:
    model = mechanism.model.copy()
    one = np.arange(model.nv) == model.joints[model.getJointId(name)].idx_v
    model.damping, model.friction = np.where(one, 3.0, 0.0), np.where(one, 0.5, 0.0)
    return replace(mechanism, model=model, friction_speed=0.7)


def _damped_everywhere(mechanism: srm.Mechanism, *forces: Any) -> srm.Mechanism:
    """More laws than the closures leave degrees of freedom: they are joined."""
    model = mechanism.model.copy()
    model.damping, model.friction = np.linspace(1.0, 3.0, model.nv), np.full(model.nv, 0.5)
    return replace(mechanism, model=model, forces=forces, friction_speed=0.7)


def _damped_four_bar() -> srm.Mechanism:
    mechanism = load("four_bar")
    return _damped_everywhere(
        mechanism,
        srm.SpringDamper(
            srm.Anchor("coupler", xyz=(0.7, 0.0, 0.2)),
            srm.Anchor("world", xyz=(0.3, 0.0, 2.5)),
            stiffness=40.0,
            damping=3.0,
            rest_length=0.7,
        ),
        srm.TorsionSpring(mechanism.joint_names[0], stiffness=4.0, damping=0.3, rest_angle=0.2),
    )


MECHANISMS: dict[str, Callable[[], srm.Mechanism]] = {
    "a bushing closes a loop": lambda: bushed_four_bar(1e-2),
    "the governor A05": lambda: load("flyball_governor"),
    "a slider-crank with friction": lambda: replace(friction().mechanism, friction_speed=0.3),
    "a walker with damping": lambda: _damped(load("klann_walker"), "O"),
    "an open chain": lambda: _chain(forces=FORCES),
    "a chain on a plane": lambda: _chain(_SLOTTED, forces=FORCES),
    "a walker with damping in all joints": lambda: _damped_everywhere(load("klann_walker")),
    "a four-bar with damping in all joints and springs": _damped_four_bar,
    "a chain with a cam": lambda: _damped(_chain(_CAM, forces=OTHER_FORCES), "j0"),
}


LARGE = {"a walker with damping", "a walker with damping in all joints", "a chain on a plane"}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.stress] if name in LARGE else [])
        for name in MECHANISMS
    ],
)
def test_the_linearised_equations_are_those_of_differences(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(linearisation, "MOST_STATEMENTS", 15_000)
    mechanism = MECHANISMS[name]()
    system = make_system(mechanism)
    monkeypatch.setattr(type(system), "derivatives", lambda *_: None)
    code = load_code(mechanism)
    generated, nv, n = make_kernel_system(system, code), system.nv, system.tangent_size
    assert code.linearises
    unit, step = np.ones(n), 2.0**-17
    norm = ErrorNorm(np.full(n, 1e-6), 1e-6)

    def rate(state: FloatArray) -> FloatArray:
        return system.evaluate(0.3, state, None).rate()[nv:].copy()

    for q, v in states_around(mechanism, 3):
        state = np.concatenate([q, v])
        J, of_laws, by_laws = (
            flat.reshape(n, -1).T if flat.size == n * n else flat
            for flat in generated.linearisation(CONSTANTS, 0.3, 1e-3, state, unit, np.abs(unit))
        )
        for j, d in enumerate(np.eye(n) * step):
            ahead, behind = rate(system.retract(state, d)), rate(system.retract(state, -d))
            size = max(np.abs(J).max(), 1.0)
            assert np.abs(J[nv:, j] - (ahead - behind) / (2.0 * step)).max() < 1e-7 * size
        memory = LinearSplitStep(get_tableau("rodas5p")).start(system, 0.3, state, norm)
        expected = linearised(system, 0.3, 1e-3, state, memory, norm, None)
        system.apply_laws(None)
        m = len(expected.laws)
        for own, other in (
            (of_laws.reshape(n, m).T, expected.by_coordinates),
            (by_laws.reshape(m, nv).T, expected.by_laws[nv:]),
            (J, expected.J),
        ):
            assert np.abs(own - other).max() < 1e-6 * max(np.abs(other).max(), 1.0)


RUNS: dict[str, tuple[Callable[[], srm.Mechanism], float]] = {
    "bushing": (lambda: bushed_four_bar(1e-6), 0.3),
    "governor": (lambda: load("flyball_governor"), 0.5),
    "friction": (lambda: friction().mechanism, 2.0),
    "damped joints": (_damped_four_bar, 1.0),
}


@pytest.mark.parametrize("name", RUNS)
def test_stiff_runs_by_generated_code_are_those_of_the_kernel(name: str) -> None:
    make, t_end = RUNS[name]
    mechanism = make()
    kernel, generated = (
        srm.simulate(mechanism, t_end, rtol=1e-7, tableau="rodas5p", backend=by)
        for by in ("kernel", "generated")
    )
    assert generated.settings.backend == "generated"
    assert abs(generated.stats.steps - kernel.stats.steps) <= 0.02 * kernel.stats.steps + 2
    assert generated.stats.evaluations <= kernel.stats.evaluations
    assert np.abs(generated.q[-1] - kernel.q[-1]).max() < 1e-6


def test_no_derivatives_are_generated_where_nothing_damps_and_where_they_are_too_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert not load_code(load("squeezing_mechanism")).linearises
    monkeypatch.setattr(linearisation, "MOST_STATEMENTS", 1000)
    too_many = _damped(load("watt_six_bar"), "crank")
    assert not load_code(too_many).linearises
    run = srm.simulate(too_many, 0.1, tableau="rodas5p", backend="generated")
    by_kernel = srm.simulate(too_many, 0.1, tableau="rodas5p", backend="kernel")
    assert np.abs(run.q[-1] - by_kernel.q[-1]).max() < 1e-6
