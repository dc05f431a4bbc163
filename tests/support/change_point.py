"""Four-bars next to their change points, and their motion by the conservation of energy.

The diagonal from the tip of the crank to the ground pivot of the rocker closes two triangles:

    f^2 = a^2 + g^2 - 2 a g cos(theta) = b^2 + c^2 - 2 b c cos(phi),

theta the angle of the crank (a) against the ground (g), phi that of the coupler (b) against the
rocker (c).  With half angles this is

    2 b c sin^2(phi/2) - 2 a g sin^2(theta/2) = kappa,  kappa = ((g - a)^2 - (b - c)^2) / 2,
    2 b c cos^2(phi/2) - 2 a g cos^2(theta/2) = lambda, lambda = ((b + c)^2 - (a + g)^2) / 2,

level curves without cancellation: kappa = 0 and lambda = 0 are the change points.  Each is
parametrised by a variable that turns monotonically; the time is an integral over it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import srm_mbs as srm
from tests.support.mechanisms import add_link, along_x, rod

GRAVITY = 9.81


@dataclass(frozen=True)
class AlmostChangePoint:
    """A four-bar of uniform bars of 1 kg whose coupler is longer than that of a change-point one
    by ``d``, started with the crank at ``start`` (rad) and its rate ``speed`` (rad/s)."""

    crank: float
    coupler: float
    rocker: float
    ground: float
    d: float
    start: float = 0.6
    speed: float = 10.0

    @cached_property
    def products(self) -> tuple[float, float]:
        """2 a g and 2 b c."""
        return 2.0 * self.crank * self.ground, 2.0 * (self.coupler + self.d) * self.rocker

    @cached_property
    def levels(self) -> tuple[float, float]:
        """kappa and lambda; the ideal lengths cancel exactly."""
        a, b, c, g = self.crank, self.coupler, self.rocker, self.ground
        d = (b + self.d) - b  # as the length of the coupler has it
        kappa = 0.5 * ((g - a) ** 2 - (b - c) ** 2) - 0.5 * d * (2.0 * (b - c) + d)
        lam = 0.5 * ((b + c) ** 2 - (a + g) ** 2) + 0.5 * d * (2.0 * (b + c) + d)
        return kappa, lam

    def half_angles(self, p: Any) -> tuple[Any, Any, Any, Any, Any, Any]:
        """sin and cos of theta/2 and of phi/2 and the derivatives of both angles, at p."""
        (ag, bc), (kappa, lam) = self.products, self.levels
        if kappa > 0.0 and lam > 0.0:  # the crank turns: p = theta
            st, ct = np.sin(0.5 * p), np.cos(0.5 * p)
            sf = np.sqrt((kappa + ag * st**2) / bc)
            cf = np.sqrt((lam + ag * ct**2) / bc)
            return st, ct, sf, cf, np.ones_like(st), ag * st * ct / (bc * sf * cf)
        if kappa < 0.0:  # cos(theta/2) : sin(phi/2) as sin(p) : cos(p)
            radius = np.sqrt(ag + kappa)
            ct, sf = radius * np.sin(p) / np.sqrt(ag), radius * np.cos(p) / np.sqrt(bc)
            st = np.sqrt(np.cos(p) ** 2 - kappa / ag * np.sin(p) ** 2)
            cf = np.sqrt(np.sin(p) ** 2 + lam / bc * np.cos(p) ** 2)
            along = -2.0 * radius * np.cos(p) / np.sqrt(ag) / st
            return st, ct, sf, cf, along, -2.0 * radius * np.sin(p) / np.sqrt(bc) / cf
        radius = np.sqrt(bc - kappa)  # sin(theta/2) : cos(phi/2) as sin(p) : cos(p)
        st, cf = radius * np.sin(p) / np.sqrt(ag), radius * np.cos(p) / np.sqrt(bc)
        ct = np.sqrt(np.cos(p) ** 2 - lam / ag * np.sin(p) ** 2)
        sf = np.sqrt(np.sin(p) ** 2 + kappa / bc * np.cos(p) ** 2)
        along = 2.0 * radius * np.cos(p) / np.sqrt(ag) / ct
        return st, ct, sf, cf, along, 2.0 * radius * np.sin(p) / np.sqrt(bc) / sf

    def parameter(self, theta: float, phi: float) -> float:
        """p at the two angles, up to whole turns."""
        (ag, bc), (kappa, lam) = self.products, self.levels
        if kappa > 0.0 and lam > 0.0:
            return theta
        if kappa < 0.0:
            theta, phi = theta % (2.0 * np.pi), np.remainder(phi + np.pi, 2.0 * np.pi) - np.pi
            return float(
                np.arctan2(np.sqrt(ag) * np.cos(0.5 * theta), np.sqrt(bc) * np.sin(0.5 * phi))
            )
        theta, phi = np.remainder(theta + np.pi, 2.0 * np.pi) - np.pi, phi % (2.0 * np.pi)
        return float(np.arctan2(np.sqrt(ag) * np.sin(0.5 * theta), np.sqrt(bc) * np.cos(0.5 * phi)))

    def motion(self, p: Any) -> tuple[Any, Any]:
        """Angles (3, ...) of crank, coupler and rocker against the ground, and their derivatives by
        p."""
        a, b, c, g = self.crank, self.coupler + self.d, self.rocker, self.ground
        st, ct, sf, cf, dtheta, dphi = self.half_angles(p)
        theta, phi = 2.0 * np.arctan2(st, ct), 2.0 * np.arctan2(sf, cf)
        square = (a - g) ** 2 + 4.0 * a * g * st**2
        diagonal = np.arctan2(a * np.sin(theta), a * np.cos(theta) - g)
        rocker = diagonal - np.arctan2(b * np.sin(phi), c - b * np.cos(phi))
        drocker = (a * (a - g * np.cos(theta)) * dtheta - b * (c * np.cos(phi) - b) * dphi) / square
        return np.array([theta, rocker - phi, rocker]), np.array([dtheta, drocker - dphi, drocker])

    def energies(self, p: Any) -> tuple[Any, Any]:
        """Inertia for the rate p' = 1, and potential energy."""
        a, b, c = self.crank, self.coupler + self.d, self.rocker
        (theta, chi, rho), (dtheta, dchi, drho) = self.motion(p)
        vx = -a * np.sin(theta) * dtheta - 0.5 * b * np.sin(chi) * dchi
        vy = a * np.cos(theta) * dtheta + 0.5 * b * np.cos(chi) * dchi
        inertia = (a * dtheta) ** 2 / 3.0 + vx**2 + vy**2
        inertia += (b * dchi) ** 2 / 12.0 + (c * drho) ** 2 / 3.0
        height = 1.5 * a * np.sin(theta) + 0.5 * b * np.sin(chi) + 0.5 * c * np.sin(rho)
        return inertia, GRAVITY * height

    @cached_property
    def begin(self) -> tuple[float, float, float]:
        """p and p' at the start, and the energy."""
        (ag, bc), (kappa, _) = self.products, self.levels
        sf = np.sqrt((kappa + ag * np.sin(0.5 * self.start) ** 2) / bc)
        p = self.parameter(self.start, 2.0 * float(np.arcsin(sf)))
        rate = self.speed / float(self.motion(p)[1][0])
        inertia, potential = self.energies(np.array(p))
        return p, rate, float(0.5 * inertia * rate**2 + potential)

    def mechanism(self) -> srm.Mechanism:
        """The four-bar in its initial state."""
        model = pin.Model()
        model.name = "four_bar"
        model.gravity.linear = np.array([0.0, -GRAVITY, 0.0])
        lengths = self.crank, self.coupler + self.d, self.rocker
        crank = add_link(model, 0, pin.JointModelRZ(), "crank", rod(length=lengths[0]))
        at = along_x(lengths[0])
        add_link(model, crank, pin.JointModelRZ(), "coupler", rod(length=lengths[1]), at)
        at = along_x(self.ground)
        add_link(model, 0, pin.JointModelRZ(), "rocker", rod(length=lengths[2]), at)
        tips = (
            srm.Anchor(name, xyz=(length, 0.0, 0.0))
            for name, length in zip(("coupler", "rocker"), lengths[1:])
        )
        p, rate, _ = self.begin
        angles, slopes = self.motion(p)
        q = np.array([angles[0], angles[1] - angles[0], angles[2]])
        v = rate * np.array([slopes[0], slopes[1] - slopes[0], slopes[2]])
        return srm.Mechanism(model, (srm.LoopClosure("point", *tips),), q0=q, v0=v)

    def time(self, end: float) -> float:
        """Time (s) from the start to p = ``end``, in the direction of the motion."""
        p, _, energy = self.begin
        low, high = sorted((p, end))
        width = min(np.sqrt(abs(x)) for x in self.levels if x != 0.0)
        quarters = 0.5 * np.pi * np.arange(np.floor(2.0 * low / np.pi), 2.0 * high / np.pi + 1.0)
        graded = 0.75 * 0.6 ** np.arange(0, 5 + max(0, int(2.0 * np.log(1.0 / width))))
        edges = np.concatenate([(quarters[:, None] + s * graded).ravel() for s in (-1.0, 1.0)])
        edges = np.unique(np.concatenate([edges, quarters, [low, high]]))
        edges = edges[(edges >= low) & (edges <= high)]
        x, w = np.polynomial.legendre.leggauss(16)
        middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
        inertia, potential = self.energies(middle[:, None] + half[:, None] * x)
        return float(half @ (np.sqrt(inertia / (2.0 * (energy - potential))) @ w))

    def error(self, solution: srm.Solution) -> float:
        """Largest error of angles and rates at the end of a run: of the angles and rates there for
        the value of p, and of the time, times the rates."""
        start, rate, energy = self.begin
        sign = np.sign(rate)
        q, v, t = solution.q[-1], solution.v[-1], float(solution.t[-1])
        angles = np.array([q[0], q[0] + q[1], q[2]])
        rates = np.array([v[0], v[0] + v[1], v[2]])
        p = self.parameter(float(angles[0]), float(angles[2] - angles[1]))
        if not (self.levels[0] > 0.0 and self.levels[1] > 0.0):  # p is known up to whole turns
            turn = sign * 2.0 * np.pi
            p += turn * np.ceil((start - p) / turn)
            while self.time(p + 0.5 * turn) < t:
                p += turn
        exact, slopes = self.motion(p)
        inertia, potential = self.energies(np.array(p))
        speed = sign * np.sqrt(2.0 * (energy - float(potential)) / float(inertia))
        off = np.remainder(angles - exact + np.pi, 2.0 * np.pi) - np.pi
        late = (self.time(p) - t) * np.abs(speed * slopes)
        return float(max(np.abs(part).max() for part in (off, late, rates - speed * slopes)))


CHANGE_POINTS = {"folded": (1.0, 2.0, 2.5, 1.5), "parallelogram": (1.0, 2.0, 1.0, 2.0)}
"""Lengths of crank, coupler, rocker and ground: one and two change points a turn."""


@dataclass(frozen=True)
class StraightOn(AlmostChangePoint):
    """The motion of the four-bar with d = 0 straight through the change point at theta = 0, where
    sin(phi/2) = ``side`` sqrt(a g/(b c)) sin(theta/2); p is theta, from -pi to pi."""

    d: float = 0.0
    side: float = 1.0

    def half_angles(self, p: Any) -> tuple[Any, Any, Any, Any, Any, Any]:
        (ag, bc), (_, lam) = self.products, self.levels
        st, ct = np.sin(0.5 * p), np.cos(0.5 * p)
        sf = self.side * np.sqrt(ag / bc) * st
        cf = np.sqrt((lam + ag * ct**2) / bc)
        return st, ct, sf, cf, np.ones_like(st), self.side * np.sqrt(ag / bc) * ct / cf

    def joints(self, p: float, rate: float) -> tuple[Any, Any]:
        """q and v at theta = p and its rate."""
        angles, slopes = self.motion(np.array(p))
        q, v = (np.array([x[0], x[1] - x[0], x[2]]) for x in (angles, slopes))
        return q, rate * v

    def after(self, p: float, kinetic: float, heading: float, t: float) -> tuple[Any, Any]:
        """q and v a time ``t`` (s) after theta = p, with that kinetic energy and sign of theta'."""
        energy = kinetic + float(self.energies(np.array(p))[1])

        def field(_: float, y: Any) -> Any:
            inertia, potential = self.energies(y)
            return heading * np.sqrt(2.0 * (energy - potential) / inertia)

        run = solve_ivp(field, (0.0, t), [p], method="DOP853", rtol=1e-12, atol=1e-13)
        return self.joints(float(run.y[0, -1]), float(field(t, run.y[:, -1])[0]))

    @classmethod
    def of(cls, name: str, q: Any) -> StraightOn:
        """That of :data:`CHANGE_POINTS` whose branch is the nearer one at q."""
        theta, phi = turned(q[0]), turned(q[2] - q[0] - q[1])
        return cls(*CHANGE_POINTS[name], side=float(np.sign(theta * phi)))


def turned(angle: Any) -> Any:
    """The angle but for whole turns, between -pi and pi."""
    return np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi
