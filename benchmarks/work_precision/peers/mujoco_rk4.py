"""MuJoCo with RK4 and equality constraints of nearly full impedance.

The same tree as XML: bodies, inertias and joints one to one, every closure a ``connect`` between
sites.  MuJoCo's constraints are soft.  Two kinds of variant: as shipped, with the largest impedance
and a time constant of two steps (the shortest it allows); and hardened, with the inverse weights
from which MuJoCo sets the softness scaled down and the time constant of a Baumgarte rate, which is
far more accurate.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from benchmarks.work_precision.peers.base import (
    Array,
    Budget,
    NotApplicableError,
    Outcome,
    Peer,
    Run,
    RunFailedError,
    Runner,
    Setting,
    gain_variants,
    step_sweep,
)
from benchmarks.work_precision.peers.pinocchio_rk4 import EVERYDAY_SUBSTEPS
from benchmarks.work_precision.problems.base import SAMPLES, Problem
from benchmarks.work_precision.trees import Tree

SMALLEST_MASS = 1e-12
"""kg and kg m^2 of massless bodies: MuJoCo refuses zero."""
IMPEDANCE = "0.9999 0.9999 0.001 0.5 2"
AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
HARDENED = 1e-6
"""Factor on the inverse weights of bodies, and so on the softness of the closures."""
SHIPPED = ("as shipped, time constant 2 h", 0.0)


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)


def _joint(tree: Tree, index: int) -> str:
    model = tree.model
    joint = model.joints[index]
    kind = joint.shortname().removeprefix("JointModel")
    name = model.names[index]
    if kind == "FreeFlyer":
        return f'<freejoint name="{name}"/>'
    if kind in ("RevoluteUnaligned", "PrismaticUnaligned"):
        letter, axis = kind[0], _axis_of(model, index)
    elif len(kind) == 2 and kind[0] in "RP" and kind[1] in AXES:
        letter, axis = kind[0], AXES[kind[1]]
    else:
        raise NotApplicableError(f"no translation of a {kind} joint to MuJoCo")
    sort = "hinge" if letter == "R" else "slide"
    damping = float(model.damping[joint.idx_v])
    springs = "".join(
        f'stiffness="{spring.stiffness!r}" springref="{spring.rest!r}" '
        for spring in tree.torsion
        if spring.joint == index
    )
    return (
        f'<joint name="{name}" type="{sort}" axis="{_numbers(axis)}" damping="{damping!r}" '
        f'{springs}limited="false"/>'
    )


def _axis_of(model: pin.Model, index: int) -> Array:
    """Axis of a one-degree joint, from its motion at unit rate."""
    joint = model.joints[index]
    v = np.zeros(model.nv)
    v[joint.idx_v] = 1.0
    data = model.createData()
    pin.forwardKinematics(model, data, pin.neutral(model), v)
    motion = data.v[index] - data.liMi[index].actInv(data.v[model.parents[index]])
    kind = joint.shortname()
    return motion.linear if "Prismatic" in kind else motion.angular


def _body(tree: Tree, index: int, sites: dict[int, list[str]]) -> str:
    model = tree.model
    placement = model.jointPlacements[index]
    x, y, z, w = pin.Quaternion(placement.rotation).coeffs()
    inertia = model.inertias[index]
    mass = max(float(inertia.mass), SMALLEST_MASS)
    I = np.array(inertia.inertia) if inertia.mass > 0.0 else SMALLEST_MASS * np.eye(3)  # noqa: E741
    full = (I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2])
    children = [j for j in range(index + 1, model.njoints) if model.parents[j] == index]
    return "\n".join(
        [
            f'<body name="{model.names[index]}" pos="{_numbers(placement.translation)}" '
            f'quat="{_numbers((w, x, y, z))}">',
            _joint(tree, index),
            f'<inertial pos="{_numbers(inertia.lever)}" mass="{mass!r}" '
            f'fullinertia="{_numbers(full)}"/>',
            *sites.get(index, []),
            *(_body(tree, child, sites) for child in children),
            "</body>",
        ]
    )


def xml(tree: Tree) -> str:
    """The tree in MuJoCo's format, closures and springs included."""
    model = tree.model
    sites: dict[int, list[str]] = {}
    equalities, tendons = [], []
    for k, closure in enumerate(tree.closures):
        for side, joint, at in (("a", closure.a, closure.in_a), ("b", closure.b, closure.in_b)):
            sites.setdefault(joint, []).append(f'<site name="{side}{k}" pos="{_numbers(at)}"/>')
        equalities.append(f'<connect site1="a{k}" site2="b{k}" solimp="{IMPEDANCE}"/>')
    for k, spring in enumerate(tree.springs):
        for side, joint, at in (("s", spring.joint, spring.at), ("t", 0, spring.ground)):
            sites.setdefault(joint, []).append(f'<site name="{side}{k}" pos="{_numbers(at)}"/>')
        tendons.append(
            f'<spatial stiffness="{spring.stiffness!r}" springlength="{spring.rest!r}">'
            f'<site site="s{k}"/><site site="t{k}"/></spatial>'
        )
    roots = [j for j in range(1, model.njoints) if model.parents[j] == 0]
    bodies = "\n".join(_body(tree, root, sites) for root in roots)
    return (
        f'<mujoco><compiler angle="radian" balanceinertia="false" boundmass="0"/>'
        f'<option integrator="RK4" gravity="{_numbers(model.gravity.linear)}" solver="Newton" '
        'iterations="100" tolerance="0" ls_tolerance="1e-12"/>'
        f"<worldbody>{''.join(sites.get(0, []))}{bodies}</worldbody>"
        f"<tendon>{''.join(tendons)}</tendon>"
        f"<equality>{''.join(equalities)}</equality></mujoco>"
    )


class MujocoRK4(Peer):
    """Steps through ``mj_step``; the loop between two samples is MuJoCo's own."""

    name = "mujoco"
    title = "MuJoCo RK4"
    modules = ("mujoco",)

    def settings(self, problem: Problem) -> Sequence[Setting]:
        hardened = [(f"hardened, {name}", gain) for name, gain in gain_variants(problem)]
        return step_sweep(problem, variants=[SHIPPED, *hardened])

    def everyday(self, problem: Problem) -> Setting:
        step = problem.t_end / SAMPLES / EVERYDAY_SUBSTEPS
        return Setting("step", step, *SHIPPED, EVERYDAY_SUBSTEPS)

    def prepare(self, problem: Problem) -> Runner:
        import mujoco

        tree = problem.tree
        flat = tree.flat
        model = mujoco.MjModel.from_xml_string(xml(tree))
        data = mujoco.MjData(model)
        # Warnings are looked for after the run; by default they go to a file as well.
        mujoco.set_mju_user_warning(lambda message: None)
        weights = model.body_invweight0.copy()
        if flat:
            start = tree.q0, tree.v0
        else:
            q, v = tree.q0.copy(), tree.v0.copy()
            v[:3] = pin.Quaternion(q[3:7]).matrix() @ v[:3]
            q[3:7] = q[[6, 3, 4, 5]]
            start = q, v

        def states(positions: Array, velocities: Array) -> tuple[Array, Array]:
            if flat:
                return positions, velocities
            q, v = positions.copy(), velocities.copy()
            q[:, 3:7] = positions[:, [4, 5, 6, 3]]
            for i, x in enumerate(q):
                v[i, :3] = pin.Quaternion(x[3:7]).matrix().T @ velocities[i, :3]
            return q, v

        def at(setting: Setting) -> Run:
            def run() -> Outcome:
                model.opt.timestep = setting.value
                gain = setting.gain
                model.eq_solref[:] = (1.0 / gain if gain else 2.0 * setting.value, 1.0)
                model.body_invweight0[:] = weights * (HARDENED if gain else 1.0)
                mujoco.mj_resetData(model, data)
                data.qpos[:], data.qvel[:] = start
                if tree.torque is not None:
                    data.qfrc_applied[:] = tree.torque
                budget = Budget()
                positions = np.empty((SAMPLES, model.nq))
                velocities = np.empty((SAMPLES, model.nv))
                for i in range(SAMPLES):
                    mujoco.mj_step(model, data, setting.substeps)
                    budget.tick(4 * setting.substeps)
                    positions[i], velocities[i] = data.qpos, data.qvel
                if not np.isfinite(positions).all() or data.warning.number.any():
                    raise RunFailedError("the state is no longer finite")
                return Outcome(
                    budget.count, budget.count // 4, lambda: states(positions, velocities)
                )

            return run

        return at
