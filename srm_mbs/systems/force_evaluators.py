r"""What the evaluators of force elements share: anchors, wrenches, numbers over time.

A wrench W = (f, m) in world axes about the world origin that acts on body a, and -W on body b, is

    tau = (J_a - J_b)^T W

with J the world-frame joint Jacobian: all elements between bodies are reduced to that.  Velocities
are spatial, in world axes at the world origin; that of a point p is v_lin + w x p.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import pinocchio as pin

from srm_mbs.anchors import Anchor
from srm_mbs.arrays import FloatArray
from srm_mbs.laws import Law
from srm_mbs.systems.loops import placement_numbers, support
from srm_mbs.systems.vectors import cross


class Evaluator(Protocol):
    """One element, resolved against a model.  ``data`` holds placements, velocities and J."""

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        """Add the element's generalised forces at t (s) to ``tau`` (nv,)."""

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        """Its potential energy (J); ``data`` need hold the placements only."""

    def constants(self) -> dict[str, Any]:
        """What the compiled kernel needs of it; ``kind`` numbers the kinds as forces.hpp does."""


class HeldAnchor:
    """An anchor: a frame on a body."""

    def __init__(self, model: pin.Model, anchor: Anchor) -> None:
        self.joint, self.inside = anchor.resolve(model)
        self.support = support(model, self.joint)

    def constants(self) -> tuple[int, FloatArray]:
        """Joint, and placement in its axes as numbers, for the compiled kernel."""
        return self.joint, placement_numbers(self.inside)

    def placement(self, data: pin.Data) -> pin.SE3:
        """Of the frame in the world."""
        return data.oMi[self.joint] * self.inside if self.joint else self.inside

    def velocity(self, data: pin.Data) -> pin.Motion:
        """Spatial velocity of the body, in world axes at the world origin."""
        joint = self.joint
        return data.oMi[joint].act(data.v[joint]) if joint else pin.Motion.Zero()


def about_origin(force: FloatArray, moment: FloatArray, point: FloatArray) -> FloatArray:
    """The wrench (6,) of a force at ``point`` and a moment, about the world origin."""
    return np.concatenate([force, moment + cross(point, force)])


def point_velocity(body: pin.Motion, point: FloatArray) -> FloatArray:
    """Velocity (3,) of ``point``, in world axes, that moves with ``body``."""
    out: FloatArray = body.linear + cross(body.angular, point)
    return out


class OverTime:
    """Numbers (n,) that laws multiply over time: none, one for all of them, or one for each."""

    def __init__(self, numbers: FloatArray, law: Law | Sequence[Law] | None) -> None:
        self._numbers = numbers
        laws = () if law is None else (law,) if isinstance(law, Law) else law
        self._curves = [each.curve() for each in laws]

    def at(self, t: float) -> FloatArray:
        """The numbers at t (s)."""
        if not self._curves:
            return self._numbers
        factors = [curve(t)[0] for curve in self._curves]
        return self._numbers * (factors[0] if len(factors) == 1 else np.array(factors))

    def constants(self) -> dict[str, Any]:
        """Numbers and curves, for the compiled kernel."""
        curves = [curve.constants() for curve in self._curves]
        return {"numbers": self._numbers.astype(float), "curves": curves}
