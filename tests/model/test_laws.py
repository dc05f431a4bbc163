"""Laws over time: values, derivatives, smoothness, tables, and what they refuse."""

from __future__ import annotations

import copy
import pickle
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import srm_mbs as srm
from srm_mbs.formats.csv_table import read_csv
from srm_mbs.model.laws import Law
from tests.support.snapshots import check_messages, refused

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


every_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())


@every_law
def test_rates_and_accelerations_are_the_derivatives_of_the_values(law: Law) -> None:
    curve = law.curve(0.4)
    for t in np.linspace(0.05, 1.9, 23):
        h = 1e-3
        s = [curve(t + k * h)[0] for k in (-2, -1, 0, 1, 2)]
        _, rate, bend = curve(t)
        assert (s[0] - 8 * s[1] + 8 * s[3] - s[4]) / (12 * h) == pytest.approx(rate, abs=3e-7)
        assert (s[1] - 2 * s[2] + s[3]) / h**2 == pytest.approx(bend, abs=3e-2)


@every_law
def test_values_rates_and_accelerations_are_continuous_at_the_knots(law: Law) -> None:
    curve = law.curve(0.4)
    for knot in law.knots:
        before, after = np.array(curve(np.nextafter(knot, -1.0))), np.array(curve(knot))
        np.testing.assert_allclose(before, after, rtol=0.0, atol=1e-12)


@every_law
def test_many_times_have_the_values_of_each(law: Law) -> None:
    curve, times = law.curve(0.4), np.linspace(-0.5, 3.0, 71)
    for many, each in zip(curve.at(times), zip(*map(curve, times))):
        np.testing.assert_allclose(many, each, rtol=1e-15, atol=1e-15)


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


def test_a_table_is_a_value_like_the_tuples_of_its_numbers() -> None:
    table, same = srm.Table(TIMES, VALUES), srm.Table(np.array(TIMES), np.array(VALUES))
    other = srm.Table(TIMES, [*VALUES[:-1], 0.8])
    assert table == same
    assert table != other
    assert len({table, same, other}) == 2
    assert table.t == tuple(TIMES)
    assert tuple(TIMES) == table.t
    assert table.t != TIMES  # as a tuple is no list
    assert hash(table.t) == hash(tuple(TIMES))
    assert repr(table) == f"Table(t={tuple(TIMES)}, values={tuple(VALUES)})"
    assert (table.t[0], table.t[-1], table.t[1:3], len(table.t)) == (0.0, 2.0, (0.2, 0.5), 6)
    assert [type(value) for value in (*table.t, table.values[2])] == [float] * 7
    assert 0.5 in table.t
    assert replace(table, values=other.values) == other
    for made in (pickle.loads(pickle.dumps(table)), copy.deepcopy(table), copy.copy(table)):
        assert made == table
        with pytest.raises(ValueError, match="read-only"):
            np.asarray(made.t)[0] = 1.0


def test_a_table_takes_little_more_memory_than_its_numbers(tmp_path: Path) -> None:
    rows = 200_000
    numbers = 2 * 8 * rows  # bytes
    t = 1e-3 * np.arange(rows)
    path = tmp_path / "long.csv"
    text = "".join(f"{at:.3f},{value:.6f}\n" for at, value in zip(t, np.sin(t)))
    path.write_text(f"t,value\n{text}")

    tracemalloc.start()
    try:
        table = srm.Table(*read_csv(path).columns(("t", "value")).T)
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert kept < 1.1 * numbers
    np.testing.assert_allclose(table.t, t, atol=1e-12)
    np.testing.assert_allclose(table.values, np.sin(t), atol=1e-6)


def test_a_table_does_not_follow_the_arrays_it_was_made_of() -> None:
    t, values = np.array(TIMES), np.array(VALUES)
    table = srm.Table(t, values)
    t[0], values[0] = -1.0, 9.0
    assert table == LAWS["table"]


REFUSED: dict[str, Callable[[], object]] = {
    "a nan": lambda: srm.ConstantSpeed(np.nan),
    "a text": lambda: srm.ConstantSpeed("fast"),  # type: ignore[arg-type]
    "no frequency": lambda: srm.Sine(1.0),
    "two frequencies": lambda: srm.Sine(1.0, frequency_hz=1.0, omega=2.0),
    "no coefficients": lambda: srm.Polynomial([]),
    "coefficients that are a text": lambda: srm.Polynomial("12"),  # type: ignore[arg-type]
    "no duration": lambda: srm.MinimumJerk(1.0, 0.0),
    "a start before 0": lambda: srm.MinimumJerk(1.0, 1.0, start=-0.1),
    "three times": lambda: srm.Table([0.0, 1.0, 2.0], [0.0, 1.0, 2.0]),
    "more values than times": lambda: srm.Table([0.0, 1.0, 2.0, 3.0], [0.0] * 5),
    "a time twice": lambda: srm.Table([0.0, 1.0, 1.0, 3.0], [0.0] * 4),
    "a table that begins later": lambda: srm.Table([0.1, 1.0, 2.0, 3.0], [0.0] * 4),
}
TABLES = {
    "a missing column": "t,angle\n0,1\n",
    "a column twice": "t,value,value\n0,1,1\n",
    "an empty file": "",
    "a text in a row": "t,value\n0,1\n1,x\n",
    "a short row": "t,value\n0,1\n1\n",
}


def test_malformed_laws_and_tables_are_refused(tmp_path: Path) -> None:
    messages = {case: refused(call) for case, call in REFUSED.items()}
    for case, text in TABLES.items():
        path = tmp_path / f"{case}.csv"
        path.write_text(text)
        messages[case] = refused(lambda path=path: read_csv(path).columns(("t", "value")), tmp_path)
    (tmp_path / "wide.csv").write_bytes("t,value\n0,1\n".encode("utf-16"))
    messages["a text of a spreadsheet in UTF-16"] = refused(
        partial(read_csv, tmp_path / "wide.csv"), tmp_path
    )
    messages["no file"] = refused(partial(read_csv, tmp_path / "none.csv"), tmp_path)
    check_messages("laws", messages)


def test_columns_of_a_csv_file_are_found_by_name(tmp_path: Path) -> None:
    path = tmp_path / "motion.csv"
    path.write_text("angle, t ,other\n1.5,0.0,7\n\n2.5,0.1,8\n")
    np.testing.assert_array_equal(read_csv(path).columns(("t", "angle")), [[0.0, 1.5], [0.1, 2.5]])


def test_a_table_with_semicolons_is_told_to_have_commas(tmp_path: Path) -> None:
    """Spreadsheets write them, and decimal commas, where numbers have these."""
    path = tmp_path / "motion.csv"
    path.write_text("t;angle\n0,0;1,5\n0,1;2,5\n")
    with pytest.raises(srm.InputError, match=r"no column 't'. Separate columns by commas"):
        read_csv(path).columns(("t", "angle"))
