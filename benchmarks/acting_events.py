"""What an event with an action costs: the time of a run over its impacts.

    python -m benchmarks.acting_events [--models NAME ...] [--impacts 1600] [--repeats 5]

The first joint of each mechanism moves between two stops and is thrown back by each without loss
(:func:`srm_mbs.impact`, which closures take part in; ``ball`` is a mass on a prismatic joint, whose
speed is reversed).  The stops are so close that there are as many impacts in half a second.  CPU
time of the whole run, its integration between the impacts included, in milliseconds for each
impact: the least of the repeats.  BLAS runs on one thread.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import pinocchio as pin

import srm_mbs as srm

SPAN = 0.5
"""Length (s) of a run."""
MODELS = ("ball", "four_bar")


def mechanism_of(name: str) -> srm.Mechanism:
    """A bundled mechanism, or the ``ball``."""
    if name != "ball":
        return srm.load(name)
    model = pin.Model()
    slide = model.addJoint(0, pin.JointModelPZ(), pin.SE3.Identity(), "slide")
    inertia = pin.Inertia(1.0, np.zeros(3), np.eye(3))
    model.appendBodyToJoint(slide, inertia, pin.SE3.Identity())
    return srm.Mechanism(model, q0=[0.0], v0=[5.0])


def stops(mechanism: srm.Mechanism, impacts: int) -> list[srm.Event]:
    """Two stops around the start of the first joint, as far apart as it goes in the time of an
    impact."""
    joint = mechanism.joint(mechanism.joint_names[0])
    place, rate = joint.idx_q, joint.idx_v
    start, speed = mechanism.q0[place], abs(mechanism.v0[rate])
    reach = 0.5 * speed * SPAN / impacts
    normal = np.zeros(mechanism.model.nv)
    normal[rate] = 1.0

    def hit(t: float, q: Any, v: Any) -> Any:
        return q, srm.impact(mechanism, q, v, normal, 1.0) if mechanism.constrained else -v

    return [
        srm.Event(lambda t, q, v: start + reach - q[place], direction=-1, action=hit),
        srm.Event(lambda t, q, v: q[place] - start + reach, direction=-1, action=hit),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    parser.add_argument("--models", nargs="+", default=list(MODELS))
    parser.add_argument("--impacts", type=int, default=1600)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    print("                 impacts  ms each")
    for name in options.models:
        mechanism = mechanism_of(name)
        events = stops(mechanism, options.impacts)
        least = np.inf
        for _ in range(options.repeats):
            start = time.process_time()
            run = srm.simulate(mechanism, SPAN, events=events)
            least = min(least, 1e3 * (time.process_time() - start))
        found = sum(len(times) for times in run.t_events or ())
        print(f"{name:16s} {found:7d} {least / max(found, 1):8.3f}", flush=True)


if __name__ == "__main__":
    main()
