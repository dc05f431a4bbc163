"""Faults of the user's code, of the mechanism and of the settings: a partial solution, a message.

Nothing hangs: every test has a minute, and a run that crawls must say so.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rows import closure_errors
from tests.stress.patience import Patience
from tests.support.mechanisms import along_x, rod

pytestmark = [pytest.mark.stress, pytest.mark.timeout(60)]

MOST_STEPS = 10_000
"""Ten times what the runs below need; one that takes more crawls and is interrupted, so that its
status is not ``failed``."""

Controller = Callable[[float, FloatArray, FloatArray], Any]
PLANE = np.array([0.0, -1.0, 0.0])


def check_partial(solution: srm.Solution, *needles: str) -> None:
    """A failed run: its message, and everything computed so far in working order."""
    assert solution.status == "failed"
    assert not solution.success
    for needle in ("Stopped at t = ", *needles):
        assert needle in solution.message, solution.message
    assert np.isfinite(solution.q).all()
    assert np.isfinite(solution.v).all()
    assert solution.t[0] == 0.0
    assert len(solution.t) == len(solution.q) == len(solution.v) == solution.stats.steps + 1
    assert np.isfinite(solution.energy).all()
    assert gap(solution) <= 1e-9
    q, _ = solution(0.5 * solution.t[-1])
    assert np.isfinite(q).all()


def gap(solution: srm.Solution) -> float:
    """Largest closure error of all rows (m, rad)."""
    mechanism = solution.mechanism
    return float(
        np.abs(closure_errors(mechanism.model, mechanism.loops, solution.q, solution.v)[0]).max()
    )


def chain(lengths: tuple[float, ...], reach: float, q: tuple[float, ...]) -> srm.Mechanism:
    """Bars in the x-z plane from the origin, the last tip pinned at (reach, 0, 0)."""
    model = pin.Model()
    model.name = "chain"
    model.gravity.linear = np.array([0.0, 0.0, -9.81])
    parent, at = 0, 0.0
    for i, length in enumerate(lengths):
        joint = pin.JointModelRevoluteUnaligned(PLANE)
        parent = model.addJoint(parent, joint, along_x(at), f"joint_{i}")
        model.appendBodyToJoint(parent, rod(length, length), pin.SE3.Identity())
        model.addBodyFrame(f"bar_{i}", parent, pin.SE3.Identity(), 0)
        at = length
    tip = srm.Anchor(f"bar_{len(lengths) - 1}", xyz=(at, 0.0, 0.0))
    pin_ = srm.LoopClosure("point", tip, srm.Anchor("world", xyz=(reach, 0.0, 0.0)), name="pin")
    mechanism = srm.Mechanism(model, (pin_,), q0=np.array(q))
    state = srm.assemble(mechanism, mechanism.q0)
    return mechanism.with_state(state.q, state.v)


@pytest.fixture(scope="module")
def four_bar() -> srm.Mechanism:
    return srm.load("four_bar")


# --- controllers --------------------------------------------------------------------------------


def from_half_a_second(value: Any) -> Controller:
    return lambda t, q, v: value if t > 0.5 else np.zeros(len(v))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_controller_that_returns_no_number_ends_the_run_where_it_did(
    value: float, four_bar: srm.Mechanism
) -> None:
    solution = srm.simulate(four_bar, 2.0, controller=from_half_a_second([value, 0.0, 0.0]))
    check_partial(solution, "the controller returned", "values that are not finite", "3 finite")
    assert 0.1 < solution.t[-1] <= 0.5


@pytest.mark.parametrize(
    "value", [None, [1.0, 2.0], "x", {"elbow": 1.0}, [None, 0.0, 0.0], np.zeros((3, 2))]
)
def test_a_controller_that_returns_something_else_ends_the_run(
    value: Any, four_bar: srm.Mechanism
) -> None:
    check_partial(srm.simulate(four_bar, 2.0, controller=from_half_a_second(value)), "controller")


@pytest.mark.parametrize("error", [ValueError("no torque"), ZeroDivisionError(), MemoryError()])
def test_a_controller_that_raises_ends_the_run_with_its_words(
    error: Exception, four_bar: srm.Mechanism
) -> None:
    def controller(t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        if t > 0.5:
            raise error
        return np.zeros(3)

    solution = srm.simulate(four_bar, 2.0, controller=controller)
    check_partial(solution, "the controller raised", type(error).__name__, str(error))
    with pytest.raises(srm.SimulationError) as caught:
        srm.simulate(four_bar, 2.0, controller=controller, raise_on_failure=True)
    assert caught.value.solution.t[-1] == solution.t[-1]


@pytest.mark.parametrize("size", [1e30, 1e150, 1e300])
@pytest.mark.parametrize("since", [0.5, -1.0])
def test_an_absurd_torque_ends_the_run(size: float, since: float, four_bar: srm.Mechanism) -> None:
    solution = srm.simulate(
        four_bar, 2.0, controller=lambda t, q, v: [size if t > since else 0.0, 0.0, 0.0]
    )
    check_partial(solution)
    assert solution.t[-1] == pytest.approx(max(since, 0.0), abs=1e-9)


def test_a_controller_that_writes_into_its_arguments_changes_nothing(
    four_bar: srm.Mechanism,
) -> None:
    def controller(t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        q[:], v[:] = 7.0, -7.0
        return np.zeros(3)

    solution = srm.simulate(four_bar, 1.0, controller=controller)
    assert np.array_equal(solution.q, srm.simulate(four_bar, 1.0).q)


@pytest.mark.parametrize("size", [1e6, 1e12])
def test_a_torque_of_noise_ends_the_run_instead_of_crawling(
    size: float, four_bar: srm.Mechanism
) -> None:
    """No step is short enough for its error, or steps are so short that the end is out of reach."""
    rng = np.random.default_rng(0)
    solution = srm.simulate(
        four_bar,
        2.0,
        controller=lambda t, q, v: size * rng.standard_normal(3),
        progress=Patience(MOST_STEPS),
    )
    check_partial(solution)


# --- motions that are impossible ------------------------------------------------------------------


def test_a_torque_cannot_push_a_double_rocker_beyond_its_reach() -> None:
    """The crank of this four-bar reaches no further than coupler and rocker in line: it bounces."""
    mechanism = chain((1.0, 1.0, 1.5), 2.2, (1.0, -1.0, -1.0))
    torque = 30.0
    solution = srm.simulate(
        mechanism, 5.0, rtol=1e-8, controller=lambda t, q, v: [torque, 0.0, 0.0]
    )
    assert solution.success
    assert gap(solution) <= 1e-9
    angle, rate = solution.joint("joint_0")
    # Law of cosines: bars 1 and 2 in line span 2.5 m from the crank's tip to the pin.
    limit = np.pi - np.arccos((2.5**2 - 1.0 - 2.2**2) / (2.0 * 2.2))
    assert limit - 0.1 < np.abs(angle).max() <= limit + 1e-6
    assert (np.sign(rate[1:]) != np.sign(rate[:-1])).sum() >= 3
    work = torque * (angle - angle[0])
    assert np.abs(solution.energy - solution.energy[0] - work).max() < 1e-5 * np.abs(work).max()


def test_a_torque_moves_no_truss() -> None:
    """Two bars and two pins: no degree of freedom."""
    mechanism = chain((1.0, 1.0), 1.5, (0.7, -1.4))
    assert mechanism.degrees_of_freedom == 0
    solution = srm.simulate(mechanism, 2.0, controller=lambda t, q, v: [1e6, -1e6])
    assert solution.success
    assert np.abs(solution.q - mechanism.q0).max() < 1e-12


def test_closures_that_contradict_each_other_are_refused_with_their_gaps() -> None:
    mechanism = srm.load("four_bar")
    other = srm.LoopClosure(
        "point", srm.Anchor("rocker", xyz=(1.5, 0.0, 0.0)), srm.Anchor("world", xyz=(9.0, 0.0, 0.0))
    )
    impossible = srm.Mechanism(mechanism.model, (*mechanism.loops, other), q0=mechanism.q0)
    with pytest.raises(srm.AssemblyError) as caught:
        srm.assemble(impossible)
    assert set(caught.value.residuals) == {"pin", other.name}
    with pytest.raises(srm.InputError, match="violates the closures"):
        srm.simulate(impossible, 1.0)


@pytest.mark.parametrize("lengths", [(1.0, 1.0), (1.0, 1.0, 1.0), (1.0, 2.0, 0.5, 1.0)])
def test_a_chain_stretched_to_its_reach_is_locked(lengths: tuple[float, ...]) -> None:
    """Its closed configuration is isolated: gravity must not pull the loop open."""
    mechanism = chain(lengths, sum(lengths), (0.0,) * len(lengths))
    if lengths == (1.0, 2.0, 0.5, 1.0):  # known at the start to rest on a singular configuration
        with pytest.raises(srm.InputError, match="singular configuration"):
            srm.simulate(mechanism, 2.0)
        return
    solution = srm.simulate(mechanism, 2.0)
    assert gap(solution) <= 1e-9
    assert np.abs(solution.q).max() < 1e-6
    if not solution.success:
        check_partial(solution)


@pytest.mark.parametrize("slack", [1e-4, 1e-6, 1e-10])
def test_a_chain_almost_stretched_to_its_reach_rattles(slack: float) -> None:
    """Its closed configurations are a circle of some sqrt(slack) rad, close to a singular point."""
    size = np.sqrt(slack)
    mechanism = chain((1.0, 1.0, 1.0), 3.0 - slack, (0.5 * size, -size, 0.5 * size))
    period = np.sqrt(size)
    solution = srm.simulate(mechanism, 2.0 * period, rtol=1e-8)
    assert solution.success
    assert gap(solution) <= 1e-9
    assert np.abs(solution.q).max() < 10.0 * size
    kinetic = solution.energy[0] - min(solution.energy[0] - 9.81 * size, solution.energy.min())
    # sigma is about sqrt(slack): rounding enters as eps over its square.
    assert np.ptp(solution.energy) < max(1e-8, 10.0 * np.finfo(float).eps / slack) * kinetic


@pytest.mark.parametrize("damping", [2.0, 8.0])
def test_a_swing_that_dies_out_in_a_singular_configuration_rests_there(damping: float) -> None:
    """Momentum is lost on the spot where the branches cross: the last place to be without.

    The run may end there with a message; it may not change its branch, nor gain energy.
    """
    solution = srm.simulate(
        srm.load("slider_crank"), 60.0, controller=lambda t, q, v: [-damping * v[0], 0.0]
    )
    energy = solution.energy
    lost = energy[0] - energy.min()
    assert (energy - np.minimum.accumulate(energy)).max() <= 1e-5 * lost
    q, v = solution(np.linspace(0.0, solution.t[-1], 2001))
    assert np.abs(q[:, 1] + 2.0 * q[:, 0]).max() < 1e-3
    assert np.abs(v[:, 1] + 2.0 * v[:, 0]).max() < 1e-3
    assert q[-1, 0] == pytest.approx(1.5 * np.pi, abs=1e-2)
    if not solution.success:
        check_partial(solution, "singular configuration")


# --- settings -----------------------------------------------------------------------------------


@pytest.mark.parametrize("setting", ["first_step", "max_step", "step"])
@pytest.mark.parametrize("value", [1e-300, 1e-16, 1e-14])
def test_a_step_below_round_off_is_named_as_such(
    setting: str, value: float, four_bar: srm.Mechanism
) -> None:
    options: dict[str, Any] = {setting: value}
    solution = srm.simulate(four_bar, 2.0, **options)
    check_partial(solution, "round-off")
    assert solution.t[-1] == 0.0


@pytest.mark.parametrize("name", ["slider_crank", "parallelogram", "four_bar"])
@pytest.mark.parametrize("tableau", ["tvd32", "dopr54", "dop853"])
def test_tolerances_at_their_floor_end_in_finite_time(name: str, tableau: str) -> None:
    mechanism = srm.load(name)
    t_end = 0.02 if tableau == "tvd32" else 2.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", srm.SrmWarning)  # rtol is raised to round-off
        solution = srm.simulate(
            mechanism, t_end, tableau=tableau, rtol=1e-300, progress=Patience(MOST_STEPS)
        )
    assert gap(solution) <= 1e-9
    if not solution.success:
        check_partial(solution)


def test_an_absolute_tolerance_of_nothing_ends_with_a_message(four_bar: srm.Mechanism) -> None:
    solution = srm.simulate(four_bar, 1.0, rtol=1e-8, atol=1e-300)
    if not solution.success:
        check_partial(solution)
