"""A bevel differential, all of whose meshes are couplings."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from tools.models.description import header, join, toml
from tools.models.urdf_text import (
    Shape,
    Urdf,
    Vector,
    bar,
    disc,
    tube,
    vector,
)

X, Y, Z = np.eye(3)
NOWHERE = np.zeros(3)


SIDES = (-0.02, 0.02)


def differential() -> tuple[str, str]:
    """Bevel differential: five meshes as couplings."""
    name = "differential"
    urdf = Urdf(name, "Bevel differential: pinion, ring gear with two spiders, two axle shafts.")
    urdf.link(
        "world",
        None,
        (
            tube(-0.42 * Y, -0.36 * Y, 0.05, "grey"),
            tube(0.36 * Y, 0.42 * Y, 0.05, "grey"),
            tube(0.46 * X - 0.16 * Y, 0.5 * X - 0.16 * Y, 0.05, "grey"),
        ),
    )

    def spoke(radius: float, at: Vector, across: Vector, along: Vector) -> tuple[Shape, ...]:
        """A bar across a disc, which shows that it turns."""
        caps = [tube(at + s * along, at + 1.4 * s * along, 0.3 * radius, "dark") for s in SIDES]
        return (tube(at - radius * across, at + radius * across, 0.012, "dark"), *caps)

    shaft = 0.28 * X - 0.16 * Y
    urdf.link(
        "pinion",
        disc(X, 0.1 * X, 1.0, 0.06, 0.04),
        (
            tube(NOWHERE, 0.03 * X, 0.06, "vermillion"),
            tube(0.03 * X, 0.18 * X, 0.02, "vermillion"),
            *spoke(0.06, 0.035 * X, Y, X),
        ),
    )
    urdf.joint("pinion", "revolute", "world", "pinion", shaft, X)
    ring = -0.14 * Y
    posts = [tube(s * 0.2 * Z + ring, s * 0.2 * Z, 0.018, "blue") for s in (-1.0, 1.0)]
    urdf.link(
        "carrier",
        disc(Y, ring, 4.0, 0.24, 0.03) + bar(-0.2 * Z, 0.2 * Z, 1.0, 0.03),
        (
            *(tube(ring + p, ring + q, 0.016, "blue") for p, q in pairwise(_circle(0.24))),
            *posts,
            tube(-0.2 * Z, 0.2 * Z, 0.012, "blue"),
            tube(ring - 0.24 * X, ring + 0.24 * X, 0.01, "blue"),
        ),
    )
    urdf.joint("carrier", "revolute", "world", "carrier", NOWHERE, Y)
    for mark, s in (("upper", 1.0), ("lower", -1.0)):
        urdf.link(
            f"{mark}_spider",
            disc(Z, NOWHERE, 0.3, 0.06, 0.03),
            (tube(-0.012 * Z, 0.012 * Z, 0.06, "green"), *spoke(0.06, s * 0.013 * Z, X, Z)),
        )
        urdf.joint(f"{mark}_spider", "revolute", "carrier", f"{mark}_spider", s * 0.1 * Z, s * Z)
    for side, s, damping in (("left", -1.0, 0.1), ("right", 1.0, 0.4)):
        urdf.link(
            f"{side}_shaft",
            disc(Y, s * 0.3 * Y, 3.0, 0.15, 0.04),
            (
                tube(s * 0.06 * Y, s * 0.085 * Y, 0.09, "orange"),
                tube(s * 0.085 * Y, s * 0.34 * Y, 0.018, "orange"),
                tube(s * 0.29 * Y, s * 0.33 * Y, 0.15, "light_grey"),
                *spoke(0.15, s * 0.335 * Y, X, Y),
            ),
        )
        brake = f'<dynamics damping="{damping}"/>'
        urdf.joint(f"{side}_shaft", "revolute", "world", f"{side}_shaft", NOWHERE, Y, brake)
    text = header(
        name,
        "Bevel differential: a motor turns the pinion, which turns the ring gear with the two "
        "spiders three times slower; the spiders share the torque between the shafts and let "
        "them turn at different speeds, (left + right) / 2 = carrier. The right wheel is braked "
        "four times as hard as the left. All meshes are couplings: six joints, four couplings, "
        "two degrees of freedom.",
    )
    meshes = [
        _mesh("final_drive", ("pinion", "carrier"), (1.0, -3.0)),
        _mesh("left_mesh", ("left_shaft", "carrier", "upper_spider"), (1.0, -1.0, -0.75)),
        _mesh("right_mesh", ("right_shaft", "carrier", "upper_spider"), (1.0, -1.0, 0.75)),
        _mesh("lower_mesh", ("right_shaft", "carrier", "lower_spider"), (1.0, -1.0, -0.75)),
    ]
    motor = '[[force]]\nname = "motor"\ntype = "torque"\njoint = "pinion"\ntorque = 0.5   # N m'
    return urdf.text(), join(text, *meshes, motor, "[simulation]\nt_end = 5.0\nrtol = 1e-8")


def _circle(radius: float) -> list[Vector]:
    angles = np.linspace(0.0, 2.0 * np.pi, 25)
    return [radius * vector(np.cos(a), 0.0, np.sin(a)) for a in angles]


def _mesh(name: str, joints: tuple[str, ...], coefficients: tuple[float, ...]) -> str:
    names = ", ".join(f'"{joint}"' for joint in joints)
    return (
        f'[[loop]]\nname = "{name}"\ntype = "coupling"\njoints = [{names}]\n'
        f"coefficients = {toml(np.array(coefficients))}"
    )


GEARS: dict[str, Callable[[], tuple[str, str]]] = {"differential": differential}
