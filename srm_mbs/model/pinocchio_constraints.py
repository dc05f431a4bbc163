"""Closures as Pinocchio's constraint models, and back.

Pinocchio has two closures: the point (3 rows) and the frame (6 rows), each in an older family,
``RigidConstraintModel``, which ``pin.constraintDynamics`` takes, and a newer one,
``PointAnchorConstraintModel`` and ``FrameAnchorConstraintModel``, also wrapped in
``pin.ConstraintModel``.  Joint 1 of a model carries b here, joint 2 carries a.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.errors import InputError
from srm_mbs.model.anchors import WORLD, Anchor
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.drives import Drive

_KINDS = {"point": pin.ContactType.CONTACT_3D, "frame": pin.ContactType.CONTACT_6D}
_ANCHORS = {pin.PointAnchorConstraintModel: "point", pin.FrameAnchorConstraintModel: "frame"}
_KNOWN = (
    "Use RigidConstraintModel, PointAnchorConstraintModel or FrameAnchorConstraintModel, or give "
    "the closure as a srm.LoopClosure"
)


@dataclass(frozen=True)
class PinocchioConstraints:
    """Closures of a mechanism in Pinocchio's form: :meth:`srm_mbs.Mechanism.to_pinocchio`.

    Attributes
    ----------
    models
        ``pin.StdVec_RigidConstraintModel``, for ``pin.initConstraintDynamics``; in LOCAL frames.
    names
        Names of these closures, in the same order.
    without
        Names of the closures and drives for which Pinocchio has no constraint model.
    """

    models: Any
    names: tuple[str, ...]
    without: tuple[str, ...]


def to_pinocchio(
    model: pin.Model, loops: Sequence[LoopClosure], drives: Sequence[Drive]
) -> PinocchioConstraints:
    """The closures of a mechanism as Pinocchio's constraint models; see
    :meth:`srm_mbs.Mechanism.to_pinocchio`."""
    models, names, without = pin.StdVec_RigidConstraintModel(), [], []
    for loop in loops:
        if loop.type not in _KINDS or loop.without or loop.a is None or loop.b is None:
            without.append(loop.name)
            continue
        (a, in_a), (b, in_b) = loop.a.resolve(model), loop.b.resolve(model)
        rigid = pin.RigidConstraintModel(
            _KINDS[loop.type], model, b, in_b, a, in_a, pin.ReferenceFrame.LOCAL
        )
        rigid.name = loop.name
        models.append(rigid)
        names.append(loop.name)
    without += [drive.name for drive in drives]
    return PinocchioConstraints(models, tuple(names), tuple(without))


def closures_from_pinocchio(model: pin.Model, constraint_models: Any) -> tuple[LoopClosure, ...]:
    """Closures from Pinocchio's constraint models.

    Parameters
    ----------
    model
        The tree that they belong to.  A joint with a constraint needs a frame, as every loader
        gives it one; ``model.addBodyFrame`` makes one.
    constraint_models
        One, or a sequence, of RigidConstraintModel, PointAnchorConstraintModel,
        FrameAnchorConstraintModel, or of these in pin.ConstraintModel.  Baumgarte gains and
        compliances have no meaning here and are left out.

    Raises
    ------
    InputError
        For a model of another kind, one with a desired offset or motion, or a joint without frame.
    """
    given = constraint_models
    try:
        models: Sequence[Any] = list(given) if isinstance(given, Iterable) else [given]
    except Exception:  # objects may raise anything
        models = [given]
    closures: list[LoopClosure] = []
    for k, constraint in enumerate(models):
        closure = _closure(model, constraint, f"constraint_models[{k}]")
        if any(closure.name == other.name for other in closures):
            closure = replace(closure, name=f"{closure.name}_{k}")
        closures.append(closure)
    return tuple(closures)


def _closure(model: pin.Model, constraint: Any, place: str) -> LoopClosure:
    if isinstance(constraint, pin.ConstraintModel):
        constraint = constraint.extract()
    kind = _ANCHORS.get(type(constraint))
    if isinstance(constraint, pin.RigidConstraintModel):
        kind = next((name for name, type_ in _KINDS.items() if type_ == constraint.type), None)
        desired = constraint.desired_contact_placement
        if not desired.isIdentity(1e-12) or np.any(constraint.desired_contact_velocity.vector):
            raise _fault("it has a desired placement or velocity", place)
    if kind is None:
        raise _fault(f"there is no closure for a {type(constraint).__name__}", place)
    for what in ("offset", "velocity"):
        if np.any(np.asarray(getattr(constraint, f"desired_constraint_{what}", 0.0))):
            raise _fault(f"it has a desired {what}", place)
    one = int(constraint.joint1_id), constraint.joint1_placement
    two = int(constraint.joint2_id), constraint.joint2_placement
    if two[0] == 0:  # the world is b
        one, two = two, one
    a, b = _anchor(model, *two, place), _anchor(model, *one, place)
    return LoopClosure(kind, a, b, name=str(getattr(constraint, "name", "") or ""))


def _fault(problem: str, place: str) -> InputError:
    return InputError(problem, element=place, remedy=_KNOWN)


def _anchor(model: pin.Model, joint: int, placement: pin.SE3, place: str) -> Anchor:
    if not 0 <= joint < model.njoints:
        raise _fault(f"it names the joint {joint}, which the model does not have", place)
    where: dict[str, str] = {"link": WORLD}
    inside = placement
    if joint:
        frame = _frame_of(model, joint, place)
        where = {"link" if frame.type == pin.FrameType.BODY else "frame": frame.name}
        inside = frame.placement.actInv(placement)
    return Anchor(
        **where,
        xyz=tuple(inside.translation.tolist()),
        rpy=tuple(pin.rpy.matrixToRpy(inside.rotation).tolist()),
    )


def _frame_of(model: pin.Model, joint: int, place: str) -> pin.Frame:
    """A frame on a joint that can be named: a link, or one whose name is no other's."""
    own = [frame for frame in model.frames if frame.parentJoint == joint]
    names = [frame.name for frame in model.frames]
    own.sort(key=lambda frame: frame.type != pin.FrameType.BODY)  # links come first
    for frame in own:
        if frame.type == pin.FrameType.BODY or names.count(frame.name) == 1:
            return frame
    raise InputError(
        f"the joint {model.names[joint]!r} has no frame of its own name",
        element=place,
        remedy="Add one: model.addBodyFrame(name, joint, pin.SE3.Identity(), 0)",
    )
