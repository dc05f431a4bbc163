"""Variants reuse the load-time analysis where it is valid; texts are made when asked for."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.constraints import structure as structures
from srm_mbs.dynamics.constraints.reusable_analysis import ReusableAnalysis
from srm_mbs.dynamics.constraints.rheonomic import unscaled_rows
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from srm_mbs.dynamics.scaling import anchor_points
from srm_mbs.formats.planar.drawing import Drawing

FOUR_BAR = """format = 1
name = "bars"
[parameters]
crank = 0.4
ground = 1.0
mass = 1.0
[planar]
ground = ["O", "C"]
mass_per_length = "=mass"
rates = { O = 3.0 }
[planar.points]
O = [0, 0]
A = ["=0.6*crank", "=0.8*crank"]
B = ["=0.6*crank + 0.8*ground", "=0.8*crank + 0.3*ground"]
C = ["=ground", 0]
[[planar.bar]]
name = "crank"
points = ["O", "A"]
[[planar.bar]]
name = "coupler"
points = ["A", "B"]
[[planar.bar]]
name = "rocker"
points = ["B", "C"]
"""


@pytest.fixture
def bars(tmp_path: Path) -> Path:
    path = tmp_path / "bars.toml"
    path.write_text(FOUR_BAR, encoding="utf-8")
    return path


class Analyses:
    """Counts the analyses that are made."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count = 0
        made = structures.analyse

        def analyse(mechanism: Any) -> Any:
            self.count += 1
            return made(mechanism)

        monkeypatch.setattr(structures, "analyse", analyse)


def test_a_load_makes_one_analysis(monkeypatch: pytest.MonkeyPatch) -> None:
    analyses = Analyses(monkeypatch)
    for name in ("four_bar", "klann_walker", "slider_crank"):
        srm.load(name)
    assert analyses.count == 3


def test_a_similar_variant_reuses_the_analysis_and_moves_as_one_with_its_own(
    bars: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = srm.load(bars)
    analyses = Analyses(monkeypatch)
    variant = base.with_parameters(crank=0.45, mass=2.0)
    assert analyses.count == 0
    assert variant.structure.units.length != base.structure.units.length
    fresh = srm.load(bars, parameters={"crank": 0.45, "mass": 2.0})
    assert analyses.count == 1
    assert np.array_equal(variant.q0, fresh.q0)
    assert np.array_equal(variant.v0, fresh.v0)
    for name in ("rank", "loop_rank", "redundant_rows", "notes"):
        assert getattr(variant.structure, name) == getattr(fresh.structure, name)
    assert variant.mobility == fresh.mobility
    one, other = (srm.simulate(each, 2.0, rtol=1e-10) for each in (variant, fresh))
    times = np.linspace(0.0, 2.0, 9)
    assert np.abs(one(times)[0] - other(times)[0]).max() < 1e-7


PRESS = """format = 1
[parameters]
crank = 0.1
mass = 2.0
along = 90.0
stiffness = 100.0
fixed = 0.0
[planar]
angle = "deg"
ground = ["O", "G"]
mass_per_length = 1.0
[planar.points]
O = [0, 0]
A = ["=crank", 0]
K = [0.4, 0.1]
G = [0.4, "=0.5 + fixed"]
D = [0.4, -0.3]
[[planar.bar]]
name = "crank"
points = ["O", "A"]
[[planar.bar]]
name = "rod"
points = ["A", "K"]
mass = "=mass"
[[planar.bar]]
name = "upper"
points = ["G", "K"]
[[planar.bar]]
name = "lower"
points = ["K", "D"]
[[planar.slider]]
name = "ram"
point = "D"
along = "=along"
mass = "=mass"
[[planar.spring]]
a = "G"
b = "D"
stiffness = "=stiffness"
rest_length = 0.5
"""


@pytest.mark.parametrize(
    "values",
    [
        {"crank": 0.12},
        {"crank": 0.12, "mass": 2.5},
        {"mass": 3.0, "fixed": 0.01},
        {"stiffness": 50.0, "crank": 0.11},
        {"along": 89.0},
    ],
)
def test_a_variant_is_the_mechanism_of_a_load_bit_by_bit(
    values: dict[str, float], tmp_path: Path
) -> None:
    """With places, masses and forces that vary, and another line of a slide."""
    path = tmp_path / "press.toml"
    path.write_text(PRESS, encoding="utf-8")
    _check_same(srm.load(path).with_parameters(**values), srm.load(path, parameters=values))


def _check_same(variant: srm.Mechanism, fresh: srm.Mechanism) -> None:
    assert variant.model == fresh.model
    for one, other in zip(variant.model.inertias, fresh.model.inertias):
        assert np.array_equal(one.toDynamicParameters(), other.toDynamicParameters())
    for name in ("loops", "forces", "drives", "points", "notes", "source", "parameters"):
        assert getattr(variant, name) == getattr(fresh, name), name
    for name in ("q0", "v0"):
        assert np.array_equal(getattr(variant, name), getattr(fresh, name))


LIFT = """format = 1
[parameters]
reach = 0.3
long = 0.8
wide = 0.31
flywheel = 0.02
offset = 0.01
block = 0.5
spin = 0.04
density = 2.0
speed = 1.5
ends = 0.0
[planar]
ground = ["O", "C", "S"]
mass_per_length = "=density"
rates = { O = "=speed" }
[planar.points]
O = [0, 0]
A = ["=0.6*reach", "=0.8*reach"]
B = [0.8, 0.5]
C = [0.9, 0]
P = [0.5, "=0.6 + ends"]
Q = [1.0, 0.7]
S = [0.2, 1.4]
[[planar.bar]]
name = "crank"
points = ["O", "A"]
inertia = "=flywheel"
centre = ["=offset", 0]
mass = 1.0
[[planar.bar]]
name = "plate"
points = ["A", "B", "P"]
[[planar.bar]]
name = "rocker"
points = ["B", "C"]
length = "=0.7*long"
[[planar.bar]]
name = "link"
points = ["P", "Q"]
[[planar.slider]]
name = "block"
point = "Q"
along = 0.3
mass = "=block"
inertia = "=spin"
[[planar.length]]
between = ["B", "P"]
length = "=wide"
[[planar.spring]]
a = "S"
b = "P"
stiffness = 30.0
rest_length = 0.2
[[planar.load]]
point = "P"
force = [0, -1]
"""


@pytest.mark.parametrize(
    "values",
    [
        {"reach": 0.29},
        {"long": 0.82, "offset": 0.02},
        {"wide": 0.32, "flywheel": 0.03},
        {"block": 0.6, "spin": 0.05},
        {"density": 2.5},
        {"speed": 2.0},
        {"ends": 0.01},
        {"block": 0.0},
    ],
)
def test_a_variant_with_plates_lengths_and_loads_is_the_mechanism_of_a_load(
    values: dict[str, float], tmp_path: Path
) -> None:
    path = tmp_path / "lift.toml"
    path.write_text(LIFT, encoding="utf-8")
    base = srm.load(path)
    _check_same(base.with_parameters(**values), srm.load(path, parameters=values))


def test_only_the_numbers_of_a_variant_are_read(
    bars: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The drawing is not translated again, until a text is asked for."""
    base = pickle.loads(pickle.dumps(srm.load(bars)))
    drawn = []
    draw = Drawing.__init__

    def counted(self: Drawing, *given: Any) -> None:
        drawn.append(given)
        draw(self, *given)

    monkeypatch.setattr(Drawing, "__init__", counted)
    variant = base.with_parameters(crank=0.45, mass=2.0)
    assert not drawn
    assert variant.source is not None
    assert "<visual>" in variant.source.urdf
    assert len(drawn) == 1


def test_rows_of_a_variant_are_those_of_its_own_closures(bars: Path) -> None:
    """They are those of the base in other places, not resolved against the tree again."""
    variant = srm.load(bars).with_parameters(crank=0.45)
    assert structures.rows_in_use.kept(variant) is not None
    structure, loops = variant.structure, variant.loops
    built = LoopKinematics(variant.model, loops)
    in_use = LoopKinematics(
        variant.model, loops, structure.row_scale, structure.kept, structure.eliminations
    )
    for rows, own in ((unscaled_rows(variant), built), (structures.rows_in_use(variant), in_use)):
        (found,), (expected,) = rows.constants()["loops"], own.constants()["loops"]
        for key, value in expected.items():
            assert np.array_equal(found[key], value), key
    places = [anchor.resolve(variant.model) for anchor in loops[0].anchors]
    assert anchor_points(variant) == [
        (joint, place.translation.tolist()) for joint, place in places
    ]


def test_a_variant_with_a_fault_is_refused_as_a_load_is(tmp_path: Path) -> None:
    path = tmp_path / "press.toml"
    path.write_text(PRESS, encoding="utf-8")
    base = srm.load(path)
    for values in ({"crank": 0.0}, {"mass": -1.0}, {"mass": 0.0}, {"fixed": -0.4}, {"along": 1e31}):
        refusals = []
        for make in (
            lambda given: base.with_parameters(**given),
            lambda given: srm.load(path, parameters=given),
        ):
            with pytest.raises((srm.InputError, srm.AssemblyError)) as refused:
                make(values)
            refusals.append(str(refused.value))
        assert refusals[0] == refusals[1]


def test_doubts_about_a_variant_are_those_of_a_load(tmp_path: Path) -> None:
    path = tmp_path / "press.toml"
    rod = 'points = ["A", "K"]\n'
    text = PRESS.replace(rod, f'{rod}inertia = "=moment"\n')
    path.write_text(text.replace("mass = 2.0", "mass = 2.0\nmoment = 0.03"), encoding="utf-8")
    base = srm.load(path)
    for moment in (1e6, 1e-9):
        with pytest.warns(srm.SrmWarning, match="radius of gyration"):
            variant = base.with_parameters(moment=moment)
        with pytest.warns(srm.SrmWarning, match="radius of gyration"):
            fresh = srm.load(path, parameters={"moment": moment})
        assert variant.notes == fresh.notes != base.notes


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"mass": 1e-3}, "rows are 30 times as long in the mass metric"),
        ({"ground": 100.0, "crank": 40.0}, "so are they with other lengths"),
    ],
)
def test_a_variant_of_other_scales_is_analysed_itself(
    bars: Path, values: dict[str, float], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = srm.load(bars)
    analyses = Analyses(monkeypatch)
    variant = base.with_parameters(**values)
    assert analyses.count == 1, why
    fresh = srm.load(bars, parameters=values)
    assert variant.structure.sigma_ref == fresh.structure.sigma_ref
    assert np.array_equal(variant.structure.row_scale, fresh.structure.row_scale)


def test_an_analysis_of_other_closures_is_refused(bars: Path) -> None:
    base = srm.load(bars)
    analysis = ReusableAnalysis.of(base)
    assert analysis is not None
    assert analysis.for_variant(base) is not None
    assert analysis.for_variant(srm.load("four_bar")) is None  # another name of the loop
    loop = base.loops[0]
    flat = srm.LoopClosure("point_on_plane", loop.a, loop.b, axis=(1.0, 0.0, 0.0), name=loop.name)
    assert analysis.for_variant(base.without_loop(loop.name).with_loop(flat)) is None


def test_a_start_that_is_open_refuses_the_analysis_of_another(bars: Path) -> None:
    base = srm.load(bars)
    analysis = ReusableAnalysis.of(base)
    assert analysis is not None
    loop = base.loops[0]
    far = srm.Anchor(link=loop.b.link, xyz=(50.0, 0.0, 0.0))
    beyond = srm.LoopClosure("point", loop.a, far, name=loop.name)
    assert analysis.for_variant(base.without_loop(loop.name).with_loop(beyond)) is None


def test_variants_do_not_depend_on_the_order_in_which_they_are_made(bars: Path) -> None:
    base = srm.load(bars)
    direct = base.with_parameters(crank=0.42, mass=1.5)
    for way in (
        base.with_parameters(mass=1e-3).with_parameters(crank=0.42, mass=1.5),
        pickle.loads(pickle.dumps(base.with_parameters(crank=0.3))).with_parameters(
            crank=0.42, mass=1.5
        ),
    ):
        assert way.structure.sigma_ref == direct.structure.sigma_ref
        assert np.array_equal(way.structure.row_scale, direct.structure.row_scale)
        assert np.array_equal(way.q0, direct.q0)


def test_texts_of_a_linkage_are_those_of_its_numbers(bars: Path, tmp_path: Path) -> None:
    variant = srm.load(bars).with_parameters(crank=0.45)
    source, copied = variant.source, pickle.loads(pickle.dumps(variant)).source
    assert source is not None
    assert "<visual>" in source.urdf
    assert source == copied
    assert source.urdf == srm.load(bars, parameters={"crank": 0.45}).source.urdf  # type: ignore[union-attr]
    with pytest.raises(AttributeError, match="no attribute 'text'"):
        _ = source.text  # type: ignore[attr-defined]
    written = tmp_path / "written"
    written.mkdir()
    (written / "bars.toml").write_text(source.description, encoding="utf-8")
    (written / "bars.urdf").write_text(source.urdf, encoding="utf-8")
    again = srm.load(written / "bars.toml")
    assert again.model == variant.model
    assert np.abs(again.q0 - variant.q0).max() < 1e-12
