r"""Tangents of the solution branches that meet in a singular configuration.

They are the real solutions of the homogeneous quadratic equations w^T B_j w = 0, where B_j are the
forms u_j^T Gdot on the velocities v = N w that keep the loops closed.  Directions that no form sees
(the motion of a free base, the spin of a rod about its axis) belong to every branch and are split
off.  If one direction per branch is left, there are at most 2^k of them for nullity k.  Otherwise
each branch has a whole tangent space there; given an arriving velocity v_a, the stationary points
of the distance from v_a (in the mass metric) on the solution set are one velocity per branch: the
one that a motion arriving with v_a would have if it were forced onto that branch, momentum along
the branch kept.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.singularities.local_analysis import VANISHING, SingularConfiguration

MOST_STARTS = 400
STARTS_PER_TANGENT = 40
"""Random starts of Newton's iteration per possible tangent; MOST_STARTS is enough up to k = 4."""
LARGEST_NULLITY = 12
"""Nullity up to which branches are searched: with more there are too many to be listed."""
ITERATIONS = 60
SOLVED = 1e-13
ISOLATED = 1e-4
"""Smallest singular value of Newton's matrix at an isolated solution; double ones are no branches
of their own to second order."""
SAME = 1e-6
"""Directions closer than this (chord of unit vectors) are one."""


def _two_lines(form: FloatArray) -> FloatArray:
    """Directions (0 or 2, 2) on which a quadratic form (2, 2) vanishes."""
    values, vectors = np.linalg.eigh(form)
    low, high = values
    if not (low < 0.0 < high and min(-low, high) > ISOLATED * max(-low, high)):
        return np.zeros((0, 2))
    along = np.sqrt(np.array([high, -low]) / (high - low))
    return np.array([vectors @ along, vectors @ (along * [1.0, -1.0])])


def _newton(forms: FloatArray, metric: FloatArray, target: FloatArray | None) -> FloatArray:
    """Isolated solutions (n, c) of w^T B_j w = 0: of unit length, or stationary for ``target``.

    With a ``target`` of unit size the unknowns are w and multipliers mu,
    metric (w - target) + sum mu_j B_j w = 0.
    """
    k, c = forms.shape[:2]
    starts = min(MOST_STARTS, STARTS_PER_TANGENT * 2**k)
    w = np.random.default_rng(0).standard_normal((starts, c)) / np.sqrt(c)
    mu = np.zeros((starts, 0 if target is None else k))
    corner = np.zeros((starts, k, k))
    for _ in range(ITERATIONS):
        Bw = np.einsum("jab,ib->ija", forms, w)
        quadratic = np.einsum("ija,ia->ij", Bw, w)
        if target is None:
            residual = np.concatenate([quadratic, (w * w).sum(axis=1)[:, None] - 1.0], axis=1)
            matrix = np.concatenate([2.0 * Bw, 2.0 * w[:, None, :]], axis=1)
        else:
            balance = (w - target) @ metric + np.einsum("ij,ija->ia", mu, Bw)
            residual = np.concatenate([quadratic, balance], axis=1)
            hessian = metric + np.einsum("ij,jab->iab", mu, forms)
            upper = np.concatenate([2.0 * Bw, corner], axis=2)
            matrix = np.concatenate(
                [upper, np.concatenate([hessian, np.swapaxes(Bw, 1, 2)], axis=2)], axis=1
            )
        step = np.einsum("iab,ib->ia", np.linalg.pinv(matrix, rcond=1e-12), residual)
        # A singular matrix on the way must not throw a start to infinity.
        step /= np.maximum(1.0, np.linalg.norm(step, axis=1))[:, None]
        w = w - step[:, :c]
        mu = mu - step[:, c:]
        if np.abs(step).max() < 1e-15:
            break
    good = np.abs(residual).max(axis=1) <= SOLVED
    good &= np.linalg.svd(matrix, compute_uv=False)[:, -1] > ISOLATED
    return w[good]  # type: ignore[no-any-return]


def branch_tangents(
    singular: SingularConfiguration, arriving: FloatArray | None = None
) -> FloatArray:
    """Velocity directions (k, n) of the branches, in units, of unit length there.

    Parameters
    ----------
    singular
        An exactly singular configuration.
    arriving : (n,)
        Arriving velocity in units.  Tangents point the way that makes the smaller angle with it,
        or with drives the way that time passes; those without are then left out.

    Returns
    -------
    (k, n)
        Sorted by the angle with ``arriving``, if given.  Empty if no isolated ones were found (a
        singularity of higher order), or where they need an arriving velocity: where a branch has
        more than one direction that the forms see, which with drives is not done at all.  With
        nullity above 4 some may be missing, above LARGEST_NULLITY all are.
    """
    none = np.zeros((0, len(singular.null)))
    if singular.nullity > LARGEST_NULLITY:
        return none
    geometry, null, forms = singular.geometry, singular.null, singular.forms
    n, p = null.shape
    flat_forms = forms.reshape(len(forms), p * p)
    _, size, independent = np.linalg.svd(flat_forms, full_matrices=False)
    independent = independent[size > VANISHING]
    k = len(independent)
    if k < singular.nullity:
        return none
    geometry.closure(singular.q)
    driven = n > len(geometry.coordinate_unit)
    M = geometry.mass()
    if driven:
        # Any metric does where every branch has one direction.
        M = block_diag(M, np.trace(M) / len(M))
    metric = null.T @ M @ null
    _, size, right = np.linalg.svd(independent.reshape(k * p, p))
    seen = int(np.sum(size > VANISHING))
    unseen = right[seen:].T
    # The complement in the mass metric: the distance to an arriving velocity splits there.
    complement = np.linalg.svd(unseen.T @ metric)[2][p - seen :].T
    restricted = complement.T @ independent.reshape(k, p, p) @ complement
    inner = complement.T @ metric @ complement
    inner = inner / np.trace(inner) * seen
    target, base = np.zeros(seen), np.zeros(p)
    if arriving is not None:
        here = np.linalg.solve(metric, null.T @ (M @ arriving))
        split = np.linalg.solve(np.column_stack([complement, unseen]), here)
        target, base = split[:seen], unseen @ split[seen:]
    speed = float(np.linalg.norm(target))
    if seen - singular.nullity == 1:
        lines = (
            _two_lines(restricted[0]) if seen == 2 and k == 1 else _newton(restricted, inner, None)
        )
        if speed > 0.0:
            share = (lines @ inner @ target) / np.einsum("ia,ab,ib->i", lines, inner, lines)
            share[np.abs(share) < 1e-12 * speed] = speed
            lines = lines * share[:, None]
    elif speed > 0.0 and not driven:
        lines = _newton(restricted, inner, target / speed) * speed
    else:
        return none
    found = (lines @ complement.T + base) @ null.T
    unique: list[FloatArray] = []
    for direction in found:
        direction = direction / np.linalg.norm(direction)
        lead = direction[np.argmax(np.abs(direction) > 0.1 * np.abs(direction).max())]
        if driven:
            lead = direction[-1]
            if abs(lead) < SAME:  # t' = 0: no motion has this direction
                continue
        elif arriving is not None:
            lead = direction @ arriving
        if lead < 0.0:
            direction = -direction
        if all(np.linalg.norm(direction - other) > SAME for other in unique):
            unique.append(direction)
    if arriving is not None:
        unique.sort(key=lambda direction: -float(direction @ arriving))
    else:
        unique.sort(key=lambda direction: tuple(np.round(-direction, 6)))
    return np.array(unique).reshape(-1, n)
