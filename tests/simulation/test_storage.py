"""Saved runs load as they were."""

from __future__ import annotations

import contextlib
import copy
import errno
import json
import os
import pickle
import re
import shutil
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import ClosedSystem
from srm_mbs.errors import EvaluationError
from srm_mbs.formats import archive
from srm_mbs.simulation import storage
from srm_mbs.visualization.animation.shapes import Mesh, visuals_of
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
    assert loaded.mechanism.source == replace(
        solution.mechanism.source,
        path=Path(solution.mechanism.source.path).name,
        urdf_path=str(tmp_path / Path(solution.mechanism.source.urdf_path).name),
    )


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
    def only_at_the_start(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.full(3, 0.0 if t == 0.0 else np.nan)

    solution = srm.simulate(srm.load("four_bar"), 1.0, controller=only_at_the_start)
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


@pytest.mark.parametrize("sample_time", [None, 0.02])
def test_what_needs_a_force_of_the_user_is_refused_after_loading(
    sample_time: float | None, tmp_path: Path
) -> None:
    """Also where the output of the sampled controller, which acted as well, is saved."""
    push = srm.UserForce(lambda t, q, v: np.array([0.0, 0.0, 3.0]), name="push")
    mechanism = replace(srm.load("four_bar"), forces=[push])
    options = {} if sample_time is None else {"controller": lambda t, q, v: -v}
    solution = srm.simulate(mechanism, 0.1, sample_time=sample_time, **options)
    loaded = reloaded(solution, tmp_path)
    assert "these forces do not act: 'push'" in loaded.mechanism.notes[-1]
    np.testing.assert_array_equal(loaded.q, solution.q)
    np.testing.assert_allclose(loaded(0.05)[0], solution(0.05)[0], atol=1e-14)
    for read in (
        lambda run: run.reactions,
        lambda run: run.joint_reactions,
        lambda run: run.energy_balance,
        lambda run: run.accelerations,
    ):
        read(solution)
        with pytest.raises(srm.InputError, match="with a UserForce cannot be computed"):
            read(loaded)


def test_a_run_with_a_sampled_controller_alone_has_its_reactions_after_loading(
    tmp_path: Path,
) -> None:
    solution = srm.simulate(
        srm.load("four_bar"), 0.1, controller=lambda t, q, v: -v, sample_time=0.02
    )
    loaded = reloaded(solution, tmp_path)
    np.testing.assert_array_equal(loaded.reactions["pin"], solution.reactions["pin"])


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
        "meta": lambda meta: np.array(str(meta).replace('{"format": 5,', '{"format": 1,')),
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


@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
@pytest.mark.parametrize("sampled", [False, True])
def test_a_run_with_a_user_force_is_read_between_its_steps_without_it(
    tmp_path: Path, tableau: str, sampled: bool
) -> None:
    def push(t: float, q: np.ndarray, v: np.ndarray) -> list[float]:
        return [5.0 * np.sin(9.0 * t) - 3.0 * v[0], 0.0]

    mechanism = replace(srm.load("slider_crank"), forces=[srm.UserForce(push)])
    options: dict[str, Any] = {"controller": lambda t, q, v: -v, "sample_time": 0.05}
    solution = srm.simulate(mechanism, 2.0, tableau=tableau, **(options if sampled else {}))
    assert solution.crossings
    t = np.linspace(0.0, 2.0, 201)
    before = solution(t)
    assert np.abs(before[1]).max() > 1.0

    loaded = reloaded(solution, tmp_path)

    for a, b in zip(loaded(t), before):
        assert np.abs(a - b).max() < 1e-12
    assert [c.time for c in loaded.crossings] == pytest.approx([c.time for c in solution.crossings])
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
    exact, drift, energy, passages = run(t), run.drift, run.energy, run.crossings
    after = copied(run)
    for other in (before, after, copied(run.at(run.t))):
        assert np.array_equal(other(t), exact)
        assert np.array_equal(other.drift, drift)
        assert np.array_equal(other.energy, energy)
        assert [one.time for one in other.crossings] == [one.time for one in passages]
        for loop, forces in run.reactions.items():
            assert np.array_equal(other.reactions[loop], forces)


@pytest.mark.parametrize("copied", [lambda run: pickle.loads(pickle.dumps(run)), copy.deepcopy])
@pytest.mark.parametrize("tableau", ["auto", "rodas5p"])
def test_a_run_that_another_process_made_is_saved_like_any_other(
    tableau: str, copied: Any, tmp_path: Path
) -> None:
    run = srm.simulate(srm.load("four_bar"), 0.5, tableau=tableau)
    again = reloaded(copied(run), tmp_path)
    t = np.linspace(0.0, 0.5, 11)
    assert np.array_equal(again(t), run(t))


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


DATA = Path(__file__).parents[1] / "data"


@pytest.mark.parametrize("name", ["four_bar", "ring"])
def test_runs_of_format_4_still_load(name: str, tmp_path: Path) -> None:
    old = srm.load_solution(DATA / f"{name}_format_4.npz")
    assert old.status == "finished"
    assert np.ptp(old.energy) < 1e-4 * np.abs(old.energy).max()
    assert old.drift.max() < 1e-9
    t = np.linspace(*old.span, 7)

    new = reloaded(old, tmp_path)

    for ours, theirs in zip(new(t), old(t)):
        assert np.array_equal(ours, theirs)
    assert new.mechanism.model == old.mechanism.model


def changed_run(folder: Path, **changes: Any) -> Path:
    """A saved run with other arrays; a change is a function of an array, or of the JSON text."""
    srm.simulate(srm.load("four_bar"), 0.2, events=stop).save(folder / "run.npz")
    with np.load(folder / "run.npz") as file:
        arrays = dict(file)
    for name, change in changes.items():
        if name == "meta":
            meta = json.loads(str(arrays["meta"]))
            change(meta)
            arrays["meta"] = np.array(json.dumps(meta))
        else:
            arrays[name] = change(arrays[name])
    np.savez(folder / "changed.npz", **arrays)
    return folder / "changed.npz"


def setting(path: str, value: Any) -> Any:
    """A change of one entry of the JSON text."""

    def change(meta: Any) -> None:
        *keys, last = path.split(".")
        for key in keys:
            meta = meta[int(key) if key.isdigit() else key]
        meta[last] = value

    return change


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        ("structure.rank", 10**6, "the ranks 2 of the loops and 1000000 of all rows"),
        ("structure.rank", -1, "structure.rank: Input should be greater than or equal to 0"),
        ("structure.rank", 1.5, "structure.rank"),
        ("structure.loop_rank", 3, "the ranks 3"),
        ("structure.sigma_ref", 0.0, "structure.sigma_ref"),
        ("structure.sigma_ref", float("nan"), "structure.sigma_ref"),
        ("structure.length", -1.0, "structure.length"),
        ("settings.atol", [1e-6], None),
        ("settings.atol", [1e-6, 1e-6], "settings.atol has 2 numbers"),
        ("settings.atol", ["1e-6"], "settings.atol: .*does not consist of numbers"),
        ("settings.tableau", "none", "there is no tableau"),
        ("settings.backend", "other", "settings.backend"),
        ("stats.steps", -1, "stats.steps"),
        ("status", "perhaps", "status"),
        ("stop", 1e9, "cannot have stopped"),
        ("zones", [[0, 0.1]], "it has no zone_0_times"),
        ("zones", [[-1, 0.1]], "zones: .*are negative"),
        ("events", 2, "it has no event_1_times"),
        ("events", 10**18, "it has no event_1_times"),
        ("mechanism.loops.0.a.xyz", [1.0, float("inf"), 0.0], "not finite"),
        ("mechanism.loops.0.a", {"link": 5}, "Anchor.link"),
        ("mechanism.loops.0.name", 7, "LoopClosure.name"),
        ("mechanism.loops.0.other", 7, "no field 'other'"),
        ("mechanism.forces", [{"type": "user", "name": "f"}], "no element of the type 'user'"),
        ("mechanism.forces", [{"link": "crank"}], "is no force"),
        ("mechanism.friction_speed", 0.0, "friction_speed"),
        ("mechanism.source", None, "neither the source of its mechanism nor its model"),
        ("request.options.method", {"kind": "PSRM", "tableau": "none"}, "there is no tableau"),
        ("request.options.backend", [], "request.options.backend"),
        ("format", "5", "it has format 5"),
        ("unknown", 1, "unknown: Extra inputs"),
    ],
)
def test_entries_of_another_kind_or_size_are_refused(
    tmp_path: Path, path: str, value: Any, says: str | None
) -> None:
    file = changed_run(tmp_path, meta=setting(path, value))
    if says is None:
        assert len(srm.load_solution(file).t) > 1
        return
    with pytest.raises(srm.InputError, match=says) as caught:
        srm.load_solution(file)
    assert caught.value.file == str(file)
    assert "pydantic" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("row_scale", lambda a: a[:, None], "row_scale has shape"),
        ("row_scale", lambda a: 0.0 * a, "row_scale has values that are not positive"),
        ("row_scale", lambda a: a.astype("f4"), "items of the type float32"),
        ("kept", lambda a: a.astype(float), "items of the type float64"),
        ("kept", lambda a: ~a, "the ranks"),
        ("coordinate_unit", lambda a: -a, "not positive"),
        ("eliminations", lambda a: np.array([[0.0, 99.0, 1.0]]), "outside 0 to"),
        ("eliminations", lambda a: np.array([[0.0, 0.5, 1.0]]), "no whole numbers"),
        ("eliminations", lambda a: np.array([[1.0, 1.0, 1.0]]), "from itself"),
        ("times", lambda a: a[::-1], "times does not increase"),
        ("times", lambda a: a[:0], "times is empty"),
        ("times", lambda a: a * np.nan, "not finite"),
        ("states", lambda a: a + 1e200, "too large"),
        ("rates", lambda a: a[:, :3], "rates has shape"),
        ("rates", lambda a: a * (1.0 + 1e-6), "the rates of step 0 do not lead"),
        ("rates", lambda a: a + 1e99, "do not lead"),
        ("corrections", lambda a: a + 1e-6, "the rates of step 0 do not lead"),
        ("states", lambda a: a + 1e-6 * np.arange(len(a))[:, None], "do not lead"),
        ("times", lambda a: 1.001 * a, "do not lead"),
        ("breaks", lambda a: np.array([-1]), "outside 1 to"),
        ("breaks", lambda a: np.array([1, 1]), "does not increase"),
        ("placements", lambda a: a + 7.0, "placements has values outside 0 to 3"),
        ("ranks", lambda a: a + 0.5, "no whole numbers"),
        ("sigmas", lambda a: -a, "outside 0 to"),
        ("event_0_times", lambda a: a + 9.0, "event_0_times has values outside"),
        ("attempts", lambda a: np.zeros(1, a.dtype), "no attempt has"),
        ("q0", lambda a: a[:-1], "q0 has shape"),
    ],
)
def test_arrays_of_another_shape_type_or_range_are_refused(
    tmp_path: Path, name: str, change: Any, says: str
) -> None:
    with pytest.raises(srm.InputError, match=says):
        srm.load_solution(changed_run(tmp_path, **{name: change}))


def test_a_ball_joint_that_turns_too_far_in_a_step_is_refused(tmp_path: Path) -> None:
    srm.simulate(floating_ring(), 0.05).save(tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz") as file:
        arrays = dict(file)
    # A rotation has no size: its end does not show how far the rates lead.
    arrays["rates"][0, 0, 5] = 1e20
    np.savez(tmp_path / "run.npz", **arrays)

    with pytest.raises(srm.InputError, match="turns too far within one step"):
        srm.load_solution(tmp_path / "run.npz")


def test_saved_runs_name_no_folders_unless_asked_for(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    (secret / "meshes").mkdir(parents=True)
    source = srm.load("four_bar").source
    assert source is not None
    meshes = "".join(
        f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
        for name in (
            f"{secret}/meshes/a.stl",
            f"file://{secret}/meshes/b.stl",
            "/other/c.stl",
            "meshes/d.stl",
            "package://robot/e.stl",
        )
    )
    (secret / "bar.urdf").write_text(
        source.urdf.replace('<link name="crank">', f'<link name="crank">{meshes}')
    )
    text = source.description.replace("../urdf/four_bar.urdf", f"{secret}/bar.urdf")
    (secret / "bar.toml").write_text(text)
    solution = srm.simulate(srm.load(secret / "bar.toml"), 0.1)

    def texts(**options: Any) -> str:
        solution.save(tmp_path / "run.npz", **options)
        with np.load(tmp_path / "run.npz") as file:
            return str(file["meta"])

    assert str(secret) in texts(full_paths=True)
    kept = texts()
    assert str(tmp_path) not in kept
    assert "/other" not in kept
    loaded = srm.load_solution(tmp_path / "run.npz").mechanism.source
    assert loaded is not None
    assert (loaded.path, loaded.urdf_path) == ("bar.toml", str(tmp_path / "bar.urdf"))
    assert re.findall(r'<mesh filename="([^"]*)"', loaded.urdf) == [
        *("meshes/a.stl", "meshes/b.stl", "c.stl", "meshes/d.stl", "package://robot/e.stl")
    ]


def test_a_loaded_run_is_played_with_the_meshes_beside_it(tmp_path: Path) -> None:
    folder = tmp_path / "robot"
    folder.mkdir()
    source = srm.load("four_bar").source
    assert source is not None
    mesh = '<visual><geometry><mesh filename="bar.stl"/></geometry></visual>'
    (folder / "bar.urdf").write_text(
        source.urdf.replace('<link name="crank">', f'<link name="crank">{mesh}')
    )
    corners = "vertex 0 0 0 vertex 1 0 0 vertex 0 1 0"
    facet = f"facet normal 0 0 1 outer loop {corners} endloop endfacet"
    (folder / "bar.stl").write_text(f"solid bar\n{facet}\nendsolid bar\n")
    (folder / "bar.toml").write_text(
        source.description.replace("../urdf/four_bar.urdf", "bar.urdf")
    )
    srm.simulate(srm.load(folder / "bar.toml"), 0.1).save(folder / "run.npz")
    folder.rename(tmp_path / "elsewhere")

    mechanism = srm.load_solution(tmp_path / "elsewhere" / "run.npz").mechanism

    assert any(isinstance(visual.shape, Mesh) for visual in visuals_of(mechanism))


def test_a_run_that_compresses_very_far_is_saved_so_that_it_loads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (archive, storage):
        monkeypatch.setattr(module, "USUAL_CONTENT", 1000)
        monkeypatch.setattr(module, "LARGEST_RATIO", 1)
    solution = srm.simulate(srm.load("four_bar"), 0.2)

    assert np.array_equal(reloaded(solution, tmp_path)(0.1)[0], solution(0.1)[0])


def test_a_run_that_is_too_large_to_be_read_is_not_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solution = srm.simulate(srm.load("four_bar"), 0.2)
    (tmp_path / "run.npz").write_text("before")
    monkeypatch.setattr(storage, "LARGEST_CONTENT", 1000)

    with pytest.raises(srm.InputError, match="more than is read"):
        solution.save(tmp_path / "run.npz")
    assert (tmp_path / "run.npz").read_text() == "before"


def test_a_bomb_is_refused_in_little_time_and_memory(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as out:
        out.writestr("meta.npy", b"\0" * 10**8)
    tracemalloc.start()
    try:
        with pytest.raises(srm.InputError, match="unpacks to 100 MB"):
            srm.load_solution(tmp_path / "bomb.npz")
        assert tracemalloc.get_traced_memory()[1] < 10**7
    finally:
        tracemalloc.stop()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the platform has no pipes")
def test_pipes_and_devices_are_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(srm.InputError, match="it is no regular file"):
            srm.load_solution(path)


def test_the_parts_of_a_run_of_segments_belong_together(tmp_path: Path) -> None:
    event = srm.Event(late, action=nothing)
    run = srm.simulate(srm.load("four_bar"), 0.6, events=event)
    assert len(run.segments) == 2
    other = srm.simulate(srm.load("slider_crank"), 0.6, events=event)
    for solution, name in ((run, "run"), (other, "other")):
        solution.save(tmp_path / f"{name}.npz")
    with zipfile.ZipFile(tmp_path / "run.npz") as file:
        parts = {name: file.read(name) for name in file.namelist()}
    with zipfile.ZipFile(tmp_path / "other.npz") as file:
        foreign = file.read("1.npz")
    contents = json.loads(parts["segments.json"])
    changes = {
        "another model": {"1.npz": foreign},
        "begins before the end": {"0.npz": parts["1.npz"], "1.npz": parts["0.npz"]},
        "it has 2 segments, not 3": {"segments.json": json.dumps(contents | {"count": 3})},
        "count: Input should be": {"segments.json": json.dumps(contents | {"count": 0})},
        "t_eval has values outside": {"segments.json": json.dumps(contents | {"t_eval": [-1.0]})},
    }
    for says, change in changes.items():
        with zipfile.ZipFile(tmp_path / "changed.npz", "w") as file:
            for name, content in (parts | change).items():
                file.writestr(name, content)
        with pytest.raises(srm.InputError, match=says):
            srm.load_solution(tmp_path / "changed.npz")


def test_a_run_of_format_4_with_indices_of_another_model_is_refused(tmp_path: Path) -> None:
    with np.load(DATA / "ring_format_4.npz") as file:
        arrays = dict(file)
    meta = json.loads(str(arrays["meta"]))
    model = pin.Model()
    model.loadFromString(meta["mechanism"]["model"])
    model.idx_vs[3] = 10**6
    meta["mechanism"]["model"] = model.saveToString()
    np.savez(tmp_path / "changed.npz", **arrays | {"meta": np.array(json.dumps(meta))})

    with pytest.raises(srm.InputError, match="the archive of its model is damaged") as caught:
        srm.load_solution(tmp_path / "changed.npz")
    assert caught.value.file == str(tmp_path / "changed.npz")


def test_a_save_that_fails_leaves_the_file_that_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solution = srm.simulate(srm.load("four_bar"), 0.2)
    solution.save(tmp_path / "run.npz")
    before = (tmp_path / "run.npz").read_bytes()

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        srm.simulate(srm.load("four_bar"), 0.3).save(tmp_path / "run.npz")
    assert (tmp_path / "run.npz").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["run.npz"]


def test_a_loaded_run_whose_stages_cannot_be_evaluated_names_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = srm.simulate(srm.load("four_bar"), 0.2, backend="python")
    run.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")

    def fails(*_: Any) -> Any:
        raise EvaluationError("two points coincide")

    monkeypatch.setattr(ClosedSystem, "evaluate", fails)
    between = 0.5 * (run.t[0] + run.t[1])
    with pytest.raises(srm.InputError, match=r"run\.npz.*two points coincide"):
        loaded(between)
    with pytest.raises(EvaluationError, match="two points coincide"):
        run(between)
