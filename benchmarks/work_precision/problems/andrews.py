"""P4: Andrews' squeezing mechanism, 0.03 s (Multibody Systems Handbook; DAE test set, Bari).

The reference comes from the equations as the test set prints them, in its seven angles
(beta, theta, gamma, phi, delta, omega, epsilon), not from Pinocchio.
"""

from __future__ import annotations

from functools import cache

import numpy as np

import srm_mbs as srm
from benchmarks.work_precision.problems.base import Array, Problem, ReducedModel, state
from benchmarks.work_precision.trees import Spring, Tree, tree_of

M1, M2, M3, M4, M5, M6, M7 = 0.04325, 0.00365, 0.02373, 0.00706, 0.0705, 0.00706, 0.05498  # kg
I1, I2, I3, I4 = 2.194e-6, 4.41e-7, 5.255e-6, 5.667e-7  # kg m^2
I5, I6, I7 = 1.169e-5, 5.667e-7, 1.912e-5
XA, YA, XB, YB, XC, YC = -0.06934, -0.00227, -0.03635, 0.03273, 0.014, 0.072  # m
STIFFNESS, REST, TORQUE = 4530.0, 0.07785, 0.033  # N/m, m, N m
D, DA, E, EA, RR, RA = 0.028, 0.0115, 0.02, 0.01421, 0.007, 0.00092  # m
SS, SA, SB, SC, SD = 0.035, 0.01874, 0.01043, 0.018, 0.02
TA, TB, U, UA, UB = 0.02308, 0.00916, 0.04, 0.01228, 0.00449
ZF, ZT, FA = 0.02, 0.04, 0.01421
TREE_ORDER = [0, 1, 4, 3, 6, 5, 2]
"""Where the tree's joints (beta, theta, delta, phi, epsilon, omega, gamma) are in these angles."""


def _mass(q: Array) -> Array:
    cth, sph, som = np.cos(q[1]), np.sin(q[3]), np.sin(q[5])
    M = np.zeros((7, 7), q.dtype)
    M[0, 0] = M1 * RA**2 + M2 * (RR**2 - 2 * DA * RR * cth + DA**2) + I1 + I2
    M[1, 0] = M[0, 1] = M2 * (DA**2 - DA * RR * cth) + I2
    M[1, 1] = M2 * DA**2 + I2
    M[2, 2] = M3 * (SA**2 + SB**2) + I3
    M[3, 3] = M4 * (E - EA) ** 2 + I4
    M[4, 3] = M[3, 4] = M4 * ((E - EA) ** 2 + ZT * (E - EA) * sph) + I4
    M[4, 4] = (
        M4 * (ZT**2 + 2 * ZT * (E - EA) * sph + (E - EA) ** 2) + M5 * (TA**2 + TB**2) + I4 + I5
    )
    M[5, 5] = M6 * (ZF - FA) ** 2 + I6
    M[6, 5] = M[5, 6] = M6 * ((ZF - FA) ** 2 - U * (ZF - FA) * som) + I6
    M[6, 6] = (
        M6 * ((ZF - FA) ** 2 - 2 * U * (ZF - FA) * som + U**2) + M7 * (UA**2 + UB**2) + I6 + I7
    )
    return M


def _force(q: Array, v: Array) -> Array:
    sth, sga, cga = np.sin(q[1]), np.sin(q[2]), np.cos(q[2])
    cph, com = np.cos(q[3]), np.cos(q[5])
    bep, thp, php, dep, omp, epp = v[0], v[1], v[3], v[4], v[5], v[6]
    xd = SD * cga + SC * sga + XB
    yd = SD * sga - SC * cga + YB
    length = np.hypot(xd - XC, yd - YC)
    pull = -STIFFNESS * (length - REST) / length
    fx, fy = pull * (xd - XC), pull * (yd - YC)
    return np.array(
        [
            TORQUE - M2 * DA * RR * thp * (thp + 2 * bep) * sth,
            M2 * DA * RR * bep**2 * sth,
            fx * (SC * cga - SD * sga) + fy * (SD * cga + SC * sga),
            M4 * ZT * (E - EA) * dep**2 * cph,
            -M4 * ZT * (E - EA) * php * (php + 2 * dep) * cph,
            -M6 * U * (ZF - FA) * epp**2 * com,
            M6 * U * (ZF - FA) * omp * (omp + 2 * epp) * com,
        ]
    )


def closures(q: Array, v: Array) -> tuple[Array, Array, Array]:
    """g (6,) in m, G (6, 7) and Gdot v (6,)."""
    be, th, ga, ph, de, om, ep = q
    bt, pd, oe = be + th, ph + de, om + ep
    g = np.array(
        [
            RR * np.cos(be) - D * np.cos(bt) - SS * np.sin(ga) - XB,
            RR * np.sin(be) - D * np.sin(bt) + SS * np.cos(ga) - YB,
            RR * np.cos(be) - D * np.cos(bt) - E * np.sin(pd) - ZT * np.cos(de) - XA,
            RR * np.sin(be) - D * np.sin(bt) + E * np.cos(pd) - ZT * np.sin(de) - YA,
            RR * np.cos(be) - D * np.cos(bt) - ZF * np.cos(oe) - U * np.sin(ep) - XA,
            RR * np.sin(be) - D * np.sin(bt) - ZF * np.sin(oe) + U * np.cos(ep) - YA,
        ]
    )
    G = np.zeros((6, 7), q.dtype)
    G[::2, 0] = -RR * np.sin(be) + D * np.sin(bt)
    G[::2, 1] = D * np.sin(bt)
    G[1::2, 0] = RR * np.cos(be) - D * np.cos(bt)
    G[1::2, 1] = -D * np.cos(bt)
    G[0, 2], G[1, 2] = -SS * np.cos(ga), -SS * np.sin(ga)
    G[2, 3], G[3, 3] = -E * np.cos(pd), -E * np.sin(pd)
    G[2, 4], G[3, 4] = -E * np.cos(pd) + ZT * np.sin(de), -E * np.sin(pd) - ZT * np.cos(de)
    G[4, 5], G[5, 5] = ZF * np.sin(oe), -ZF * np.cos(oe)
    G[4, 6], G[5, 6] = ZF * np.sin(oe) - U * np.cos(ep), -ZF * np.cos(oe) - U * np.sin(ep)
    bep, thp, gap, php, dep, omp, epp = v
    b2, bt2, pd2, oe2 = bep**2, (bep + thp) ** 2, (php + dep) ** 2, (omp + epp) ** 2
    x = -RR * np.cos(be) * b2 + D * np.cos(bt) * bt2
    y = -RR * np.sin(be) * b2 + D * np.sin(bt) * bt2
    bias = np.array(
        [
            x + SS * np.sin(ga) * gap**2,
            y - SS * np.cos(ga) * gap**2,
            x + E * np.sin(pd) * pd2 + ZT * np.cos(de) * dep**2,
            y - E * np.cos(pd) * pd2 + ZT * np.sin(de) * dep**2,
            x + ZF * np.cos(oe) * oe2 + U * np.sin(ep) * epp**2,
            y + ZF * np.sin(oe) * oe2 - U * np.cos(ep) * epp**2,
        ]
    )
    return g, G, bias


def _eliminated(A: Array, b: Array) -> Array:
    """x with A x = b, of arrays of expressions, in the order of the rows.

    The pivots are those of M, which is positive definite, and of -G M^-1 G^T, which is negative
    definite.
    """
    A, b = A.copy(), b.copy()
    n = len(b)
    for k in range(n):
        for i in range(k + 1, n):
            if isinstance(A[i, k], int):  # no expression, but the 0 of an array of objects
                continue
            factor = A[i, k] / A[k, k]
            for j in range(k + 1, n):
                if not isinstance(A[k, j], int):
                    A[i, j] = A[i, j] - factor * A[k, j]
            b[i] = b[i] - factor * b[k]
    for k in reversed(range(n)):
        for j in range(k + 1, n):
            if not isinstance(A[k, j], int):
                b[k] = b[k] - A[k, j] * b[j]
        b[k] = b[k] / A[k, k]
    return b


def field(t: float, y: Array) -> Array:
    """(q', v') of the index-1 equations, y = (q, v) (14,) in the test set's order: numbers, or
    expressions of a program that differentiates them."""
    q, v = y[:7], y[7:]
    _, G, bias = closures(q, v)
    kkt = np.zeros((13, 13), y.dtype)
    kkt[:7, :7], kkt[:7, 7:], kkt[7:, :7] = _mass(q), G.T, G
    right = np.concatenate([_force(q, v), -bias])
    solve = _eliminated if y.dtype == object else np.linalg.solve
    return np.concatenate([v, solve(kkt, right)[:7]])


def project(y: Array) -> Array:
    """y (14,) moved onto the closures and their rates."""
    q, v = y[:7], y[7:]
    for _ in range(3):
        g, G, _ = closures(q, v)
        q = q - np.linalg.lstsq(G, g, rcond=None)[0]
    _, G, _ = closures(q, v)
    return np.concatenate([q, v - np.linalg.lstsq(G, G @ v, rcond=None)[0]])


def in_tree_order(y: Array) -> Array:
    """(n, 14) in the test set's order, in that of the tree."""
    return np.hstack([y[:, :7][:, TREE_ORDER], y[:, 7:][:, TREE_ORDER]])


def _field_of_tree(t: float, y: Array) -> Array:
    """As :func:`field`, in the order of the tree."""
    order = np.argsort(TREE_ORDER)
    rates = field(t, np.concatenate([y[:7][order], y[7:][order]]))
    return np.concatenate([rates[:7][TREE_ORDER], rates[7:][TREE_ORDER]])


def _tree(mechanism: srm.Mechanism) -> Tree:
    model = mechanism.model
    bare = tree_of(mechanism, rows=(0, 2))
    torque = np.zeros(model.nv)
    torque[mechanism.joint("beta").idx_v] = TORQUE
    spring = Spring(model.getJointId("gamma"), (SD, 0.0, -SC), (XC, 0.0, YC), STIFFNESS, REST)
    return Tree(model, bare.closures, bare.q0, bare.v0, torque, (spring,))


def squeezing_mechanism() -> Problem:
    """The bundled squeezing_mechanism; rates count in rad/ms."""
    mechanism = cache(lambda: srm.load("squeezing_mechanism"))
    start = mechanism()
    return Problem(
        "squeezing_mechanism",
        "P4: Andrews' squeezing mechanism, three loops, regular, 0.03 s",
        0.03,
        mechanism,
        lambda: _tree(mechanism()),
        state,
        rates=7,
        rate_unit=1000.0,
        index_one=ReducedModel(_field_of_tree, (*start.q0, *start.v0)),
        planar=(0, 2),
        gains=(300.0, 1000.0, 3000.0),
    )
