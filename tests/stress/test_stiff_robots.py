"""Published robots with damping and friction that make them stiff: work of a second of motion.

``tests/data/robots/README.md`` names their sources and licences.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.analysis.time_constants import stiff_elements

pytestmark = [pytest.mark.stress, pytest.mark.timeout(600)]

ROBOTS = Path(__file__).parents[1] / "data" / "robots"
FOLDERS = ("dm_control", "example_robot_data", "gymnasium")
"""Those with robots; the others have linkages and bodies without damping."""
FILES = sorted(
    path
    for name in FOLDERS
    for path in (ROBOTS / name).iterdir()
    if path.suffix in (".urdf", ".xml")
)
FRICTION = 2.0
"""In all joints of one coordinate (N m, N), with a friction speed of 0.01 rad/s or m/s."""
DAMPING_FACTOR = 1e3
MOST_STEPS = {1e-6: 200, 1e-9: 600}
"""By tolerance.  Explicit steps of 6 time constants would be up to 4e8 in a second."""


def stiffened(path: Path) -> srm.Mechanism:
    """The robot with a thousand times its damping, and friction in its joints."""
    mechanism = srm.load(path)
    model = mechanism.model.copy()
    single = [joint for joint in list(model.joints)[1:] if joint.nv == 1]
    friction = np.zeros(model.nv)
    friction[[joint.idx_v for joint in single]] = FRICTION
    model.damping, model.friction = DAMPING_FACTOR * model.damping, friction
    return replace(mechanism, model=model, friction_speed=0.01)


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_the_work_of_a_stiff_robot_does_not_grow_with_its_stiffness(path: Path) -> None:
    mechanism = stiffened(path)
    random = np.random.default_rng(1).standard_normal(mechanism.model.nv)
    v0 = mechanism.v0 if mechanism.loops else random
    loose, tight = (srm.simulate(mechanism, 1.0, v0=v0, rtol=rtol) for rtol in MOST_STEPS)
    # Closures between links, and laws that they share, are differentiated by evaluations.
    each = 13 + 3 * mechanism.model.nv * bool(mechanism.loops)
    for run, most in zip((loose, tight), MOST_STEPS.values()):
        assert run.success, run.message
        tried = run.stats.steps + run.stats.rejected
        assert tried < most
        assert run.stats.evaluations < each * (tried + 1)
    apart = pin.difference(mechanism.model, loose.q[-1], tight.q[-1])
    assert np.abs(apart).max() < 1e-4


def test_most_of_them_are_stiff() -> None:
    stiff = [path for path in FILES if stiff_elements(stiffened(path))]
    assert len(stiff) > 0.8 * len(FILES)
