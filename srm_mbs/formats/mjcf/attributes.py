"""Elements and attributes of MJCF: names, default classes, numbers and orientations.

The tables list the names that are read and those that do not affect the motion; all others are
refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.formats.xml import XmlValues

PLACED = ("pos", "quat", "axisangle", "xyaxes", "zaxis", "euler")
SECTIONS = (
    "compiler",
    "option",
    "default",
    "asset",
    "worldbody",
    "equality",
    "tendon",
    "contact",
    "actuator",
    "include",
)
"""Sections that are read, or looked into."""
IGNORED_SECTIONS = (
    "size",
    "visual",
    "statistic",
    "sensor",
    "keyframe",
    "custom",
    "extension",
)
BODY_READ = ("inertial", "joint", "freejoint", "geom", "site", "body", "frame")
BODY_IGNORED = ("camera", "light")
ATTRIBUTES: dict[str, tuple[str, ...]] = {
    "compiler": (
        "angle",
        "eulerseq",
        "coordinate",
        "autolimits",
        "inertiafromgeom",
        "inertiagrouprange",
        "boundmass",
        "boundinertia",
        "balanceinertia",
        "settotalmass",
        "meshdir",
        "assetdir",
    ),
    "option": ("gravity", "wind", "density", "viscosity"),
    "body": ("name", "childclass", "mocap", "gravcomp", *PLACED),
    "frame": ("name", "childclass", *PLACED),
    "inertial": ("mass", "diaginertia", "fullinertia", *PLACED),
    "joint": (
        "name",
        "class",
        "type",
        "pos",
        "axis",
        "springdamper",
        "stiffness",
        "range",
        "limited",
        "ref",
        "springref",
        "armature",
        "damping",
        "frictionloss",
        "actuatorgravcomp",
    ),
    "freejoint": ("name",),
    "geom": (
        "name",
        "class",
        "type",
        "group",
        "size",
        "mass",
        "density",
        "shellinertia",
        "fromto",
        "mesh",
        "rgba",
        "material",
        *PLACED,
    ),
    "site": ("name", "class", "fromto", *PLACED),
    "equality": ("active", "class"),
    "connect": ("name", "class", "active", "body1", "body2", "anchor", "site1", "site2"),
    "weld": (
        "name",
        "class",
        "active",
        "body1",
        "body2",
        "anchor",
        "relpose",
        "site1",
        "site2",
    ),
    "tendon": ("stiffness", "damping", "frictionloss", "springlength", "armature", "class"),
    "spatial": (
        "name",
        "class",
        "stiffness",
        "damping",
        "frictionloss",
        "springlength",
        "armature",
    ),
    "mesh": ("name", "class", "file", "scale", "inertia", "refpos", "refquat"),
    "material": ("name", "class", "rgba"),
}
"""Attributes that are read; those of a joint equality are in JOINT_EQUALITY."""
JOINT_EQUALITY = ("name", "class", "active", "joint1", "joint2", "polycoef")
_CONTACT = ("solref", "solimp", "margin", "gap", "user")
IGNORED_ATTRIBUTES: dict[str, tuple[str, ...]] = {
    "compiler": (
        "strippath",
        "texturedir",
        "discardvisual",
        "usethread",
        "fusestatic",
        "alignfree",
        "convexhull",
        "conflict",
        "exactmeshinertia",
        "saveinertial",
    ),
    "option": (
        "timestep",
        "apirate",
        "impratio",
        "tolerance",
        "ls_tolerance",
        "noslip_tolerance",
        "ccd_tolerance",
        "mpr_tolerance",
        "magnetic",
        "o_margin",
        "o_solref",
        "o_solimp",
        "o_friction",
        "integrator",
        "cone",
        "jacobian",
        "solver",
        "iterations",
        "ls_iterations",
        "noslip_iterations",
        "ccd_iterations",
        "mpr_iterations",
        "sdf_iterations",
        "sdf_initpoints",
        "actuatorgroupdisable",
        "collision",
        "sleep_tolerance",
    ),
    "body": ("user", "sleep"),
    "joint": (
        "group",
        "user",
        "margin",
        "solreflimit",
        "solimplimit",
        "solreffriction",
        "solimpfriction",
        "actuatorfrcrange",
        "actuatorfrclimited",
    ),
    "freejoint": ("group", "align"),
    "geom": (
        *_CONTACT,
        "contype",
        "conaffinity",
        "condim",
        "priority",
        "friction",
        "solmix",
        "hfield",
        "fitscale",
        "fluidshape",
        "fluidcoef",
    ),
    "site": ("type", "group", "material", "size", "rgba", "user"),
    "equality": ("solref", "solimp"),
    "connect": ("solref", "solimp"),
    "weld": ("solref", "solimp", "torquescale"),
    "tendon": (*_CONTACT, "group", "limited", "range", "width", "material", "rgba"),
    "spatial": (
        *_CONTACT,
        "group",
        "limited",
        "range",
        "width",
        "material",
        "rgba",
        "actuatorfrclimited",
        "actuatorfrcrange",
        "solreflimit",
        "solimplimit",
        "solreffriction",
        "solimpfriction",
    ),
    "mesh": (
        "content_type",
        "smoothnormal",
        "vertex",
        "normal",
        "texcoord",
        "face",
        "maxhullvert",
        "builtin",
        "params",
        "material",
    ),
    "material": (
        "texture",
        "texrepeat",
        "texuniform",
        "emission",
        "specular",
        "shininess",
        "reflectance",
        "metallic",
        "roughness",
    ),
}
GEOMS = (
    "sphere",
    "capsule",
    "ellipsoid",
    "cylinder",
    "box",
    "mesh",
    "plane",
    "hfield",
    "sdf",
)
"""Types of geom, the default first."""
DEFAULTS_OF_OTHERS = (
    "camera",
    "light",
    "pair",
    "general",
    "motor",
    "position",
    "velocity",
    "intvelocity",
    "damper",
    "cylinder",
    "muscle",
    "adhesion",
    "dcmotor",
    "texture",
)
"""Defaults of elements that are not read."""


MAIN = "main"
ORIENTATIONS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass
class Compiler:
    """Settings of ``<compiler>`` that are used here."""

    degrees: bool = True
    sequence: str = "xyz"
    autolimits: bool = True
    inertia_from_geom: str = "auto"
    bound_mass: float = 0.0
    bound_inertia: float = 0.0
    total_mass: float = -1.0
    groups: tuple[int, int] = (0, 5)
    mesh_folder: str = ""


@dataclass
class MjcfValues(XmlValues):
    """Values of one file, with its compiler settings and default classes."""

    file: str
    compiler: Compiler = field(default_factory=Compiler)
    classes: dict[str, dict[str, dict[str, str]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        XmlValues.__init__(self, self.file)
        self.classes[MAIN] = {}

    # Defaults -------------------------------------------------------------------------------

    def read_defaults(self, node: Element, parent: str | None = None) -> None:
        """Read a ``<default>`` and those inside it."""
        name = node.get("class", "")
        if parent is None:
            name = name or MAIN
        if not name:
            raise self.fault("<default>", "it has no class", 'Give class="..."')
        where = f"default {name!r}"
        self.attributes(node, where, ("class",))
        if parent is None and name != MAIN:
            self.classes[name] = self.classes[MAIN]
        elif parent is not None:
            if name in self.classes:
                raise self.fault(where, "two classes have this name", "Rename one of them")
            inherited = self.classes[parent]
            self.classes[name] = {tag: dict(values) for tag, values in inherited.items()}
        mine = self.classes[name]
        for child in node:
            if child.tag not in (*ATTRIBUTES, *DEFAULTS_OF_OTHERS, "default"):
                raise self.fault(where, f"unknown element <{child.tag}>", "Correct its name")
            if child.tag != "default" and child.tag in ATTRIBUTES:
                self.known(child, f"{where}, <{child.tag}>")
                mine.setdefault(child.tag, {}).update(child.attrib)
        # Nested classes inherit all attributes, also those that follow them in the file.
        for child in node.findall("default"):
            self.read_defaults(child, name)

    def known(self, node: Element, where: str) -> None:
        """Refuse unknown attributes; those that do not affect the motion are ignored."""
        ignored = IGNORED_ATTRIBUTES.get(node.tag, ())
        for key in node.attrib:
            if key not in ATTRIBUTES[node.tag] and key not in ignored:
                raise self.fault(
                    where,
                    f"<{node.tag}> has an unknown attribute {key!r}",
                    f"Known: {', '.join((*ATTRIBUTES[node.tag], *ignored))}",
                )

    def resolved(self, node: Element, childclass: str, where: str, tag: str = "") -> dict[str, str]:
        """Attributes of ``node`` over those of its class.

        Parameters
        ----------
        node, where
            The element and its name for messages.
        childclass
            Of the bodies around it; counts if the element names no class.
        tag
            Under which the defaults stand, if that is not the element's own.
        """
        self.known(node, where)
        name = node.get("class") or childclass or MAIN
        if name not in self.classes:
            raise self.fault(
                where, f"there is no default class {name!r}", f"Known: {', '.join(self.classes)}"
            )
        return {**self.classes[name].get(tag or node.tag, {}), **node.attrib}

    # Values ---------------------------------------------------------------------------------

    def get(
        self, given: Mapping[str, str], key: str, count: int, default: str, where: str
    ) -> FloatArray:
        """``count`` numbers of the attribute ``key``."""
        return self.numbers(given.get(key, default), count, where, key)

    def number(self, given: Mapping[str, str], key: str, default: float, where: str) -> float:
        """One number of the attribute ``key``."""
        if key not in given:
            return default
        return float(self.numbers(given[key], 1, where, key)[0])

    def choice(self, given: Mapping[str, str], key: str, known: tuple[str, ...], where: str) -> str:
        """A word of the attribute ``key``; the first of ``known`` by default."""
        word = given.get(key, known[0])
        if word not in known:
            raise self.fault(where, f"{key} is {word!r}", f"Known: {', '.join(known)}")
        return word

    def flag(self, given: Mapping[str, str], key: str, default: bool, where: str) -> bool:
        """``true`` or ``false``."""
        return default if key not in given else self.truth(given[key], where, key)

    def angle(self, value: float) -> float:
        """An angle of the file in rad."""
        return float(np.deg2rad(value)) if self.compiler.degrees else value

    def placement(self, given: Mapping[str, str], where: str) -> pin.SE3:
        """``pos`` and the orientation."""
        return pin.SE3(self.rotation(given, where), self.get(given, "pos", 3, "0 0 0", where))

    def rotation(self, given: Mapping[str, str], where: str) -> FloatArray:
        """The orientation (3, 3), in any of the notations of MJCF.

        Raises
        ------
        InputError
            If it is written in two ways, or a direction is zero.
        """
        ways = [way for way in ORIENTATIONS if way in given]
        if len(ways) > 1 and ways[:1] == ["quat"]:
            ways = ways[1:]  # in MuJoCo the others replace a quaternion
        if len(ways) > 1:
            raise self.fault(where, f"{' and '.join(ways)} are both given", "Keep one")
        match ways:
            case ["quat"]:
                w, x, y, z = self.direction(self.get(given, "quat", 4, "", where), where, "quat")
                return np.asarray(pin.Quaternion(w, x, y, z).matrix())
            case ["axisangle"]:
                *axis, angle = self.get(given, "axisangle", 4, "", where)
                unit = self.direction(np.array(axis), where, "axisangle")
                return np.asarray(pin.AngleAxis(self.angle(angle), unit).matrix())
            case ["xyaxes"]:
                both = self.get(given, "xyaxes", 6, "", where)
                x_axis = self.direction(both[:3], where, "xyaxes")
                y_axis = both[3:] - x_axis * (x_axis @ both[3:])
                y_axis = self.direction(y_axis, where, "xyaxes")
                return np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
            case ["zaxis"]:
                return z_along(
                    self.direction(self.get(given, "zaxis", 3, "", where), where, "zaxis")
                )
            case ["euler"]:
                return self._euler(self.get(given, "euler", 3, "", where))
        return np.eye(3)

    def _euler(self, angles: FloatArray) -> FloatArray:
        """The rotation (3, 3) of ``euler``; lower-case letters of the sequence are intrinsic,
        capitals extrinsic rotations."""
        out = np.eye(3)
        for letter, angle in zip(self.compiler.sequence, angles):
            turn = pin.AngleAxis(self.angle(angle), np.array(AXES[letter.lower()])).matrix()
            out = out @ turn if letter.islower() else turn @ out
        return out


def z_along(direction: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes the z axis to the unit vector ``direction``."""
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(z, direction)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-10:
        axis, sine = np.array([1.0, 0.0, 0.0]), 0.0
    angle = np.arctan2(sine, direction[2])
    return np.asarray(pin.AngleAxis(float(angle), axis / np.linalg.norm(axis)).matrix())
