"""Actuators of MJCF on hinges and slides with a fixed gain and an affine bias, which are motors and
servos (:class:`srm_mbs.Actuator`).

MuJoCo's ``motor``, ``position`` and ``velocity`` are shortcuts of ``general``, whose force is
gainprm[0] u + biasprm[0] + biasprm[1] l + biasprm[2] dl/dt.  Others are noted by name.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from srm_mbs.formats.mjcf.attributes import (
    ACTUATOR_DELAYS,
    ACTUATORS,
    KIND,
    MAIN,
    OTHER_ACTUATORS,
    PARAMETERS,
    Attributes,
    MjcfValues,
)
from srm_mbs.formats.mjcf.bodies import BodyReader
from srm_mbs.formats.mjcf.parts import Part
from srm_mbs.model.forces import OPEN_LIMIT

TRANSMISSIONS = {
    "tendon": "a tendon",
    "site": "a site",
    "cranksite": "a slider-crank",
    "slidersite": "a slider-crank",
    "body": "a body",
}
"""Attributes that name something else than a joint, and what it is."""
NO_FORCE = "and give no force"


class ActuatorReader:
    """Reads ``<actuator>`` of the files when all joints are known.

    Parameters
    ----------
    tree
        The bodies and joints.
    locked
        Joints that the file locks.
    disabled
        Groups of actuators that ``<option actuatorgroupdisable>`` switches off.

    Attributes
    ----------
    actuators
        The entry ``actuators`` of a description.
    """

    def __init__(
        self, tree: BodyReader, locked: Collection[str], disabled: Collection[int]
    ) -> None:
        self.tree, self._locked, self._disabled = tree, locked, disabled
        self._kinds = {name: kind for name, kind, _ in tree.order}
        self._elements: list[tuple[MjcfValues, Element]] = []
        self.actuators: dict[str, dict[str, Any]] = {}

    def read(self, part: Part) -> None:
        """Collect the actuators of a file."""
        values, known = part.values, (*ACTUATORS, *OTHER_ACTUATORS)
        for section in part.attached("actuator"):
            values.children(section, "<actuator>", known, (), known)
            self._elements += [(values, node) for node in section]

    def finish(self) -> None:
        """Translate what was collected."""
        given = [node.get("name", "") for _, node in self._elements]
        for values, node in self._elements:
            name = node.get("name") or self._default_name(node, {*given, *self.actuators})
            if name in self.actuators:
                where = f"actuator {name!r}"
                raise values.fault(where, "two actuators have this name", "Rename one of them")
            made = self._actuator(values, name, node)
            if made is not None:
                self.actuators[name] = made
        self._limit_efforts()

    def _default_name(self, node: Element, taken: Collection[str]) -> str:
        """That of the joint, with the kind and a number where it is taken."""
        joint = node.get("joint") or node.get("jointinparent") or ""
        names = [joint, f"{joint}_{node.tag}".lstrip("_")]
        numbered = (f"{names[1]}_{k}" for k in range(2, len(self._elements) + 3))
        return next(name for name in (*names, *numbered) if name and name not in taken)

    def _actuator(self, values: MjcfValues, name: str, node: Element) -> dict[str, Any] | None:
        """The entry of one actuator; None, with a note, where it gives no force."""
        where = f"actuator {name!r}"
        if "actuation" in values.off:
            values.remark("actuators are disabled (<flag actuation>)", where)
            return None
        class_name = node.get("class") or MAIN
        if class_name not in values.classes:
            raise values.unknown(where, f"there is no default class {class_name!r}", values.classes)
        base = values.classes[class_name].get("general", {})
        given = Attributes(values, values.as_general(node, base, where), where)
        why = self._unread(given)
        if why is not None:
            values.remark(why, where)
            return None
        for key in ("armature", "damping"):
            if given.text(key) and given.numbers(key, (1, 2, 3)).any():
                values.remark(f"{key} of actuators does not act", where)
        return self._entry(given, given.text("joint") or given.text("jointinparent"))

    def _unread(self, given: Attributes) -> str | None:
        """Why the actuator is not read; None if it is."""
        if given.text(KIND) in OTHER_ACTUATORS:
            return f"<{given.text(KIND)}> actuators are not read {NO_FORCE}"
        for key, what in TRANSMISSIONS.items():
            if key in given:
                return f"actuators on {what} are not read {NO_FORCE}"
        joint = given.text("joint") or given.text("jointinparent")
        if joint not in self._kinds:
            problem = f"there is no joint {joint!r}" if joint else "it has no joint"
            raise given.values.unknown(given.where, problem, self._kinds)
        if joint not in self.tree.references:
            return f"actuators on a {self._kinds[joint]} joint are not read {NO_FORCE}"
        dynamics = given.text("dyntype", "none")
        if dynamics != "none":
            return f"actuators with dynamics ({dynamics}) are not read {NO_FORCE}"
        for key, known in (("gaintype", ("fixed",)), ("biastype", ("none", "affine"))):
            word = given.text(key, known[0])
            if word not in known:
                return f"actuators with the {key} {word!r} are not read {NO_FORCE}"
        for key in ACTUATOR_DELAYS:
            if key in given:
                return f"actuators with {key} are not read {NO_FORCE}"
        if joint in self._locked:
            return "actuators of joints that are locked are left out"
        if given.number("group") in self._disabled:
            return "actuators of disabled groups (actuatorgroupdisable) are left out"
        return None

    def _entry(self, given: Attributes, joint: str) -> dict[str, Any]:
        """The entry, without the fields that have their defaults."""
        gain = float(given.numbers("gainprm", PARAMETERS, "1")[0])
        bias = np.zeros(3)
        if given.text("biastype", "none") == "affine":
            parameters = given.numbers("biasprm", PARAMETERS, "0")[:3]
            bias[: parameters.size] = parameters
        constant, kp, kv = bias[0], -bias[1], -bias[2]
        ratio = 0.0
        if kv < 0.0 and gain == kp:  # as in MuJoCo
            ratio, kv = -kv, 0.0
        kind = "position" if kp else "velocity" if kv and gain == kv else "motor"
        usual = {"position": kp, "velocity": kv, "motor": 1.0}[kind]
        gear = float(given.numbers("gear", tuple(range(1, 7)), "1")[0])
        if gear == 0.0:
            raise given.fault("gear is zero", "Give the ratio of the transmission, or remove it")
        numbers = {
            "gear": (gear, 1.0),
            "kp": (kp, 0.0),
            "kv": (kv, 0.0),
            "gain": (gain, usual),
            "bias": (constant, 0.0),
            "damping_ratio": (ratio, 0.0),
            "reference": (self.tree.references[joint] if kp else 0.0, 0.0),
        }
        entry: dict[str, Any] = {"joint": joint, "type": kind}
        entry |= {
            key: float(value) for key, (value, default) in numbers.items() if value != default
        }
        ranges = {
            "control_range": None if "clampctrl" in given.values.off else self._controls(given),
            "force_range": given.limited_range("forcerange", "forcelimited"),
        }
        return entry | {key: list(two) for key, two in ranges.items() if two is not None}

    def _controls(self, given: Attributes) -> tuple[float, float] | None:
        """``ctrlrange``, or with ``inheritrange`` a multiple of the range of the joint."""
        part = given.number("inheritrange")
        if not part:
            return given.limited_range("ctrlrange", "ctrllimited")
        name = given.text("joint") or given.text("jointinparent")
        joint = next(one for one in self.tree.joints if one.name == name)
        if joint.lower <= -OPEN_LIMIT or joint.upper >= OPEN_LIMIT:
            raise given.fault("inheritrange: the joint has no range", "Give ctrlrange")
        middle = 0.5 * (joint.lower + joint.upper) + self.tree.references[name]
        half = 0.5 * part * (joint.upper - joint.lower)
        return middle - half, middle + half

    def _limit_efforts(self) -> None:
        """Take ``actuatorfrcrange`` of a joint into the range of the force of its actuator."""
        count = Counter(entry["joint"] for entry in self.actuators.values())
        for entry in self.actuators.values():
            effort = self.tree.efforts.get(entry["joint"])
            if effort is None:
                continue
            if count[entry["joint"]] > 1:
                self.tree.values.remark(
                    "actuatorfrcrange of a joint with several actuators does not act",
                    f"joint {entry['joint']!r}",
                )
                continue
            limits = np.sort(np.array(effort) / entry.get("gear", 1.0))
            own = entry.get("force_range", (-np.inf, np.inf))
            entry["force_range"] = np.clip(own, *limits).tolist()
