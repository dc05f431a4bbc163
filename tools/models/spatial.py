"""IFToMM problems A01, A04 and A05, and the spatial slider-crank."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tools.models.description import header, join, point, toml
from tools.models.urdf_text import (
    Mass,
    Urdf,
    ball,
    bar,
    box,
    brick,
    tube,
    vector,
)

X, Y, Z = np.eye(3)
NOWHERE = np.zeros(3)


def simple_pendulum() -> tuple[str, str]:
    """IFToMM A01."""
    name = "simple_pendulum"
    urdf = Urdf(name, "A point mass of 1 kg on a massless bar of 1 m (IFToMM A01).")
    urdf.link("world", None, (box(vector(0.3, 0.12, 0.05), vector(0.0, 0.0, 0.06), "grey"),))
    urdf.link(
        "pendulum",
        Mass(1.0, X, np.zeros((3, 3))),
        (
            tube(NOWHERE, X, 0.015, "blue"),
            tube(-0.05 * Y, 0.05 * Y, 0.03, "dark"),
            ball(X, 0.06, "orange"),
        ),
    )
    urdf.joint("pendulum", "revolute", "world", "pendulum", NOWHERE, -Y)
    text = header(
        name,
        "Benchmark A01 of the IFToMM Library of Computational Benchmark Problems: a point mass "
        "of 1 kg on a massless bar of 1 m, let go at rest from the horizontal, on the negative "
        "x axis. No loops: it runs on the forward dynamics alone.",
    )
    rest = (
        "[initial]\nq = { pendulum = 3.141592653589793 }\n\n[simulation]\nt_end = 10.0\nrtol = 1e-8"
    )
    return urdf.text(), join(text, rest)


def bricard() -> tuple[str, str]:
    """IFToMM A04: five bars and the ground along six edges of a cube."""
    name = "bricard"
    corners = [NOWHERE, X, X - Z, X - Z - Y, -Z - Y, -Y]  # x, y, z of the publication: x, z, -y
    axes = [Z, Y, X, Z, Y]
    following = [*axes[1:], X]
    urdf = Urdf(name, "Bricard's mechanism (IFToMM A04): five bars of 1 m and 1 kg, six hinges.")
    hinge = 0.07
    urdf.link(
        "world",
        None,
        (
            tube(-Y, NOWHERE, 0.02, "light_grey"),
            tube(-hinge * Z, hinge * Z, 0.045, "grey"),
            tube(-Y - hinge * X, -Y + hinge * X, 0.045, "grey"),
        ),
    )
    colours = ("blue", "orange", "green", "vermillion", "purple")
    parent, origin = "world", NOWHERE
    for k, (start, end, axis) in enumerate(zip(corners, corners[1:], axes), 1):
        link = f"rod_{k}"
        along, after = end - start, following[k - 1]
        urdf.link(
            link,
            bar(NOWHERE, along, 1.0, 0.1),
            (
                tube(NOWHERE, along, 0.03, colours[k - 1]),
                tube(-hinge * axis, hinge * axis, 0.04, "dark"),
                tube(along - hinge * after, along + hinge * after, 0.045, colours[k - 1]),
            ),
        )
        urdf.joint(f"hinge_{k}", "revolute", parent, link, start - origin, axis)
        parent, origin = link, start
    text = header(
        name,
        "Benchmark A04 of the IFToMM Library of Computational Benchmark Problems, Bricard's "
        "mechanism: six hinges along the edges of a cube, five bars of 1 m, 1 kg and 0.1 m x "
        "0.1 m, let go at rest. Gruebler's count gives 0 degrees of freedom, the truth is 1: "
        "the closure of five rows has rank four wherever it is closed, and never the same row "
        "is the redundant one. x, y, z of the publication are x, z, -y here.",
    )
    loop = (
        '[[loop]]\nname = "hinge_6"\ntype = "revolute"\n'
        f'a = {{ link = "rod_5", xyz = {toml(corners[5] - corners[4])} }}\n'
        f'b = {{ link = "world", xyz = {toml(corners[5])} }}\naxis = [1.0, 0.0, 0.0]\n'
    )
    return urdf.text(), join(text, loop, "[simulation]\nt_end = 10.0\nrtol = 1e-8")


def flyball_governor() -> tuple[str, str]:
    """IFToMM A05: Watt's governor with springs of 8e5 N/m instead of coupler rods."""
    name = "flyball_governor"
    urdf = Urdf(name, "Watt's governor, springs instead of coupler rods (IFToMM A05).")
    density, thin = 3000.0, 0.01
    rod_mass = density * thin * thin
    shaft = brick(vector(thin, thin, 1.0), 0.5 * Z, rod_mass)
    urdf.link("world", None, (tube(-0.1 * Z, NOWHERE, 0.08, "grey"),))
    urdf.link(
        "shaft",
        shaft,
        (
            tube(NOWHERE, Z, 0.012, "light_grey"),
            box(vector(0.1, 0.03, 0.03), Z, "light_grey"),
        ),
    )
    urdf.joint("shaft", "revolute", "world", "shaft", NOWHERE, Z)
    urdf.link(
        "slider",
        brick(vector(0.1, 0.1, 0.1), NOWHERE, density * 1e-3),
        (box(vector(0.1, 0.1, 0.1), NOWHERE, "green"),),
    )
    urdf.joint("slider", "prismatic", "shaft", "slider", 0.5 * Z, Z)
    down = vector(np.cos(np.pi / 6.0), 0.0, -0.5)
    forces = []
    for side, sign, colour in (("left", -1.0, "blue"), ("right", 1.0, "orange")):
        along = down * vector(sign, 1.0, 1.0)
        mass = bar(NOWHERE, along, rod_mass, thin) + Mass(5.0, along, np.zeros((3, 3)))
        shapes = (
            tube(NOWHERE, along, 0.012, colour),
            tube(-0.03 * Y, 0.03 * Y, 0.02, "dark"),
            ball(along, 0.07, colour),
        )
        urdf.link(f"{side}_rod", mass, shapes)
        # Both angles count downwards, so that the symmetric motion has equal ones.
        urdf.joint(f"{side}_rod", "revolute", "shaft", f"{side}_rod", Z + sign * 0.05 * X, sign * Y)
        forces.append(
            f'[[force]]\nname = "{side}_spring"\ntype = "spring_damper"\n'
            f'a = {{ link = "{side}_rod", xyz = {toml(0.5 * along)} }}\n'
            f'b = {{ link = "slider", xyz = {toml(vector(sign * 0.05, 0.0, 0.0))} }}\n'
            "stiffness = 8e5       # N/m\n"
            "damping = 4e4         # N s/m\nrest_length = 0.5     # m"
        )
    text = header(
        name,
        "Benchmark A05 of the IFToMM Library of Computational Benchmark Problems, the stiff "
        "governor: a shaft that starts with 2 pi rad/s, two rods of 1 m at 30 degrees below the "
        "horizontal with 5 kg at their ends, and a slider of 3 kg that stiff spring-dampers "
        "hold from the middles of the rods. The slider starts 0.5 m above the foot of the shaft "
        "(its coordinate counts from there). Stiff: the dampers' time constant of 4e-5 s limits "
        "explicit steps to some 1e-4 s.",
    )
    rest = "[initial]\nv = { shaft = 6.283185307179586 }\n\n[simulation]\nt_end = 10.0\nrtol = 1e-6"
    return urdf.text(), join(text, *forces, rest)


def spatial_slider_crank() -> tuple[str, str]:
    """Rigid spatial slider-crank of the IFToMM library (after Haug)."""
    name = "spatial_slider_crank"
    crank, rod = 0.08, 0.3
    pivot = vector(0.0, 0.1, 0.12)
    tip = pivot + crank * Z
    slider = vector(np.sqrt(rod**2 - tip[1] ** 2 - tip[2] ** 2), 0.0, 0.0)
    along = tip - slider
    u = along / rod
    inertia = 0.004 * (np.eye(3) - np.outer(u, u)) + 0.0004 * np.outer(u, u)
    urdf = Urdf(name, "Rigid spatial slider-crank of the IFToMM library, after Haug.")
    urdf.link(
        "world",
        None,
        (
            tube(pivot - 0.05 * X, pivot - 0.012 * X, 0.02, "grey"),
            box(vector(0.016, 0.03, 0.12), vector(-0.04, 0.1, 0.06), "grey"),
            box(vector(0.34, 0.06, 0.01), vector(0.13, 0.0, -0.02), "light_grey"),
            box(vector(0.36, 0.2, 0.01), vector(0.1, 0.04, -0.03), "light_grey"),
        ),
    )
    urdf.link(
        "crank",
        Mass(0.12, 0.5 * crank * Z, np.diag([1e-4, 1e-4, 1e-5])),
        (
            tube(NOWHERE, crank * Z, 0.007, "blue"),
            tube(-0.02 * X, 0.008 * X, 0.01, "dark"),
            ball(crank * Z, 0.012, "dark"),
        ),
    )
    urdf.joint("crank", "revolute", "world", "crank", pivot, X)
    urdf.link(
        "slider",
        Mass(2.0, NOWHERE, 1e-4 * np.eye(3)),
        (box(vector(0.05, 0.035, 0.03), NOWHERE, "green"),),
    )
    urdf.joint("slider", "prismatic", "world", "slider", slider, X)
    urdf.link("cross")
    urdf.joint("cross", "revolute", "slider", "cross", NOWHERE, Y)
    urdf.link(
        "rod",
        Mass(0.5, 0.5 * along, inertia),
        (tube(NOWHERE, along, 0.006, "orange"), ball(NOWHERE, 0.011, "dark")),
    )
    urdf.joint("rod", "revolute", "cross", "rod", NOWHERE, X)
    text = header(
        name,
        "Rigid spatial slider-crank of the IFToMM Library of Computational Benchmark Problems, "
        "after E. J. Haug (1989): crank 0.08 m and 0.12 kg about x at (0, 0.1, 0.12) m, rod 0.3 "
        "m and 0.5 kg, slider 2 kg along x. The rod has a ball at the crank and a universal "
        "joint at the slider, whose cross lies along y in the slider and along x in the rod at "
        "the start. The crank starts upright with 6 rad/s; one degree of freedom.",
    )
    start = "[initial]\nq = { crank = 0.0 }\nv = { crank = 6.0 }"
    rest = f"{start}\n\n[simulation]\nt_end = 5.0\nrtol = 1e-8"
    loop = point("ball", "rod", along, "crank", crank * Z)
    return urdf.text(), join(text, loop, rest)


SPATIAL: dict[str, Callable[[], tuple[str, str]]] = {
    "simple_pendulum": simple_pendulum,
    "bricard": bricard,
    "flyball_governor": flyball_governor,
    "spatial_slider_crank": spatial_slider_crank,
}
