"""Laws over time: values, derivatives, smoothness, tables, and what they refuse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import srm_mbs as srm
from srm_mbs.formats.csv_table import read_csv
from srm_mbs.model.laws import Law

TIMES = [0.0, 0.2, 0.5, 0.9, 1.4, 2.0]
VALUES = [0.3, -0.1, 0.4, 1.2, 0.7, 0.9]
LAWS = {
    "constant speed": srm.ConstantSpeed(-2.5),
    "sine in Hz": srm.Sine(0.7, frequency_hz=0.4, phase=0.3, offset=0.2),
    "sine in rad/s": srm.Sine(0.7, omega=2.2),
    "polynomial": srm.Polynomial([0.1, -0.4, 0.3, 0.2]),
    "minimum jerk": srm.MinimumJerk(1.7, 0.8, start=0.5),
    "table": srm.Table(TIMES, VALUES),
}


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())
def test_rates_and_accelerations_are_the_derivatives_of_the_values(law: Law) -> None:
    curve = law.curve(0.4)
    for t in np.linspace(0.05, 1.9, 23):
        h = 1e-3
        s = [curve(t + k * h)[0] for k in (-2, -1, 0, 1, 2)]
        _, rate, bend = curve(t)
        assert (s[0] - 8 * s[1] + 8 * s[3] - s[4]) / (12 * h) == pytest.approx(rate, abs=3e-7)
        assert (s[1] - 2 * s[2] + s[3]) / h**2 == pytest.approx(bend, abs=3e-2)


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())
def test_values_rates_and_accelerations_are_continuous_at_the_knots(law: Law) -> None:
    curve = law.curve(0.4)
    for knot in law.knots:
        before, after = np.array(curve(np.nextafter(knot, -1.0))), np.array(curve(knot))
        np.testing.assert_allclose(before, after, rtol=0.0, atol=1e-12)


def test_the_laws_have_their_closed_forms() -> None:
    assert LAWS["constant speed"].curve(1.0)(2.0) == (-4.0, -2.5, 0.0)
    assert LAWS["sine in Hz"].curve()(1.1)[0] == pytest.approx(
        0.2 + 0.7 * np.sin(2 * np.pi * 0.4 * 1.1 + 0.3)
    )
    assert LAWS["polynomial"].curve(9.0)(2.0) == pytest.approx((2.1, 3.2, 3.0))


def test_minimum_jerk_goes_from_rest_to_rest_and_is_fastest_in_the_middle() -> None:
    curve = srm.MinimumJerk(1.7, 0.8, start=0.5).curve(-0.3)
    assert curve(0.0) == curve(0.5) == (-0.3, 0.0, 0.0)
    assert curve(1.3) == curve(9.0) == (1.7, 0.0, 0.0)
    assert curve(0.9) == pytest.approx((0.7, 15.0 / 8.0 * 2.0 / 0.8, 0.0))
    assert srm.MinimumJerk(1.7, 0.8, start=0.5).knots == (0.5, 1.3)


def test_a_table_is_the_cubic_spline_through_its_values() -> None:
    curve, spline = LAWS["table"].curve(), CubicSpline(TIMES, VALUES)
    for t in np.linspace(0.0, 2.0, 41):
        np.testing.assert_allclose(curve(t), [spline(t, k) for k in range(3)], atol=1e-12)
    jumps = [abs(spline(k, 3) - spline(k - 1e-9, 3)) > 1e-6 for k in TIMES[1:-1]]
    assert LAWS["table"].knots == tuple(t for t, jump in zip(TIMES[1:-1], jumps) if jump)
    assert LAWS["table"].span == (0.0, 2.0)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: srm.ConstantSpeed(np.nan), "speed = nan"),
        (lambda: srm.ConstantSpeed("fast"), "speed = 'fast'"),  # type: ignore[arg-type]
        (lambda: srm.Sine(1.0), "one frequency"),
        (lambda: srm.Sine(1.0, frequency_hz=1.0, omega=2.0), "one frequency"),
        (lambda: srm.Polynomial([]), "coefficients"),
        (lambda: srm.MinimumJerk(1.0, 0.0), "duration = 0.0 is too small"),
        (lambda: srm.MinimumJerk(1.0, 1.0, start=-0.1), "negative"),
        (lambda: srm.Table([0.0, 1.0, 2.0], [0.0, 1.0, 2.0]), "t has shape"),
        (lambda: srm.Table([0.0, 1.0, 2.0, 3.0], [0.0] * 5), "4 times and 5 values"),
        (lambda: srm.Table([0.0, 1.0, 1.0, 3.0], [0.0] * 4), "ascend"),
        (lambda: srm.Table([0.1, 1.0, 2.0, 3.0], [0.0] * 4), r"begins at t = 0\.1 s"),
    ],
)
def test_malformed_laws_are_refused(make: object, words: str) -> None:
    with pytest.raises(srm.InputError, match=words):
        make()  # type: ignore[operator]


def test_columns_of_a_csv_file_are_found_by_name(tmp_path: Path) -> None:
    path = tmp_path / "motion.csv"
    path.write_text("angle, t ,other\n1.5,0.0,7\n\n2.5,0.1,8\n")
    np.testing.assert_array_equal(read_csv(path).columns(("t", "angle")), [[0.0, 1.5], [0.1, 2.5]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,angle\n0,1\n", "there is no column 'value'.*Known: t, angle"),
        ("t,value,value\n0,1,1\n", "two columns 'value'"),
        ("", "Known: none"),
        ("t,value\n0,1\n1,x\n", "row 2 of the table is wrong"),
        ("t,value\n0,1\n1\n", "row 2 of the table is wrong: 1 values, 2 columns"),
    ],
)
def test_malformed_tables_are_refused_with_file_and_row(
    tmp_path: Path, text: str, words: str
) -> None:
    path = tmp_path / "motion.csv"
    path.write_text(text)
    with pytest.raises(srm.InputError, match=words) as caught:
        read_csv(path).columns(("t", "value"))
    assert str(path) in str(caught.value)


def test_a_missing_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(srm.InputError, match="cannot be read"):
        read_csv(tmp_path / "none.csv")
