"""Parameters of a description: a number computed is the same as that number typed in."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.cli.model_file import parameter_values
from srm_mbs.formats.toml.parameters import Resolved
from tests.support.bundled import load
from tests.support.commands import error_line, row, run
from tests.support.snapshots import check_refusals

LINKAGE = """format = 1
[parameters]
crank = 0.3
rocker = "=2*crank + 0.1"
[planar]
ground = ["O", "C"]
mass_per_length = 1.0
[planar.points]
O = [0, 0]
A = ["=crank*cos(pi/3)", "=crank*sin(radians(60))"]
B = ["=3*crank", "=rocker"]
C = [1.0, 0]
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


def typed_in(crank: float) -> str:
    """The linkage with numbers in place of its expressions."""
    numbers = {
        "=crank*cos(pi/3)": crank * math.cos(math.pi / 3),
        "=crank*sin(radians(60))": crank * math.sin(math.radians(60)),
        "=3*crank": 3 * crank,
        "=rocker": 2 * crank + 0.1,
    }
    text = LINKAGE
    for expression, number in numbers.items():
        text = text.replace(f'"{expression}"', repr(number))
    return text.replace(text[text.index("[parameters]") : text.index("[planar]")], "")


@pytest.fixture
def linkage(tmp_path: Path) -> Path:
    path = tmp_path / "linkage.toml"
    path.write_text(LINKAGE, encoding="utf-8")
    return path


def same(a: srm.Mechanism, b: srm.Mechanism) -> bool:
    return bool(
        a.model == b.model
        and a.loops == b.loops
        and np.array_equal(a.q0, b.q0)
        and np.array_equal(a.v0, b.v0)
    )


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("=2*a", 0.5),
        ("= a + b/3 - 1", 0.25 + 3.0 / 3.0 - 1.0),
        ("=-a**2", -0.0625),
        ("=(1 + b)*(2 - a)", 4.0 * 1.75),
        ("=sqrt(b**2 + 4**2)", 5.0),
        ("=atan2(1, -1)", 0.75 * math.pi),
        ("=max(a, b, 2) - min(a, b)", 2.75),
        ("=abs(-b) + degrees(pi) + tan(0)", 183.0),
        ("=7/2", 3.5),
        ("=c", 6.0),
    ],
)
def test_an_expression_is_the_number_that_arithmetic_gives(expression: str, value: float) -> None:
    table = {"a": 0.25, "b": 3, "c": "=2*b"}
    entries = {"parameters": table, "gravity": [0, expression, 0]}
    found = Resolved(entries, {}, "a.toml")
    assert found.entries == {"gravity": [0, value, 0]}
    assert found.values == {"a": 0.25, "b": 3.0, "c": 6.0}


@pytest.mark.parametrize("crank", [0.3, 0.31])
def test_a_linkage_with_parameters_is_that_with_the_numbers_typed_in(
    linkage: Path, crank: float
) -> None:
    found = srm.load(linkage, parameters={"crank": crank})
    assert dict(found.parameters) == {"crank": crank, "rocker": 2 * crank + 0.1}
    linkage.write_text(typed_in(crank), encoding="utf-8")
    assert same(found, srm.load(linkage))


def test_a_variant_is_the_mechanism_loaded_with_its_values(linkage: Path) -> None:
    found = srm.load(linkage, gravity=[0.0, 0.0, -1.62])
    wanted = srm.load(linkage, gravity=[0.0, 0.0, -1.62], parameters={"crank": 0.31, "rocker": 0.8})
    linkage.unlink()  # what was read is what varies
    copied = pickle.loads(pickle.dumps(found.with_state(found.q0, found.v0)))
    for origin in (found, copied):
        assert same(origin.with_parameters(crank=0.31).with_parameters(rocker=0.8), wanted)
    assert dict(found.parameters) == {"crank": 0.3, "rocker": 0.7}


def test_a_parameter_that_nothing_uses_is_noted() -> None:
    entries = {"parameters": {"a": 1.0, "b": 2.0}, "friction_speed": "=a"}
    assert Resolved(entries, {}, "a.toml").notes == ("no expression uses the parameters 'b'",)


def test_runs_and_conversions_keep_the_numbers(linkage: Path, tmp_path: Path) -> None:
    found = srm.load(linkage, parameters={"crank": 0.31})
    run = srm.simulate(found, 0.1)
    run.save(tmp_path / "run.npz")
    again = srm.load_solution(tmp_path / "run.npz")
    assert again.mechanism.parameters == found.parameters
    assert np.array_equal(again.q, run.q)
    out = tmp_path / "written.toml"
    srm.convert(linkage, out, parameters={"crank": 0.31})
    written = srm.load(out)
    assert not written.parameters
    assert same(written, found)


def test_values_on_the_command_line_are_names_and_numbers() -> None:
    assert parameter_values(["crank=0.3", "rod=1e-2"]) == {"crank": 0.3, "rod": 0.01}


def test_commands_take_values_of_parameters(linkage: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.npz"
    values = ("--set", "crank=0.31", "--set", "rocker=0.8")
    run("simulate", linkage, *values, "--t-end", 0.1, "--out", out)
    wanted = srm.load(linkage, parameters={"crank": 0.31, "rocker": 0.8})
    assert srm.load_solution(out).mechanism.parameters == wanted.parameters
    assert np.array_equal(srm.load_solution(out).q[0], wanted.q0)
    plain, changed = (run("info", linkage, *given) for given in ((), values))
    assert row(plain, "degrees of freedom") == row(changed, "degrees of freedom")
    assert plain != changed


@pytest.mark.parametrize(
    ("given", "start"),
    [
        ("cranc=1", "{file}: --set: there is no parameter 'cranc'"),
        ("crank=nan", "--set: the parameter 'crank' = nan is not a finite number"),
        ("crank", "--set: 'crank' is not a name and a number"),
        ("idle=2", "{file}: --set: nothing in the description uses the parameter 'idle'"),
    ],
)
def test_faults_of_the_command_line_name_its_option(linkage: Path, given: str, start: str) -> None:
    text = LINKAGE.replace("[parameters]", "[parameters]\nidle = 1.0")
    linkage.write_text(text, encoding="utf-8")
    line = error_line(run("info", linkage, "--set", given, status=2))
    assert line.startswith(f"error: {start.format(file=linkage)}")


@pytest.mark.parametrize(
    ("table", "start"),
    [
        ("sin = 1.0", "[parameters]: 'sin' cannot be the name of a parameter"),
        ("crank = true", "parameters.crank: a finite number is wanted"),
    ],
)
def test_faults_of_the_table_of_a_file_do_not_name_the_option(
    linkage: Path, table: str, start: str
) -> None:
    linkage.write_text(LINKAGE.replace("crank = 0.3\n", f"{table}\n"), encoding="utf-8")
    for more in ((), ("--set", "rocker=0.5")):
        line = error_line(run("info", linkage, *more, status=2))
        assert line.startswith(f"error: {linkage}: {start}")


def test_messages_about_parameters(linkage: Path) -> None:
    def speed(expression: Any, **table: Any) -> Callable[[], object]:
        entries = {"parameters": {"crank": 1.0, **table}, "friction_speed": expression}
        return partial(Resolved, entries, {}, "a.toml")

    def given(values: Any) -> Callable[[], object]:
        return partial(srm.load, "four_bar", parameters=values)

    check_refusals(
        "parameters",
        {
            "unknown": speed("=2*cran"),
            "unknown function": speed("=exp(crank)"),
            "attribute": speed("=crank.real"),
            "call of a call": speed("=sqrt(4)(2)"),
            "import": speed("=__import__('os')"),
            "comparison": speed("=crank < 2"),
            "text": speed("='a'*9"),
            "caret": speed("=crank^2"),
            "arguments": speed("=sqrt(1, 2)"),
            "function as a value": speed("=2*sin"),
            "syntax": speed("=2*"),
            "huge power": speed("=9**9**9"),
            "root of a negative number": speed("=(-crank)**0.5"),
            "division by zero": speed("=1/(crank - 1)"),
            "too large": speed("=1e29*100"),
            "too long": speed("=" + "1+" * 200 + "1"),
            "circle": speed("=a", a="=b+1", b="=2*a"),
            "chain": speed("=p0", **{f"p{k}": f"=p{k + 1}" for k in range(60)}, p60=1.0),
            "value": speed("=a", a=True),
            "name of a function": speed("=1", sin=2.0),
            "unusual name": speed("=1", **{"bar-length": 2.0}),
            "no table": partial(Resolved, {"parameters": 3}, {}, "a.toml"),
            "value of an unknown": partial(
                Resolved, {"parameters": {"a": 1.0}, "name": "x"}, {"b": 1.0}, "a.toml"
            ),
            "value that nothing uses": partial(
                Resolved, {"parameters": {"a": 1.0}, "name": "x"}, {"a": 2.0}, "a.toml"
            ),
            "value of a text": given({"crank": "long"}),
            "values of a list": given([1.0]),
            "not finite": given({"crank": math.nan}),
            "variant without description": load("four_bar").with_parameters,
            "variant of a changed mechanism": replace(srm.load(linkage), forces=()).with_parameters,
            "command line": partial(parameter_values, ["crank"]),
            "command line twice": partial(parameter_values, ["a=1", "a=2"]),
        },
    )
    assert load("four_bar").parameters == {}
