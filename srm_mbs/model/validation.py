"""Checks of a mechanism as a whole; its closures, forces and drives check themselves.

A tree must be in Pinocchio's order of joints, and its inertias must determine its motion.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, Protocol, TypeVar

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dpotrf

from srm_mbs._kernel.workspace import scratch
from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, known_names, naming, safe_repr
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.numbers import finite_array, named_values, vector_elements

ARTICULATED_INERTIA_TOLERANCE = 1e-13
"""Articulated inertia, over the composite one, below which it is rounding."""
KEPT_MOTIONS = 16
"""Random motions that are kept, by the number of coordinates."""

LOADED = (
    ', or load it with massless="fix", which locks the joints of massless ends, or with '
    'massless={"mass": ..., "inertia": ...}, which gives their links balls of that inertia '
    "(--massless)"
)
"""Remedies for files, where the model was read from one."""


def check_inertia(model: pin.Model, file: str | None = None) -> None:
    """Refuse joints that move no inertia: the equations of motion have no solution.

    ``file`` is the file that the model was read from.

    Raises
    ------
    InputError
        Naming the joint and the links that it moves.
    """
    if model.nv == 0:
        return

    def links(joint: int) -> str:
        names = [
            repr(f.name)
            for f in model.frames
            if f.parentJoint == joint and f.type == pin.FrameType.BODY
        ]
        return ", ".join(names) or "its body"

    for joint in massless_ends(model):
        raise InputError(
            f"neither {links(joint)} nor anything that it carries has inertia",
            file=file,
            element=f"joint {model.names[joint]!r}",
            remedy="Give the moving end of the chain a mass (<inertial> of a URDF)"
            f"{LOADED if file else ''}",
        )
    q = pin.integrate(model, pin.neutral(model), _motion(model.nv))
    at = undetermined_joint(model, q, file)
    if at is not None:
        raise InputError(
            f"the joint moves mass ({links(at)} and what it carries) but no inertia in one "
            "of its directions: its acceleration is not determined",
            file=file,
            element=f"joint {model.names[at]!r}",
            remedy="Give a moment of inertia, or a centre of mass off the axis",
        )


@lru_cache(maxsize=KEPT_MOTIONS)
def _motion(size: int) -> FloatArray:
    """A motion (size,) from the neutral configuration to one in general position; read-only."""
    out = np.random.default_rng(0).uniform(-1.0, 1.0, size)
    out.setflags(write=False)
    return out


def massless_ends(model: pin.Model) -> list[int]:
    """The joints that move neither mass, inertia nor armature of their own, from the root to the
    tips."""
    parents, moves = vector_elements(model.parents), [False] * model.njoints
    for joint in range(model.njoints - 1, 0, -1):
        if moves[joint] or _has_inertia(model.inertias[joint]):
            moves[joint] = moves[parents[joint]] = True
    return [
        joint
        for joint in range(1, model.njoints)
        if not moves[joint]
        and not model.armature[model.idx_vs[joint] : model.idx_vs[joint] + model.nvs[joint]].all()
    ]


def _has_inertia(body: pin.Inertia) -> bool:
    return bool(body.mass or body.inertia.trace())


def undetermined_joint(
    model: pin.Model,
    q: FloatArray,
    file: str | None,
    least: float = ARTICULATED_INERTIA_TOLERANCE,
) -> int | None:
    """A joint with a direction in which it moves no inertia at q (nq,); None if there is none.

    No inertia is one below ``least`` of the composite inertia.

    Examples are an axis through a point mass, and the outer axes of massless links in line.  Such
    joints are found by the pivots of the Cholesky factorisation of M, scaled to a unit diagonal and
    with the tips of the tree first: they are the articulated inertias over M_ii.

    Raises
    ------
    InputError
        If the mass matrix is not finite.
    """
    with np.errstate(all="ignore"):
        # Of M the upper triangle counts: the lower one of what LAPACK reads.
        M = pin.crba(model, scratch(model), q)[::-1, ::-1]
        size = np.sqrt(M.diagonal())
        scaled = M / size[:, None] / size
        finite = math.isfinite(np.add.reduce(M, axis=None))  # then each of them is
    if not finite and not np.isfinite(np.tril(M)).all():
        raise InputError(
            "the mass matrix is not finite",
            file=file,
            remedy="Check the size of the masses, inertias and lengths",
        )
    bad = np.flatnonzero(~(size > 0.0))
    if bad.size:
        failed = int(bad[0])
    else:
        factor, info = dpotrf(scaled, lower=1)
        small = np.flatnonzero(factor.diagonal()[: info - 1 if info else None] ** 2 < least)
        if not small.size and not info:
            return None
        failed = int(small[0]) if small.size else info - 1
    component = model.nv - 1 - failed
    return int(np.searchsorted(model.idx_vs, component, side="right")) - 1


def check_tree(model: pin.Model) -> None:
    """Refuse a tree that cannot move, or whose joints are not in depth-first order, share a name or
    mimic others, or where gravity or damping is not finite, or damping negative.

    Raises
    ------
    InputError
        Naming the fault, or the joint at fault.
    """
    if model.nv == 0:
        raise InputError(
            "nothing in this mechanism can move",
            element="model",
            remedy="Give it at least one joint that is neither fixed nor locked; load its file "
            'with base="floating"; or, if its links have no inertia, with massless={"mass": ..., '
            '"inertia": ...}',
        )
    for what, numbers in (("gravity", model.gravity.vector), ("damping", model.damping)):
        if not np.isfinite(numbers).all():
            raise InputError(
                f"the {what} of the model is not finite: {numbers}",
                element=f"model.{what}",
                remedy="Give finite numbers",
            )
    negative = np.flatnonzero(model.damping < 0.0)
    if negative.size:
        at = int(np.searchsorted(model.idx_vs, negative[0], side="right")) - 1
        damping = model.damping[model.idx_vs[at] : model.idx_vs[at] + model.nvs[at]]
        raise InputError(
            f"the damping of the joint {safe_repr(model.names[at])} is negative: {damping}",
            element="model.damping",
            remedy="Give no negative numbers; a force that feeds energy in is an srm.UserForce",
        )
    names = vector_elements(model.names)
    for joint in vector_elements(model.mimicking_joints):
        raise InputError(
            f"the joint {safe_repr(names[joint])} is a Pinocchio mimic joint",
            element="model",
            remedy="Build the model without it, with a joint of its own and the closure "
            'srm.LoopClosure("coupling", joints=..., ratio=...)',
        )
    if len(set(names)) < len(names):
        ((name, count),) = Counter(names).most_common(1)
        raise InputError(
            f"{count} joints have the name {safe_repr(name)}",
            element="model",
            remedy="Give every joint a name of its own; that of the root is universe",
        )
    _check_order(model)


def _check_order(model: pin.Model) -> None:
    """Refuse joints out of order: Pinocchio's crba would return a wrong mass matrix, silently."""
    parents, branch = vector_elements(model.parents), [0]
    for joint in range(1, model.njoints):
        while branch and branch[-1] != parents[joint]:
            branch.pop()
        branch.append(joint)
        if len(branch) < 2:
            raise InputError(
                f"the joint {model.names[joint]!r} continues a branch that another joint, "
                f"{model.names[joint - 1]!r}, has interrupted",
                element="model",
                remedy="Add the joints depth first, every branch to its tip; Pinocchio's mass "
                "matrix is wrong otherwise",
            )


class _Part(Protocol):
    @property
    def name(self) -> str: ...
    def check(self, model: pin.Model) -> None: ...


Part = TypeVar("Part", bound=_Part)


def checked_elements(
    model: pin.Model, what: str, given: Iterable[Part], types: tuple[type, ...], examples: str
) -> tuple[Part, ...]:
    """The parts of the kind ``what`` (loop, force, drive) of a mechanism, of the ``types`` that the
    equations know, as a tuple; messages show ``examples``.

    Raises
    ------
    InputError
        If they are not several, one is of another type, names repeat, or one does not fit
        ``model``.
    """
    several = isinstance(given, Iterable) and not isinstance(given, str)
    try:
        parts: tuple[Any, ...] = tuple(given) if several else (given,)
    except Exception:  # objects may raise anything
        several, parts = False, (given,)
    if not several or not all(type(part) in types for part in parts):
        for i, part in enumerate(parts):
            base = next((known.__name__ for known in types if isinstance(part, known)), "")
            if base and type(part) not in types:
                raise InputError(
                    f"the class {safe_repr(type(part).__name__)} inherits from {base}, of which "
                    "the equations read the fields alone",
                    element=f"{what}s[{i}]",
                    remedy=f"Give an object of {base} itself, which a function may make",
                )
        raise InputError(
            f"{what}s = {safe_repr(given)} is not a list of {what}s",
            element=f"{what}s",
            remedy=f"Give a list of them, such as {examples}",
        )
    names = [part.name for part in parts]
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                f"the {what} name {safe_repr(name)} is used twice",
                element=f"{what} {safe_repr(name)}",
                remedy=f"Give every {what} its own name",
            )
    for part in parts:
        part.check(model)
    return parts


def without(what: str, parts: Sequence[Part], name: str) -> tuple[Part, ...]:
    """``parts`` (loops, drives) without the one of that name.

    Raises
    ------
    InputError
        If there is none; the message lists those there are.
    """
    kept = tuple(part for part in parts if part.name != name)
    if len(kept) == len(parts):
        known = known_names(repr(part.name) for part in parts)
        raise InputError(f"there is no {what} {safe_repr(name)}", remedy=known)
    return kept


START_ARGUMENTS, STATE_ARGUMENTS = ("q0", "v0"), ("q", "v")
"""Names of an initial state, and of a state where a function takes it."""


def checked_start(
    model: pin.Model, q0: Any, v0: Any, names: tuple[str, str] = START_ARGUMENTS
) -> tuple[FloatArray, FloatArray]:
    """Read-only copies of an initial state, q0 (nq,) and v0 (nv,), which messages call ``names``.

    Raises
    ------
    InputError
        If a shape does not fit, a number is not finite, or a quaternion is not of unit length.
    """
    position, rate = names
    q0 = _frozen_array(q0, model.nq, position)
    if model.nq > model.nv and not pin.isNormalized(model, q0, 1e-9):
        raise InputError(
            f"{position} has a quaternion, or a (cos, sin) pair, that is not of unit length",
            element=position,
            remedy=f"Use pinocchio.normalize(model, {position})",
        )
    return q0, _frozen_array(v0, model.nv, rate)


def _frozen_array(values: Any, size: int, name: str) -> FloatArray:
    array = finite_array(values, (size,))
    if array is None:
        remedy = f"Give {size} finite numbers"
        if isinstance(values, Mapping):
            kind = name[0]  # q or v
            remedy += f"; srm.assemble(mechanism, {kind}=...) makes them from values of joints"
        raise InputError(
            f"{name} does not consist of {size} finite numbers", element=name, remedy=remedy
        )
    array.setflags(write=False)
    return array


def checked_friction_speed(model: pin.Model, friction_speed: Any) -> float:
    """The speed (rad/s, m/s) over which the joint friction of ``model`` changes its sign.

    Raises
    ------
    InputError
        If it is not positive, or the friction is negative or not finite.
    """
    if not (np.isfinite(model.friction).all() and np.all(model.friction >= 0.0)):
        raise InputError(
            "joint friction is negative or not finite",
            element="model.friction",
            remedy="Give values >= 0",
        )
    speed = finite_array(friction_speed, ())
    if speed is None or speed <= 0.0:
        raise InputError(
            f"friction_speed = {safe_repr(friction_speed)} is not a finite positive number",
            element="friction_speed",
            remedy="Give the speed (rad/s, m/s) over which friction changes its sign",
        )
    return float(speed)


def checked_points(model: pin.Model, points: Any) -> dict[str, Anchor]:
    """The named points of a mechanism.

    Raises
    ------
    InputError
        Unless every name is a text and every point an anchor on a link or frame of the model.
    """
    found: dict[str, Anchor] = {}
    links: set[str | None] = set()
    body = pin.FrameType.BODY
    for name, anchor in named_values(points, "points").items():
        element = f"point {safe_repr(name)}"
        if not isinstance(name, str) or not isinstance(anchor, Anchor):
            raise InputError(
                f"{safe_repr(name)}: {safe_repr(anchor)} is not a name and a point of a link",
                element="points",
                remedy='Give for example {"tip": srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))}',
            )
        if anchor.link is None or anchor.link not in links:
            if anchor.link is None or not model.existFrame(anchor.link, body):
                with naming(element=element):
                    anchor.resolve(model)
            links.add(anchor.link)
        found[name] = anchor
    return found
