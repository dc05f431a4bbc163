"""Stiff mechanisms: a loop closed by a bushing, joints that rub, dampers that follow a motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from tests.support.reduced import G, OneDegree, regular_slider_crank

RATE = 5.0
"""Stiffness over damping of the bushing (1/s)."""
A, B = (2.0, 0.0, 0.0), (1.5, 0.0, 0.0)
"""The pin of the four-bar on the coupler and on the rocker."""


def bushed_four_bar(tau: float) -> srm.Mechanism:
    """The four-bar whose pin is a bushing with the damping 1 kg / ``tau`` (s), overdamped: its
    direction against the links turns with them."""
    open_chain = srm.load("four_bar").without_loop("pin")
    c = 1.0 / tau
    planar = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    bushing = srm.Bushing(
        a=srm.Anchor("coupler", xyz=A),
        b=srm.Anchor("rocker", xyz=B),
        stiffness=tuple(RATE * c * planar),
        damping=tuple(c * planar),
        name="pin",
    )
    return replace(open_chain, forces=(bushing,))


def guided_four_bar(tau: float) -> srm.Mechanism:
    """The four-bar with a bushing between its coupler and the ground, which damps 1 kg / ``tau``
    (s) in both directions of the plane: one more than the mechanism can move along."""
    c = 1.0 / tau
    planar = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    bushing = srm.Bushing(
        a=srm.Anchor("coupler", xyz=(1.0, 0.0, 0.0)),
        b=srm.Anchor("world", xyz=(1.0, 0.0, 1.0)),
        stiffness=tuple(RATE * c * planar),
        damping=tuple(c * planar),
        name="guide",
    )
    return replace(srm.load("four_bar"), forces=(bushing,))


BETWEEN = (0.0, 0.0, 0.0), (0.75, 0.0, 0.0)
"""Points of the coupler and of the rocker whose distance changes as the four-bar moves."""


def braced_four_bar(tau: float) -> srm.Mechanism:
    """The four-bar with a bushing between two points of coupler and rocker that damps 1 kg /
    ``tau`` (s): it pulls them to their least distance, where it has no leverage to damp."""
    c = 1.0 / tau
    planar = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    brace = srm.Bushing(
        a=srm.Anchor("coupler", xyz=BETWEEN[0]),
        b=srm.Anchor("rocker", xyz=BETWEEN[1]),
        stiffness=tuple(RATE * c * planar),
        damping=tuple(c * planar),
        name="brace",
    )
    return replace(srm.load("four_bar"), forces=(brace,))


def braced_reference(mechanism: srm.Mechanism, tau: float, times: FloatArray) -> FloatArray:
    """Angles and rates (k, 2) of its crank at ``times`` (k,) s, by LSODA on its equation of one
    degree of freedom."""
    equation = OneDegree(replace(mechanism, forces=()), "crank")
    forces = bushed_forces(mechanism, tau, *BETWEEN)

    def field(t: float, y: FloatArray) -> list[float]:
        v = equation.rates(*y)
        equation.force = forces(equation.q, v)
        return equation(t, y)

    start = [mechanism.q0[0], mechanism.v0[0]]
    run = solve_ivp(field, (0.0, times[-1]), start, "LSODA", times, rtol=1e-9, atol=1e-10)
    assert run.success
    states: FloatArray = run.y.T
    return states


def bushed_forces(
    mechanism: srm.Mechanism, tau: float, a: Any = A, b: Any = B
) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Its generalised forces at (q, v) of a bushing between the points ``a`` of the coupler and
    ``b`` of the rocker, the force in the rocker's axes by hand."""
    model = mechanism.model
    data = model.createData()
    frames = [model.getFrameId(name, pin.FrameType.BODY) for name in ("coupler", "rocker")]
    c = 1.0 / tau

    def forces(q: FloatArray, v: FloatArray) -> FloatArray:
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        points, jacobians = [], []
        for frame, at in zip(frames, (a, b)):
            J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
            arm = data.oMf[frame].rotation @ np.array(at)
            points.append(data.oMf[frame].translation + arm)
            jacobians.append(J[:3] - pin.skew(arm) @ J[3:])
        # The rocker's own point at the coupler's pin: the damper sees the motion from its axes.
        J = pin.getFrameJacobian(model, data, frames[1], pin.LOCAL_WORLD_ALIGNED)
        arm = points[0] - data.oMf[frames[1]].translation
        relative = jacobians[0] - (J[:3] - pin.skew(arm) @ J[3:])
        force = -RATE * c * (points[0] - points[1]) - c * (relative @ v)
        force[1] = 0.0
        tau_q: FloatArray = relative.T @ force
        return tau_q

    return forces


def differenced(field: Callable[[float, FloatArray], Any]) -> Callable[..., FloatArray]:
    """The Jacobian (n, n) of a field by one-sided differences.  The steps of SciPy's own grow
    without limit in coordinates on which nothing depends."""

    def jacobian(t: float, y: FloatArray) -> FloatArray:
        here = np.asarray(field(t, y))
        steps = 2.0**-26 * np.maximum(1.0, np.abs(y))
        columns = [np.asarray(field(t, y + row)) - here for row in np.diag(steps)]
        return np.column_stack(columns) / steps

    return jacobian


def by_radau(
    field: Callable[[float, FloatArray], Any], start: Any, times: Any, rtol: float = 1e-10
) -> FloatArray:
    """States (k, n) of y' = field(t, y) at ``times`` (k,) s."""
    run = solve_ivp(
        field,
        (0.0, times[-1]),
        start,
        "Radau",
        t_eval=times,
        rtol=rtol,
        atol=0.1 * rtol,
        jac=differenced(field),
    )
    assert run.success
    states: FloatArray = run.y.T
    return states


def bushed_field(mechanism: srm.Mechanism, tau: float) -> Callable[[float, FloatArray], FloatArray]:
    """The derivative of its state (q, v), from Pinocchio's aba."""
    model = mechanism.model
    data, forces = model.createData(), bushed_forces(mechanism, tau)

    def field(t: float, y: FloatArray) -> FloatArray:
        q, v = y[: model.nq], y[model.nq :]
        return np.concatenate([v, pin.aba(model, data, q, v, forces(q, v))])

    return field


def bushed_reference(mechanism: srm.Mechanism, tau: float, t_end: float) -> FloatArray:
    """Its state at ``t_end`` (s), by Radau."""
    start = np.concatenate([mechanism.q0, mechanism.v0])
    return by_radau(bushed_field(mechanism, tau), start, [t_end])[0]


def driven_reference(mechanism: srm.Mechanism, tau: float, t_end: float) -> FloatArray:
    """Positions at ``t_end`` (s) with the crank at its first speed: M_22 v_2' = f_2."""
    model = mechanism.model
    data, forces = model.createData(), bushed_forces(mechanism, tau)
    speed = mechanism.v0[0]

    def field(t: float, y: FloatArray) -> FloatArray:
        q = np.array([mechanism.q0[0] + speed * t, *y[:2]])
        v = np.array([speed, *y[2:]])
        load = forces(q, v) - pin.nonLinearEffects(model, data, q, v)
        M = pin.crba(model, data, q)
        M = np.triu(M) + np.triu(M, 1).T
        return np.concatenate([v[1:], np.linalg.solve(M[1:, 1:], load[1:])])

    start = np.concatenate([mechanism.q0[1:], mechanism.v0[1:]])
    end = by_radau(field, start, [t_end])[0]
    return np.array([mechanism.q0[0] + speed * t_end, *end[:2]])


def rubbing(name: str, friction: float, speed: float) -> srm.Mechanism:
    """A bundled mechanism with ``friction`` in all joints and the friction speed ``speed``."""
    mechanism = srm.load(name)
    model = mechanism.model.copy()
    model.friction = np.full(model.nv, friction)
    return replace(mechanism, model=model, friction_speed=speed)


def by_turns(
    mechanism: srm.Mechanism, joint: str, friction: float, times: FloatArray
) -> FloatArray:
    """Positions (k, nv) at ``times`` (k,) s of a mechanism with one degree of freedom and dry
    ``friction`` in all joints: from one turn of a joint to the next the friction is constant.

    That is the limit of F tanh(v / v_s), from which rates differ by some v_s.
    """
    equation = OneDegree(mechanism, joint)
    signs = np.sign(mechanism.v0)
    t, state = 0.0, np.array([mechanism.q0[equation.joint], mechanism.v0[equation.joint]])
    found = [np.zeros((0, len(signs)))]
    while t < times[-1]:
        equation.force = -friction * signs

        def turns(i: int, sign: float) -> Callable[[float, FloatArray], float]:
            def turn(t: float, y: FloatArray) -> float:
                return float(sign * equation.rates(*y)[i])

            turn.terminal, turn.direction = True, -1.0  # type: ignore[attr-defined]
            return turn

        run = solve_ivp(
            equation,
            (t, times[-1]),
            state,
            "DOP853",
            rtol=1e-9,
            atol=1e-10,
            events=[turns(i, sign) for i, sign in enumerate(signs)],
            dense_output=True,
        )
        assert run.success
        end = run.t[-1]
        inside = times[(times > t) & (times <= end)]
        found.append(np.array([equation.configuration(run.sol(at)[0]).copy() for at in inside]))
        t, state = end, run.y[:, -1]
        signs = np.where(np.abs(equation.rates(*state)) < 1e-7, -signs, signs)
    return np.concatenate([rows for rows in found if len(rows)])


def rubbing_slider_crank(friction: float, start: FloatArray, times: FloatArray) -> FloatArray:
    """Angles (k,) of the crank of slider_crank_regular at ``times`` (k,) s from its angle and rate
    ``start``, with dry ``friction`` (N m) in both joints: from one turn to the next it is constant.

    The rod turns against the crank by (d beta / d theta - 1) < 0 times the rate of the crank, so
    that both joints turn back at the same time.
    """

    def field(t: float, y: FloatArray) -> Any:
        s, c = np.sin(y[0]), np.cos(y[0])
        ratio = -c / (3.0 * np.sqrt(1.0 - s * s / 9.0)) - 1.0
        return regular_slider_crank(lambda rate: -direction * friction * (1.0 - ratio))(t, y)

    def turn(t: float, y: FloatArray) -> float:
        return float(direction * y[1])

    turn.terminal, turn.direction = True, -1.0  # type: ignore[attr-defined]
    t, state, direction, found = 0.0, start, float(np.sign(start[1])), []
    while t < times[-1]:
        run = solve_ivp(
            field,
            (t, times[-1]),
            state,
            "DOP853",
            times[(times > t)],
            rtol=1e-12,
            atol=1e-12,
            events=turn,
        )
        assert run.success
        found.append(run.y[0])
        if run.status == 1:
            t, state, direction = run.t_events[0][0], run.y_events[0][0] * [1.0, 0.0], -direction
        else:
            t = times[-1]
    return np.concatenate(found)


DISC = 0.5
"""Inertia (kg m2) of the disc of :func:`parallelogram_with_disc`."""


def parallelogram_with_disc(
    tau: float, rate: float
) -> tuple[srm.Mechanism, Callable[[float, FloatArray], Any], FloatArray]:
    """The parallelogram swings up from below with ``rate`` (rad/s), through its change points; a
    disc turns on the axis of its rocker, held by a spring whose damper stops it in ``tau`` (s).

    Its equations, of crank angle and disc angle, (8/3 + J) a'' + J p'' = -3 g cos a and
    J (a'' + p'') = -k p - c p', with c = J / tau and k = 50 c, and their start.
    """
    base = srm.load("parallelogram")
    model = base.model.copy()
    disc = model.addJoint(
        model.getJointId("rocker"), pin.JointModelRY(), pin.SE3.Identity(), "disc"
    )
    model.appendBodyToJoint(
        disc, pin.Inertia(1.0, np.zeros(3), DISC * np.eye(3)), pin.SE3.Identity()
    )
    model.addBodyFrame("disc", disc, pin.SE3.Identity(), 0)
    c = DISC / tau
    spring = srm.TorsionSpring("disc", stiffness=50.0 * c, damping=c)
    alike = np.array([1.0, -1.0, 1.0, 0.0])
    mechanism = srm.Mechanism(
        model, base.loops, q0=-0.5 * np.pi * alike, v0=rate * alike, forces=(spring,)
    )

    def field(t: float, y: FloatArray) -> Any:
        torque = -50.0 * c * y[1] - c * y[3]
        crank = (-3.0 * G * np.cos(y[0]) - torque) / (8.0 / 3.0)
        return [y[2], y[3], crank, torque / DISC - crank]

    return mechanism, field, np.array([-0.5 * np.pi, 0.0, rate, 0.0])


def follower(rate: float) -> tuple[srm.Mechanism, Callable[..., FloatArray]]:
    """A block of 1 kg and the force of a damper, of ``rate`` (1/s), to the motion sin t: from the
    start at rest on it, x = sin t."""
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    joint = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    model.appendBodyToJoint(joint, pin.Inertia(1.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    model.addBodyFrame("block", joint, pin.SE3.Identity(), 0)

    def force(t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        return -np.sin(t) - rate * (v - np.cos(t)) - rate * (q - np.sin(t))

    return srm.Mechanism(model, v0=[1.0]), force
