"""Linkages typed in: names, frames, units, elements, files and refusals."""

from __future__ import annotations

import math
import pickle
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

import srm_mbs as srm
from srm_mbs.formats.load import models_folder
from srm_mbs.formats.planar.shapes import fitted, outline, slender
from srm_mbs.model.coordinates import position_of
from srm_mbs.model.laws import Curve
from tests.support.bundled import finished, load
from tests.support.snapshots import check_messages, refused

POINTS = {"O": (0, 0), "A": (40, 0), "B": (120, 80), "C": (150, 0)}
BARS = {"crank": ("O", "A"), "coupler": ("A", "B"), "rocker": ("B", "C")}
FOUR_BAR: dict[str, Any] = {
    "points": POINTS,
    "bars": BARS,
    "ground": ("O", "C"),
    "unit": "mm",
    "mass_per_length": 1.0,
}
PRESS: dict[str, Any] = {
    "points": {"O": (0, 0), "A": (1, 1), "D": (3, 0)},
    "bars": {"crank": ("O", "A"), "rod": ("A", "D")},
    "ground": ("O",),
    "mass_per_length": 1.0,
}
RAM = {"ram": {"point": "D", "along": (1, 0), "mass": 2.0}}


def changed(base: Mapping[str, Any], **changes: Any) -> dict[str, Any]:
    return {**base, **changes}


def made(base: Mapping[str, Any] = FOUR_BAR, **changes: Any) -> srm.Linkage:
    return srm.planar(**changed(base, **changes))


def closure_names(mechanism: srm.Mechanism) -> dict[str, str]:
    return {loop.name: loop.type_name for loop in mechanism.loops}


def test_joints_and_closures_are_called_after_their_pins() -> None:
    linkage = made()
    assert set(linkage.joint_names) == {"O", "A", "C"}
    assert closure_names(linkage) == {"B": "point"}
    assert linkage.degrees_of_freedom == 1
    assert linkage.redundant_rows == ("B.y",)
    assert set(linkage.points) == set(POINTS)


def test_where_several_bars_meet_a_joint_is_called_after_its_bar_too() -> None:
    points = POINTS | {"D": (120, -50), "E": (170, -60)}
    bars = BARS | {"second": ("A", "D"), "arm": ("D", "E")}
    linkage = made(points=points, bars=bars, ground=("O", "C", "E"))
    assert {"A:coupler", "A:second"} <= set(linkage.joint_names)
    assert set(closure_names(linkage)) == {"B", "D"}


def test_angles_are_those_of_the_bars_as_drawn() -> None:
    linkage = made()
    position = dict(zip(linkage.joint_names, linkage.q0))
    assert position["O"] == pytest.approx(0.0)
    assert position["A"] == pytest.approx(np.pi / 4.0), "of the coupler against the crank"
    assert position["C"] == pytest.approx(np.arctan2(80.0, -30.0)), "from its pin on the ground"


def test_a_positive_rate_turns_from_x_to_y_and_y_points_up() -> None:
    linkage = made(rates={"O": 2.0}, gravity=(0.5, -3.0))
    np.testing.assert_array_equal(linkage.model.gravity.linear, [0.5, 0.0, -3.0])
    solution = finished(linkage, 0.01)
    assert solution.joint("O")[0][-1] > 0.015
    np.testing.assert_allclose(linkage.points["C"].xyz, (0.15, 0.0, 0.0))


@pytest.mark.parametrize(
    ("unit", "size"), [("m", 1.0), ("cm", 1e2), ("mm", 1e3), ("in", 1 / 0.0254)]
)
def test_units_describe_the_same_linkage(unit: str, size: float) -> None:
    metres = {name: np.array(at) / 1e3 for name, at in POINTS.items()}
    spring = {"a": "A", "b": "C", "stiffness": 10.0, "rest_length": 0.1}
    expected = made(points=metres, unit="m", springs=[spring], rates={"O": np.pi})
    linkage = made(
        points={name: size * at for name, at in metres.items()},
        unit=unit,
        springs=[spring | {"rest_length": 0.1 * size}],
        angle="deg",
        rates={"O": 180.0},
    )
    np.testing.assert_allclose(linkage.q0, expected.q0, atol=1e-14)
    np.testing.assert_allclose(linkage.v0, expected.v0, rtol=1e-12)
    for one, two in zip(linkage.model.inertias, expected.model.inertias):
        assert one.isApprox(two, 1e-12)
    assert linkage.forces[0].rest_length == pytest.approx(0.1)  # type: ignore[attr-defined]


def test_bars_are_slender_and_plates_consist_of_bars_along_their_outline() -> None:
    linkage = made(points=POINTS | {"P": (60, 60)}, bars=BARS | {"coupler": ("A", "B", "P")})
    crank = linkage.model.inertias[linkage.model.getJointId("O")]
    assert crank.mass == pytest.approx(0.04)
    assert crank.inertia[1, 1] == pytest.approx(0.04 * 0.04**2 / 12.0)
    corners = [np.array(p) / 1e3 for p in (POINTS["A"], POINTS["B"], (60, 60))]
    sides = [(corners[i], corners[i - 1]) for i in range(3)]
    masses = [np.linalg.norm(a - b) for a, b in sides]
    middles = [0.5 * (a + b) for a, b in sides]
    centre = np.average(middles, axis=0, weights=masses)
    moment = sum(m**3 / 12.0 + m * np.sum((c - centre) ** 2) for m, c in zip(masses, middles))
    plate = linkage.model.inertias[linkage.model.getJointId("A")]
    assert plate.mass == pytest.approx(sum(masses))
    assert plate.inertia[1, 1] == pytest.approx(moment)
    assert np.linalg.norm(plate.lever) == pytest.approx(np.linalg.norm(centre - corners[0]))


def test_points_in_line_make_one_bar() -> None:
    line = [(0.0, 0.0), (2.0, 1.0), (1.0, 0.5)]
    assert outline(line) == [(0, 1)]
    assert slender(line).length == pytest.approx(np.sqrt(5.0))


def test_an_inner_point_of_a_plate_is_not_on_its_outline() -> None:
    square = [(0.0, 0.0), (1.0, 0.0), (0.4, 0.5), (1.0, 1.0), (0.0, 1.0)]
    assert sorted(sum(outline(square), ())) == [0, 0, 1, 1, 3, 3, 4, 4]
    assert slender(square).length == pytest.approx(4.0)


def test_masses_inertias_and_centres_are_taken_as_given() -> None:
    bars = BARS | {"rocker": {"points": ("B", "C"), "mass": 2.0, "centre": (150, 10)}}
    linkage = made(bars=bars, masses={"coupler": 0.3}, inertias={"coupler": 1e-3})
    coupler, rocker = (linkage.model.inertias[linkage.model.getJointId(n)] for n in ("A", "C"))
    assert coupler.mass == 0.3
    assert coupler.inertia[1, 1] == pytest.approx(1e-3)
    assert np.linalg.norm(rocker.lever) == pytest.approx(0.01)


def test_lengths_replace_those_of_the_drawing() -> None:
    rough = {name: np.array(at) + (0 if name in "OC" else 6) for name, at in POINTS.items()}
    lengths = {"crank": 40.0, "coupler": np.hypot(80, 80), ("B", "C"): np.hypot(30, 80)}
    linkage = made(points=rough, lengths=lengths, start={"O": 0.0})
    exact = made()
    np.testing.assert_allclose(linkage.q0, exact.q0, atol=1e-9)
    for one, two in zip(linkage.model.inertias, exact.model.inertias):
        assert one.isApprox(two, 1e-12)


def test_three_lengths_make_a_plate() -> None:
    bars = BARS | {"coupler": ("A", "B", "P")}
    lengths = {("A", "B"): 110.0, ("B", "P"): 60.0, ("A", "P"): 80.0}
    linkage = made(points=POINTS | {"P": (60, 60)}, bars=bars, lengths=lengths)
    at = {n: np.array(linkage.points[n].xyz) for n in "BP"}
    assert linkage.points["P"].link == "coupler"
    assert np.linalg.norm(at["P"]) == pytest.approx(0.08)
    (loop,) = linkage.loops
    assert np.linalg.norm(loop.a.xyz) == pytest.approx(0.11)
    assert np.linalg.norm(np.array(loop.a.xyz) - at["P"]) == pytest.approx(0.06)


def test_a_fit_keeps_the_side_of_a_point() -> None:
    drawn = [(0.0, 0.0), (1.0, 0.0), (0.5, -0.4)]
    found = fitted(drawn, {(0, 1): 1.2, (0, 2): 0.9, (1, 2): 0.8})
    assert found[2][1] < 0.0


def test_a_slider_with_mass_is_a_body_and_one_without_a_closure() -> None:
    body = made(PRESS, sliders=RAM)
    assert {"O", "A", "ram"} == set(body.joint_names)
    assert closure_names(body) == {"D": "point"}
    slot = made(PRESS, sliders={"ram": {"point": "D", "along": (1, 0)}})
    assert {"O", "A"} == set(slot.joint_names)
    assert closure_names(slot) == {"ram": "point_on_plane"}
    times = np.linspace(0.0, 1.0, 5)
    light = made(PRESS, sliders={"ram": RAM["ram"] | {"mass": 1e-9}})
    one, two = (finished(each, 1.0, rtol=1e-9).at(times).joint("O")[0] for each in (slot, light))
    np.testing.assert_allclose(one, two, atol=1e-6)


def test_a_slider_without_mass_is_a_joint_where_a_rate_names_it() -> None:
    linkage = made(PRESS, sliders={"ram": {"point": "D", "along": (1, 0)}}, rates={"ram": 0.5})
    assert "ram" in linkage.joint_names
    assert linkage.v0[linkage.joint("ram").idx_v] == 0.5


def test_a_bar_on_two_sliders_needs_no_pin_on_the_ground() -> None:
    """An ellipsograph: the middle of the bar is on a circle."""
    sliders = {"up": {"point": "P", "along": (0, 1)}, "side": {"point": "Q", "along": (1, 0)}}
    linkage = srm.planar(
        points={"P": (0, 1), "Q": (1, 0)},
        bars={"bar": ("P", "Q")},
        ground=(),
        sliders=sliders,
        mass_per_length=1.0,
        rates={"up": -1.0},
    )
    assert linkage.degrees_of_freedom == 1
    solution = finished(linkage, 2.0, rtol=1e-9)
    angle, rate = solution.joint("P")
    length = np.sqrt(2.0)
    height = length * np.sin(angle + np.pi) / 2.0
    energy = length**3 * rate**2 / 6.0 + length * 9.81 * height
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)


def test_the_line_of_a_slider_is_an_angle_a_direction_or_two_points() -> None:
    axes = []
    for along in (45.0, (2, 2), ("O", "A")):
        ram = {"ram": {"point": "D", "along": along, "mass": 1.0}}
        linkage = made(PRESS, sliders=ram, angle="deg")
        axes.append(linkage.q0)
        assert 'axis xyz="0.70710678' in str(linkage.source and linkage.source.urdf)
    np.testing.assert_allclose(axes[1:], [axes[0]] * 2, atol=1e-12)


def test_elements_act_on_points_and_pins() -> None:
    spring = {"a": "A", "b": "C", "stiffness": 50.0, "damping": 2.0, "rest_length": 90.0}
    linkage = made(springs=[spring], torques={"O": 0.5}, loads={"B": (1.0, -2.0)})
    crank, rocker = (srm.Anchor(linkage.points[n].link, xyz=linkage.points[n].xyz) for n in "AB")
    assert linkage.forces == (
        srm.SpringDamper(crank, linkage.points["C"], 50.0, 2.0, 0.09, name="A_C"),
        srm.JointTorque("O", 0.5),
        srm.Wrench(rocker, (1.0, 0.0, -2.0), name="load_B"),
    )


@pytest.mark.parametrize(
    ("given", "law"),
    [
        (90.0, srm.ConstantSpeed(np.pi / 2)),
        ({"type": "sine", "amplitude": 180.0, "omega": 2.0}, srm.Sine(np.pi, omega=2.0)),
        (srm.Polynomial([0.0, 90.0]), srm.Polynomial([0.0, np.pi / 2])),
        (srm.MinimumJerk(90.0, 2.0), srm.MinimumJerk(np.pi / 2, 2.0)),
        (
            srm.Table([0, 1, 2, 3], [0, 90, 180, 270]),
            srm.Table([0, 1, 2, 3], [0, np.pi / 2, np.pi, 1.5 * np.pi]),
        ),
    ],
)
def test_drives_are_in_the_unit_of_angles(given: Any, law: Any) -> None:
    (drive,) = made(drives={"O": given}, angle="deg").drives
    assert drive.joint == "O"
    for t in (0.3, 1.7):
        np.testing.assert_allclose(drive.law.curve()(t), law.curve()(t), atol=1e-12)


def test_a_pin_that_a_drive_moves_is_not_cut() -> None:
    lifted = POINTS | {"A": (30, 30)}  # with the crank on the ground line the pin B cannot turn
    for pin in POINTS:
        assert pin in made(points=lifted, drives={pin: 1.0}).joint_names


def test_loops_are_cut_where_the_user_says() -> None:
    linkage = made(cut=["A"])
    assert closure_names(linkage) == {"A": "point"}
    assert "B" in linkage.joint_names


def as_tables(**linkage: Any) -> dict[str, Any]:
    """The description of a linkage given in Python."""
    planar = {key: value for key, value in linkage.items() if key != "bars"}
    planar["bar"] = [{"name": name, "points": list(p)} for name, p in linkage["bars"].items()]
    planar["points"] = {name: list(map(float, at)) for name, at in linkage["points"].items()}
    return {"format": 1, "name": "linkage", "planar": planar}


def test_a_section_of_a_description_is_the_same_linkage(tmp_path: Path) -> None:
    path = tmp_path / "linkage.toml"
    path.write_text(tomli_w.dumps(as_tables(**changed(FOUR_BAR, ground=["O", "C"]))))
    loaded, typed = srm.load(path), made()
    assert loaded.model == typed.model
    assert loaded.loops == typed.loops
    assert loaded.points == typed.points
    assert loaded.source is not None
    assert typed.source is not None
    assert loaded.source.urdf == typed.source.urdf
    assert loaded.source.description == typed.source.description
    np.testing.assert_array_equal(loaded.q0, typed.q0)


def test_other_sections_of_the_description_name_its_pins_and_bars(tmp_path: Path) -> None:
    lifted = POINTS | {"A": (30, 30)}
    tables = as_tables(**changed(FOUR_BAR, points=lifted, ground=["O", "C"]))
    tables |= {
        "initial": {"v": {"B": 1.0}},
        "force": [{"type": "torsion_spring", "joint": "O", "stiffness": 1.0}],
        "simulation": {"t_end": 2.0},
    }
    path = tmp_path / "linkage.toml"
    path.write_text(tomli_w.dumps(tables))
    loaded = srm.load(path)
    assert "B" in loaded.joint_names
    assert loaded.forces[0].type == "torsion_spring"
    assert loaded.defaults.t_end == 2.0


def test_a_linkage_is_saved_as_urdf_and_description(tmp_path: Path) -> None:
    linkage = made(springs=[{"a": "A", "b": "C", "stiffness": 1.0, "rest_length": 90.0}])
    description, urdf = linkage.save(tmp_path / "four_bar.toml")
    assert urdf.exists()
    assert "planar" not in tomllib.loads(description.read_text())
    again = srm.load(description)
    assert again.model == linkage.model
    assert (again.loops, again.forces) == (linkage.loops, linkage.forces)
    assert again.points == linkage.points
    np.testing.assert_array_equal(again.q0, linkage.q0)


@pytest.mark.parametrize("name", ["klann_walker", "wiper", "scissor_lift", "quick_return"])
def test_a_description_of_points_and_bars_is_converted(name: str, tmp_path: Path) -> None:
    out, _, _ = srm.convert(models_folder() / f"{name}.toml", tmp_path / f"{name}.toml")
    again, linkage = srm.load(out), load(name)
    assert again.model == linkage.model
    assert (again.loops, again.drives) == (linkage.loops, linkage.drives)
    np.testing.assert_array_equal(again.q0, linkage.q0)


def with_parameters(crank: float, **changes: Any) -> srm.Linkage:
    """The four-bar with expressions in every kind of argument."""
    return made(
        points=POINTS | {"A": ("=crank", 0), "B": ("=3*crank", "=2*crank")},
        parameters={"crank": crank, "light": "=crank/400"},
        mass_per_length="=10*light",
        masses={"coupler": "=light"},
        start={"O": "=light"},
        rates={"O": "=crank"},
        springs=[{"a": "A", "b": "C", "stiffness": "=crank", "rest_length": "=2*crank"}],
        torques={"C": "=-light"},
        loads={"B": (0, "=-crank")},
        gravity=(0, "=-245.25*light"),
        **changes,
    )


def typed_in(crank: float) -> srm.Linkage:
    """The same with numbers."""
    light = crank / 400
    return made(
        points=POINTS | {"A": (crank, 0), "B": (3 * crank, 2 * crank)},
        mass_per_length=10 * light,
        masses={"coupler": light},
        start={"O": light},
        rates={"O": crank},
        springs=[{"a": "A", "b": "C", "stiffness": crank, "rest_length": 2 * crank}],
        torques={"C": -light},
        loads={"B": (0, -crank)},
        gravity=(0, -245.25 * light),
    )


def assert_same(one: srm.Mechanism, other: srm.Mechanism) -> None:
    assert one.model == other.model
    assert (one.loops, one.forces) == (other.loops, other.forces)
    assert (one.drives, one.points) == (other.drives, other.points)
    np.testing.assert_array_equal(one.q0, other.q0)
    np.testing.assert_array_equal(one.v0, other.v0)


def test_expressions_over_parameters_stand_for_their_numbers(tmp_path: Path) -> None:
    linkage = with_parameters(40.0)
    assert dict(linkage.parameters) == {"crank": 40.0, "light": 0.1}
    assert_same(linkage, typed_in(40.0))
    copied = pickle.loads(pickle.dumps(linkage))
    for origin in (linkage, copied):
        longer = origin.with_parameters(crank=42.0)
        assert type(longer) is srm.Linkage
        assert_same(longer, typed_in(42.0))
    longer.save(tmp_path / "longer.toml")
    assert_same(srm.load(tmp_path / "longer.toml"), longer)
    assert made(lengths={("A", "B"): "=110 + pi"}).parameters == {}


def test_a_sweep_varies_the_parameters_of_a_linkage_typed_in() -> None:
    linkage = with_parameters(40.0)
    lengths = [39.0, 41.0]
    found = srm.sweep(linkage, None, 0.05, parameters={"crank": lengths})
    for energy, crank in zip(found.table["energy_change"], lengths):
        run = srm.simulate(typed_in(crank), 0.05)
        ends = run.at(run.span).energy
        assert energy == pytest.approx(ends[1] - ends[0], rel=1e-9)


def test_points_are_saved_with_runs(tmp_path: Path) -> None:
    linkage = made()
    finished(linkage, 0.1).save(tmp_path / "run.npz")
    assert srm.load_solution(tmp_path / "run.npz").mechanism.points == linkage.points


def test_any_description_names_points(tmp_path: Path) -> None:
    linkage = made()
    description, _ = linkage.save(tmp_path / "four_bar.toml")
    text = description.read_text() + '[points.tip]\nlink = "coupler"\nxyz = [0.2, 0.0, 0.0]\n'
    description.write_text(text)
    assert srm.load(description).points["tip"] == srm.Anchor("coupler", xyz=(0.2, 0.0, 0.0))


def test_coinciding_pins_are_noted() -> None:
    points = POINTS | {"A2": (40, 0)}
    linkage = made(points=points, bars=BARS | {"tail": ("B", "A2")})
    assert any("'A'" in note and "'A2'" in note for note in linkage.notes)


def refusals() -> dict[str, Callable[[], object]]:
    def case(base: Mapping[str, Any] = FOUR_BAR, **changes: Any) -> Callable[[], object]:
        return lambda: made(base, **changes)

    triangle = {"points": {"O": (0, 0), "A": (1, 2), "C": (2, 0)}, "unit": "m"}
    return {
        "unknown point of a bar": case(bars=BARS | {"rocker": ("B", "X")}),
        "unknown point on the ground": case(ground=("O", "X")),
        "unused point": case(points=POINTS | {"Z": (1, 1)}),
        "coincident points": case(points=POINTS | {"B": (40, 0)}),
        "bar of one point": case(bars=BARS | {"rocker": ("B",)}),
        "point twice in a bar": case(bars=BARS | {"rocker": ("B", "B")}),
        "bar as a text": case(bars=BARS | {"rocker": "BC"}),
        "no bars": case(bars={}),
        "bars as a list": case(bars=["OA"]),
        "a number as a name": case(bars={3: ("O", "A")}),
        "a set of points": case(ground={"O"}),
        "too many points": case(points={f"P{i}": (i, 0) for i in range(2001)}),
        "no ground": case(ground=()),
        "ground twice": case(ground=("O", "C", "O")),
        "bar on the ground": case(bars=BARS | {"frame": ("O", "C")}),
        "loose bar": case(
            points=POINTS | {"P": (0, 50), "Q": (10, 90)}, bars=BARS | {"loose": ("P", "Q")}
        ),
        "loose bars": case(
            points=POINTS | {"P": (0, 50), "Q": (10, 90), "R": (50, 90)},
            bars=BARS | {"one": ("P", "Q"), "two": ("Q", "R")},
        ),
        "structure": case(**triangle, bars={"left": ("O", "A"), "right": ("A", "C")}),
        "no mass": case(mass_per_length=None),
        "inertia without mass": case(masses={"coupler": 0.0}, inertias={"coupler": 1e-4}),
        "bar without mass at a moving end": case(masses={"coupler": 0.0}),
        "two masses": case(
            bars=BARS | {"crank": {"points": ["O", "A"], "mass": 1.0, "mass_per_length": 1.0}}
        ),
        "mass of an unknown bar": case(masses={"cuopler": 0.3}),
        "negative mass": case(masses={"coupler": -0.3}),
        "a mass that is no number": case(masses={"coupler": "heavy"}),
        "unknown unit": case(unit="yd"),
        "reserved name": case(bars=BARS | {"world": ("A", "C")}),
        "colon in a name": case(points=POINTS | {"A:b": (1, 2)}),
        "name of two parts": case(PRESS, sliders={"rod": RAM["ram"]}),
        "name of a slider and a pin": case(PRESS, sliders={"O": RAM["ram"]}),
        "slider of an unknown point": case(PRESS, sliders={"ram": RAM["ram"] | {"point": "X"}}),
        "slider on an unknown bar": case(PRESS, sliders={"ram": RAM["ram"] | {"on": "X"}}),
        "slider on its own bar": case(PRESS, sliders={"ram": RAM["ram"] | {"on": "rod"}}),
        "slider without direction": case(PRESS, sliders={"ram": RAM["ram"] | {"along": (0, 0)}}),
        "slider along three numbers": case(
            PRESS, sliders={"ram": RAM["ram"] | {"along": (0, 0, 1)}}
        ),
        "slider without anything": case(
            PRESS,
            points=PRESS["points"] | {"E": (4, 4)},
            sliders=RAM | {"nothing": {"point": "E", "along": 0.0}},
        ),
        "slider that is no table": case(PRESS, sliders={"ram": "D"}),
        "unknown pin of a torque": case(torques={"X": 1.0}),
        "several joints at a pin": case(
            points=POINTS | {"D": (90, -50)}, bars=BARS | {"tail": ("A", "D")}, rates={"A": 1.0}
        ),
        "every joint of a loop is driven": case(drives=dict.fromkeys(POINTS, 1.0)),
        "spring on an unknown point": case(springs=[{"a": "A", "b": "X"}]),
        "spring on a point of no bar": case(
            points=POINTS | {"S": (0, 90)}, springs=[{"a": "A", "b": "S"}]
        ),
        "spring within a bar": case(springs=[{"a": "A", "b": "B"}]),
        "spring without a length": case(springs=[{"a": "A", "b": "C", "stiffness": 1.0}]),
        "load on the ground": case(loads={"C": (1.0, 0.0)}),
        "one length of a plate": case(
            points=POINTS | {"P": (60, 60)},
            bars=BARS | {"coupler": ("A", "B", "P")},
            lengths={"coupler": 90.0},
        ),
        "length between bars": case(lengths={("O", "B"): 90.0}),
        "length of an unknown bar": case(lengths={"X": 90.0}),
        "lengths that make no triangle": case(
            points=POINTS | {"P": (60, 60)},
            bars=BARS | {"coupler": ("A", "B", "P")},
            lengths={("A", "B"): 110.0, ("B", "P"): 20.0, ("A", "P"): 20.0},
        ),
        "lengths that do not close": case(lengths={"coupler": 900.0}),
        "start that does not close": case(start={"O": 0.1, "C": 0.1}, angle="deg"),
        "start of every pin": case(start={"O": 0.1, "A": 0.1, "C": 0.1}),
        "rates that do not close": case(rates={"O": 1.0, "C": 0.1}),
        "drives that do not close": case(drives={"O": 1.0, "C": 2.0}),
        "unknown law": case(drives={"O": {"type": "fast"}}),
        "table of a file in degrees": case(
            drives={"O": {"type": "table", "table": "motion.csv"}}, angle="deg"
        ),
        "unknown joint to cut": case(cut=["X"]),
        "gravity of three numbers": case(gravity=(0.0, 0.0, -9.81)),
        "unknown parameter": case(masses={"coupler": "=light"}, parameters={"crank": 1.0}),
        "parameters as a list": case(parameters=["crank"]),
        "an expression that is none": case(mass_per_length="=2*"),
        "a value that nothing uses": lambda: with_parameters(40.0).with_parameters(rod=1.0),
    }


def test_refusals_name_the_point_or_bar() -> None:
    check_messages("planar", {name: refused(call) for name, call in refusals().items()})


def test_refusals_of_a_description_name_its_file(tmp_path: Path) -> None:
    tables = as_tables(**changed(FOUR_BAR, ground=["O", "C"]))

    def load_changed(**changes: Any) -> Callable[[], object]:
        path = tmp_path / "linkage.toml"

        def call() -> object:
            path.write_text(tomli_w.dumps({**tables, **changes}))
            return srm.load(path)

        return call

    calls = {
        "two sources": load_changed(urdf="linkage.urdf"),
        "floating base": load_changed(base="floating"),
        "point on an unknown link": load_changed(points={"tip": {"link": "X"}}),
        "point without a link": load_changed(points={"tip": {"xyz": [0.0, 0.0, 0.0]}}),
        "start that does not close": load_changed(planar=tables["planar"] | {"start": {"C": 0.1}}),
        "start that does not close, outside of the section": load_changed(
            initial={"q": {"C": 0.1}}
        ),
        "no points": load_changed(planar={"bar": [], "ground": []}),
        "unknown key": load_changed(planar={"points": {}, "bar": [], "ground": [], "bars": []}),
    }
    messages = {name: refused(call, tmp_path) for name, call in calls.items()}
    check_messages("planar_files", messages)


@pytest.mark.parametrize(
    ("base", "start", "moved", "unit"),
    [
        (changed(FOUR_BAR, angle="deg"), {"O": 0.1, "C": 0.1}, "C", math.pi / 180.0),
        (changed(PRESS, sliders=RAM, unit="cm"), {"O": 0.9, "ram": 1.0}, "ram", 0.01),
    ],
    ids=["pins in degrees", "a slide in centimetres"],
)
def test_a_start_that_does_not_close_is_refused_with_one_in_its_units_that_does(
    base: dict[str, Any], start: dict[str, float], moved: str, unit: float
) -> None:
    with pytest.raises(srm.AssemblyError) as caught:
        made(base, start=start)
    assert caught.value.element == "planar.start"
    found = re.search(rf"\({moved} = (\S+) (deg|cm)\)", str(caught.value))
    assert found is not None
    linkage = made(base, start={"O": start["O"]})
    closed = position_of(linkage, linkage.q0, moved)
    assert unit * float(found[1]) == pytest.approx(closed, rel=1e-8)


def test_a_variant_names_the_start_that_does_not_close() -> None:
    linkage = made(start={"C": "=angle"}, parameters={"angle": 1.9})
    with pytest.raises(srm.AssemblyError) as caught:
        linkage.with_parameters(angle=0.1)
    assert caught.value.element == "planar.start"


@pytest.mark.parametrize(
    ("angle", "value", "said"),
    [
        ("rad", 30.0, "angle 30 of the joint 'O' .*: angles are in rad, and 30 degrees are 0.52"),
        ("deg", 1000.0, "angle 1000 of the joint 'O' is more than two turns: angles are in deg$"),
    ],
)
def test_a_start_of_more_than_two_turns_is_named_as_it_is_written(
    angle: str, value: float, said: str
) -> None:
    with pytest.warns(srm.SrmWarning, match=rf"planar\.start: the {said}") as caught:
        linkage = made(angle=angle, start={"O": "=turned"}, parameters={"turned": value})
    assert len(caught) == 1
    with pytest.warns(srm.SrmWarning, match=r"planar\.start: the angle \S+ of the joint 'O'"):
        linkage.with_parameters(turned=1.01 * value)


class Doubled(srm.Sine):
    """A law with the fields of a sine, and twice its motion."""

    def curve(self, initial: float = 0.0) -> Curve:
        curve = super().curve(initial)
        return replace(curve, sines=tuple((2.0 * a, w, p) for a, w, p in curve.sines))


def test_a_drive_whose_law_no_description_can_have_is_refused() -> None:
    with pytest.raises(srm.InputError, match=r"drives: Doubled\(.* is not a law that a descr"):
        made(drives={"O": Doubled(amplitude=0.1, omega=3.0)})


def test_a_linkage_is_sent_to_other_processes() -> None:
    linkage = made()
    copied = pickle.loads(pickle.dumps(linkage))
    assert type(copied) is srm.Linkage
    assert copied.points == linkage.points
    np.testing.assert_array_equal(copied.q0, linkage.q0)


@pytest.mark.parametrize("points", [3, {"tip": "rod"}, {3: srm.Anchor("crank")}])
def test_points_of_a_mechanism_are_anchors_by_name(points: Any) -> None:
    with pytest.raises(srm.InputError, match="points"):
        replace(load("four_bar"), points=points)


def test_points_of_a_mechanism_are_on_its_links() -> None:
    with pytest.raises(srm.InputError, match=r"point 'tip': there is no link 'X'"):
        replace(load("four_bar"), points={"tip": srm.Anchor("X")})
    tip = srm.Anchor("coupler", xyz=(2.0, 0.0, 0.0))
    assert replace(load("four_bar"), points={"tip": tip}).points == {"tip": tip}


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"v0": np.ones(3)}, "v0"),
        ({"actuators": {"motor": srm.Actuator("O")}}, "actuators"),
        ({"name": "other", "forces": (srm.TorsionSpring("O", stiffness=1.0),)}, "forces, name"),
    ],
)
def test_a_linkage_that_was_changed_is_not_saved(
    tmp_path: Path, changes: dict[str, Any], named: str
) -> None:
    other = replace(made(), **changes)
    with pytest.raises(srm.InputError, match=f"changed after srm.planar made it: {named}. Give"):
        other.save(tmp_path / "out.toml")
    assert not list(tmp_path.iterdir())
