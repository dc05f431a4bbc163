"""Evaluations of random mechanisms by generated code are those of the kernel."""

from __future__ import annotations

import shutil

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings

from srm_mbs.dynamics.multibody import make_system
from srm_mbs.integration.generated.code import load_code
from srm_mbs.integration.kernel import backend
from srm_mbs.integration.kernel.system import make_kernel_system
from tests.stress.random_mechanisms import Spec, build, specs
from tests.support.dynamics import mass_matrix

pytestmark = [
    pytest.mark.stress,
    pytest.mark.timeout(900),
    pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}"),
    pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler"),
]

STATES = 4
deterministic = settings(
    max_examples=40, derandomize=True, database=None, deadline=None, print_blob=True
)


def check(spec: Spec) -> None:
    mechanism, rates = build(spec)
    model, system = mechanism.model, make_system(mechanism)
    kernel, generated = make_kernel_system(system), make_kernel_system(system, load_code(mechanism))
    rng = np.random.default_rng(spec.seed)
    unit = mechanism.structure.units.coordinate
    for _ in range(STATES):
        q = pin.integrate(model, mechanism.q0, 0.3 * unit * rng.standard_normal(model.nv))
        state = np.concatenate([q, rates * rng.uniform(-1.0, 1.0, model.nv)])
        one, two = kernel.terms(0.0, state), generated.terms(0.0, state)
        assert one["rank"] == two["rank"]
        # Masses differ by a factor of 1e4, lengths by 6: accelerations carry the condition of M.
        scale = np.sqrt(np.diag(mass_matrix(model, q)))
        condition = np.linalg.cond(mass_matrix(model, q) / np.outer(scale, scale))
        allowed = 1e-12 + 1e-14 * condition / min(one["sigma"], 1.0)
        parts = {
            key: [np.asarray(found[key])[-model.nv :] * scale for found in (one, two)]
            for key in ("rate", "multiplier", "correction")
        }
        # Rate and multiplier are parts of the free acceleration, which may be far larger than one.
        free = max(np.abs(parts[key][0]).max() for key in ("rate", "multiplier"))
        speed = max(np.abs(parts["correction"][0]).max(), np.abs(state[-model.nv :] * scale).max())
        for key, size in (("rate", free), ("multiplier", free), ("correction", speed)):
            assert np.abs(parts[key][0] - parts[key][1]).max() <= allowed * size, key
        assert abs(one["sigma"] - two["sigma"]) <= 1e-12 * condition


@pytest.mark.parametrize("planar", [True, False])
def test_random_mechanisms(planar: bool) -> None:
    @deterministic
    @given(specs(planar))
    def random_mechanism(spec: Spec) -> None:
        check(spec)

    random_mechanism()
