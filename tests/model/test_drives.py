"""Drives: prescribed motions, the forces that they need, and what they refuse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system
from tests.support.backends import needs_kernel, on_both
from tests.support.bundled import finished, load
from tests.support.convergence import observed_order
from tests.support.lockstep import compare
from tests.support.mechanisms import add_link, along_x
from tests.support.snapshots import check_messages, refused


def driven(
    mechanism: srm.Mechanism, *drives: srm.Drive, q: Any = None, v: Any = None
) -> srm.Mechanism:
    """``mechanism`` with the drives, assembled from its own start."""
    mechanism = replace(mechanism, drives=drives)
    q = mechanism.q0 if q is None else q
    state = srm.assemble(mechanism, q, mechanism.v0 if v is None else v)
    return mechanism.with_state(state.q, state.v)


def chain(*joints: Any, gravity: float = 9.81) -> srm.Mechanism:
    """Rods of 1 m and 1 kg along x, one after the other; gravity along -y."""
    model = pin.Model()
    model.name = "chain"
    model.gravity.linear = np.array([0.0, -gravity, 0.0])
    parent = 0
    for i, joint in enumerate(joints):
        parent = add_link(model, parent, joint, "abc"[i], at=along_x(1.0 if i else 0.0))
    return srm.Mechanism(model)


def pendulum(joint: Any = None, angle: float = 0.4) -> srm.Mechanism:
    mechanism = chain(joint or pin.JointModelRZ())
    q = [angle] if mechanism.model.nq == 1 else [np.cos(angle), np.sin(angle)]
    return mechanism.with_state(np.array(q), np.zeros(1))


# Where everything is known in closed form


@on_both
@pytest.mark.parametrize("joint", [pin.JointModelRZ, pin.JointModelRUBZ], ids=["angle", "cos, sin"])
def test_a_pendulum_follows_a_sine_and_the_torque_is_that_of_its_inertia_and_weight(
    joint: Any, backend: str
) -> None:
    start = pendulum(joint())
    mechanism = driven(start, srm.Drive(srm.Sine(2.0, omega=3.0, phase=0.5), "a"))
    t = np.linspace(0.0, 2.0, 41)
    solution = finished(mechanism, 2.0, rtol=1e-10, t_eval=t, backend=backend)
    angle, rate = solution.joint("a")
    wanted = 0.4 + 2.0 * (np.sin(3.0 * t + 0.5) - np.sin(0.5))
    np.testing.assert_allclose(angle, wanted, atol=1e-9)
    np.testing.assert_allclose(rate, 6.0 * np.cos(3.0 * t + 0.5), atol=1e-8)
    inertia = mechanism.model.inertias[1]
    about = inertia.inertia[2, 2] + 0.25
    torque = about * -18.0 * np.sin(3.0 * t + 0.5) + 9.81 * 0.5 * np.cos(wanted)
    np.testing.assert_allclose(solution.drive_forces["a"], torque, atol=1e-8)
    np.testing.assert_allclose(solution.drive_rates["a"], rate, atol=1e-8)


@on_both
def test_a_continuous_joint_is_driven_through_many_turns(backend: str) -> None:
    mechanism = driven(pendulum(pin.JointModelRUBZ()), srm.Drive(srm.ConstantSpeed(-9.0), "a"))
    solution = srm.simulate(mechanism, 10.0, rtol=1e-8, backend=backend)
    angle, _ = solution.joint("a")
    np.testing.assert_allclose(angle, 0.4 - 9.0 * solution.t, atol=1e-11)
    assert solution.drift.max() < 1e-12


@on_both
def test_an_arm_moved_with_minimum_jerk_needs_the_torques_of_inverse_dynamics(
    backend: str,
) -> None:
    arm = chain(pin.JointModelRZ(), pin.JointModelRY(), pin.JointModelRX())
    targets = {"a": 1.2, "b": -0.7, "c": 0.9}
    drives = [srm.Drive(srm.MinimumJerk(q, 0.8, start=0.1), name) for name, q in targets.items()]
    mechanism = driven(arm, *drives, q=np.array([0.3, 0.2, -0.4]))
    assert mechanism.degrees_of_freedom == 0
    t = np.linspace(0.0, 1.0, 51)
    solution = finished(mechanism, 1.0, rtol=1e-9, t_eval=t, backend=backend)
    np.testing.assert_allclose(solution.q[-1], list(targets.values()), atol=1e-12)
    model, data = mechanism.model, mechanism.model.createData()
    curves = [mechanism.drive_curves[name] for name in targets]
    for i, time in enumerate(t):
        q, v, a = np.array([curve(time) for curve in curves]).T
        torque = pin.rnea(model, data, q, v, a)
        found = [solution.drive_forces[name][i] for name in targets]
        np.testing.assert_allclose(found, torque, atol=1e-7)


def slider_crank(speed: float = 2.0) -> srm.Mechanism:
    mechanism = load("slider_crank_regular")
    return driven(mechanism, srm.Drive(srm.ConstantSpeed(speed), "crank"))


@on_both
def test_the_torque_of_a_slider_crank_at_constant_speed_is_that_of_the_reduced_equation(
    backend: str,
) -> None:
    """One coordinate x: tau = (d/dt dL/dx' - dL/dx) with the joints as functions of the crank."""
    mechanism = slider_crank()
    model, data = mechanism.model, mechanism.model.createData()
    t = np.linspace(0.05, 2.95, 30)
    solution = finished(mechanism, 3.0, rtol=1e-10, t_eval=t, backend=backend)
    assert solution.drift.max() < 1e-12

    def energies(crank: float, near: np.ndarray) -> tuple[float, float]:
        """Kinetic energy for a crank rate of 1 rad/s, and the potential."""
        free = replace(mechanism, drives=())
        state = srm.assemble(
            free.with_state(near, 0.0 * near[: model.nv]), {"crank": crank}, {"crank": 1.0}
        )
        kinetic = pin.computeKineticEnergy(model, data, state.q, state.v)
        return kinetic, pin.computePotentialEnergy(model, data, state.q)

    for i in range(0, len(t), 7):
        # At constant speed w: tau = w^2 dT1/dx + dV/dx.
        x, near, h = solution.joint("crank")[0][i], solution.q[i], 1e-3
        values = np.array([energies(x + k * h, near) for k in (-2, -1, 1, 2)])
        slope = np.array([1.0, -8.0, 8.0, -1.0]) @ values / (12.0 * h)
        torque = 4.0 * slope[0] + slope[1]
        assert solution.drive_forces["crank"][i] == pytest.approx(torque, rel=1e-7, abs=1e-7)


@on_both
def test_a_point_driven_along_a_line_needs_the_force_that_moves_it(backend: str) -> None:
    """A bead of 1 kg on a vertical rail (prismatic), pulled by its anchor along the rail."""
    model = pin.Model()
    model.gravity.linear = np.array([0.0, 0.0, -9.81])
    add_link(model, 0, pin.JointModelPZ(), "bead", pin.Inertia(2.0, np.zeros(3), np.eye(3)))
    drive = srm.Drive(
        srm.Polynomial([7.0, 0.5, 0.3, -0.2]),
        a=srm.Anchor("bead", xyz=(0.1, 0.2, 0.3)),
        b=srm.Anchor("world", xyz=(0.0, 0.0, -1.0)),
        axis=np.array([0.0, 0.0, 2.0]),  # type: ignore[arg-type]
        name="lift",
    )
    assert drive.axis == (0.0, 0.0, 1.0)
    mechanism = driven(srm.Mechanism(model, q0=[0.25]), drive)
    t = np.linspace(0.0, 1.5, 16)
    solution = srm.simulate(mechanism, 1.5, t_eval=t, backend=backend)
    height = 0.25 + 0.5 * t + 0.3 * t**2 - 0.2 * t**3
    np.testing.assert_allclose(solution.q[:, 0], height, atol=1e-12)
    force = 2.0 * (9.81 + 0.6 - 1.2 * t)
    np.testing.assert_allclose(solution.drive_forces["lift"], force, atol=1e-9)


@on_both
def test_a_table_is_followed(backend: str) -> None:
    t = np.linspace(0.0, 2.0, 11)
    table = srm.Table(t, np.sin(2.0 * t))
    mechanism = driven(pendulum(), srm.Drive(table, "a"))
    solution = srm.simulate(mechanism, 2.0, t_eval=t, backend=backend, rtol=1e-8)
    np.testing.assert_allclose(solution.q[:, 0], 0.4 + np.sin(2.0 * t), atol=1e-11)


# Balance, order, drift, and singular configurations


CASES: dict[str, Callable[[], srm.Mechanism]] = {
    "slider-crank": slider_crank,
    "five-bar, one crank": lambda: driven(
        load("five_bar"), srm.Drive(srm.Sine(0.3, frequency_hz=0.4, phase=0.2), "crank_left")
    ),
    "spatial four-bar": lambda: driven(
        load("spatial_four_bar"), srm.Drive(srm.ConstantSpeed(3.0), "crank")
    ),
    "a point of a chain": lambda: driven(
        load("pendulum_chain"),
        srm.Drive(
            srm.Sine(0.1, omega=2.0),
            a=srm.Anchor("link_2", xyz=(0.1, 0.0, 0.0)),
            b=srm.Anchor("world"),
            axis=(0.0, 0.0, 1.0),
        ),
        q=load("pendulum_chain").q0 + 0.3,
    ),
}


every_case = pytest.mark.parametrize("make", CASES.values(), ids=CASES.keys())


@every_case
def test_the_work_of_the_drives_is_what_the_energy_gains(
    make: Callable[[], srm.Mechanism],
) -> None:
    solution = finished(make(), 1.5, rtol=1e-10)
    balance = solution.energy_balance
    assert any(name.startswith("drive ") for name in balance.works)
    assert balance.relative < 1e-8
    assert solution.drift.max() < 1e-11


@needs_kernel
@every_case
def test_both_backends_make_the_same_driven_steps(make: Callable[[], srm.Mechanism]) -> None:
    comparison = compare(make(), 1.0, rtol=1e-8)
    assert comparison.decisions == []
    assert comparison.attempts > 5
    assert max(comparison.h, comparison.state, comparison.correction) < 1e-12


@pytest.mark.parametrize(
    ("tableau", "order", "steps"),
    [
        ("erk4", 4, (2e-2, 1e-2, 5e-3)),
        ("dopr54", 5, (1e-2, 5e-3, 2.5e-3)),
        ("dop853", 8, (5e-2, 2.5e-2, 1.25e-2)),
    ],
)
def test_the_order_is_kept_by_a_driven_closed_loop(
    tableau: str, order: int, steps: tuple[float, ...]
) -> None:
    mechanism = CASES["five-bar, one crank"]()
    assert observed_order(mechanism, srm.PSRM(tableau), steps) > order - 0.4


def test_sweeps_converge_on_driven_mechanisms() -> None:
    method = srm.SRM("erk4", iterations=3, restart=True, carry=True)
    mechanism = slider_crank()
    exact = srm.simulate(mechanism, 1.0, rtol=1e-11)
    errors = []
    for h in (1e-2, 5e-3):
        run = srm.simulate(mechanism, 1.0, method=method, step=h)
        errors.append(np.abs(run.v[-1] - exact.v[-1]).max())
    assert errors[0] < 1e-2
    assert errors[0] / errors[1] > 3.0


@on_both
def test_a_driven_crank_leads_through_the_dead_points_of_equal_bars(backend: str) -> None:
    """slider_crank has r = l: at pi/2 + k pi the closure and the drive lose rank together."""
    mechanism = driven(load("slider_crank"), srm.Drive(srm.ConstantSpeed(2.0), "crank"))
    assert mechanism.degrees_of_freedom == 0
    solution = finished(mechanism, 20.0, rtol=1e-8, backend=backend)
    crank, _ = solution.joint("crank")
    rod_angle, _ = solution.joint("rod")
    np.testing.assert_allclose(crank - crank[0], 2.0 * solution.t, atol=1e-11)
    np.testing.assert_allclose(rod_angle, -2.0 * crank, atol=1e-9)  # the branch of the start
    passed = (crank[-1] - crank[0]) / np.pi
    assert abs(len(solution.crossings) - passed) <= 1.0
    assert not any(crossing.switched for crossing in solution.crossings)
    assert solution.drift[:, 0].max() < 1e-12


def test_a_slider_driven_beyond_its_dead_point_ends_with_what_it_reached() -> None:
    mechanism = replace(load("slider_crank_slider"), drives=())
    slider = next(n for n in mechanism.joint_names if "slide" in n)
    mechanism = driven(mechanism, srm.Drive(srm.ConstantSpeed(1.0), slider))
    solution = srm.simulate(mechanism, 10.0, rtol=1e-6)
    assert not solution.success
    assert "singular" in solution.message
    assert f"the drive {slider!r} is at its dead point" in solution.message
    assert solution.t[-1] == pytest.approx(4.0 - 2.0 * np.sqrt(2.0), abs=1e-6)  # bars in line
    assert solution.drift[:, 0].max() < 1e-9


# Several drives, redundancy and contradictions


def test_drives_take_degrees_of_freedom_and_none_may_be_left() -> None:
    free = load("five_bar")
    one = CASES["five-bar, one crank"]()
    both = driven(
        free,
        srm.Drive(srm.ConstantSpeed(0.5), "crank_left"),
        srm.Drive(srm.ConstantSpeed(-0.4), "crank_right"),
    )
    assert [m.degrees_of_freedom for m in (free, one, both)] == [2, 1, 0]
    solution = finished(both, 0.5)
    assert solution.joint("crank_right")[0][-1] == pytest.approx(both.q0[2] - 0.2, abs=1e-12)


def parallel_cranks() -> tuple[srm.Mechanism, list[str]]:
    """The parallelogram, and its two joints on the ground."""
    mechanism = load("parallelogram")
    model = mechanism.model
    return mechanism, [
        name for name in mechanism.joint_names if not model.parents[model.getJointId(name)]
    ]


def test_drives_that_agree_share_the_load() -> None:
    mechanism, (left, right) = parallel_cranks()
    laws = [srm.Sine(0.3, omega=2.0), srm.Sine(0.3, omega=2.0)]
    both = driven(mechanism, *(srm.Drive(law, name) for law, name in zip(laws, (left, right))))
    alone = driven(mechanism, srm.Drive(laws[0], left))
    assert both.degrees_of_freedom == alone.degrees_of_freedom == 0
    assert any("agree" in note for note in both.structure.notes)
    t = np.linspace(0.0, 1.0, 6)
    shared, single = (srm.simulate(m, 1.0, t_eval=t, rtol=1e-9) for m in (both, alone))
    assert shared.success, shared.message
    np.testing.assert_allclose(shared.q, single.q, atol=1e-9)
    total = shared.drive_forces[left] + shared.drive_forces[right]
    np.testing.assert_allclose(total, single.drive_forces[left], atol=1e-6)


def test_drives_that_come_to_contradict_each_other_end_the_run() -> None:
    mechanism, (left, right) = parallel_cranks()
    goals = [
        srm.Drive(srm.MinimumJerk(mechanism.q0[0] + 0.5 * k, 1.0), name)
        for k, name in ((1, left), (2, right))
    ]
    both = driven(mechanism, *goals)
    solution = srm.simulate(both, 1.0)
    assert not solution.success
    assert "follows all drives" in solution.message


def test_an_absolute_table_places_the_start() -> None:
    t = np.linspace(0.0, 1.0, 5)
    table = srm.Table(t, 1.1 + 0.2 * t)
    mechanism = replace(pendulum(), drives=(srm.Drive(table, "a", absolute=True),))
    state = srm.assemble(mechanism)
    assert (state.q[0], state.v[0]) == pytest.approx((1.1, 0.2))


def test_an_absolute_position_of_a_point_places_the_start() -> None:
    drive = srm.Drive(
        srm.Polynomial([0.5, 0.1]),
        a=srm.Anchor("a", xyz=(1.0, 0.0, 0.0)),
        b=srm.Anchor("world"),
        axis=(0.0, 1.0, 0.0),
        absolute=True,
    )
    mechanism = replace(pendulum(), drives=(drive,))
    state = srm.assemble(mechanism)
    assert np.sin(state.q[0]) == pytest.approx(0.5)
    assert np.cos(state.q[0]) * state.v[0] == pytest.approx(0.1)
    assert np.abs(state.residuals).max() < 1e-14


SPEED = srm.ConstantSpeed(1.0)
TABLE = srm.Table([0.0, 0.25, 0.5, 0.75, 1.0], [0.0, 0.1, 0.3, 0.6, 1.0])


def refusals() -> dict[str, Callable[[], Any]]:
    """Drives that cannot be, or contradict each other, and what drives do not allow."""
    crank, (parallelogram, (left, right)) = slider_crank(), parallel_cranks()
    faster = srm.Drive(srm.ConstantSpeed(1.1), right)
    ball = chain(pin.JointModelSpherical())
    placed = replace(pendulum(), drives=(srm.Drive(TABLE, "a", absolute=True),))
    ends = srm.Anchor("a"), srm.Anchor("world")
    return {
        "neither a joint nor a point": lambda: srm.Drive(SPEED),
        "a number as law": lambda: srm.Drive(3.0, "a"),  # type: ignore[arg-type]
        "an axis for a joint": lambda: srm.Drive(SPEED, "a", axis=(0.0, 0.0, 1.0)),
        "a point without axis": lambda: srm.Drive(SPEED, None, *ends),
        "axis and distance": lambda: srm.Drive(SPEED, None, *ends, (0.0, 0.0, 1.0), distance=True),
        "an axis of two numbers": lambda: srm.Drive(SPEED, None, *ends, (0.0, 1.0)),
        "an axis of zeros": lambda: srm.Drive(SPEED, None, *ends, (0.0, 0.0, 0.0)),
        "an absolute speed": lambda: srm.Drive(SPEED, "a", absolute=True),
        "an unknown joint": lambda: replace(pendulum(), drives=(srm.Drive(SPEED, "x"),)),
        "a joint twice": lambda: replace(pendulum(), drives=2 * (srm.Drive(SPEED, "a"),)),
        "a ball": lambda: replace(ball, drives=(srm.Drive(SPEED, "a"),)),
        "drives that contradict each other": lambda: driven(
            parallelogram, srm.Drive(SPEED, left), faster
        ),
        "a held rate": lambda: srm.assemble(crank, crank.q0, {"crank": 1.0}),
        "a held position": lambda: srm.assemble(placed, {"a": 0.4}),
        "a start at rest": lambda: srm.simulate(crank, 1.0, v0=np.zeros(crank.model.nv)),
        "a run longer than a table": lambda: srm.simulate(placed, 1.1),
        "an equilibrium": lambda: srm.equilibrium(crank),
        "a linearisation": lambda: srm.linearise(crank),
    }


CRANK = 'joint = "crank"\n'
IN_FILES = {
    "an unknown law": f'{CRANK}type = "jump"',
    "a key of another law": f'{CRANK}type = "sine"\nspeed = 1.0',
    "no speed": f'{CRANK}type = "constant_speed"',
    "no joint of that name": 'joint = "wheel"\ntype = "constant_speed"\nspeed = 1.0',
    "a text as speed": f'{CRANK}type = "constant_speed"\nspeed = "1"',
    "an unknown key": f'{CRANK}type = "constant_speed"\nspeed = 1.0\nx = 2',
    "no file": f'{CRANK}type = "table"\ntable = "none.csv"',
    "columns without table": f'{CRANK}type = "table"\nt = [0.0]\ntime = "s"\nvalues = [1.0]',
    "a locked joint": f'{CRANK}type = "constant_speed"\nspeed = 3.0',
}


def test_malformed_and_contradictory_drives_are_refused(tmp_path: Path) -> None:
    messages = {case: refused(call) for case, call in refusals().items()}
    for case, keys in IN_FILES.items():
        lock = 'lock = ["crank"]\n' if case == "a locked joint" else ""
        path = written(tmp_path, f"[[drive]]\n{keys}\n", lock)
        messages[f"in a file: {case}"] = refused(partial(srm.load, path), tmp_path)
    check_messages("drives", messages)


def test_a_run_may_end_with_a_table() -> None:
    assert srm.simulate(driven(pendulum(), srm.Drive(TABLE, "a")), 1.0).success


def test_knots_of_the_laws_are_breakpoints_of_the_mechanism() -> None:
    mechanism = driven(pendulum(), srm.Drive(srm.MinimumJerk(1.0, 0.5, start=0.2), "a"))
    assert mechanism.breakpoints(0.0, 1.0) == (0.2, 0.7)
    assert mechanism.breakpoints(0.2, 0.7) == ()


# Descriptions, saved runs, stages


TEXT = """
format = 1
name = "driven"
urdf = "{urdf}"
[[loop]]
name = "pin"
type = "point_on_plane"
a = {{ link = "rod", xyz = [2.0, 0.0, 0.0] }}
b = {{ link = "world" }}
axis = [0.0, 0.0, 1.0]
[initial]
q = {{ crank = 0.5 }}
guess = {{ rod = -1.0 }}
"""


def written(folder: Path, drive: str, more: str = "") -> Path:
    urdf = load("slider_crank").source.urdf_path  # type: ignore[union-attr]
    path = folder / "driven.toml"
    path.write_text(
        TEXT.format(urdf=Path(urdf).resolve()).replace("[[loop]]", more + "[[loop]]") + drive
    )
    return path


def test_a_description_has_drives(tmp_path: Path) -> None:
    mechanism = srm.load(
        written(tmp_path, '[[drive]]\njoint = "crank"\ntype = "constant_speed"\nspeed = 3.0\n')
    )
    assert mechanism.drives == (srm.Drive(srm.ConstantSpeed(3.0), "crank"),)
    assert mechanism.degrees_of_freedom == 0
    np.testing.assert_allclose(mechanism.q0, [0.5, -1.0], atol=1e-12)
    np.testing.assert_allclose(mechanism.v0, [3.0, -6.0], atol=1e-12)


def test_a_description_reads_tables_beside_it_and_saved_runs_keep_them(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 6)
    table = tmp_path / "motion.csv"
    np.savetxt(table, np.column_stack([t, t**2]), delimiter=",", header="s,turn", comments="")
    drive = '[[drive]]\njoint = "crank"\ntype = "table"\ntable = "motion.csv"\ntime = "s"\n'
    mechanism = srm.load(written(tmp_path, drive + 'value = "turn"\n'))
    solution = srm.simulate(mechanism, 0.8)
    assert solution.q[-1, 0] == pytest.approx(0.5 + 0.64, abs=1e-12)
    solution.save(tmp_path / "run.npz")
    table.unlink()
    loaded = srm.load_solution(tmp_path / "run.npz")
    assert loaded.mechanism.drives == mechanism.drives
    np.testing.assert_array_equal(loaded.drive_forces["crank"], solution.drive_forces["crank"])
    np.testing.assert_array_equal(loaded(0.37)[0], solution(0.37)[0])


@every_case
def test_stages_satisfy_the_equations_of_motion_with_drives(
    make: Callable[[], srm.Mechanism],
) -> None:
    """G v' + Gdot v = s'' with G v' + Gdot v by differences along the motion, off the manifold."""
    mechanism = make()
    system = make_system(mechanism)
    rng = np.random.default_rng(0)
    nv = mechanism.model.nv
    state = np.concatenate([mechanism.q0, mechanism.v0])
    state = system.retract(state, 0.05 * rng.standard_normal(2 * nv))
    t, h = 0.3, 1e-4
    v, a = np.split(system.evaluate(t, state).rate(), 2)

    def rates(k: int) -> np.ndarray:
        moved = system.retract(
            state, np.concatenate([k * h * v + 0.5 * (k * h) ** 2 * a, k * h * a])
        )
        return system.residuals(moved, t + k * h)[1]

    change = (rates(-2) - 8 * rates(-1) + 8 * rates(1) - rates(2)) / (12 * h)
    assert np.abs(change).max() < 1e-7 * max(1.0, np.abs(a).max())
    # The correction takes out g - s and G v - s'.
    corrected = state
    for _ in range(6):
        corrected = system.retract(corrected, -system.evaluate(t, corrected).correction())
    assert max(np.abs(part).max() for part in system.residuals(corrected, t)) < 1e-12


# Analyses


def test_inverse_dynamics_of_a_driven_run_finds_the_forces_of_the_drives() -> None:
    mechanism = slider_crank()
    t = np.linspace(0.0, 1.0, 5)
    solution = srm.simulate(mechanism, 1.0, rtol=1e-10, t_eval=t)
    found = srm.inverse_dynamics(mechanism, solution, actuated="crank")
    np.testing.assert_allclose(found.torques[:, 0], solution.drive_forces["crank"], atol=1e-7)


@on_both
def test_a_driven_distance_needs_the_force_along_the_line(backend: str) -> None:
    """A hydraulic cylinder from the ground to a pendulum: its force from virtual work."""
    drive = srm.Drive(
        srm.Sine(0.2, omega=3.0),
        a=srm.Anchor("a", xyz=(0.8, 0.0, 0.0)),
        b=srm.Anchor("world", xyz=(0.5, -1.0, 0.0)),
        distance=True,
        name="cylinder",
    )
    mechanism = driven(pendulum(), drive)
    t = np.linspace(0.0, 2.0, 21)
    solution = finished(mechanism, 2.0, rtol=1e-10, t_eval=t, backend=backend)
    x, rate = solution.joint("a")
    arm = np.column_stack([0.8 * np.cos(x) - 0.5, 0.8 * np.sin(x) + 1.0])
    length = np.linalg.norm(arm, axis=1)
    np.testing.assert_allclose(length, length[0] + 0.2 * np.sin(3.0 * t), atol=1e-11)
    slope = np.sum(arm * 0.8 * np.column_stack([-np.sin(x), np.cos(x)]), axis=1) / length
    model, data = mechanism.model, mechanism.model.createData()
    torque = [
        pin.rnea(model, data, *(np.array([value]) for value in values))[0]
        for values in zip(x, rate, solution.accelerations[:, 0])
    ]
    np.testing.assert_allclose(solution.drive_forces["cylinder"], torque / slope, atol=1e-7)


def test_an_absolute_distance_places_the_start() -> None:
    drive = srm.Drive(
        srm.Polynomial([1.2, 0.1]),
        a=srm.Anchor("a", xyz=(1.0, 0.0, 0.0)),
        b=srm.Anchor("world", xyz=(0.0, 1.0, 0.0)),
        distance=True,
        absolute=True,
    )
    state = srm.assemble(replace(pendulum(), drives=(drive,)))
    assert np.hypot(np.cos(state.q[0]), np.sin(state.q[0]) - 1.0) == pytest.approx(1.2)


# Stepped from outside


@on_both
def test_a_simulator_follows_the_drives_also_after_a_reset(backend: str) -> None:
    mechanism = driven(
        load("five_bar"), srm.Drive(srm.MinimumJerk(2.3, 0.6, start=0.1), "crank_left")
    )
    whole = srm.simulate(mechanism, 1.0, rtol=1e-9)
    simulator = srm.Simulator(mechanism, rtol=1e-9, backend=backend)
    for _ in range(20):
        q, v = simulator.step(0.05)
    np.testing.assert_allclose(q, whole.q[-1], atol=1e-7)
    q, v = whole(0.4)
    simulator.reset(q, v, t=0.4)
    np.testing.assert_allclose(simulator.step(0.6)[0], whole.q[-1], atol=1e-7)
    with pytest.raises(srm.InputError, match="violates the drives: row crank_left"):
        simulator.reset(q, v, t=0.5)


def test_info_and_tables_show_what_is_driven(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from srm_mbs.cli.app import app

    path = written(
        tmp_path,
        '[[drive]]\njoint = "crank"\ntype = "sine"\namplitude = 0.25\nfrequency_hz = 2.0\n',
    )
    shown = CliRunner().invoke(app, ["info", str(path)])
    assert shown.exit_code == 0, shown.output
    assert "0, 1 without the drives" in shown.output
    assert "amplitude 0.25, frequency_hz 2" in shown.output
    solution = srm.simulate(srm.load(path), 0.2)
    solution.to_csv(tmp_path / "run.csv")
    assert "||g|| (m; rad)" in (tmp_path / "run.csv").read_text().splitlines()[0]


def test_a_delta_robot_moves_from_rest_to_rest_with_the_torques_of_inverse_dynamics() -> None:
    robot = load("delta_robot")
    arms = ["arm_1", "arm_2", "arm_3"]
    starts = [robot.q0[robot.joint(name).idx_q] for name in arms]
    drives = [
        srm.Drive(srm.MinimumJerk(start + 0.06 * (k + 1), 0.5, start=0.1), name)
        for k, (start, name) in enumerate(zip(starts, arms))
    ]
    mechanism = driven(robot, *drives, v=0.0 * robot.v0)
    assert mechanism.degrees_of_freedom == 0
    solution = finished(mechanism, 0.7, rtol=1e-9)
    for k, (start, name) in enumerate(zip(starts, arms)):
        assert solution.joint(name)[0][-1] == pytest.approx(start + 0.06 * (k + 1), abs=1e-12)
    found = srm.inverse_dynamics(mechanism, solution, actuated=arms)
    forces = np.column_stack([solution.drive_forces[name] for name in arms])
    np.testing.assert_allclose(found.torques, forces, atol=1e-10)
    assert solution.energy_balance.relative < 1e-10
