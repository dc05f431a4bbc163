"""Starts on, and next to, singular configurations."""

from __future__ import annotations

import re
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.singularities.branch_limit import branch_limit, branch_next_to
from srm_mbs.dynamics.singularities.local_analysis import (
    nearest_singular,
)
from srm_mbs.integration import singular_endpoints
from tests.support import reduced, slider_crank
from tests.support.backends import on_both
from tests.support.bundled import load
from tests.support.convergence import fitted_order
from tests.support.mechanisms import ball_dead_point, distance, floating_slider_crank
from tests.support.reduced import error_at_end
from tests.support.singularities import singular_at
from tests.support.slider_crank import state
from tests.support.snapshots import check_messages, refused

PI = np.pi
LOWEST = 1.5 * PI
"""Crank angle of slider_crank at its lower singular configuration."""


def parallel(n: int, rate: float) -> list[float]:
    """Rates, or angles, of the N-four-bar (N = 1: the parallelogram) moving as parallelograms."""
    return [rate] + [-rate, rate] * n


def simulated(
    mechanism: Mechanism | str, t_end: float, tol: float = 1e-10, **options: Any
) -> srm.Solution:
    mechanism = load(mechanism) if isinstance(mechanism, str) else mechanism
    return srm.simulate(mechanism, t_end, rtol=tol, atol=tol, **options)


# --- exactly there ------------------------------------------------------------------------------


@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
@pytest.mark.parametrize("rate", ["1.0", "-0.5"])
def test_a_slider_crank_starts_upright_with_momentum(
    rate: str, tableau: str, exact: dict[str, Any]
) -> None:
    data = exact["slidercrank"]["start_at_singular th1=3pi/2"][f"omega0={rate},t=10"]
    solution = simulated("slider_crank", 10.0, **state(LOWEST, float(rate)), tableau=tableau)
    assert solution.success
    end = [solution.q[-1, 0], solution.v[-1, 0]]
    assert end == pytest.approx([float(x) for x in data], abs=1e-8)


def test_the_other_branch_of_the_slider_crank_is_followed_as_well() -> None:
    """The rod lies on the crank: one rigid pendulum of two bars, (8/3) a'' = -2 g cos a."""
    solution = simulated("slider_crank", 3.0, q0=[LOWEST, -2.0 * LOWEST], v0=[1.0, 0.0])

    def pendulum(t: float, y: Any) -> list[float]:
        return [y[1], -0.75 * reduced.G * np.cos(y[0])]

    assert error_at_end(solution, pendulum, [LOWEST, 1.0]) < 1e-8
    assert np.abs(solution.q[:, 1] + 3.0 * PI).max() < 1e-8


def test_a_parallelogram_starts_stretched_out() -> None:
    solution = simulated("parallelogram", 3.0, 1e-9, q0=parallel(1, 0.0), v0=parallel(1, 6.0))
    assert error_at_end(solution, reduced.parallelogram(), [0.0, 6.0]) < 1e-8


@pytest.mark.parametrize("n", [1, 2, 5])
def test_an_n_four_bar_starts_where_it_has_lost_n_rows(n: int) -> None:
    mechanism = load(f"n_four_bar_{n}")
    solution = simulated(mechanism, 2.0, 1e-9, q0=parallel(n, 0.0), v0=parallel(n, -4.0))
    assert error_at_end(solution, reduced.n_four_bar(n), [0.0, -4.0]) < 1e-8
    cranks = [mechanism.joint(f"crank_{i}").idx_q for i in range(n + 1)]
    assert np.abs(solution.q[:, cranks] - solution.q[:, :1]).max() < 1e-8


def test_a_spatial_mechanism_starts_in_its_dead_point_while_its_rod_spins() -> None:
    mechanism = load("spatial_dead_point")
    start = srm.assemble(
        mechanism,
        {"crank": 2.0 * PI / 3.0},
        {"crank": 4.0, "rod": 6.4, "rod_spin": -3.0},
        guess={"rod_sideways": 2.5, "rod": 0.0},
    )
    assert start.singular
    solution = simulated(mechanism, 2.0, 1e-9, q0=start.q, v0=start.v)
    expected = reduced.integrate(reduced.spatial_dead_point(), [PI / 2.0, 4.0], 2.0)
    assert solution.success
    assert solution.q[-1, 0] - PI / 6.0 == pytest.approx(expected[0], abs=1e-6)
    assert solution.v[-1, 0] == pytest.approx(expected[1], abs=1e-6)


def test_a_ball_joint_starts_in_a_dead_point_to_round_off() -> None:
    solution = simulated(ball_dead_point(PI / 2.0, 4.0), 0.3, 1e-12)
    assert error_at_end(solution, reduced.spatial_dead_point(), [PI / 2.0, 4.0]) < 1e-11


def test_a_free_flying_mechanism_starts_as_one_that_passes_there() -> None:
    """Without forces motions are reversible: the way back passes the start and goes on."""
    start = floating_slider_crank()
    there = simulated(start, 0.6, 1e-11)
    assert there.success
    back = simulated(start, 0.9, 1e-11, q0=there.q[-1], v0=-there.v[-1])
    q, v = back(0.6)
    assert np.abs(pin.difference(start.model, q, start.q0)).max() < 1e-8
    assert np.abs(v + start.v0).max() < 1e-8
    assert len(back.crossings) == 1
    before = simulated(start, 0.3, 1e-11, v0=-start.v0)
    assert np.abs(pin.difference(start.model, back.q[-1], before.q[-1])).max() < 1e-8
    assert np.abs(back.v[-1] - before.v[-1]).max() < 1e-8


def test_the_motion_does_not_depend_on_the_frame_of_a_free_base() -> None:
    first = floating_slider_crank()
    turned = floating_slider_crank(turn=(0.4, -1.1, 0.7))
    a, b = simulated(first, 1.0), simulated(turned, 1.0)
    assert a.success
    assert b.success
    assert np.abs(a.q[-1, 7:] - b.q[-1, 7:]).max() < 1e-8
    assert np.abs(a.v[-1] - b.v[-1]).max() < 1e-8


def test_momentum_and_energy_are_kept_from_a_free_singular_start() -> None:
    mechanism = floating_slider_crank()
    solution = simulated(mechanism, 1.0)
    data = mechanism.model.createData()
    momenta = []
    for q, v in zip(solution.q, solution.v):
        h = pin.computeCentroidalMomentum(mechanism.model, data, q, v)
        momenta.append(h.vector)
    assert np.abs(np.array(momenta) - momenta[0]).max() < 1e-8
    assert np.abs(solution.energy / solution.energy[0] - 1.0).max() < 1e-9


# --- redundant and singular at once -------------------------------------------------------------


def closed_twice(kind: str) -> Mechanism:
    base = load("parallelogram")
    (loop,) = base.loops
    loops = {
        "same point again": (loop, srm.LoopClosure("point", loop.a, loop.b, name="again")),
        "hinge": (srm.LoopClosure("revolute", loop.a, loop.b, (0.0, 1.0, 0.0), name="hinge"),),
        # a point beyond the pin, on the coupler's and rocker's common pivot axis
        "two points of the pivot": (
            loop,
            srm.LoopClosure(
                "point",
                srm.Anchor("coupler", xyz=(2.0, 0.3, 0.0)),
                srm.Anchor("rocker", xyz=(1.0, 0.3, 0.0)),
                name="beyond",
            ),
        ),
    }[kind]
    return srm.Mechanism(base.model, loops, q0=base.q0, v0=base.v0, name="closed_twice")


@pytest.mark.parametrize("kind", ["same point again", "hinge", "two points of the pivot"])
def test_redundant_closures_start_singular_as_well(kind: str) -> None:
    mechanism = closed_twice(kind)
    assert mechanism.degrees_of_freedom == 1
    solution = simulated(mechanism, 2.0, 1e-9, q0=parallel(1, 0.0), v0=parallel(1, 6.0))
    assert error_at_end(solution, reduced.parallelogram(), [0.0, 6.0]) < 1e-7
    assert np.abs(solution.q[:, 2] - solution.q[:, 0]).max() < 1e-8


# --- next to it ---------------------------------------------------------------------------------

NEXT_TO = [1e-3, -3e-4, 1e-4, 1e-5, -1e-6, 1e-7, 1e-8, -1e-9, 1e-10, 1e-12]


@pytest.mark.parametrize("away", NEXT_TO)
def test_starts_next_to_a_singular_configuration_are_as_exact_as_others(away: float) -> None:
    solution = simulated("slider_crank", 2.0, **state(LOWEST + away, 1.0))
    assert slider_crank.error(solution, [LOWEST + away, 1.0]) < 1e-9


@pytest.mark.parametrize("away", NEXT_TO)
def test_starts_next_to_a_dead_point_on_a_curved_branch_are_exact_too(away: float) -> None:
    angle = PI / 2.0 + away
    solution = simulated(ball_dead_point(angle, 4.0), 0.3)
    assert error_at_end(solution, reduced.spatial_dead_point(), [angle, 4.0]) < 1e-8


@pytest.mark.parametrize("away", [1e-3, 1e-5, 1e-6, 1e-7])
@pytest.mark.parametrize("ratio", [-2.0, 0.0])
def test_assembled_rates_belong_to_the_branch_next_to_its_end(away: float, ratio: float) -> None:
    theta = LOWEST + away
    rod = -2.0 * theta if ratio else -3.0 * PI
    start = srm.assemble(load("slider_crank"), {"crank": theta}, {"crank": 1.0}, guess={"rod": rod})
    assert start.v[1] == pytest.approx(ratio, abs=1e-9)
    assert srm.simulate(load("slider_crank"), 0.1, q0=start.q, v0=start.v).success


@pytest.mark.parametrize("away", [1e-3, pytest.param(1e-5, marks=pytest.mark.stress)])
def test_a_mechanism_is_released_from_rest_next_to_a_singular_configuration(away: float) -> None:
    """Upright it falls, away from it by a factor of 2 in the first second: a slow start."""
    theta = 0.5 * PI + away
    solution = srm.simulate(load("slider_crank"), 1.0, **state(theta, 0.0), rtol=1e-10, atol=1e-14)
    assert slider_crank.error(solution, [theta, 0.0]) < 1e-8 * away


def test_a_slow_start_leaves_the_singular_configuration_on_its_branch() -> None:
    start = [0.5 * PI, 1e-3]
    solution = srm.simulate(load("slider_crank"), 3.0, **state(*start), rtol=1e-10, atol=1e-14)
    assert abs(solution.q[-1, 0] - 0.5 * PI) > 0.01
    assert slider_crank.error(solution, start) < 1e-8


def test_sweeps_refuse_a_start_that_stays_next_to_a_singular_configuration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Hanging, a slider-crank swings through the singular configuration by 1e-6 rad."""
    monkeypatch.setattr("srm_mbs.integration.singular_endpoints.DEPARTURE_BLOCKS", 3)
    with pytest.raises(srm.InputError, match="does not leave"):
        srm.simulate(load("slider_crank"), 20.0, method=srm.SRM(), **state(LOWEST, 1e-6))


def test_a_start_that_stays_next_to_a_singular_configuration_swings_there() -> None:
    start = [LOWEST, 1e-6]
    solution = srm.simulate(load("slider_crank"), 20.0, **state(*start), rtol=1e-8, atol=1e-12)
    assert slider_crank.error(solution, start) < 1e-10


# --- orders -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tableau", "steps"),
    [
        ("trap", (2e-2, 1e-2, 5e-3)),
        ("tvd32", (2e-2, 1e-2, 5e-3)),
        ("erk4", (2e-2, 1e-2, 5e-3)),
        ("dopr54", (4e-2, 2e-2, 1e-2)),
    ],
)
def test_fixed_steps_from_a_singular_start_have_the_order_of_the_tableau(
    tableau: str, steps: tuple[float, ...]
) -> None:
    errors = []
    for h in steps:
        start, method = state(LOWEST, 2.0), srm.PSRM(tableau)
        solution = srm.simulate(load("slider_crank"), 0.4, **start, method=method, step=h)
        errors.append(slider_crank.error(solution, [LOWEST, 2.0]))
    assert fitted_order(steps, errors) == pytest.approx(srm.TABLEAUS[tableau].order, abs=0.35)


def test_the_order_is_kept_on_a_curved_branch() -> None:
    """There the stages, which lie off the branch, would see other constraint normals."""
    steps, errors = (0.02, 0.01, 0.005), []
    start = ball_dead_point(PI / 2.0, 2.0)
    for h in steps:
        solution = srm.simulate(start, 0.3, method=srm.PSRM("dopr54"), step=h)
        errors.append(error_at_end(solution, reduced.spatial_dead_point(), [PI / 2.0, 2.0]))
    assert fitted_order(steps, errors) > 4.8


@pytest.mark.parametrize(
    "method",
    [
        srm.SRM("erk4", iterations=4, eps="h", restart=False),
        srm.PSRM("dopr54", correction="sweep", eps=0.1),
        srm.PSRM("dopr54", correction="fused", eps=0.1),
    ],
    ids=["SRM", "two sweeps", "fused"],
)
def test_other_methods_start_there_too(method: Any) -> None:
    start = state(LOWEST, 2.0)
    solution = srm.simulate(load("slider_crank"), 0.4, **start, method=method, step=5e-3)
    assert slider_crank.error(solution, [LOWEST, 2.0]) < 1e-3


# --- refusals -----------------------------------------------------------------------------------


def test_starts_from_which_the_motion_is_not_determined_are_refused_with_their_branches() -> None:
    """G v vanishes there for every crank and rod rate.  Next to it the closure rates are 1e-9
    rad/s: only the branch tells that this is no motion.  On a floating base the base moves."""
    crank, floating = load("slider_crank"), floating_slider_crank()
    assembled = srm.assemble(crank, {"crank": LOWEST}, guess={"rod": -2.0 * LOWEST})
    q = [LOWEST, -2.0 * LOWEST]
    beside = [LOWEST + 1e-9, -2.0 * (LOWEST + 1e-9)]
    base = np.zeros(floating.model.nv)
    base[:6] = 1.0
    cases: dict[str, tuple[Mechanism, dict[str, Any]]] = {
        "at rest": (crank, {"q0": assembled.q, "v0": assembled.v}),
        "between the branches": (crank, {"q0": q, "v0": [1.0, -1.5]}),
        "off the branch next to it": (crank, {"q0": beside, "v0": [1.0, -1.0]}),
        "only its base moves": (floating, {"v0": base}),
    }
    messages = {}
    for case, (mechanism, start) in cases.items():
        message = refused(partial(srm.simulate, mechanism, 1.0, **start))
        if mechanism is crank:
            assert "(crank 0.4472, rod -0.8944)" in message
            assert "(crank 1)" in message
        # The order of the branches is of no importance.
        messages[case] = re.sub(r"(?<=in the ratios ).*(?=\. Give)", "...", message)
    check_messages("singular_starts", messages)


# --- the analysis behind it ---------------------------------------------------------------------


CASES: dict[str, Any] = {
    "slider-crank": lambda: (load("slider_crank"), [1.5 * PI + 0.05, -3.0 * PI - 0.1]),
    "parallelogram": lambda: (load("parallelogram"), [0.1, -0.1, 0.1]),
    "closed twice": lambda: (closed_twice("same point again"), [0.1, -0.1, 0.1]),
    "hinge": lambda: (closed_twice("hinge"), [0.1, -0.1, 0.1]),
    "N = 3": lambda: (load("n_four_bar_3"), parallel(3, 0.1)),
    "ball": lambda: (ball_dead_point(PI / 2.0), ball_dead_point(PI / 2.0 + 0.1).q0),
    "free flyer": lambda: (floating_slider_crank(), floating_slider_crank(away=0.1).q0),
}


@pytest.mark.parametrize("case", CASES)
def test_the_nearest_singular_configuration_is_closed_and_singular(case: str) -> None:
    mechanism, q = CASES[case]()
    singular = singular_at(mechanism, q)
    geometry = singular.geometry
    g, _ = geometry.closure(singular.q)
    values = np.linalg.svd(geometry.normalised(singular.q), compute_uv=False)
    assert np.abs(g).max() < 1e-14
    assert values[mechanism.structure.rank - 1] < 1e-12
    assert np.abs(geometry.difference(np.asarray(q), singular.q)).max() < 0.3


@pytest.mark.parametrize("case", CASES)
def test_hessians_are_the_derivatives_of_the_jacobian(case: str) -> None:
    singular = singular_at(*CASES[case]())
    geometry = singular.geometry
    u = np.random.default_rng(1).standard_normal(len(geometry.unit))
    tau = 1e-5
    ahead = geometry.normalised(geometry.move(singular.q, tau * u))
    behind = geometry.normalised(geometry.move(singular.q, -tau * u))
    expected = singular.left.T @ (ahead - behind) / (2.0 * tau)
    np.testing.assert_allclose(singular.hessians(u), expected, atol=1e-8)
    for a, n in enumerate(singular.null.T):
        np.testing.assert_allclose(
            singular.forms[:, a], singular.hessians(n) @ singular.null, atol=1e-12
        )


@pytest.mark.parametrize("case", CASES)
def test_the_third_derivative_is_that_of_the_bias_along_a_constant_velocity(case: str) -> None:
    singular = singular_at(*CASES[case]())
    geometry = singular.geometry
    u = 3.0 * np.random.default_rng(2).standard_normal(len(geometry.unit))
    tau = 1e-5
    ahead = geometry.bias(geometry.move(singular.q, tau * u), u)
    behind = geometry.bias(geometry.move(singular.q, -tau * u), u)
    expected = singular.left.T @ (ahead - behind) / (2.0 * tau)
    scale = max(1.0, float(np.abs(expected).max()))
    np.testing.assert_allclose(singular.third_derivative(u), expected, atol=1e-7 * scale)


@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-8, 1e-6, 1e-4, 1e-3])
def test_the_limit_of_the_algebra_gives_the_exact_acceleration(away: float) -> None:
    angle = PI / 2.0 + away
    mechanism = ball_dead_point(angle, 4.0)
    singular = singular_at(mechanism, mechanism.q0)
    limit = branch_limit(singular, mechanism.q0, mechanism.v0)
    assert limit is not None
    model = mechanism.model
    data = model.createData()
    free = pin.aba(model, data, mechanism.q0, mechanism.v0, np.zeros(model.nv))
    acceleration = (free - limit.multiplier(mechanism.v0, free))[0]
    expected = reduced.spatial_dead_point()(0.0, [angle, 4.0])[1]
    assert acceleration == pytest.approx(expected, abs=1e-9)
    assert np.abs(limit.projector @ mechanism.v0).max() < 1e-9


def test_the_limit_formula_is_exact_on_the_configuration_itself() -> None:
    mechanism = ball_dead_point(PI / 2.0, 4.0)
    singular = singular_at(mechanism, mechanism.q0)
    free = pin.aba(
        mechanism.model,
        mechanism.model.createData(),
        mechanism.q0,
        mechanism.v0,
        np.zeros(mechanism.model.nv),
    )
    acceleration = singular.limit_acceleration(mechanism.v0, free)
    assert acceleration is not None
    expected = reduced.spatial_dead_point()(0.0, [PI / 2.0, 4.0])[1]
    assert acceleration[0] == pytest.approx(expected, abs=1e-11)


@pytest.mark.parametrize(
    ("case", "rows", "nullity"),
    [
        ("slider-crank", {"pin.normal"}, 1),
        ("parallelogram", {"pin.x"}, 1),
        ("closed twice", {"pin.x", "again.x"}, 1),
        ("hinge", {"hinge.x"}, 1),
        ("N = 3", {"pin_0.x", "pin_1.x", "pin_2.x"}, 3),
        ("ball", {"rail.normal_1", "rail.normal_2"}, 1),
    ],
)
def test_the_rows_that_lose_rank_are_named_and_redundant_ones_are_not(
    case: str, rows: set[str], nullity: int
) -> None:
    singular = singular_at(*CASES[case]())
    involved = singular.participants
    assert set(involved.rows) == rows
    assert involved.loops == tuple(dict.fromkeys(row.partition(".")[0] for row in involved.rows))
    assert singular.nullity == nullity


def test_far_from_singular_configurations_none_is_found() -> None:
    mechanism = load("four_bar")
    geometry = ClosureGeometry(mechanism, mechanism.q0)
    assert nearest_singular(geometry, mechanism.q0, mechanism.structure.rank, 0.3) is None


def test_starts_give_the_same_motion_as_a_run_that_passes_there() -> None:
    """Slider-crank at 3 rad/s: what passes 3 pi / 2 and what starts there."""
    passing = simulated("slider_crank", 1.0, 1e-11, **state(LOWEST - 0.5, 3.0))
    times = np.linspace(0.0, 1.0, 2001)
    angles = passing(times)[0][:, 0]
    t0 = float(np.interp(LOWEST, angles, times))
    for _ in range(5):
        q, v = passing(t0)
        t0 -= float((q[0] - LOWEST) / v[0])
    rate = float(passing(t0)[1][0])
    started = simulated("slider_crank", 1.0 - t0, 1e-11, **state(LOWEST, rate))
    assert distance(load("slider_crank"), passing, started) < 1e-8


def folded(t: float, y: Any) -> list[float]:
    """Equal bars of 2 m and 1 kg that turn as one body: (8/3) theta'' = -2 g cos theta."""
    return [y[1], -0.75 * reduced.G * float(np.cos(y[0]))]


@on_both
@pytest.mark.parametrize("speed", [1e-4, 1e-2])
@pytest.mark.parametrize("branch", ["stretched", "folded"])
def test_a_slow_start_costs_one_curve_on_its_branch_and_is_exact(
    branch: str, speed: float, backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hanging on the singular configuration, which the motion does not leave before the end."""
    mechanism = load("slider_crank")
    found: list[Any] = []

    def counted(*arguments: Any) -> Any:
        found.append(branch_next_to(*arguments))
        return found[-1]

    monkeypatch.setattr(singular_endpoints, "branch_next_to", counted)
    theta, t_end = 1.5 * np.pi, 0.7
    rates = [speed, 0.0] if branch == "folded" else [speed, -2.0 * speed]
    run = srm.simulate(
        mechanism, t_end, q0=[theta, -3.0 * np.pi], v0=rates, rtol=1e-9, backend=backend
    )
    assert run.success, run.message
    field = folded if branch == "folded" else reduced.slider_crank()
    exact = reduced.integrate(field, [theta, speed], t_end)
    assert run.q[-1, 0] == pytest.approx(exact[0], abs=1e-8 * speed + 1e-14)
    assert run.v[-1, 0] == pytest.approx(exact[1], abs=1e-8 * speed + 1e-14)
    # One for the start and one for the end, which lies next to it as well.
    assert len(found) <= 2
