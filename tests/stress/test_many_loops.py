"""Mechanisms with hundreds of loops: they load, close and run, in time and memory that fit them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import lapack

import srm_mbs as srm
from srm_mbs.dynamics.constraints import row_algebra
from srm_mbs.integration.kernel import backend
from tests.support import reduced
from tests.support.memory import ON_LINUX, growth

pytestmark = [
    pytest.mark.stress,
    pytest.mark.timeout(240),
    pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}"),
]


def check_cranks(solution: srm.Solution, n: int) -> None:
    """First, middle and last crank move as the reduced equations say."""
    expected = reduced.trajectory(reduced.n_four_bar(n), [np.pi / 2.0, -1.0], solution.t)
    for crank in ("crank_0", f"crank_{n // 2}", f"crank_{n}"):
        position, rate = solution.joint(crank)
        assert np.abs(position - expected[:, 0]).max() < 1e-7
        assert np.abs(rate - expected[:, 1]).max() < 1e-7


@pytest.mark.skipif(not ON_LINUX, reason="reads /proc/self/status")
@pytest.mark.parametrize("n", [320, 640])
def test_hundreds_of_loops_load_and_run(n: int) -> None:
    """Pinocchio's own workspace would take 8 GB for 320 loops, 67 GB for 640."""

    def run() -> None:
        mechanism = srm.n_four_bar(n)
        assert mechanism.degrees_of_freedom == 1
        assert mechanism.redundant_rows == tuple(f"pin_{i}.y" for i in range(n))
        t = np.linspace(0.0, 0.3, 4)
        solution = srm.simulate(mechanism, 0.3, rtol=1e-8, t_eval=t)
        assert solution.success
        check_cranks(solution, n)
        assert np.abs(solution.drift).max() < 1e-9

    assert growth(run) < 1500.0  # MB


def test_a_hundred_and_sixty_loops_pass_their_singularity_of_that_nullity() -> None:
    t = np.linspace(0.0, 1.2, 13)
    solution = srm.simulate(srm.n_four_bar(160), 1.2, rtol=1e-8, t_eval=t)
    assert solution.success
    assert len(solution.crossings) == 1
    check_cranks(solution, 160)


def test_loading_many_loops_factorises_nothing_that_is_large_and_dense(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Their cost would grow with the cube of the loops: 30 times from 40 to 160, measured, where
    the sparse algebra takes 6 times (``python -m benchmarks.loop_scaling`` measures runs)."""

    largest = row_algebra.SPARSE_ABOVE

    def watch(module: Any, name: str) -> None:
        original = getattr(module, name)

        def watched(a: np.ndarray, *rest: Any, **options: Any) -> Any:
            assert min(np.shape(a)) <= largest, f"{name} of {np.shape(a)}"
            return original(a, *rest, **options)

        monkeypatch.setattr(module, name, watched)

    for name in ("svd", "lstsq", "qr", "eigh", "inv", "pinv", "matrix_rank"):
        watch(np.linalg, name)
    for name in ("dgeqp3", "dgesdd"):
        watch(lapack, name)
    assert srm.n_four_bar(160).degrees_of_freedom == 1
    # The watch sees what is dense: the search from an open guess, of few loops.
    few = srm.n_four_bar(2)
    largest = 2
    with pytest.raises(AssertionError, match="of "):
        srm.assemble(few, few.q0 + 0.01, hold=["crank_0"])


def test_a_long_chain_is_assembled_from_a_crooked_guess() -> None:
    n = 160
    mechanism = srm.n_four_bar(n)
    rng = np.random.default_rng(0)
    guess = mechanism.q0 + 0.02 * rng.uniform(-1.0, 1.0, mechanism.model.nq)
    found = srm.assemble(mechanism, guess, hold=["crank_0"])
    assert np.abs(found.residuals).max() < 1e-12 * mechanism.structure.units.length
    assert found.free_directions.shape == (mechanism.model.nv, 1)
    assert not found.singular
