"""Values that look like those of other units: what is noted and warned of when a file is loaded."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs.assembly.regular_start import BEYOND_ROUNDING, bodies_at_start
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import (
    anchor_points,
    body_numbers,
    coordinate_units,
    is_angle,
    numbers_of_tree,
    scene_diagonal,
)
from srm_mbs.formats.translation import FileTerms
from srm_mbs.model.numbers import vector_elements

LARGEST_ANGLE = 4.0 * math.pi
"""Angle (rad) of a start or of a frame above which it may be in degrees."""
LARGEST_GYRATION = 10.0
"""Radius of gyration of a body, over the size of the mechanism, above which a unit is doubtful."""
SMALLEST_GYRATION = 1e-3
"""The same over the size of the body, below which it is; point masses have none."""
LEAST_DENSITY = 1e-3
"""Mean density (kg/m^3) of the bodies of a mechanism below which its lengths are doubtful: a
thousandth of that of air.  Lengths in mm make steel 8e-6 of it, the bundled mechanisms have 40 and
more."""


def doubtful_angles(
    mechanism: Mechanism, element: str, values: Mapping[str, Any], terms: FileTerms | None
) -> Iterator[str]:
    """Sentences about angles among ``values`` of ``element``, joint -> position, that may be in
    degrees; ``terms`` as of a :class:`~srm_mbs.formats.translation.Translation`."""
    for name, value in values.items():
        single = isinstance(value, int | float) and abs(value) > LARGEST_ANGLE
        if single and name in mechanism.joint_names and is_angle(mechanism.model, name):
            given = None if terms is None else terms.written(name)
            key, unit, factor = given or (element, "rad", 1.0)
            yield f"{key}: the angle {value / factor:g} of the joint {name!r} {_doubt(value, unit)}"


def doubtful_rotations(mechanism: Mechanism, tree: Element) -> Iterator[str]:
    """Sentences about frames of the URDF ``tree`` and of closures whose ``rpy`` may be in
    degrees."""
    placed = [
        (f"{node.tag} {node.get('name')!r}", tuple(map(float, origin.get("rpy", "0").split())))
        for node in tree
        for origin in node.iter("origin")
    ]
    placed += [
        (f"loop {loop.name!r}", anchor.rpy) for loop in mechanism.loops for anchor in loop.anchors
    ]
    for element, angles in placed:
        largest = max(angles, key=abs, default=0.0)
        if abs(largest) > LARGEST_ANGLE:
            yield f"{element}: the angle {largest:g} of rpy {_doubt(largest, 'rad')}"


def _doubt(angle: float, unit: str) -> str:
    """Why an ``angle`` (rad) that is written in ``unit`` is doubtful."""
    degrees = f", and {angle:g} degrees are {math.radians(angle):.6g} rad" * (unit == "rad")
    return f"is more than two turns: angles are in {unit}{degrees}"


def doubtful_inertias(mechanism: Mechanism) -> Iterator[str]:
    """Sentences about bodies whose mass and moments of inertia do not fit to each other, or to the
    size of the body or of the mechanism at q0.

    The size of a body is the largest distance of its joints, anchors and centre of mass from the
    origin of the joint that moves it.
    """
    bodies = bodies_at_start(mechanism)
    if (
        bodies is not None
        and bodies.least_gyration > BEYOND_ROUNDING * SMALLEST_GYRATION
        and BEYOND_ROUNDING * bodies.largest_gyration < LARGEST_GYRATION
    ):
        return
    model = mechanism.model
    # Known from the analysis; 1 also where all points are one.
    scene = coordinate_units(mechanism, mechanism.q0, mechanism.v0).length
    if scene == 1.0:
        scene = scene_diagonal(mechanism, mechanism.q0)
    sizes = [0.0] * model.njoints
    parents = vector_elements(model.parents)
    places = numbers_of_tree(mechanism).placements[:, 9:].tolist()
    ends = [(parents[joint], places[joint]) for joint in range(1, model.njoints)]
    ends += anchor_points(mechanism)
    for joint, place in ends:
        sizes[joint] = max(sizes[joint], math.hypot(*place))
    for joint, body in islice(enumerate(body_numbers(mechanism)), 1, None):
        half_trace = 0.5 * body.trace
        if body.mass == 0.0:
            if half_trace > 0.0:
                yield (
                    f"{_body(model, joint)} has moments of inertia, {half_trace:.3g} kg m^2, and "
                    "no mass: give its links a mass"
                )
            continue
        # The largest principal moment of a real body is a third to a half of the trace.
        gyration = math.sqrt(half_trace / body.mass)
        size = max(sizes[joint], math.hypot(*body.lever))
        if gyration > LARGEST_GYRATION * scene > 0.0:
            yield (
                f"{_body(model, joint)} has a radius of gyration of {gyration:.3g} m in a "
                f"mechanism of {scene:.3g} m: moments of inertia are in kg m^2 "
                "(1 kg mm^2 is 1e-6 kg m^2), and lengths in m"
            )
        elif 0.0 < gyration < SMALLEST_GYRATION * size:
            yield (
                f"{_body(model, joint)} has a radius of gyration of {gyration:.3g} m and a size of "
                f"{size:.3g} m: lengths are in m (1 mm is 0.001 m), and moments of inertia in "
                "kg m^2"
            )


def doubtful_lengths(mechanism: Mechanism) -> Iterator[str]:
    """A sentence about bodies that are too light for their size, as with lengths, and moments of
    inertia with them, in mm.

    The volume of a body is that of the homogeneous cuboid with its mass and principal moments of
    inertia I_k about its centre of mass, with edges a_k^2 = 6 (trace - 2 I_k)/m; that of a rod or
    plate without thickness is zero.
    """
    bodies = numbers_of_tree(mechanism).bodies[1:]
    bodies = bodies[bodies[:, 0] > 0.0]
    masses, moments = bodies[:, 0], bodies[:, 4:]
    mass = float(masses.sum())
    # Edges of a cube have 2 trace/m each, which is the largest volume for the trace.
    squares = 2.0 * np.maximum(moments[:, [0, 3, 5]].sum(axis=1), 0.0) / masses
    if mass >= LEAST_DENSITY * float((squares**1.5).sum()):
        return
    principal = np.linalg.eigvalsh(moments[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]])
    squares = 6.0 * (principal.sum(axis=1, keepdims=True) - 2.0 * principal) / masses[:, None]
    volume = float(np.sqrt(np.maximum(squares, 0.0).prod(axis=1)).sum())
    if mass < LEAST_DENSITY * volume:
        yield (
            f"the bodies have {mass:.3g} kg, and by their moments of inertia {volume:.3g} m^3, so "
            f"that they are lighter than air ({mass / volume:.1g} kg/m^3): lengths are in m (1 mm "
            "is 0.001 m), and moments of inertia in kg m^2 (1 kg mm^2 is 1e-6 kg m^2)"
        )


def _body(model: pin.Model, joint: int) -> str:
    links = (
        frame.name
        for frame in model.frames
        if frame.type == pin.FrameType.BODY and frame.parentJoint == joint
    )
    return f"the body of the joint {model.names[joint]!r} ({', '.join(map(repr, links))})"
