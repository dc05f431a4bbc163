"""IFToMM problems A01, A04 and A05, the spatial slider-crank, and parallel robots."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from tools.models.planar import header
from tools.models.urdf_text import (
    Mass,
    Urdf,
    Vector,
    ball,
    bar,
    box,
    brick,
    disc,
    tube,
    vector,
)

X, Y, Z = np.eye(3)
NOWHERE = np.zeros(3)


def toml(values: Vector) -> str:
    """A list of numbers."""
    return "[" + ", ".join(f"{float(v) + 0.0:.17g}" for v in values) + "]"


def point(name: str, a: str, at_a: Vector, b: str, at_b: Vector) -> str:
    return (
        f'[[loop]]\nname = "{name}"\ntype = "point"\n'
        f'a = {{ link = "{a}", xyz = {toml(at_a)} }}\nb = {{ link = "{b}", xyz = {toml(at_b)} }}\n'
    )


def join(*parts: str) -> str:
    return "\n\n".join(part.strip() for part in parts) + "\n"


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


def _ring(radius: float, angles: list[float], height: float) -> list[Vector]:
    return [vector(radius * np.cos(a), radius * np.sin(a), height) for a in angles]


def _plate(corners: list[Vector], material: str) -> tuple[object, ...]:
    closed = [*corners, corners[0]]
    edges = [tube(p, q, 0.022, material) for p, q in pairwise(closed)]
    return (*edges, *(ball(p, 0.035, "dark") for p in corners))


def stewart_platform() -> tuple[str, str]:
    """Six UPS legs; a spring in each."""
    name = "stewart_platform"
    third = 2.0 * np.pi / 3.0
    foot_angles = [k * third + s for k in range(3) for s in (-0.2, 0.2)]
    top_angles = [k * third + s for k in range(3) for s in (-0.85, 0.85)]
    feet = _ring(1.0, foot_angles, 0.0)
    height = 1.1
    tops = _ring(0.6, top_angles, 0.0)
    urdf = Urdf(name, "Stewart platform: six legs, each a universal joint, a slider and a ball.")
    urdf.link("world", None, (*_plate(feet, "grey"),))
    urdf.link(
        "platform",
        disc(Z, NOWHERE, 20.0, 0.6, 0.08),
        (*_plate(tops, "blue"), tube(-0.02 * Z, 0.02 * Z, 0.45, "sky")),
    )
    urdf.joint("platform", "floating", "world", "platform", NOWHERE)
    loops, forces = [], []
    for k, (foot, top) in enumerate(zip(feet, tops), 1):
        along = top + height * Z - foot
        length = float(np.linalg.norm(along))
        u = along / length
        # The cross lies square to the leg, so that both angles start at zero.
        first = np.cross(u, Z) / np.linalg.norm(np.cross(u, Z))
        second = np.cross(u, first)
        urdf.link(f"cross_{k}")
        urdf.joint(f"swing_{k}", "revolute", "world", f"cross_{k}", foot, first)
        urdf.link(
            f"cylinder_{k}",
            bar(NOWHERE, 0.7 * u, 2.0, 0.06),
            (tube(NOWHERE, 0.7 * u, 0.03, "orange"),),
        )
        urdf.joint(f"lean_{k}", "revolute", f"cross_{k}", f"cylinder_{k}", NOWHERE, second)
        urdf.link(
            f"piston_{k}",
            bar(-0.7 * u, NOWHERE, 1.0, 0.03),
            (tube(-0.7 * u, NOWHERE, 0.016, "light_grey"),),
        )
        urdf.joint(f"leg_{k}", "prismatic", f"cylinder_{k}", f"piston_{k}", length * u, u)
        loops.append(point(f"ball_{k}", f"piston_{k}", NOWHERE, "platform", top))
        forces.append(
            f'[[force]]\nname = "spring_{k}"\ntype = "spring_damper"\n'
            f'a = {{ link = "platform", xyz = {toml(top)} }}\n'
            f'b = {{ link = "world", xyz = {toml(foot)} }}\n'
            "stiffness = 4000.0   # N/m\ndamping = 20.0   # N s/m\n"
            f"rest_length = {length:.17g}   # m"
        )
    text = header(
        name,
        "Stewart platform with six UPS legs (universal joint, slider, ball): feet on a circle "
        "of 1 m, a disc of 20 kg and 0.6 m at 1.1 m, legs of 3 kg with a spring-damper in each. "
        "Six degrees of freedom. It starts with a turn about its axis and a push sideways and "
        "settles on its springs.",
    )
    rest = (
        f"[initial]\nq = {{ platform = [0.0, 0.0, {height}, 0.0, 0.0, 0.0, 1.0] }}\n"
        "v = { platform = [0.5, 0.0, 0.0, 0.0, 0.0, 2.0] }\n\n"
        "[simulation]\nt_end = 5.0\nrtol = 1e-8"
    )
    return urdf.text(), join(text, *loops, *forces, rest)


def delta_robot() -> tuple[str, str]:
    """Three arms, six rods: Clavel's robot."""
    name = "delta_robot"
    base, arm, rod, tool, half = 0.2, 0.3, 0.7, 0.06, 0.05
    urdf = Urdf(
        name, "Delta robot: three arms on the ceiling, three pairs of rods, one tool plate."
    )
    third = 2.0 * np.pi / 3.0
    frames = []
    for k in range(3):
        out = vector(np.cos(k * third), np.sin(k * third), 0.0)
        frames.append((out, np.cross(Z, out)))
    ceiling = [tube(-0.03 * Z, 0.03 * Z, 0.16, "grey")]
    for out, side in frames:
        ceiling.append(tube(base * out - 0.06 * side, base * out + 0.06 * side, 0.03, "grey"))
    urdf.link("world", None, tuple(ceiling))
    depth = float(np.sqrt(rod**2 - (base + arm - tool) ** 2))
    plate = disc(Z, NOWHERE, 0.3, tool, 0.01)
    corners = [tool * out + s * half * side for out, side in frames for s in (-1.0, 1.0)]
    urdf.link("tool", plate, (tube(-0.008 * Z, 0.008 * Z, 0.05, "blue"), *_plate_small(corners)))
    urdf.joint("tool", "floating", "world", "tool", NOWHERE)
    loops, forces = [], []
    for k, (out, side) in enumerate(frames, 1):
        elbow = arm * out
        urdf.link(
            f"arm_{k}",
            bar(NOWHERE, elbow, 0.5, 0.03),
            (
                tube(NOWHERE, elbow, 0.018, "orange"),
                tube(elbow - half * side, elbow + half * side, 0.012, "orange"),
            ),
        )
        # Positive angles lift the elbow.
        urdf.joint(f"arm_{k}", "revolute", "world", f"arm_{k}", base * out, -side)
        forces.append(
            f'[[force]]\nname = "motor_{k}"\ntype = "torsion_spring"\njoint = "arm_{k}"\n'
            "stiffness = 8.0   # N m/rad\ndamping = 0.05   # N m s/rad"
        )
        for mark, s in (("a", -1.0), ("b", 1.0)):
            start = s * half * side
            along = (tool - base - arm) * out - depth * Z
            urdf.link(f"cross_{k}{mark}")
            urdf.joint(
                f"lift_{k}{mark}", "revolute", f"arm_{k}", f"cross_{k}{mark}", elbow + start, -side
            )
            second = np.cross(along, side) / rod
            urdf.link(
                f"rod_{k}{mark}",
                bar(NOWHERE, along, 0.1, 0.01),
                (tube(NOWHERE, along, 0.006, "vermillion"), ball(NOWHERE, 0.014, "dark")),
            )
            urdf.joint(
                f"sway_{k}{mark}", "revolute", f"cross_{k}{mark}", f"rod_{k}{mark}", NOWHERE, second
            )
            loops.append(
                point(f"ball_{k}{mark}", f"rod_{k}{mark}", along, "tool", tool * out + start)
            )
    text = header(
        name,
        "Delta robot after R. Clavel: three arms of 0.3 m and 0.5 kg under the ceiling, three "
        "pairs of rods of 0.7 m and 0.1 kg, each on a universal joint at the elbow and a ball "
        "at the tool plate of 0.3 kg. Three degrees of freedom: the plate keeps its "
        "orientation. Torsion springs stand for the motors; the arms start level at different "
        "rates.",
    )
    rest = (
        f"[initial]\nq = {{ arm_1 = 0.0, arm_2 = 0.0, arm_3 = 0.0 }}\n"
        "v = { arm_1 = 3.0, arm_2 = -1.0, arm_3 = 0.0 }\n"
        f"guess = {{ tool = [0.0, 0.0, {-depth:.17g}, 0.0, 0.0, 0.0, 1.0] }}\n\n"
        "[simulation]\nt_end = 5.0\nrtol = 1e-8"
    )
    return urdf.text(), join(text, *loops, *forces, rest)


def _plate_small(corners: list[Vector]) -> tuple[object, ...]:
    return tuple(ball(corner, 0.012, "dark") for corner in corners)


SPATIAL: dict[str, Callable[[], tuple[str, str]]] = {
    "simple_pendulum": simple_pendulum,
    "bricard": bricard,
    "flyball_governor": flyball_governor,
    "spatial_slider_crank": spatial_slider_crank,
    "stewart_platform": stewart_platform,
    "delta_robot": delta_robot,
}
