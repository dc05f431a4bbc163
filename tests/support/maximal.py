"""Mechanisms in maximal coordinates: each bar moves in the plane on its own, all pins are closures.

The same motions as the bundled slider_crank and parallelogram, whose trees leave one closure each;
in the x-y plane, gravity along -y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from tests.support.mechanisms import add_link, rod

JOINTS = ("planar", "chain")
"""One planar joint for each bar (nq != nv), or two prismatic joints and a revolute one."""
_AXIS = (0.0, 0.0, 1.0)
_GROUND = srm.Anchor("world")


@dataclass(frozen=True)
class Bar:
    """A uniform bar from ``origin`` (m) at ``angle`` (rad), with their rates."""

    name: str
    mass: float
    length: float
    origin: tuple[float, float]
    angle: float
    origin_rate: tuple[float, float] = (0.0, 0.0)
    rate: float = 0.0

    @property
    def tip(self) -> srm.Anchor:
        return srm.Anchor(self.name, xyz=(self.length, 0.0, 0.0))


def _mechanism(
    name: str, joints: str, bars: Sequence[Bar], loops: Sequence[srm.LoopClosure]
) -> srm.Mechanism:
    model = pin.Model()
    model.name = name
    model.gravity.linear = np.array([0.0, -9.81, 0.0])
    q, v = [], []
    for bar in bars:
        here, moving = np.array(bar.origin), np.array(bar.origin_rate)
        c, s = np.cos(bar.angle), np.sin(bar.angle)
        if joints == "planar":
            parent, joint = 0, pin.JointModelPlanar()
            q += [*here, c, s]
            v += [*(np.array([[c, s], [-s, c]]) @ moving), bar.rate]  # in the bar's axes
        else:
            x = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), f"{bar.name}_x")
            parent = model.addJoint(x, pin.JointModelPY(), pin.SE3.Identity(), f"{bar.name}_y")
            joint = pin.JointModelRZ()
            q += [*here, bar.angle]
            v += [*moving, bar.rate]
        add_link(model, parent, joint, bar.name, rod(bar.mass, bar.length))
    return srm.Mechanism(model, tuple(loops), q0=np.array(q), v0=np.array(v))


def slider_crank(joints: str, angle: float = 7 * np.pi / 4, rate: float = 0.0) -> srm.Mechanism:
    """The bundled slider_crank (:func:`tests.support.reduced.slider_crank`)."""
    c, s = np.cos(angle), np.sin(angle)
    crank = Bar("crank", 1.0, 2.0, (0.0, 0.0), angle, rate=rate)
    tip, moving = (2.0 * c, 2.0 * s), (-2.0 * s * rate, 2.0 * c * rate)
    rod_ = Bar("rod", 1.0, 2.0, tip, -angle, moving, -rate)
    loops = (
        srm.LoopClosure("revolute", srm.Anchor("crank"), _GROUND, _AXIS, "ground"),
        srm.LoopClosure("revolute", srm.Anchor("rod"), crank.tip, _AXIS, "knee"),
        srm.LoopClosure("point_on_plane", rod_.tip, _GROUND, (0.0, 1.0, 0.0), "slide"),
    )
    return _mechanism("slider_crank", joints, (crank, rod_), loops)


def parallelogram(joints: str, angle: float = 1.0, rate: float = 6.0) -> srm.Mechanism:
    """The bundled parallelogram (:func:`tests.support.reduced.parallelogram`)."""
    c, s = np.cos(angle), np.sin(angle)
    crank = Bar("crank", 1.0, 1.0, (0.0, 0.0), angle, rate=rate)
    coupler = Bar("coupler", 2.0, 2.0, (c, s), 0.0, (-s * rate, c * rate))
    rocker = Bar("rocker", 1.0, 1.0, (2.0, 0.0), angle, rate=rate)
    right = srm.Anchor("world", xyz=(2.0, 0.0, 0.0))
    loops = (
        srm.LoopClosure("revolute", srm.Anchor("crank"), _GROUND, _AXIS, "left"),
        srm.LoopClosure("revolute", srm.Anchor("coupler"), crank.tip, _AXIS, "top_left"),
        srm.LoopClosure("revolute", coupler.tip, rocker.tip, _AXIS, "top_right"),
        srm.LoopClosure("revolute", srm.Anchor("rocker"), right, _AXIS, "right"),
    )
    return _mechanism("parallelogram", joints, (crank, coupler, rocker), loops)
