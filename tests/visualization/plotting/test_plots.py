"""The run plot: what its panels show, and the files it is saved to."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

import srm_mbs as srm
from srm_mbs.api import Solution
from srm_mbs.visualization.plotting import figure as panels
from srm_mbs.visualization.plotting import run
from tests.support.bundled import load


@pytest.fixture(scope="module")
def slider_crank() -> Solution:
    return srm.simulate(load("slider_crank"), 5.0, rtol=1e-8)


@pytest.fixture(scope="module")
def four_bar() -> Solution:
    return srm.simulate(load("four_bar"), 2.0)


@pytest.fixture(scope="module")
def pendulum_chain() -> Solution:
    return srm.simulate(load("pendulum_chain"), 1.0)


def line(axes: Axes, label: str) -> Line2D:
    """The line of ``axes`` whose label starts with ``label``."""
    return next(line for line in axes.lines if str(line.get_label()).startswith(label))


def legend(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


def titles(figure: Figure) -> list[str]:
    return [axes.get_title(loc="left") for axes in figure.axes]


def marked_times(axes: Axes) -> list[float]:
    """Where the vertical lines of ``axes`` stand."""
    return [segment[0, 0] for lines in axes.collections for segment in lines.get_segments()]


def test_drift_energy_sigma_and_steps_share_one_time_axis_with_units(
    slider_crank: Solution,
) -> None:
    figure = slider_crank.plot()
    assert len(figure.axes) == 4
    for axes in figure.axes:
        assert axes.get_shared_x_axes().joined(axes, figure.axes[0])
    drift, energy, sigma, steps = (axes.get_ylabel() for axes in figure.axes)
    assert drift == "drift"
    assert energy.startswith("energy change")
    assert "J" in energy
    assert r"\sigma" in sigma
    assert steps == "step size (s)"
    assert figure.axes[-1].get_xlabel() == "time (s)"
    assert legend(figure.axes[0]) == [r"$\Vert G\,v\Vert$ (m/s)", r"$\Vert g\Vert$ (m)"]


def test_the_title_is_free_of_settings_which_are_in_the_metadata_of_files(
    slider_crank: Solution, four_bar: Solution, tmp_path: Path
) -> None:
    for solution, name in ((slider_crank, "slider_crank"), (four_bar, "four_bar")):
        assert solution.plot().get_suptitle() == name
    slider_crank.plot(tmp_path / "run.png")
    with Image.open(tmp_path / "run.png") as picture:
        assert picture.info["Title"] == "slider_crank"
        assert picture.info["Description"] == "srm_mbs: PSRM, auto, rtol = 1e-08"
    fixed = srm.simulate(load("four_bar"), 0.1, step=0.01)
    fixed.plot(tmp_path / "run.svg")
    assert "fixed step 0.01 s" in (tmp_path / "run.svg").read_text()


def test_drift_that_is_zero_is_drawn_at_the_floor_of_the_logarithmic_axis(
    slider_crank: Solution,
) -> None:
    assert (slider_crank.drift[:, 0] == 0.0).any()
    axes = slider_crank.plot().axes[0]
    assert axes.get_yscale() == "log"
    drawn = line(axes, r"$\Vert g").get_ydata()
    assert drawn.min() == run.SMALLEST_DRIFT
    np.testing.assert_array_equal(drawn, np.maximum(slider_crank.drift[:, 0], 1e-17))
    assert "zeros drawn at 1e-17" in axes.get_title(loc="left")


def test_closures_with_alignment_rows_have_drift_in_radians_too() -> None:
    base = load("four_bar")
    pin = base.loops[0]
    hinge = srm.LoopClosure("revolute", pin.a, pin.b, (0.0, 1.0, 0.0))
    mechanism = srm.Mechanism(base.model, (hinge,), q0=base.q0, v0=base.v0)
    solution = srm.simulate(mechanism, 0.1)
    labels = legend(solution.plot().axes[0])
    assert "(m/s, rad/s)" in labels[0]
    assert "(m, rad)" in labels[1]


def test_energy_panel_shows_the_change_in_the_power_of_ten_of_its_label(four_bar: Solution) -> None:
    axes = four_bar.plot().axes[1]
    change = four_bar.energy - four_bar.energy[0]
    power = int(np.floor(np.log10(np.abs(change).max())))
    assert f"10^{{{power}}}" in axes.get_ylabel()
    np.testing.assert_allclose(axes.lines[0].get_ydata(), change / 10.0**power)


def test_energy_panel_says_since_when_if_the_first_time_is_not_the_start() -> None:
    solution = srm.simulate(load("four_bar"), 0.5, t_eval=[0.25, 0.5])
    assert titles(solution.plot())[1] == "(b) total energy relative to t = 0.25 s"


def test_singular_passages_are_marked_in_the_panels_of_sigma_and_steps(
    slider_crank: Solution,
) -> None:
    figure = slider_crank.plot()
    passages = [crossing.time for crossing in slider_crank.crossings]
    assert len(passages) == 2
    for axes in figure.axes[2:]:
        np.testing.assert_allclose(marked_times(axes), passages)
        assert "singular passage" in legend(axes)
    assert not marked_times(figure.axes[0])


def test_many_singular_passages_are_ticks_instead_of_full_lines(
    slider_crank: Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    (lines,) = slider_crank.plot().axes[3].collections
    assert lines.get_segments()[0][1, 1] == 1.0
    monkeypatch.setattr(panels, "MAX_FULL_LINES", 1)
    (ticks,) = slider_crank.plot().axes[3].collections
    assert ticks.get_segments()[0][1, 1] < 0.1


def test_sigma_is_drawn_at_step_ends_and_through_the_stages(slider_crank: Solution) -> None:
    axes = slider_crank.plot().axes[2]
    ends = line(axes, "step ends")
    np.testing.assert_array_equal(ends.get_xdata(), slider_crank.steps.times[1:])
    np.testing.assert_array_equal(ends.get_ydata(), slider_crank.steps.sigmas[:, -1])
    stages = line(axes, "stages")
    assert (np.diff(stages.get_xdata()) >= 0.0).all()
    assert stages.get_ydata().min() == slider_crank.steps.sigmas.min()


def test_accepted_steps_are_dots_and_those_that_did_not_stand_are_crosses(
    four_bar: Solution,
) -> None:
    axes = four_bar.plot().axes[3]
    accepted, rejected = line(axes, "accepted"), line(axes, "rejected")
    np.testing.assert_array_equal(accepted.get_ydata(), np.diff(four_bar.steps.times))
    assert len(four_bar.rejected) == four_bar.stats.rejected > 0
    np.testing.assert_array_equal(rejected.get_xydata(), four_bar.rejected)
    assert (accepted.get_marker(), rejected.get_marker()) == (".", "x")
    assert accepted.get_color() != rejected.get_color()
    assert "redone" not in legend(axes)


def test_steps_redone_because_of_a_singular_configuration_have_marks_of_their_own() -> None:
    quarter = 4.29657624142677449 / 4.0  # a grid point is singular
    solution = srm.simulate(
        load("slider_crank"), 2.0, step=quarter / 20, tableau="dopr54", placement="halved"
    )
    axes = solution.plot().axes[3]
    redone = line(axes, "redone")
    assert len(solution.replaced) == solution.stats.replaced > 0
    np.testing.assert_array_equal(redone.get_xydata(), solution.replaced)
    assert redone.get_marker() == "+"
    assert "rejected" not in legend(axes)


@pytest.mark.parametrize("step", [None, 0.01])
def test_step_sizes_have_labelled_ticks_also_within_one_decade(step: float | None) -> None:
    solution = srm.simulate(load("pendulum_chain"), 1.0, step=step)
    axes = solution.plot().axes[-1]
    axes.figure.draw_without_rendering()
    low, high = axes.get_ylim()
    labels = [tick for tick in axes.get_yticks() if low <= tick <= high]
    assert len(labels) >= 2


def test_legends_lie_above_their_panels(four_bar: Solution) -> None:
    figure = four_bar.plot()
    figure.draw_without_rendering()
    for axes in figure.axes:
        if axes.get_legend() is not None:
            above = axes.get_legend().get_window_extent().y0 - axes.bbox.y1
            assert above >= -1e-9  # pixels


def test_open_chain_has_no_panels_for_drift_and_sigma(pendulum_chain: Solution) -> None:
    figure = pendulum_chain.plot()
    assert titles(figure) == ["(a) total energy relative to the start", "(b) steps"]


@pytest.mark.parametrize(
    ("name", "signature"),
    [("run.png", b"\x89PNG"), ("run.PDF", b"%PDF"), ("run.svg", b"<?xml")],
)
def test_suffix_decides_the_format_of_the_file(
    pendulum_chain: Solution, tmp_path: Path, name: str, signature: bytes
) -> None:
    path = tmp_path / name
    pendulum_chain.plot(path)
    assert path.read_bytes().startswith(signature)
    assert path.stat().st_size > 5000


def fails_at(time: float) -> Any:
    """A controller that gives up at ``time`` (s)."""

    def controller(t: float, q: Any, v: Any) -> Any:
        if t >= time:
            raise ValueError("no power")
        return np.zeros(len(v))

    return controller


@pytest.mark.parametrize("name", ["slider_crank", "pendulum_chain"])
@pytest.mark.parametrize(("time", "some_steps"), [(1e-12, False), (0.5, True)])
def test_unfinished_runs_are_drawn_as_far_as_they_went(
    tmp_path: Path, name: str, time: float, some_steps: bool
) -> None:
    solution = srm.simulate(load(name), 2.0, controller=fails_at(time))
    assert (solution.status, solution.stats.steps > 0) == ("failed", some_steps)
    path = tmp_path / "run.png"
    figure = solution.plot(path)
    assert f"failed at t = {solution.t[-1]:.6g} s" in figure.get_suptitle()
    assert path.stat().st_size > 5000


def test_names_with_dollars_and_braces_are_no_formulas(four_bar: Solution, tmp_path: Path) -> None:
    mechanism = replace(four_bar.mechanism, name="a$b_{c")
    figure = srm.simulate(mechanism, 0.1).plot(tmp_path / "run.png")
    assert figure.get_suptitle() == "a$b_{c"


def test_plots_need_neither_pyplot_nor_a_display(tmp_path: Path) -> None:
    code = (
        "import sys, srm_mbs as srm\n"
        "solution = srm.simulate(srm.load('pendulum_chain'), 0.1)\n"
        "assert 'matplotlib' not in sys.modules\n"
        f"solution.plot({str(tmp_path / 'run.png')!r})\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    root = Path(srm.__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
