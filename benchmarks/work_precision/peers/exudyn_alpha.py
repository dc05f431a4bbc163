"""Exudyn: rigid bodies in the plane with joints, index-3 generalised-alpha.

The peers' tree becomes one ``RigidBody2D`` for every body with mass, in redundant coordinates, and
one revolute joint for every hinge and closure; a massless slider becomes a joint that keeps a point
on a line.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from benchmarks.work_precision.peers.base import (
    Array,
    NotApplicableError,
    Outcome,
    Peer,
    Run,
    RunFailedError,
    Runner,
    Setting,
    step_sweep,
)
from benchmarks.work_precision.peers.pinocchio_rk4 import EVERYDAY_SUBSTEPS
from benchmarks.work_precision.problems.base import SAMPLES, Problem
from benchmarks.work_precision.trees import Tree

SPECTRAL_RADIUS = 0.9
DENSE_BODIES = 8
"""Bodies up to which the dense linear solver, Exudyn's default, is the faster one."""
SUBSTEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


class _Plane:
    """Projects a planar tree to the two world axes it moves in; angles turn first to second."""

    def __init__(self, tree: Tree, axes: tuple[int, int]) -> None:
        self.tree, self.axes = tree, list(axes)
        self.normal = np.cross(np.eye(3)[axes[0]], np.eye(3)[axes[1]])
        model = tree.model
        self.data = model.createData()
        pin.forwardKinematics(model, self.data, tree.q0, tree.v0)
        self.massive = [j for j in range(1, model.njoints) if model.inertias[j].mass > 0.0]
        self.sign: dict[int, float] = {}
        for j in range(1, model.njoints):
            kind = model.joints[j].shortname()
            if "JointModelP" in kind:
                continue
            unit = np.zeros(model.nv)
            unit[model.joints[j].idx_v] = 1.0
            still = model.createData()
            pin.forwardKinematics(model, still, tree.q0, unit)
            omega = still.oMi[j].rotation @ still.v[j].angular
            self.sign[j] = float(np.sign(omega @ self.normal))

    def local(self, joint: int, point: Array) -> list[float]:
        """A point of a joint, relative to its centre of mass, in body axes that are the plane's
        at the start; of the ground: world coordinates."""
        world = self.data.oMi[joint].act(np.asarray(point, dtype=float))
        if joint:
            world = world - self.data.oMi[joint].act(self.tree.model.inertias[joint].lever)
        return [*(float(x) for x in world[self.axes]), 0.0]

    def start(self, joint: int) -> tuple[list[float], list[float]]:
        """Position and velocity of the centre of mass, angle and rate."""
        placement, v = self.data.oMi[joint], self.data.v[joint]
        lever = self.tree.model.inertias[joint].lever
        centre = placement.act(lever)
        velocity = placement.rotation @ (v.linear + np.cross(v.angular, lever))
        rate = float(placement.rotation @ v.angular @ self.normal)
        return (
            [*(float(x) for x in centre[self.axes]), 0.0],
            [*(float(x) for x in velocity[self.axes]), rate],
        )

    def inertia(self, joint: int) -> float:
        """Moment of inertia (kg m^2) about the plane's normal, at the centre of mass."""
        R = self.data.oMi[joint].rotation
        return float(self.normal @ R @ self.tree.model.inertias[joint].inertia @ R.T @ self.normal)


class ExudynAlpha(Peer):
    """Planar problems only."""

    name = "exudyn"
    title = "Exudyn generalised-alpha"
    modules = ("exudyn",)

    def settings(self, problem: Problem) -> Sequence[Setting]:
        return step_sweep(problem, SUBSTEPS)

    def everyday(self, problem: Problem) -> Setting:
        step = problem.t_end / SAMPLES / EVERYDAY_SUBSTEPS
        return Setting("step", step, substeps=EVERYDAY_SUBSTEPS)

    def prepare(self, problem: Problem) -> Runner:
        if problem.planar is None:
            raise NotApplicableError("only planar problems have been written for Exudyn")
        import exudyn
        from exudyn import itemInterface as items  # noqa: N813
        from exudyn.utilities import SensorNode

        tree = problem.tree
        model = tree.model
        plane = _Plane(tree, problem.planar)
        container = exudyn.SystemContainer()
        system: Any = container.AddSystem()
        ground = system.AddObject(items.ObjectGround())
        bodies, sensors = {0: ground}, {}
        gravity = model.gravity.linear[plane.axes]
        for j in plane.massive:
            position, velocity = plane.start(j)
            mass = float(model.inertias[j].mass)
            node = system.AddNode(
                items.NodeRigidBody2D(referenceCoordinates=position, initialVelocities=velocity)
            )
            bodies[j] = system.AddObject(
                items.ObjectRigidBody2D(mass=mass, inertia=plane.inertia(j), nodeNumber=node)
            )
            centre = system.AddMarker(items.MarkerBodyMass(bodyNumber=bodies[j]))
            system.AddLoad(
                items.LoadMassProportional(markerNumber=centre, loadVector=[*gravity.tolist(), 0.0])
            )
            if tree.torque is not None and tree.torque[model.joints[j].idx_v]:
                if model.parents[j] != 0:
                    raise NotApplicableError("a torque between two moving bodies")
                rigid = system.AddMarker(
                    items.MarkerBodyRigid(bodyNumber=bodies[j], localPosition=[0, 0, 0])
                )
                moment = plane.sign[j] * float(tree.torque[model.joints[j].idx_v])
                system.AddLoad(
                    items.LoadTorqueVector(markerNumber=rigid, loadVector=[0, 0, moment])
                )
            sensors[j] = [
                system.AddSensor(
                    SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=kind)
                )
                for kind in (
                    exudyn.OutputVariableType.Coordinates,
                    exudyn.OutputVariableType.Coordinates_t,
                )
            ]

        def marker(joint: int, point: Array, kind: Any = items.MarkerBodyPosition) -> Any:
            return system.AddMarker(
                kind(bodyNumber=bodies[joint], localPosition=plane.local(joint, point))
            )

        sliders: dict[int, int] = {}
        for j in range(1, model.njoints):
            parent, placement = model.parents[j], model.jointPlacements[j]
            if j not in bodies:
                if parent != 0 or "JointModelP" not in model.joints[j].shortname():
                    raise NotApplicableError(f"the massless body {model.names[j]}")
                continue
            if parent in bodies:
                pair = [marker(parent, placement.translation), marker(j, np.zeros(3))]
                system.AddObject(items.ObjectJointRevolute2D(markerNumbers=pair))
            else:  # hinged on a massless slider: a point on the slider's line
                sliders[parent] = j
                along = np.eye(model.nv)[model.joints[parent].idx_v]
                still = model.createData()
                pin.forwardKinematics(model, still, tree.q0, along)
                line = still.oMi[parent].rotation @ still.v[parent].linear
                axis = line[plane.axes]
                pair = [
                    marker(j, np.zeros(3), items.MarkerBodyRigid),
                    marker(0, plane.data.oMi[parent].translation, items.MarkerBodyRigid),
                ]
                system.AddObject(
                    items.ObjectJointPrismatic2D(
                        markerNumbers=pair,
                        normalMarker1=[-float(axis[1]), float(axis[0]), 0.0],
                        constrainRotation=False,
                    )
                )
        for closure in tree.closures:
            pair = [marker(closure.a, closure.in_a), marker(closure.b, closure.in_b)]
            system.AddObject(items.ObjectJointRevolute2D(markerNumbers=pair))
        for spring in tree.springs:
            pair = [marker(0, spring.ground), marker(spring.joint, spring.at)]
            system.AddObject(
                items.ObjectConnectorSpringDamper(
                    markerNumbers=pair, stiffness=spring.stiffness, referenceLength=spring.rest
                )
            )
        system.Assemble()

        def states(stored: dict[int, tuple[Array, Array]]) -> tuple[Array, Array]:
            q, v = np.empty((SAMPLES, model.nq)), np.empty((SAMPLES, model.nv))
            q0 = tree.q0
            turn = {0: (np.zeros(SAMPLES), np.zeros(SAMPLES))}
            for j, (position, rate) in stored.items():
                turn[j] = position[:, 2], rate[:, 2]
            for j in range(1, model.njoints):
                k, i = model.joints[j].idx_q, model.joints[j].idx_v
                if j in sliders:
                    rod = sliders[j]
                    position, rate = stored[rod]
                    base = np.array(plane.local(rod, np.zeros(3)))[:2]
                    c, s = np.cos(position[:, 2]), np.sin(position[:, 2])
                    x = position[:, 0] + c * base[0] - s * base[1]
                    q[:, k] = q0[k] + x - (base[0])
                    v[:, i] = rate[:, 0] - rate[:, 2] * (s * base[0] + c * base[1])
                    turn[j] = turn[0]
                    continue
                parent = turn[model.parents[j]]
                q[:, k] = q0[k] + plane.sign[j] * (turn[j][0] - parent[0])
                v[:, i] = plane.sign[j] * (turn[j][1] - parent[1])
            return q, v

        def at(setting: Setting) -> Run:
            options = exudyn.SimulationSettings()
            integration = options.timeIntegration
            integration.endTime = problem.t_end
            integration.numberOfSteps = SAMPLES * setting.substeps
            integration.verboseMode = 0
            integration.generalizedAlpha.spectralRadius = SPECTRAL_RADIUS
            integration.newton.useModifiedNewton = True
            integration.newton.relativeTolerance = 1e-10
            integration.newton.absoluteTolerance = 1e-12
            options.solution.file.write = False
            options.solution.sensors.writePeriod = problem.t_end / SAMPLES
            if len(plane.massive) > DENSE_BODIES:
                options.linearSolver.solverType = exudyn.LinearSolverType.EigenSparse
            options.show.statistics = False
            options.show.computationTime = False

            def run() -> Outcome:
                try:
                    done = system.SolveDynamic(options, showHints=False, showCausingItems=False)
                except Exception as error:  # Newton or a singular matrix
                    raise RunFailedError(f"{type(error).__name__}: {str(error)[:200]}") from error
                if not done:
                    raise RunFailedError("the solver gave up")
                stored = {
                    j: tuple(system.GetSensorStoredData(sensor)[-SAMPLES:, 1:] for sensor in pair)
                    for j, pair in sensors.items()
                }
                return Outcome(None, SAMPLES * setting.substeps, lambda: states(stored))

            return run

        return at
