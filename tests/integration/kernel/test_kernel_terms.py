"""What the kernel computes at one stage, whatever the joints; and what its workspace holds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.dynamics.system import Zone
from srm_mbs.integration.kernel import backend
from srm_mbs.integration.kernel.system import Evaluator, make_kernel_system
from tests.support.mechanisms import along_x, rod

pytestmark = pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}")

_TILTED = np.array([0.6, 0.0, 0.8])


def _composite() -> pin.JointModelComposite:
    joint = pin.JointModelComposite()
    joint.addJoint(pin.JointModelRX(), pin.SE3.Identity())
    joint.addJoint(pin.JointModelPY(), along_x(0.1))
    return joint


def _tilted_unbounded() -> pin.JointModelRevoluteUnboundedUnaligned:
    joint = pin.JointModelRevoluteUnboundedUnaligned()
    joint.axis = _TILTED
    return joint


IN_ONE_PASS = {
    "revolute": (pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ),
    "tilted": (lambda: pin.JointModelRevoluteUnaligned(_TILTED),),
    "unbounded": (pin.JointModelRUBX, pin.JointModelRUBY, pin.JointModelRUBZ),
    "tilted unbounded": (_tilted_unbounded,),
    "prismatic": (pin.JointModelPX, pin.JointModelPY, pin.JointModelPZ),
    "tilted prismatic": (lambda: pin.JointModelPrismaticUnaligned(_TILTED),),
    "ball": (pin.JointModelSpherical,),
    "planar": (pin.JointModelPlanar,),
    "free": (pin.JointModelFreeFlyer,),
}
BY_PINOCCHIO = {
    "helical": (lambda: pin.JointModelHX(0.2),),
    "translation": (pin.JointModelTranslation,),
    "composite": (_composite,),
}


def _branching(kinds: tuple) -> srm.Mechanism:
    """A hinge, from which a chain of ``kinds`` and a second branch go; its tip stays in a plane."""
    rng = np.random.default_rng(1)
    model = pin.Model()
    model.armature = np.zeros(0)

    def add(parent: int, joint: object, name: str) -> int:
        placement = pin.SE3(pin.rpy.rpyToMatrix(rng.uniform(-1, 1, 3)), rng.uniform(-1, 1, 3))
        index = model.addJoint(parent, joint, placement, name)
        model.appendBodyToJoint(index, rod(), pin.SE3.Identity())
        model.addBodyFrame(name, index, pin.SE3.Identity(), 0)
        return index

    first = last = add(0, pin.JointModelRY(), "root")
    for k, kind in enumerate(kinds):
        last = add(last, kind(), f"link_{k}")
    tip = add(last, pin.JointModelRZ(), "tip")
    add(first, pin.JointModelRX(), "branch")
    model.armature = rng.uniform(0.0, 0.1, model.nv)
    data = model.createData()
    q = pin.neutral(model)
    pin.forwardKinematics(model, data, q)
    at = tuple(data.oMi[tip].translation.tolist())
    plane = srm.LoopClosure(
        "point_on_plane", srm.Anchor("tip"), srm.Anchor("world", xyz=at), axis=(0.0, 0.6, 0.8)
    )
    return srm.Mechanism(model, [plane], q0=q)


@pytest.mark.parametrize("name", [*IN_ONE_PASS, *BY_PINOCCHIO])
def test_terms_are_those_of_the_reference_for_any_kind_of_joint(name: str) -> None:
    mechanism = _branching((IN_ONE_PASS | BY_PINOCCHIO)[name])
    model = mechanism.model
    system = make_system(mechanism)
    kernel_system = make_kernel_system(system)
    rng = np.random.default_rng(2)
    for _ in range(5):
        q = pin.integrate(model, mechanism.q0, rng.uniform(-1.0, 1.0, model.nv))
        state = np.concatenate([q, rng.uniform(-2.0, 2.0, model.nv)])
        found = kernel_system.terms(0.0, state)
        terms = system.evaluate(0.0, state)
        size = np.abs(terms.rate()).max()
        assert np.abs(found["rate"] - terms.rate()).max() < 1e-13 * size / terms.sigma
        assert found["sigma"] == pytest.approx(terms.sigma, rel=1e-12)
        residuals = kernel_system.closure_errors(np.zeros(1), state[None])
        for found_ones, own in zip(residuals, system.residuals(state)):
            assert np.abs(found_ones - own).max() < 1e-14 * (1.0 + np.abs(state).max())
        largest = Evaluator(system, kernel_system).largest_residuals(state, 0.0)
        assert largest == pytest.approx(system.largest_residuals(state, 0.0), abs=1e-13)


def test_the_largest_error_of_the_rows_is_not_a_number_if_one_of_them_is_none() -> None:
    mechanism = srm.load("n_four_bar_2")
    kernel_system = make_kernel_system(make_system(mechanism))
    v = mechanism.v0.copy()
    v[0] = np.nan  # of the first loop alone
    state = np.concatenate([mechanism.q0, v])[None]
    rates = kernel_system.closure_errors(np.zeros(1), state)[1][0]
    assert np.isnan(rates[:2]).all()
    assert np.isfinite(rates[2:]).all()
    largest = kernel_system.largest_errors(0.0, mechanism.q0, v, np.ones(len(rates)))
    assert largest[0] < 1e-15
    assert np.isnan(largest[1])


@pytest.mark.parametrize("name", ["bricard", "delta_robot"])
def test_terms_whose_dropped_rows_have_no_multiplier_are_those_of_the_reference(name: str) -> None:
    mechanism = srm.load(name)
    system = make_system(mechanism)
    rng = np.random.default_rng(3)
    q = pin.integrate(mechanism.model, mechanism.q0, rng.normal(size=mechanism.model.nv) * 1e-2)
    state = np.concatenate([q, rng.normal(size=mechanism.model.nv)])  # corrections are not zero
    zone = Zone.without_prediction(2.0 * system.evaluate(0.0, state).sigma, mechanism.model.nv)
    terms = system.evaluate(0.0, state, zone)
    expected = [x.copy() for x in (terms.rate(), terms.multiplier(), terms.correction())]
    found = Evaluator(system, make_kernel_system(system)).evaluate(0.0, state, zone)
    assert found.rank == terms.rank > 0
    assert found.rank_deficient
    assert terms.rank_deficient
    for own, other in zip((found.rate(), found.multiplier(), found.correction()), expected):
        assert np.abs(own - other).max() < 1e-12 * np.abs(other).max()


def _resident() -> float:
    """Memory in use (MB)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads Linux's /proc")
def test_workspaces_of_large_trees_hold_no_second_derivatives() -> None:
    """Pinocchio's would take 4 nv^3 numbers each: 86 MB here."""
    model = pin.Model()
    parent = 0
    for i in range(139):
        parent = model.addJoint(parent, pin.JointModelRY(), along_x(1.0 if i else 0.0), f"j{i}")
        model.appendBodyToJoint(parent, rod(), pin.SE3.Identity())
    system = make_system(srm.Mechanism(model))
    before = _resident()
    kept = [make_kernel_system(system) for _ in range(6)]
    # What one gives back may stay with the process until the next one takes it: once, not six.
    assert _resident() - before < 2.5 * 86.0
    assert np.isfinite(kept[0].terms(0.0, np.zeros(2 * model.nv))["rate"]).all()
