"""Pictures of singular configurations for ``docs/singular_configurations.md``.

    python -m tools.singular_pictures [DIR]

Run from a checkout with the test requirements; writes into ``docs/singular``, or DIR.  All of them
are of the equal-length slider-crank: its configurations, its runs, and SciPy's beside them.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import srm_mbs as srm
from benchmarks.thesis.drawing import BLACK, BLUE, GREY, VERMILION, label, legend, panels, save
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rows import closure_errors
from tests.support.reduced import index_one

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FOLDER = Path(__file__).parents[1] / "docs" / "singular"
VERTICAL = 1.5 * np.pi
"""Crank angle (rad) of the first singular configuration that the run meets."""
BAR = 2.0
"""Length of each bar (m)."""
T_END = 10.0
LEFT = 5.9
"""Time (s) soon after SciPy's run has left its branch (5.37 s)."""
TOLERANCE = 1e-6
"""Of all runs, rtol and SciPy's atol."""


def by_scipy(mechanism: srm.Mechanism, t_end: float) -> Any:
    """DOP853 on the index-1 equations, as in ``benchmarks.headline``."""
    start = np.concatenate([mechanism.q0, mechanism.v0])
    field = index_one(mechanism)
    return solve_ivp(field, (0.0, t_end), start, "DOP853", rtol=TOLERANCE, atol=TOLERANCE)


def points(mechanism: srm.Mechanism, q: FloatArray) -> FloatArray:
    """Pivot, middle joint and tip (3, 2) in the plane of motion, x and z in m."""
    data = mechanism.model.createData()
    pin.forwardKinematics(mechanism.model, data, q)
    tip = data.oMi[2].act(np.array([BAR, 0.0, 0.0]))
    return np.array([data.oMi[1].translation, data.oMi[2].translation, tip])[:, [0, 2]]


def draw_bars(axes: Axes, mechanism: srm.Mechanism, q: FloatArray, colour: str) -> None:
    x, z = points(mechanism, q).T
    axes.plot(x, z, color=colour, linewidth=2.0, marker="o", markersize=4)


def branches(mechanism: srm.Mechanism, path: Path) -> None:
    """The bars before, at and behind the singular configuration, on both branches."""
    figure, axes = panels(1, 1.5, 3, sharey=True)
    titles = ("before", "singular: the bars coincide", "behind: two ways to go on")
    for one, title, turn in zip(axes[0], titles, (0.6, 0.0, -0.6)):
        crank = VERTICAL + turn
        one.axhline(0.0, color=GREY, linewidth=0.8)
        draw_bars(one, mechanism, np.array([crank, -2.0 * crank]), BLUE)
        if turn < 0.0:  # the tip stays on the pivot
            draw_bars(one, mechanism, np.array([crank, np.pi]), VERMILION)
        one.plot(0.0, 0.0, "s", color=BLACK, markersize=6)
        one.set_aspect("equal")
        one.set_xlim(-2.6, 2.6)
        label(one, "x (m)", "z (m)" if turn > 0.0 else "", title)
    save(figure, path)


def configurations(mechanism: srm.Mechanism, path: Path) -> None:
    """The closed configurations as curves in the plane of the two angles, and two runs on them."""
    figure, axes = panels(1, 3.2)
    one = axes[0, 0]
    crank, rod = np.linspace(3.3, 6.2, 90), np.linspace(-12.6, -6.4, 120)
    grid = np.array([(a, b) for b in rod for a in crank])
    g, _ = closure_errors(mechanism.model, mechanism.loops, grid, np.zeros_like(grid))
    height = g[:, 0].reshape(len(rod), len(crank))
    one.contour(crank, rod, height, levels=[0.0], colors=[GREY], linewidths=0.8)
    ours = srm.simulate(mechanism, T_END, t_eval=np.linspace(0.0, T_END, 401))
    theirs = by_scipy(mechanism, LEFT)
    one.plot(*ours.q.T, color=BLUE, linewidth=2.5, label=f"srm_mbs, {T_END:g} s")
    one.plot(
        *theirs.y[:2], ".--", color=VERMILION, linewidth=1.0, label=f"SciPy, index 1, {LEFT} s"
    )
    for crossing in ours.crossings[:2]:
        if crossing.configuration is not None:
            one.plot(*crossing.configuration, "o", color=BLACK, fillstyle="none", markersize=9)
    one.set_xlim(crank[0], crank[-1])
    one.set_ylim(rod[0], rod[-1])
    label(one, "crank (rad)", "rod against crank (rad)")
    legend(one, beside=True)
    save(figure, path)


def runs(mechanism: srm.Mechanism, path: Path) -> None:
    """The crank over time, ours and SciPy's."""
    figure, axes = panels(1, 2.4)
    one = axes[0, 0]
    ours, theirs = srm.simulate(mechanism, T_END), by_scipy(mechanism, T_END)
    t = np.linspace(0.0, T_END, 400)
    for crossing in ours.crossings:
        one.axvline(crossing.time, color=GREY, linewidth=0.8)
    one.plot(t, ours(t)[0][:, 0], color=BLUE, linewidth=2.0, label="srm_mbs")
    one.plot(theirs.t, theirs.y[0], ".--", color=VERMILION, linewidth=1.0, label="SciPy, index 1")
    one.set_xlim(0.0, T_END)
    label(one, "t (s)", "crank (rad)", "vertical lines: passages")
    legend(one, beside=True)
    save(figure, path)


def passage(mechanism: srm.Mechanism, path: Path) -> None:
    """sigma at the stages of the steps around the first passage, with and without placement."""
    figure, axes = panels(1, 2.4)
    one = axes[0, 0]
    for placement, colour, marker in (("automatic", BLUE, "o"), ("off", VERMILION, "x")):
        run = srm.simulate(mechanism, 2.2, placement=placement)
        ends = run.steps.times
        stages = ends[:-1, None] + np.diff(ends)[:, None] * np.append(run.scheme.c, 1.0)
        name = f'placement="{placement}"'
        one.semilogy(
            stages.ravel(), run.steps.sigmas.ravel(), marker, color=colour, markersize=4, label=name
        )
    time = run.crossings[0].time
    one.axvline(time, color=GREY, linewidth=0.8)
    one.set_xlim(time - 0.6, time + 0.6)
    label(one, "t (s)", r"$\sigma$", "distance to the singular configuration at the stages")
    legend(one, beside=True)
    save(figure, path)


PICTURES = {f.__name__: f for f in (branches, configurations, runs, passage)}


def draw(folder: Path) -> None:
    """All pictures, as ``folder/NAME.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    mechanism = srm.load("slider_crank")
    for name, picture in PICTURES.items():
        picture(mechanism, folder / f"{name}.png")


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
