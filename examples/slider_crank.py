"""The slider-crank through its singular configurations.

Writes slider_crank.png (drift, energy, distance to singular configurations, steps) and
slider_crank.html (animation) to the current folder; with --play it opens the browser.
"""

import sys

import srm_mbs as srm

mechanism = srm.load("slider_crank")
solution = srm.simulate(mechanism, 20.0, rtol=1e-8)

print(solution.message)
for crossing in solution.crossings:
    print(f"singular configuration passed at t = {crossing.time:.6f} s")
print(f"largest closure error {solution.drift[:, 0].max():.1e} m")
print(f"relative energy error {abs(solution.energy / solution.energy[0] - 1).max():.1e}")

solution.plot("slider_crank.png")
solution.export_html("slider_crank.html")
if "--play" in sys.argv:
    solution.play()
