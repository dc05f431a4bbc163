"""A DAE that is not a mechanism: a chemical reactor with a prescribed amount of one species.

Two reactions A -> B -> C take place, and the feed u of A makes the amount of A follow a prescribed
curve.  In the form x' = f - B y, 0 = g(t, x) the feed is the multiplier y = u of an index-2 DAE.
"""

import numpy as np

import srm_mbs as srm

K1, K2 = 1.0, 0.5  # 1/s


def target(t: float) -> tuple[float, float, float]:
    """The prescribed amount of A and its first two derivatives."""
    return 1.0 + 0.3 * np.sin(t), 0.3 * np.cos(t), -0.3 * np.sin(t)


problem = srm.SemiExplicitDAE(
    f=lambda t, x: np.array([-K1 * x[0], K1 * x[0] - K2 * x[1]]),
    B=lambda t, x: np.array([[-1.0], [0.0]]),  # feed u = y enters A
    g=lambda t, x: np.array([x[0] - target(t)[0]]),
    G=lambda t, x: np.array([[1.0, 0.0]]),
    g_t=lambda t, x: np.array([-target(t)[1]]),
)
result = srm.solve_dae(problem, (0.0, 10.0), [1.0, 0.0], rtol=1e-8)
print(result.message)

amount, slope, _ = target(10.0)
feed = slope + K1 * amount  # from A' = u - K1 A on the curve
print(f"feed at the end: {result.y[-1, 0]:.8f}, exactly {feed:.8f}")
print(f"B at the end: {result.x[-1, 1]:.8f}")
