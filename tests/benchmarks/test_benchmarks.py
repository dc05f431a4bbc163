"""The work-precision benchmark, thinned: schema, counting rule, plots from JSON, missing peers."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from PIL import Image

import srm_mbs as srm
from benchmarks.work_precision import (
    command,
    plots,
    readme,
    records,
    reliability,
    scaling,
    tables,
    threads,
    timing,
)
from benchmarks.work_precision.counting import Point, cheapest
from benchmarks.work_precision.harness import attempt, errors_of, measure_problem, sweep
from benchmarks.work_precision.peers import PEERS
from benchmarks.work_precision.peers.base import (
    NotApplicableError,
    Outcome,
    OverBudgetError,
    Peer,
    Setting,
)
from benchmarks.work_precision.problems import PROBLEMS, andrews
from benchmarks.work_precision.problems.base import Problem
from benchmarks.work_precision.records import Measurement, Results
from benchmarks.work_precision.references import by_extrapolation, by_gauss, by_scipy
from benchmarks.work_precision.reliability import measure_reliability, summary
from benchmarks.work_precision.scaling import measure_scaling
from benchmarks.work_precision.skip import ITEMS, measure_unneeded
from benchmarks.work_precision.trees import Equations
from srm_mbs.dynamics.multibody import make_system
from tests.support.bundled import problem as shared
from tests.support.commands import ROOT, run, run_apart


def quiet(text: str) -> None:
    pass


class Absent(type(PEERS["mujoco"])):
    """A peer whose package nobody has."""

    name = "absent"
    modules = ("no_such_simulator",)


@pytest.fixture(scope="module")
def results() -> Results:
    """One problem, us, the floor and a peer, a setting of every sweep; and a peer not installed."""
    out = Results({"processor": "some"}, {"pin": pin.__version__}, {"repeats": 2})
    peers: list[Peer] = [PEERS["ours"], PEERS["reduced"], PEERS["pinocchio_dop853"], Absent()]
    said: list[str] = []
    measure_problem(
        PROBLEMS["slider_crank_regular"](),
        peers,
        out,
        repeats=2,
        choose=lambda settings: settings[1:7:3],
        say=said.append,
    )
    out.settings["said"] = said
    return out


def test_a_measurement_has_error_drift_energy_evaluations_and_times_of_every_repeat(
    results: Results, tmp_path: Path
) -> None:
    results.save(tmp_path / "results.json")
    data = json.loads((tmp_path / "results.json").read_text())
    assert data["schema"] == records.SCHEMA
    problem = data["problems"]["slider_crank_regular"]
    assert problem["reference_accuracy"] < 1e-11
    assert (problem["nv"], problem["degrees_of_freedom"], problem["loops"]) == (2, 1, 1)
    rows = [row for row in data["measurements"] if row["peer"] == "ours"]
    assert len(rows) >= 2
    for row in rows:
        assert row["status"] == "ok"
        assert row["evaluations"] > row["steps"] > 10
        assert 0.0 < row["error"] < 10.0
        assert 0.0 <= row["drift"] < 1e-3
        assert 0.0 <= row["energy"] < 1.0
        for clock in ("cpu", "wall"):
            assert len(row[clock]["all"]) == 2
            assert row[clock]["least"] == min(row[clock]["all"])
            assert row[clock]["least"] <= row[clock]["median"] <= max(row[clock]["all"])
    peers = {row["peer"] for row in data["preparations"]}
    assert peers == {"ours", "reduced", "pinocchio_dop853"}


def test_a_peer_that_is_not_installed_is_skipped_with_a_message(results: Results) -> None:
    (skipped,) = [entry for entry in results.skipped if entry.peer == "absent"]
    assert skipped.reason == "no_such_simulator is not installed"
    assert any("absent" in line and "not installed" in line for line in results.settings["said"])
    assert not any(row.peer == "absent" for row in results.measurements)


def test_plots_and_tables_are_made_from_the_file_alone(results: Results, tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    results.save(path)
    code = (
        "import sys\n"
        "from pathlib import Path\n"
        "from benchmarks.work_precision import plots, records, tables\n"
        f"results = records.load(Path({str(path)!r}))\n"
        f"print(*plots.draw(results, Path({str(tmp_path)!r})), sep='\\n')\n"
        f"tables.write(results, Path({str(tmp_path)!r}))\n"
        "assert not {'pinocchio', 'srm_mbs', 'mujoco'} & set(sys.modules)\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    (picture,) = run.stdout.split()
    pixels = np.array(Image.open(picture).convert("L"))
    assert pixels.std() > 5.0
    text = (tmp_path / "tables.md").read_text()
    for words in ("Ours beside the best peer", *results.problems, "hand-reduced ODE", "absent"):
        assert words in text


def test_a_setting_counts_only_if_every_tighter_one_reaches_the_level() -> None:
    errors = {1e-3: 1e-7, 1e-4: 1e-2, 1e-5: 1e-7, 1e-6: 1e-8}
    lucky = [Point(*pair, float(cost)) for cost, pair in enumerate(errors.items(), start=1)]
    assert cheapest(lucky, 1e-6) is lucky[2]
    failed = [*lucky[:3], Point(1e-6, None, 0.0)]
    assert cheapest(failed, 1e-6) is None
    assert cheapest(lucky, 1e-8) is lucky[3]
    assert cheapest(lucky[::-1], 1e-6) is lucky[2]
    assert cheapest([], 1e-3) is None


def test_ratios_take_our_default_against_the_best_variant_of_the_peers() -> None:
    def row(peer: str, variant: str, tol: float, error: float, cost: float) -> Measurement:
        times = {"least": cost, "median": cost, "all": [cost]}
        return Measurement(
            "p", peer, variant, "rtol", tol, "ok", error=error, cpu=times, wall=times
        )

    made = Results({}, {}, {}, problems={"p": {}}, peers={"ours": "", "reduced": "", "mujoco": ""})
    made.measurements = [
        row("ours", "dopr54, auto", 1e-4, 1e-9, 0.1),
        row("ours", "dop853, auto", 1e-4, 1e-4, 2.0),
        row("mujoco", "soft", 1e-3, 1e-4, 9.0),
        row("mujoco", "hard", 1e-2, 1e-4, 1.0),
        row("mujoco", "hard", 1e-3, 1e-1, 5.0),
        row("reduced", "", 1e-3, 1e-4, 0.5),
    ]
    (ratios,) = tables.ratio_rows(made, 1e-3)
    assert ratios["peer"].variant == "soft"
    assert ratios["against_peer"] == 4.5
    assert ratios["against_floor"] == 4.0
    (ratios,) = tables.ratio_rows(made, 1e-6)
    assert ratios["ours"] is None
    assert ratios["against_peer"] is None


def test_files_of_another_schema_are_refused(results: Results, tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    replace(results, schema=records.SCHEMA + 1).save(path)
    with pytest.raises(ValueError, match="schema 2"):
        records.load(path)


def test_failed_runs_count_as_wrong_and_leave_median_or_worst_open() -> None:
    assert summary([1e-9, 1e-3, 5.0]) == {"right": 2, "median": 1e-3, "worst": 5.0}
    assert summary([1e-9, 1e-9, None]) == {"right": 2, "median": 1e-9, "worst": None}
    assert summary([None, None, 1e-9]) == {"right": 1, "median": None, "worst": None}


STIFF = ("bushing", "friction", "governor")


@pytest.mark.parametrize("name", STIFF)
def test_the_reduced_equations_of_stiff_problems_are_ours(name: str) -> None:
    problem = shared(name)
    mechanism, model = problem.mechanism, problem.reduced
    assert problem.stiff
    assert model is not None
    nv = mechanism.model.nv
    # Later states as well: at the start springs are relaxed, and some joints at rest.
    for q, v in [(mechanism.q0, mechanism.v0), (x[0] for x in srm.simulate(mechanism, 0.1)([0.1]))]:
        ours = make_system(mechanism).evaluate(0.0, np.concatenate([q, v])).rate()[nv:]
        if name == "friction":
            ours, start = ours[:1], np.array([q[0], v[0]])
        else:
            start = np.concatenate([q, v])
        theirs = np.asarray(model.field(0.0, start))[len(start) // 2 :]
        assert np.abs(ours - theirs).max() < 1e-9 * (np.abs(ours).max() + 1.0)


@pytest.mark.stress
def test_implicit_integrators_are_measured_on_stiff_problems_alone() -> None:
    out = Results({"processor": "some"}, {"pin": pin.__version__}, {"repeats": 2})
    peers = [PEERS[name] for name in ("ours", "reduced", "reduced_radau", "mujoco")]
    measure_problem(
        shared("friction"),
        peers,
        out,
        repeats=2,
        choose=lambda settings: [each for each in settings if each.value == 1e-5],
        say=quiet,
    )
    assert {row.peer for row in out.measurements} == {"ours", "reduced_radau"}
    assert all(row.error is not None and row.error < 1e-2 for row in out.measurements)
    assert {row.peer for row in out.skipped} == {"reduced", "mujoco"}
    with pytest.raises(NotApplicableError, match="are for stiff problems"):
        PEERS["reduced_radau"].check(shared("slider_crank_whirl"))


@pytest.mark.parametrize(
    "name", [name for name in PROBLEMS if not name.endswith("_40") and name not in STIFF]
)
def test_the_equations_of_the_peers_are_ours(name: str) -> None:
    problem = shared(name)
    tree = problem.tree
    equations = Equations(tree)
    mechanism = problem.mechanism
    ours = make_system(mechanism).evaluate(0.0, np.concatenate([mechanism.q0, mechanism.v0]))
    if tree.closures:
        g, G = equations.gaps(tree.q0)
        assert np.abs(g).max() < 1e-12
        assert np.abs(G @ tree.v0).max() < 1e-10 * max(1.0, np.abs(tree.v0).max())
    theirs, _ = equations.acceleration(tree.q0, tree.v0)
    nv = mechanism.model.nv
    acceleration = ours.rate()[nv:]
    if name.startswith("slider_crank"):  # another tree: the crank is in both
        acceleration, theirs = acceleration[:1], theirs[:1]
    scale = np.abs(acceleration).max() + 1.0
    assert np.abs(acceleration - theirs).max() < 1e-9 * scale


def installed(name: str) -> Peer:
    """The peer; skips the test where its package is missing."""
    if PEERS[name].missing():
        pytest.skip(f"{PEERS[name].missing()} is not installed")
    return PEERS[name]


def simulated(problem: Problem, peer: Peer, setting: Setting) -> np.ndarray:
    """The observed coordinates of a run of the peer at the samples of the problem."""
    outcome = attempt(problem, peer.prepare(problem), setting)
    assert not isinstance(outcome, str), outcome
    run = outcome[0]
    return problem.observe(*run.states()) if run.observed is None else run.observed()


@pytest.mark.parametrize(
    ("peer", "error"),
    [
        ("pinocchio_dop853", 1e-5),
        ("pinocchio_dop853_baumgarte", 1e-4),
        ("pinocchio_rk4_baumgarte", 1e-4),
        ("pinocchio_rk4_projected", 1e-4),
        ("mujoco", 1e-2),
        ("sundials_ida", 1e-2),
        ("scipy_dae_radau", 1e-4),
    ],
)
def test_every_peer_simulates_the_spatial_robot(peer: str, error: float) -> None:
    chosen = installed(peer)
    whole = shared("walking_robot")
    problem = replace(
        whole,
        t_end=0.1,
        reference_of=lambda: replace(whole.reference, observed=whole.reference.observed[9:10]),
    )
    setting = chosen.everyday(problem)
    if setting.kind == "rtol":
        setting = replace(setting, value=1e-6)
    else:
        setting = Setting("step", 1e-3, setting.variant, setting.gain, 1)
    observed = simulated(problem, chosen, setting)
    assert np.abs(observed[-1] - problem.reference.observed[0]).max() < error


@pytest.mark.parametrize("name", ["slider_crank_regular", "n_four_bar_2", "squeezing_mechanism"])
@pytest.mark.parametrize("peer", ["exudyn", "mujoco", "pinocchio_rk4_baumgarte"])
def test_peers_with_fixed_steps_simulate_planar_loops(peer: str, name: str) -> None:
    chosen = installed(peer)
    whole = shared(name)
    problem = replace(whole, t_end=whole.t_end / 10.0)  # every tenth sample is one of the whole
    setting = next(each for each in chosen.settings(problem) if each.substeps == 20)
    observed = simulated(problem, chosen, setting)
    difference = np.abs(observed[9::10] - problem.reference.observed[:10])
    difference[:, problem.rates :] /= problem.rate_unit
    assert difference.max() < 1e-3


@pytest.mark.parametrize(
    "name", ["slider_crank_whirl", "slider_crank_regular", "n_four_bar_2", "squeezing_mechanism"]
)
def test_heyoka_integrates_the_equations_written_by_hand(name: str) -> None:
    chosen = installed("taylor")
    problem = shared(name)
    observed = simulated(problem, chosen, Setting("rtol", 1e-12))
    assert problem.error(observed) < 1e-9


def test_elimination_of_expressions_solves_what_the_matrix_of_numbers_does() -> None:
    y = shared("squeezing_mechanism").reference.observed[20]
    in_numbers = andrews.field(0.0, y)
    in_objects = andrews.field(0.0, y.astype(object)).astype(float)
    np.testing.assert_allclose(in_objects, in_numbers, rtol=1e-9)


def test_references_agree_with_independent_integrators() -> None:
    field = lambda t, y: np.array([y[1], -np.sin(y[0])])  # noqa: E731
    times = np.linspace(0.0, 5.0, 6)[1:]
    start = np.array([1.0, 0.5])
    one = by_scipy(field, start, times)
    two = by_extrapolation(field, start.astype(np.longdouble), times, 8)
    three = by_gauss(field, start, times, 8)
    assert np.abs(one - two).max() < 1e-12
    assert np.abs(three - two).max() < 1e-12
    whirl = PROBLEMS["slider_crank_whirl"]().reference.observed[-1]
    np.testing.assert_allclose(whirl, [25.8858770871720776, 2.07434062447342553], atol=1e-12)


def test_more_than_one_thread_is_refused() -> None:
    environment = {"OMP_NUM_THREADS": "4"}
    assert not threads.single_threaded(environment)
    assert all(environment[name] == "1" for name in threads.VARIABLES)
    assert threads.single_threaded(environment)
    threads.check(1.0, 1.0)
    with pytest.raises(RuntimeError, match="several threads"):
        threads.check(2.0, 1.0)


def test_times_are_those_of_the_calls() -> None:
    calls: list[int] = []
    cpu, wall = timing.repeated(lambda: calls.append(0), 7)
    assert len(calls) == len(cpu.all) == len(wall.all) == 7
    assert cpu.least == min(cpu.all) <= cpu.median


def test_a_repeat_that_takes_too_long_ends_the_sweep_and_not_the_benchmark() -> None:
    problem, peer = shared("slider_crank_regular"), PEERS["ours"]
    settings = peer.settings(problem)[:2]
    calls = iter(range(9))

    def runner(setting: Setting) -> Callable[[], Outcome]:
        whole = peer.prepare(problem)(setting)

        def run_once() -> Outcome:
            if next(calls):
                raise OverBudgetError("stopped after 0.6 s")
            return whole()

        return run_once

    done = list(sweep(problem, peer, runner, settings, 5, 1.0, quiet))
    assert [measurement.status for measurement, _ in done] == ["over budget"]
    assert done[0][0].message == "stopped after 0.6 s"


def test_the_command_needs_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert "checkout" in run("benchmark", "--out", "x", status=2)
    assert "--peers" in run("benchmark", "--help")


@pytest.mark.stress
def test_the_command_measures_from_a_checkout(tmp_path: Path) -> None:
    arguments = ["--out", str(tmp_path), "--thin", "--repeats", "1", "--sections", "work"]
    chosen = ["--problems", "pendulum_chain", "--peers", "ours", "pinocchio_dop853"]
    chosen += ["--backend", srm.backend()]
    done = run_apart("benchmark", *arguments, *chosen)
    assert done.returncode == 0, done.stderr
    assert "[1/1]" in done.stdout
    assert "written:" in done.stdout
    results = records.load(tmp_path / "results.json")
    assert {row.peer for row in results.measurements} == {"ours", "pinocchio_dop853"}
    assert (tmp_path / "work_precision_pendulum_chain.png").is_file()


def test_what_is_measured_again_replaces_results_and_the_rest_is_kept(tmp_path: Path) -> None:
    def measured(problem: str, peer: str) -> records.Measurement:
        return records.Measurement(problem, peer, "", "rtol", 1e-6, "ok")

    fresh = records.Results({"processors": 2}, {"pin": "4.1.0"}, {"repeats": 5})
    old = replace(
        fresh,
        problems={"pendulum_chain": {}, "spatial_four_bar": {}},
        measurements=[
            measured("pendulum_chain", "ours"),
            measured("pendulum_chain", "mujoco"),
            measured("spatial_four_bar", "ours"),
        ],
        skipped=[records.Skipped("ours", "not there")],
        unneeded=[{"item": "zero rows"}],
        scaling={"loops": []},
    )
    path = tmp_path / "results.json"
    old.save(path)
    kept = records.continued(path, fresh, ["work", "scaling"], ["pendulum_chain"], ["ours"])
    assert kept.measurements == old.measurements[1:]
    assert kept.problems == old.problems
    assert kept.skipped == old.skipped  # of the section on reliability
    assert kept.unneeded == old.unneeded
    assert kept.scaling == {}

    for what, value in (("versions", {"pin": "4.2.0"}), ("machine", {"processors": 4})):
        with pytest.raises(ValueError, match=f"other {what}"):
            records.continued(path, replace(fresh, **{what: value}), ["work"], [], [])


def test_fewer_than_five_repeats_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        command.main(["--out", str(tmp_path), "--repeats", "1"])
    assert stopped.value.code == 2
    assert "at least 5 repeats" in capsys.readouterr().err


def test_energy_is_compared_with_the_start() -> None:
    problem = shared("pendulum_chain")
    for name in ("ours", "pinocchio_dop853"):
        peer = PEERS[name]
        setting = replace(peer.everyday(problem), value=1e-8)
        outcome = attempt(problem, peer.prepare(problem), setting)
        assert not isinstance(outcome, str)
        error, drift, energy = errors_of(problem, outcome[0])
        assert error < 1e-3
        assert drift == 0.0
        assert energy is not None
        assert 0.0 < energy < 1e-5
    assert plots.STYLES.keys() == PEERS.keys()
    assert {records.OURS, records.FLOOR} < PEERS.keys()


def test_the_reference_of_the_squeezing_mechanism_ends_as_published() -> None:
    # DAE test set of CWI and Bari: beta, theta, gamma, phi, delta, omega, epsilon at 0.03 s (rad)
    published = [
        *(15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948),
        *(0.5244099658805304, 0.5347301163226948, 1.048080741042263),
    ]
    problem = shared("squeezing_mechanism")
    assert problem.reference.accuracy < 1e-11
    ours = problem.reference.observed[-1][:7]
    assert np.abs(ours - np.array(published)[andrews.TREE_ORDER]).max() < 2e-9


def test_the_benchmark_page_and_the_readme_get_the_figure_and_a_table_between_their_marks(
    results: Results, tmp_path: Path
) -> None:
    # A time that three digits show as 2.87 ms, and as 2.88 ms when four digits were kept before.
    results = replace(
        results,
        measurements=[
            replace(row, cpu={**row.cpu, "least": 2.8746e-3}) if row.cpu else row
            for row in results.measurements
        ],
    )
    page, data, docs = tmp_path / "README.md", tmp_path / "results.json", tmp_path / "docs"
    docs.mkdir()
    whole = docs / "benchmarks.md"
    for path in (page, whole):
        path.write_text(f"# Title\n\n{readme.BEGIN}\n{readme.END}\n\ntext\n")
    results.save(data)
    readme.main([str(data), "--docs", str(docs), "--readme", str(page)])
    # Again from the brief results in the documentation.
    kept, short, text = docs / "work_precision.json", page.read_text(), whole.read_text()
    brief = kept.read_text()
    readme.main(["--docs", str(docs), "--readme", str(page)])
    assert (page.read_text(), whole.read_text()) == (short, text)
    assert kept.read_text() == brief
    assert '"all"' in data.read_text()
    assert '"all"' not in brief
    assert "2.87 /" in readme.table(results)
    assert readme.table(records.load(kept)) in text
    for written in (short, text):
        assert written.count(readme.BEGIN) == written.count(readme.END) == 1
        assert results.problems["slider_crank_regular"]["title"] in written
        assert written.endswith(f"{readme.END}\n\ntext\n")
    assert "![CPU time against error](docs/work_precision.png)" in short
    assert "![CPU time against error](work_precision.png)" in text
    assert kept.with_suffix(".png").stat().st_size > 10_000
    with pytest.raises(ValueError, match="marks"):
        readme.rewritten(f"{readme.END} {readme.BEGIN}", "new")


def test_what_is_skipped_is_measured_on_the_same_motion() -> None:
    out = Results({}, {}, {})
    measure_unneeded(out, repeats=2, thin=True, say=quiet)
    # Which is less is for the benchmark to say: two repeats beside other work may show either.
    (row,) = out.unneeded
    assert min(row["skipped"], row["done"]) > 0.0


@pytest.mark.stress
def test_every_thing_that_is_skipped_is_measured_on_the_same_motion() -> None:
    out = Results({}, {}, {})
    measure_unneeded(out, repeats=1, thin=False, say=quiet)
    assert len(out.unneeded) >= len(ITEMS)


@pytest.mark.stress
def test_cost_against_size_has_ours_beside_pinocchio() -> None:
    out = Results({}, {}, {})
    measure_scaling(out, repeats=1, thin=True, say=quiet)
    loops, chains = out.scaling.values()
    assert [row["loops"] for row in loops] == [1, 2]
    for row in loops:
        ratio = row["run, per evaluation (us)"] / row["constraintDynamics (us)"]
        assert row["ours / constraintDynamics"] == pytest.approx(ratio)
        names = list(row)
        parts = names[names.index("of a Python run: Pinocchio") :][:4]
        assert sum(row[part] for part in parts) == pytest.approx(1.0)
        # Differences of measured times: on a busy machine a small one may come out negative.
        assert ("evaluation in the kernel (us)" in row) == (srm.backend() == "kernel")
        if "evaluation in the kernel (us)" in row:
            parts = names[names.index("of a run: Pinocchio") :][:4]
            assert sum(row[part] for part in parts) == pytest.approx(1.0)
    assert all(min(row["aba (us)"], row["run, per step (us)"]) > 0.0 for row in chains)


@pytest.mark.skipif(srm.backend() != "kernel", reason="sizes that only the kernel is measured at")
def test_cells_of_sizes_that_only_the_kernel_is_measured_at_are_empty(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(scaling, "LOOPS", (1, 2))
    monkeypatch.setattr(scaling, "LOOPS_OF_ALL", 1)
    monkeypatch.setattr(scaling, "LINKS", ())
    # The numbers themselves do not matter here, and take long.
    monkeypatch.setattr(scaling, "_run_cost", lambda *_: (1e3, 100, 10))
    monkeypatch.setattr(scaling, "_inside", lambda *_: (1e3, 900.0))
    monkeypatch.setattr(scaling, "per_call", lambda call, *_: (call(), 5.0)[1])
    out = Results({}, {}, {})
    measure_scaling(out, repeats=1, thin=False, say=quiet)
    one, two = next(iter(out.scaling.values()))
    assert list(one) == list(two)
    empty = {key for key, value in two.items() if value is None}
    assert empty == {
        "Python backend, per evaluation (us)",
        "of a Python run: Pinocchio",
        "LAPACK",
        "Python in evaluations",
        "stepping in Python",
        "constraintDynamics (us)",
        "ours / constraintDynamics",
    }
    assert None not in one.values()
    path = tmp_path / "results.json"
    out.save(path)
    loaded = records.load(path)
    last = tables.text(loaded).rstrip().splitlines()[-1]
    assert last.startswith("| 2 | 5 |")
    assert last.count(" - ") == len(empty)
    (picture,) = plots.draw(loaded, tmp_path)
    assert picture.name == "scaling_closed_loops.png"


def test_reliability_counts_right_branches_and_names_peers_that_are_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reliability, "FAMILIES", reliability.FAMILIES[1:2])
    out = Results({}, {}, {})
    measure_reliability([PEERS["ours"], Absent()], out, thin=True, say=quiet)
    (row,) = out.reliability
    assert (row["problem"], row["peer"], row["right"]) == ("n_four_bar_1", "ours", 3)
    assert [run["speed"] for run in row["runs"]] == pytest.approx([0.5, 2.4, 4.3])
    assert 0.0 < row["median"] <= row["worst"] < 1e-6
    assert [entry.peer for entry in out.skipped] == ["absent"]
