"""The thesis is regenerated: thinned, and what only its figures need is checked by itself."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.integrate import solve_ivp

import srm_mbs as srm
from benchmarks.thesis.catalogue import regenerate
from benchmarks.thesis.entries import KEYS, PRINTED, TABLES, Entry, write
from benchmarks.thesis.orders import slope
from benchmarks.thesis.pendulum_equations import START, baumgarte, index_reduced, regularised
from benchmarks.thesis.published import PublishedControl, PublishedSRM
from benchmarks.thesis.runs import fixed_step_run
from benchmarks.thesis.systems import (
    CartesianPendulum,
    Index2,
    Published,
    slider_crank,
    slider_crank_state,
)
from srm_mbs.integration.control.step_size import StepDecision
from srm_mbs.integration.methods.base import ErrorNorm, StepResult

PAGE = Path(__file__).parents[2] / "docs/thesis.md"
PICTURES = PAGE.parent / "thesis"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("thesis")


@pytest.fixture(scope="module")
def thinned(folder: Path) -> dict[str, Entry]:
    entries = regenerate(folder, thin=True)
    write(entries, folder / "thesis.json")
    return {entry.key: entry for entry in entries}


@pytest.mark.stress
def test_every_table_and_figure_is_written_with_print_beside_ours(
    folder: Path, thinned: dict[str, Entry]
) -> None:
    record = json.loads((folder / "thesis.json").read_text())
    assert list(record) == list(KEYS)
    assert set(PRINTED) == set(KEYS)
    for key, values in record.items():
        assert values["ours"], key
        assert len(values["difference"]) > 10, key
        pixels = np.array(Image.open(folder / values["png"]).convert("L"))
        assert pixels.std() > 5.0, f"{key} is blank"
        if key in TABLES:
            assert values["printed"] == PRINTED[key]["rows"]
            assert {row: list(cells) for row, cells in values["printed"].items()} == {
                row: list(cells) for row, cells in values["ours"].items()
            }


@pytest.mark.stress
def test_table_5_1_agrees_in_all_digits(thinned: dict[str, Entry]) -> None:
    table = thinned["table5.1"]
    assert len(table.printed) == 4
    assert table.ours == table.printed


@pytest.mark.stress
def test_observed_orders_are_those_of_theory(thinned: dict[str, Entry]) -> None:
    for key, order in (("table5.2", 2), ("table5.3", 3), ("table5.4", 4)):
        row = thinned[key].ours[f"m = {order}"]
        assert row["eps = h"] == pytest.approx(order, abs=0.1)
    for row, cells in thinned["table5.7"].ours.items():
        for column, order in (("eps = h", 2), ("h = 0.001", 1), ("eps = 5h", 2), ("eps = 0.05", 1)):
            assert cells[column] == pytest.approx(order, abs=0.1), (row, column)


def test_a_slope_over_rounding_is_called_exact() -> None:
    assert slope((0.1, 0.01, 0.001), (1e-6, 1e-15, 0.0)) == "exact"
    assert slope((0.1, 0.01, 0.001), (1e-4, 1e-6, 1e-8)) == pytest.approx(2.0)


def test_the_thesis_slider_crank_follows_its_exact_solution(exact: dict[str, Any]) -> None:
    solution = srm.simulate(slider_crank(), 5.0, rtol=1e-8)
    theta, omega = map(float, exact["slidercrank"]["theta1,omega1"]["5"])
    q, v = slider_crank_state(theta, omega)
    np.testing.assert_allclose(solution.q[-1], q, rtol=0, atol=2e-7)
    np.testing.assert_allclose(solution.v[-1], v, rtol=0, atol=2e-7)


def test_rows_in_world_axes_give_the_same_algebra_on_the_constraints() -> None:
    mechanism = slider_crank(5.0, 1.0)
    state = np.concatenate([mechanism.q0, mechanism.v0])
    sigma = Published(mechanism).evaluate(0.0, state)
    rate = sigma.rate().copy()
    expected = srm.simulate(mechanism, 1e-6, step=1e-6).steps.rates[0, 0]
    np.testing.assert_allclose(rate, expected, rtol=1e-9, atol=1e-9)


def test_published_sweeps_are_those_of_the_package_away_from_singularities() -> None:
    mechanism = slider_crank()
    start = np.concatenate([mechanism.q0, mechanism.v0])
    for ours, theirs in (
        (PublishedSRM("tvd32", 3, eps=0.01), srm.SRM(tableau="tvd32", iterations=3, eps=0.01)),
        (PublishedSRM("dopr54", 2, eps=0.02), srm.SRM(tableau="dopr54", iterations=2, eps=0.02)),
    ):
        runs = [
            fixed_step_run(Published(mechanism), method, start, 0.5, 0.01, every=10)[1]
            for method in (ours, theirs)
        ]
        np.testing.assert_allclose(runs[0], runs[1], rtol=0, atol=1e-12)


def test_index_2_sweeps_keep_the_rates_and_leave_the_positions(exact: dict[str, Any]) -> None:
    mechanism = slider_crank()
    start = np.concatenate([mechanism.q0, mechanism.v0])
    errors = []
    for h in (0.02, 0.01, 0.005):
        method = PublishedSRM("tvd32", 3, eps=h)
        _, states = fixed_step_run(Index2(mechanism), method, start, 0.8, h, every=round(0.8 / h))
        theta = float(exact["slidercrank"]["theta1,omega1"]["0.8"][0])
        errors.append(abs(states[-1, 2] - theta))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders.min() > 1.7


def test_the_published_estimate_tends_to_the_gap_of_the_sweeps_and_not_to_zero() -> None:
    system, method = Published(slider_crank()), PublishedSRM("tvd32", 4, eps=0.05)
    state = np.concatenate([system.mechanism.q0, system.mechanism.v0])
    norm = ErrorNorm(np.full(12, 0.01), 0.01)
    memory = method.start(system, 0.0, state, norm)
    for step in range(16):
        result = method.step(system, 0.05 * step, 0.05, state, memory, norm)
        method.accept(memory, result)
        state = result.state
    gap = method.gap(memory, norm)
    assert gap > 0.01
    off = []
    for h in (1e-3, 1e-5, 1e-7):
        estimate = method.step(system, 0.8, h, state, memory, norm).error_ratio
        off.append(abs(estimate / gap - 1.0))
    np.testing.assert_allclose(np.log10(np.array(off[:-1]) / off[1:]), 2.0, atol=0.1)


def test_the_control_of_appendix_b_forces_steps_at_its_threshold() -> None:
    control = PublishedControl(t_end=1.0, first_step=0.1, order=3, smallest=0.02)

    def judged(xi: float) -> tuple[StepDecision, float]:
        proposal = control.propose(0.0, math.inf, None)
        result = StepResult.__new__(StepResult)
        result.error_ratio = xi
        return control.decide(proposal, result), proposal.h

    assert judged(16.0) == (StepDecision.REJECTED, 0.1)
    assert judged(1.0e6)[1] == pytest.approx(0.1 * 0.8 * 16.0**-0.25)
    verdict, h = judged(2.0)
    assert (verdict, h) == (StepDecision.ACCEPTED, 0.02)
    assert (control.accepted, control.rejected, control.forced) == (1, 2, 1)
    judged(1e-9)
    assert judged(1.0)[1] == pytest.approx(0.02 * 5.0)


def pendulum(exact: dict[str, Any], t: str) -> np.ndarray:
    return np.array(list(map(float, exact["pendulum"]["x1,x2,v1,v2"][t])))


def test_equations_of_the_pendulum_have_its_exact_solution(exact: dict[str, Any]) -> None:
    expected = pendulum(exact, "1")
    for field, start in ((index_reduced, START), (baumgarte(10.0), START[:4])):
        run = solve_ivp(field, (0.0, 1.0), start, method="DOP853", rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(run.y[:4, -1], expected, rtol=0, atol=1e-8)


def test_the_regularised_pendulum_errs_by_eps(exact: dict[str, Any]) -> None:
    errors = []
    for eps in (1e-3, 1e-4, 1e-5):
        run = solve_ivp(
            regularised(eps), (0.0, 0.5), START, method="DOP853", rtol=1e-10, atol=1e-10
        )
        errors.append(np.abs(run.y[:2, -1] - pendulum(exact, "0.5")[:2]).max())
    orders = np.log10(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 1.0, atol=0.15)


def test_sweeps_on_the_cartesian_pendulum_converge_with_order_two(exact: dict[str, Any]) -> None:
    errors = []
    for h in (0.01, 0.005, 0.0025):
        method = PublishedSRM("trap", 2, eps=h)
        _, states = fixed_step_run(
            CartesianPendulum(), method, START[:4], 1.0, h, every=round(1.0 / h)
        )
        errors.append(np.abs(states[-1] - pendulum(exact, "1")).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.3)


def test_the_page_shows_every_picture_and_they_are_small() -> None:
    text = PAGE.read_text(encoding="utf-8")
    record = json.loads((PICTURES / "thesis.json").read_text(encoding="utf-8"))
    assert list(record) == list(KEYS)
    sizes = [(PICTURES / values["png"]).stat().st_size for values in record.values()]
    for key, values in record.items():
        assert f"](thesis/{key}.png)" in text
        assert f"## {values['title']}" in text
    assert max(sizes) < 100_000
    assert sum(sizes) < 400_000
