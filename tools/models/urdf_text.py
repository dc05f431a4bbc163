"""Links, joints and shapes as URDF text.

Every link is described where the mechanism is drawn: with all joints at zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

Vector = np.ndarray

MATERIALS = {
    "grey": "0.55 0.57 0.60 1",
    "light_grey": "0.72 0.74 0.77 1",
    "dark": "0.15 0.16 0.18 1",
    "blue": "0 0.447 0.698 1",
    "orange": "0.902 0.624 0 1",
    "green": "0 0.620 0.451 1",
    "vermillion": "0.835 0.369 0 1",
    "purple": "0.8 0.475 0.655 1",
    "sky": "0.337 0.706 0.914 1",
}


def vector(*parts: float) -> Vector:
    return np.array(parts, dtype=float)


def numbers(values: Vector | tuple[float, ...]) -> str:
    """Numbers of an attribute, without the rounding noise of zero."""
    return " ".join(
        f"{0.0 if abs(value) < 1e-15 else value:.16g}" for value in np.ravel(np.array(values))
    )


@dataclass(frozen=True)
class Mass:
    """Mass (kg), centre (m) and inertia about the centre (kg m^2), in the axes of the link."""

    mass: float
    centre: Vector
    inertia: Vector

    def __add__(self, other: Mass) -> Mass:
        mass = self.mass + other.mass
        centre = (self.mass * self.centre + other.mass * other.centre) / mass
        return Mass(mass, centre, self._about(centre) + other._about(centre))

    def _about(self, point: Vector) -> Vector:
        """Steiner's rule."""
        d = self.centre - point
        return np.asarray(self.inertia + self.mass * (d @ d * np.eye(3) - np.outer(d, d)))


def bar(start: Vector, end: Vector, mass: float, width: float = 0.0) -> Mass:
    """A uniform bar of square section."""
    along = end - start
    length = float(np.linalg.norm(along))
    u = along / length
    axial = mass * width**2 / 6.0
    transverse = mass * (length**2 + width**2) / 12.0
    inertia = transverse * (np.eye(3) - np.outer(u, u)) + axial * np.outer(u, u)
    return Mass(mass, 0.5 * (start + end), inertia)


def brick(sides: Vector, centre: Vector, mass: float) -> Mass:
    """A uniform box."""
    x, y, z = sides**2
    return Mass(mass, centre, mass / 12.0 * np.diag([y + z, x + z, x + y]))


def disc(axis: Vector, centre: Vector, mass: float, radius: float, height: float) -> Mass:
    """A uniform cylinder."""
    axial = 0.5 * mass * radius**2
    transverse = mass * (3.0 * radius**2 + height**2) / 12.0
    u = axis / np.linalg.norm(axis)
    inertia = transverse * np.eye(3) + (axial - transverse) * np.outer(u, u)
    return Mass(mass, centre, inertia)


def direction(along: Vector) -> Vector:
    """rpy that turn the z axis into ``along``."""
    u = along / np.linalg.norm(along)
    return vector(0.0, np.arctan2(np.hypot(u[0], u[1]), u[2]), np.arctan2(u[1], u[0]))


@dataclass(frozen=True)
class Shape:
    """A primitive and where it is drawn on its link."""

    element: str
    xyz: Vector
    rpy: Vector
    material: str


def box(sides: Vector, xyz: Vector, material: str, rpy: Vector | None = None) -> Shape:
    return Shape(
        f'<box size="{numbers(sides)}"/>', xyz, np.zeros(3) if rpy is None else rpy, material
    )


def tube(start: Vector, end: Vector, radius: float, material: str) -> Shape:
    """A cylinder between two points."""
    length = float(np.linalg.norm(end - start))
    element = f'<cylinder radius="{radius:.10g}" length="{length:.10g}"/>'
    return Shape(element, 0.5 * (start + end), direction(end - start), material)


def ball(xyz: Vector, radius: float, material: str) -> Shape:
    return Shape(f'<sphere radius="{radius:.10g}"/>', xyz, np.zeros(3), material)


@dataclass
class Urdf:
    """A URDF in the making; joints and links appear in the order in which they are added."""

    name: str
    comment: str
    parts: list[str] = field(default_factory=list)

    def link(self, name: str, mass: Mass | None = None, shapes: tuple[Shape, ...] = ()) -> None:
        if mass is None and not shapes:
            self.parts.append(f'  <link name="{name}"/>')
            return
        lines = [f'  <link name="{name}">']
        if mass is not None:
            i = mass.inertia
            tensor = zip(
                ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"),
                (i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]),
            )
            lines += [
                "    <inertial>",
                f'      <origin xyz="{numbers(mass.centre)}"/>',
                f'      <mass value="{mass.mass:.16g}"/>',
                "      <inertia "
                + " ".join(f'{key}="{numbers((float(value),))}"' for key, value in tensor)
                + "/>",
                "    </inertial>",
            ]
        for shape in shapes:
            turn = f' rpy="{numbers(shape.rpy)}"' if np.any(shape.rpy) else ""
            lines += [
                "    <visual>",
                f'      <origin xyz="{numbers(shape.xyz)}"{turn}/>',
                f"      <geometry>{shape.element}</geometry>",
                f'      <material name="{shape.material}"/>',
                "    </visual>",
            ]
        self.parts.append("\n".join([*lines, "  </link>"]))

    def joint(
        self,
        name: str,
        kind: str,
        parent: str,
        child: str,
        xyz: Vector,
        axis: Vector | None = None,
        inside: str = "",
    ) -> None:
        lines = [
            f'  <joint name="{name}" type="{kind}">',
            f'    <parent link="{parent}"/>',
            f'    <child link="{child}"/>',
            f'    <origin xyz="{numbers(xyz)}"/>',
        ]
        if axis is not None:
            lines.append(f'    <axis xyz="{numbers(axis)}"/>')
        if kind in ("revolute", "prismatic"):
            lines.append('    <limit lower="-1e6" upper="1e6" effort="1e6" velocity="1e6"/>')
        if inside:
            lines.append(f"    {inside}")
        self.parts.append("\n".join([*lines, "  </joint>"]))

    def text(self) -> str:
        body = "\n".join(self.parts)
        materials = "\n".join(
            f'  <material name="{name}"><color rgba="{rgba}"/></material>'
            for name, rgba in MATERIALS.items()
            if f'name="{name}"' in body
        )
        return (
            f'<?xml version="1.0"?>\n<!-- {self.comment}\n     Written by tools.models. -->\n'
            f'<robot name="{self.name}">\n{materials}\n\n{body}\n</robot>\n'
        )
