"""A sweep over coupler mass and crank speed of a four-bar, to find overloads of its pin.

Each case has its own masses and initial state.  One of them is not a valid mechanism; it becomes a
failure and does not end the sweep.  A file keeps finished cases: a second run of this program
simulates none of them again.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product

import numpy as np

import srm_mbs as srm

MASSES, SPEEDS = (0.5, 1.0, 2.0, -1.0), (2.0, 4.0, 6.0)  # times the coupler's, rad/s
END, LIMIT = 2.0, 120.0  # s, N

four_bar = srm.load("four_bar")


def with_coupler(mass: float, speed: float) -> srm.Mechanism:
    """The four-bar with ``mass`` times the mass of its coupler, and the crank at ``speed``."""
    if mass < 0.0:
        raise ValueError(f"{mass:g} times a mass")
    model = four_bar.model.copy()
    joint = model.getJointId("coupler")
    scaled = model.inertias[joint].copy()
    scaled.mass *= mass
    scaled.inertia = scaled.inertia * mass
    model.inertias[joint] = scaled
    heavy = replace(four_bar, model=model)
    start = srm.assemble(heavy, v={"crank": speed})
    return heavy.with_state(start.q, start.v)


def load_of_the_pin(solution: srm.Solution) -> dict[str, float]:
    """Largest force in the closure (N), and the standard measures."""
    (pin,) = solution.reactions.values()
    force = float(np.linalg.norm(pin[:, :3], axis=1).max())
    return {**srm.standard_measures(solution), "force": force}


cases = [{"mass": mass, "speed": speed} for mass, speed in product(MASSES, SPEEDS)]
with ThreadPoolExecutor(2) as threads:
    sweep = srm.sweep(
        with_coupler,
        cases,
        END,
        measure=load_of_the_pin,
        executor=threads,
        resume="parameter_sweep.jsonl",
        rtol=1e-8,
    )

print(sweep)
print("coupler   crank (rad/s)   largest force (N)")
for mass, speed, force in zip(*(sweep.table[name] for name in ("mass", "speed", "force"))):
    if np.isfinite(force):
        verdict = "  too much" if force > LIMIT else ""
        print(f"{mass:7.1f}   {speed:13.1f}   {force:17.1f}{verdict}")
for failure in sweep.failures:
    print(f"not simulated: {dict(failure.parameters)}: {failure.message}")
