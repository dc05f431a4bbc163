r"""Families of mechanisms, generated as a description and a URDF.

The N-four-bar is benchmark A02 of the IFToMM Technical Committee for Multibody Dynamics
(Library of Computational Benchmark Problems): :math:`2N + 1` uniform rods of 1 m and 1 kg,
of which N + 1 are cranks pivoted at (i, 0, 0) and N are couplers between neighbouring crank
tips, under gravity of 9.81 m/s^2.  It starts with the cranks upright and the first crank tip
moving at 1 m/s in +x.  It has one degree of freedom, and N + 1 whenever the cranks are
horizontal.  The common crank angle obeys

.. math:: I \ddot\theta = -g W \cos\theta, \quad I = (N + 1)/3 + N, \quad W = (N + 1)/2 + N,

with :math:`\theta(0) = \pi/2`, :math:`\dot\theta(0) = -1`; at t = 10 s the first crank tip is at
x = 0.3284581115, z = 0.9445185382 (N = 2) and x = 0.1805122267, z = 0.9835727406 (N = 40).
"""

from __future__ import annotations

import math

LENGTH = 1.0  # m, every rod
MASS = 1.0  # kg, every rod
TRANSVERSE_INERTIA = MASS * LENGTH**2 / 12.0  # kg m^2, about the centre
AXIAL_INERTIA = 1e-3 * TRANSVERSE_INERTIA  # small and positive; no effect on a planar motion
UPRIGHT = math.pi / 2.0  # rad, crank angle at the start, from +x towards +z
CRANK_RATE = -1.0  # rad/s: the tip of an upright crank moves at 1 m/s in +x

WIDTH, DEPTH, EYE_RADIUS, PIN_RADIUS = 0.08, 0.04, 0.065, 0.03  # m, how the rods look
GROUND_LAYER, CRANK_LAYER, COUPLER_LAYERS = 0.075, 0.025, (-0.025, -0.075)  # m, y of drawn parts
ALONG_Y = "1.5707963267948966 0 0"  # rpy that lays a URDF cylinder along y

MATERIALS = (  # after Okabe and Ito: colour-blind readers can distinguish them
    ("grey", "0.55 0.57 0.60 1"),
    ("dark", "0.15 0.16 0.18 1"),
    ("blue", "0 0.447 0.698 1"),
    ("orange", "0.902 0.624 0 1"),
)


def n_four_bar(n: int) -> tuple[str, str]:
    """Write the N-four-bar benchmark (IFToMM A02).

    Parameters
    ----------
    n
        Number of four-bar loops, which is the number of couplers.

    Returns
    -------
    toml_text, urdf_text
        The description, which names ``../urdf/n_four_bar_<n>.urdf``, and that URDF.

    Raises
    ------
    ValueError
        If ``n`` is less than 1.
    """
    if n < 1:
        raise ValueError(f"an N-four-bar needs at least one loop, not n = {n}")
    return _description(n), _urdf(n)


def _description(n: int) -> str:
    """Write the TOML text: one closure per coupler; the first crank is held at the start."""
    couplers = "1 coupler" if n == 1 else f"{n} couplers"
    lines = [
        f"# N-four-bar with N = {n}: {n + 1} cranks and {couplers}, uniform rods of 1 m and 1 kg.",
        "# Benchmark A02 of the IFToMM Library of Computational Benchmark Problems. It starts with",
        "# upright cranks, the first crank tip at 1 m/s in +x.",
        f"# Singular when the cranks are horizontal: then {n + 1} degrees of freedom, not 1.",
        "# Written by srm_mbs.n_four_bar.",
        "format = 1",
        f'name = "n_four_bar_{n}"',
        f'urdf = "../urdf/n_four_bar_{n}.urdf"',
        'base = "fixed"',
        "gravity = [0.0, 0.0, -9.81]",
    ]
    for i in range(n):
        lines += [
            "",
            "[[loop]]",
            f'name = "pin_{i}"',
            'type = "point"',
            f'a = {{ link = "coupler_{i}", xyz = [{LENGTH}, 0.0, 0.0] }}',
            f'b = {{ link = "crank_{i + 1}", xyz = [{LENGTH}, 0.0, 0.0] }}',
        ]
    lines += [
        "",
        "[initial]",
        f"q = {{ crank_0 = {UPRIGHT} }}",
        f"v = {{ crank_0 = {CRANK_RATE} }}",
        "",
        "[initial.guess]",
    ]
    for i in range(n):
        lines += [f"coupler_{i} = {-UPRIGHT}", f"crank_{i + 1} = {UPRIGHT}"]
    lines += ["", "[simulation]", "t_end = 10.0", "rtol = 1e-8"]
    return "\n".join(lines) + "\n"


def _urdf(n: int) -> str:
    """Write the URDF text: a tree of N + 1 cranks, all but the last carrying a coupler."""
    lines = [
        '<?xml version="1.0"?>',
        f"<!-- N-four-bar, N = {n} (IFToMM A02); models/n_four_bar_{n}.toml closes its loops.",
        "     Written by srm_mbs.n_four_bar. -->",
        f'<robot name="n_four_bar_{n}">',
    ]
    for material, rgba in MATERIALS:
        lines.append(f'  <material name="{material}"><color rgba="{rgba}"/></material>')
    lines += ["", '  <link name="world">', *_ground(n), "  </link>"]
    for i in range(n + 1):
        front = min(COUPLER_LAYERS[j % 2] for j in (i - 1, i) if 0 <= j < n)
        pins = [*_pin(0.0, GROUND_LAYER, CRANK_LAYER), *_pin(LENGTH, CRANK_LAYER, front)]
        lines += _rod(f"crank_{i}", "blue", CRANK_LAYER, pins)
        lines += _joint(f"crank_{i}", "world", float(i))
        if i < n:
            lines += _rod(f"coupler_{i}", "orange", COUPLER_LAYERS[i % 2], [])
            lines += _joint(f"coupler_{i}", f"crank_{i}", LENGTH)
    lines.append("</robot>")
    return "\n".join(lines) + "\n"


def _ground(n: int) -> list[str]:
    """Draw the ground: a beam beyond the rods and a block at every pivot."""
    beam = f'<box size="{_number(n + 0.4)} {DEPTH} 0.05"/>'
    lines = _visual((n / 2.0, GROUND_LAYER, -0.125), beam, "grey")
    for i in range(n + 1):
        block = f'<box size="0.16 {DEPTH} 0.18"/>'
        lines += _visual((float(i), GROUND_LAYER, -0.02), block, "grey")
    return lines


def _rod(name: str, material: str, layer: float, pins: list[str]) -> list[str]:
    """Write a link: a uniform rod from its origin along +x, drawn at y = ``layer``."""
    bar = f'<box size="{LENGTH} {DEPTH} {WIDTH}"/>'
    eye = f'<cylinder radius="{EYE_RADIUS}" length="{DEPTH}"/>'
    transverse = f'iyy="{TRANSVERSE_INERTIA}" izz="{TRANSVERSE_INERTIA}"'
    return [
        "",
        f'  <link name="{name}">',
        "    <inertial>",
        f'      <origin xyz="{_number(LENGTH / 2.0)} 0 0"/>',
        f'      <mass value="{_number(MASS)}"/>',
        f'      <inertia ixx="{AXIAL_INERTIA}" {transverse} ixy="0" ixz="0" iyz="0"/>',
        "    </inertial>",
        *_visual((LENGTH / 2.0, layer, 0.0), bar, material),
        *_visual((0.0, layer, 0.0), eye, material, ALONG_Y),
        *_visual((LENGTH, layer, 0.0), eye, material, ALONG_Y),
        *pins,
        "  </link>",
    ]


def _pin(x: float, back: float, front: float) -> list[str]:
    """Draw a pin along y through the layers from ``back`` to ``front``."""
    length = back - front + DEPTH + 0.02
    cylinder = f'<cylinder radius="{PIN_RADIUS}" length="{_number(length)}"/>'
    return _visual((x, (back + front) / 2.0, 0.0), cylinder, "dark", ALONG_Y)


def _joint(name: str, parent: str, x: float) -> list[str]:
    """Write the revolute joint that moves the link of the same name, at (x, 0, 0) of ``parent``."""
    return [
        f'  <joint name="{name}" type="revolute">',
        f'    <parent link="{parent}"/>',
        f'    <child link="{name}"/>',
        f'    <origin xyz="{_number(x)} 0 0"/>',
        '    <axis xyz="0 -1 0"/>',
        '    <limit lower="-1e6" upper="1e6" effort="1e6" velocity="1e6"/>',
        "  </joint>",
    ]


def _visual(
    xyz: tuple[float, float, float], geometry: str, material: str, rpy: str | None = None
) -> list[str]:
    """Write one visual; ``geometry`` is its XML element."""
    place = f'xyz="{" ".join(map(_number, xyz))}"'
    turn = "" if rpy is None else f' rpy="{rpy}"'
    return [
        "    <visual>",
        f"      <origin {place}{turn}/>",
        f"      <geometry>{geometry}</geometry>",
        f'      <material name="{material}"/>',
        "    </visual>",
    ]


def _number(value: float) -> str:
    """Write a drawing or placement length without rounding noise."""
    return f"{value:.10g}"
