"""Derivatives of recorded expressions, and those of the terms of mechanisms, which Pinocchio and
differences have as well."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.integration.generated.differentiation import (
    Direction,
    count_derivatives,
    derivatives,
)
from srm_mbs.integration.generated.expressions import Expression, Recorder
from srm_mbs.integration.generated.frames import shortest_terms
from srm_mbs.integration.generated.structure import structure_of
from tests.support.bundled import load
from tests.support.dynamics import mass_matrix, nonlinear_effects, states_around
from tests.support.generated import values_of
from tests.support.mechanisms import rod


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture
def x(recorder: Recorder) -> Expression:
    return recorder.leaf("q[0]")


def test_each_operation_has_its_derivative(recorder: Recorder, x: Expression) -> None:
    call = recorder.call
    cases: list[tuple[Expression, Callable[[float], float]]] = [
        (x * x + 3.0 * x, lambda t: 2.0 * t + 3.0),
        (1.0 - x * x * x, lambda t: -3.0 * t * t),
        ((2.0 + x) / (x * x), lambda t: -1.0 / t**2 - 4.0 / t**3),
        (call("sqrt", 1.0 + x * x), lambda t: t / math.sqrt(1.0 + t * t)),
        (call("sin", x * x), lambda t: 2.0 * t * math.cos(t * t)),
        (call("cos", 2.0 * x), lambda t: -2.0 * math.sin(2.0 * t)),
        (-call("fabs", x), lambda t: -math.copysign(1.0, t)),
        (call("fmax", x, recorder.zero), lambda t: float(t > 0.0)),
        (call("fmin", x * x, recorder.one), lambda t: 2.0 * t if t * t < 1.0 else 0.0),
        (
            recorder.choose(call("fmax", x, recorder.zero), x * x, -x),
            lambda t: 2.0 * t if t > 0.0 else -1.0,
        ),
    ]
    (found,) = derivatives([value for value, _ in cases], [{x: recorder.one}])
    for t in (-1.7, -0.4, 0.3, 2.1):
        for (_, expected), own in zip(cases, values_of(found, {x: t})):
            assert own == pytest.approx(expected(t), rel=1e-14)


def test_what_does_not_move_has_no_derivative(recorder: Recorder, x: Expression) -> None:
    y = recorder.leaf("q[1]")
    still = recorder.call("sin", y)
    assert derivatives([still, still * x], [{x: recorder.one}]) == [[recorder.zero, still]]
    assert count_derivatives([still * x], [{x: recorder.one}, {y: recorder.one}]) == 3


NAMES = ("M", "nle", "g", "bias", "G")


class _Terms:
    """The recorded terms of a mechanism without laws over time, and their derivatives by q and v,
    as arrays of numbers."""

    def __init__(self, mechanism: srm.Mechanism) -> None:
        self.mechanism, self.system = mechanism, make_system(mechanism)
        constants = self.system.constants()
        self.structure, self.p = structure_of(mechanism.model, constants)
        self.terms = shortest_terms(self.structure).recorded
        # Forces also depend on laws that act.
        self.outputs = [o for o in self.terms.outputs if o.target.split("[")[0] in NAMES]
        self.nv, self.rows = self.structure.nv, self.structure.rows
        self.by_state = self._along([*self.terms.along_q, *self.terms.along_v])

    def _along(self, directions: list[Direction]) -> list[list[Expression]]:
        return derivatives([out.value for out in self.outputs], directions)

    def _leaves(self, q: FloatArray, v: FloatArray) -> dict[Expression, float]:
        terms = self.terms
        pairs = zip(
            [*terms.q, *terms.v, *terms.parameters], np.concatenate([q, v, self.p]).tolist()
        )
        return {leaf: value for leaf, value in pairs if leaf.text}

    def _arrays(self, values: Sequence[float]) -> dict[str, FloatArray]:
        """M, nle, g, bias and G of the values of the outputs."""
        nv, rows = self.nv, self.rows
        out = {"M": np.zeros(nv * nv), "nle": np.zeros(nv), "G": np.zeros((rows, nv))}
        out |= {"g": np.zeros(rows), "bias": np.zeros(rows)}
        for output, value in zip(self.outputs, values):
            name, *places = output.target.replace("]", "").split("[")
            out[name][tuple(map(int, places))] = value
        upper = out["M"].reshape(nv, nv)  # column by column
        return out | {"M": upper + np.tril(upper, -1).T}

    def derivatives(
        self, q: FloatArray, v: FloatArray, along: list[Direction] | None = None
    ) -> dict[str, FloatArray]:
        """Of each term, its derivatives in one more, last dimension."""
        rows = self.by_state if along is None else self._along(along)
        flat = values_of([value for row in rows for value in row], self._leaves(q, v))
        count = len(self.outputs)
        each = [self._arrays(flat[i : i + count]) for i in range(0, len(flat), count)]
        return {name: np.stack([own[name] for own in each], axis=-1) for name in each[0]}

    def rows_at(self, q: FloatArray, v: FloatArray) -> dict[str, FloatArray]:
        """g, bias and G of the reference."""
        self.system.evaluate(0.0, np.concatenate([q, v]))
        loops = self.system.loops
        return {"g": loops.g.copy(), "bias": loops.bias.copy(), "G": loops.G.copy()}


def _grouped() -> srm.Mechanism:
    """A free body with a planar, a ball and an unbounded joint after it, closed by a frame."""
    rng = np.random.default_rng(7)
    model = pin.Model()
    joint = 0
    kinds = [pin.JointModelFreeFlyer(), pin.JointModelPlanar(), pin.JointModelSpherical()]
    for i, kind in enumerate([*kinds, pin.JointModelRUBY(), pin.JointModelHX(0.3)]):
        at = pin.SE3(pin.rpy.rpyToMatrix(rng.uniform(-1, 1, 3)), rng.uniform(-1, 1, 3))
        joint = model.addJoint(joint, kind, at, f"j{i}")
        body = rod(rng.uniform(0.5, 2.0))
        body.lever = rng.uniform(-0.5, 0.5, 3)
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
        model.addBodyFrame(f"body_{i}", joint, pin.SE3.Identity(), 0)
    a = srm.Anchor("body_4", xyz=(0.3, 0.1, -0.2), rpy=(0.1, 0.2, 0.3))
    loop = srm.LoopClosure("frame", a, srm.Anchor("world", xyz=(0.2, -0.1, 0.4)))
    return srm.Mechanism(model, [loop], q0=pin.neutral(model))


MECHANISMS: dict[str, Callable[[], srm.Mechanism]] = {
    "squeezing_mechanism": lambda: load("squeezing_mechanism"),
    "bricard": lambda: load("bricard"),
    "free, planar, ball and unbounded joints": _grouped,
}


@lru_cache
def _terms_of(name: str) -> _Terms:
    return _Terms(MECHANISMS[name]())


@pytest.mark.parametrize("name", MECHANISMS)
def test_derivatives_of_the_tree_are_pinocchios(name: str) -> None:
    terms = _terms_of(name)
    model, nv = terms.mechanism.model, terms.nv
    data = model.createData()
    for q, v in states_around(terms.mechanism, 2):
        found = terms.derivatives(q, v)
        pin.computeRNEADerivatives(model, data, q, v, np.zeros(nv))
        by_q, by_v = data.dtau_dq.copy(), data.dtau_dv.copy()
        by_a = []  # d(M a)/dq of the unit vectors a
        for a in np.eye(nv):
            pin.computeRNEADerivatives(model, data, q, v, a)
            by_a.append(data.dtau_dq - by_q)
        size = max(np.abs(by_q).max(), np.abs(by_v).max())
        assert np.abs(found["nle"] - np.hstack([by_q, by_v])).max() < 1e-13 * size
        M = np.stack(by_a, axis=1)
        assert np.abs(M).max() > 0.0
        assert np.abs(found["M"][:, :, :nv] - M).max() < 1e-13 * max(size, np.abs(M).max())
        assert not found["M"][:, :, nv:].any()


@pytest.mark.parametrize("name", MECHANISMS)
def test_derivatives_of_the_rows_are_those_of_differences_along_the_chart(name: str) -> None:
    terms = _terms_of(name)
    model, nv, step = terms.mechanism.model, terms.nv, 2.0**-17
    for q, v in states_around(terms.mechanism, 2):
        found, here = terms.derivatives(q, v), terms.rows_at(q, v)
        for name_of_term, own in found.items():
            if name_of_term not in here:
                continue
            for j, d in enumerate(np.eye(nv) * step):
                by_q, by_v = (
                    (ahead[name_of_term] - behind[name_of_term]) / (2.0 * step)
                    for ahead, behind in (
                        [terms.rows_at(pin.integrate(model, q, s * d), v) for s in (1.0, -1.0)],
                        [terms.rows_at(q, v + s * d) for s in (1.0, -1.0)],
                    )
                )
                size = max(np.abs(here[name_of_term]).max(), 1.0)
                assert np.abs(own[..., j] - by_q).max() < 1e-8 * size
                assert np.abs(own[..., nv + j] - by_v).max() < 1e-8 * size
        # The rows of G are gradients, and what they change by along the motion is bias.
        G = here["G"]
        assert np.abs(found["g"][:, :nv] - G).max() < 1e-13 * np.abs(G).max()
        change = np.einsum("ijk,j,k->i", found["G"][:, :, :nv], v, v)
        assert np.abs(change - here["bias"]).max() < 1e-12 * max(np.abs(here["bias"]).max(), 1.0)


def test_derivatives_by_parameters_are_those_of_other_models() -> None:
    """M and the nonlinear effects are linear in a mass, and in gravity."""
    terms = _terms_of("bricard")
    model, structure = terms.mechanism.model, terms.structure
    leaves = terms.terms.parameters
    one = leaves[0].recorder.one
    mass = leaves[structure.motions[3].inertia.start]
    gravity = leaves[structure.gravity.start + 2]
    heavier, falling = model.copy(), model.copy()
    joint = structure.bodies.index(3)
    body = model.inertias[joint]
    heavier.inertias[joint] = pin.Inertia(body.mass + 1.0, body.lever, body.inertia)
    falling.gravity.linear = model.gravity.linear + np.array([0.0, 0.0, 1.0])
    for q, v in states_around(terms.mechanism, 2):
        found = terms.derivatives(q, v, [{mass: one}, {gravity: one}])
        M = mass_matrix(heavier, q) - mass_matrix(model, q)
        assert np.abs(found["M"][..., 0] - M).max() < 1e-13 * np.abs(M).max()
        assert not found["M"][..., 1].any()
        for i, other in enumerate((heavier, falling)):
            nle = nonlinear_effects(other, q, v) - nonlinear_effects(model, q, v)
            size = np.abs(nonlinear_effects(other, q, v)).max()
            assert np.abs(nle).max() > 1e-6
            assert np.abs(found["nle"][..., i] - nle).max() < 1e-14 * size
        assert not found["g"].any()
