"""Saved runs load as they were."""

from __future__ import annotations

import contextlib
import copy
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.mechanisms import floating_ring
from tests.support.snapshots import check_messages, refused


def reloaded(solution: srm.Solution, folder: Path) -> srm.Solution:
    """The run, saved and loaded."""
    solution.save(folder / "saved.npz")
    return srm.load_solution(folder / "saved.npz")


def stop(t: float, q: np.ndarray, v: np.ndarray) -> float:
    return t - 0.1


stop.terminal = True  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["slider_crank", "pendulum_chain", "n_four_bar_3"])
def test_a_saved_run_interpolates_to_the_last_bit(name: str, tmp_path: Path) -> None:
    solution = srm.simulate(srm.load(name), 3.0, rtol=1e-10)
    loaded = reloaded(solution, tmp_path)
    t = np.linspace(0.0, 3.0, 301)
    for a, b in zip(solution(t), loaded(t)):
        assert np.array_equal(a, b)
    assert np.array_equal(solution.q, loaded.q)
    assert loaded.stats == solution.stats
    assert loaded.settings == solution.settings
    assert loaded.message == solution.message
    assert np.array_equal(loaded.drift, solution.drift)
    assert np.array_equal(loaded.energy, solution.energy)
    assert loaded.crossings == solution.crossings
    assert np.array_equal(loaded.attempts, solution.attempts)
    assert loaded.t_events is None
    assert loaded.mechanism.source == solution.mechanism.source


def test_a_run_through_the_zone_interpolates_to_the_last_bit(tmp_path: Path) -> None:
    solution = srm.simulate(srm.load("slider_crank"), 1.2, rtol=1e-12, max_step=5e-4)
    assert solution.stats.zone_steps > 0
    loaded = reloaded(solution, tmp_path)
    t = np.linspace(0.0, 1.2, 1001)
    assert np.array_equal(solution(t)[0], loaded(t)[0])


def test_events_and_where_they_ended_the_run_are_saved(tmp_path: Path) -> None:
    def upwards(t: float, q: np.ndarray, v: np.ndarray) -> float:
        return float(np.cos(q[0]))

    def never(t: float, q: np.ndarray, v: np.ndarray) -> float:
        return 1.0

    upwards.terminal = 2  # type: ignore[attr-defined]
    solution = srm.simulate(
        srm.load("slider_crank"), 5.0, events=[upwards, never], singular_times=[1.0, 2.0]
    )
    assert solution.status == "event"
    loaded = reloaded(solution, tmp_path)
    assert loaded.success
    assert loaded.settings == solution.settings
    assert np.array_equal(loaded.t, solution.t)
    assert np.array_equal(loaded.q, solution.q)
    for name in ("t_events", "q_events", "v_events"):
        for ours, theirs in zip(getattr(loaded, name), getattr(solution, name)):
            assert np.array_equal(ours, theirs)
            assert ours.shape == theirs.shape
    with pytest.raises(ValueError, match="the run covers"):
        loaded(solution.t[-1] + 1e-3)


def test_a_mechanism_built_in_python_is_saved_with_its_model(tmp_path: Path) -> None:
    ring = floating_ring()
    solution = srm.simulate(ring, 1.0, t_eval=[0.0, 0.5, 1.0])
    loaded = reloaded(solution, tmp_path)
    assert loaded.mechanism.model == ring.model
    assert loaded.mechanism.loops == ring.loops
    assert np.array_equal(loaded.t, [0.0, 0.5, 1.0])
    assert np.array_equal(loaded.q, solution.q)
    assert np.array_equal(loaded(0.3)[0], solution(0.3)[0])


def test_overridden_gravity_and_base_are_saved(tmp_path: Path) -> None:
    mechanism = srm.load("pendulum_chain", gravity=(0.0, 0.0, -1.62))
    solution = srm.simulate(mechanism, 1.0)
    loaded = reloaded(solution, tmp_path)
    assert np.array_equal(loaded.mechanism.model.gravity.linear, [0.0, 0.0, -1.62])
    assert np.array_equal(loaded.energy, solution.energy)


def test_locked_joints_and_moving_bases_are_saved(tmp_path: Path) -> None:
    source = srm.load("five_bar").source
    assert source is not None
    (tmp_path / "five_bar.urdf").write_text(source.urdf)
    text = source.description.replace("../urdf/", "").replace(
        "base =", 'lock = ["crank_right"]\nbase ='
    )
    assert "lock" in text
    (tmp_path / "locked.toml").write_text(text)
    chain = srm.load("pendulum_chain").source
    assert chain is not None
    trunk = (
        '<link name="trunk"><inertial><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="0.1" '
        'ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    urdf = chain.urdf.replace('<link name="world">', trunk).replace('"world"', '"trunk"')
    (tmp_path / "chain.urdf").write_text(urdf)
    (tmp_path / "free.toml").write_text(
        'format = 1\nurdf = "chain.urdf"\nbase = "floating"\n[initial]\nv = { link_0 = 1.0 }\n'
    )
    for name, nv in (("locked", 3), ("free", 9)):
        mechanism = srm.load(tmp_path / f"{name}.toml")
        assert mechanism.model.nv == nv
        solution = srm.simulate(mechanism, 0.5)
        loaded = reloaded(solution, tmp_path)
        assert loaded.mechanism.joint_names == mechanism.joint_names
        assert np.array_equal(loaded(0.3)[0], solution(0.3)[0])
        assert np.array_equal(loaded.energy, solution.energy)


def test_a_failed_run_can_be_saved(tmp_path: Path) -> None:
    solution = srm.simulate(srm.load("four_bar"), 1.0, controller=lambda t, q, v: [np.nan])
    assert not solution.success
    loaded = reloaded(solution, tmp_path)
    assert loaded.status == "failed"
    assert len(loaded.t) == 1
    assert np.array_equal(loaded(0.0)[0], solution.q[0])


def test_reactions_of_a_controlled_run_are_refused_after_loading(tmp_path: Path) -> None:
    solution = srm.simulate(srm.load("four_bar"), 0.1, controller=lambda t, q, v: np.ones(3))
    assert solution.reactions["pin"].shape == (len(solution.t), 6)
    with pytest.raises(srm.InputError, match="controllers are not saved"):
        _ = reloaded(solution, tmp_path).reactions


def test_the_file_needs_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = srm.load("four_bar").source
    assert source is not None
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "bar.urdf").write_text(source.urdf)
    (folder / "bar.toml").write_text(
        source.description.replace("../urdf/four_bar.urdf", "bar.urdf")
    )
    solution = srm.simulate(srm.load(folder / "bar.toml"), 0.5)
    solution.save(tmp_path / "run.npz")
    shutil.rmtree(folder)
    assert np.array_equal(srm.load_solution(tmp_path / "run.npz")(0.2)[0], solution(0.2)[0])


def test_files_that_are_no_runs_are_refused_by_name(tmp_path: Path) -> None:
    contents = {"empty": b"", "text": b"text", "broken archive": b"PK\x03\x04 broken"}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    np.savez(tmp_path / "other arrays.npz", x=np.zeros(3))
    (tmp_path / "folder").mkdir()
    solution = srm.simulate(srm.load("four_bar"), 0.2, events=stop, step=0.04)
    for name, change in {
        "rates": lambda array: array[:-1],
        "event_0_states": lambda array: array[:, 1:],
        "attempts": lambda array: np.zeros((2, 2)),
        "times": lambda array: array + 1.0,
        "meta": lambda meta: np.array(str(meta).replace('{"format": 4,', '{"format": 1,')),
    }.items():
        solution.save(tmp_path / "run.npz")
        with np.load(tmp_path / "run.npz") as file:
            arrays = dict(file)
        np.savez(tmp_path / f"other {name}.npz", **arrays | {name: change(arrays[name])})
    (tmp_path / "run.npz").unlink()
    places = sorted(path.name for path in tmp_path.iterdir())
    check_messages(
        "storage",
        {
            name: refused(lambda: srm.load_solution(tmp_path / name), tmp_path)  # noqa: B023
            for name in (*places, "missing")
        },
    )


def test_runs_whose_parts_cannot_be_saved_leave_no_file(tmp_path: Path) -> None:
    tableau = replace(srm.TABLEAUS["erk4"], name="own")
    own = srm.simulate(srm.load("four_bar"), 0.1, method=srm.PSRM(tableau), step=0.01)
    with pytest.raises(srm.InputError, match=r"run\.npz: the tableau 'own' is not one of"):
        own.save(tmp_path / "run.npz")
    assert not list(tmp_path.iterdir())


def test_a_damaged_file_is_refused_whatever_is_wrong_with_it(tmp_path: Path) -> None:
    srm.simulate(srm.load("four_bar"), 0.2).save(tmp_path / "run.npz")
    good = (tmp_path / "run.npz").read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(150):
        data = bytearray(good)
        for at in rng.integers(0, len(data), 4):
            data[at] = rng.integers(0, 256)
        (tmp_path / "damaged.npz").write_bytes(bytes(data))
        with contextlib.suppress(srm.InputError):
            srm.load_solution(tmp_path / "damaged.npz")
            continue  # the damage fell where nothing is
        refused += 1
    assert refused > 100


@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
def test_a_controlled_run_is_read_between_its_steps_without_its_controller(
    tmp_path: Path, tableau: str
) -> None:
    solution = srm.simulate(
        srm.load("slider_crank"),
        2.0,
        controller=lambda t, q, v: [5.0 * np.sin(9.0 * t) - 3.0 * v[0], 0.0],
        tableau=tableau,
    )
    loaded = reloaded(solution, tmp_path)
    t = np.linspace(0.0, 2.0, 201)
    assert np.abs(loaded(t)[0] - solution(t)[0]).max() < 1e-13
    again = reloaded(loaded, tmp_path)
    assert np.array_equal(again(t)[0], loaded(t)[0])


def test_drives_of_a_run_that_starts_later_go_on_when_it_is_loaded(tmp_path: Path) -> None:
    drive = srm.Drive(srm.Sine(amplitude=0.4, omega=9.0, phase=0.3), joint="crank")
    mechanism = replace(srm.load("slider_crank_regular"), drives=[drive])
    start = srm.assemble(mechanism)
    first = srm.simulate(mechanism, 0.5, q0=start.q, v0=start.v)
    later = srm.simulate(first.mechanism, 1.0, t0=0.5, q0=first.q[-1], v0=first.v[-1])
    loaded = reloaded(later, tmp_path)
    assert loaded.drift[:, 0].max() < 1e-12
    np.testing.assert_allclose(loaded.drift, later.drift, rtol=1e-6, atol=1e-14)
    again = srm.certify(loaded)
    assert again.grade == "good"
    assert again.error == srm.certify(later).error


@pytest.mark.parametrize("backend", ["python", "auto"])
@pytest.mark.parametrize("name", ["slider_crank", "pendulum_chain"])
@pytest.mark.parametrize("copied", [lambda run: pickle.loads(pickle.dumps(run)), copy.deepcopy])
def test_copies_of_a_run_say_the_same_wherever_they_are_read(
    name: str, backend: str, copied: Any
) -> None:
    run = srm.simulate(srm.load(name), 2.0, backend=backend)
    t = np.linspace(0.0, 2.0, 31)
    before = copied(run)
    exact = run(t)
    after = copied(run)
    for other in (before, after):
        assert np.array_equal(other(t), exact)
        for loop, forces in run.reactions.items():
            assert np.array_equal(other.reactions[loop], forces)


def late(t: float, q: Any, v: Any) -> float:
    return t - 0.3


def nothing(t: float, q: Any, v: Any) -> None:
    return None


def test_a_pickled_segment_keeps_the_motion_of_its_drives() -> None:
    driven = srm.load("slider_crank_regular")
    driven = replace(driven, drives=[srm.Drive(srm.ConstantSpeed(speed=6.0), joint="crank")])
    start = srm.assemble(driven)
    event = srm.Event(late, action=nothing)
    run = srm.simulate(driven, 0.6, q0=start.q, v0=start.v, events=event)
    other = pickle.loads(pickle.dumps(run))
    assert other.drift.max() < 1e-9
    assert np.array_equal(other.drive_forces["crank"], run.drive_forces["crank"])
