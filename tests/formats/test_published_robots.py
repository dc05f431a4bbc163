"""Published model files: read, compared with MuJoCo and Pinocchio, run, and in balance.

``tests/data/robots/README.md`` names their sources and licences.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
import yaml
from scipy.linalg import null_space

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from tests.support.actuators import check_forces
from tests.support.dynamics import check_same_span, closure_rows
from tests.support.mujoco_twins import Twins, check_dynamics, check_residuals, check_row_space

ROBOTS = Path(__file__).parents[1] / "data" / "robots"
MJCF = sorted(path for path in ROBOTS.glob("*/*.xml"))
URDF = sorted(ROBOTS.glob("*/*.urdf"))
GEPETTO = sorted(ROBOTS.glob("*/*/robot.yaml"))
FILES = [*MJCF, *URDF, *GEPETTO]


def label(path: Path) -> str:
    return "-".join(path.relative_to(ROBOTS).with_suffix("").parts)


def closed_configurations(mechanism: srm.Mechanism, count: int = 4) -> list[FloatArray]:
    """The start and random closed configurations (nq,)."""
    model = mechanism.model
    rng = np.random.default_rng(3)
    found = [mechanism.q0]
    for _ in range(20):
        guess = pin.integrate(model, mechanism.q0, rng.uniform(-0.7, 0.7, model.nv))
        try:
            found.append(srm.assemble(mechanism, guess, hold=()).q)
        except srm.AssemblyError:  # from a guess too far away
            continue
        if len(found) > count:
            return found
    raise AssertionError("too few random guesses could be closed")


def test_there_are_forty_two_with_their_licences() -> None:
    assert len(FILES) == 42
    readme = (ROBOTS / "README.md").read_text()
    for folder in {path.relative_to(ROBOTS).parts[0] for path in FILES}:
        assert f"| `{folder}` |" in readme
        assert (ROBOTS / folder / "LICENSE").stat().st_size > 1000


@pytest.mark.parametrize("path", MJCF, ids=label)
def test_an_mjcf_is_what_mujoco_makes_of_it(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file where it runs
    twins = Twins(path.read_text(), path)
    check_dynamics(twins)
    if twins.entries.get("loop"):
        check_residuals(twins)
        mechanism = srm.load(path)
        for q in closed_configurations(mechanism):
            check_row_space(twins, mechanism, q)


@pytest.mark.parametrize("path", MJCF, ids=label)
def test_actuators_exert_the_forces_of_mujoco(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    mechanism = srm.load(path)
    unread = [note for note in mechanism.notes if note.startswith("actuators on a tendon")]
    on_tendons = ("manipulator", "stacker", "point_mass", "tendon_dampratio")
    assert bool(unread) == (path.stem in on_tendons)
    none = path.stem in ("point_mass", "tendon_dampratio")  # on tendons alone
    if none or "<actuator>" not in path.read_text():
        assert not mechanism.actuators
    else:
        assert check_forces(path, mechanism) > 0.0


@pytest.mark.parametrize("path", [*URDF, *GEPETTO], ids=label)
def test_a_urdf_is_what_pinocchio_makes_of_it(path: Path) -> None:
    model, theirs = srm.load(path).model, pin.buildModelFromUrdf(str(path.with_suffix(".urdf")))
    data, other = model.createData(), theirs.createData()
    rng = np.random.default_rng(2)
    assert list(model.names) == list(theirs.names)
    for _ in range(3):
        moved, v = rng.uniform(-1.0, 1.0, model.nv), rng.standard_normal(model.nv)
        q, its_q = (pin.integrate(m, pin.neutral(m), moved) for m in (model, theirs))
        np.testing.assert_allclose(pin.crba(model, data, q), pin.crba(theirs, other, its_q))
        bias = pin.nonLinearEffects(theirs, other, its_q, v)
        np.testing.assert_allclose(pin.nonLinearEffects(model, data, q, v), bias, atol=1e-12)


@pytest.mark.parametrize("path", sorted(ROBOTS.glob("generalized_rbda/*.urdf")), ids=label)
def test_loops_of_a_urdf_keep_the_frames_of_the_file_together(path: Path) -> None:
    """At the start and at random closed configurations origins and axes coincide, and the rates
    that are free keep them so."""
    mechanism = srm.load(path)
    model = mechanism.model
    data = model.createData()
    for q in closed_configurations(mechanism):
        free = null_space(closure_rows(mechanism, q))
        assert free.shape[1] >= mechanism.degrees_of_freedom
        for loop in ElementTree.parse(path).getroot().findall("loop"):
            apart = []
            (axis,) = (np.array(node.get("xyz", "").split(), float) for node in loop.iter("axis"))
            for side, sign in (("predecessor", 1.0), ("successor", -1.0)):
                end = loop.find(side)
                assert end is not None
                place = end.find("origin").get("xyz").split()  # type: ignore[union-attr]
                frame = model.getFrameId(end.get("link"))
                J = pin.computeFrameJacobian(
                    model, data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
                )
                pin.framesForwardKinematics(model, data, q)
                turn = data.oMf[frame].rotation
                arm, along = turn @ np.array(place, float), turn @ axis
                rate = J[:3] - pin.skew(arm) @ J[3:]
                held = [data.oMf[frame].translation + arm, along, rate @ free]
                held.append(-pin.skew(along) @ J[3:] @ free)
                apart.append([sign * value for value in held])
            for here, there in zip(*apart, strict=True):
                np.testing.assert_allclose(here + there, 0.0, atol=1e-10)


@pytest.mark.parametrize("path", GEPETTO, ids=label)
def test_the_rows_of_gepettos_loops_are_those_of_pinocchios_constraints(path: Path) -> None:
    mechanism = srm.load(path)
    model = mechanism.model
    given = yaml.safe_load(path.read_text())
    kinds = {"6d": pin.ContactType.CONTACT_6D, "3d": pin.ContactType.CONTACT_3D}
    constraints = []
    for (a, b), kind in zip(given["closed_loop"], given["type"], strict=True):
        first, second = (model.frames[model.getFrameId(name)] for name in (a, b))
        constraints.append(
            pin.RigidConstraintModel(
                *(kinds[kind], model, first.parentJoint, first.placement),
                *(second.parentJoint, second.placement, pin.ReferenceFrame.LOCAL),
            )
        )
    for q in closed_configurations(mechanism):
        data = model.createData()
        pin.computeJointJacobians(model, data, q)
        theirs = []
        for constraint in constraints:
            values = constraint.createData()
            constraint.calc(model, data, values)
            theirs.append(pin.getConstraintJacobian(model, data, constraint, values))
        check_same_span(closure_rows(mechanism, q), np.concatenate(theirs))


@pytest.mark.parametrize("path", FILES, ids=label)
def test_a_run_balances_its_energy(path: Path) -> None:
    mechanism = srm.load(path)
    v0 = np.random.default_rng(1).standard_normal(mechanism.model.nv)
    q0 = mechanism.q0
    if mechanism.loops:  # the start of some is singular
        q0 = closed_configurations(mechanism, 1)[-1]
        v0 = srm.assemble(mechanism, q0, v0, hold=()).v
    run = srm.simulate(mechanism, 0.05, q0=q0, v0=v0, rtol=1e-9)
    assert run.success, run.message
    assert np.abs(run.drift).max(initial=0.0) < 1e-9
    assert run.energy_balance.relative < 1e-8
