"""A Stewart platform on springs: static equilibrium, vibration and the response to a push.

The linearisation gives the frequencies of the six modes; a run starts with a push, whose decay
follows the slowest mode.
"""

import numpy as np

import srm_mbs as srm

mechanism = srm.load("stewart_platform")
print("degrees of freedom:", mechanism.degrees_of_freedom, "closures:", len(mechanism.loops))

rest = srm.equilibrium(mechanism)
height = rest.q[mechanism.joint("platform").idx_q + 2]
print(f"at rest the platform stands at {height:.4f} m, stable: {rest.stable}")

linear = srm.linearise(mechanism, rest.q)
print("  mode   frequency (Hz)   damping ratio")
swinging = [s for s in linear.eigenvalues if s.imag > 0.0]
for k, s in enumerate(sorted(swinging, key=lambda s: s.imag), 1):
    print(f"{k:6d} {abs(s) / (2.0 * np.pi):16.3f} {-s.real / abs(s):15.4f}")

# The push: a velocity of the platform along x; assembly computes the rates of the legs.
still = mechanism.with_state(rest.q, np.zeros(mechanism.model.nv))
start = srm.assemble(still, v={"platform": [0.3, 0.0, 0.0, 0.0, 0.0, 0.0]})
run = srm.simulate(still, 5.0, q0=start.q, v0=start.v, rtol=1e-8)
first = mechanism.joint("platform").idx_q
away = np.linalg.norm(run.q[:, first : first + 3] - rest.q[first : first + 3], axis=1)
print(f"pushed with 0.3 m/s it moves {away.max() * 1e3:.1f} mm away")
print(f"energy balance over the run: {run.energy_balance.relative:.0e}")
run.export_html("stewart_platform.html")
