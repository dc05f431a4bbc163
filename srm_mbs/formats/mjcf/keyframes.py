"""Keyframes of MJCF: states of the mechanism that a file names.

A keyframe lists the positions ``qpos`` and rates ``qvel`` of all joints as MuJoCo has them, in the
order of the file: a hinge or slide counts from its ``ref``, a free joint has the pose of its body
in the world, and quaternions begin with the real part.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import known_names
from srm_mbs.formats.graph.joint_graph import ROOT_JOINT
from srm_mbs.formats.mjcf.attributes import Attributes, MjcfValues
from srm_mbs.formats.mjcf.bodies import BodyReader
from srm_mbs.formats.mjcf.parts import Part

SIZES = {"hinge": (1, 1), "slide": (1, 1), "ball": (4, 3), "free": (7, 6)}
"""Numbers of positions and rates of each type of joint."""


class KeyframeReader:
    """The keyframes of the files, and a start in one of them.

    That of an attached file has the joints of the file alone; the others are in their zeros.

    Parameters
    ----------
    values, tree
        The main file, and the bodies and joints of all.
    """

    def __init__(self, values: MjcfValues, tree: BodyReader) -> None:
        self.values, self.tree = values, tree
        self.keys: dict[str, Attributes] = {}
        self._parts: dict[str, Part] = {}
        for part in tree.parts:
            for node in (key for section in part.root.findall("keyframe") for key in section):
                name = node.get("name") or str(len(self.keys))
                self.keys[name] = part.values.own(node, f"<keyframe>, key {name!r}")
                self._parts[name] = part

    def start(self, wanted: str | None, closed: bool, joints: Collection[str]) -> dict[str, Any]:
        """The entry ``initial`` of a description that starts in the keyframe ``wanted``.

        Parameters
        ----------
        wanted
            Name, or number from 0 where a keyframe has no name; None: nothing but a note.
        closed
            Whether there are closures: positions are guesses then, and rates are left out.
        joints
            Names of the joints of the mechanism; others are locked.

        Raises
        ------
        InputError
            If there is no such keyframe, or its numbers do not fit the joints.
        """
        if wanted is None:
            if self.keys:
                self.values.remark(
                    "a run starts in the pose of the file; srm.load(..., keyframe=NAME) and "
                    "--keyframe NAME start in one of its keyframes",
                    known_names(self.keys),
                )
            return {}
        if wanted not in self.keys:
            problem = f"there is no keyframe {wanted!r}"
            raise self.values.unknown("<keyframe>", problem, self.keys)
        given, order = self.keys[wanted], self.tree.order[self._parts[wanted].joints]
        sizes = np.array([SIZES[kind] for _, kind, _ in order]).reshape(-1, 2)
        qpos, qvel = (
            given.numbers(key, total) if given.text(key).strip() else None
            for key, total in zip(("qpos", "qvel"), sizes.sum(axis=0).tolist())
        )
        positions: dict[str, Any] = {}
        rates: dict[str, Any] = {}
        ends = np.cumsum(sizes, axis=0)
        for (joint, kind, body), (nq, nv), (end_q, end_v) in zip(order, sizes, ends):
            alone = kind == "free" and joint not in joints
            name = ROOT_JOINT if alone else joint
            if name not in joints:
                continue
            if qpos is not None:
                own = qpos[end_q - nq : end_q]
                positions[name] = self._position(given, joint, kind, body, own, alone)
            if qvel is not None and not closed and kind != "free":
                rate = qvel[end_v - nv : end_v].tolist()
                rates[name] = rate if nv > 1 else rate[0]
            elif qvel is not None and qvel[end_v - nv : end_v].any():
                why = "of a mechanism with closures" if closed else "of a free joint"
                self.values.remark(f"the rates {why} are not read", given.where)
        return {
            key: part
            for key, part in (("guess" if closed else "q", positions), ("v", rates))
            if part
        }

    def _position(
        self,
        given: Attributes,
        joint: str,
        kind: str,
        body: str,
        own: FloatArray,
        alone: bool,
    ) -> float | list[float]:
        """The position of one joint, whose numbers are ``own``; a free joint that is ``alone`` is
        the root joint, before the placement of its body."""
        if kind in ("hinge", "slide"):
            # In rad, whatever the unit of the file.
            return float(own[0]) - self.tree.references[joint]
        turn = self.values.quaternion(own[-4:], given.where, "qpos")
        if kind == "ball":
            return list(map(float, pin.Quaternion(turn).coeffs()))
        pose, at = pin.SE3(turn, own[:3]), self.tree.placements[body].inverse()
        moved = pose * at if alone else at * pose
        return list(map(float, pin.SE3ToXYZQUAT(moved)))
