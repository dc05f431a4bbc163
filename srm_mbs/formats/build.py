"""From a description and a tree of links and joints to the assembled mechanism."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.assembly.assemble import consistent_start
from srm_mbs.assembly.diagnosis import CORRECT_AXIS, inclined_axes
from srm_mbs.assembly.implied_rows import without_implied_rows
from srm_mbs.assembly.position import CONSTRAINT_TOLERANCE, limit_springs
from srm_mbs.assembly.regular_start import BEYOND_ROUNDING, bodies_at_start
from srm_mbs.dynamics.constraints.reusable_analysis import ReusableAnalysis
from srm_mbs.dynamics.constraints.structure import structure_of
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import (
    AssemblyError,
    EvaluationError,
    InputError,
    SrmWarning,
    get_logger,
    known_names,
    naming,
)
from srm_mbs.formats.csv_table import CsvFolder
from srm_mbs.formats.plausibility import (
    doubtful_angles,
    doubtful_inertias,
    doubtful_lengths,
    doubtful_rotations,
)
from srm_mbs.formats.toml.description import Description, check_description, parse_toml
from srm_mbs.formats.toml.parameters import Place
from srm_mbs.formats.translation import FileTerms, NumbersOfVariants, TreeParts
from srm_mbs.formats.urdf.parser import UrdfModel, build_urdf, lock_joints
from srm_mbs.formats.urdf.variants import OverridableTree
from srm_mbs.formats.variants import Elements
from srm_mbs.formats.xml import parse_xml
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.coordinates import write_position, write_positions, write_rate
from srm_mbs.model.forces import ForceElement, Wrench
from srm_mbs.model.mechanism import SimulationDefaults, Source, VariantMaker
from srm_mbs.model.numbers import vector_elements
from srm_mbs.model.validation import check_inertia, massless_ends, undetermined_joint

log = get_logger(__name__)


def _acting_joints(description: Description) -> Iterator[tuple[str, str]]:
    """Keys of the elements that act on joints, and the names of these."""
    for kind, key in (
        *(("force", "joint"), ("force", "joints")),
        *(("loop", "joints"), ("drive", "joint")),
    ):
        for i, entry in enumerate(getattr(description, kind)):
            names = getattr(entry, key, None) or ()
            for name in [names] if isinstance(names, str) else names:
                yield f"{kind}[{i}].{key}", name


def _check_joint_names(description: Description, model: pin.Model) -> None:
    """Refuse names that are no moving joints, and joints that are locked but act or are given
    twice."""
    known = tuple(vector_elements(model.names)[1:])
    initial = description.initial
    given = [("lock", name) for name in description.lock]
    for part in ("q", "v", "guess"):
        given += [(f"initial.{part}", name) for name in getattr(initial, part)]
    acting = list(_acting_joints(description))
    for where, name in (*given, *acting):
        if name not in known:
            raise InputError(
                f"there is no moving joint {name!r}",
                element=where,
                remedy=known_names(known),
            )
    for where, name in acting:
        if name in description.lock:
            raise InputError(
                f"joint {name!r} is locked",
                element=where,
                remedy=f"Remove the {where.partition('[')[0]}, or the joint from lock",
            )
    for i, name in enumerate(description.lock):
        if name in description.lock[:i]:
            raise InputError(f"joint {name!r} is named twice", element="lock", remedy="Keep one")
    for name in initial.q:
        if name in initial.guess:
            raise InputError(
                f"joint {name!r} is held in initial.q and guessed in initial.guess",
                element="initial.guess",
                remedy="Keep one of the two",
            )


def _check_frames(description: Description, model: pin.Model) -> None:
    """Refuse an anchor's frame name that means two different frames, say a joint's and a link's."""
    for where, anchor in description.anchors():
        if anchor.frame is None:
            continue
        frames = [frame for frame in model.frames if frame.name == anchor.frame]
        for other in frames[1:]:
            same = other.placement.isApprox(frames[0].placement, 1e-12)
            if other.parentJoint != frames[0].parentJoint or not same:
                raise InputError(
                    f"the name {anchor.frame!r} belongs to a joint and to another joint's link",
                    element=f"{where}.frame",
                    remedy="Rename one of them in the URDF, or write link = instead of frame =",
                )


def _without_locked(
    description: Description, model: pin.Model
) -> tuple[pin.Model, dict[str, Any], dict[str, Any], dict[str, Any]]:
    """The model without the locked joints, and q, v and guess of those that remain."""
    initial = description.initial
    q, v, guess = dict(initial.q), dict(initial.v), dict(initial.guess)
    if not description.lock:
        return model, q, v, guess
    frozen = pin.neutral(model)
    for name in description.lock:
        joint = model.joints[model.getJointId(name)]
        for where, values in (("initial.q", q), ("initial.guess", guess)):
            if name in values:
                with naming(element=where):
                    write_position(joint, frozen, name, values.pop(name))
        rate = np.zeros(model.nv)
        with naming(element="initial.v"):
            write_rate(joint, rate, name, v.pop(name, np.zeros(joint.nv)))
        if rate.any():
            raise InputError(
                f"joint {name!r} is locked but has an initial rate",
                element="initial.v",
                remedy="Remove the rate, or the joint from lock",
            )
    return lock_joints(model, list(description.lock), frozen), q, v, guess


def _with_massless_ends(
    description: Description, model: pin.Model
) -> tuple[Description, tuple[str, ...]]:
    """Treat massless moving ends as the description says: lock their joints, or give their bodies
    the inertia of a ball in ``model``; returns the description and notes."""
    treatment = description.massless
    if treatment == "refused":
        return description, ()
    ends = [k for k in massless_ends(model) if model.names[k] not in description.lock]
    if not ends:
        return description, ()
    names = [str(model.names[k]) for k in ends]
    if not isinstance(treatment, str):
        mass, inertia = treatment["mass"], treatment["inertia"]
        for joint in ends:
            model.inertias[joint] = pin.Inertia(mass, np.zeros(3), inertia * np.eye(3))
        return description, (
            f"bodies without inertia at moving ends have {mass:g} kg and {inertia:g} kg m^2 "
            f"(massless): those of {', '.join(map(repr, names))}",
        )
    coupled = sorted(
        {name for entry in description.loop for name in entry.joints or ()}.intersection(names)
    )
    left_out = f", and their couplings left out: {', '.join(map(repr, coupled))}" if coupled else ""
    return description.with_locked(names), (
        'joints that move nothing with inertia are locked (massless = "fix"): '
        f"{', '.join(map(repr, names))}{left_out}",
    )


def _friction_note(
    model: pin.Model, forces: tuple[ForceElement, ...], friction_speed: float
) -> tuple[str, ...]:
    if not model.friction.any() and not any(getattr(force, "friction", 0.0) for force in forces):
        return ()
    return (
        "joint friction F acts as F tanh(v/v_s) with v_s = "
        f"{friction_speed:g} rad/s or m/s: set it with friction_speed",
    )


@dataclass(frozen=True, eq=False)
class Reading:
    """A file as it was read.

    Attributes
    ----------
    description, entries
        The checked description, and its tables; those of a variant may still have the section
        [planar].
    tree
        Root element of its URDF; building the mechanism changes it.
    source
        The texts of both.
    notes
        Sentences about approximations and ignored elements.
    kind
        The class of the mechanism.
    variants
        Reads it again with other values of its parameters; None without parameters.
    analysis
        That of another variant of the description, if it is one.
    file_terms, parts, model, vary
        As of :class:`~srm_mbs.formats.translation.Translation`.
    overridable
        The numbers of a URDF that its description changes, if variants may change them again.
    elements
        Its elements, where they are not made from the tables of the description.
    """

    description: Description
    entries: Mapping[str, Any]
    tree: Element
    source: Source
    notes: tuple[str, ...] = ()
    file_terms: FileTerms | None = None
    kind: type[Mechanism] = Mechanism
    variants: VariantMaker | None = None
    analysis: ReusableAnalysis | None = None
    parts: TreeParts | None = None
    model: pin.Model | None = None
    elements: Elements | None = None
    vary: Callable[[Sequence[Place]], NumbersOfVariants | None] | None = None
    overridable: OverridableTree | None = None


def unassembled(
    reading: Reading, tables: bool = True
) -> tuple[Mechanism, dict[str, Any], dict[str, Any]]:
    """The mechanism with the guess as its q0, and the held positions and rates by joint.

    Without ``tables``, drives and forces that may need tables from other files are left out.

    Raises
    ------
    InputError
        Naming file, element and remedy.
    """
    description, source = reading.description, reading.source
    if reading.model is not None:
        built = UrdfModel(reading.model, ())
    else:
        locked, coupled = description.lock, description.coupled_joints()
        built = build_urdf(reading.tree, source.urdf_path, source.base, locked, coupled)
    built.model.gravity.linear = np.array(source.gravity)
    description, massless = _with_massless_ends(description, built.model)
    if reading.elements is None:  # others have the names of a variant that was checked
        _check_joint_names(description, built.model)
    model, q, v, guess = _without_locked(description, built.model)
    if reading.model is None:  # the start of variants decides
        check_inertia(model, source.urdf_path)
    elements = reading.elements
    if elements is None:
        _check_frames(description, model)
    start = pin.neutral(model)
    for where, values in (("initial.guess", guess), ("initial.q", q)):
        with naming(element=where):
            write_positions(model, start, values)
    for name, value in v.items():
        with naming(element="initial.v"):
            write_rate(model.joints[model.getJointId(name)], np.zeros(model.nv), name, value)
    defaults = description.simulation
    reads = tables and (description.force or description.drive)
    csv = CsvFolder(Path(source.path).parent, source.reach) if reads else None
    friction_speed = description.friction_speed
    actuators, idle = description.named_actuators()
    forces = (
        *description.force_elements(csv),
        *_compensation(reading, model, np.array(source.gravity)),
    )
    parts: dict[str, Any] = {
        "model": model,
        "loops": description.closures() if elements is None else elements.closures,
        "q0": start,
        "forces": forces,
        "drives": description.drives(csv) if csv else (),
        "friction_speed": friction_speed,
        "name": description.name or model.name,
        "source": source,
        "defaults": SimulationDefaults(defaults.t_end, defaults.rtol, defaults.atol),
        "notes": (
            *reading.notes,
            *built.notes,
            *massless,
            *idle,
            *_friction_note(model, forces, friction_speed),
        ),
        "points": description.named_points() if elements is None else elements.points,
        "actuators": actuators,
    }
    if elements is None:
        mechanism = reading.kind(**parts)
    else:
        mechanism = reading.kind.of_checked(elements.tree_results, **parts)
    if description.limits == "spring":
        mechanism = _with_limit_springs(mechanism)
    return mechanism, q, v


def _with_limit_springs(mechanism: Mechanism) -> Mechanism:
    """The mechanism with springs at its joint limits, and a note about them."""
    springs = limit_springs(mechanism)
    values = ", ".join(f"{s.joint} {s.stiffness:.3g} and {s.damping:.3g}" for s in springs)
    note = (
        "springs act at the joint limits, stiffness (N m/rad, N/m) and damping (per second): "
        f"{values}; give [[force]] entries of type limit_spring for others"
        if springs
        else "no joint has limits at which a spring could act"
    )
    return replace(mechanism, forces=(*mechanism.forces, *springs), notes=(*mechanism.notes, note))


def _compensation(
    reading: Reading, model: pin.Model, gravity: FloatArray
) -> Iterator[ForceElement]:
    """The forces of ``gravity_compensation``, which carry a part of the weight of links.

    ``gravity`` (3,) m/s^2 is that of the model; links on the ground need no force.
    """
    links = {link.get("name", ""): link for link in reading.tree.findall("link")}
    for name, part in reading.description.gravity_compensation.items():
        if name not in links:
            raise InputError(
                f"there is no link {name!r}",
                element="gravity_compensation",
                remedy=known_names(links),
            )
        inertial = links[name].find("inertial")
        frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
        if inertial is None or frame.parentJoint == 0:
            continue
        mass, origin = inertial.find("mass"), inertial.find("origin")
        given = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
        x, y, z = map(float, given.split())
        force = -part * float("0" if mass is None else mass.get("value", "0")) * gravity
        if force.any():
            yield Wrench(
                Anchor(link=name, xyz=(x, y, z)),
                tuple(force.tolist()),
                name=f"{name}::gravity_compensation",
            )


def rebuild(source: Source) -> Mechanism:
    """The mechanism of a saved run without its drives; its q0 is the guess of the description, not
    assembled."""
    entries = parse_toml(source.description, source.path)
    description = check_description(entries, source.path)
    tree = parse_xml(source.urdf, source.urdf_path)
    return unassembled(Reading(description, entries, tree, source), tables=False)[0]


def _in_gimbal_lock(source: Source, why: str) -> InputError:
    return InputError(
        f"where the loops are closed the accelerations are not determined: {why}",
        file=source.path,
        element="initial",
        remedy="Give another guess, or inertia to massless links whose axes may be in line there "
        "(gimbal lock)",
    )


ROTOR_INERTIA = 1e-9
"""Inertia of a rotor on a damped joint without any in one direction, over the composite inertia:
less than tolerances show, and enough for accelerations to be above rounding."""


def _with_rotors(mechanism: Mechanism) -> tuple[Mechanism, int | None]:
    """The mechanism with rotors on damped joints that move no inertia at the start, and a note; and
    a joint that moves none still, if there is one.

    Damping d alone determines the motion along such a direction, as for d -> 0 of the inertia.
    """
    model, source = mechanism.model, mechanism.source
    bodies = bodies_at_start(mechanism)
    if bodies is not None and bodies.least_inertia > BEYOND_ROUNDING * ROTOR_INERTIA:
        return mechanism, None
    armature = np.array(model.armature)
    path = None if source is None else source.urdf_path
    names: list[str] = []
    at: int | None = None
    for _ in range(model.njoints):
        at = undetermined_joint(model, mechanism.q0, path, ROTOR_INERTIA)
        if at is None:  # then none moves less, either
            break
        own = slice(model.idx_vs[at], model.idx_vs[at] + model.nvs[at])
        if not model.damping[own].all():
            break
        if not names:
            model = model.copy()
        names.append(model.names[at])
        composite = np.diag(pin.crba(model, workspace(model), mechanism.q0))
        armature[own] += 2.0 * ROTOR_INERTIA * composite[own]
        model.armature = armature
    if at is not None:
        at = undetermined_joint(model, mechanism.q0, path)
    if not names:
        return mechanism, at
    note = (
        f"the inertia that {', '.join(map(repr, names))} moves vanishes in one direction at the "
        f"start: damping determines the motion there, and a rotor of {2.0 * ROTOR_INERTIA:g} of "
        "what the joint carries is added; give the links at its end a moment of inertia"
    )
    return replace(mechanism, model=model, notes=(*mechanism.notes, note)), at


ALMOST_CLOSED = 1e-5
"""Gap (m, rad) of loops below which the digits of the file may be the reason."""


def _advice(error: AssemblyError) -> str:
    """A further remedy for loops that almost close."""
    gaps = [size for pair in error.residuals.values() for size in pair if size is not None]
    if error.limits or error.element == "closing_tolerance":
        return ""
    if not CONSTRAINT_TOLERANCE < max(gaps, default=0.0) < ALMOST_CLOSED:
        return ""
    return (
        f". Loops that are overconstrained and close to {max(gaps):.1e} (m, rad), the accuracy of "
        "their file, load with closing_tolerance of that size (--closing-tolerance)"
    )


def _analysed(mechanism: Mechanism, reading: Reading) -> None:
    """Analyse a mechanism where its loops are closed, unless the analysis of another variant is
    valid for it."""
    analysis = reading.analysis
    if analysis is not None and structure_of.kept(mechanism) is None:
        structure = analysis.for_variant(mechanism)
        if structure is not None:
            structure_of.keep(mechanism, structure)
            if reading.model is not None:
                analysis.lend_rows_in_use(mechanism)
    _ = mechanism.structure


def _started(
    mechanism: Mechanism, reading: Reading, q: Mapping[str, Any], v: Mapping[str, Any]
) -> tuple[Mechanism, int | None]:
    """The mechanism in a consistent start, and a joint that moves no inertia there.

    Joints of a variant that all move inertia at the start do so elsewhere; whether others do is
    looked at here, and comes before what else is wrong with them.
    """
    try:
        found = consistent_start(mechanism, q, v).mechanism
        started, joint = _with_rotors(found)
        moves = joint is None and started is found
    except (AssemblyError, EvaluationError):
        if reading.model is not None:
            check_inertia(mechanism.model, reading.source.urdf_path)
        raise
    if reading.model is not None and not moves:
        check_inertia(mechanism.model, reading.source.urdf_path)
    return started, joint


def _doubtful_angles(mechanism: Mechanism, reading: Reading) -> list[str]:
    """Sentences about angles that may be in degrees."""
    initial, terms = reading.description.initial, reading.file_terms
    return [
        *doubtful_angles(mechanism, "initial.q", initial.q, terms),
        *doubtful_angles(mechanism, "initial.guess", initial.guess, terms),
        *(() if reading.analysis is not None else doubtful_rotations(mechanism, reading.tree)),
    ]


def _with_doubts(mechanism: Mechanism, reading: Reading) -> Mechanism:
    """The mechanism with notes about values that look like those of other units, and about an axis
    that keeps a loop from moving; warnings say the same."""
    doubts = [
        *_doubtful_angles(mechanism, reading),
        # Moments of inertia in other units than the lengths say nothing about the lengths.
        *(list(doubtful_inertias(mechanism)) or doubtful_lengths(mechanism)),
    ]
    if mechanism.loops and mechanism.degrees_of_freedom == 0 and not mechanism.drives:
        inclined = inclined_axes(mechanism).values()
        doubts += [f"the mechanism cannot move: {clause}. {CORRECT_AXIS}" for clause in inclined]
    if not doubts:
        return mechanism
    name = mechanism.name if mechanism.source is None else mechanism.source.path
    for doubt in doubts:
        warnings.warn(f"{name}: {doubt}", SrmWarning, stacklevel=2)
    noted = replace(mechanism, notes=(*mechanism.notes, *doubts))
    structure_of.keep(noted, mechanism.structure)
    return noted


def assembled(reading: Reading) -> Mechanism:
    """The mechanism with its loops closed.

    Raises
    ------
    InputError, AssemblyError
        As :func:`srm_mbs.load`.
    """
    description, source = reading.description, reading.source
    if reading.elements is None:
        description.refuse_identical_closures()
    mechanism, q, v = unassembled(reading)
    if reading.analysis is not None and reading.model is not None:
        reading.analysis.lend_rows(mechanism)
    try:
        if description.closing_tolerance:
            reduced, note = without_implied_rows(mechanism, description.closing_tolerance)
            if note:
                mechanism = replace(reduced, notes=(*reduced.notes, note))
        # The mass matrix has to be regular before the analysis factorises it.
        mechanism, joint = _started(mechanism, reading, q, v)
        if joint is None:
            _analysed(mechanism, reading)
    except AssemblyError as error:
        if reading.file_terms is not None:
            reading.file_terms.explain(error)
        error.remedy = ". ".join(
            (error.remedy + _advice(error), *_doubtful_angles(mechanism, reading))
        )
        if description.lock:
            locked = ", ".join(map(repr, description.lock))
            error.remedy = f"{error.remedy}. Locked, so that they cannot help: {locked}"
        raise
    except EvaluationError as error:
        raise _in_gimbal_lock(source, str(error)) from error
    if joint is not None:
        raise _in_gimbal_lock(
            source, f"the joint {mechanism.model.names[joint]!r} moves no inertia there"
        )
    if reading.file_terms is not None:
        reading.file_terms.check(mechanism)
    mechanism = _with_doubts(mechanism, reading)
    log.info(
        "%s: %d degrees of freedom, rank %d",
        mechanism.name,
        mechanism.degrees_of_freedom,
        mechanism.structure.rank,
    )
    return mechanism
