"""Consistent states next to guesses that are closed and regular, in one call of the kernel.

Most mechanisms are described in a closed pose, and sweeps make hundreds of variants of such.  Where
the guess q0 is closed to round-off and the normalised rows in use A are independent, with all
singular values above a bound also in the free columns, assembly as
:mod:`~srm_mbs.assembly.position` and :mod:`~srm_mbs.assembly.velocity` have it comes down to

    q <- q (+) (-A^T (A A^T)^-1 g)    until g no longer falls,
    u <- u - A^T (A A^T)^-1 A u       twice, the second time for the rounding of the first,

because no search, no other branch and no curvature is involved.  The kernel checks this, without
the interpreter's lock; everything else is left to those two modules.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

from srm_mbs._kernel import core
from srm_mbs._typing import FloatArray
from srm_mbs.assembly.position import (
    CONSTRAINT_TOLERANCE,
    EXACTLY_CLOSED,
    POLISHING_EVALUATIONS,
    SINGULAR_ROUNDING,
)
from srm_mbs.assembly.velocity import (
    AT_REST,
    CLOSURE_ROUNDING,
    LARGEST_RATE_ERROR,
    NEARLY,
    RATE_TOLERANCE,
)
from srm_mbs.dynamics.constraints.compiled_rows import compiled_rows
from srm_mbs.dynamics.constraints.geometry import CLEARLY_MORE, open_spreads
from srm_mbs.dynamics.constraints.row_algebra import SPARSE_ABOVE
from srm_mbs.dynamics.constraints.structure import ROUNDING_ROW
from srm_mbs.dynamics.scaling import RELATIVE_ROUNDING, keep_units, rotating_coordinates
from srm_mbs.model.coordinates import free_coordinates
from srm_mbs.model.mechanism import MechanismData, per_model, per_tree

KEPT_FREE = 16
"""Sets of held joints whose free coordinates are kept: variants hold the same."""


@cache
def _rules() -> Any:
    """The bounds of assembly as the kernel takes them."""
    made: Any = core
    return made.StartRules(
        closed=CONSTRAINT_TOLERANCE,
        exact=EXACTLY_CLOSED,
        evaluations=POLISHING_EVALUATIONS,
        clearly_more=CLEARLY_MORE,
        rounding_row=ROUNDING_ROW,
        zero=SINGULAR_ROUNDING,
        regular=NEARLY,
        at_rest=AT_REST,
        rate_error=RATE_TOLERANCE,
        position_error=CLOSURE_ROUNDING,
        largest_rate_error=LARGEST_RATE_ERROR,
        size_rounding=RELATIVE_ROUNDING,
    )


@per_tree
def _free_coordinates(mechanism: MechanismData) -> dict[tuple[str, ...], list[int]]:
    """Velocity indices of the joints that are not held, by those that are."""
    return {}


def _free(mechanism: MechanismData, held: tuple[str, ...]) -> list[int]:
    known = _free_coordinates(mechanism)
    if held not in known:
        if len(known) >= KEPT_FREE:
            known.clear()
        known[held] = free_coordinates(mechanism, held).tolist()
    return known[held]


BEYOND_ROUNDING = 2.0
"""Factor by which numbers of :class:`Bodies` are beyond a bound, wherever the kernel rounds them
differently."""


class Bodies(NamedTuple):
    """How far the bodies of a mechanism are from doubts about them, as the kernel finds them.

    Attributes
    ----------
    least_inertia
        The least that a joint moves at the start, over the composite inertia
        (:func:`~srm_mbs.model.validation.undetermined_joint`).
    least_gyration, largest_gyration
        Radii of gyration, over the size of the body and over that of the mechanism
        (:mod:`~srm_mbs.formats.plausibility`).
    """

    least_inertia: float
    least_gyration: float
    largest_gyration: float


@per_model
def bodies_at_start(mechanism: MechanismData) -> Bodies | None:
    """Those next to which :func:`regular_start` found a start; None where it found none."""
    return None


def regular_start(
    mechanism: MechanismData,
    start: FloatArray,
    rates: FloatArray,
    held: tuple[str, ...],
    held_rates: tuple[str, ...],
) -> tuple[FloatArray, FloatArray] | None:
    """The consistent state, q (nq,) and v (nv,), of a mechanism with loops next to a closed and
    regular guess.

    Parameters
    ----------
    start : (nq,), rates : (nv,)
        The guess, and the requested rates.
    held, held_rates
        Joints whose positions, and whose rates, stay as they are.

    Returns
    -------
    tuple or None
        None for other guesses, for closures whose axes have a sense, which rows do not show, with
        drives, for more coordinates than dense algebra is for, and without the kernel.
    """
    if core is None or mechanism.drives or mechanism.model.nv > SPARSE_ABOVE:
        return None
    if any(len(loop.rows.matched) for loop in mechanism.loops):
        return None
    found = compiled_rows(mechanism).regular_start(
        _rules(),
        start,
        rates,
        _free(mechanism, held),
        _free(mechanism, held_rates),
        rotating_coordinates(mechanism),
        open_spreads(int(mechanism.model.nv)),
    )
    if found is None:
        return None
    q, v, diagonal, *numbers = found
    keep_units(mechanism, start, diagonal)
    bodies_at_start.keep(mechanism, Bodies(*numbers))
    return q, v
