"""Cassie from its SDF file, falling freely: counts, orders of convergence, and the redundant rows.

The reference is that of the benchmark: index-1 equations from Pinocchio's kinematics by a dense
KKT solve and Gauss collocation, accurate to 2e-11.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support.bundled import problem


def error(**options: object) -> float:
    """Largest difference from the reference at the end."""
    cassie = problem("cassie")
    run = srm.simulate(cassie.mechanism, cassie.t_end, **options)
    assert run.success, run.message
    end = cassie.observe(run.q[-1:], run.v[-1:])
    return float(np.abs(end[-1] - cassie.reference.observed[-1]).max())


def test_cassie_floats_with_twelve_rows_of_which_ten_are_independent() -> None:
    mechanism = problem("cassie").mechanism
    assert mechanism.model.names[1] == "root_joint"
    assert mechanism.model.nv == 28
    assert sum(loop.rows.count for loop in mechanism.loops) == 12
    assert mechanism.structure.rank == 10
    assert mechanism.degrees_of_freedom == 18
    assert np.abs(mechanism.initial_errors[0]).max() < 1e-13
    assert np.abs(mechanism.initial_errors[1]).max() < 1e-11  # the axes are parallel to rounding
    # By Pinocchio, away from the pose: the rank of the Jacobian of the gaps between the points.
    model = mechanism.model.copy()
    rng = np.random.default_rng(3)
    start = pin.integrate(model, mechanism.q0, rng.uniform(-0.03, 0.03, model.nv))
    q = srm.assemble(mechanism.with_state(start, mechanism.v0)).q
    assert np.abs(pin.difference(model, mechanism.q0, q)).max() > 0.01
    rows = []
    for loop in mechanism.loops:
        ends = [side.resolve(model) for side in (loop.a, loop.b)]
        frames = [
            model.addFrame(pin.Frame(f"{loop.name}{i}", joint, place, pin.FrameType.OP_FRAME))
            for i, (joint, place) in enumerate(ends)
        ]
        data = model.createData()
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        one, other = (pin.getFrameJacobian(model, data, frame, world)[:3] for frame in frames)
        rows.append(one - other)
    values = np.linalg.svd(np.vstack(rows), compute_uv=False)
    assert values[9] > 1e-4
    # The axes of the right foot and of its rod are parallel to 7.4e-8 in the file, and no lever of
    # these loops is as long as 1 m.
    assert values[10] < 7.4e-8


@pytest.mark.parametrize(("tableau", "order", "steps"), [("erk4", 4, 500), ("dopr54", 5, 350)])
def test_the_fall_of_cassie_converges_with_the_order_of_the_scheme(
    tableau: str, order: int, steps: int
) -> None:
    coarse, fine = (
        error(tableau=tableau, step=problem("cassie").t_end / n) for n in (steps, 2 * steps)
    )
    assert 1e-9 < fine < 1e-5
    assert np.log2(coarse / fine) > order - 0.2


def test_the_fall_of_cassie_follows_its_tolerance() -> None:
    loose, tight = error(rtol=1e-6), error(rtol=1e-10)
    assert loose < 1e-3
    assert tight < 1e-8
