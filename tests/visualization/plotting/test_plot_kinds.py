"""The kinds of picture of a run: what is on their axes, what they leave out and refuse."""

from __future__ import annotations

import inspect
import re
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

import srm_mbs as srm
from srm_mbs.api import Solution
from srm_mbs.visualization.joint_components import rotation_vectors
from srm_mbs.visualization.plotting import COMMON, DAE_KINDS, KINDS, joints, sampling
from srm_mbs.visualization.plotting import figure as style
from srm_mbs.visualization.plotting.poses import plane_normal
from tests.support.bundled import load
from tests.support.commands import error_line, run
from tests.support.daes import START_TWO, problem_two, solution_two
from tests.support.mechanisms import DISTINCT_MODELS, add_link, floating_ring
from tests.support.snapshots import check_messages, refused
from tests.visualization.plotting.test_plots import fails_at, legend, line, marked_times, titles


@pytest.fixture(scope="module")
def slider_crank() -> Solution:
    return srm.simulate(load("slider_crank"), 3.0)


@pytest.fixture(scope="module")
def stewart() -> Solution:
    return srm.simulate(load("stewart_platform"), 0.2)


@pytest.fixture(scope="module")
def walker() -> Solution:
    return srm.simulate(load("jansen_walker"), 0.1)


@pytest.fixture(scope="module")
def ring() -> Solution:
    return srm.simulate(floating_ring(), 0.5)


@pytest.fixture(scope="module")
def driven() -> Solution:
    free = load("slider_crank")
    crank = srm.Drive(srm.ConstantSpeed(4.0), joint="crank")
    mechanism = srm.Mechanism(free.model, free.loops, drives=(crank,), q0=free.q0, v0=[4.0, -8.0])
    return srm.simulate(mechanism, 0.6)


@pytest.fixture(scope="module")
def let_go() -> Solution:
    """A four-bar whose pin lets go at 0.8 s."""
    mechanism = load("four_bar")
    freed = mechanism.without_loop("pin")
    event = srm.Event(lambda t, q, v: t - 0.8, action=lambda t, q, v: srm.Switch(freed))
    return srm.simulate(mechanism, 1.2, events=[event])


@pytest.fixture(scope="module")
def dae() -> srm.DaeSolution:
    return srm.solve_dae(problem_two(), (0.0, 1.0), START_TWO, first_step=1.0)


def drawn(axes: Axes, number: int = 0) -> tuple[np.ndarray, np.ndarray]:
    return axes.lines[number].get_xdata(), axes.lines[number].get_ydata()


def note(figure: Figure) -> str:
    return str(figure.get_supxlabel()).replace("\n", " ")


# -- all kinds --------------------------------------------------------------------------------


DRAWN = {"slider_crank", "delta_robot", "differential", "klann_walker"}
"""Of one loop in a plane, of drives, of joint closures, of many loops and points."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in DRAWN else [pytest.mark.stress])
        for name in DISTINCT_MODELS
    ],
)
def test_every_kind_of_every_bundled_mechanism_is_drawn_without_warnings(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What is asked here depends neither on the number of panels nor on that of the points.
    monkeypatch.setattr(sampling, "MIN_PIECES", 16)
    monkeypatch.setattr(joints, "MAX_ROWS", 2)
    monkeypatch.setattr(joints, "MAX_PORTRAITS", 1)
    solution = srm.simulate(load(name), 0.01)
    for kind in KINDS:
        figure = solution.plot(kind=kind)
        if kind == "path":  # ticks, layout and glyphs are found while drawing, which is slow
            figure.draw_without_rendering()
        for axes in figure.axes:
            if axes.axison:
                assert any(unit in axes.get_ylabel() for unit in ("(", "drift", "tolerance"))


@pytest.mark.parametrize("kind", KINDS)
def test_unfinished_runs_are_drawn_as_far_as_they_went(kind: str) -> None:
    solution = srm.simulate(load("slider_crank"), 2.0, controller=fails_at(0.5))
    assert solution.status == "failed"
    figure = solution.plot(kind=kind)
    assert f"failed at t = {solution.t[-1]:.6g} s" in figure.get_suptitle()


@pytest.mark.parametrize("kind", KINDS)
def test_runs_of_several_segments_are_drawn_whole(kind: str, let_go: Solution) -> None:
    figure = let_go.plot(kind=kind)
    if kind not in ("phase", "path", "poses"):
        assert figure.axes[-1].get_xlim()[1] > 1.2
        assert 0.8 in np.round(marked_times(figure.axes[-1]), 6)


def test_plots_that_cannot_be_drawn_are_refused(
    slider_crank: Solution, stewart: Solution, ring: Solution, dae: srm.DaeSolution, tmp_path: Path
) -> None:
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    add_link(model, 0, pin.JointModelFreeFlyer(), "body")
    adrift = srm.simulate(srm.Mechanism(model), 0.1)
    failed = srm.simulate(load("four_bar"), 1.0, step=1.0)
    assert len(failed.t) == 1
    ground, coupler = srm.Anchor("world"), srm.Anchor("coupler")
    cases: dict[str, tuple[Any, dict[str, Any]]] = {
        "an unknown kind": (slider_crank, {"kind": "drift"}),
        "joints of a run plot": (slider_crank, {"kind": "run", "joints": ["crank"]}),
        "an unknown joint": (slider_crank, {"kind": "state", "joints": ["krank"]}),
        "one name": (slider_crank, {"kind": "state", "joints": "crank"}),
        "no names": (slider_crank, {"kind": "state", "joints": []}),
        "a name twice": (slider_crank, {"kind": "phase", "joints": ["rod", "rod"]}),
        "a portrait of six freedoms": (stewart, {"kind": "phase", "joints": ["platform"]}),
        "no joint with a portrait": (ring, {"kind": "phase"}),
        "an unknown closure": (slider_crank, {"kind": "reactions", "loops": ["pni"]}),
        "an unknown joint's reaction": (slider_crank, {"kind": "reactions", "joints": ["pin"]}),
        "reactions of a body at rest": (adrift, {"kind": "reactions"}),
        "an unknown joint as axis": (slider_crank, {"kind": "state", "x": "krank"}),
        "a joint of six freedoms as axis": (stewart, {"kind": "state", "x": "platform"}),
        "a unit without a joint": (slider_crank, {"kind": "state", "unit": "deg"}),
        "a length of an angle": (slider_crank, {"kind": "state", "x": "crank", "unit": "mm"}),
        "an axis of a run plot": (slider_crank, {"x": "crank"}),
        "a size of one number": (slider_crank, {"size": 7.0}),
        "a size of nothing": (slider_crank, {"size": (7.0, 0.0)}),
        "a size by an unknown name": (slider_crank, {"size": "poster"}),
        "a resolution of nothing": (slider_crank, {"dpi": 0}),
        "a title that is no text": (slider_crank, {"title": 7}),
        "an unknown point": (slider_crank, {"kind": "point", "points": ["C"]}),
        "one point": (slider_crank, {"kind": "path", "points": srm.Anchor("rod")}),
        "no points": (slider_crank, {"kind": "path", "points": []}),
        "an unknown link": (slider_crank, {"kind": "path", "points": [srm.Anchor("rood")]}),
        "a point of the ground": (slider_crank, {"kind": "path", "points": [ground]}),
        "no point that moves": (failed, {"kind": "path", "points": [coupler]}),
        "a time of a pose outside the run": (slider_crank, {"kind": "poses", "at": [4.0]}),
        "a pose that is no time": (slider_crank, {"kind": "poses", "at": "late"}),
        "no poses": (slider_crank, {"kind": "poses", "at": []}),
        "an angle that the crank does not pass": (
            slider_crank,
            {"kind": "poses", "at": [90.0], "crank": "crank"},
        ),
        "a crank without positions": (slider_crank, {"kind": "poses", "crank": "crank"}),
        "a crank of six degrees of freedom": (
            ring,
            {"kind": "poses", "at": [0.0], "crank": ring.mechanism.joint_names[0]},
        ),
        "an unknown direction": (slider_crank, {"kind": "poses", "view": "w"}),
        "a direction of nothing": (slider_crank, {"kind": "poses", "view": (0, 0, 0)}),
        "poses in inches": (slider_crank, {"kind": "poses", "unit": "inch"}),
        "reactions of a DAE": (dae, {"kind": "reactions"}),
    }
    messages = {case: refused(partial(it.plot, **options)) for case, (it, options) in cases.items()}
    for it, name in ((slider_crank, "run.xyz"), (slider_crank, "run"), (dae, "dae.gif")):
        messages[f"the file {name}"] = refused(partial(it.plot, tmp_path / name), tmp_path)
    check_messages("plots", messages)
    assert not list(tmp_path.iterdir())


def test_names_with_dollars_and_underscores_are_drawn_as_they_are() -> None:
    mechanism = load("slider_crank")
    model = mechanism.model.copy()
    model.names[1], model.names[2] = "_a$b", "c$d"
    loop = srm.LoopClosure("point_on_line", *mechanism.loops[0].anchors, (1.0, 0.0, 0.0), name="_$")
    renamed = srm.Mechanism(model, (loop,), q0=mechanism.q0, v0=mechanism.v0, name="x")
    solution = srm.simulate(renamed, 0.1)
    for kind in ("state", "reactions", "phase", "path"):
        solution.plot(kind=kind).draw_without_rendering()
    assert legend(solution.plot(kind="reactions").axes[0]) == [" _$"]


# -- state ------------------------------------------------------------------------------------


def test_the_state_of_joints_is_that_of_the_run_with_units(slider_crank: Solution) -> None:
    figure = slider_crank.plot(kind="state", joints=["rod"])
    position, rate = figure.axes
    assert position.get_ylabel() == "rod\n(rad)"
    assert rate.get_ylabel() == "(rad/s)"
    t, values = drawn(position)
    assert set(slider_crank.t) <= set(t)
    assert len(t) > 5 * len(slider_crank.t)
    q, v = slider_crank(t)
    np.testing.assert_array_equal(values, q[:, 1])
    np.testing.assert_array_equal(drawn(rate)[1], v[:, 1])
    passages = [crossing.time for crossing in slider_crank.crossings]
    assert marked_times(position) == pytest.approx(passages)
    assert note(figure) == "Vertical lines: singular passages (dashed)."


def test_prismatic_joints_are_in_metres() -> None:
    solution = srm.simulate(load("stewart_platform"), 0.2)
    axes = solution.plot(kind="state", joints=["leg_2"]).axes
    assert [each.get_ylabel() for each in axes] == ["leg_2\n(m)", "(m/s)"]


def test_a_floating_body_has_a_position_and_a_rotation_vector(ring: Solution) -> None:
    figure = ring.plot(kind="state", joints=["a"])
    position, velocity, rotation, spin = figure.axes
    assert position.get_ylabel() == "a\nposition (m)"
    assert rotation.get_ylabel() == "a\nrotation (rad)"
    assert [velocity.get_ylabel(), spin.get_ylabel()] == ["(m/s)", "(rad/s)"]
    for axes in figure.axes:
        assert legend(axes) == ["x", "y", "z"]
        assert len({str(one.get_linestyle()) + str(one._dash_pattern) for one in axes.lines}) == 3
    assert "in the moving body's axes" in note(figure)
    t = drawn(position)[0]
    q, v = ring(t)
    for i in range(3):
        np.testing.assert_array_equal(drawn(position, i)[1], q[:, i])
        np.testing.assert_array_equal(drawn(spin, i)[1], v[:, 3 + i])
    vectors = np.array([drawn(rotation, i)[1] for i in range(3)]).T
    for vector, own in zip(vectors[::50], q[::50]):
        np.testing.assert_allclose(
            pin.exp3(vector), pin.Quaternion(*own[[6, 3, 4, 5]]).matrix(), atol=1e-12
        )


def test_rotation_vectors_count_turns_without_jumps() -> None:
    angles = np.linspace(-1.0, 20.0, 400)
    axis = np.array([1.0, -2.0, 2.0]) / 3.0
    quaternions = np.column_stack([np.outer(np.sin(angles / 2.0), axis), np.cos(angles / 2.0)])
    np.testing.assert_allclose(rotation_vectors(quaternions), np.outer(angles, axis), atol=1e-7)


def test_the_state_of_a_large_mechanism_says_what_it_leaves_out(stewart: Solution) -> None:
    figure = stewart.plot(kind="state")
    assert len(figure.axes) == 16
    assert "Left out: swing_3, lean_3" in note(figure)
    assert "and 6 more; joints=[...], or --joint, draws" in note(figure)
    names = stewart.mechanism.joint_names[:12]
    asked = stewart.plot(kind="state", joints=names)
    assert len(asked.axes) == 2 * 13
    assert "Left out" not in note(asked)


def test_what_does_not_move_is_a_straight_line_between_round_ticks() -> None:
    mechanism = load("parallelogram")
    model = mechanism.model.copy()
    model.gravity = pin.Motion.Zero()
    still = srm.Mechanism(model, mechanism.loops, q0=mechanism.q0)
    for axes in srm.simulate(still, 0.1).plot(kind="state").axes:
        low, high = axes.get_ylim()
        assert high - low > 1e-2


def test_a_jump_has_both_its_values() -> None:
    mechanism = load("simple_pendulum")
    kick = srm.Event(lambda t, q, v: t - 0.5, action=lambda t, q, v: (q, v + 3.0))
    solution = srm.simulate(mechanism, 1.0, events=[kick])
    before, after = solution.v[solution.t == 0.5][:, 0]
    t, rate = drawn(solution.plot(kind="state").axes[1])
    at = int(np.searchsorted(t, 0.5))
    assert rate[at - 1 : at + 1] == pytest.approx([before, after], abs=1e-9)
    assert t[at] - t[at - 1] < 1e-12
    # In the phase portrait nothing joins them.
    assert np.isnan(drawn(solution.plot(kind="phase").axes[0])[1]).sum() == 1


# -- balance ----------------------------------------------------------------------------------


def test_the_balance_shows_energies_works_and_residual(driven: Solution) -> None:
    figure = driven.plot(kind="balance")
    energies, works, residual = figure.axes
    names = [axes.get_ylabel().partition(" ")[0] for axes in figure.axes]
    assert names == ["energy", "work", "residual"]
    assert all(axes.get_ylabel().endswith("J)") for axes in figure.axes)
    assert legend(works) == ["drive crank"]
    t, kinetic = drawn(energies)
    potential, total = drawn(energies, 1)[1], drawn(energies, 2)[1]
    np.testing.assert_allclose(kinetic + potential, total)
    balance = driven.at(t).energy_balance
    np.testing.assert_allclose(kinetic, balance.kinetic)
    np.testing.assert_allclose(drawn(works)[1], balance.works["drive crank"], rtol=1e-6, atol=1e-6)
    assert drawn(residual)[0] == pytest.approx(driven.t)
    assert f"{driven.energy_balance.relative:.1e}" in titles(figure)[2]


def test_what_does_no_work_worth_mentioning_is_in_a_note(let_go: Solution) -> None:
    figure = let_go.plot(kind="balance")
    assert len(figure.axes) == 2
    assert "no more than the residual is left out: events" in note(figure)


def test_many_works_are_summed_and_none_is_lost() -> None:
    base = load("pendulum_chain")
    forces = [
        srm.JointTorque(name, 0.1 * (i + 1), name=f"{name}_{i}")
        for i in range(5)
        for name in base.joint_names[:2]
    ]
    mechanism = srm.Mechanism(base.model, forces=forces, q0=base.q0, v0=base.v0)
    solution = srm.simulate(mechanism, 0.3)
    works = solution.plot(kind="balance").axes[1]
    assert legend(works)[-1] == "5 others together"
    power = works.get_ylabel()
    assert "10^" not in power
    total = sum(one.get_ydata()[-1] for one in works.lines)
    assert total == pytest.approx(sum(own[-1] for own in solution.energy_balance.works.values()))


# -- reactions --------------------------------------------------------------------------------


def test_reactions_are_the_norms_of_forces_and_moments(driven: Solution) -> None:
    figure = driven.plot(kind="reactions")
    force, on_joints, turning, drive = figure.axes
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["force (N)", "force (N)", "moment (N m)", "torque (N m)"]
    t, values = drawn(force)
    read = driven.at(t)
    np.testing.assert_allclose(values, np.linalg.norm(read.reactions["pin"][:, :3], axis=1))
    wrench = read.joint_reactions["crank"]
    np.testing.assert_allclose(drawn(on_joints)[1], np.linalg.norm(wrench[:, :3], axis=1))
    np.testing.assert_allclose(drawn(turning)[1], np.linalg.norm(wrench[:, 3:], axis=1))
    np.testing.assert_allclose(drawn(drive)[1], read.drive_forces["crank"])
    shown = [legend(axes) for axes in figure.axes]
    assert shown == [["pin"], ["crank", "rod"], ["crank"], ["crank"]]
    assert "Left out as rounding: moment in pin, moment in rod." in note(figure)


def test_moments_of_a_contact_are_about_the_point_that_touches() -> None:
    """A ball on a plane: its force has a moment about the origin of the plane, none about the
    ball."""
    solution = srm.simulate(load("slider_crank"), 0.3)
    assert np.abs(solution.reactions["pin"][:, 3:]).max() > 1.0
    figure = solution.plot(kind="reactions", loops=["pin"])
    assert titles(figure) == ["(a) forces in the closures"]
    assert "Left out as rounding: moment in pin." in note(figure)


def test_joints_that_are_named_are_drawn_alone_over_any_joint() -> None:
    solution = srm.simulate(load("four_bar"), 0.5)
    figure = solution.plot(kind="reactions", joints=["rocker"], x="crank", unit="deg")
    assert [legend(axes) for axes in figure.axes] == [["rocker"]] * len(figure.axes)
    assert figure.axes[-1].get_xlabel() == "crank (deg)"
    angle, values = drawn(figure.axes[0])
    found = np.linalg.norm(solution.joint_reactions["rocker"][:, :3], axis=1)
    crank = np.rad2deg(solution.joint("crank")[0])
    assert angle[0] == pytest.approx(crank[0])
    assert angle[-1] == pytest.approx(crank[-1])
    assert values[-1] == pytest.approx(found[-1])


def test_an_open_chain_has_reactions_in_its_joints() -> None:
    solution = srm.simulate(load("pendulum_chain"), 0.1)
    figure = solution.plot(kind="reactions")
    assert titles(figure)[0] == "(a) forces in the joints"
    t, values = drawn(figure.axes[0])
    first = solution.mechanism.joint_names[0]
    expected = np.linalg.norm(solution.at(t).joint_reactions[first][:, :3], axis=1)
    np.testing.assert_allclose(values, expected)


def test_pins_have_no_moments_and_name_what_equilibrium_does_not_determine() -> None:
    solution = srm.simulate(load("four_bar"), 0.2)
    figure = solution.plot(kind="reactions")
    assert titles(figure) == ["(a) forces in the closures", "(b) forces in the joints"]
    assert "Equilibrium does not determine pin.y, crank.fy, crank.mx" in note(figure)
    figure = solution.plot(kind="reactions", loops=["pin"])
    assert "Equilibrium does not determine pin.y: values of least norm." in note(figure)


def test_rows_of_one_unit_share_a_panel() -> None:
    base = load("four_bar")
    hinge = srm.LoopClosure("revolute", *base.loops[0].anchors, (0.0, 1.0, 0.0), name="hinge")
    mechanism = srm.Mechanism(base.model, (hinge,), q0=base.q0, v0=base.v0)
    solution = srm.simulate(mechanism, 0.1)
    figure = solution.plot(kind="reactions", rows=True)
    units = [axes.get_ylabel().rpartition(" (")[2] for axes in figure.axes]
    assert [unit.rpartition("$ ")[2] for unit in units] == ["N)", "N m)"]
    labels = [*legend(figure.axes[0]), *legend(figure.axes[1])]
    assert labels == list(hinge.rows.labels)
    t, values = drawn(figure.axes[0])
    expected = solution.at(t).reaction_multipliers["hinge"][:, 0]
    np.testing.assert_allclose(values, expected)


def test_couplings_are_drawn_by_the_force_on_their_first_joints() -> None:
    solution = srm.simulate(load("differential"), 0.2)
    couplings = [loop.name for loop in solution.mechanism.loops]
    (axes,) = solution.plot(kind="reactions", loops=couplings).axes
    t, values = drawn(axes)
    assert legend(axes)[0].replace("\n", " ") == "final_drive, on pinion"
    np.testing.assert_allclose(values, solution.at(t).coupling_forces["final_drive"][:, 0])


def test_the_smaller_of_many_reactions_are_named_below(walker: Solution) -> None:
    figure = walker.plot(kind="reactions")
    assert len(legend(figure.axes[0])) == len(style.LINES)
    high = {
        n: np.percentile(np.linalg.norm(w[:, :3], axis=1), 98) for n, w in walker.reactions.items()
    }
    largest = max(high, key=lambda name: high[name])
    assert largest in legend(figure.axes[0])
    assert "Left out: " in note(figure)
    asked = walker.plot(kind="reactions", loops=["left_0_above"])
    assert legend(asked.axes[0]) == ["left_0_above"]


def test_peaks_beside_singular_passages_are_cut_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    solution = srm.simulate(load("slider_crank"), 10.0)
    peaked = {name: own.copy() for name, own in solution.reactions.items()}
    peaked["pin"][3, :3] *= 1e4
    figure = srm.simulate(load("slider_crank"), 10.0).plot(kind="reactions")
    assert "cut" not in titles(figure)[0]
    monkeypatch.setattr(Solution, "reactions", property(lambda _: peaked))
    monkeypatch.setattr(sampling, "PIECES_PER_STEP", 1)
    monkeypatch.setattr(sampling, "MIN_PIECES", 1)
    figure = solution.plot(kind="reactions")
    force = np.linalg.norm(peaked["pin"][:, :3], axis=1)
    assert titles(figure)[0].endswith(f"peaks to {force.max():.2g} N are cut")
    assert figure.axes[0].get_ylim()[1] < force.max() / 10.0
    assert drawn(figure.axes[0])[1].max() == force.max()


# -- points, axes, titles ---------------------------------------------------------------------


def test_points_have_positions_velocities_and_accelerations_over_a_joint(
    slider_crank: Solution,
) -> None:
    middle = srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))
    figure = slider_crank.plot(kind="point", points=[middle], x="crank", unit="deg")
    assert [axes.get_ylabel().rpartition("(")[2] for axes in figure.axes] == ["m)", "m/s)", "m/s²)"]
    assert titles(figure) == ["position", "velocity", "acceleration"]
    assert legend(figure.axes[0]) == ["x", "z"]
    motion = slider_crank.point(middle)
    crank = np.rad2deg(slider_crank.joint("crank")[0])
    for axes, values in zip(figure.axes, (motion.position, motion.velocity, motion.acceleration)):
        assert axes.get_xlabel() == "crank (deg)"
        for drawn_line, k in zip(axes.lines, (0, 2)):
            angle, shown = drawn_line.get_data()
            assert angle[-1] == pytest.approx(crank[-1])
            assert shown[-1] == pytest.approx(values[-1, k], rel=1e-9)
    assert "coordinates that do not change are left out" in note(figure)


def test_accelerations_are_a_third_column_of_the_state(slider_crank: Solution) -> None:
    figure = slider_crank.plot(kind="state", joints=["rod"], accelerations=True)
    assert titles(figure) == ["position", "rate", "acceleration"]
    t, values = drawn(figure.axes[2])
    np.testing.assert_allclose(values, slider_crank.at(t).accelerations[:, 1])
    assert figure.axes[2].get_ylabel() == "(rad/s²)"


def test_passages_are_marked_at_the_position_of_the_joint(slider_crank: Solution) -> None:
    crossings = slider_crank.crossings
    assert crossings
    figure = slider_crank.plot(kind="state", joints=["rod"], x="crank")
    expected = slider_crank.at([crossing.time for crossing in crossings]).joint("crank")[0]
    np.testing.assert_allclose(sorted(marked_times(figure.axes[0])), sorted(expected))


def test_titles_and_sizes_may_be_chosen(slider_crank: Solution, dae: srm.DaeSolution) -> None:
    for solution in (slider_crank, dae):
        figure = solution.plot(title="Test $1", size=(8.0, 3.5))
        assert figure.get_suptitle() == "Test $1"
        assert figure.get_size_inches().tolist() == [8.0, 3.5]


def inches(path: Path) -> tuple[float, float]:
    """Width and height of a picture, as its file says."""
    if path.suffix == ".png":
        with Image.open(path) as picture:
            return tuple(np.array(picture.size) / picture.info["dpi"])
    text = path.read_bytes().decode("latin-1")
    pattern = r'width="([\d.]+)pt" height="([\d.]+)pt"'
    if path.suffix == ".pdf":
        pattern = r"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]"
    width, height = re.search(pattern, text).groups()
    return float(width) / 72.0, float(height) / 72.0


def test_files_have_the_width_of_a_column_or_page_and_their_text_as_text(
    slider_crank: Solution, tmp_path: Path
) -> None:
    point = [srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))]
    for suffix in ("png", "pdf", "svg"):
        for size, width in (("column", 3.5), ("page", 7.0), ((5.0, 2.5), 5.0)):
            path = tmp_path / f"path.{suffix}"
            slider_crank.plot(path, kind="path", points=point, size=size, dpi=150, title="Rod")
            assert inches(path)[0] == pytest.approx(width, abs=0.01)
    assert inches(path)[1] == pytest.approx(2.5, abs=0.01)
    assert re.search(r"<text[^>]*>Rod<", path.read_text())
    fonts = path.with_suffix(".pdf").read_bytes()
    assert b"/FontFile2" in fonts
    assert b"/Type3" not in fonts
    with Image.open(path.with_suffix(".png")) as picture:
        assert picture.size == (750, 375)
    with pytest.raises(srm.InputError, match="would have 240000 by 240000 pixels"):
        slider_crank.plot(path.with_suffix(".png"), size=(100.0, 100.0), dpi=2400)


@pytest.mark.parametrize("kind", ["run", "state", "reactions"])
def test_nothing_of_a_plot_for_a_column_overlaps_or_leaves_the_picture(
    slider_crank: Solution, kind: str
) -> None:
    figure = slider_crank.plot(kind=kind, size="column")
    figure.draw_without_rendering()
    frame = figure.bbox
    for axes in figure.axes:
        title, legend = axes._left_title.get_window_extent(), axes.get_legend()
        texts = [*legend.get_texts()] if legend else []
        for box in [title, *(text.get_window_extent() for text in texts)]:
            assert frame.x0 <= box.x0
            assert box.x1 <= frame.x1
        assert not any(title.overlaps(text.get_window_extent()) for text in texts)


# -- sigma ------------------------------------------------------------------------------------


def test_all_kinds_of_steps_have_marks_of_their_own(slider_crank: Solution) -> None:
    figure = slider_crank.plot(kind="sigma")
    sigma, steps, errors = figure.axes
    assert sigma.get_yscale() == steps.get_yscale() == errors.get_yscale() == "log"
    data = slider_crank.steps
    placed = line(steps, "placed")
    chosen = data.placements > 0.0
    assert chosen.any()
    np.testing.assert_array_equal(placed.get_xdata(), data.times[:-1][chosen])
    np.testing.assert_array_equal(placed.get_ydata(), np.diff(data.times)[chosen])
    assert placed.get_marker() != line(steps, "accepted").get_marker()
    np.testing.assert_array_equal(line(sigma, "step ends").get_ydata(), data.sigmas[:, -1])
    np.testing.assert_array_equal(line(errors, "accepted").get_ydata(), data.error_ratios)
    passages = [crossing.time for crossing in slider_crank.crossings]
    for axes in figure.axes:
        assert marked_times(axes) == pytest.approx(passages)


def test_rejected_steps_have_error_estimates_above_one() -> None:
    solution = srm.simulate(load("four_bar"), 2.0)
    errors = solution.plot(kind="sigma").axes[2]
    rejected = line(errors, "rejected")
    assert len(rejected.get_ydata()) == solution.stats.rejected > 0
    assert rejected.get_ydata().min() > 1.0
    assert line(errors, "accepted").get_ydata().max() <= 1.0


def test_stiff_intervals_are_shaded() -> None:
    run = srm.simulate(srm.load("flyball_governor"), 0.1)
    ((start, end),) = run.settings.stiff
    axes = run.plot(kind="sigma").axes[-2]
    (shaded,) = [patch for patch in axes.patches if patch.get_label() == "stiff"]
    box = shaded.get_extents().transformed(axes.transData.inverted())
    np.testing.assert_allclose([box.x0, box.x1], [start, end], rtol=1e-9)
    plain = srm.simulate(srm.load("four_bar"), 0.1).plot(kind="sigma")
    assert not any(axes.patches for axes in plain.axes)


def test_steps_in_the_zone_are_marked() -> None:
    quarter = 4.29657624142677449 / 4.0  # a grid point is singular
    options: dict[str, Any] = {"tableau": "dopr54", "placement": "off"}
    solution = srm.simulate(load("slider_crank"), 2.0, step=quarter / 20, **options)
    assert len(solution.steps.zones) == solution.stats.zone_steps > 0
    figure = solution.plot(kind="sigma")
    assert len(figure.axes) == 2  # fixed steps have no error estimate
    marked = line(figure.axes[1], "in the zone")
    assert len(marked.get_xdata()) == solution.stats.zone_steps


# -- phase ------------------------------------------------------------------------------------


def test_phase_portraits_have_positions_rates_starts_ends_and_passages(
    slider_crank: Solution,
) -> None:
    figure = slider_crank.plot(kind="phase")
    assert titles(figure) == ["crank", "rod"]
    axes = figure.axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("position (rad)", "rate (rad/s)")
    curve, passages, start, end = axes.lines
    q, v = slider_crank(slider_crank.span[1])
    assert end.get_xydata()[0] == pytest.approx([q[0], v[0]])
    assert start.get_xydata()[0] == pytest.approx([slider_crank.q[0, 0], slider_crank.v[0, 0]])
    at = [slider_crank(crossing.time) for crossing in slider_crank.crossings]
    np.testing.assert_allclose(passages.get_xydata(), [(q[0], v[0]) for q, v in at])
    assert start.get_marker() != end.get_marker() != passages.get_marker()
    np.testing.assert_array_equal(curve.get_xdata()[[0]], start.get_xdata())
    assert "Circles: start; squares: end; plus signs: singular passages." in note(figure)


def test_joints_of_several_degrees_of_freedom_have_no_portrait(stewart: Solution) -> None:
    assert "Left out: platform" in note(stewart.plot(kind="phase"))


# -- path -------------------------------------------------------------------------------------


def test_the_path_of_a_point_in_its_plane(slider_crank: Solution) -> None:
    figure = slider_crank.plot(kind="path", points=[srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))])
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "z (m)")
    assert axes.get_aspect() == 1.0
    path = line(axes, "rod (1, 0, 0)")
    times = sampling.read_smoothly(slider_crank).t
    crank = slider_crank(times)[0][:, 0]
    # Bars of 2 m, isosceles: half way along the rod, half as high as the crank's end.
    np.testing.assert_allclose(path.get_xdata(), 3.0 * np.cos(crank), atol=1e-6)
    np.testing.assert_allclose(path.get_ydata(), np.sin(crank), atol=1e-6)
    assert legend(axes) == ["rod (1, 0, 0)", "start", "end"]


def test_points_in_space_are_seen_from_three_sides(ring: Solution) -> None:
    figure = ring.plot(kind="path", points=[srm.Anchor("b")])
    labels = [(axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes if axes.axison]
    assert labels == [("x (m)", "z (m)"), ("y (m)", "z (m)"), ("x (m)", "y (m)")]
    assert titles(figure)[:3] == ["from the front", "from the right", "from above"]


def test_paths_by_default_are_those_of_different_points_that_move(let_go: Solution) -> None:
    (axes,) = let_go.plot(kind="path").axes
    assert legend(axes) == ["1 coupler", "2 closure pin", "start", "end"]
    assert [text.get_text() for text in axes.texts] == ["1", "2"]  # for print in grey
    pendulum = srm.simulate(load("simple_pendulum"), 0.5)
    (axes,) = pendulum.plot(kind="path").axes
    assert legend(axes)[0].replace("\n", " ") == "centre of mass of the body at pendulum"


# -- long runs --------------------------------------------------------------------------------


def test_thinned_lines_keep_every_extreme() -> None:
    t = np.linspace(0.0, 1.0, 200_000)
    values = np.sin(40.0 * t)
    values[123_456], values[77_777], values[5_000] = 9.0, -9.0, np.nan
    seen = sampling.thinned(t, values)
    assert len(seen) <= 4 * sampling.COLUMNS
    assert {0, 77_777, 123_456, len(t) - 1} <= set(seen)
    few = sampling.thinned(t[:100], values[:100])
    assert list(few) == list(range(100))


def test_marks_upon_each_other_are_drawn_once_and_the_extremes_always() -> None:
    rng = np.random.default_rng(0)
    x, y = np.sort(rng.uniform(0.0, 1.0, 500_000)), 10.0 ** rng.integers(-3, 0, 500_000)
    y[4321], y[77] = 1e3, 1e-9
    seen = sampling.distinct(x, y, log=True)
    assert len(seen) < 6 * sampling.COLUMNS
    assert {4321, 77} <= set(seen)


def test_a_long_run_is_drawn_with_few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "COLUMNS", 20)
    monkeypatch.setattr(sampling, "ROWS", 20)
    solution = srm.simulate(load("slider_crank"), 40.0)
    for kind in ("run", "state", "sigma", "balance"):
        for axes in solution.plot(kind=kind).axes:
            for one in axes.lines:
                assert len(one.get_xdata()) <= 20 * 21
    crank = solution.plot(kind="state").axes[0].lines[0].get_ydata()
    read = sampling.read_smoothly(solution).q[:, 0]
    assert (crank.min(), crank.max()) == (read.min(), read.max())


# -- style ------------------------------------------------------------------------------------


def test_lines_of_a_panel_differ_in_more_than_colour() -> None:
    styles = style.line_styles(len(style.LINES))
    assert len({str(each["linestyle"]) for each in styles}) == len(styles)


def test_a_legend_that_does_not_fit_above_stands_beside(walker: Solution) -> None:
    figure = walker.plot(kind="reactions")
    figure.draw_without_rendering()
    axes = figure.axes[0]
    assert axes.get_legend().get_window_extent().x0 >= axes.bbox.x1


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("pin", ["pin"]),
        ("left_plantar_foot_joint", ["left_plantar_", "foot_joint"]),
        ("on the left shoulder", ["on the left", "shoulder"]),
        ("x" * 20, ["x" * 16, "x" * 4]),
    ],
)
def test_long_names_are_broken_where_their_words_end(name: str, lines: list[str]) -> None:
    assert style.wrapped(name, 16).split("\n") == lines


def test_small_values_have_their_power_of_ten_in_the_label() -> None:
    axes = Figure().subplots()
    factor = style.linear_axis(axes, [np.array([-2e-5, 3e-5])], "work ", "J", size=0.0)
    assert factor == pytest.approx(1e-5)
    assert axes.get_ylabel() == "work ($10^{-5}$ J)"
    assert style.linear_axis(axes, [np.array([5.0, 700.0])], "work ", "J") == 1.0
    # A change in the eighth digit is not magnified, nor written as a difference.
    style.linear_axis(axes, [np.array([5.0, 5.0 + 1e-7])], "position ", "m")
    low, high = axes.get_ylim()
    assert low < 4.6 < 5.4 < high


# -- poses ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def turning() -> Solution:
    return srm.simulate(load("four_bar"), 1.2)


def corners(axes: Axes) -> list[np.ndarray]:
    """Corners of the outlines of the bodies, in the order in which they are drawn."""
    return [patch.get_xy()[:-1] for patch in axes.patches if patch.get_edgecolor()[3] > 0.0]


def holds(points: np.ndarray, point: np.ndarray) -> bool:
    return bool(np.linalg.norm(points - point, axis=1).min() < 1e-9)


def test_bodies_and_points_are_drawn_where_forward_kinematics_puts_them(turning: Solution) -> None:
    point = srm.Anchor("coupler", xyz=(1.0, 0.0, 0.6))
    times = [0.15, 0.7]
    options = {"kind": "poses", "at": times, "points": [point], "unit": "mm"}
    axes = turning.plot(**options).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (mm)", "z (mm)")
    assert axes.get_aspect() == 1.0
    model = turning.mechanism.model
    data = model.createData()
    outlines = corners(axes)
    assert len(outlines) == 2 * 3
    (path,) = (own for own in axes.lines if "path of" in str(own.get_label()))
    for k, t in enumerate(times):
        q, _ = turning(t)
        pin.forwardKinematics(model, data, q)
        ends = {"crank": [(1.0, 0.0, 0.0)], "rocker": [(1.5, 0.0, 0.0)]}
        ends["coupler"] = [(2.0, 0.0, 0.0), (1.0, 0.0, 0.6)]
        for name, local in ends.items():
            joint = model.getJointId(name)
            outline = outlines[3 * k + joint - 1]
            placed = [data.oMi[joint].act(np.array(end)) for end in [(0.0, 0.0, 0.0), *local]]
            assert len(outline) == len(placed)
            assert all(holds(outline, 1e3 * p[[0, 2]]) for p in placed)
        curve = np.column_stack(path.get_data())
        assert np.linalg.norm(curve - 1e3 * placed[-1][[0, 2]], axis=1).min() < 20.0
    # The first is paler.
    strengths = [sum(patch.get_edgecolor()[:3]) for patch in axes.patches[1::2]]
    assert strengths[0] > strengths[3]


def test_poses_at_angles_of_a_crank_have_these_angles(turning: Solution) -> None:
    axes = turning.plot(kind="poses", at=[90.0, 200.0, 330.0], crank="crank").axes[0]
    cranks = corners(axes)[::3]
    for angle, bar in zip((90.0, 200.0, 330.0), cranks):
        tip = bar[np.linalg.norm(bar, axis=1).argmax()]
        # Joints about +y turn x towards -z.
        found = np.degrees(np.arctan2(abs(tip[1]), tip[0]))
        assert found == pytest.approx(min(angle, 360.0 - angle), abs=1e-9)


@pytest.mark.parametrize(
    ("view", "labels"),
    [
        ("x", ("y (m)", "z (m)")),
        ("z", ("x (m)", "y (m)")),
        ((0.0, -2.0, 0.0), ("-x (m)", "z (m)")),
        ((-1.0, 1.0, 0.0), ("along (0.71, 0.71, 0) (m)", "z (m)")),
    ],
)
def test_the_direction_of_view_may_be_chosen(
    turning: Solution, view: Any, labels: tuple[str, str]
) -> None:
    axes = turning.plot(kind="poses", view=view).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == labels


def test_the_plane_of_motion_is_found_from_the_axes_of_the_joints(ring: Solution) -> None:
    model = pin.Model()
    tilted = np.array([0.6, 0.0, 0.8])
    first = add_link(model, 0, pin.JointModelRevoluteUnaligned(tilted), "first")
    add_link(model, first, pin.JointModelRevoluteUnaligned(-tilted), "second")
    normal = plane_normal(srm.Mechanism(model))
    assert normal is not None
    np.testing.assert_allclose(np.abs(normal), tilted, atol=1e-12)
    slide = pin.JointModelPrismaticUnaligned(np.array([0.8, 0.0, -0.6]))
    add_link(model, first, slide, "across")
    assert plane_normal(srm.Mechanism(model)) is not None
    add_link(model, first, pin.JointModelPX(), "out")
    assert plane_normal(srm.Mechanism(model)) is None
    assert plane_normal(ring.mechanism) is None


# -- DAEs -------------------------------------------------------------------------------------


def test_the_run_of_a_dae_has_drift_sigma_and_steps(dae: srm.DaeSolution) -> None:
    figure = dae.plot()
    drift, sigma, steps = figure.axes
    assert figure.get_suptitle() == "index-2 DAE"
    assert steps.get_xlabel() == "time"
    g = [abs(problem_two().g(t, x)) for t, x in zip(dae.t, dae.x)]
    np.testing.assert_allclose(drawn(drift)[1], np.maximum(g, 1e-17))
    np.testing.assert_array_equal(line(sigma, "step ends").get_ydata(), dae.steps.sigmas[:, -1])
    rejected = line(steps, "rejected").get_xydata()
    assert len(rejected) == dae.stats.rejected > 0
    assert rejected[0] == pytest.approx([0.0, 1.0])


def test_states_and_multipliers_of_a_dae_are_drawn_between_its_steps(
    dae: srm.DaeSolution, tmp_path: Path
) -> None:
    figure = dae.plot(tmp_path / "dae.png", kind="state")
    states, multipliers = figure.axes
    assert [legend(states), legend(multipliers)] == [["x[0]", "x[1]"], ["y[0]"]]
    t, first = drawn(states)
    assert len(t) > 5 * len(dae.t)
    x, y = solution_two(t)
    np.testing.assert_allclose(first, x[:, 0], atol=1e-5)
    np.testing.assert_allclose(drawn(states, 1)[1], x[:, 1], atol=1e-5)
    np.testing.assert_allclose(drawn(multipliers)[1], y, atol=1e-4)


def test_a_dae_that_fails_at_its_start_is_drawn() -> None:
    solution = srm.solve_dae(
        problem_two(f=lambda t, x: np.full(2, np.nan) if t > 0.1 else problem_two().f(t, x)),
        (0.0, 1.0),
        START_TWO,
    )
    assert not solution.success
    for kind in ("run", "state"):
        assert "failed at t = " in solution.plot(kind=kind).get_suptitle()


# -- the command line -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "crank.npz"
    srm.simulate(load("slider_crank"), 0.3).save(path)
    return path


@pytest.mark.parametrize(
    "options",
    [
        ("--kind", "state", "--joint", "rod", "--joint", "crank"),
        ("--kind", "reactions", "--loop", "pin", "--rows"),
        ("--kind", "path", "--point", "rod:1,0,0"),
        ("--kind", "phase", "--joint", "rod"),
        ("--kind", "poses", "--at", "0,0.2", "--point", "rod:1,0,0", "--view", "0,1,0"),
        ("--kind", "poses", "--at", "0", "--unit", "mm", "--size", "column", "--dpi", "250"),
        ("--kind", "point", "--point", "rod:1,0,0", "--title", "A point", "--size", "8,6"),
        ("--kind", "state", "--x", "crank", "--unit", "deg", "--accelerations"),
        ("--kind", "reactions", "--joint", "crank", "--joint", "rod"),
    ],
)
def test_the_command_plot_draws_other_kinds_beside_the_run(
    saved: Path, options: tuple[str, ...]
) -> None:
    beside = saved.with_name(f"crank_{options[1]}.png")
    assert run("plot", saved, *options) == f"written: {beside}\n"
    assert beside.stat().st_size > 5000


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--kind", "drift"), "--kind"),
        (("--joint", "rod"), "--joint"),
        (("--kind", "state", "--joint", "x"), "--joint"),
        (("--kind", "path", "--point", "rod"), "--point"),
        (("--kind", "path", "--point", "rd:0,0,0"), "--point"),
        (("--kind", "reactions", "--loop", "x"), "--loop"),
        (("--kind", "reactions", "--joint", "x"), "--joint"),
        (("--kind", "point", "--point", "C"), "--point"),
        (("--kind", "state", "--x", "C"), "--x"),
        (("--kind", "state", "--x", "crank", "--unit", "m"), "--unit"),
        (("--size", "7"), "--size"),
        (("--dpi", "1"), "--dpi"),
        (("--kind", "poses", "--at", "-1"), "--at"),
        (("--kind", "poses", "--view", "1,2"), "--view"),
    ],
)
def test_the_command_plot_names_its_own_options(
    saved: Path, options: tuple[str, ...], named: str
) -> None:
    assert error_line(run("plot", saved, *options, status=2)).startswith(f"error: {named}: ")


def test_the_help_of_the_command_plot_lists_the_kinds() -> None:
    words = run("plot", "--help").replace(",", " ").split()
    assert set(KINDS) <= set(words)


def test_a_loaded_run_with_a_controller_is_drawn_but_for_what_needs_it(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    mechanism = load("slider_crank")
    srm.simulate(mechanism, 0.2, controller=lambda t, q, v: [np.sin(t), 0.0]).save(path)
    solution = srm.load_solution(path)
    for kind in KINDS:
        if kind not in ("balance", "reactions", "point"):
            solution.plot(kind=kind)
            continue
        with pytest.raises(srm.InputError, match="controllers are not saved"):
            solution.plot(kind=kind)


def test_runaway_states_are_drawn_without_warnings() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the run's own, of overflow
        solution = srm.simulate(load("four_bar"), 100.0, step=0.3)
    assert not solution.success
    for kind in KINDS:
        figure = solution.plot(kind=kind)
        if kind in ("run", "reactions"):  # those with logarithms and peaks; drawing is slow
            figure.draw_without_rendering()


@pytest.mark.parametrize(("result", "kinds"), [(Solution, KINDS), (srm.DaeSolution, DAE_KINDS)])
def test_the_signature_of_plot_names_the_options_of_all_kinds(result: Any, kinds: Any) -> None:
    named = [list(inspect.signature(draw).parameters)[1:] for draw in kinds.values()]
    every = {*COMMON, *(name for names in named for name in names)}
    _, path, kind, *options = inspect.signature(result.plot).parameters.values()
    assert (path.name, kind.name) == ("path", "kind")
    assert {option.name for option in options} == every
    assert all(option.kind is inspect.Parameter.KEYWORD_ONLY for option in options)
    # The defaults are those that are not handed on.
    assert all(option.default in (None, False) for option in options)


def test_options_at_their_defaults_are_those_of_no_kind(slider_crank: Solution) -> None:
    figure = slider_crank.plot(kind="run", joints=None, rows=False, accelerations=False)
    assert titles(figure) == titles(slider_crank.plot())
