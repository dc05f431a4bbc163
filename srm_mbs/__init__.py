"""Closed-loop mechanisms: simulation without drift, through singular configurations.

The public names are imported on first use, so that ``import srm_mbs`` stays fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from srm_mbs.actions import Event, Switch, impact
    from srm_mbs.analysis.certificate import Certificate, certify
    from srm_mbs.analysis.energy_balance import EnergyBalance
    from srm_mbs.analysis.equilibrium import Equilibrium, equilibrium
    from srm_mbs.analysis.following import FollowedPath, follow
    from srm_mbs.analysis.inverse_dynamics import InverseDynamics, inverse_dynamics
    from srm_mbs.analysis.linearisation import Linearisation, linearise
    from srm_mbs.analysis.mobility import MobilityMap, mobility_map
    from srm_mbs.analysis.modes import AssemblyMode, assembly_modes
    from srm_mbs.anchors import Anchor
    from srm_mbs.assembly import Assembly, assemble
    from srm_mbs.closures import CLOSURE_TYPES
    from srm_mbs.dae import solve_dae
    from srm_mbs.dae_solution import DaeSolution
    from srm_mbs.drives import Drive
    from srm_mbs.errors import (
        AnalysisError,
        AssemblyError,
        InputError,
        SimulationError,
        SrmError,
        SrmWarning,
    )
    from srm_mbs.force_element import ForceElement
    from srm_mbs.forces import (
        FORCE_TYPES,
        Bushing,
        JointTorque,
        LimitSpring,
        SpringDamper,
        TorsionSpring,
        Wrench,
    )
    from srm_mbs.kernel import backend
    from srm_mbs.laws import LAW_TYPES, ConstantSpeed, MinimumJerk, Polynomial, Sine, Table
    from srm_mbs.live import LiveView
    from srm_mbs.loading import bundled_models, load, n_four_bar
    from srm_mbs.loading.converting import convert
    from srm_mbs.loop_closure import LoopClosure
    from srm_mbs.mechanism import Mechanism
    from srm_mbs.methods.butcher import ButcherTableau
    from srm_mbs.methods.psrm import PSRM
    from srm_mbs.methods.srm import SRM
    from srm_mbs.methods.tableaus import TABLEAUS
    from srm_mbs.motion import JointMotion
    from srm_mbs.pinocchio_constraints import closures_from_pinocchio
    from srm_mbs.semi_explicit import SemiExplicitDAE
    from srm_mbs.simulation import simulate
    from srm_mbs.simulator import Simulator
    from srm_mbs.solution import Solution
    from srm_mbs.storage import load_solution
    from srm_mbs.sweeps.results import Sweep
    from srm_mbs.sweeps.running import sweep
    from srm_mbs.sweeps.tasks import standard_measures
    from srm_mbs.user_forces import UserForce

_HOME = {
    "AnalysisError": "errors",
    "Anchor": "anchors",
    "Assembly": "assembly",
    "AssemblyError": "errors",
    "AssemblyMode": "analysis.modes",
    "Bushing": "forces",
    "ButcherTableau": "methods.butcher",
    "CLOSURE_TYPES": "closures",
    "Certificate": "analysis.certificate",
    "ConstantSpeed": "laws",
    "DaeSolution": "dae_solution",
    "Drive": "drives",
    "EnergyBalance": "analysis.energy_balance",
    "Equilibrium": "analysis.equilibrium",
    "Event": "actions",
    "FORCE_TYPES": "forces",
    "FollowedPath": "analysis.following",
    "ForceElement": "force_element",
    "InputError": "errors",
    "InverseDynamics": "analysis.inverse_dynamics",
    "JointMotion": "motion",
    "JointTorque": "forces",
    "LAW_TYPES": "laws",
    "LimitSpring": "forces",
    "LiveView": "live",
    "Linearisation": "analysis.linearisation",
    "LoopClosure": "loop_closure",
    "Mechanism": "mechanism",
    "MinimumJerk": "laws",
    "MobilityMap": "analysis.mobility",
    "PSRM": "methods.psrm",
    "Polynomial": "laws",
    "SRM": "methods.srm",
    "SemiExplicitDAE": "semi_explicit",
    "SimulationError": "errors",
    "Simulator": "simulator",
    "Sine": "laws",
    "Solution": "solution",
    "SpringDamper": "forces",
    "SrmError": "errors",
    "SrmWarning": "errors",
    "Sweep": "sweeps.results",
    "Switch": "actions",
    "TABLEAUS": "methods.tableaus",
    "Table": "laws",
    "TorsionSpring": "forces",
    "UserForce": "user_forces",
    "Wrench": "forces",
    "assemble": "assembly",
    "assembly_modes": "analysis.modes",
    "backend": "kernel",
    "bundled_models": "loading",
    "certify": "analysis.certificate",
    "convert": "loading.converting",
    "equilibrium": "analysis.equilibrium",
    "follow": "analysis.following",
    "inverse_dynamics": "analysis.inverse_dynamics",
    "linearise": "analysis.linearisation",
    "closures_from_pinocchio": "pinocchio_constraints",
    "impact": "actions",
    "load": "loading",
    "load_solution": "storage",
    "mobility_map": "analysis.mobility",
    "n_four_bar": "loading",
    "simulate": "simulation",
    "solve_dae": "dae",
    "standard_measures": "sweeps.tasks",
    "sweep": "sweeps.running",
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
