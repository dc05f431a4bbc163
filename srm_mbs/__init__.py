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
    from srm_mbs.analysis.linearisation import Linearisation, linearise
    from srm_mbs.analysis.path_following import FollowedPath, follow
    from srm_mbs.api import DaeSolution, Solution, load_solution, simulate, solve_dae
    from srm_mbs.assembly.assemble import Assembly, assemble
    from srm_mbs.dynamics.mechanism import Mechanism
    from srm_mbs.errors import (
        AnalysisError,
        AssemblyError,
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
    from srm_mbs.integration.kernel.backend import backend
    from srm_mbs.integration.methods.butcher import ButcherTableau
    from srm_mbs.integration.methods.psrm import PSRM
    from srm_mbs.integration.methods.tableaus import TABLEAUS
    from srm_mbs.integration.methods.thesis.srm import SRM
    from srm_mbs.model.anchors import Anchor
    from srm_mbs.model.closures import CLOSURE_TYPES, LoopClosure
    from srm_mbs.model.dae import SemiExplicitDAE
    from srm_mbs.model.drives import Drive
    from srm_mbs.model.forces import (
        FORCE_TYPES,
        Bushing,
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
    from srm_mbs.simulation.segmented_run import Event, Switch, impact
    from srm_mbs.simulation.simulator import Simulator
    from srm_mbs.sweeps.results import Sweep
    from srm_mbs.sweeps.sweep import sweep
    from srm_mbs.sweeps.tasks import standard_measures
    from srm_mbs.visualization.animation.joint_motion import JointMotion
    from srm_mbs.visualization.animation.live import LiveView

_HOME = {
    "__version__": "errors",
    "AnalysisError": "errors",
    "Anchor": "model.anchors",
    "Assembly": "assembly.assemble",
    "AssemblyError": "errors",
    "AssemblyMode": "analysis.assembly_modes",
    "Bushing": "model.forces",
    "ButcherTableau": "integration.methods.butcher",
    "CLOSURE_TYPES": "model.closures",
    "Certificate": "analysis.accuracy.certificate",
    "ConstantSpeed": "model.laws",
    "DaeSolution": "api",
    "Drive": "model.drives",
    "EnergyBalance": "simulation.energy_balance",
    "Equilibrium": "analysis.equilibrium",
    "Event": "simulation.segmented_run",
    "FORCE_TYPES": "model.forces",
    "FollowedPath": "analysis.path_following",
    "ForceElement": "model.forces",
    "InputError": "errors",
    "InverseDynamics": "analysis.inverse_dynamics",
    "JointMotion": "visualization.animation.joint_motion",
    "JointTorque": "model.forces",
    "LAW_TYPES": "model.laws",
    "LimitSpring": "model.forces",
    "Linearisation": "analysis.linearisation",
    "LiveView": "visualization.animation.live",
    "LoopClosure": "model.closures",
    "Mechanism": "dynamics.mechanism",
    "MinimumJerk": "model.laws",
    "MobilityMap": "simulation.mobility",
    "PSRM": "integration.methods.psrm",
    "Polynomial": "model.laws",
    "SRM": "integration.methods.thesis.srm",
    "SemiExplicitDAE": "model.dae",
    "SimulationError": "errors",
    "Simulator": "simulation.simulator",
    "Sine": "model.laws",
    "Solution": "api",
    "SpringDamper": "model.forces",
    "SrmError": "errors",
    "SrmWarning": "errors",
    "Sweep": "sweeps.results",
    "Switch": "simulation.segmented_run",
    "TABLEAUS": "integration.methods.tableaus",
    "Table": "model.laws",
    "TorsionSpring": "model.forces",
    "UserForce": "model.forces",
    "Wrench": "model.forces",
    "assemble": "assembly.assemble",
    "assembly_modes": "analysis.assembly_modes",
    "backend": "integration.kernel.backend",
    "bundled_models": "formats.load",
    "certify": "analysis.accuracy.certificate",
    "closures_from_pinocchio": "model.pinocchio_constraints",
    "convert": "formats.convert",
    "equilibrium": "analysis.equilibrium",
    "follow": "analysis.path_following",
    "impact": "simulation.segmented_run",
    "inverse_dynamics": "analysis.inverse_dynamics",
    "linearise": "analysis.linearisation",
    "load": "formats.load",
    "load_solution": "api",
    "mobility_map": "simulation.mobility",
    "n_four_bar": "formats.load",
    "simulate": "api",
    "solve_dae": "api",
    "standard_measures": "sweeps.tasks",
    "sweep": "sweeps.sweep",
}

__all__ = [
    "CLOSURE_TYPES",
    "FORCE_TYPES",
    "LAW_TYPES",
    "PSRM",
    "SRM",
    "TABLEAUS",
    "AnalysisError",
    "Anchor",
    "Assembly",
    "AssemblyError",
    "AssemblyMode",
    "Bushing",
    "ButcherTableau",
    "Certificate",
    "ConstantSpeed",
    "DaeSolution",
    "Drive",
    "EnergyBalance",
    "Equilibrium",
    "Event",
    "FollowedPath",
    "ForceElement",
    "InputError",
    "InverseDynamics",
    "JointMotion",
    "JointTorque",
    "LimitSpring",
    "Linearisation",
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
    "assemble",
    "assembly_modes",
    "backend",
    "bundled_models",
    "certify",
    "closures_from_pinocchio",
    "convert",
    "equilibrium",
    "follow",
    "impact",
    "inverse_dynamics",
    "linearise",
    "load",
    "load_solution",
    "mobility_map",
    "n_four_bar",
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
    return sorted([*globals(), *__all__])
