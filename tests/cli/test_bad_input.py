"""What commands refuse, with the messages of ``tests/data/messages/command_line.txt``."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import srm_mbs as srm
from tests.cli.conftest import Describe
from tests.support.bundled import load
from tests.support.commands import error_line, row, run
from tests.support.snapshots import check_messages

BAD_INPUT = """
info nonsense
info nonsense.toml
info robot.dae
info type.toml
simulate guess.toml
info open.toml
simulate four_bar --t-end 0
simulate four_bar --t-end inf
simulate four_bar --rtol -1
simulate four_bar --atol 0
simulate four_bar --step nan
simulate four_bar --method rattle
simulate four_bar --tableau rk5
simulate four_bar --tableau erk4
simulate four_bar --backend fortran
simulate four_bar --image a.png --at 11
simulate slider_crank --trace rod
simulate four_bar --gravity down
simulate four_bar --q crank
simulate four_bar --q wheel=1
simulate four_bar --q crank=1 --v crank=fast
plot nonsense.npz
plot none/run.npz
plot text.npz
plot run.npz --out drift.gif
plot run.npz --dpi 0
play nonsense.npz
report run.npz --out report.pdf
report run.npz --rtol 1e-8 --no-second-run
modes four_bar --hold crank=x
modes four_bar --hold crank=1,2
modes four_bar --seed -1
modes four_bar --hold crank=1 --hold crank
equilibrium four_bar --hold wheel
linearise four_bar --at here
linearise four_bar --html x.txt
linearise four_bar --mode 1
drag four_bar crank=1 crank=2
drag four_bar crank
drag four_bar crank=nan
"""
BAD_OUTPUT = """
simulate slider_crank --out run.txt
simulate slider_crank --plot run.gif
simulate slider_crank --plot run
simulate slider_crank --csv run.xls
simulate slider_crank --html run.js
simulate slider_crank --out none/run.npz
simulate slider_crank --plot none/run.png
simulate slider_crank --html none/run.html
simulate slider_crank --out folder.npz
"""


def test_bad_input_is_one_line_that_names_the_option_and_status_2(
    describe: Describe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    srm.simulate(load("slider_crank"), 0.1).save("run.npz")
    Path("robot.dae").write_text("<COLLADA/>")
    Path("text.npz").write_text("not a run")
    Path("folder.npz").mkdir()
    describe(('type = "point" ', 'type = "weld" ')).rename("type.toml")
    describe(("[initial.guess]", "[initial.gues]")).rename("guess.toml")
    describe(
        ("q = { crank = 1.0 }", "q = { crank = 1.0, coupler = 1.0, rocker = 1.0 }"),
        ("coupler = -0.674", ""),
        ("rocker = 1.413", ""),
    ).rename("open.toml")
    messages = {}

    def refuse(commands: str) -> None:
        for line in commands.strip().splitlines():
            name, *arguments = line.split()
            output = run(name, *arguments, status=2)
            messages[line] = error_line(output)
            assert output.count("\n") == 1

    refuse(BAD_INPUT)
    # Before the run, so that none is lost.
    monkeypatch.setattr(srm, "load", lambda _: pytest.fail("the run was about to start"))
    refuse(BAD_OUTPUT)
    assert not list(tmp_path.glob("*.png"))
    check_messages("command_line", messages)


@pytest.mark.parametrize(
    "args", [("simulate",), ("simulate", "four_bar", "--rtol", "x"), ("nonsense",), ("info", "-x")]
)
def test_wrong_usage_has_status_2(args: tuple[str, ...]) -> None:
    assert "Usage: " in run(*args, status=2)


@pytest.mark.skipif(
    os.name != "posix" or os.geteuid() == 0, reason="the superuser may write anywhere"
)
def test_folder_without_permission_is_refused_before_the_run(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        path = tmp_path / "run.npz"
        line = error_line(run("simulate", "slider_crank", "--out", path, status=2))
        assert line.startswith(f"error: {path}: --out: it cannot be written")
    finally:
        tmp_path.chmod(0o700)


def test_file_that_cannot_be_written_after_all_does_not_lose_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: object, path: Path, full_paths: bool) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("srm_mbs.api.Solution.save", full)
    out, plot = tmp_path / "run.npz", tmp_path / "run.png"
    output = run("simulate", "four_bar", "--t-end", 0.1, "--out", out, "--plot", plot, status=2)
    assert error_line(output).startswith(
        f"error: {out}: it cannot be written: No space left on device. Check the folder"
    )
    assert row(output, "written") == str(plot)
    assert plot.stat().st_size > 5000
