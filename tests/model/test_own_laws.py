"""Laws of one's own, which drives and forces follow (docs/extending.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.analysis.summary import drive_rows, force_rows
from srm_mbs.model.laws import Curve, Law
from tests.support.backends import on_both


class TwoSines(Law):
    """0.2 sin 3 t + 0.1 sin 7 t, from the initial value."""

    type = "two_sines"

    def curve(self, initial: float = 0.0) -> Curve:
        return Curve(pieces=((initial,),), sines=((0.2, 3.0, 0.0), (0.1, 7.0, 0.0)))


class Doubled(srm.Sine):
    """A law with the fields of a sine, and twice its motion."""

    def curve(self, initial: float = 0.0) -> Curve:
        curve = super().curve(initial)
        return replace(curve, sines=tuple((2.0 * a, w, p) for a, w, p in curve.sines))


class Given(Law):
    """The curve that it is given."""

    type = "given"

    def __init__(self, curve: Any, knots: Sequence[float] = ()) -> None:
        self._curve, self._knots = curve, knots

    def curve(self, initial: float = 0.0) -> Curve:
        return self._curve  # type: ignore[no-any-return]

    @property
    def knots(self) -> Sequence[float]:
        return self._knots


def driven(law: Law) -> srm.Mechanism:
    mechanism = srm.load("slider_crank_regular")
    mechanism = replace(mechanism, drives=[srm.Drive(law, joint="crank")])
    start = srm.assemble(mechanism, mechanism.q0)
    return mechanism.with_state(start.q, start.v)


@on_both
@pytest.mark.parametrize(
    ("law", "moved"),
    [
        (TwoSines(), 0.2 * np.sin(3.0) + 0.1 * np.sin(7.0)),
        (Doubled(amplitude=0.2, omega=3.0), 0.4 * np.sin(3.0)),
        # t^3 until 0.5 s, then its tangent parabola, from its value there.
        (
            Given(Curve((0.0, 0.5), ((0.0, 0.0, 0.0, 1.0), (0.125, 0.75, 1.5, 0.0))), [0.5]),
            0.125 + 0.75 * 0.5 + 1.5 * 0.25,
        ),
    ],
    ids=["inherits from Law", "inherits from Sine", "two pieces"],
)
def test_a_drive_follows_a_law_of_ones_own_exactly(law: Law, moved: float, backend: str) -> None:
    mechanism = driven(law)
    run = srm.simulate(mechanism, 1.0, rtol=1e-9, backend=backend)
    assert run.joint("crank")[0][-1] == pytest.approx(mechanism.q0[0] + moved, abs=1e-12)
    assert run.energy_balance.relative < 1e-9


@pytest.mark.parametrize(
    ("piece", "said"),
    [
        ((0.7, 1.0), "its position jumps from 0.5 to 0.7 at t = 0.5 s"),
        ((0.5, 3.0), "its rate jumps from 1 to 3 at t = 0.5 s"),
    ],
)
@pytest.mark.parametrize("knots", [[], [0.5]], ids=["unknown", "knot"])
def test_a_drive_whose_law_jumps_is_refused(
    piece: tuple[float, float], said: str, knots: list[float]
) -> None:
    """No motion follows it: the closures would stay open by the jump."""
    law = Given(Curve((0.0, 0.5), ((0.0, 1.0), piece)), knots)
    with pytest.raises(srm.InputError, match=f"drive 'crank': {said}, by its law 'given'"):
        driven(law)


def test_jumps_before_the_start_and_of_forces_are_no_jumps_of_a_drive() -> None:
    start = Curve((-1.0, 0.0), ((0.0, 0.0), (0.0, 1.0)))  # at rest until 0
    assert srm.simulate(driven(Given(start)), 0.2).success
    push = srm.JointTorque("crank", law=Given(Curve((0.0, 0.1), ((0.0,), (1.0,))), [0.1]))
    pushed = replace(srm.load("slider_crank_regular"), forces=[push])
    assert srm.simulate(pushed, 0.2).success


@on_both
def test_a_torque_follows_a_law_of_ones_own(backend: str) -> None:
    mechanism = srm.load("slider_crank_regular")
    ends = [
        srm.simulate(replace(mechanism, forces=forces), 1.0, rtol=1e-10, backend=backend).q[-1]
        for forces in (
            [srm.JointTorque("crank", 2.0, law=TwoSines())],
            [
                srm.JointTorque("crank", 2.0, "one", srm.Sine(amplitude=0.2, omega=3.0)),
                srm.JointTorque("crank", 2.0, "two", srm.Sine(amplitude=0.1, omega=7.0)),
            ],
        )
    ]
    assert ends[0] == pytest.approx(ends[1], abs=1e-9)


@pytest.mark.parametrize(
    ("curve", "said"),
    [
        (None, "its curve is None. Return a Curve"),
        (Curve(breaks=()), r"the breaks \(\) of its curve are not ascending times"),
        (Curve((1.0, 0.0), ((0.0,), (0.0,))), "are not ascending times"),
        (Curve((0.0, 1.0), ((0.0,),)), "are not coefficients of 2 polynomials"),
        (Curve((0.0, 1.0), ((0.0,), (0.0, 1.0))), "are not coefficients of 2 polynomials"),
        (Curve(pieces=((),)), "are not coefficients of 1 polynomials"),
        (Curve(pieces=((np.nan,),)), "are not coefficients of 1 polynomials"),
        (Curve(sines=((1.0, 2.0),)), "are not triples of numbers"),  # type: ignore[arg-type]
    ],
)
def test_a_law_whose_curve_cannot_be_evaluated_is_refused(curve: Any, said: str) -> None:
    for use in (
        lambda: srm.Drive(Given(curve), joint="crank"),
        lambda: srm.JointTorque("crank", law=Given(curve)),
    ):
        with pytest.raises(srm.InputError, match=f"law 'given': .*{said}"):
            use()


@pytest.mark.parametrize("knots", [None, 0.5, [np.nan], ["late"]])
def test_a_law_whose_knots_are_no_times_is_refused(knots: Any) -> None:
    with pytest.raises(srm.InputError, match=r"law 'given': its knots .* are not times"):
        srm.Drive(Given(Curve(), knots), joint="crank")


@pytest.mark.parametrize("span", [None, (1.0,), (np.nan, 1.0), (0.0, 0.0), (0.1, 2.0), ("a", 1.0)])
def test_a_law_whose_span_is_none_is_refused(span: Any) -> None:
    class Spanned(Given):
        span = property(lambda law: span)  # type: ignore[assignment]

    with pytest.raises(srm.InputError, match=r"its span .* is not from t = 0 or before"):
        srm.Drive(Spanned(Curve()), joint="crank")


def test_a_law_without_what_laws_have_is_answered_with_where_to_inherit_it() -> None:
    with pytest.raises(srm.InputError, match=r"inherits from srm_mbs\.model\.laws\.Law"):
        srm.Drive(lambda t: 2.0 * t, joint="crank")  # type: ignore[arg-type]


@pytest.mark.parametrize("law", [TwoSines(), Doubled(amplitude=0.2, omega=3.0)])
def test_a_run_with_a_law_of_ones_own_is_not_saved_and_says_so(law: Law, tmp_path: Path) -> None:
    pushed = replace(
        srm.load("slider_crank_regular"), forces=[srm.JointTorque("crank", law=law, name="push")]
    )
    for mechanism, name in ((driven(law), "crank"), (pushed, "push")):
        run = srm.simulate(mechanism, 0.1)
        with pytest.raises(srm.InputError, match=f"the law of '{name}' is not one of the"):
            run.save(tmp_path / "run.npz")
    assert not list(tmp_path.iterdir())


def test_a_law_of_ones_own_is_listed_by_its_type() -> None:
    law = TwoSines()
    mechanism = replace(driven(law), forces=[srm.JointTorque("rod", law=law, name="push")])
    assert list(drive_rows(mechanism)) == [("crank", "two_sines", "crank", "of the user")]
    assert list(force_rows(mechanism)) == [("push", "torque", "rod", "torque 1 N m, law two_sines")]


def test_a_run_that_is_longer_than_a_law_of_ones_own_is_refused() -> None:
    class Short(TwoSines):
        span = (0.0, 0.5)  # type: ignore[assignment]

    with pytest.raises(srm.InputError, match=r"'crank': its law ends at t = 0\.5 s"):
        srm.simulate(driven(Short()), 1.0)
