"""What a run of a mechanism ends with: its solution, and the sentences of its message."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from srm_mbs.arrays import FloatArray, IndexArray
from srm_mbs.compiled.dense_output import CompiledDenseOutput
from srm_mbs.compiled.driving import CompiledRecord
from srm_mbs.compiled.twin import shared
from srm_mbs.forces import LimitSpring
from srm_mbs.mechanism import Mechanism
from srm_mbs.methods.base import ErrorNorm, Method
from srm_mbs.records import Settings, Statistics, attempt_array
from srm_mbs.solution import Solution
from srm_mbs.stepping.dense import DenseOutput
from srm_mbs.stepping.events import EventWatch
from srm_mbs.stepping.loop import RunRecord
from srm_mbs.stepping.remarks import drift, passings, restarts, turns
from srm_mbs.stepping.singular_times import Placing, suspected
from srm_mbs.stepping.stepsize import Verdict
from srm_mbs.systems.multibody import ClosedSystem, OpenSystem

MENDED = "See solution.crossings; try a smaller rtol or step."
"""What to do about a passage that may have changed the branch."""
TOLD = 2
"""Bifurcations that the message of a run describes."""
ROUND_OFF = 1e-12
"""Distance (rad, m) behind a joint limit that is rounding; times |q| where that is above 1."""


def collected(
    mechanism: Mechanism,
    system: OpenSystem | ClosedSystem,
    method: Method,
    record: RunRecord,
    wrappers: Sequence[Placing],
    watch: EventWatch | None,
    t_eval: FloatArray | None,
    settings: Settings,
    norm: ErrorNorm,
    twin: Any,
) -> Solution:
    """Arrays and statistics from a run record."""
    scheme = method.scheme
    data = record.data(scheme, system.tangent_size)
    placed = sum(wrapper.placed for wrapper in wrappers)
    replaced = sum(wrapper.replaced for wrapper in wrappers)
    suspects = suspected(wrappers)
    dense: DenseOutput
    if not isinstance(record, CompiledRecord):
        dense = DenseOutput(system, scheme, data)
    else:
        dense = CompiledDenseOutput(None if shared(system) else twin, system, scheme, data)
        placed, replaced, suspects = record.placed, record.replaced, record.suspects
    rejected = [a for a in record.attempts if a.verdict is Verdict.REJECTED]
    stats = Statistics(
        steps=data.count,
        rejected=len(rejected),
        placements=placed,
        replaced=replaced,
        zone_steps=len(data.zones),
        evaluations=system.evaluations,
        factorisations=system.factorisations,
        wall_time=record.wall_time,
    )
    return Solution(
        mechanism,
        system,
        scheme,
        data,
        dense=dense,
        t_eval=t_eval,
        attempts=attempt_array(record.attempts),
        events=None if watch is None else watch.found(),
        status=record.status,
        message=record.message
        + turns(suspects, "the velocity turned", MENDED)
        + restarts(record.steps)
        + passings(record.steps)
        + drift(record.steps, norm)
        + _limits_left(mechanism, dense)
        + _driven_too_far(mechanism, record),
        stats=stats,
        settings=settings,
    )


def _driven_too_far(mechanism: Mechanism, record: RunRecord) -> str:
    """What else may be the cause where a driven mechanism cannot go on."""
    if record.status != "failed" or not mechanism.drives:
        return ""
    names = ", ".join(drive.name for drive in mechanism.drives)
    return f" A drive ({names}) may lead where the mechanism cannot follow."


def bifurcations_told(solution: Solution) -> str:
    """A sentence for each singular configuration that was reached without momentum."""
    found = solution.bifurcations
    more = f" There were {len(found)} of them." if len(found) > TOLD else ""
    return "".join(f" {bifurcation}." for bifurcation in found[:TOLD]) + more


def _limited_joints(mechanism: Mechanism) -> tuple[list[str], IndexArray, FloatArray]:
    """Names, indices in q (k,) and limits (2, k) of the one-degree joints that have limits."""
    model = mechanism.model
    names, indices, limits = [], [], []
    sprung = {force.joint for force in mechanism.forces if isinstance(force, LimitSpring)}
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        if joint.nq == 1 and name not in sprung:
            low = float(model.lowerPositionLimit[joint.idx_q])
            high = float(model.upperPositionLimit[joint.idx_q])
            if low < high and (np.isfinite(low) or np.isfinite(high)):
                names.append(name)
                indices.append(joint.idx_q)
                limits.append((low, high))
    return names, np.array(indices, dtype=int), np.array(limits).reshape(-1, 2).T


def _limits_left(mechanism: Mechanism, dense: DenseOutput) -> str:
    """A sentence naming the one-degree joints that left their limits, which do not act."""
    names, indices, (low, high) = mechanism.derived(
        "limited_joints", lambda: _limited_joints(mechanism)
    )
    if not names:
        return ""
    q = dense.nodes()[1][:, indices]
    # The reductions themselves: their methods cost more than they do here.
    least, largest = np.minimum.reduce(q), np.maximum.reduce(q)
    beyond = np.maximum(low - least, largest - high)
    if not max(beyond.tolist()) > 0.0:
        return ""
    # A run that a terminal event ends at a limit has not left it.
    slack = ROUND_OFF * np.maximum(1.0, np.maximum(-least, largest))
    left = [names[k] for k in np.flatnonzero(beyond > slack)]
    return f" Joint limits do not act; these joints left theirs: {', '.join(left)}." if left else ""
