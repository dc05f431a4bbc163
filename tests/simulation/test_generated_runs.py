"""Runs with generated code: the same motion as the kernel's, and errors that name the reason."""

from __future__ import annotations

import pickle
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.integration.generated import code, code_cache
from srm_mbs.integration.kernel import backend
from tests.support.bundled import finished, load
from tests.support.commands import row, run
from tests.support.mechanisms import COMPILED_MODELS, distance, rod

pytestmark = [
    pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}"),
    pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler"),
]

END = {"squeezing_mechanism": 0.03, "jansen_walker": 2.0, "klann_walker": 2.0}
"""Ends of runs (s); others last 3 s."""


@pytest.mark.parametrize("name", COMPILED_MODELS)
def test_runs_of_bundled_mechanisms_are_those_of_the_kernel(name: str) -> None:
    mechanism, t_end = load(name), END.get(name, 3.0)
    kernel, generated = (
        finished(mechanism, t_end, rtol=1e-8, backend=by) for by in ("kernel", "generated")
    )
    assert generated.settings.backend == "generated"
    assert generated.status == kernel.status
    assert [c.kind for c in generated.crossings] == [c.kind for c in kernel.crossings]
    exact = finished(mechanism, t_end, rtol=1e-11, backend="kernel")
    size = max(1.0, float(np.abs(exact.v[-1]).max()))
    error = distance(mechanism, kernel, exact)
    assert distance(mechanism, generated, exact) < 3.0 * error + 1e-9 * size


def test_a_run_that_names_its_backend_is_repeated_bit_by_bit() -> None:
    mechanism = load("n_four_bar_2")
    first, second = (
        finished(mechanism, 4.0, backend="generated", t_eval=np.linspace(0.0, 4.0, 41))
        for _ in range(2)
    )
    assert np.array_equal(first.q, second.q)
    assert np.array_equal(first.v, second.v)
    # In between another backend takes the idle workspace.
    finished(mechanism, 1.0, backend="kernel")
    third = finished(mechanism, 4.0, backend="generated", t_eval=np.linspace(0.0, 4.0, 41))
    assert np.array_equal(first.q, third.q)


def test_a_run_by_the_kernel_after_one_by_generated_code_is_the_kernels() -> None:
    before = finished(load("four_bar"), 2.0, backend="kernel")
    finished(load("four_bar"), 2.0, backend="generated")
    after = finished(load("four_bar"), 2.0, backend="kernel")
    assert np.array_equal(before.q, after.q)
    assert after.settings.backend == "kernel"


def test_controllers_and_drives_act_beside_generated_code() -> None:
    mechanism = load("five_bar")

    def controller(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array([np.sin(3.0 * t), *(-0.1 * v[1:])])

    for options in ({}, {"sample_time": 0.05}):
        runs = [
            finished(mechanism, 1.0, rtol=1e-9, backend=by, controller=controller, **options)
            for by in ("kernel", "generated")
        ]
        assert distance(mechanism, *runs) < 1e-7
    driven = load("wiper")
    assert driven.drives
    runs = [finished(driven, 2.0, rtol=1e-9, backend=by) for by in ("kernel", "generated")]
    assert distance(driven, *runs) < 1e-7


def test_a_simulator_takes_generated_code() -> None:
    states = []
    for by in ("kernel", "generated"):
        simulator = srm.Simulator(load("four_bar"), backend=by)
        for _ in range(20):
            simulator.step(0.02)
        states.append(np.concatenate([simulator.q, simulator.v]))
    assert np.abs(states[0] - states[1]).max() < 1e-9
    assert not np.array_equal(*states)


def test_a_run_is_saved_loaded_and_copied_with_its_backend(tmp_path: Path) -> None:
    solution = finished(load("four_bar"), 1.0, backend="generated")
    solution.save(tmp_path / "run.npz")
    for other in (srm.load_solution(tmp_path / "run.npz"), pickle.loads(pickle.dumps(solution))):
        assert other.settings.backend == "generated"
        assert np.array_equal(other.at([0.333]).q, solution.at([0.333]).q)
    assert "generated code" in row(run("info", tmp_path / "run.npz"), "computed by")


def test_a_loaded_run_compiles_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    solution = finished(load("four_bar"), 1.0, backend="generated")
    solution.save(tmp_path / "run.npz")
    monkeypatch.setattr(code, "_libraries", type(code._libraries)())
    monkeypatch.setenv("SRM_MBS_CACHE", str(tmp_path / "nothing"))
    other = srm.load_solution(tmp_path / "run.npz")
    assert np.abs(other.at([0.333]).q - solution.at([0.333]).q).max() < 1e-13
    assert not list((tmp_path / "nothing").glob("*.so"))


def test_threads_share_generated_code() -> None:
    mechanism = srm.load("spatial_four_bar")
    expected = finished(srm.load("spatial_four_bar"), 1.0, backend="generated")
    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(lambda _: finished(mechanism, 1.0, backend="generated"), range(8)))
    assert all(np.array_equal(one.q, expected.q) for one in runs)


def _egg() -> srm.Mechanism:
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelEllipsoid(1.0, 2.0, 3.0), pin.SE3.Identity(), "egg")
    model.appendBodyToJoint(joint, rod(), pin.SE3.Identity())
    return srm.Mechanism(model, q0=pin.neutral(model))


def test_an_element_without_generated_code_is_the_reason_of_the_error() -> None:
    with pytest.raises(srm.InputError, match="'egg' is of the type Ellipsoid") as caught:
        srm.simulate(_egg(), 0.1, backend="generated")
    assert caught.value.element == "backend"
    with pytest.raises(srm.InputError, match="'egg'"):
        srm.Simulator(_egg(), backend="generated")


def test_a_mechanism_that_is_too_large_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(code, "MOST_OPERATIONS", 50)
    monkeypatch.setattr(code, "_libraries", type(code._libraries)())
    monkeypatch.setattr(code, "_refused", {})
    monkeypatch.setenv("SRM_MBS_CACHE", str(tmp_path))
    for _ in range(2):
        with pytest.raises(srm.InputError, match="statements, more than 50"):
            srm.compile(srm.load("flyball_governor"))


def test_without_a_compiler_the_error_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(code_cache, "compiler", lambda: None)
    monkeypatch.setattr(code, "_libraries", type(code._libraries)())
    monkeypatch.setenv("SRM_MBS_CACHE", str(tmp_path))
    with pytest.raises(srm.InputError, match="there is no C compiler") as caught:
        srm.simulate(srm.load("four_bar"), 0.1, backend="generated")
    assert caught.value.remedy.startswith("Install a C compiler")
    monkeypatch.delenv("SRM_MBS_BACKEND", raising=False)
    assert srm.simulate(srm.load("four_bar"), 0.1).settings.backend == "kernel"


def test_options_that_the_kernel_lacks_are_refused() -> None:
    with pytest.raises(srm.InputError, match="it has no placement"):
        srm.simulate(load("four_bar"), 0.1, backend="generated", placement="halved")
