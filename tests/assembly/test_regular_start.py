"""Starts that the kernel finds next to closed and regular guesses, against those of the search."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.assembly import assemble
from srm_mbs.assembly.regular_start import bodies_at_start, regular_start
from srm_mbs.dynamics.scaling import coordinate_units, scene_diagonal
from tests.support.backends import needs_kernel
from tests.support.bundled import load

pytestmark = needs_kernel

NEARLY_CLOSED = 1e-13
"""Size (rad, m) of the motions that open the loops of a guess a little."""


def found_and_searched(
    mechanism: srm.Mechanism, monkeypatch: pytest.MonkeyPatch, **given: Any
) -> tuple[srm.Assembly, srm.Assembly]:
    """The assembly with the kernel's start, which there is, and the one without."""
    starts = []

    def kept(*request: Any) -> tuple[FloatArray, FloatArray] | None:
        starts.append(regular_start(*request))
        return starts[-1]

    with monkeypatch.context() as patch:
        patch.setattr(assemble, "regular_start", kept)
        found = srm.assemble(mechanism, **given)
        patch.setattr(assemble, "regular_start", lambda *_: None)
        searched = srm.assemble(mechanism, **given)
    assert starts[0] is not None
    return found, searched


@pytest.mark.parametrize(
    "name", ["klann_walker", "delta_robot", "differential", "watt_six_bar", "squeezing_mechanism"]
)
def test_a_start_next_to_a_closed_guess_is_that_of_the_search(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mechanism = load(name)
    rng = np.random.default_rng(1)
    given = {
        "q": mechanism.q0 + NEARLY_CLOSED * rng.uniform(-1.0, 1.0, mechanism.model.nq),
        "v": rng.uniform(-1.0, 1.0, mechanism.model.nv),
    }
    found, searched = found_and_searched(mechanism, monkeypatch, **given)
    np.testing.assert_allclose(found.q, searched.q, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(found.v, searched.v, rtol=0.0, atol=1e-12)
    assert np.abs(found.residuals).max() < 1e-15 + 0.5 * np.abs(searched.residuals).max()
    assert not found.singular


def test_units_at_a_start_are_those_of_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    by_kernel = load("stewart_platform")
    with monkeypatch.context() as patch:
        patch.setattr(assemble, "regular_start", lambda *_: None)
        reference = srm.load("stewart_platform")
    own, other = (coordinate_units(m, m.q0, m.v0) for m in (by_kernel, reference))
    np.testing.assert_allclose(own.state, other.state, rtol=1e-14)
    np.testing.assert_allclose(own.length, other.length, rtol=1e-14)


@pytest.mark.parametrize("name", ["klann_walker", "delta_robot", "watt_six_bar"])
def test_inertias_and_gyrations_at_a_start_are_those_of_its_mass_matrix_and_bodies(
    name: str,
) -> None:
    mechanism = load(name)
    model = mechanism.model
    state = regular_start(mechanism, mechanism.q0, mechanism.v0, (), ())
    found = bodies_at_start(mechanism)
    assert state is not None
    assert found is not None
    M = np.triu(pin.crba(model, model.createData(), state[0]))
    M += np.triu(M, 1).T
    scaled = M / np.sqrt(np.outer(M.diagonal(), M.diagonal()))
    # What is left of each inertia if all joints behind it in the order are free.
    left = [1.0 / np.linalg.inv(scaled[k:, k:])[0, 0] for k in range(model.nv)]
    assert found.least_inertia == pytest.approx(min(left), rel=1e-9)
    reaches = [[np.linalg.norm(body.lever)] for body in model.inertias]
    ends = [end for loop in mechanism.loops for end in loop.resolve(model)]
    ends += [(model.parents[i], model.jointPlacements[i]) for i in range(1, model.njoints)]
    for joint, placed in ends:
        reaches[joint].append(np.linalg.norm(placed.translation))
    moving = [(body, max(own)) for body, own in list(zip(model.inertias, reaches))[1:] if body.mass]
    radii = [np.sqrt(0.5 * np.trace(body.inertia) / body.mass) for body, _ in moving]
    sizes = [radius / size for radius, (_, size) in zip(radii, moving)]
    scene = scene_diagonal(mechanism, mechanism.q0)
    assert found.least_gyration == pytest.approx(min(sizes), rel=1e-12)
    assert found.largest_gyration == pytest.approx(max(radii) / scene, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "why"), [("five_bar", "open guess"), ("bricard", "dependent rows")]
)
def test_other_guesses_are_left_to_the_search(name: str, why: str) -> None:
    mechanism = load(name)
    opened = mechanism.q0 + (0.1 if why == "open guess" else 0.0)
    assert regular_start(mechanism, opened, mechanism.v0, (), ()) is None, why


def test_threads_may_assemble_one_mechanism_at_once() -> None:
    mechanism = load("klann_walker")
    crank = mechanism.joint_names[0]

    def start(speed: float) -> FloatArray:
        return srm.assemble(mechanism, mechanism.q0, {crank: speed}).v

    speeds = np.linspace(1.0, 20.0, 60).tolist()
    alone = [start(speed) for speed in speeds]
    with ThreadPoolExecutor(4) as threads:
        for one, other in zip(alone, threads.map(start, speeds), strict=True):
            np.testing.assert_array_equal(one, other)
