"""Linkages typed in, against closed formulas and against the same mechanisms made otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from itertools import combinations

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system
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

# Joint that is the crank, and end of the run (s), of those that are also bundled as URDF.
TWINS = {
    "slider_crank": ("O", 2.0),
    "four_bar": ("O", 2.0),
    "watt_six_bar": ("A", 1.0),
    "jansen_walker": ("O", 0.6),
}


def acceleration(mechanism: srm.Mechanism, joint: str, state: np.ndarray) -> float:
    rate = make_system(mechanism).evaluate(0.0, state).rate()
    return float(rate[mechanism.model.nv + mechanism.joint(joint).idx_v])


@pytest.mark.parametrize("name", TWINS)
def test_a_linkage_typed_in_is_the_bundled_urdf_to_rounding(name: str) -> None:
    """Accelerations at equal states of the crank along the motion, and the motion itself."""
    crank, t_end = TWINS[name]
    ours, other = load(f"{name}_planar"), load(name)
    assert ours.source is not None
    assert ours.source.format == "planar linkage"
    assert ours.degrees_of_freedom == other.degrees_of_freedom
    assert len(ours.loops) == len(other.loops)
    mine, theirs = (finished(each, t_end, rtol=1e-10) for each in (ours, other))
    places = ours.joint(crank).idx_q, other.joint("crank").idx_q
    # The angles of the other may count from the start.
    before = ours.q0[places[0]] - other.q0[places[1]]
    for t in np.linspace(0.0, t_end, 5):
        (q, v), (angles, rates) = mine(t), theirs(t)
        angle, rate = before + angles[places[1]], rates[other.joint("crank").idx_v]
        assert q[places[0]] == pytest.approx(angle, abs=2e-7)
        near = ours.with_state(q, v)
        state = srm.assemble(near, q={crank: angle}, v={crank: rate})
        expected = acceleration(other, "crank", np.concatenate([angles, rates]))
        found = acceleration(ours, crank, np.concatenate([state.q, state.v]))
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)
