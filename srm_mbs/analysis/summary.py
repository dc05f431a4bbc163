"""A mechanism and a run as rows of text, for the command line and for reports."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.analysis.time_constants import stiff_elements
from srm_mbs.dynamics.constraints.rows import closure_errors
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import angle_coordinates, is_angle, row_angles, scene_diagonal
from srm_mbs.errors import time_text
from srm_mbs.integration.critical_passages import ROUNDED_RESIDUAL
from srm_mbs.integration.kernel.backend import backend, code_status
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.closures import JointRow, LoopClosure
from srm_mbs.model.coordinates import position_of
from srm_mbs.model.laws import is_of_package
from srm_mbs.simulation.result import SimulationResult

JOINT_TYPES = {
    **{f"R{axis}": f"revolute about {axis.lower()}" for axis in "XYZ"},
    **{f"RUB{axis}": f"continuous about {axis.lower()}" for axis in "XYZ"},
    **{f"P{axis}": f"prismatic along {axis.lower()}" for axis in "XYZ"},
    "RevoluteUnaligned": "revolute",
    "RevoluteUnboundedUnaligned": "continuous",
    "PrismaticUnaligned": "prismatic",
    "FreeFlyer": "floating",
    "Planar": "planar",
    "Spherical": "ball",
    "Universal": "universal",
    "HelicalUnaligned": "screw",
}
"""Pinocchio's joint types as URDF calls them."""
MAX_RESIDUALS = 100
"""Singular passages whose residuals are looked at."""
MAX_LISTED = 8
"""Longest list of numbers that is given in full; of longer ones the ends."""
BUSHING_ANGULAR = [False, False, False, True, True, True]
"""Which of the six numbers of a bushing belong to angles."""
MAX_STIFF = 5
"""Joints and force elements that are listed as stiff."""
BACKENDS = {
    "generated": "the compiled kernel with generated code",
    "kernel": "the compiled kernel",
    "python": "the Python reference",
}


def run_rows(solution: SimulationResult, *, passages: bool = True) -> list[tuple[str, str]]:
    """Summary of a run: (quantity, value with unit).

    Parameters
    ----------
    passages
        Whether to count the singular passages, which is slow if there are thousands.
    """
    stats = solution.stats
    energy = solution.energy - solution.energy[0]
    rows = [
        ("mechanism", solution.mechanism.name),
        ("status", solution.status),
        ("computed by", BACKENDS[solution.settings.backend]),
        ("end time", f"{time_text(solution.t[-1])} s"),
        ("steps", f"{stats.steps}"),
        ("rejected steps", f"{stats.rejected}"),
        ("evaluations", f"{stats.evaluations}"),
    ]
    if solution.mechanism.constrained:
        position, rate = solution.drift.max(axis=0)
        rows += [
            ("placements", f"{stats.placements} in advance, {stats.replaced} redone"),
            ("zone steps", f"{stats.zone_steps}"),
            *([("singular passages", _passages_text(solution))] if passages else []),
            ("largest ||g||", f"{position:.2e} (m, rad)"),
            ("largest ||G v||", f"{rate:.2e} (m/s, rad/s)"),
        ]
    rows += [
        ("energy change", f"{energy[-1]:.2e} J at the end, at most {abs(energy).max():.2e} J"),
        ("wall time", f"{stats.wall_time:.3g} s"),
    ]
    return rows


def _passages_text(solution: SimulationResult) -> str:
    """Number of the singular passages, and the residuals that the closures have there."""
    crossings = solution.crossings
    listed = crossings[:MAX_RESIDUALS]
    found = [abs(one.residual) for one in listed if one.residual is not None]
    if not max(found, default=0.0) > ROUNDED_RESIDUAL:
        return f"{len(crossings)}"
    avoided = sum(one.kind == "avoided" for one in listed)
    some = "" if len(listed) == len(crossings) else f" of the first {len(listed)}"
    return f"{len(crossings)}; residuals{some} up to {max(found):.1e}, {avoided} avoided"


def mechanism_rows(mechanism: Mechanism) -> list[tuple[str, str]]:
    """Size, mass, degrees of freedom, rank and redundancy of a mechanism: (quantity, value).

    The size is the diagonal of the box around joints, centres of mass and anchors at the start, the
    mass that of all bodies that can move: both show a model in other units than m and kg.
    """
    structure, source = mechanism.structure, mechanism.source
    found = mechanism.mobility
    count = f"{found.joint_freedoms} - {found.rows} = {found.gruebler}"
    if found.planar_gruebler is not None:
        count += f", in the plane {found.planar_gruebler}"
    freedom = f"{mechanism.degrees_of_freedom}"
    if mechanism.drives:
        freedom += f", {found.degrees_of_freedom} without the drives"
    idle = [f"{', '.join(motion.joints)} ({motion.directions})" for motion in found.idle]
    code = code_status(mechanism)
    mass = sum(body.mass for body in mechanism.model.inertias.tolist()[1:])
    return [
        ("mechanism", mechanism.name),
        ("read from", "Python" if source is None else f"{source.path} ({source.format})"),
        ("size", f"{scene_diagonal(mechanism, mechanism.q0):.6g} m"),
        ("mass", f"{mass:.6g} kg"),
        ("degrees of freedom", freedom),
        ("Gruebler count", count),
        ("closure rows", f"{found.rows}"),
        *([("drives", f"{len(mechanism.drives)}")] if mechanism.drives else []),
        ("rank", f"{structure.rank}"),
        ("redundant rows, left out", ", ".join(structure.redundant_rows) or "none"),
        ("redundant rows, left to pivoting", f"{structure.pivoted_redundancy}"),
        ("joints that cannot move", ", ".join(found.unreachable_joints) or "none"),
        ("joints that move no loop", "; ".join(idle) or "none"),
        ("runs on", BACKENDS[backend(mechanism)]),
        *([] if code is None else [("generated code", code)]),
    ]


def joint_rows(mechanism: Mechanism) -> Iterator[tuple[str, str, str, str]]:
    """(name, type, initial position, initial rate) of each moving joint."""
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        v = [_without_noise(value) for value in mechanism.v0[joint.idx_v : joint.idx_v + joint.nv]]
        rate = f"{v[0]:.6g} {_unit(mechanism, name)}/s" if joint.nv == 1 else vector_text(v)
        yield name, _joint_type(joint), position_text(mechanism, name, mechanism.q0), rate


def position_text(mechanism: Mechanism, name: str, q: FloatArray) -> str:
    """Position of the joint ``name`` in q (nq,), with its unit if it has one degree of freedom."""
    joint = mechanism.joint(name)
    if joint.nv > 1:
        return vector_text(map(_without_noise, q[joint.idx_q : joint.idx_q + joint.nq]))
    return f"{_without_noise(position_of(mechanism, q, name)):.6g} {_unit(mechanism, name)}"


def force_text(mechanism: Mechanism, name: str, force: FloatArray) -> str:
    """The generalised force (n,) on the joint ``name``, with its units."""
    return _in_units(force, _angular(mechanism, name), ["N m", "N"])


def _angular(mechanism: Mechanism, name: str) -> list[bool]:
    """Which degrees of freedom of the joint ``name`` are angles."""
    joint = mechanism.joint(name)
    own = slice(joint.idx_v, joint.idx_v + joint.nv)
    angular: list[bool] = angle_coordinates(mechanism.model)[own].tolist()
    return angular


def _in_units(values: FloatArray, angular: list[bool], units: list[str]) -> str:
    """Numbers (n,) in the two ``units``, that of angles and that of lengths: a list of each."""
    if len(angular) == 1:
        return f"{values[0]:.6g} {units[not angular[0]]}"
    parts = groupby(zip(angular, values.tolist()), itemgetter(0))
    return ", ".join(f"{vector_text(x for _, x in own)} {units[not angle]}" for angle, own in parts)


def _without_noise(value: float) -> float:
    """``value`` rounded to 12 decimals: assembly leaves rounding errors where it means zero."""
    return round(float(value), 12) + 0.0


def _joint_type(joint: Any) -> str:
    short = str(joint.shortname()).removeprefix("JointModel")
    return JOINT_TYPES.get(short, short)


def _unit(mechanism: Mechanism, name: str) -> str:
    return "rad" if is_angle(mechanism.model, name) else "m"


def body_rows(mechanism: Mechanism) -> Iterator[tuple[str, str, str, str]]:
    """(links, joint that carries it, mass, centre of mass in its frame) of each moving body."""
    model = mechanism.model
    links: dict[int, list[str]] = {}
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY:
            links.setdefault(int(frame.parentJoint), []).append(frame.name)
    for k, name in enumerate(mechanism.joint_names, start=1):
        inertia = model.inertias[k]
        centre = vector_text(map(_without_noise, inertia.lever)) + " m" if inertia.mass else ""
        yield ", ".join(links.get(k, ())), name, f"{inertia.mass:.6g} kg", centre


def loop_rows(mechanism: Mechanism) -> Iterator[tuple[str, str, str, str, str]]:
    """(name, type, anchor a or joints, anchor b or relation, gap at the start) of each loop."""
    model, loops = mechanism.model, mechanism.loops
    g = closure_errors(model, loops, mechanism.q0[None], mechanism.v0[None])[0][0]
    angles = row_angles(mechanism)
    at = 0
    for loop in loops:
        own, turned = g[at : at + loop.rows.count], angles[at : at + loop.rows.count]
        at += loop.rows.count
        gaps = [(own[~turned], "m"), (own[turned], "rad")]
        gap = ", ".join(
            f"{np.linalg.norm(part):.1e} {unit}" if part.any() else f"0 {unit}"
            for part, unit in gaps
            if len(part)
        )
        if loop.joints is not None:
            yield loop.name, loop.type_name, ", ".join(loop.joints), _relation(loop), gap
            continue
        a, b = map(_anchor, loop.anchors)
        yield loop.name, loop.type_name, a, b, gap


def _relation(loop: LoopClosure) -> str:
    """The equation of a coupling: "first = 2 second + 0.1"."""
    (row,) = loop.rows.joint_rows
    if not isinstance(loop.type, str):  # of the user, who knows what its keys mean
        return _row_relation(row)
    if loop.polynomial is not None:
        return _polynomial_relation(loop, loop.polynomial)
    if loop.ratio is not None:
        terms = f"{row.joints[0]} = {loop.ratio:g} {row.joints[1]}"
        return f"{terms} {row.offset:+g}" if row.offset else terms
    return _row_relation(row)


def _row_relation(row: JointRow) -> str:
    """The equation of a joint row: "+1 first -2 second = 0.1 +3 y^2, y = +1 second"."""
    left, right = (
        " ".join(f"{c:+g} {name}" for c, name in zip(numbers, row.joints) if c)
        for numbers in (row.coefficients, row.arguments)
    )
    powers = "".join(f" {a:+g} y^{k}" for k, a in enumerate(row.powers, 2) if a)
    return f"{left} = {row.offset:g}{powers}" + (f", y = {right}" if powers else "")


def _polynomial_relation(loop: LoopClosure, polynomial: Sequence[float]) -> str:
    """The equation of a coupling by a polynomial: "first = 0.1 +2 y +3 y^2, y = second"."""
    joints = loop.joints or ()
    sides = ((loop.coefficients, joints[:1]), (loop.arguments, joints[1:]))
    left, right = (
        " ".join(names)
        if numbers is None
        else " ".join(f"{c:+g} {name}" for c, name in zip(numbers, joints) if c)
        for numbers, names in sides
    )
    powers = ("", " y", *(f" y^{k}" for k in range(2, len(polynomial))))
    terms = " ".join(f"{a:+g}{power}" for a, power in zip(polynomial, powers) if a)
    return f"{left} = {terms}, y = {right}"


RARE = ("slack", "friction")
"""Values of force elements that are listed where they are not zero."""


def force_rows(mechanism: Mechanism) -> Iterator[tuple[str, str, str, str]]:
    """(name, type, joint or anchors, values with units) of each force element."""
    for force in mechanism.forces:
        places, values = [], []
        for key in fields(force):  # type: ignore[arg-type]
            value = getattr(force, key.name)
            if isinstance(value, Anchor):
                places.append(_anchor(value))
            elif key.name == "joint":
                places.append(value)
            elif key.name == "joints":
                places += value
            elif key.name != "name":
                if value is None or (key.name in RARE and not value):
                    continue
                units = key.metadata.get("unit", "").split(", ")
                text = f"{value:.6g}" if isinstance(value, float) else value
                if key.name == "law":
                    laws = value if isinstance(value, tuple) else (value,)
                    text = ", ".join(dict.fromkeys(law.type for law in laws))
                elif len(units) > 1:
                    joint = getattr(force, "joint", None)
                    angular = BUSHING_ANGULAR if joint is None else _angular(mechanism, joint)
                    text, units = _in_units(np.atleast_1d(value), angular, units), [""]
                elif isinstance(value, tuple):
                    text = vector_text(value)
                elif callable(value):
                    text = getattr(value, "__name__", "of the user")
                values.append(f"{key.name} {text} {units[0]}".rstrip())
        yield force.name, force.type, ", ".join(places), ", ".join(values)


def stiff_rows(mechanism: Mechanism) -> Iterator[tuple[str, str, str]]:
    """(joint or force element, coefficient, time constant) of the MAX_STIFF stiffest ones, and how
    many more there are."""
    found = stiff_elements(mechanism)
    for one in found[:MAX_STIFF]:
        yield one.element, one.coefficient, f"{one.seconds:.2g} s"
    if len(found) > MAX_STIFF:
        yield f"and {len(found) - MAX_STIFF} more", "", f"up to {found[-1].seconds:.2g} s"


def drive_rows(mechanism: Mechanism) -> Iterator[tuple[str, str, str, str]]:
    """(name, law, joint or anchors, values) of each drive."""
    for drive in mechanism.drives:
        place = drive.joint or ""
        if drive.a is not None and drive.b is not None:
            along = "distance" if drive.axis is None else f"along {vector_text(drive.axis)}"
            place = f"{_anchor(drive.a)}, {_anchor(drive.b)}, {along}"
        ours = is_of_package(drive.law)
        values = [] if ours else ["of the user"]
        for key in fields(drive.law) if ours else ():  # type: ignore[arg-type]
            value = getattr(drive.law, key.name)
            if isinstance(value, Sequence) and len(value) > MAX_LISTED:
                values.append(f"{key.name} {value[0]:.6g} .. {value[-1]:.6g} ({len(value)})")
            elif value is not None:
                text = vector_text(value) if isinstance(value, Sequence) else f"{value:.6g}"
                values.append(f"{key.name} {text}")
        values += ["absolute"] if drive.absolute else []
        yield drive.name, drive.law.type, place, ", ".join(values)


def actuator_rows(mechanism: Mechanism) -> Iterator[tuple[str, str, str, str]]:
    """(name, type, joint, values that are not the defaults) of each actuator."""
    for name, actuator in mechanism.actuators.items():
        values = []
        for key in fields(actuator):
            value = getattr(actuator, key.name)
            if key.name not in ("joint", "type") and value != key.default:
                text = f"{value:.6g}" if isinstance(value, float) else vector_text(value)
                values.append(f"{key.name} {text}")
        yield name, actuator.type, actuator.joint, ", ".join(values)


def _anchor(anchor: Anchor) -> str:
    text = anchor.where
    if any(anchor.xyz):
        text += f" xyz {vector_text(anchor.xyz)} m"
    if any(anchor.rpy):
        text += f" rpy {vector_text(anchor.rpy)} rad"
    return text


def vector_text(values: Iterable[float]) -> str:
    """``values`` as ``[1, 0.5, 0]``."""
    return f"[{', '.join(f'{value:.6g}' for value in values)}]"
