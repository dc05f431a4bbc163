"""Values that look like those of other units, and axes that keep a loop from moving."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.formats.load import models_folder
from tests.support.bundled import load


@pytest.fixture
def changed(tmp_path: Path) -> Callable[..., Path]:
    """A bundled mechanism whose description and URDF have other texts."""

    def written(
        urdf: Callable[[str], str] = str, toml: Callable[[str], str] = str, name: str = "four_bar"
    ) -> Path:
        folder = models_folder()
        tree = (folder.parent / "urdf" / f"{name}.urdf").read_text(encoding="utf-8")
        text = (folder / f"{name}.toml").read_text(encoding="utf-8")
        (tmp_path / f"{name}.urdf").write_text(urdf(tree), encoding="utf-8")
        path = tmp_path / f"{name}.toml"
        path.write_text(toml(text.replace("../urdf/", "")), encoding="utf-8")
        return path

    return written


def doubts(path: Path) -> list[str]:
    """The warnings of a load, all of which are notes of the mechanism too."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        mechanism = srm.load(path)
    said = [str(each.message) for each in found]
    assert all(each.category is srm.SrmWarning for each in found)
    assert said == [f"{path}: {note}" for note in mechanism.notes]
    return said


def with_factor(tag: str, keys: str, factor: float) -> Callable[[str], str]:
    """Multiplies attributes of all elements ``tag``."""

    def number(found: re.Match[str]) -> str:
        return f'{found[1]}="{float(found[2]) * factor!r}"'

    def element(found: re.Match[str]) -> str:
        return re.sub(f'({keys})="([^"]*)"', number, found[0])

    return lambda text: re.sub(f"<{tag} [^>]*>", element, text)


def with_axis(joint: str, axis: str) -> Callable[[str], str]:
    """Gives a joint another axis."""

    def apply(text: str) -> str:
        at = text.index("<axis", text.index(f'<joint name="{joint}"'))
        return f'{text[:at]}<axis xyz="{axis}"{text[text.index("/>", at) :]}'

    return apply


@pytest.mark.parametrize(
    ("where", "old", "new", "radians"),
    [
        ("initial.q", "q = { crank = 1.0 }", "q = { crank = 60.0 }", "60 degrees are 1.0472 rad"),
        (
            "initial.guess",
            "coupler = -0.674",
            "coupler = -38.6",
            "-38.6 degrees are -0.673697 rad",
        ),
    ],
)
def test_an_angle_of_a_start_above_two_turns_is_doubted(
    changed: Callable[..., Path], where: str, old: str, new: str, radians: str
) -> None:
    (said,) = doubts(changed(toml=lambda text: text.replace(old, new)))
    assert f"{where}: the angle" in said
    assert radians in said


def test_rotations_of_frames_above_two_turns_are_doubted(changed: Callable[..., Path]) -> None:
    place = r'(<joint name="coupler".*?xyz="1 0 0")'
    turned = partial(re.sub, place, r'\1 rpy="0 360 0"', flags=re.DOTALL)
    (said,) = doubts(changed(lambda text: turned(text)))
    assert "joint 'coupler': the angle 360 of rpy is more than two turns" in said
    assert "360 degrees are 6.28319 rad" in said
    old, new = "xyz = [2.0, 0.0, 0.0]", "xyz = [2.0, 0.0, 0.0], rpy = [0, -90, 0]"
    (said,) = doubts(changed(toml=lambda text: text.replace(old, new)))
    assert "loop 'pin': the angle -90 of rpy" in said


def test_an_angle_in_degrees_is_a_hint_where_loops_do_not_close(
    changed: Callable[..., Path],
) -> None:
    start, guess = "q = { crank = 1.0 }", "rocker = 1.413"
    held = changed(
        toml=lambda text: text.replace(start, "q = { rocker = 60.0 }").replace(guess, "crank = 1.0")
    )
    with pytest.raises(srm.AssemblyError, match=r"60 degrees are 1\.0472 rad") as caught:
        srm.load(held)
    assert "nearest values that close" in str(caught.value)


def test_positions_of_slides_are_no_angles() -> None:
    slide = srm.planar(
        points={"O": (0, 0), "A": (20, 0), "D": (60, 0)},
        bars={"crank": ("O", "A"), "rod": ("A", "D")},
        sliders={"ram": {"point": "D", "along": (1, 0), "mass": 2.0}},
        ground=("O",),
        mass_per_length=1.0,
        start={"ram": -20.0},
    )
    assert slide.notes == ()


@pytest.mark.parametrize("factor", [1e6, 1e-6])
def test_moments_of_inertia_in_other_units_than_the_lengths_are_doubted(
    changed: Callable[..., Path], factor: float
) -> None:
    """Bars of length l have a radius of gyration of l/sqrt(12): 1000 times too long or short."""
    said = doubts(changed(with_factor("inertia", "i..", factor)))
    assert len(said) == 3
    for text, (name, length) in zip(said, {"crank": 1.0, "coupler": 2.0, "rocker": 1.5}.items()):
        assert f"the body of the joint {name!r} ({name!r}) has a radius of gyration of" in text
        given = float(text.split("gyration of ")[1].split()[0])
        assert given == pytest.approx(np.sqrt(factor / 12.0) * length, rel=0.01)


def test_lengths_in_millimetres_beside_inertias_in_si_units_are_doubted() -> None:
    given = {"O": (0, 0), "A": (40, 0), "B": (120, 80), "C": (150, 0)}
    bars = {"crank": ("O", "A"), "coupler": ("A", "B"), "rocker": ("B", "C")}
    masses, inertias = dict.fromkeys(bars, 0.1), dict.fromkeys(bars, 1e-5)
    with pytest.warns(
        srm.SrmWarning, match=r"size of [0-9.]+ m: lengths are in m \(1 mm is 0.001 m"
    ):
        srm.planar(points=given, bars=bars, ground=["O", "C"], masses=masses, inertias=inertias)
    srm.planar(
        points=given, bars=bars, ground=["O", "C"], masses=masses, inertias=inertias, unit="mm"
    )


def _enlarged(factor: float, mass: float) -> Callable[[str], str]:
    """A URDF with lengths ``factor``, and masses ``mass``, times as large."""
    moments = with_factor("inertia", "i..", mass * factor**2)
    masses = with_factor("mass", "value", mass)

    def place(found: re.Match[str]) -> str:
        return f'xyz="{" ".join(repr(factor * float(x)) for x in found[1].split())}"'

    def urdf(text: str) -> str:
        return moments(masses(re.sub(r'(?<!axis )xyz="([^"]*)"', place, text)))

    return urdf


def _enlarged_closure(factor: float) -> Callable[[str], str]:
    return lambda text: text.replace("[2.0, 0.0, 0.0]", f"[{factor * 2.0!r}, 0.0, 0.0]").replace(
        "[1.5, 0.0, 0.0]", f"[{factor * 1.5!r}, 0.0, 0.0]"
    )


def test_lengths_and_moments_of_inertia_in_millimetres_are_doubted(
    changed: Callable[..., Path],
) -> None:
    (said,) = doubts(changed(_enlarged(1e3, 1.0), _enlarged_closure(1e3)))
    assert "lighter than air" in said
    assert "lengths are in m (1 mm is 0.001 m)" in said
    # Cuboids of the bundled bars: 0.1 m wide, 4.5 m long together, 4.5 kg, 1000 times larger.
    mechanism_density = float(re.search(r"\((.*) kg/m\^3\)", said)[1])
    original = srm.load("four_bar")
    volume = 0.0
    for body in original.model.inertias.tolist()[1:]:
        moments = np.linalg.eigvalsh(body.inertia)
        volume += np.sqrt(np.prod(6.0 * (moments.sum() - 2.0 * moments) / body.mass))
    mass = sum(body.mass for body in original.model.inertias.tolist()[1:])
    assert mechanism_density == pytest.approx(mass / volume * 1e-9, rel=0.06)  # of one digit


@pytest.mark.parametrize(("factor", "mass"), [(1e2, 1e6), (1e3, 1e9), (1e-3, 1e-9), (1e-6, 1e-18)])
def test_large_and_small_mechanisms_of_the_density_of_bodies_are_not_doubted(
    changed: Callable[..., Path], factor: float, mass: float
) -> None:
    assert doubts(changed(_enlarged(factor, mass), _enlarged_closure(factor))) == []


def test_moments_of_inertia_without_a_mass_are_doubted(changed: Callable[..., Path]) -> None:
    (said,) = doubts(changed(lambda text: text.replace('mass value="1"', 'mass value="0"')))
    assert "the body of the joint 'crank' ('crank') has moments of inertia, 0.08" in said
    assert "and no mass" in said


@pytest.mark.parametrize("name", srm.bundled_models())
def test_no_bundled_mechanism_is_doubted(name: str) -> None:
    load(name)  # warnings are errors


@pytest.mark.parametrize("axis", ["0 0 1", "0 -1 0.001"])
@pytest.mark.parametrize("joint", ["crank", "coupler", "rocker"])
def test_an_inclined_axis_in_a_planar_loop_is_the_cause_that_is_named(
    changed: Callable[..., Path], joint: str, axis: str
) -> None:
    with pytest.raises(srm.AssemblyError) as raised:
        srm.load(changed(with_axis(joint, axis)))
    others = ", ".join(repr(name) for name in ("crank", "coupler", "rocker") if name != joint)
    angle = "90" if axis == "0 0 1" else "0.0573"
    assert raised.value.element == f"joint {joint!r}"
    assert raised.value.problem.startswith(
        f"in the loop 'pin' the axis of the joint {joint!r} is inclined by {angle} degrees to "
        f"those of {others}, which are parallel: the loops cannot be closed; remaining gaps: pin"
    )
    assert raised.value.residuals["pin"][0] > 1e-5  # type: ignore[operator]


def as_hinge(axis: str) -> Callable[[str], str]:
    """Makes a hinge of the closure."""

    def apply(text: str) -> str:
        return text.replace('type = "point"', f'type = "revolute"\naxis = {axis}')

    return apply


def test_an_inclined_axis_of_a_closure_is_the_cause_that_is_named(
    changed: Callable[..., Path],
) -> None:
    with pytest.raises(srm.AssemblyError) as raised:
        srm.load(changed(toml=as_hinge("[2.0, 0.0, 0.0]")))
    assert raised.value.element == "loop 'pin'"
    assert raised.value.problem.startswith(
        "in the loop 'pin' the axis of the closure is inclined by 90 degrees to those of 'crank', "
        "'coupler', 'rocker', which are parallel: the loops cannot be closed"
    )


def test_a_closure_with_the_axis_of_two_joints_tells_which_third_is_inclined(
    changed: Callable[..., Path],
) -> None:
    with pytest.raises(srm.AssemblyError) as raised:
        srm.load(changed(with_axis("crank", "0 0 1"), as_hinge("[0.0, 1.0, 0.0]")))
    assert raised.value.element == "joint 'crank'"
    assert "to those of 'coupler', 'rocker', 'pin', which" in raised.value.problem


def test_loops_that_close_and_cannot_move_for_an_inclined_axis_are_doubted(
    changed: Callable[..., Path],
) -> None:
    """All joints of this mechanism are zero where its loops are closed, whatever its axes."""
    path = changed(with_axis("rocker", "0 -1 0.5"), _at_rest, "watt_six_bar")
    (said,) = doubts(path)
    assert "the mechanism cannot move: in the loop" in said
    assert "the axis of the joint 'rocker' is inclined by 26.6 degrees" in said


def _at_rest(text: str) -> str:
    return re.sub(r"\nv = .*", "", text)


def test_spatial_loops_keep_their_own_diagnosis() -> None:
    mechanism = load("spatial_slider_crank")
    with pytest.raises(srm.AssemblyError) as raised:
        srm.assemble(mechanism, q=dict.fromkeys(mechanism.joint_names[:2], 3.0))
    assert "inclined" not in str(raised.value)
