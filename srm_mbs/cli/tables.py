"""Results of analyses as rows of text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.analysis.assembly_modes import AssemblyMode
from srm_mbs.analysis.equilibrium import Equilibrium
from srm_mbs.analysis.linearisation import Linearisation
from srm_mbs.analysis.path_following import FollowedPath
from srm_mbs.analysis.summary import force_text, position_text, vector_text
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.simulation.energy_balance import EnergyBalance


def position_rows(mechanism: Mechanism, q: FloatArray) -> list[tuple[str, str]]:
    """(joint, position with unit) in the configuration q (nq,)."""
    return [(name, position_text(mechanism, name, q)) for name in mechanism.joint_names]


def mode_rows(mechanism: Mechanism, modes: Sequence[AssemblyMode]) -> Iterator[tuple[str, ...]]:
    """(number, starts that led to it, singular, position of each joint) of each assembly mode."""
    for number, mode in enumerate(modes, 1):
        positions = (text for _, text in position_rows(mechanism, mode.q))
        singular = "singular" if mode.singular else ""
        yield str(number), f"{mode.found} of {mode.starts}", singular, *positions


def equilibrium_rows(mechanism: Mechanism, found: Equilibrium) -> Iterator[tuple[str, str]]:
    """Stability, frequencies, holding forces and reactions: (quantity, value)."""
    kind = "stable" if found.stable else "neutral" if found.neutral else "unstable"
    yield "equilibrium", kind + ", on a singular configuration" * found.singular
    yield "force left", f"{found.residual:.1e} N m"
    for value in found.eigenvalues:
        if value.imag:
            yield "small motion", f"eigenvalue {value:.6g} 1/s^2"
        elif value.real > 0.0:
            yield "small motion", f"swings with {np.sqrt(value.real) / (2.0 * np.pi):.6g} Hz"
        else:
            yield "small motion", f"leaves with {np.sqrt(-value.real):.6g} 1/s"
    for name, force in found.holding.items():
        yield f"to hold {name}", force_text(mechanism, name, force)
    for name, wrench in found.reactions.items():
        yield f"reaction {name}", f"{vector_text(wrench[:3])} N, {vector_text(wrench[3:])} N m"


def eigenvalue_rows(found: Linearisation) -> Iterator[tuple[str, ...]]:
    """(number, eigenvalue, frequency, damping ratio, joint motions) of each mode."""
    modes = zip(found.eigenvalues, found.frequencies, found.damping_ratios, found.modes.T)
    for number, (value, frequency, damping, shape) in enumerate(modes):
        parts = (_complex(entry) for entry in shape)
        yield str(number), _complex(value), f"{frequency:.6g}", f"{damping + 0.0:.4g}", *parts


def _complex(value: Any) -> str:
    value = complex(value)
    if abs(value.imag) <= 1e-9 * abs(value):
        return f"{value.real:.6g}"
    return f"{value.real:.6g}{value.imag:+.6g}j"


def matrix_rows(found: Linearisation) -> Iterator[tuple[str, ...]]:
    """(derivative of, entries of A, entries of B, drift) for each state."""
    for label, a, b, rest in zip(state_names(found), found.A, found.B, found.drift):
        yield f"d/dt {label}", *(f"{x:.6g}" for x in (*a, *b, rest))


def state_names(found: Linearisation) -> list[str]:
    """Names of the states x = (z, w)."""
    return [*found.coordinates, *(f"rate of {name}" for name in found.coordinates)]


def balance_rows(found: EnergyBalance) -> Iterator[tuple[str, str]]:
    """Energies and works at the end of a run, and how well they balance: (quantity, J)."""
    kinetic, potential = found.kinetic[-1], found.potential[-1]
    yield "kinetic energy at the end", f"{kinetic:.9g} J"
    yield "potential energy at the end", f"{potential:.9g} J"
    yield "energy gained", f"{kinetic + potential - found.start:.9g} J"
    for name, work in found.works.items():
        yield f"work of {name}", f"{work[-1]:.9g} J"
    yield "balance", f"open by at most {found.relative:.1e} of {found.scale:.3g} J"


def path_rows(found: FollowedPath) -> Iterator[tuple[str, str]]:
    """End of a path, and the singular configurations on it: (quantity, value)."""
    yield "path", found.message
    yield "configurations on the way", str(len(found.path))
    yield "branch kept", "yes" if found.branch_kept else "no"
    for point in found.singular:
        at = ", ".join(f"{name} = {value:.6g}" for name, value in point.values.items())
        yield "singular configuration", f"{at}; loops {', '.join(point.loops)}"
