"""Planar linkages from the positions of their pins: six-bars and Theo Jansen's walker.

A link is the list of its pins, where they are when all joints are at zero; bars of one kilogram per
metre join them.  Joints turn about -y, so that positive angles go from x to z.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from tools.models.description import header, join, toml
from tools.models.urdf_text import Mass, Shape, Urdf, Vector, bar, box, tube, vector

AXIS = vector(0.0, -1.0, 0.0)
DENSITY = 1.0  # kg/m


def meeting(a: Vector, from_a: float, b: Vector, from_b: float, left: bool) -> Vector:
    """The point (2,) at given distances from a and b, to the left of the way from a to b or not."""
    apart = b - a
    d = float(np.linalg.norm(apart))
    along = (d * d + from_a**2 - from_b**2) / (2.0 * d)
    across = np.sqrt(from_a**2 - along**2)
    u = apart / d
    normal = vector(-u[1], u[0])
    return np.asarray(a + along * u + (across if left else -across) * normal)


@dataclass
class Linkage:
    """A planar mechanism in the x-z plane.

    Attributes
    ----------
    width
        Width of the bars as they are drawn (m); the layers lie as far apart.
    """

    name: str
    comment: str
    width: float
    urdf: Urdf = field(init=False)
    loops: list[str] = field(default_factory=list)
    origins: dict[str, Vector] = field(default_factory=dict)
    layers: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.urdf = Urdf(self.name, self.comment)
        self.origins["world"] = np.zeros(2)
        self.layers["world"] = 0

    def at(self, point: Vector, link: str) -> Vector:
        """A point of the plane (2,) in the frame of ``link`` (3,)."""
        x, z = point - self.origins[link]
        return vector(x, 0.0, z)

    def ground(self, *pins: Vector) -> None:
        """A post with a foot behind each of the pins that do not move."""
        w = self.width
        shapes: list[Shape] = []
        for x, z in pins:
            shapes += [
                tube(vector(x, 1.5 * w, z), vector(x, 0.5 * w, z), 0.9 * w, "grey"),
                box(vector(1.8 * w, w, 2.5 * w), vector(x, w, z - 1.25 * w), "grey"),
                box(vector(4.0 * w, w, 0.7 * w), vector(x, w, z - 2.85 * w), "grey"),
            ]
        self.urdf.link("world", None, tuple(shapes))

    def link(self, name: str, parent: str, pins: list[Vector], material: str, layer: int) -> None:
        """A link on ``parent``, which it meets at the first of its pins; drawn in ``layer``."""
        self.origins[name], self.layers[name] = pins[0], layer
        w, y = self.width, -layer * self.width
        places = [self.at(pin, name) for pin in pins]
        mass: Mass | None = None
        shapes: list[Shape] = []
        lift = vector(0.0, y, 0.0)
        for start, end in combinations(places, 2):
            own = bar(start, end, DENSITY * float(np.linalg.norm(end - start)), w)
            mass = own if mass is None else mass + own
            shapes.append(tube(start + lift, end + lift, 0.4 * w, material))
        half = vector(0.0, 0.45 * w, 0.0)
        shapes += [tube(p + lift - half, p + lift + half, 0.75 * w, material) for p in places]
        back = -self.layers[parent] * w
        ends = sorted((back, y))
        reach = vector(0.0, 0.5 * w, 0.0)
        shapes.append(
            tube(
                vector(0.0, ends[0], 0.0) - reach,
                vector(0.0, ends[1], 0.0) + reach,
                0.35 * w,
                "dark",
            )
        )
        self.urdf.link(name, mass, tuple(shapes))
        self.urdf.joint(name, "revolute", parent, name, self.at(pins[0], parent), AXIS)

    def pin(self, name: str, a: str, b: str, point: Vector) -> None:
        """Close a loop: a hinge between links a and b; the row out of the plane is always zero."""
        rows = [f'[[loop]]\nname = "{name}"\ntype = "point"']
        for side, link in (("a", a), ("b", b)):
            x, y, z = (f"{float(v):.17g}" for v in self.at(point, link))
            rows.append(f'{side} = {{ link = "{link}", xyz = [{x}, {y}, {z}] }}')
        self.loops.append("\n".join(rows))


def description(linkage: Linkage, text: str, rest: str) -> str:
    return "\n\n".join([header(linkage.name, text).rstrip(), *linkage.loops, rest.strip()]) + "\n"


@dataclass
class Drawing:
    """The same mechanisms as a section ``[planar]``: named points, and bars between them whose mass
    and inertia are those of the links."""

    name: str
    text: str
    width: float
    ground: tuple[str, ...]
    rates: str
    points: dict[str, Vector] = field(default_factory=dict)
    bars: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def _bar(self, name: str) -> str:
        places = [vector(x, 0.0, z) for x, z in (self.points[each] for each in self.bars[name])]
        parts = [
            bar(start, end, DENSITY * float(np.linalg.norm(end - start)), self.width)
            for start, end in combinations(places, 2)
        ]
        whole = parts[0]
        for part in parts[1:]:
            whole = whole + part
        return (
            f'[[planar.bar]]\nname = "{name}"\npoints = {quoted(self.bars[name])}\n'
            f"mass = {whole.mass:.17g}\ninertia = {whole.inertia[1, 1]:.17g}\n"
        )

    def description(self, t_end: str) -> str:
        """The text of the description, whose runs end at ``t_end`` (s)."""
        comment = header(self.name, self.text).partition("urdf =")[0]
        points = "".join(f"{name} = {toml(at)}\n" for name, at in self.points.items())
        return join(
            comment,
            f"[planar]\nground = {quoted(self.ground)}\nrates = {self.rates}\n",
            f"[planar.points]\n{points}",
            *map(self._bar, self.bars),
            f"[simulation]\nt_end = {t_end}\nrtol = 1e-8\n",
        )


def quoted(names: Iterable[str]) -> str:
    """A list of names."""
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


TURNING = """
[initial]
q = { crank = 0.0 }
v = { crank = 8.0 }

[simulation]
t_end = 5.0
rtol = 1e-8
"""
"""Start and run of the six-bars."""


def watt_points() -> dict[str, Vector]:
    """The pins of Watt's six-bar in its pose, A and D on the ground."""
    a, d = vector(0.0, 0.0), vector(1.0, 0.0)
    b = a + 0.3 * vector(np.cos(1.0), np.sin(1.0))
    c = meeting(b, 0.9, d, 0.7, left=True)
    e = meeting(b, 0.75, c, 0.6, left=True)
    f = meeting(d, 1.2, c, 0.6, left=False)
    g = meeting(e, 0.9, f, 0.8, left=True)
    return {"A": a, "B": b, "C": c, "D": d, "E": e, "F": f, "G": g}


def watt_six_bar() -> tuple[str, str]:
    """Watt's chain with a binary ground: two ternary links that meet in a pin."""
    a, b, c, d, e, f, g = watt_points().values()
    plane = Linkage(
        "watt_six_bar",
        "Watt's six-bar: a crank, two ternary links that meet in a pin, and a dyad between them.",
        0.035,
    )
    plane.ground(a, d)
    plane.link("crank", "world", [a, b], "blue", 1)
    plane.link("coupler", "crank", [b, c, e], "orange", 2)
    plane.link("left", "coupler", [e, g], "vermillion", 1)
    plane.link("rocker", "world", [d, c, f], "green", 1)
    plane.link("right", "rocker", [f, g], "purple", 2)
    plane.pin("knee", "coupler", "rocker", c)
    plane.pin("top", "left", "right", g)
    text = description(
        plane,
        "Watt's six-bar linkage: crank 0.3 m, ground 1 m, a ternary coupler and a ternary "
        "rocker that meet in a pin, and a dyad between them; bars of 1 kg per metre. The crank "
        "can turn fully and starts at 1 rad (joint angles count from there) with 8 rad/s. Seven "
        "pins, two loops.",
        TURNING,
    )
    return plane.urdf.text(), text


def watt_six_bar_planar() -> tuple[str, str]:
    """:func:`watt_six_bar` typed in as points and bars."""
    plane = Drawing(
        "watt_six_bar_planar",
        "The bundled watt_six_bar typed in as points and bars. The angle of the crank counts from "
        "the x axis; bars have the masses and inertias of its links.",
        0.035,
        ("A", "D"),
        "{ A = 8.0 }",
        watt_points(),
        {
            "crank": ("A", "B"),
            "coupler": ("B", "C", "E"),
            "left": ("E", "G"),
            "rocker": ("D", "C", "F"),
            "right": ("F", "G"),
        },
    )
    return "", plane.description("5.0")


def stephenson_six_bar() -> tuple[str, str]:
    """Stephenson III: a four-bar whose coupler point moves a dyad on the ground."""
    a, d, r = vector(0.0, 0.0), vector(1.0, 0.0), vector(1.7, 0.25)
    b = a + 0.3 * vector(np.cos(1.0), np.sin(1.0))
    c = meeting(b, 0.9, d, 0.7, left=True)
    p = meeting(b, 1.1, c, 0.5, left=True)
    q = meeting(p, 0.9, r, 0.9, left=True)
    plane = Linkage(
        "stephenson_six_bar",
        "Stephenson's six-bar (III): a four-bar whose coupler point moves a dyad on the ground.",
        0.035,
    )
    plane.ground(a, d, r)
    plane.link("crank", "world", [a, b], "blue", 1)
    plane.link("coupler", "crank", [b, c, p], "orange", 2)
    plane.link("link", "coupler", [p, q], "vermillion", 1)
    plane.link("rocker", "world", [d, c], "green", 1)
    plane.link("output", "world", [r, q], "purple", 2)
    plane.pin("knee", "coupler", "rocker", c)
    plane.pin("top", "link", "output", q)
    text = description(
        plane,
        "Stephenson's six-bar linkage (III): a four-bar (crank 0.3 m, coupler 0.9 m, rocker 0.7 "
        "m, ground 1 m) whose coupler point moves a dyad on the ground; bars of 1 kg per metre. "
        "The crank can turn fully and starts at 1 rad (joint angles count from there) with 8 "
        "rad/s.",
        TURNING,
    )
    return plane.urdf.text(), text


JANSEN = {
    "a": 0.38, "b": 0.415, "c": 0.393, "d": 0.401, "e": 0.558, "f": 0.394, "g": 0.367,
    "h": 0.657, "i": 0.49, "j": 0.5, "k": 0.619, "l": 0.078, "m": 0.15,
}  # fmt: skip
"""Theo Jansen's eleven holy numbers and the crank, in units of 100 of his."""


def _leg(plane: Linkage, name: str, crank_pin: Vector, mirrored: bool, layer: int) -> None:
    """One of Jansen's legs: three loops on the crank."""
    n = JANSEN
    sign = 1.0 if mirrored else -1.0
    hip = vector(sign * n["a"], -n["l"])
    above = meeting(crank_pin, n["j"], hip, n["b"], left=mirrored)
    below = meeting(crank_pin, n["k"], hip, n["c"], left=not mirrored)
    back = meeting(hip, n["d"], above, n["e"], left=not mirrored)
    ankle = meeting(back, n["f"], below, n["g"], left=mirrored)
    foot = meeting(ankle, n["h"], below, n["i"], left=mirrored)
    plane.link(f"{name}_j", "crank", [crank_pin, above], "orange", layer + 1)
    plane.link(f"{name}_k", "crank", [crank_pin, below], "vermillion", layer)
    plane.link(f"{name}_hip", "world", [hip, above, back], "green", layer)
    plane.link(f"{name}_f", f"{name}_hip", [back, ankle], "sky", layer + 1)
    plane.link(f"{name}_c", "world", [hip, below], "purple", layer + 1)
    plane.link(f"{name}_foot", f"{name}_c", [below, ankle, foot], "blue", layer)
    plane.pin(f"{name}_above", f"{name}_j", f"{name}_hip", above)
    plane.pin(f"{name}_below", f"{name}_k", f"{name}_c", below)
    plane.pin(f"{name}_ankle", f"{name}_f", f"{name}_foot", ankle)


def jansen_walker() -> tuple[str, str]:
    """Four of Theo Jansen's legs on one crankshaft: twelve loops, one degree of freedom."""
    plane = Linkage(
        "jansen_walker",
        "Four of Theo Jansen's legs on one crankshaft, hung up by its frame.",
        0.025,
    )
    centre = np.zeros(2)
    hips = [vector(sign * JANSEN["a"], -JANSEN["l"]) for sign in (-1.0, 1.0)]
    plane.ground(centre, *hips)
    pins = [JANSEN["m"] * vector(np.cos(angle), np.sin(angle)) for angle in (0.5, 0.5 + np.pi)]
    plane.link("crank", "world", [centre, *pins], "dark", 1)
    for k, pin in enumerate(pins):
        for side, mirrored in (("left", False), ("right", True)):
            _leg(plane, f"{side}_{k}", pin, mirrored, 2 + 2 * k)
    text = description(
        plane,
        "Theo Jansen's walker: four legs of his eleven numbers (1 unit = 1 cm) on one "
        "crankshaft, hung up by its frame; two legs to each side, the two pairs half a turn "
        "apart; bars of 1 kg per metre. 25 joints, twelve loops, one degree of freedom. The "
        "crank starts with 6 rad/s.",
        """
[initial]
q = { crank = 0.0 }
v = { crank = 6.0 }

[simulation]
t_end = 3.0
rtol = 1e-8
""",
    )
    return plane.urdf.text(), text


def jansen_walker_planar() -> tuple[str, str]:
    """:func:`jansen_walker` typed in as points and bars."""
    n = JANSEN
    plane = Drawing(
        "jansen_walker_planar",
        "The bundled jansen_walker typed in as points and bars. The angle of the crank counts from "
        "the x axis; bars have the masses and inertias of its links.",
        0.025,
        ("O", "hip_left", "hip_right"),
        "{ O = 6.0 }",
        {"O": vector(0.0, 0.0)},
        {"crank": ("O", "pin_0", "pin_1")},
    )
    for side, sign in (("left", -1.0), ("right", 1.0)):
        plane.points[f"hip_{side}"] = vector(sign * n["a"], -n["l"])
    for k, angle in enumerate((0.5, 0.5 + np.pi)):
        pin = plane.points[f"pin_{k}"] = n["m"] * vector(np.cos(angle), np.sin(angle))
        for side, mirrored in (("left", False), ("right", True)):
            leg, hip = f"{side}_{k}", plane.points[f"hip_{side}"]
            above = meeting(pin, n["j"], hip, n["b"], left=mirrored)
            below = meeting(pin, n["k"], hip, n["c"], left=not mirrored)
            back = meeting(hip, n["d"], above, n["e"], left=not mirrored)
            ankle = meeting(back, n["f"], below, n["g"], left=mirrored)
            foot = meeting(ankle, n["h"], below, n["i"], left=mirrored)
            found = {"above": above, "below": below, "back": back, "ankle": ankle, "foot": foot}
            plane.points |= {f"{leg}_{name}": at for name, at in found.items()}
            own = {name: f"{leg}_{name}" for name in found}
            plane.bars |= {
                f"{leg}_j": (f"pin_{k}", own["above"]),
                f"{leg}_k": (f"pin_{k}", own["below"]),
                f"{leg}_hip": (f"hip_{side}", own["above"], own["back"]),
                f"{leg}_f": (own["back"], own["ankle"]),
                f"{leg}_c": (f"hip_{side}", own["below"]),
                f"{leg}_foot": (own["below"], own["ankle"], own["foot"]),
            }
    return "", plane.description("3.0")


PLANAR: dict[str, Callable[[], tuple[str, str]]] = {
    "watt_six_bar": watt_six_bar,
    "watt_six_bar_planar": watt_six_bar_planar,
    "jansen_walker_planar": jansen_walker_planar,
    "stephenson_six_bar": stephenson_six_bar,
    "jansen_walker": jansen_walker,
}
