"""Where a mechanism stands in the world does not matter: rounding follows its own size.

1/sigma magnifies rounding where closures are singular, so that runs through passages tell it first.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.dynamics.observables import Observables
from srm_mbs.integration.kernel import backend as kernel
from srm_mbs.integration.kernel.observables import CompiledObservables
from tests.support.bundled import finished, load, rewritten

pytestmark = pytest.mark.skipif(kernel.core is None, reason=f"no kernel: {kernel.missing}")

FAR = np.array([1024.0, -512.0, 256.0])
"""m; places with few digits are moved by it without rounding."""


def moved(mechanism: srm.Mechanism, by: FloatArray) -> srm.Mechanism:
    """The mechanism, ground and all, ``by`` (3,) m farther."""
    model = mechanism.model.copy()
    way = pin.SE3(np.eye(3), by)
    for joint in range(1, model.njoints):
        if model.parents[joint] == 0:
            model.jointPlacements[joint] = way * model.jointPlacements[joint]
    for frame in model.frames:
        if frame.parentJoint == 0 and frame.name != "universe":
            frame.placement = way * frame.placement

    def with_ground(element: Any) -> Any:
        ends = {
            end: dataclasses.replace(anchor, xyz=tuple(np.array(anchor.xyz) + by))
            for end, anchor in vars(element).items()
            if isinstance(anchor, srm.Anchor) and anchor.link == "world"
        }
        return dataclasses.replace(element, **ends)

    return dataclasses.replace(
        mechanism,
        model=model,
        loops=tuple(map(with_ground, mechanism.loops)),
        forces=tuple(map(with_ground, mechanism.forces)),
    )


@pytest.mark.parametrize("backend", ["python", "kernel", "generated"])
@pytest.mark.parametrize("rtol", [1e-6, 1e-12])
def test_passages_one_kilometre_away_are_those_near_the_origin(backend: str, rtol: float) -> None:
    mechanism = load("n_four_bar_2")
    # Near by, because the code of a mechanism at the origin has no sums with its place.
    own, far = (
        finished(moved(mechanism, by), 5.0, rtol=rtol, backend=backend) for by in (FAR / 1024, FAR)
    )
    assert len(own.crossings) == len(far.crossings) > 2
    np.testing.assert_array_equal(far.q, own.q)
    assert far.stats.evaluations == own.stats.evaluations


@pytest.mark.parametrize("backend", ["kernel", "generated"])
def test_passages_on_a_body_ten_kilometres_away_are_those_near_the_origin(
    backend: str, tmp_path: Path
) -> None:
    free = ('base = "fixed"', 'base = "floating"')
    body = ('"world"', '"body"')
    mechanism = srm.load(rewritten(tmp_path, "n_four_bar_2", free, urdf=(body,)))
    runs = []
    for away in (np.zeros(3), 10.0 * FAR):
        q = mechanism.q0.copy()
        q[:3] += away
        runs.append(finished(mechanism, 3.0, q0=q, rtol=1e-9, backend=backend))
    here, far = runs
    assert len(here.crossings) == len(far.crossings) > 0
    np.testing.assert_allclose(far.q[-1, 3:], here.q[-1, 3:], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(far.q[-1, :3] - 10.0 * FAR, here.q[-1, :3], rtol=0.0, atol=1e-9)
    assert far.stats.evaluations < 1.1 * here.stats.evaluations


def forced() -> srm.Mechanism:
    """A spatial four-bar with elements between its trees, and between them and the ground."""
    bare = load("spatial_four_bar")
    crank = srm.Anchor("crank", xyz=(0.05, 0.02, -0.03), rpy=(0.3, -0.2, 0.5))
    rocker = srm.Anchor("rocker", xyz=(0.1, 0.0, 0.02), rpy=(0.1, 0.4, -0.2))
    ground = srm.Anchor("world", xyz=(0.1, -0.2, 0.3))
    stiffness = (5.0, 6.0, 7.0, 1.0, 2.0, 3.0)
    return dataclasses.replace(
        bare,
        forces=(
            srm.SpringDamper(crank, rocker, 30.0, 2.0, 0.2, "strut"),
            srm.SpringDamper(rocker, ground, 30.0, 2.0, 0.2, "rod"),
            srm.SpringDamper(ground, rocker, 0.0, 3.0, 0.0, "damper"),
            srm.Bushing(crank, rocker, stiffness, (0.5,) * 6, "bushing"),
            srm.Bushing(ground, crank, stiffness, (0.5,) * 6, "foot"),
            srm.Wrench(rocker, (1.0, 2.0, 3.0), (0.3, 0.2, 0.1), "link", name="wrench"),
        ),
    )


@pytest.mark.parametrize("backend", ["python", "kernel", "generated"])
@pytest.mark.parametrize("tableau", ["dop853", "rodas5p"])
def test_elements_between_trees_far_away_act_as_those_of_the_reference_at_the_origin(
    backend: str, tableau: str
) -> None:
    here, t = forced(), np.linspace(0.0, 0.5, 6)
    assert list(here.model.parents).count(0) > 2  # the universe, and two trees
    options = {"t_eval": t, "rtol": 1e-9}
    expected = finished(here, 0.5, backend="python", **options)
    far = moved(here, FAR)
    found = finished(far, 0.5, method=srm.PSRM(tableau), backend=backend, **options)
    np.testing.assert_allclose(found.q, expected.q, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(found.v, expected.v, rtol=0.0, atol=1e-6)


def test_powers_energies_and_reactions_far_away_are_those_of_the_reference_at_the_origin() -> None:
    here = forced()
    far = moved(here, FAR)
    run = finished(here, 0.2, rtol=1e-9)
    t, q, v = run.t, run.q, run.v
    own, away = Observables(make_system(here)), CompiledObservables(make_system(far))
    powers = away.powers(t, q, v)
    for name, expected in own.powers(t, q, v).items():
        np.testing.assert_allclose(powers[name], expected, rtol=1e-9, atol=1e-9)
    higher = sum(body.mass for body in here.model.inertias) * -here.model.gravity.linear @ FAR
    kinetic, potential = own.energies(q, v).T
    np.testing.assert_allclose(
        away.energies(q, v).T, [kinetic, potential + higher], rtol=1e-12, atol=1e-12 * higher
    )
    mine, theirs = own.reactions(t, q, v), away.reactions(t, q, v)
    for key in ("closures", "multipliers", "joints"):
        found = getattr(theirs, key)
        for name, expected in getattr(mine, key).items():
            np.testing.assert_allclose(found[name], expected, rtol=1e-8, atol=1e-8)
