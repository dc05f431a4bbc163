"""Saved runs load as they were."""

from __future__ import annotations

import contextlib
import copy
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.mechanisms import floating_ring


@pytest.mark.parametrize("name", ["slider_crank", "pendulum_chain", "n_four_bar_3"])
def test_a_saved_run_interpolates_to_the_last_bit(name: str, tmp_path: Path) -> None:
    solution = srm.simulate(srm.load(name), 3.0, rtol=1e-10)
    solution.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
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
    solution.save(tmp_path / "run")
    loaded = srm.load_solution(tmp_path / "run")
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
    solution.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
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
    solution.save(tmp_path / "ring.npz")
    loaded = srm.load_solution(tmp_path / "ring.npz")
    assert loaded.mechanism.model == ring.model
    assert loaded.mechanism.loops == ring.loops
    assert np.array_equal(loaded.t, [0.0, 0.5, 1.0])
    assert np.array_equal(loaded.q, solution.q)
    assert np.array_equal(loaded(0.3)[0], solution(0.3)[0])


def test_overridden_gravity_and_base_are_saved(tmp_path: Path) -> None:
    mechanism = srm.load("pendulum_chain", gravity=(0.0, 0.0, -1.62))
    solution = srm.simulate(mechanism, 1.0)
    solution.save(tmp_path / "moon.npz")
    loaded = srm.load_solution(tmp_path / "moon.npz")
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
        solution.save(tmp_path / "run.npz")
        loaded = srm.load_solution(tmp_path / "run.npz")
        assert loaded.mechanism.joint_names == mechanism.joint_names
        assert np.array_equal(loaded(0.3)[0], solution(0.3)[0])
        assert np.array_equal(loaded.energy, solution.energy)


def test_a_failed_run_can_be_saved(tmp_path: Path) -> None:
    solution = srm.simulate(srm.load("four_bar"), 1.0, controller=lambda t, q, v: [np.nan])
    assert not solution.success
    solution.save(tmp_path / "failed.npz")
    loaded = srm.load_solution(tmp_path / "failed.npz")
    assert loaded.status == "failed"
    assert len(loaded.t) == 1
    assert np.array_equal(loaded(0.0)[0], solution.q[0])


def test_reactions_of_a_controlled_run_are_refused_after_loading(tmp_path: Path) -> None:
    solution = srm.simulate(srm.load("four_bar"), 0.1, controller=lambda t, q, v: np.ones(3))
    assert solution.reactions["pin"].shape == (len(solution.t), 6)
    solution.save(tmp_path / "run.npz")
    with pytest.raises(srm.InputError, match="controllers are not saved"):
        _ = srm.load_solution(tmp_path / "run.npz").reactions


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
    for file in folder.iterdir():
        file.unlink()
    assert np.array_equal(srm.load_solution(tmp_path / "run.npz")(0.2)[0], solution(0.2)[0])


@pytest.mark.parametrize(
    "content", [b"", b"text", b"PK\x03\x04 broken"], ids=["empty", "text", "broken zip"]
)
def test_a_file_that_is_no_run_is_refused_by_name(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "strange.npz"
    path.write_bytes(content)
    with pytest.raises(srm.InputError, match=r"strange\.npz: it is not a saved run") as refused:
        srm.load_solution(path)
    assert "pickle" not in str(refused.value)


def test_another_npz_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(srm.InputError, match=r"other\.npz: it is not a saved run"):
        srm.load_solution(tmp_path / "other.npz")
    with pytest.raises(srm.InputError, match="no such file"):
        srm.load_solution(tmp_path / "missing.npz")
    with pytest.raises(srm.InputError, match="it cannot be read: Is a directory"):
        srm.load_solution(tmp_path)


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


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("rates", lambda array: array[:-1], "rates has shape"),
        ("event_0_states", lambda array: array[:, 1:], "event_0_states has shape"),
        ("attempts", lambda array: np.zeros((2, 2)), "attempts has the fields"),
        ("times", lambda array: array + 1.0, "cannot have stopped at"),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(
    name: str, change: Callable[[np.ndarray], np.ndarray], words: str, tmp_path: Path
) -> None:
    def stop(t: float, q: np.ndarray, v: np.ndarray) -> float:
        return t - 0.1

    stop.terminal = True  # type: ignore[attr-defined]
    srm.simulate(srm.load("four_bar"), 0.2, events=stop).save(tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz") as file:
        arrays = dict(file)
    arrays[name] = change(arrays[name])
    np.savez(tmp_path / "cut.npz", **arrays)
    with pytest.raises(srm.InputError, match=rf"cut\.npz: it is not a saved run: .*{words}"):
        srm.load_solution(tmp_path / "cut.npz")


def test_a_run_of_another_format_is_refused_as_such(tmp_path: Path) -> None:
    srm.simulate(srm.load("four_bar"), 0.1).save(tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz") as file:
        arrays = dict(file)
    arrays["meta"] = np.array(str(arrays["meta"]).replace('{"format": 4,', '{"format": 1,'))
    np.savez(tmp_path / "old.npz", **arrays)
    with pytest.raises(srm.InputError, match=r"old\.npz: it has format 1, this version reads 4"):
        srm.load_solution(tmp_path / "old.npz")


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
    solution.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
    t = np.linspace(0.0, 2.0, 201)
    assert np.abs(loaded(t)[0] - solution(t)[0]).max() < 1e-13
    loaded.save(tmp_path / "again.npz")
    again = srm.load_solution(tmp_path / "again.npz")
    assert np.array_equal(again(t)[0], loaded(t)[0])


def test_drives_of_a_run_that_starts_later_go_on_when_it_is_loaded(tmp_path: Path) -> None:
    drive = srm.Drive(srm.Sine(amplitude=0.4, omega=9.0, phase=0.3), joint="crank")
    mechanism = replace(srm.load("slider_crank_regular"), drives=[drive])
    start = srm.assemble(mechanism)
    first = srm.simulate(mechanism, 0.5, q0=start.q, v0=start.v)
    later = srm.simulate(first.mechanism, 1.0, t0=0.5, q0=first.q[-1], v0=first.v[-1])
    later.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
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
