"""Mechanisms with hundreds of loops: they load, close and run, in time and memory that fit them."""

from __future__ import annotations

import resource
import time

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs import kernel
from tests import reduced

pytestmark = [
    pytest.mark.stress,
    pytest.mark.timeout(240),
    pytest.mark.skipif(kernel.core is None, reason=f"no kernel: {kernel.missing}"),
]


def memory() -> float:
    """Largest memory of this process so far (GB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


@pytest.mark.parametrize("n", [320, 640])
def test_hundreds_of_loops_load_and_run(n: int) -> None:
    """Pinocchio's own workspace would take 8 GB for 320 loops, 67 GB for 640."""
    before = memory()
    mechanism = srm.n_four_bar(n)
    assert mechanism.degrees_of_freedom == 1
    assert mechanism.redundant_rows == tuple(f"pin_{i}.y" for i in range(n))
    t = np.linspace(0.0, 0.3, 4)
    solution = srm.simulate(mechanism, 0.3, rtol=1e-8, t_eval=t)
    assert solution.success
    expected = reduced.trajectory(reduced.n_four_bar(n), [np.pi / 2.0, -1.0], t)
    for crank in ("crank_0", f"crank_{n // 2}", f"crank_{n}"):
        position, rate = solution.joint(crank)
        assert np.abs(position - expected[:, 0]).max() < 1e-7
        assert np.abs(rate - expected[:, 1]).max() < 1e-7
    assert np.abs(solution.drift).max() < 1e-9
    assert memory() - before < 1.5


def test_a_hundred_and_sixty_loops_pass_their_singularity_of_that_nullity() -> None:
    t = np.linspace(0.0, 1.2, 13)
    solution = srm.simulate(srm.n_four_bar(160), 1.2, rtol=1e-8, t_eval=t)
    assert solution.success
    assert len(solution.crossings) == 1
    expected = reduced.trajectory(reduced.n_four_bar(160), [np.pi / 2.0, -1.0], t)
    for crank in ("crank_0", "crank_80", "crank_160"):
        position, rate = solution.joint(crank)
        assert np.abs(position - expected[:, 0]).max() < 1e-7
        assert np.abs(rate - expected[:, 1]).max() < 1e-7


def test_the_time_to_load_grows_with_the_loops_not_with_their_cube() -> None:
    """It is linear in the number of loops but for filling dense arrays: measured 6 times from 40 to
    160 loops, and 30 times with singular values."""

    def seconds(n: int) -> float:
        best = np.inf
        for _ in range(2):
            start = time.process_time()
            srm.n_four_bar(n)
            best = min(best, time.process_time() - start)
        return best

    assert seconds(160) < 15.0 * seconds(40)


def test_a_long_chain_is_assembled_from_a_crooked_guess() -> None:
    n = 160
    mechanism = srm.n_four_bar(n)
    rng = np.random.default_rng(0)
    guess = mechanism.q0 + 0.02 * rng.uniform(-1.0, 1.0, mechanism.model.nq)
    found = srm.assemble(mechanism, guess, hold=["crank_0"])
    assert np.abs(found.residuals).max() < 1e-12 * mechanism.structure.units.length
    assert found.free_directions.shape == (mechanism.model.nv, 1)
    assert not found.singular
