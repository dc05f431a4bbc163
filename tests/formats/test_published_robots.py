"""Published model files: read, compared with MuJoCo and Pinocchio, run, and in balance.

``tests/data/robots/README.md`` names their sources and licences.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support.actuators import check_forces
from tests.support.mujoco_twins import Twins, check_dynamics, check_residuals

ROBOTS = Path(__file__).parents[1] / "data" / "robots"
MJCF = sorted(path for path in ROBOTS.glob("*/*.xml"))
URDF = sorted(ROBOTS.glob("*/*.urdf"))


def test_there_are_thirty() -> None:
    assert len(MJCF) + len(URDF) == 30


@pytest.mark.parametrize("path", MJCF, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_an_mjcf_is_what_mujoco_makes_of_it(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file where it runs
    twins = Twins(path.read_text(), path)
    check_dynamics(twins)
    if twins.entries.get("loop"):
        check_residuals(twins)


@pytest.mark.parametrize("path", MJCF, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_actuators_exert_the_forces_of_mujoco(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    mechanism = srm.load(path)
    unread = [note for note in mechanism.notes if note.startswith("actuators on a tendon")]
    assert bool(unread) == (path.stem in ("manipulator", "stacker", "point_mass"))
    if path.stem == "point_mass":  # on tendons alone
        assert not mechanism.actuators
    else:
        assert check_forces(path, mechanism) > 0.0


@pytest.mark.parametrize("path", URDF, ids=lambda path: path.stem)
def test_a_urdf_is_what_pinocchio_makes_of_it(path: Path) -> None:
    model, theirs = srm.load(path).model, pin.buildModelFromUrdf(str(path))
    data, other = model.createData(), theirs.createData()
    rng = np.random.default_rng(2)
    assert list(model.names) == list(theirs.names)
    for _ in range(3):
        moved, v = rng.uniform(-1.0, 1.0, model.nv), rng.standard_normal(model.nv)
        q, its_q = (pin.integrate(m, pin.neutral(m), moved) for m in (model, theirs))
        np.testing.assert_allclose(pin.crba(model, data, q), pin.crba(theirs, other, its_q))
        bias = pin.nonLinearEffects(theirs, other, its_q, v)
        np.testing.assert_allclose(pin.nonLinearEffects(model, data, q, v), bias, atol=1e-12)


@pytest.mark.parametrize("path", [*MJCF, *URDF], ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_run_balances_its_energy(path: Path) -> None:
    mechanism = srm.load(path)
    random = np.random.default_rng(1).standard_normal(mechanism.model.nv)
    v0 = mechanism.v0 if mechanism.loops else random
    run = srm.simulate(mechanism, 0.05, v0=v0, rtol=1e-9)
    assert run.success, run.message
    assert np.abs(run.drift).max(initial=0.0) < 1e-9
    assert run.energy_balance.relative < 1e-8
