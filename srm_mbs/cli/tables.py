"""Results of analyses as rows of text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.analysis.assembly_modes import AssemblyMode
from srm_mbs.analysis.equilibrium import NEUTRAL_STIFFNESS, Equilibrium
from srm_mbs.analysis.linearisation import Linearisation
from srm_mbs.analysis.path_following import FollowedPath
from srm_mbs.analysis.summary import force_text, position_text, vector_text
from srm_mbs.assembly.position import beyond_limits
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import angle_coordinates, coordinate_units
from srm_mbs.simulation.energy_balance import EnergyBalance

ROUNDING = 1e-12
"""Part of the largest number of a kind below which another one of that kind is shown as 0."""


def _rounded(values: Any, scale: float) -> Any:
    """``values``, those below the rounding of ``scale`` as 0; of complex ones each part."""
    values = np.asarray(values)
    if np.iscomplexobj(values):
        return _rounded(values.real, scale) + 1j * _rounded(values.imag, scale)
    return np.where(np.abs(values) <= ROUNDING * scale, 0.0, values)


def _largest(values: Any) -> float:
    return float(np.max(np.abs(values), initial=0.0))


def position_rows(mechanism: Mechanism, q: FloatArray) -> Iterator[tuple[str, str, str]]:
    """(joint, position with unit, limit that it is beyond) in the configuration q (nq,)."""
    beyond = beyond_limits(mechanism, q)
    for name in mechanism.joint_names:
        limit = f"beyond its limit {beyond[name][1]:.6g}" if name in beyond else ""
        yield name, position_text(mechanism, name, q), limit


def mode_rows(mechanism: Mechanism, modes: Sequence[AssemblyMode]) -> Iterator[tuple[str, ...]]:
    """(number, starts that led to it, whether it is singular or beyond joint limits, position of
    each joint) of each assembly mode."""
    for number, mode in enumerate(modes, 1):
        positions = (text for _, text, _ in position_rows(mechanism, mode.q))
        remarks = ["singular"] * mode.singular
        if beyond := beyond_limits(mechanism, mode.q):
            remarks.append(f"beyond the limits of {', '.join(beyond)}")
        yield str(number), f"{mode.found} of {mode.starts}", "; ".join(remarks), *positions


def _own(mechanism: Mechanism, name: str, values: FloatArray) -> FloatArray:
    """Those of ``values`` (nv,) that belong to the joint ``name``."""
    joint = mechanism.joint(name)
    return values[joint.idx_v : joint.idx_v + joint.nv]


def equilibrium_rows(mechanism: Mechanism, found: Equilibrium) -> Iterator[tuple[str, str]]:
    """Stability, frequencies, holding forces and reactions: (quantity, value)."""
    kind = "stable" if found.stable else "neutral" if found.neutral else "unstable"
    yield "equilibrium", kind + ", on a singular configuration" * found.singular
    yield "force left", f"{found.residual:.1e} N m"
    zero = NEUTRAL_STIFFNESS * mechanism.structure.units.rate**2
    for value in found.eigenvalues:
        if abs(value) <= zero:
            yield "small motion", "neutral: it neither swings nor leaves"
        elif value.imag:
            yield "small motion", f"eigenvalue {value:.6g} 1/s^2"
        elif value.real > 0.0:
            yield "small motion", f"swings with {np.sqrt(value.real) / (2.0 * np.pi):.6g} Hz"
        else:
            yield "small motion", f"leaves with {np.sqrt(-value.real):.6g} 1/s"
    length = coordinate_units(mechanism, mechanism.q0, mechanism.v0).length
    arm = np.repeat([1.0, length], 3)
    arms = np.where(angle_coordinates(mechanism.model), length, 1.0)
    held = {name: _own(mechanism, name, arms) for name in found.holding}
    forces = [found.holding[name] / held[name] for name in held]
    scale = max(map(_largest, (*forces, *(w / arm for w in found.reactions.values()))), default=0.0)
    for name, force in zip(held, forces):
        yield f"to hold {name}", force_text(mechanism, name, _rounded(force, scale) * held[name])
    for name, wrench in found.reactions.items():
        shown = _rounded(wrench / arm, scale) * arm
        yield f"reaction {name}", f"{vector_text(shown[:3])} N, {vector_text(shown[3:])} N m"


def eigenvalue_rows(found: Linearisation) -> Iterator[tuple[str, ...]]:
    """(number, eigenvalue, frequency, damping ratio, joint motions) of each mode."""
    values, frequencies = (
        _rounded(numbers, _largest(numbers)) for numbers in (found.eigenvalues, found.frequencies)
    )
    rows = zip(values, frequencies, found.damping_ratios, found.modes.T)
    for number, (value, frequency, damping, shape) in enumerate(rows):
        parts = (_complex(entry) for entry in _rounded(shape, _largest(shape)))
        # A zero eigenvalue has no damping ratio.
        ratio = f"{_rounded(damping, 1.0) + 0.0:.4g}" if value else ""
        value = _rounded(value, abs(value))
        yield str(number), _complex(value), f"{frequency:.6g}", ratio, *parts


def _complex(value: Any) -> str:
    value = complex(value)
    if abs(value.imag) <= 1e-9 * abs(value):
        return f"{value.real:.6g}"
    return f"{value.real:.6g}{value.imag:+.6g}j"


def matrix_rows(found: Linearisation) -> Iterator[tuple[str, ...]]:
    """(derivative of, entries of A, entries of B, drift) for each state."""
    n = len(found.coordinates)
    shown = np.column_stack([found.A, found.B, found.drift])
    # Blocks of one kind each: positions, rates, inputs and drift, of d/dt of positions and rates.
    columns = (slice(n), slice(n, 2 * n), slice(2 * n, -1), slice(-1, None))
    for block in ((rows, own) for rows in columns[:2] for own in columns):
        shown[block] = _rounded(shown[block], _largest(shown[block]))
    for label, numbers in zip(state_names(found), shown):
        yield f"d/dt {label}", *(f"{x:.6g}" for x in numbers)


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
