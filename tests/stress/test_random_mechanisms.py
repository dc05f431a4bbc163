"""Any mechanism whose loops can close is assembled and keeps its energy and its closures."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import event, given, settings
from scipy.integrate import trapezoid

import srm_mbs as srm
from srm_mbs._kernel import core
from srm_mbs.dynamics.constraints.rows import LoopKinematics, closure_errors
from srm_mbs.dynamics.scaling import row_units
from srm_mbs.integration import critical_passages
from srm_mbs.integration.dense_output import CRITICAL
from srm_mbs.integration.kernel import marshalling, run
from tests.stress.patience import Patience
from tests.stress.random_mechanisms import Closure, Spec, build, specs

pytestmark = [pytest.mark.stress, pytest.mark.timeout(900)]

T_END = 2.0
RTOL = 1e-8
MOST_STEPS = 5000
"""Light links of a centimetre beside heavy ones may turn thousands of times in 2 s: such a run is
judged by what it did in that many steps."""
MANY_TURNS = 100.0
"""Energy errors add up, step by step: beyond this many turns of the fastest coordinate the bound
grows with their number."""

deterministic = settings(derandomize=True, database=None, deadline=None, print_blob=True)


def rank_at_start(mechanism: srm.Mechanism) -> int:
    """Rank of the closures at q0 by a dense SVD; random configurations are regular."""
    model = mechanism.model
    data = model.createData()
    rows = LoopKinematics(model, mechanism.loops)
    pin.crba(model, data, mechanism.q0, pin.Convention.WORLD)
    rows.update(data, mechanism.q0)
    units = mechanism.structure.units
    G = rows.G / row_units(mechanism, units)[:, None] * units.coordinate
    return int(np.linalg.matrix_rank(G, tol=1e-9))


def assembled(spec: Spec) -> srm.Mechanism:
    """The mechanism of ``spec``, assembled from a guess beside its closed configuration."""
    mechanism, rates = build(spec)
    model, units = mechanism.model, mechanism.structure.units
    beside = 0.02 * units.coordinate * np.random.default_rng(spec.seed).standard_normal(model.nv)
    state = srm.assemble(mechanism, pin.integrate(model, mechanism.q0, beside), rates)
    size = row_units(mechanism, units)
    speed = max(1.0, float(np.abs(state.v / units.coordinate).max()))
    assert np.abs(state.residuals / size).max() <= 1e-12
    assert np.abs(state.rate_residuals / size).max() <= 1e-11 * speed
    return mechanism.with_state(state.q, state.v)


def check(spec: Spec) -> None:
    mechanism = assembled(spec)
    model, units = mechanism.model, mechanism.structure.units
    assert mechanism.degrees_of_freedom == model.nv - rank_at_start(mechanism) >= 1
    solution = srm.simulate(mechanism, T_END, rtol=RTOL, progress=Patience(MOST_STEPS))
    event(f"{solution.status}, {len(solution.crossings)} passages")
    assert solution.status in ("finished", "interrupted"), solution.message

    data = model.createData()
    kinetic = [pin.computeKineticEnergy(model, data, q, v) for q, v in zip(solution.q, solution.v)]
    rates = np.abs(solution.v / units.coordinate).max(axis=1)
    turns = float(trapezoid(rates, solution.t)) / (2.0 * np.pi)
    energy = solution.energy
    bound = 1e-6 * max(1.0, turns / MANY_TURNS)
    assert np.abs(energy - energy[0]).max() <= bound * max(kinetic)

    size = row_units(mechanism, units)
    g, c = closure_errors(model, mechanism.loops, solution.q, solution.v)
    assert np.abs(g / size).max() <= 1e-9
    # Rates are projected with the Jacobian just before the positions are corrected.
    assert np.abs(c / size).max() <= 10.0 * RTOL * max(units.rate, float(rates.max()))


@settings(deterministic, max_examples=200)
@given(specs(planar=True))
def test_random_planar_mechanisms_keep_energy_and_closures(spec: Spec) -> None:
    check(spec)


BALL_BESIDE_A_CRITICAL_CONFIGURATION = Spec(
    planar=False,
    seed=7000,
    length=0.017323653741397528,
    parents=(-1, 0),
    joints=("revolute", "ball"),
    closures=(Closure("point_on_line", 0, 1, copies=2), Closure("point_on_plane", 1, -1)),
)
"""Half a radian of rotation away from it: rates of rotation vectors differ from velocities."""


@pytest.fixture
def passing_from_afar(monkeypatch: pytest.MonkeyPatch) -> None:
    """Motions follow curves past critical configurations however far away they are."""
    monkeypatch.setattr(critical_passages, "FARTHEST", np.inf)
    if core is not None:
        monkeypatch.setattr(run, "CONSTANTS", marshalling.constants())


@pytest.mark.parametrize("backend", ["kernel", "python"])
def test_a_ball_joint_far_from_a_critical_configuration_keeps_its_energy(
    backend: str, passing_from_afar: None
) -> None:
    mechanism = assembled(BALL_BESIDE_A_CRITICAL_CONFIGURATION)
    # One of the passages of the last run begins so far away that it has several panels.
    for rtol, t_end in ((1e-8, T_END), (1e-10, T_END), (10.0**-10.5, 2.0 * T_END)):
        solution = srm.simulate(mechanism, t_end, rtol=rtol, backend=backend)
        assert CRITICAL in solution.steps.placements
        assert np.abs(solution.energy - solution.energy[0]).max() <= 1e-10
        assert solution.crossings == ()


@settings(deterministic, max_examples=50)
@given(specs(planar=False))
def test_random_spatial_mechanisms_keep_energy_and_closures(spec: Spec) -> None:
    check(spec)
