"""Parallel robots: a Stewart platform and a delta robot."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from tools.models.description import header, join, point, toml
from tools.models.urdf_text import (
    Shape,
    Urdf,
    Vector,
    ball,
    bar,
    disc,
    tube,
    vector,
)

X, Y, Z = np.eye(3)
NOWHERE = np.zeros(3)


def _ring(radius: float, angles: list[float], height: float) -> list[Vector]:
    return [vector(radius * np.cos(a), radius * np.sin(a), height) for a in angles]


def _plate(corners: list[Vector], material: str) -> tuple[Shape, ...]:
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


def _plate_small(corners: list[Vector]) -> tuple[Shape, ...]:
    return tuple(ball(corner, 0.012, "dark") for corner in corners)


PARALLEL: dict[str, Callable[[], tuple[str, str]]] = {
    "stewart_platform": stewart_platform,
    "delta_robot": delta_robot,
}
