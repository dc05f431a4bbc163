"""Closed-loop mechanisms: simulation without drift, through singular configurations.

The public names are imported on first use, so that ``import srm_mbs`` stays fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from srm_mbs.analysis.accuracy.certificate import Certificate, certify
    from srm_mbs.analysis.assembly_modes import AssemblyMode, assembly_modes
    from srm_mbs.analysis.equilibrium import Equilibrium, equilibrium
    from srm_mbs.analysis.inverse_dynamics import InverseDynamics, inverse_dynamics
    from srm_mbs.analysis.kinematics import kinematics
    from srm_mbs.analysis.linearisation import Linearisation, linearise
    from srm_mbs.analysis.linkage import LinkageReport, linkage_report
    from srm_mbs.analysis.path_following import FollowedPath, follow
    from srm_mbs.api import DaeSolution, Solution, compile, load_solution, simulate, solve_dae
    from srm_mbs.assembly.assemble import Assembly, assemble
    from srm_mbs.dynamics.actuation import actuator_controller
    from srm_mbs.dynamics.mechanism import Mechanism
    from srm_mbs.errors import (
        AnalysisError,
        AssemblyError,
        ControllerError,
        EventError,
        FailedRunWarning,
        FunctionError,
        InputError,
        SimulationError,
        SrmError,
        SrmWarning,
    )
    from srm_mbs.errors import (
        __version__ as __version__,
    )
    from srm_mbs.formats.convert import convert
    from srm_mbs.formats.load import bundled_models, load, n_four_bar
    from srm_mbs.formats.planar.linkage import Linkage, planar
    from srm_mbs.integration.impacts import impact
    from srm_mbs.integration.kernel.backend import backend
    from srm_mbs.integration.methods.butcher import ButcherTableau
    from srm_mbs.integration.methods.psrm import PSRM
    from srm_mbs.integration.methods.tableaus import TABLEAUS
    from srm_mbs.integration.methods.thesis.srm import SRM
    from srm_mbs.model.actuators import Actuator
    from srm_mbs.model.anchors import Anchor
    from srm_mbs.model.closures import CLOSURE_TYPES, LoopClosure
    from srm_mbs.model.dae import SemiExplicitDAE
    from srm_mbs.model.drives import Drive
    from srm_mbs.model.forces import (
        FORCE_TYPES,
        Bushing,
        CouplingSpring,
        ForceElement,
        JointTorque,
        LimitSpring,
        SpringDamper,
        TorsionSpring,
        UserForce,
        Wrench,
    )
    from srm_mbs.model.laws import LAW_TYPES, ConstantSpeed, MinimumJerk, Polynomial, Sine, Table
    from srm_mbs.model.pinocchio_constraints import closures_from_pinocchio
    from srm_mbs.simulation.energy_balance import EnergyBalance
    from srm_mbs.simulation.mobility import MobilityMap, mobility_map
    from srm_mbs.simulation.segmented_run import Event, Switch
    from srm_mbs.simulation.simulator import Simulator
    from srm_mbs.sweeps.results import Sweep
    from srm_mbs.sweeps.sweep import sweep
    from srm_mbs.sweeps.tasks import standard_measures
    from srm_mbs.visualization.animation.joint_motion import CrankMotion, JointMotion
    from srm_mbs.visualization.animation.live import LiveView

_NAMES = {
    "analysis.accuracy.certificate": "Certificate certify",
    "analysis.assembly_modes": "AssemblyMode assembly_modes",
    "analysis.equilibrium": "Equilibrium equilibrium",
    "analysis.inverse_dynamics": "InverseDynamics inverse_dynamics",
    "analysis.kinematics": "kinematics",
    "analysis.linkage": "LinkageReport linkage_report",
    "analysis.linearisation": "Linearisation linearise",
    "analysis.path_following": "FollowedPath follow",
    "api": "DaeSolution Solution compile load_solution simulate solve_dae",
    "assembly.assemble": "Assembly assemble",
    "dynamics.actuation": "actuator_controller",
    "dynamics.mechanism": "Mechanism",
    "errors": "__version__ AnalysisError AssemblyError ControllerError EventError FailedRunWarning "
    "FunctionError InputError SimulationError SrmError SrmWarning",
    "formats.convert": "convert",
    "formats.load": "bundled_models load n_four_bar",
    "formats.planar.linkage": "Linkage planar",
    "integration.impacts": "impact",
    "integration.kernel.backend": "backend",
    "integration.methods.butcher": "ButcherTableau",
    "integration.methods.psrm": "PSRM",
    "integration.methods.tableaus": "TABLEAUS",
    "integration.methods.thesis.srm": "SRM",
    "model.actuators": "Actuator",
    "model.anchors": "Anchor",
    "model.closures": "CLOSURE_TYPES LoopClosure",
    "model.dae": "SemiExplicitDAE",
    "model.drives": "Drive",
    "model.forces": "Bushing CouplingSpring FORCE_TYPES ForceElement JointTorque LimitSpring "
    "SpringDamper TorsionSpring UserForce Wrench",
    "model.laws": "ConstantSpeed LAW_TYPES MinimumJerk Polynomial Sine Table",
    "model.pinocchio_constraints": "closures_from_pinocchio",
    "simulation.energy_balance": "EnergyBalance",
    "simulation.mobility": "MobilityMap mobility_map",
    "simulation.segmented_run": "Event Switch",
    "simulation.simulator": "Simulator",
    "sweeps.results": "Sweep",
    "sweeps.sweep": "sweep",
    "sweeps.tasks": "standard_measures",
    "visualization.animation.joint_motion": "CrankMotion JointMotion",
    "visualization.animation.live": "LiveView",
}
"""Public names of each module."""
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "CLOSURE_TYPES",
    "FORCE_TYPES",
    "LAW_TYPES",
    "PSRM",
    "SRM",
    "TABLEAUS",
    "Actuator",
    "AnalysisError",
    "Anchor",
    "Assembly",
    "AssemblyError",
    "AssemblyMode",
    "Bushing",
    "ButcherTableau",
    "Certificate",
    "ConstantSpeed",
    "ControllerError",
    "CouplingSpring",
    "CrankMotion",
    "DaeSolution",
    "Drive",
    "EnergyBalance",
    "Equilibrium",
    "Event",
    "EventError",
    "FailedRunWarning",
    "FollowedPath",
    "ForceElement",
    "FunctionError",
    "InputError",
    "InverseDynamics",
    "JointMotion",
    "JointTorque",
    "LimitSpring",
    "Linearisation",
    "Linkage",
    "LinkageReport",
    "LiveView",
    "LoopClosure",
    "Mechanism",
    "MinimumJerk",
    "MobilityMap",
    "Polynomial",
    "SemiExplicitDAE",
    "SimulationError",
    "Simulator",
    "Sine",
    "Solution",
    "SpringDamper",
    "SrmError",
    "SrmWarning",
    "Sweep",
    "Switch",
    "Table",
    "TorsionSpring",
    "UserForce",
    "Wrench",
    "actuator_controller",
    "assemble",
    "assembly_modes",
    "backend",
    "bundled_models",
    "certify",
    "closures_from_pinocchio",
    "compile",
    "convert",
    "equilibrium",
    "follow",
    "impact",
    "inverse_dynamics",
    "kinematics",
    "linearise",
    "linkage_report",
    "load",
    "load_solution",
    "mobility_map",
    "n_four_bar",
    "planar",
    "simulate",
    "solve_dae",
    "standard_measures",
    "sweep",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
