"""Linkages over a turn of the crank, against the formulas of triangles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support.bundled import load
from tests.support.commands import error_line, run
from tests.support.mechanisms import add_link, along_x, rod


def angle_of(a: float, b: float, c: float) -> float:
    """Angle (rad) opposite to the side c of a triangle with the sides a, b, c."""
    return float(np.arccos((a * a + b * b - c * c) / (2.0 * a * b)))


def four_bar(crank: float, coupler: float, output: float, ground: float) -> srm.Mechanism:
    """A four-bar in the x-z plane, closed where its coupler lies above the ground."""
    model = pin.Model()
    hinge = pin.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0]))  # angles from x to z
    a = add_link(model, 0, hinge, "crank", rod(1.0, crank))
    add_link(model, a, hinge, "coupler", rod(1.0, coupler), along_x(crank))
    add_link(model, 0, hinge, "output", rod(1.0, output), along_x(ground))
    tip = srm.LoopClosure(
        "point",
        srm.Anchor("coupler", xyz=(coupler, 0.0, 0.0)),
        srm.Anchor("output", xyz=(output, 0.0, 0.0)),
        name="tip",
    )
    # The crank where the diagonal from its tip to the output's pivot closes a triangle.
    diagonal = 0.5 * (
        max(abs(coupler - output), abs(ground - crank)) + min(coupler + output, ground + crank)
    )
    turn = angle_of(crank, ground, diagonal)
    at = crank * np.array([np.cos(turn), np.sin(turn)])
    line = np.arctan2(-at[1], ground - at[0])
    q1 = line + angle_of(coupler, diagonal, output)
    q2 = line + np.pi - angle_of(output, diagonal, coupler)
    return srm.Mechanism(model, (tip,), np.array([turn, q1 - turn, q2]))


def test_limits_stroke_and_time_ratio_of_a_crank_rocker_are_those_of_its_triangles() -> None:
    """The rocker turns back where crank and coupler are in line: sides b + a and b - a."""
    a, b, c, d = 1.0, 2.0, 1.5, 2.2
    report = srm.linkage_report(load("four_bar"), "crank")
    assert report.turns
    assert report.lengths == pytest.approx((a, b, c, d), rel=1e-9)
    assert report.grashof_class == "crank-rocker"
    assert report.dead_points == ()
    stroke = report.strokes["rocker"]
    swing = angle_of(c, d, b + a) - angle_of(c, d, b - a)
    assert stroke.length == pytest.approx(swing, abs=1e-9)
    out, back = angle_of(b + a, d, c), angle_of(b - a, d, c)
    halves = np.pi + (back - out), np.pi - (back - out)
    assert stroke.time_ratio == pytest.approx(max(halves) / min(halves), abs=1e-8)
    assert len(stroke.limits) == 2
    inner = [angle_of(b, c, d - a), angle_of(b, c, d + a)]
    folded = [min(angle, np.pi - angle) for angle in inner]
    assert report.transmission_angle is not None
    assert report.transmission_angle.min() == pytest.approx(min(folded), abs=1e-4)


def test_ratios_are_those_of_a_run_and_advantages_balance_torques() -> None:
    mechanism = load("four_bar")
    report = srm.linkage_report(mechanism, "crank")
    solution = srm.simulate(mechanism, 1.0, rtol=1e-10)
    crank, rate = solution.joint("crank")
    at = np.argmin(np.abs(report.positions[:, None] - crank), axis=0)
    near = np.abs(report.positions[at] - crank) < 2e-3
    assert near.any()
    for name in ("coupler", "rocker"):
        found = solution.joint(name)[1] / rate
        np.testing.assert_allclose(report.ratios[name][at][near], found[near], atol=0.02)
    product = report.mechanical_advantage["rocker"] * report.ratios["rocker"]
    np.testing.assert_allclose(product, 1.0, rtol=1e-12)
    step = np.diff(report.joints["rocker"]) / np.diff(report.positions)
    middle = 0.5 * (report.ratios["rocker"][1:] + report.ratios["rocker"][:-1])
    np.testing.assert_allclose(step, middle, atol=1e-3)


CLASSES = {
    "crank-rocker": (1.0, 3.0, 2.5, 2.8),
    "double-crank": (2.5, 2.8, 3.0, 1.0),
    "double-rocker": (2.5, 1.0, 2.8, 3.0),
    "rocker-crank": (2.5, 3.0, 1.0, 2.8),
    "triple-rocker": (2.0, 1.5, 2.2, 3.5),
}


@pytest.mark.parametrize("kind", CLASSES)
def test_the_class_of_a_four_bar_follows_from_its_bars(kind: str) -> None:
    lengths = CLASSES[kind]
    a, b, c, d = lengths
    report = srm.linkage_report(four_bar(*lengths), "crank")
    assert report.lengths == pytest.approx(lengths, rel=1e-9)
    assert report.grashof_class == kind
    assert report.turns == (kind in ("crank-rocker", "double-crank"))
    if report.turns:
        return
    # The crank goes no further where coupler and output are in line.
    reached = [side for side in (b + c, abs(b - c)) if abs(d - a) < side < d + a]
    expected = {round(angle_of(a, d, side), 6) for side in reached}
    found = {round(abs((x + np.pi) % (2.0 * np.pi) - np.pi), 6) for x in report.dead_points}
    assert found == expected
    assert "output" in report.strokes


def test_equal_sums_are_a_change_point() -> None:
    report = srm.LinkageReport(
        load("four_bar"),
        "crank",
        True,
        *[np.zeros(0)] * 2,
        {},
        {},
        {},
        (),
        None,
        (1.0, 2.0, 1.0, 2.0),
    )
    assert report.grashof_class == "change-point"


def offset_slider_crank(a: float, b: float, e: float) -> srm.Mechanism:
    """Crank a, rod b, the slider along x at the height e."""
    model = pin.Model()
    hinge = pin.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0]))
    first = add_link(model, 0, hinge, "crank", rod(1.0, a))
    add_link(model, first, hinge, "rod", rod(1.0, b), along_x(a))
    up = pin.SE3(np.eye(3), np.array([0.0, 0.0, e]))
    add_link(model, 0, pin.JointModelPX(), "slider", rod(1.0, 0.1), up)
    pivot = srm.LoopClosure(
        "point", srm.Anchor("rod", xyz=(b, 0.0, 0.0)), srm.Anchor("slider"), name="pin"
    )
    turn = np.arcsin(e / b)
    return srm.Mechanism(model, (pivot,), np.array([0.0, turn, a + b * np.cos(turn)]))


def test_an_offset_slider_crank_returns_quickly() -> None:
    """Its slider turns back at sqrt((b +- a)^2 - e^2)."""
    a, b, e = 1.0, 3.0, 0.8
    report = srm.linkage_report(offset_slider_crank(a, b, e), "crank")
    stroke = report.strokes["slider"]
    ends = np.sqrt((b + a) ** 2 - e**2), np.sqrt((b - a) ** 2 - e**2)
    assert (stroke.upper, stroke.lower) == pytest.approx(ends, abs=1e-9)
    assert stroke.unit == "m"
    part = np.pi + np.arcsin(e / (b + a)) - np.arcsin(e / (b - a))
    parts = part, 2.0 * np.pi - part
    assert stroke.time_ratio == pytest.approx(max(parts) / min(parts), abs=1e-8)
    assert report.lengths is None
    assert report.grashof_class is None
    angle = report.transmission_angle
    assert angle is not None
    # The rod is steepest with the crank down: sin = (a + e) / b from the path.
    assert angle.min() == pytest.approx(0.5 * np.pi - np.arcsin((a + e) / b), abs=1e-4)
    assert angle.max() == pytest.approx(0.5 * np.pi, abs=0.01)


def test_larger_linkages_have_strokes_and_no_transmission_angle() -> None:
    report = srm.linkage_report(load("jansen_walker"), "crank")
    assert report.turns
    assert report.transmission_angle is None
    assert report.lengths is None
    assert all(stroke.length > 0.0 for stroke in report.strokes.values())


@pytest.mark.parametrize("name", ["wiper", "toggle_press"])
def test_every_configuration_of_a_report_is_closed_and_has_the_crank_where_it_says(
    name: str,
) -> None:
    """A step along the path that passes a position must not be taken for it."""
    mechanism = load(name)
    crank = mechanism.joint_names[0]
    report = srm.linkage_report(mechanism, crank)
    assert len(report.dead_points) == 2
    for position, q in zip(report.positions, report.q):
        held = srm.assemble(mechanism, q, hold=[crank])
        np.testing.assert_allclose(held.q, q, atol=1e-7)  # a dead point is a double root
        assert q[mechanism.joint(crank).idx_q] == pytest.approx(position, abs=1e-12)


def test_what_is_no_linkage_is_refused() -> None:
    with pytest.raises(srm.InputError, match="2 degrees of freedom"):
        srm.linkage_report(load("five_bar"), "crank_left")
    with pytest.raises(srm.InputError, match="there is no moving joint 'krank'"):
        srm.linkage_report(load("four_bar"), "krank")


@pytest.mark.parametrize("name", ["slider_crank_slider", "parallelogram"])
def test_a_linkage_that_meets_a_singular_configuration_is_refused(name: str) -> None:
    with pytest.raises(srm.InputError, match="meets a singular configuration at crank = "):
        srm.linkage_report(load(name), "crank")


def test_the_command_linkage_prints_the_table_and_draws_it(tmp_path: Path) -> None:
    path = tmp_path / "linkage.png"
    words = run("linkage", "four_bar", "--crank", "crank", "--plot", path)
    assert "crank turns fully" in words
    assert "crank-rocker" in words
    assert f"written: {path}" in words
    assert path.stat().st_size > 5000
    line = error_line(run("linkage", "four_bar", "--crank", "x", status=2))
    assert line.startswith("error: --crank: there is no moving joint 'x'")


def test_a_report_is_shown_in_one_line_and_printed_as_a_table() -> None:
    report = srm.linkage_report(load("four_bar"), "crank")
    assert repr(report) == (
        f"LinkageReport('four_bar', crank='crank', turns fully, {len(report.positions)} positions, "
        "2 joints)"
    )
    assert str(report).startswith("crank ")
    assert "time ratio" in str(report)


@pytest.mark.parametrize(
    ("name", "crank"), [("klann_walker", "hip_r"), ("bricard", "hinge_5"), ("wiper", "L")]
)
def test_strokes_between_dead_points_are_those_of_a_path_in_small_steps(
    name: str, crank: str
) -> None:
    """A limit may lie on one of the positions of the report, where the rate is rounding of either
    sign."""
    mechanism = load(name)
    report = srm.linkage_report(mechanism, crank)
    start = mechanism.q0[mechanism.joint(crank).idx_q]
    low, high = report.dead_points
    ways = [
        srm.follow(mechanism, {crank: np.linspace(start, end, 300)}).q
        for end in (low + 1e-7, high - 1e-7)
    ]
    q = np.concatenate([ways[0][::-1], ways[1]])
    for joint, stroke in report.strokes.items():
        sampled = q[:, mechanism.joint(joint).idx_q]
        step = np.abs(np.diff(sampled)).max()
        assert sampled.max() - 1e-9 <= stroke.upper <= sampled.max() + step
        assert sampled.min() - step <= stroke.lower <= sampled.min() + 1e-9
        moves = np.diff(sampled)[np.abs(np.diff(sampled)) > 1e-9]
        assert len(stroke.limits) == np.sum(moves[:-1] * moves[1:] < 0.0)


def test_a_joint_may_turn_back_between_the_last_position_and_a_dead_point() -> None:
    """The crank's positions are a degree apart, and its last way to a dead point is shorter."""
    mechanism = load("jansen_walker")
    stroke = srm.linkage_report(mechanism, "left_1_hip").strokes["right_0_c"]
    curve = srm.kinematics(mechanism, "left_1_hip")
    sampled = curve.q[:, mechanism.joint("right_0_c").idx_q]
    near = np.abs(curve.positions - stroke.crank_at_upper) < 0.01
    assert len(stroke.limits) == 2
    np.testing.assert_allclose(stroke.upper, sampled[near].max(), atol=5e-6)
    assert stroke.upper >= sampled[near].max()
