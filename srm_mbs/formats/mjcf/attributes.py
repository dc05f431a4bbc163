"""Elements and attributes of MJCF: names, default classes, numbers and orientations.

The tables list the names that are read and those that do not affect the motion; all others are
refused.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.formats.xml import XmlValues, words


def _table(rows: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    return {tag: words(names) for tag, names in rows.items()}


SECTIONS = words(
    "compiler option default asset worldbody equality tendon contact actuator keyframe include"
)
"""Sections that are read, or looked into."""
IGNORED_SECTIONS = words("size visual statistic sensor custom extension")
BODY_READ = words("inertial joint freejoint geom site body frame replicate attach")
BODY_IGNORED = ("camera", "light")
PLACED = "pos quat axisangle xyaxes zaxis euler"
ACTUATORS = words("general motor position velocity")
"""Actuators that are read, where they act on a hinge or slide."""
OTHER_ACTUATORS = words(
    """intvelocity orientation pid damper cylinder muscle adhesion dcmotor plugin"""
)
ACTUATOR_DELAYS = words("delay nsample interp input ffrange velrange")
"""Attributes of actuators whose outputs are not those of the control at the same time."""
ACTUATOR = f"""name class group ctrllimited ctrlrange forcelimited forcerange gear joint
    jointinparent tendon site refsite cranksite slidersite armature damping
    {" ".join(ACTUATOR_DELAYS)}"""
PARAMETERS = tuple(range(1, 11))
"""Counts of numbers of gainprm and biasprm."""
SERVOS = ("position", "velocity")
KIND = "kind"
"""Key of an actuator that has its parameters: the tag of the element that gave them."""
ATTRIBUTES = _table(
    {
        "compiler": """angle eulerseq coordinate autolimits inertiafromgeom inertiagrouprange
            boundmass boundinertia balanceinertia settotalmass meshdir assetdir conflict""",
        "option": "gravity wind density viscosity actuatorgroupdisable",
        "body": f"name childclass mocap gravcomp {PLACED}",
        "frame": f"name childclass {PLACED}",
        "replicate": "count sep offset euler",
        "attach": "model body prefix",
        "inertial": f"mass diaginertia fullinertia {PLACED}",
        "joint": """name class type pos axis springdamper stiffness range limited ref springref
            armature damping frictionloss actuatorgravcomp actuatorfrcrange
            actuatorfrclimited""",
        "freejoint": "name",
        "geom": f"""name class type group size mass density shellinertia fromto mesh rgba material
            {PLACED}""",
        "site": f"name class fromto {PLACED}",
        "equality": "active class",
        "connect": "name class active body1 body2 anchor site1 site2",
        "weld": "name class active body1 body2 anchor relpose site1 site2",
        "tendon": "stiffness damping frictionloss springlength armature class",
        "spatial": "name class stiffness damping frictionloss springlength armature",
        "mesh": "name class file scale inertia refpos refquat",
        "material": "name class rgba",
        "model": "name file",
        "key": "name qpos qvel",
        "general": f"""{ACTUATOR} body dyntype gaintype biastype dynprm gainprm biasprm
            inheritrange""",
        "motor": ACTUATOR,
        "position": f"{ACTUATOR} kp kv dampratio timeconst inheritrange",
        "velocity": f"{ACTUATOR} kv",
    }
)
"""Attributes that are read; those of equalities between coordinates follow."""
JOINT_EQUALITY = words("name class active joint1 joint2 polycoef")
TENDON_EQUALITY = words("name class active tendon1 tendon2 polycoef")
CONTACT = "solref solimp margin gap user"
IGNORED_ATTRIBUTES = _table(
    {
        "compiler": """strippath texturedir discardvisual usethread fusestatic alignfree convexhull
            exactmeshinertia saveinertial""",
        "option": """timestep apirate impratio tolerance ls_tolerance noslip_tolerance ccd_tolerance
            mpr_tolerance magnetic o_margin o_solref o_solimp o_friction integrator cone jacobian
            solver iterations ls_iterations noslip_iterations ccd_iterations mpr_iterations
            sdf_iterations sdf_initpoints collision sleep_tolerance""",
        "body": "user sleep",
        "model": "content_type",
        "joint": "group user margin solreflimit solimplimit solreffriction solimpfriction",
        "freejoint": "group align",
        "geom": f"""{CONTACT} contype conaffinity condim priority friction solmix hfield fitscale
            fluidshape fluidcoef""",
        "site": "type group material size rgba user",
        "equality": "solref solimp",
        "connect": "solref solimp",
        "weld": "solref solimp torquescale",
        "tendon": f"{CONTACT} group limited range width material rgba",
        "spatial": f"""{CONTACT} group limited range width material rgba actuatorfrclimited
            actuatorfrcrange solreflimit solimplimit solreffriction solimpfriction""",
        "key": "time act ctrl mpos mquat",
        "general": "user lengthrange cranklength actdim actearly actlimited actrange",
        "motor": "user lengthrange cranklength",
        "position": "user lengthrange cranklength",
        "velocity": "user lengthrange cranklength",
        "mesh": """content_type smoothnormal vertex normal texcoord face maxhullvert builtin params
            material""",
        "material": """texture texrepeat texuniform emission specular shininess reflectance metallic
            roughness""",
    }
)
GEOMS = words("sphere capsule ellipsoid cylinder box mesh plane hfield sdf")
"""Types of geom, the default first."""
DEFAULTS_OF_OTHERS = (*words("camera light pair texture"), *OTHER_ACTUATORS)
"""Defaults of elements that are not read."""
MAIN = "main"
"""The default class that all others inherit from."""
ORIENTATIONS = words("quat axisangle xyaxes zaxis euler")
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
    balance_inertia: bool = False
    total_mass: float = -1.0
    groups: tuple[int, int] = (0, 5)
    mesh_folder: str = ""
    in_world: bool = False
    """Whether placements, axes and anchors are those in the world, in the pose of the file."""
    merges: bool = False
    """Whether the options of attached models act where those of the main file are the defaults."""


class MjcfValues(XmlValues):
    """Values of one file, with its compiler settings and default classes.

    Parameters
    ----------
    file
        Its name.
    prefix
        Of its names, if it is attached.
    main
        The values of the main file, if it is another one; notes and counts are kept together.

    Attributes
    ----------
    off
        The kinds of force that ``<flag>`` of the main file disables.
    """

    def __init__(self, file: str, prefix: str = "", main: MjcfValues | None = None) -> None:
        super().__init__(file, main)
        self.prefix, self.main = prefix, self if main is None else main
        self.compiler = Compiler()
        self.classes: dict[str, dict[str, dict[str, str]]] = {MAIN: {}}
        self.off: set[str] = set() if main is None else main.off
        self._attached = 0

    @property
    def folder(self) -> Path:
        """Where the main file lies; the model is written as if it was in one file there."""
        return Path(self.main.file).parent

    def relative(self, path: Path) -> Path:
        """``path``, which is relative to this file, relative to the main one."""
        if self.main is self or path.is_absolute():
            return path
        return Path(os.path.relpath(Path(self.file).parent / path, self.folder))

    def count_attached(self, count: int, where: str, most: int) -> None:
        """Count elements that are attached, and refuse more than ``most``."""
        self.main._attached += count
        if self.main._attached > most:
            raise self.fault(
                where, f"more than {most} elements are attached", "Use smaller models, or fewer"
            )

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
            if child.tag in (*ACTUATORS, *OTHER_ACTUATORS):
                # All kinds of actuators share one default.
                known = mine.get("general", {})
                mine["general"] = self.as_general(child, known, f"{where}, <{child.tag}>")
            elif child.tag in ATTRIBUTES:
                self.own(child, f"{where}, <{child.tag}>")
                mine.setdefault(child.tag, {}).update(child.attrib)
        # Nested classes inherit all attributes, also those that follow them in the file.
        for child in node.findall("default"):
            self.read_defaults(child, name)

    def own(self, node: Element, where: str) -> Attributes:
        """Attributes of ``node``, which are known; those without effect on the motion are ignored.

        Parameters
        ----------
        node, where
            The element and its name for messages.
        """
        known = (*ATTRIBUTES[node.tag], *IGNORED_ATTRIBUTES.get(node.tag, ()))
        self.only(node, where, known)
        return Attributes(self, node.attrib, where)

    def resolved(self, node: Element, childclass: str, where: str, tag: str = "") -> Attributes:
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
        given = self.own(node, where)
        name = node.get("class") or childclass or MAIN
        if name not in self.classes:
            raise self.unknown(where, f"there is no default class {name!r}", self.classes)
        defaults = self.classes[name].get(tag or node.tag, {})
        return Attributes(self, {**defaults, **given.texts}, where)

    def as_general(self, node: Element, base: Mapping[str, str], where: str) -> dict[str, str]:
        """Attributes of an actuator over those of ``base``, as MuJoCo's compiler has them: those of
        a ``general`` one.

        All kinds share their attributes.  Servos inherit the parameters of their own kind and of
        general actuators, which are kept under keys such as ``position.gainprm``.
        """
        if node.tag in OTHER_ACTUATORS:
            return {**base, **node.attrib, KIND: node.tag}
        own = self.own(node, where)
        given = {**base, **own.texts}
        if node.tag == "general":
            for key in ("gainprm", "biasprm"):
                if key in own:
                    given |= {f"{kind}.{key}": own.text(key) for kind in SERVOS}
            return given
        given[KIND] = node.tag
        given["dyntype"] = "filterexact" if own.number("timeconst") else "none"
        given["gaintype"], given["biastype"] = "fixed", "affine"
        gain, bias = 1.0, np.zeros(3)
        if node.tag in SERVOS:
            inherited = Attributes(self, base, where)
            gain = float(inherited.numbers(f"{node.tag}.gainprm", PARAMETERS, "1")[0])
            gain = own.number("kp" if node.tag == "position" else "kv", gain)
        if node.tag == "position":
            old = inherited.numbers("position.biasprm", PARAMETERS, "0")[:3]
            bias[: old.size] = old
            bias[:2] = 0.0, -gain
            if "kv" in own and "dampratio" in own:
                raise own.fault("kv and dampratio are both given", "Keep one")
            if "kv" in own or "dampratio" in own:  # MuJoCo tells them apart by the sign
                bias[2] = own.number("dampratio") - own.number("kv")
        elif node.tag == "velocity":
            bias[2] = -gain
        texts = {"gainprm": repr(gain), "biasprm": " ".join(map(repr, bias.tolist()))}
        if node.tag in SERVOS:
            given |= {f"{node.tag}.{key}": text for key, text in texts.items()}
        return given | texts

    def angle(self, value: float) -> float:
        """An angle of the file in rad."""
        return float(np.deg2rad(value)) if self.compiler.degrees else value

    def euler(self, angles: FloatArray) -> FloatArray:
        """The rotation (3, 3) of Euler angles (3,); lower-case letters of the sequence are
        intrinsic, capitals extrinsic rotations."""
        out = np.eye(3)
        for letter, angle in zip(self.compiler.sequence, angles.tolist()):
            axis = np.array(AXES[letter.lower()])
            turn = pin.AngleAxis(self.angle(angle), axis).matrix()
            out = out @ turn if letter.islower() else turn @ out
        return out

    def quaternion(self, wxyz: FloatArray, where: str, what: str) -> FloatArray:
        """The rotation (3, 3) of a quaternion (4,) of any length, the real part first."""
        w, x, y, z = self.direction(wxyz, where, what)
        return np.asarray(pin.Quaternion(w, x, y, z).matrix())


@dataclass(frozen=True, eq=False)
class Attributes:
    """Attributes of one element, with those of its default class.

    Attributes
    ----------
    values
        The file.
    texts
        By name.
    where
        The element, for messages.
    """

    values: MjcfValues
    texts: Mapping[str, str]
    where: str

    def __contains__(self, key: str) -> bool:
        return key in self.texts

    def fault(self, problem: str, remedy: str) -> InputError:
        """The error to raise about this element."""
        return self.values.fault(self.where, problem, remedy)

    def text(self, key: str, default: str = "") -> str:
        return self.texts.get(key, default)

    def numbers(self, key: str, count: int | tuple[int, ...], default: str = "") -> FloatArray:
        """``count`` numbers, or as many as one of several counts."""
        return self.values.numbers(self.text(key, default), count, self.where, key)

    def number(self, key: str, default: float = 0.0) -> float:
        return float(self.numbers(key, 1)[0]) if key in self else default

    def direction(self, key: str, default: str = "") -> FloatArray:
        """A unit vector (3,)."""
        return self.values.direction(self.numbers(key, 3, default), self.where, key)

    def choice(self, key: str, known: tuple[str, ...]) -> str:
        """One of the words ``known``, by default the first."""
        word = self.text(key, known[0])
        if word not in known:
            raise self.values.unknown(self.where, f"{key} is {word!r}", known)
        return word

    def limited_range(self, key: str, limited: str) -> tuple[float, float] | None:
        """The range ``key``, where it acts by the attribute ``limited``; None without one.

        Raises
        ------
        InputError
            If it does not increase, or MuJoCo would not know whether it acts.
        """
        word = self.choice(limited, ("auto", "true", "false"))
        if key not in self or word == "false":
            return None
        if word == "auto" and not self.values.compiler.autolimits:
            raise self.fault(f"it has a {key}, but autolimits is off", f"Write {limited}")
        low, high = self.numbers(key, 2)
        if low == high == 0.0:
            return None
        if low >= high:
            raise self.fault(f"the {key} does not increase", "Exchange the two")
        return float(low), float(high)

    def flag(self, key: str, default: bool = False) -> bool:
        """``true`` or ``false``."""
        return self.values.truth(self.texts[key], self.where, key) if key in self else default

    def placement(self) -> pin.SE3:
        """``pos`` and the orientation."""
        return pin.SE3(self.rotation(), self.numbers("pos", 3, "0 0 0"))

    def rotation(self) -> FloatArray:
        """The orientation (3, 3), in any of the notations of MJCF.

        Raises
        ------
        InputError
            If it is written in two ways, or a direction is zero.
        """
        ways = [way for way in ORIENTATIONS if way in self]
        if len(ways) > 1 and ways[0] == "quat":
            ways = ways[1:]  # in MuJoCo the others replace a quaternion
        if len(ways) > 1:
            raise self.fault(f"{' and '.join(ways)} are both given", "Keep one")
        values = self.values
        match ways:
            case ["quat"]:
                return values.quaternion(self.numbers("quat", 4), self.where, "quat")
            case ["axisangle"]:
                *axis, angle = self.numbers("axisangle", 4)
                unit = values.direction(np.array(axis), self.where, "axisangle")
                return np.asarray(pin.AngleAxis(values.angle(angle), unit).matrix())
            case ["xyaxes"]:
                both = self.numbers("xyaxes", 6)
                x_axis = values.direction(both[:3], self.where, "xyaxes")
                y_axis = both[3:] - x_axis * (x_axis @ both[3:])
                y_axis = values.direction(y_axis, self.where, "xyaxes")
                return np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
            case ["zaxis"]:
                return z_along(self.direction("zaxis"))
            case ["euler"]:
                return values.euler(self.numbers("euler", 3))
        return np.eye(3)


def z_along(direction: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes the z axis to the unit vector ``direction``."""
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(z, direction)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-10:
        axis, sine = np.array([1.0, 0.0, 0.0]), 0.0
    angle = np.arctan2(sine, direction[2])
    return np.asarray(pin.AngleAxis(float(angle), axis / np.linalg.norm(axis)).matrix())
