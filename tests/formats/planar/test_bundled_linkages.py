"""Linkages typed in, against closed formulas and against the same mechanisms made otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support.bundled import finished, load
from tests.support.one_degree import (
    OneDegree,
    Point,
    Points,
    carried,
    is_left,
    length,
    meeting,
    point,
    polar,
)
from tests.support.reduced import trajectory
from tools.models.planar import JANSEN
from tools.models.planar import meeting as real_meeting

DATA = Path(__file__).parents[2] / "data" / "planar"


def distance(a: Point, b: Point) -> float:
    return float(length(a, b).real)


def edges(at: Points, density: float, *names: str) -> dict[tuple[str, str], float]:
    """The bars of a plate, or the one of a bar."""
    return {(p, q): density * distance(at[p], at[q]) for p, q in combinations(names, 2)}


def placed(solution: srm.Solution, name: str, t: float) -> np.ndarray:
    """A named point (x, y) of the drawing at a time."""
    mechanism = solution.mechanism
    joint, offset = mechanism.points[name].resolve(mechanism.model)
    data = mechanism.model.createData()
    pin.forwardKinematics(mechanism.model, data, solution(t)[0])
    x, y, z = (data.oMi[joint] * offset).translation
    assert abs(y) < 1e-12, "it stays in the plane"
    return np.array([x, z])


# -- closed formulas --------------------------------------------------------------------------


def klann() -> OneDegree:
    drawn = {
        "O": point(1.599, 0.75), "A": point(1.331, 0.75), "upper": point(1.366, 1.366),
        "lower": point(1.009, 0.574), "elbow": point(0.741, 0.75), "knee": point(0.232, 0.866),
        "hip": point(0.866, 1.5), "foot": point(0.0, 0.0),
    }  # fmt: skip
    mirrored = {f"{k}_r": point(2 * 1.599 - p[0], p[1]) for k, p in drawn.items()}
    mirrored["O"] = drawn["O"]

    def leg(at: Mapping[str, Point], pin_: Point, s: str) -> dict[str, Point]:
        p = {k: at[f"{k}{s}"] for k in ("A", "upper", "lower", "elbow", "knee", "hip", "foot")}

        def meet(centre: str, a: str, b: str, origin: Point) -> Point:
            from_a, from_b = distance(p[a], p[centre]), distance(p[b], p[centre])
            return meeting(origin, from_a, p[b], from_b, is_left(p[a], p[b], p[centre]))

        elbow = meet("elbow", "A", "lower", pin_)
        knee = carried(pin_, elbow, (p["A"], p["elbow"], p["knee"]))
        hip = meet("hip", "knee", "upper", knee)
        foot = carried(knee, hip, (p["knee"], p["hip"], p["foot"]))
        found = {"A": pin_, "elbow": elbow, "knee": knee, "hip": hip, "foot": foot}
        return {f"{k}{s}": value for k, value in (p | found).items()}

    def places(angle: complex) -> Points:
        first, second = (polar(drawn["O"], 0.268, angle + turn) for turn in (0.0, np.pi))
        return leg(drawn, first, "") | leg(mirrored, second, "_r")

    at = places(np.pi)
    bars = {("A", "A_r"): 0.536}
    for s in ("", "_r"):
        bars |= edges(at, 1.0, f"A{s}", f"elbow{s}", f"knee{s}")
        bars |= edges(at, 1.0, f"knee{s}", f"hip{s}", f"foot{s}")
        bars |= edges(at, 1.0, f"upper{s}", f"hip{s}") | edges(at, 1.0, f"lower{s}", f"elbow{s}")
    return OneDegree(places, bars)


def toggle() -> OneDegree:
    o, g = point(0.56, 0.38), point(0.0, 0.64)
    k, a, d = point(0.112, 0.34), point(0.512, 0.444), point(0.0, 0.04)
    rod, upper, lower = distance(a, k), distance(g, k), distance(k, d)

    def places(angle: complex) -> Points:
        at = polar(o, 0.08, angle)
        knee = meeting(at, rod, g, upper, is_left(a, g, k))
        ram = point(0.0, knee[1] - np.sqrt(lower**2 - knee[0] * knee[0]))
        return {"A": at, "K": knee, "G": g, "D": ram}

    masses = {("A", "K"): 10 * rod, ("G", "K"): 10 * upper, ("K", "D"): 10 * lower}
    return OneDegree(places, masses, {"D": 20.0}, flywheel=2.0)


def scissor() -> OneDegree:
    def places(angle: complex) -> Points:
        c, s = np.cos(angle), np.sin(angle)
        names = {"foot": (0, 0), "heel": (c, 0), "left": (0, s), "right": (c, s)}
        names |= {"top": (0, 2 * s), "edge": (c, 2 * s), "end": (1.1, 2 * s)}
        return {k: point(*p) for k, p in names.items()}

    arms = {("foot", "right"): 3.0, ("heel", "left"): 3.0, ("left", "edge"): 3.0}
    arms |= {("right", "top"): 3.0, ("top", "end"): 20.0}
    return OneDegree(places, arms, springs={("foot", "heel"): (3000.0, 300.0, 0.5)})


def quick_return() -> OneDegree:
    o, b, c = point(0.0, 0.25), point(0.0, 0.0), point(0.1, 0.55)
    lever, link = distance(b, c), distance(c, point(-0.18, 0.6))

    def places(angle: complex) -> Points:
        a = polar(o, 0.1, angle)
        end = a * lever / length(b, a)
        ram = point(end[0] - np.sqrt(link**2 - (0.6 - end[1]) ** 2), 0.6)
        return {"A": a, "B": b, "C": end, "D": ram}

    bars = {("B", "C"): 5 * lever, ("C", "D"): 5 * link}
    return OneDegree(places, bars, {"A": 0.5, "D": 5.0}, flywheel=0.5)


def wiper() -> OneDegree:
    o, a, left, p = point(0.3, -0.06), point(0.35, -0.06), point(0.0, 0.0), point(0.03, -0.095)
    right, q, tips = point(0.5, 0.0), point(0.53, -0.095), (point(-0.12, 0.48), point(0.4, 0.42))

    def places(angle: complex) -> Points:
        at = polar(o, 0.05, angle)
        one = meeting(at, distance(a, p), left, distance(left, p), is_left(a, left, p))
        two = meeting(one, distance(p, q), right, distance(right, q), is_left(p, right, q))
        out = {"O": o, "A": at, "L": left, "P": one, "R": right, "Q": two}
        out["left_tip"] = carried(left, one, (left, p, tips[0]))
        out["right_tip"] = carried(right, two, (right, q, tips[1]))
        return out

    at = places(0.0)
    bars = edges(at, 0.5, "L", "P", "left_tip") | edges(at, 0.5, "R", "Q", "right_tip")
    for pair in ("OA", "AP", "PQ"):
        bars |= edges(at, 0.5, *pair)
    return OneDegree(places, bars)


# Joint that is the coordinate, end of the run (s), and a point to compare.
FORMULAS = {
    "klann_walker": (klann, "O", 2.0, "foot_r"),
    "toggle_press": (toggle, "O", 2.0, "D"),
    "scissor_lift": (scissor, "foot", 2.0, "edge"),
    "quick_return": (quick_return, "O", 2.0, "D"),
}


@cache
def run(name: str, t_end: float) -> srm.Solution:
    return finished(load(name), t_end, rtol=1e-10)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.stress) if n == "klann_walker" else n for n in FORMULAS],
)
def test_a_bundled_linkage_follows_the_equation_of_its_crank(name: str) -> None:
    made, joint, t_end, tip = FORMULAS[name]
    reference, solution = made(), run(name, t_end)
    angle, rate = solution.joint(joint)
    times = np.linspace(0.0, t_end, 5)
    expected = trajectory(reference, [angle[0], rate[0]], times)
    i = solution.mechanism.joint(joint).idx_q
    q, v = solution(times)
    np.testing.assert_allclose(q[:, i], expected[:, 0], atol=2e-7)
    np.testing.assert_allclose(v[:, i], expected[:, 1], atol=2e-6)
    for t, (turned, _) in zip(times, expected):
        wanted = reference.places(turned)[tip].real
        np.testing.assert_allclose(placed(solution, tip, t), wanted, atol=2e-7)


def test_the_driven_wiper_moves_and_needs_the_torque_of_the_formulas() -> None:
    reference, solution = wiper(), run("wiper", 2.0)
    speed = np.radians(270.0)
    for t, torque in list(zip(solution.t, solution.drive_forces["O"]))[::20]:
        at = reference.places(speed * t)
        for name in ("P", "Q", "left_tip", "right_tip"):
            np.testing.assert_allclose(placed(solution, name, t), at[name].real, atol=1e-12)
        assert torque == pytest.approx(reference.torque(speed * t, speed, 0.0), abs=1e-8)


def test_the_ram_of_the_quick_return_is_faster_on_its_way_back() -> None:
    """The lever is at its ends where the crank is at right angles with it."""
    reference = quick_return()
    swing = np.arcsin(100.0 / 250.0)
    rates = [reference.places(angle + 1e-30j)["C"][0].imag for angle in (-swing, np.pi + swing)]
    np.testing.assert_allclose(np.array(rates) / 1e-30, 0.0, atol=1e-12)
    assert np.degrees(np.pi + 2.0 * swing) == pytest.approx(227.0, abs=0.5)


# -- the same mechanisms made otherwise -------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "t_end", "joints"),
    [
        ("four_bar", 2.0, {"O": "crank", "A": "coupler"}),
        ("slider_crank", 2.0, {"O": "crank"}),
    ],
)
def test_a_linkage_typed_in_moves_as_the_bundled_one(
    name: str, t_end: float, joints: dict[str, str]
) -> None:
    ours = finished(srm.load(DATA / f"{name}.toml"), t_end, rtol=1e-10)
    other = finished(load(name), t_end, rtol=1e-10)
    times = np.linspace(0.0, t_end, 9)
    for mine, theirs in joints.items():
        for one, two in zip(ours.at(times).joint(mine), other.at(times).joint(theirs)):
            turns = 2.0 * np.pi * np.round((one - two)[0] / (2.0 * np.pi))
            np.testing.assert_allclose(one - turns, two, atol=1e-7)


def of_links(mechanism: srm.Mechanism, names: Mapping[str, str]) -> dict[str, dict[str, float]]:
    """Masses and moments of inertia of joints of another mechanism, for bars by their names."""
    found: dict[str, dict[str, float]] = {"masses": {}, "inertias": {}}
    for bar, joint in names.items():
        inertia = mechanism.model.inertias[mechanism.model.getJointId(joint)]
        found["masses"][bar] = inertia.mass
        found["inertias"][bar] = inertia.inertia[1, 1]
    return found


def as_bundled(name: str, t_end: float, crank: str, **linkage: Any) -> None:
    """Compare the angle of the crank, which in the other mechanism counts from the start."""
    bars = dict.fromkeys(linkage["bars"])
    other = load(name)
    ours = srm.planar(**linkage, **of_links(other, {bar: bar for bar in bars}))
    assert ours.degrees_of_freedom == other.degrees_of_freedom
    assert len(ours.loops) == len(other.loops)
    times = np.linspace(0.0, t_end, 9)
    one = finished(ours, t_end, rtol=1e-10).at(times).joint(crank)
    two = finished(other, t_end, rtol=1e-10).at(times).joint("crank")
    np.testing.assert_allclose(one[0] - one[0][0], two[0], atol=2e-7)
    np.testing.assert_allclose(one[1], two[1], atol=2e-6)


def test_watts_six_bar_typed_in_moves_as_the_bundled_one() -> None:
    a, d = point(0.0, 0.0), point(1.0, 0.0)
    b = 0.3 * point(np.cos(1.0), np.sin(1.0))
    c = real_meeting(b, 0.9, d, 0.7, left=True)
    e, f = real_meeting(b, 0.75, c, 0.6, left=True), real_meeting(d, 1.2, c, 0.6, left=False)
    g = real_meeting(e, 0.9, f, 0.8, left=True)
    as_bundled(
        "watt_six_bar",
        1.0,
        "A",
        points={"A": a, "B": b, "C": c, "D": d, "E": e, "F": f, "G": g},
        bars={
            "crank": list("AB"),
            "coupler": list("BCE"),
            "left": list("EG"),
            "rocker": list("DCF"),
            "right": list("FG"),
        },
        ground=("A", "D"),
        rates={"A": 8.0},
    )


def test_jansens_walker_typed_in_moves_as_the_bundled_one() -> None:
    n = JANSEN
    points: dict[str, Any] = {"O": (0.0, 0.0), "hip_l": (-0.38, -0.078), "hip_r": (0.38, -0.078)}
    bars: dict[str, tuple[str, ...]] = {"crank": ("O", "pin_0", "pin_1")}
    for k, angle in enumerate((0.5, 0.5 + np.pi)):
        pin_ = points[f"pin_{k}"] = n["m"] * point(np.cos(angle), np.sin(angle))
        for side, mirrored in (("left", False), ("right", True)):
            leg, hip_name = f"{side}_{k}", f"hip_{side[0]}"
            hip = np.array(points[hip_name])
            above = real_meeting(pin_, n["j"], hip, n["b"], left=mirrored)
            below = real_meeting(pin_, n["k"], hip, n["c"], left=not mirrored)
            back = real_meeting(hip, n["d"], above, n["e"], left=not mirrored)
            ankle = real_meeting(back, n["f"], below, n["g"], left=mirrored)
            foot = real_meeting(ankle, n["h"], below, n["i"], left=mirrored)
            found = {"above": above, "below": below, "back": back, "ankle": ankle, "foot": foot}
            points |= {f"{leg}_{name}": at for name, at in found.items()}
            for bar, ends in {
                "j": (f"pin_{k}", "above"), "k": (f"pin_{k}", "below"),
                "hip": (hip_name, "above", "back"), "f": ("back", "ankle"),
                "c": (hip_name, "below"), "foot": ("below", "ankle", "foot"),
            }.items():  # fmt: skip
                bars[f"{leg}_{bar}"] = tuple(
                    end if end in points else f"{leg}_{end}" for end in ends
                )
    as_bundled(
        "jansen_walker",
        0.6,
        "O",
        points=points,
        bars=bars,
        ground=("O", "hip_l", "hip_r"),
        rates={"O": 6.0},
    )
