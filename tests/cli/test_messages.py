"""Help texts, error messages and log records are of one form, that of docs/messages.md."""

from __future__ import annotations

import ast
import logging
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import srm_mbs as srm
from srm_mbs.cli.app import app
from tests.support.sources import MODULES, PACKAGE, syntax_tree

IMPERATIVES = (
    "Add Anchor Break Build Check Close Convert Correct Couple Cut Define Describe Drag Draw Drive "
    "Exchange Extend Free Give Hold Include Install Join Keep Leave Let Linearise Look Make "
    "Move Name Pose Put Read Remove Rename Return Run Save Set Sort Split Start Take Trace "
    "Turn Use Widen Write"
)
"""With which remedies begin; the alternative is a list, "Known: a, b"."""
PROPER = {"G", "Pinocchio", "SDF", "SRM", "T"}
"""With which problems may begin in upper case: names, and letters of the notation."""


def literal_ends(node: ast.expr | None, which: int) -> list[str]:
    """The literal texts with which the value of an expression can begin (``which`` = 0) or end
    (-1); none where it is not literal."""
    match node:
        case ast.Constant(value=str(text)):
            return [text]
        case ast.JoinedStr(values=[_, *_] as values):
            return literal_ends(values[which], which)
        case ast.IfExp(body=body, orelse=orelse):
            return literal_ends(body, which) + literal_ends(orelse, which)
        case ast.BinOp(left=left, right=right):
            return literal_ends((left, right)[which], which)
    return []


def beginnings(node: ast.expr | None) -> list[str]:
    return literal_ends(node, 0)


def endings(node: ast.expr | None) -> list[str]:
    return literal_ends(node, -1)


@cache
def calls() -> list[tuple[str, str, ast.Call]]:
    """Module and line, name without what is before its last dot, call."""
    return [
        (f"{module}:{node.lineno}", ast.unparse(node.func).rpartition(".")[2], node)
        for module in MODULES
        for node in ast.walk(syntax_tree(module))
        if isinstance(node, ast.Call)
    ]


def faults() -> Iterator[tuple[str, ast.expr | None, ast.expr | None]]:
    """Place, problem and remedy of every error that is made."""
    for place, name, call in calls():
        named = {word.arg: word.value for word in call.keywords}
        if name in ("InputError", "AssemblyError", "AnalysisError"):
            yield place, call.args[0] if call.args else None, named.get("remedy")
        elif name in ("fault", "_fault") and len(call.args) >= 2:
            # (..., problem, remedy)
            yield place, call.args[-2], call.args[-1]


def test_every_problem_is_a_clause_in_lower_case_without_a_full_stop() -> None:
    found = list(faults())
    assert len(found) > 350
    wrong = [
        (place, text)
        for place, problem, _ in found
        for text in beginnings(problem)
        if text[:1].isupper() and re.split(r"\W", text, maxsplit=1)[0] not in PROPER
    ]
    wrong += [
        (place, text)
        for place, problem, _ in found
        for text in endings(problem)
        if text.rstrip().endswith((".", "!"))
    ]
    assert not wrong


def test_every_remedy_is_an_imperative_or_a_list_of_what_is_known() -> None:
    begun = [(place, text) for place, _, remedy in faults() for text in beginnings(remedy)]
    assert len(begun) > 300
    assert not [
        (place, text)
        for place, text in begun
        if not text.startswith("Known: ") and re.split(r"\W", text)[0] not in IMPERATIVES.split()
    ]
    assert not [
        (place, text)
        for place, _, remedy in faults()
        for text in endings(remedy)
        if re.search(r"(?<!\.\.)\.$|\s$", text)
    ]


def test_an_error_needs_a_remedy() -> None:
    with pytest.raises(TypeError, match="remedy"):
        srm.InputError("there is no such thing")
    error = srm.InputError("there is no such thing", file="a.toml", element="b", remedy="Add it")
    assert str(error) == "a.toml: b: there is no such thing. Add it"


REPLACED = (
    r"(?<!there )\b(is|are) no |stands? there|[Tt]his version (has|knows)|option away|Ctrl\+C"
)
"""Words that others of docs/messages.md stand for."""


def test_one_thing_is_said_in_one_way() -> None:
    assert not [
        (place, said)
        for place, problem, remedy in faults()
        for said in beginnings(problem) + endings(problem) + beginnings(remedy)
        if re.search(REPLACED, said)
    ]


# --- the log -------------------------------------------------------------------------------------


def test_library_code_logs_below_its_own_name_and_prints_nothing() -> None:
    for place, name, call in calls():
        assert ast.unparse(call.func) != "print", place
        # Only get_logger() escapes the control characters of names.
        assert name != "getLogger" or place.startswith(("cli", "errors")), place
        if name == "get_logger":
            assert ast.unparse(call.args[0]) == "__name__", place


LEVELS = ("debug", "info", "warning", "error", "exception", "critical")


def test_records_begin_in_lower_case_end_without_a_full_stop_and_are_formatted_when_wanted() -> (
    None
):
    found = 0
    for place, name, call in calls():
        if name not in LEVELS or ast.unparse(call.func) != f"log.{name}":
            continue
        found += 1
        text = call.args[0]
        assert isinstance(text, ast.Constant), f"{place}: formatted before it is wanted"
        assert isinstance(text.value, str)
        assert not text.value[0].isupper(), f"{place}: {text.value!r}"
        assert not text.value.endswith("."), f"{place}: {text.value!r}"
    assert found > 20


QUIET = """
import srm_mbs as srm
mechanism = srm.load("slider_crank")
solution = srm.simulate(mechanism, 1.2)
assert solution.crossings
solution.to_csv("run.csv")
solution.save("run.npz")
srm.sweep(mechanism, [{}, {}], 0.02)
"""


def test_without_logging_set_up_nothing_is_said(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", QUIET],
        cwd=tmp_path,
        # A kernel of other sources would issue a warning, rightly.
        env={"PYTHONPATH": str(PACKAGE.parent), "SRM_MBS_BACKEND": "python"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert (done.stdout, done.stderr) == ("", "")


@pytest.fixture
def logged(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.DEBUG, "srm_mbs")
    return caplog


def said(logged: pytest.LogCaptureFixture, words: str, level: str = "INFO") -> bool:
    return any(
        words in record.getMessage() and record.levelname == level for record in logged.records
    )


def test_a_run_logs_its_settings_end_and_singular_passages(logged: Any) -> None:
    mechanism = srm.load("slider_crank")
    assert said(logged, "slider_crank: 1 degrees of freedom, rank 1")
    assert said(logged, "read as URDF", "DEBUG")
    assert said(logged, "slider_crank: assembled with crank held, closed to ", "DEBUG")
    solution = srm.simulate(mechanism, 5.0, rtol=1e-7)
    by = solution.settings.backend
    assert said(logged, f"slider_crank: from t = 0 to 5 s with PSRM auto, rtol 1e-07, backend {by}")
    assert said(logged, f"slider_crank: finished after {solution.stats.steps} steps")
    assert said(logged, f"slider_crank: {solution.message}")
    assert len(solution.crossings) == 2
    for crossing in solution.crossings:
        words = f"singular configuration of pin passed at t = {crossing.time:.9g} s"
        assert said(logged, words, "DEBUG")


def test_passages_are_not_looked_for_unless_they_are_wanted(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "srm_mbs.integration.singular_passages.find_crossings", lambda *_: pytest.fail("looked for")
    )
    mechanism = srm.load("slider_crank")
    with caplog.at_level(logging.INFO, "srm_mbs"):
        assert srm.simulate(mechanism, 2.0).success
    assert said(caplog, "slider_crank: finished")


@pytest.mark.skipif(srm.backend() == "python", reason="there is no kernel to do without")
def test_a_run_that_the_kernel_cannot_make_says_why(logged: Any) -> None:
    srm.simulate(srm.load("four_bar"), 0.1, method=srm.PSRM("dopr54", correction="sweep"))
    assert said(logged, "the Python reference makes this run, not the compiled kernel: it has the")


def test_files_sweeps_equilibria_and_daes_are_logged(logged: Any, tmp_path: Path) -> None:
    mechanism = srm.load("four_bar")
    run = srm.simulate(mechanism, 0.1)
    for write, name in (
        (run.save, "run.npz"),
        (run.to_csv, "run.csv"),
        (run.plot, "run.png"),
        (run.export_html, "run.html"),
    ):
        write(tmp_path / name)
        assert said(logged, f"written: {tmp_path / name}")
    srm.sweep(mechanism, [{}, {"v": {"crank": 1.0}}], 0.1).to_parquet(tmp_path / "table.parquet")
    assert said(logged, "sweep of 2 cases, 0 of them known")
    assert said(logged, "cases[1]: The run reached t = 0.1 s", "DEBUG")
    assert said(logged, "sweep ended: Sweep(2 cases, 2 reached the end")
    assert said(logged, f"written: {tmp_path / 'table.parquet'}")
    rest = srm.equilibrium(mechanism)
    assert said(logged, "four_bar: equilibrium", "DEBUG")
    srm.linearise(mechanism, rest.q)
    assert said(logged, "four_bar: linearised in 1 coordinates", "DEBUG")
    circle = srm.SemiExplicitDAE(
        f=lambda t, x: np.array([x[0] - x[1], x[0] + x[1]]),
        B=lambda t, x: x,
        g=lambda t, x: 0.5 * (x @ x - 1.0),
        G=lambda t, x: x,
    )
    srm.solve_dae(circle, (0.0, 1.0), [1.0, 0.0])
    assert said(logged, "DAE: finished after ")


# --- the command line ----------------------------------------------------------------------------


def commands() -> dict[str, Any]:
    group = typer.main.get_command(app)
    return {"srm-mbs": group, **group.commands}


def texts(name: str) -> Iterator[tuple[str, str]]:
    """What the help of a command says: of itself, and of its parameters."""
    command = commands()[name]
    yield name, " ".join(command.help.split("\n\n")[0].split())
    for parameter in command.params:
        yield f"{name} {parameter.name}", getattr(parameter, "help", None) or ""


@pytest.mark.parametrize("name", commands())
def test_every_help_text_is_a_sentence(name: str) -> None:
    for place, text in texts(name):
        assert text[:1].isupper(), f"{place}: {text!r}"
        assert text.endswith("."), f"{place}: {text!r}"
        # Defaults are shown in one place, [default: ...].
        assert "efault:" not in text, f"{place}: {text!r}"


def test_the_list_of_commands_shows_whole_sentences() -> None:
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "80"}).output
    assert "..." not in shown[shown.index("Commands:") :]


def test_verbose_shows_the_log_and_without_it_nothing_of_it_is_seen() -> None:
    logged = CliRunner().invoke(app, ["-v", "simulate", "slider_crank", "--t-end", "2"]).stderr
    assert "info: slider_crank: from t = 0 to 2 s with PSRM auto, rtol 1e-08" in logged
    assert "debug: slider_crank: singular configuration of pin passed at t = " in logged
    quiet = CliRunner().invoke(app, ["simulate", "slider_crank", "--t-end", "2"])
    assert quiet.stderr == ""


PAGES = (PACKAGE.parent / "README.md", *sorted((PACKAGE.parent / "docs").rglob("*.md")))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_commands_and_options_that_a_page_shows_exist(page: Path) -> None:
    known = commands()
    for line in re.findall(r"srm-mbs (?:-v )?([^`\n]+)", page.read_text(encoding="utf-8")):
        name, *words = line.split()
        if name == "benchmark" or not name.isidentifier():
            continue
        options = {text for parameter in known[name].params for text in parameter.opts}
        given = {word.rstrip(".,;:)") for word in words if re.match(r"--?[a-z]", word)}
        assert given <= options | {"--help"}, line


@pytest.mark.parametrize("name", [name for name in commands() if name != "srm-mbs"])
def test_every_value_has_a_name_in_its_help(name: str) -> None:
    for parameter in commands()[name].params:
        if parameter.param_type_name == "option" and not parameter.is_flag:
            assert parameter.metavar, f"{name} {parameter.name}"
