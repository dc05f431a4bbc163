r"""Mechanisms that come in families: written out as a description and a URDF on demand.

The N-four-bar is benchmark A02 of the IFToMM Technical Committee for Multibody Dynamics
(Library of Computational Benchmark Problems): :math:`2N + 1` uniform rods of 1 m and 1 kg,
of which N + 1 are cranks pivoted at (i, 0, 0) and N are couplers between neighbouring crank
tips, under gravity of 9.81 m/s^2.  It starts with the cranks upright and the first crank tip
moving at 1 m/s in +x.  It has one degree of freedom, and N + 1 whenever the cranks are
horizontal.  The common crank angle obeys

.. math:: I \ddot\theta = -g W \cos\theta, \quad I = (N + 1)/3 + N, \quad W = (N + 1)/2 + N,

with :math:`\theta(0) = \pi/2`, :math:`\dot\theta(0) = -1`; at t = 10 s the first crank tip is at
(0.3284581115, 0.9445185382) for N = 2 and at (0.1805122267, 0.9835727406) for N = 40.
"""

from __future__ import annotations

import math

LENGTH = 1.0  # m, every rod
MASS = 1.0  # kg, every rod
TRANSVERSE_INERTIA = MASS * LENGTH**2 / 12.0  # kg m^2, about the centre
AXIAL_INERTIA = 1e-3 * TRANSVERSE_INERTIA  # small and positive: the motion is planar
UPRIGHT = math.pi / 2.0  # rad, angle of the cranks from +x towards +z at the start
CRANK_RATE = -1.0  # rad/s: the tip of an upright crank moves at 1 m/s in +x

WIDTH, DEPTH, EYE_RADIUS, PIN_RADIUS = 0.08, 0.06, 0.065, 0.03  # m, how the rods look
GROUND_LAYER, CRANK_LAYER, COUPLER_LAYERS = 0.12, 0.04, (-0.04, -0.12)  # m, y of the drawn parts
ALONG_Y = "1.5707963267948966 0 0"  # rpy that lays a URDF cylinder along y

MATERIALS = (  # after Okabe and Ito: told apart by colour-blind readers too
    ("ground", "0.55 0.57 0.60 1"),
    ("pin", "0.15 0.16 0.18 1"),
    ("crank", "0 0.447 0.698 1"),
    ("coupler", "0.902 0.624 0 1"),
)


def n_four_bar(n: int) -> tuple[str, str]:
    """Write the N-four-bar benchmark (IFToMM A02).

    Parameters
    ----------
    n
        Number of couplers, which is the number of four-bar loops.

    Returns
    -------
    toml_text, urdf_text
        The description, which names the URDF ``../urdf/n_four_bar_<n>.urdf``, and that URDF.

    Raises
    ------
    ValueError
        If ``n`` is less than 1.
    """
    if n < 1:
        raise ValueError(f"an N-four-bar needs at least one loop, not n = {n}")
    return _description(n), _urdf(n)


def _description(n: int) -> str:
    """The TOML text: one closure per coupler, the first crank held at the start."""
    first_coupler = f"{-UPRIGHT!r}"
    lines = [
        f"# N-four-bar with N = {n}: benchmark A02 of the IFToMM library of computational benchmark",
        f"# problems. {n + 1} cranks and {n} coupler{'s' if n > 1 else ''}, all uniform rods of"
        " 1 m and 1 kg.",
        "# It starts with upright cranks, the first tip at 1 m/s in +x.",
        f"# Singular whenever the cranks are horizontal: the degrees of freedom jump from 1 to {n + 1}.",
        "# Written by srm_mbs.loading.generated.n_four_bar.",
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
            f'a = {{ link = "coupler_{i}", xyz = [{LENGTH!r}, 0.0, 0.0] }}',
            f'b = {{ link = "crank_{i + 1}", xyz = [{LENGTH!r}, 0.0, 0.0] }}',
        ]
    lines += [
        "",
        "[initial]",
        f"q = {{ crank_0 = {UPRIGHT!r} }}",
        f"v = {{ crank_0 = {CRANK_RATE!r} }}",
        "",
        "[initial.guess]",
    ]
    for i in range(n):
        lines += [f"coupler_{i} = {first_coupler}", f"crank_{i + 1} = {UPRIGHT!r}"]
    lines += ["", "[simulation]", "t_end = 10.0", "rtol = 1e-8"]
    return "\n".join(lines) + "\n"


def _urdf(n: int) -> str:
    """The URDF text: a tree of N + 1 cranks, the first N of which carry a coupler."""
    lines = [
        '<?xml version="1.0"?>',
        f"<!-- N-four-bar, N = {n} (IFToMM A02): loop closures are in models/n_four_bar_{n}.toml.",
        "     Written by srm_mbs.loading.generated.n_four_bar. -->",
        f'<robot name="n_four_bar_{n}">',
    ]
    lines += [
        f'  <material name="{name}"><color rgba="{rgba}"/></material>' for name, rgba in MATERIALS
    ]
    lines += ["", '  <link name="world">', *_ground(n), "  </link>"]
    for i in range(n + 1):
        lines += _rod(f"crank_{i}", "world", float(i), "crank", CRANK_LAYER, GROUND_LAYER)
        if i < n:
            layer = COUPLER_LAYERS[i % 2]
            lines += _rod(f"coupler_{i}", f"crank_{i}", LENGTH, "coupler", layer, CRANK_LAYER)
    lines += ["</robot>"]
    return "\n".join(lines) + "\n"


def _ground(n: int) -> list[str]:
    """Visuals of the ground: a beam behind the rods and a block at every pivot."""
    beam = f'<box size="{n + 0.4:.10g} 0.06 0.05"/>'
    lines = _visual(f"{n / 2.0:.10g} {GROUND_LAYER:.10g} -0.105", beam, "ground")
    for i in range(n + 1):
        block = '<box size="0.16 0.06 0.16"/>'
        lines += _visual(f"{i} {GROUND_LAYER:.10g} -0.02", block, "ground")
    return lines


def _rod(
    name: str, parent: str, x: float, material: str, layer: float, parent_layer: float
) -> list[str]:
    """A link with its revolute joint at (x, 0, 0) of the parent, the rod lying along its +x."""
    box = f'<box size="{LENGTH:.10g} {DEPTH:.10g} {WIDTH:.10g}"/>'
    eye = f'<cylinder radius="{EYE_RADIUS:.10g}" length="{DEPTH:.10g}"/>'
    pin_length = abs(parent_layer - layer) + DEPTH + 0.02
    pin = f'<cylinder radius="{PIN_RADIUS:.10g}" length="{pin_length:.10g}"/>'
    return [
        "",
        f'  <link name="{name}">',
        "    <inertial>",
        f'      <origin xyz="{LENGTH / 2.0:.10g} 0 0"/>',
        f'      <mass value="{MASS:.10g}"/>',
        f'      <inertia ixx="{AXIAL_INERTIA!r}" iyy="{TRANSVERSE_INERTIA!r}"'
        f' izz="{TRANSVERSE_INERTIA!r}" ixy="0" ixz="0" iyz="0"/>',
        "    </inertial>",
        *_visual(f"{LENGTH / 2.0:.10g} {layer:.10g} 0", box, material),
        *_visual(f"0 {layer:.10g} 0", eye, material, ALONG_Y),
        *_visual(f"{LENGTH:.10g} {layer:.10g} 0", eye, material, ALONG_Y),
        *_visual(f"0 {(layer + parent_layer) / 2.0:.10g} 0", pin, "pin", ALONG_Y),
        "  </link>",
        f'  <joint name="{name}" type="revolute">',
        f'    <parent link="{parent}"/>',
        f'    <child link="{name}"/>',
        f'    <origin xyz="{x:.10g} 0 0"/>',
        '    <axis xyz="0 -1 0"/>',
        '    <limit lower="-1e6" upper="1e6" effort="1e6" velocity="1e6"/>',
        "  </joint>",
    ]


def _visual(xyz: str, geometry: str, material: str, rpy: str | None = None) -> list[str]:
    """One URDF visual."""
    turn = "" if rpy is None else f' rpy="{rpy}"'
    return [
        "    <visual>",
        f'      <origin xyz="{xyz}"{turn}/>',
        f"      <geometry>{geometry}</geometry>",
        f'      <material name="{material}"/>',
        "    </visual>",
    ]
