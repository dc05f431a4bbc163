"""What is drawn of closures: their gaps, and the size of their reactions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.moving import Moving, no_turn, path_of, stretched
from srm_mbs.solution import Solution
from srm_mbs.spans import Spans, loops_of, within
from srm_mbs.visuals import Colour, Cylinder, Sphere
from srm_mbs.workspaces import workspace

if TYPE_CHECKING:
    from srm_mbs.loop_closure import LoopClosure
    from srm_mbs.motion import Playable
    from srm_mbs.scene import Motion

GAP_COLOUR: Colour = (0.835, 0.0, 0.35, 1.0)
RAMP: tuple[tuple[float, float, float], ...] = (  # cividis, even in lightness
    (0.000, 0.135, 0.305),
    (0.255, 0.305, 0.425),
    (0.485, 0.482, 0.470),
    (0.720, 0.675, 0.430),
    (0.995, 0.909, 0.218),
)
LARGEST_GAP = 0.1
"""Part of the picture's extent that the largest gap may take."""
HIGH = 98.0
"""Percentile of the reactions at the end of the colours: near singular passages they have peaks."""
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True, eq=False)
class Gap:
    """What one closure is open by, over time.

    Attributes
    ----------
    loop
        The closure.
    spans
        When it is there (s); None for always.
    starts : (n, 3) m, arrows : (n, 3) m
        b's origin in the world, and from there the part of the way to a's origin that the closure
        excludes; zero while it is not there.
    """

    loop: LoopClosure
    spans: Spans | None
    starts: FloatArray
    arrows: FloatArray


def gaps_of(solution: Playable, times: FloatArray) -> list[Gap]:
    """The gaps at ``times`` (n,) s of the closures with anchors and rows of length."""
    model = solution.mechanism.model
    data = workspace(model)
    out, sides = [], []
    for loop, spans in loops_of(solution):
        if len(loop.rows.directions) or loop.rows.distances:
            starts, arrows = np.zeros((len(times), 3)), np.zeros((len(times), 3))
            out.append(Gap(loop, spans, starts, arrows))
            sides.append((loop.resolve(model), within(times, spans, solution.span[1])))
    for i, q in enumerate(solution(times)[0]):
        pin.forwardKinematics(model, data, q)
        for gap, (((joint_a, in_a), (joint_b, in_b)), there) in zip(out, sides):
            b = data.oMi[joint_b] * in_b
            gap.starts[i] = b.translation
            if there[i]:
                p = b.actInv((data.oMi[joint_a] * in_a).translation)
                gap.arrows[i] = b.rotation @ _excluded(gap.loop, p)
    return out


def _excluded(loop: LoopClosure, p: FloatArray) -> FloatArray:
    """The part of a's position ``p`` (3,) m in b that the rows of length make zero."""
    directions = loop.rows.directions
    gap = directions.T @ (directions @ p)
    size = float(np.linalg.norm(p))
    for length in loop.rows.distances:
        gap = gap + (size - length) * p / (size or 1.0)
    return np.asarray(gap)


def draw_gaps(
    solution: Playable, motion: Motion, extent: float
) -> tuple[list[Moving], dict[str, Any]]:
    """The gaps as bars, all exaggerated by the same factor, and what the panel says about it."""
    gaps = gaps_of(solution, motion.times)
    sizes = (float(np.linalg.norm(gap.arrows, axis=1).max()) for gap in gaps)
    largest = max(sizes, default=0.0)
    if not largest > 0.0:
        return [], {"text": "the closures have no gaps"}
    power = int(np.floor(np.log10(LARGEST_GAP * extent / largest)))
    bar = Cylinder(0.006 * extent, 1.0)
    middle = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.5]))
    moving = []
    for number, gap in enumerate(gaps):
        parts = ((bar, middle, GAP_COLOUR),)
        bars = stretched(f"gap_{number}", parts, gap.starts, 10.0**power * gap.arrows)
        moving.append(replace(bars, in_front=True, spans=gap.spans))
    return moving, {
        "text": f"gaps of the closures, at most {largest:.1e} m, drawn 10"
        f"{str(power).translate(SUPERSCRIPTS)} times as large"
    }


def draw_reactions(
    solution: Playable, motion: Motion, extent: float
) -> tuple[list[Moving], dict[str, Any]]:
    """The closures as balls, coloured by their reaction force, and the legend.

    Raises
    ------
    InputError
        If the reactions are not known.
    """
    if not isinstance(solution, Solution):
        raise InputError(
            "a motion that was not simulated has no reactions",
            element="reactions",
            remedy="Leave the option out",
        )
    model = solution.mechanism.model
    sizes = {
        name: np.linalg.norm(wrench[:, :3], axis=1)
        for name, wrench in solution.at(motion.times).reactions.items()
    }
    loops = [(loop, spans) for loop, spans in loops_of(solution) if loop.name in sizes]
    # While a closure is not there, it has no force, and not one of zero.
    there = [within(motion.times, spans, solution.span[1]) for _, spans in loops]
    together = np.concatenate([sizes[loop.name][own] for (loop, _), own in zip(loops, there)])
    together = together[np.isfinite(together)]
    top = float(np.percentile(together, HIGH)) if len(together) else 0.0
    ball = Sphere(0.014 * extent)
    moving = []
    for number, (loop, spans) in enumerate(loops):
        path = path_of(motion, *loop.resolve(model)[0])
        colours = ramp_colours(sizes[loop.name] / top if top else 0.0 * sizes[loop.name])
        parts = ((ball, pin.SE3.Identity(), (*RAMP[0], 1.0)),)
        turns = no_turn(len(path))
        moving.append(Moving(f"closure_{number}", parts, path, turns, None, colours, True, spans))
    return moving, {
        "text": "force in the closures",
        "ramp": [f"rgb({', '.join(str(round(255 * c)) for c in colour)})" for colour in RAMP],
        "ends": ["0", f"{top:.3g} N and more"],
    }


def ramp_colours(parts: FloatArray) -> FloatArray:
    """Colours (n, 3) at ``parts`` (n,) of the ramp, 0 to 1; beyond, those of its ends."""
    parts = np.nan_to_num(parts, nan=1.0, posinf=1.0)
    at = np.linspace(0.0, 1.0, len(RAMP))
    return np.column_stack([np.interp(parts, at, channel) for channel in np.array(RAMP).T])
