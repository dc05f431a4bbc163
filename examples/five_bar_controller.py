"""A controller on a five-bar: both cranks are actuated and follow a desired motion.

In a first run drives prescribe the motion; their forces are the feed-forward torques.  The
controller adds a PD correction.  It is sampled every five milliseconds, its output is held in
between, and the coupler of the controlled mechanism is heavier than that of the model.
"""

from dataclasses import replace

import numpy as np

import srm_mbs as srm

CRANKS = ("crank_left", "crank_right")
SAMPLE, END = 5e-3, 3.0  # s
STIFFNESS, DAMPING = 200.0, 20.0  # N m/rad, N m s/rad

mechanism = srm.load("five_bar")
cranks = [mechanism.joint(name).idx_q for name in CRANKS]
still = mechanism.with_state(mechanism.q0, np.zeros(mechanism.model.nv))

# Swings that start at rest: s(t) - s(0) = amplitude (1 - cos 3 t).
swings = [
    srm.Drive(srm.Sine(amplitude, omega=3.0, phase=-0.5 * np.pi), joint=name)
    for name, amplitude in zip(CRANKS, (-0.2, 0.1))
]
wanted = srm.simulate(replace(still, drives=swings), END, rtol=1e-8)
feed = np.column_stack([wanted.drive_forces[name] for name in CRANKS])
print(f"largest torque of the feed-forward {np.abs(feed).max():.1f} N m")

heavy = still.model.copy()
heavy.inertias[still.model.getJointId("coupler_left")].mass *= 1.2
plant = replace(still, model=heavy)
errors = []


def controller(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Torques (nv,), zero for the passive joints."""
    q_wanted, v_wanted = wanted(t)
    off = (q_wanted - q)[cranks]
    errors.append(np.abs(off).max())
    tau = np.zeros(mechanism.model.nv)
    tau[cranks] = [np.interp(t, wanted.t, torque) for torque in feed.T]
    tau[cranks] += STIFFNESS * off + DAMPING * (v_wanted - v)[cranks]
    return tau


run = srm.simulate(plant, END, controller=controller, sample_time=SAMPLE)
print(f"{len(errors)} samples, largest error of the cranks {max(errors):.1e} rad")
print(f"drift {run.drift[:, 0].max():.0e} m")
