"""Mechanisms whose branches almost cross: the motion follows the data.

The slider-crank of bars 2 and 2 + d avoids its singular configurations.  The reference integrates
its time over the angle that turns monotonically, by the conservation of energy, on panels that
resolve the corner: no closures, no Pinocchio.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.constraints.geometry import geometry_of
from srm_mbs.dynamics.singularities.critical import critical_configuration
from tests.support.backends import needs_kernel
from tests.support.bundled import load

START, SPEED, T_END = 0.3, 8.0, 5.0
INERTIA = 0.3333333333333333
OFFSETS = [sign * 10.0**-k for k in range(1, 13) for sign in (1, -1)]
GRID = [("kernel", d) for d in OFFSETS] + [("python", d) for d in OFFSETS[::5]]
"""The twin runs of the reference are slow, and compared step by step elsewhere."""


def slider_crank(d: float) -> srm.Mechanism:
    ideal = load("slider_crank")
    pin = replace(ideal.loops[0], a=srm.Anchor("rod", xyz=(2.0 + d, 0.0, 0.0)))
    mechanism = srm.Mechanism(ideal.model, (pin,))
    state = srm.assemble(mechanism, {"crank": START}, {"crank": SPEED}, guess={"rod": -2.0 * START})
    return mechanism.with_state(state.q, state.v)


class Reference:
    """Energy integral of the slider-crank: angles of crank and rod against the ground."""

    def __init__(self, d: float) -> None:
        crank, rod = 2.0, 2.0 + d
        self.by_crank = rod > crank
        self.short, self.long = min(crank, rod), max(crank, rod)
        self.width = np.sqrt(2.0 * (self.long - self.short))
        rod_angle = -np.arcsin(crank * np.sin(START) / rod)
        self.start = START if self.by_crank else rod_angle
        mass, potential, rates = self.terms(np.array(self.start))
        speed = SPEED / float(rates[0])
        self.energy = 0.5 * float(mass) * speed**2 + float(potential)
        self.sign = float(np.sign(speed))

    def terms(self, x: Any) -> tuple[Any, Any, tuple[Any, Any]]:
        """m, V and the rates of both angles for the rate 1 of the monotone angle x."""
        ratio = self.short / self.long
        difference = (self.long - self.short) * (self.long + self.short) / self.long**2
        cosine = np.sqrt(difference + (ratio * np.cos(x)) ** 2)
        other, rate = -np.arcsin(ratio * np.sin(x)), -ratio * np.cos(x) / cosine
        one = np.ones_like(rate)
        theta, psi, dtheta, dpsi = (x, other, one, rate) if self.by_crank else (other, x, rate, one)
        vx = -2.0 * np.sin(theta) * dtheta - np.sin(psi) * dpsi
        vz = 2.0 * np.cos(theta) * dtheta + np.cos(psi) * dpsi
        mass = (1.0 + INERTIA) * dtheta**2 + vx**2 + vz**2 + INERTIA * dpsi**2
        return mass, 9.81 * (3.0 * np.sin(theta) + np.sin(psi)), (dtheta, dpsi)

    def time(self, end: float) -> float:
        """Time (s) from the start to the monotone angle ``end``."""
        low, high = sorted((self.start, end))
        corners = np.pi / 2 + np.pi * np.arange(
            np.floor(low / np.pi) - 1, np.ceil(high / np.pi) + 1
        )
        graded = 0.5 * 0.6 ** np.arange(0, 4 + max(0, int(np.log(0.5 / self.width) / 0.5)))
        edges = np.concatenate([(corners[:, None] + s * graded).ravel() for s in (-1.0, 1.0)])
        edges = np.unique(np.concatenate([edges, corners, corners + np.pi / 2, [low, high]]))
        edges = edges[(edges >= low) & (edges <= high)]
        x, w = np.polynomial.legendre.leggauss(16)
        middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
        mass, potential, _ = self.terms(middle[:, None] + half[:, None] * x)
        return float(half @ (np.sqrt(mass / (2.0 * (self.energy - potential))) @ w))

    def error(self, solution: srm.Solution) -> float:
        """Largest error of angles and rates at the end of a run."""
        return max(self.errors(float(solution.t[-1]), solution.q[-1], solution.v[-1]))

    def errors(self, t: float, q: Any, v: Any) -> tuple[float, float]:
        """Error of the time at the angle at t, times the rates, and largest one of the rates
        there."""
        angles = np.array([q[0], q[0] + q[1]])
        rates = np.array([v[0], v[0] + v[1]])
        end = angles[0 if self.by_crank else 1]
        mass, potential, slopes = self.terms(np.array(end))
        speed = self.sign * np.sqrt(2.0 * (self.energy - float(potential)) / float(mass))
        exact = speed * np.array([float(slope) for slope in slopes])
        late = abs(self.time(float(end)) - t)
        return late * float(np.abs(exact).max()), float(np.abs(rates - exact).max())


def check(d: float, rtol: float, backend: str = "auto") -> srm.Solution:
    solution = srm.simulate(
        slider_crank(d), T_END, rtol=rtol, singular_tolerance=0.0, backend=backend
    )
    assert solution.success, solution.message
    assert Reference(d).error(solution) < 1000.0 * rtol + 1e-9
    assert not solution.settings.stiff
    return solution


@pytest.mark.parametrize("d", [1e-3, -1e-5, 1e-7, -1e-9, 1e-12])
@pytest.mark.parametrize("rtol", [1e-4, 1e-9])
def test_almost_equal_bars_turn_the_corner_that_their_lengths_prescribe(
    d: float, rtol: float
) -> None:
    check(d, rtol)


@pytest.mark.stress
@pytest.mark.parametrize(("backend", "d"), GRID)
@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-9, 1e-12])
def test_bars_of_any_difference_turn_the_corner(d: float, rtol: float, backend: str) -> None:
    check(d, rtol, backend)


@pytest.mark.parametrize(
    ("rtol", "backend"),
    [
        (1e-4, "auto"),
        (1e-6, "auto"),
        # Half a minute on the Python reference.
        pytest.param(1e-9, "kernel", marks=needs_kernel),
        pytest.param(1e-12, "kernel", marks=needs_kernel),
    ],
)
def test_layers_cost_at_most_twice_the_evaluations_of_equal_bars(rtol: float, backend: str) -> None:
    equal = srm.simulate(slider_crank(0.0), T_END, rtol=rtol, backend=backend).stats.evaluations
    for d in (1e-1, -1e-1, -5e-2, 1e-2, -1e-2, -1e-3, 1e-4, -1e-6, 1e-8, -1e-12):
        assert check(d, rtol, backend).stats.evaluations <= 2 * equal


@pytest.mark.parametrize("d", [0.0, 1e-12, 1e-6, -1e-3, 1e-1])
def test_the_residual_of_a_critical_configuration_is_the_difference_of_the_bars(d: float) -> None:
    mechanism = slider_crank(d)
    geometry = geometry_of(mechanism, mechanism.q0)
    near = np.array([np.pi / 2 - 0.2, -np.pi + 0.41])

    found = critical_configuration(geometry, mechanism.structure.rank, near, 1.0)

    assert found is not None
    np.testing.assert_allclose(found.q, [np.pi / 2, -np.pi], atol=1e-9)
    assert abs(found.residual) * geometry.units.length == pytest.approx(abs(d), abs=4e-16)


@pytest.mark.parametrize("ahead", [0.1, 0.02, 0.004])
def test_the_critical_configuration_of_loops_that_are_singular_at_once_is_found(
    ahead: float,
) -> None:
    """All 20 loops pass together: any combination of their critical rows is critical."""
    mechanism = load("n_four_bar_20")
    solution = srm.simulate(mechanism, 1.0, rtol=1e-10)
    (passage,) = solution.crossings
    geometry = geometry_of(mechanism, mechanism.q0)
    near, at = (solution(passage.time - time)[0] for time in (ahead, 0.0))

    found = critical_configuration(geometry, mechanism.structure.rank, near, 0.6)

    assert found is not None
    assert abs(found.residual) < 1e-15
    np.testing.assert_allclose(geometry.difference(at, found.q), 0.0, atol=1e-8)


@pytest.mark.parametrize("rtol", [1e-4, 1e-8, 1e-12])
def test_a_residual_below_the_tolerance_counts_as_zero_at_every_accuracy(rtol: float) -> None:
    almost, equal = slider_crank(1e-10), slider_crank(0.0)

    run = srm.simulate(almost, 2.0, rtol=rtol)

    assert run.success
    assert "count as exact (singular_tolerance)" in run.message
    assert [passage.kind for passage in run.crossings] == ["passed"] * len(run.crossings)
    assert all(passage.by_tolerance for passage in run.crossings)
    ideal = srm.simulate(equal, 2.0, rtol=1e-12)
    assert len(run.crossings) == len(ideal.crossings)
    assert np.abs(run.q[-1] - ideal.q[-1]).max() < 1000.0 * rtol + 1e-7


@pytest.mark.parametrize("backend", ["kernel", "python"])
def test_the_decision_is_the_same_at_every_accuracy(backend: str) -> None:
    mechanism = slider_crank(1e-7)
    for rtol in (1e-4, 1e-6, 1e-9):
        run = srm.simulate(mechanism, 1.2, rtol=rtol, backend=backend)
        assert [passage.kind for passage in run.crossings] == ["avoided"] * 3
        residuals = [passage.residual for passage in run.crossings]
        np.testing.assert_allclose(np.abs(residuals), 2.586e-8, rtol=1e-3)
        straight = srm.simulate(mechanism, 1.2, rtol=rtol, backend=backend, singular_tolerance=1e-6)
        assert {passage.kind for passage in straight.crossings} == {"passed"}


@pytest.mark.parametrize("rtol", [1e-3, 3e-4, 1e-4, 3e-5])
def test_a_critical_configuration_far_from_the_motion_does_not_draw_it_away(rtol: float) -> None:
    """Newton's steps towards a curve through one would lead the walker whole turns further."""
    mechanism = load("klann_walker")
    exact = srm.simulate(mechanism, 2.3, rtol=1e-9, tableau="dopr54")
    run = srm.simulate(mechanism, 2.3, rtol=rtol)
    np.testing.assert_allclose(run.q[-1], exact.q[-1], rtol=0.0, atol=30.0 * rtol)


def test_equal_bars_pass_with_no_residual() -> None:
    run = srm.simulate(slider_crank(0.0), 1.2, singular_tolerance=0.0)
    assert run.crossings
    for passage in run.crossings:
        assert passage.kind == "passed"
        assert not passage.by_tolerance
        assert passage.residual == pytest.approx(0.0, abs=1e-15)


def test_dense_output_in_the_layer_keeps_closures_and_energy() -> None:
    run = srm.simulate(slider_crank(1e-6), 1.2, rtol=1e-8)
    first = run.crossings[0].time
    inside = run.at(first + np.linspace(-0.01, 0.01, 401))

    assert inside.drift[:, 0].max() < 1e-8
    assert np.abs(inside.energy - run.energy[0]).max() < 1e-5 * np.abs(run.energy[0])


@pytest.mark.parametrize("d", [-1e-7, 1e-8, -1e-9, -1e-12])
def test_dense_output_in_a_narrow_layer_has_its_rates(d: float) -> None:
    run = srm.simulate(slider_crank(d), 0.5, singular_tolerance=0.0)
    reference = Reference(d)
    t = run.crossings[0].time + np.linspace(-0.5, 0.5, 21) * np.sqrt(abs(d))
    q, v = run(t)
    errors = np.array([reference.errors(*at) for at in zip(t.tolist(), q, v)])

    assert errors[:, 0].max() < 1e-6
    assert errors[:, 1].max() < 5e-5 * np.abs(v).max()


@pytest.mark.parametrize("off", [-1e-4, -1e-6, 1e-6, 1e-4])
@pytest.mark.parametrize("d", [-1e-6, -1e-8])
def test_an_action_in_a_narrow_layer_finds_the_closures(d: float, off: float) -> None:
    """Newton's steps onto them end at rounding over sigma, which is far above rounding."""
    mechanism = slider_crank(d)
    ideal = srm.simulate(mechanism, 1.0, rtol=1e-8, singular_tolerance=0.0)
    time = ideal.crossings[1].time + off
    event = srm.Event(lambda t, q, v: t - time, action=lambda t, q, v: (q, v))

    run = srm.simulate(mechanism, 1.0, rtol=1e-8, singular_tolerance=0.0, events=event)

    assert run.success, run.message
    assert len(run.segments) == 2
    assert run.drift[:, 0].max() < 1e-11
    # Dense output in the layer, from which the action starts, errs by 1e-5 of the rates.
    assert Reference(d).error(run) < 5e-4


def test_a_saved_run_reads_the_same_within_a_passage(tmp_path: Any) -> None:
    run = srm.simulate(slider_crank(1e-8), 0.5)
    run.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
    t = run.crossings[0].time + np.linspace(-0.01, 0.01, 21)

    np.testing.assert_array_equal(loaded(t)[0], run(t)[0])
    assert [passage.kind for passage in loaded.crossings] == ["avoided"]
    assert loaded.settings.singular_tolerance == run.settings.singular_tolerance


def test_a_run_may_end_within_a_passage() -> None:
    whole = srm.simulate(slider_crank(1e-8), 0.5, rtol=1e-9)
    end = whole.crossings[0].time + 1e-5
    short = srm.simulate(slider_crank(1e-8), end, rtol=1e-9)

    assert short.success
    assert float(short.t[-1]) == end
    np.testing.assert_allclose(short.q[-1], whole(end)[0], atol=1e-8)


def test_events_within_a_passage_are_found() -> None:
    whole = srm.simulate(slider_crank(1e-8), 0.5, rtol=1e-9)
    lowest = whole.q[:, 1].min()

    def folded(t: float, q: Any, v: Any) -> float:
        return float(q[1] - (lowest + 1e-4))

    run = srm.simulate(slider_crank(1e-8), 0.5, rtol=1e-9, events=folded)
    assert run.t_events is not None
    assert len(run.t_events[0]) >= 1
    for t in run.t_events[0]:
        assert whole(t)[0][1] == pytest.approx(lowest + 1e-4, abs=1e-8)


def test_dissipation_and_a_controller_act_in_the_layer() -> None:
    def brake(t: float, q: Any, v: Any) -> Any:
        return np.array([-0.5 * v[0] + np.sin(t), 0.0])

    coarse, fine = (
        srm.simulate(slider_crank(d), 2.0, rtol=1e-9, controller=brake, singular_tolerance=0.0)
        for d in (1e-8, 1.01e-8)
    )
    assert coarse.energy_balance.residual is not None
    worst = np.abs(coarse.energy_balance.residual).max()
    assert worst < 1e-6 * np.abs(coarse.energy).max()
    assert np.abs(coarse.q[-1] - fine.q[-1]).max() < 1e-4


@pytest.mark.parametrize("value", [-1e-9, float("nan"), float("inf"), "tight", None])
def test_a_tolerance_that_is_no_number_is_refused(value: Any) -> None:
    with pytest.raises(srm.InputError, match="singular_tolerance"):
        srm.simulate(load("slider_crank"), 1.0, singular_tolerance=value)


def driven_four_bar(crank: float) -> srm.Mechanism:
    return srm.planar(
        points={"O": (0, 0), "A": (crank, 0), "B": (120, 80), "C": (150, 0)},
        bars={"crank": ("O", "A"), "coupler": ("A", "B"), "rocker": ("B", "C")},
        ground=("O", "C"),
        unit="mm",
        mass_per_length=1.0,
        drives={"O": 6.28},
    )


@pytest.mark.parametrize("backend", ["kernel", "python"])
@pytest.mark.parametrize("t_end", [1.0, 1.2])
def test_a_linkage_far_from_its_singular_configurations_is_not_said_to_avoid_one(
    backend: str, t_end: float
) -> None:
    """The crank turns fully: rocker and coupler are never in line."""
    run = srm.simulate(driven_four_bar(38.587174348697395), t_end, backend=backend)
    assert run.message == f"The run reached t = {t_end:g} s."


@pytest.mark.parametrize("backend", ["kernel", "python"])
def test_a_run_that_stops_before_a_passage_does_not_report_it(backend: str) -> None:
    with pytest.warns(srm.SrmWarning, match="dead point"):
        run = srm.simulate(driven_four_bar(47.0), 0.7, backend=backend)
    assert run.t[-1] < 0.4321
    assert "avoids" not in run.message
