"""The commands around the simulation."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import srm_mbs as srm
from tests.cli.conftest import Describe
from tests.support.commands import ROOT, row, run

pytestmark = pytest.mark.filterwarnings("ignore:zmq.eventloop:DeprecationWarning")


def test_modes_lists_what_closes_and_how_often_it_was_found() -> None:
    output = run("modes", "four_bar", "--hold", "crank=1.0", "--starts", 20)
    lines = output.splitlines()
    assert lines[0] == "held: crank"
    assert len(lines) == 4
    assert "1 rad  -0.674279 rad  1.41339 rad" in lines[2]
    assert " of 20 " in lines[3]
    assert run("modes", "five_bar", "--starts", 10).startswith("held: crank_left, crank_right\n")
    assert "no closed configuration" in run(
        "modes", "four_bar", "--hold", "rocker=3", "--starts", 5, status=1
    )


def test_equilibrium_prints_stability_and_what_holds() -> None:
    output = run("equilibrium", "four_bar")
    found = srm.equilibrium(srm.load("four_bar"))
    frequency = np.sqrt(found.eigenvalues[0]) / (2.0 * np.pi)
    assert row(output, "equilibrium") == "stable"
    assert row(output, "small motion") == f"swings with {frequency:.6g} Hz"
    assert row(output, "crank") == f"{found.q[0]:.6g} rad"
    output = run("equilibrium", "four_bar", "--nearest")
    assert row(output, "equilibrium") == "unstable"
    assert row(output, "small motion").startswith("leaves with")
    held = run("equilibrium", "four_bar", "--hold", "crank=0.5")
    force = srm.equilibrium(srm.load("four_bar"), {"crank": 0.5}, hold="crank").holding["crank"]
    assert row(held, "to hold crank") == f"{force[0]:.6g} N m"
    assert row(held, "crank") == "0.5 rad"
    assert "on a singular configuration" in run("equilibrium", "slider_crank")


def test_a_search_that_finds_nothing_exits_with_1(tmp_path: Path) -> None:
    falling = """
        format = 1
        [planar]
        points = { A = [0, 0], B = [1, 0] }
        bar = [{ name = "bar", points = ["B", "A"] }]
        slider = [{ name = "slide", point = "A", along = [0, 1] }]
        ground = []
        mass_per_length = 1.0
    """
    path = tmp_path / "falling.toml"
    path.write_text(falling, encoding="utf-8")
    assert "no stable equilibrium was found" in run("equilibrium", path, status=1)


@pytest.mark.parametrize(
    ("command", "option"),
    [
        (["simulate", "four_bar", "--t-end", "0.1", "--q", "crank=30"], "--q"),
        (["equilibrium", "four_bar", "--hold", "crank=30"], "--hold"),
        (["drag", "four_bar", "crank=30"], "JOINT=VALUE"),
    ],
    ids=lambda value: value[0],
)
def test_angles_that_may_be_in_degrees_are_doubted_as_those_of_files(
    command: list[str], option: str
) -> None:
    said = f"warning: {option}: the angle 30 of the joint 'crank' is more than two turns: angles "
    assert said + "are in rad, and 30 degrees are 0.523599 rad" in run(*command)


def test_positions_beyond_the_limits_of_their_joints_are_marked(
    tmp_path: Path, describe: Describe
) -> None:
    bundled, own = ROOT / "urdf" / "four_bar.urdf", tmp_path / "limited.urdf"
    head, crank = bundled.read_text(encoding="utf-8").split('<joint name="crank"')
    own.write_text(f'{head}<joint name="crank"{crank.replace("1e6", "1.8", 2)}', encoding="utf-8")
    path = describe((bundled.as_posix(), own.as_posix()))
    dragged = run("drag", path, "crank=2.5")
    assert re.split(" {2,}", row(dragged, "crank")) == ["2.5 rad", "beyond its limit 1.8"]
    assert "beyond" not in row(dragged, "rocker")
    assert "beyond" not in run("drag", path, "crank=1.5")
    assert srm.equilibrium(srm.load(path)).q[0] < -1.8
    assert row(run("equilibrium", path), "crank").endswith("beyond its limit -1.8")
    assert run("modes", path, "--hold", "crank=-2.5").count("beyond the limits of crank") == 2


NOISE = re.compile(r"(?<![\w.])-?[\d.]+e-(1[3-9]|[2-9]\d)")
"""Numbers below 1e-12."""


@pytest.mark.parametrize("name", ["stewart_platform", "quick_return", "flyball_governor"])
def test_rounding_of_zeros_is_printed_as_zero(name: str) -> None:
    found = srm.equilibrium(srm.load(name))
    lines = run("equilibrium", name).splitlines()
    shown = [line for line in lines if not line.startswith("force left")]  # a measure of rounding
    assert not NOISE.search("\n".join(shown))
    assert not NOISE.search(run("linearise", name))
    for joint, wrench in found.reactions.items():  # what is no rounding is printed in full
        largest = wrench[:3][np.argmax(np.abs(wrench[:3]))]
        assert f"{largest:.6g}" in row("\n".join(lines), f"reaction {joint}")


def test_small_numbers_among_small_ones_are_printed_in_full(tmp_path: Path) -> None:
    tiny = srm.planar(
        points={"O": (0, 0), "A": (1e-6, 0)},
        bars={"bar": ("O", "A")},
        ground=("O",),
        mass_per_length=1e-9,
    )
    tiny.save(tmp_path / "tiny.toml")
    held = run("equilibrium", tmp_path / "tiny.toml", "--hold", "O=0")
    # 1e-15 kg at half of 1e-6 m.
    assert float(row(held, "to hold O").split()[0]) == pytest.approx(9.81 * 0.5e-21, rel=1e-5)


def test_a_motion_without_stiffness_is_called_neutral() -> None:
    output = run("equilibrium", "flyball_governor")
    assert row(output, "equilibrium") == "neutral"
    assert row(output, "small motion") == "neutral: it neither swings nor leaves"
    modes = run("linearise", "flyball_governor").split("mode  eigenvalue")[1].splitlines()
    assert [line.split()[:4] for line in modes[1:3]] == [["0", "0", "0", "1"], ["1", "0", "0", "1"]]


def test_linearise_prints_matrices_and_modes_and_writes_a_page(tmp_path: Path) -> None:
    page = tmp_path / "mode.html"
    output = run(
        *("linearise", "four_bar", "--at", "equilibrium", "--coordinate", "crank"),
        *("--input", "crank", "--html", page),
    )
    assert page.stat().st_size > 100_000
    found = srm.linearise(
        srm.load("four_bar"),
        srm.equilibrium(srm.load("four_bar")).q,
        coordinates="crank",
    )
    assert row(output, "d/dt rate of crank").split()[0] == f"{found.A[1, 0]:.6g}"
    assert "force of crank" in output
    assert "force of rocker" not in output
    assert row(output, "0").split()[1] == f"{found.frequencies[0]:.6g}"
    assert "rate of coupler" in run("linearise", "four_bar")
    assert "drift" in run("linearise", "four_bar", "--at", "rest")


def test_drag_says_how_far_it_came(tmp_path: Path) -> None:
    page = tmp_path / "drag.html"
    output = run("drag", "slider_crank", "crank=5,0", "--html", page)
    assert row(output, "path") == "all values were reached"
    assert output.count("singular configuration") == 2
    assert row(output, "crank") == "0 rad"
    assert page.exists()
    output = run("drag", "four_bar", "rocker=3", status=1)
    assert row(output, "path").startswith("no further than rocker = 2.74589")


def test_simulate_prints_the_balance_when_asked() -> None:
    output = run("simulate", "squeezing_mechanism", "--t-end", 0.01, "--balance")
    assert row(output, "work of force motor").endswith(" J")
    assert "open by at most" in row(output, "balance")
    assert "balance" not in run("simulate", "four_bar", "--t-end", 0.1)


@pytest.mark.parametrize(
    ("words", "option"),
    [
        ("equilibrium four_bar --hold wheel=1", "--hold"),
        ("equilibrium four_bar --hold rocker=3", "--hold"),
        ("modes four_bar --hold wheel=1", "--hold"),
        ("linearise four_bar --input wheel", "--input"),
        ("linearise four_bar --coordinate wheel", "--coordinate"),
        ("simulate four_bar --q wheel=1", "--q"),
        ("simulate four_bar --q rocker=3", "--q"),
        ("simulate four_bar --v wheel=1", "--v"),
        ("simulate four_bar --control wheel=1", "--control"),
    ],
)
def test_a_value_that_does_not_fit_the_mechanism_is_named_by_its_option(
    words: str, option: str
) -> None:
    assert run(*words.split(), status=2).startswith(f"error: {option}: ")


@pytest.mark.parametrize("command", ["plot", "play", "report"])
def test_a_run_that_is_not_there_is_asked_for_as_a_saved_run(command: str, tmp_path: Path) -> None:
    refused = run(command, tmp_path / "none.npz", status=2)
    assert "Give a file written by solution.save or srm-mbs simulate --out" in refused
