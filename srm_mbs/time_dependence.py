"""Which parts of a mechanism depend on time, until when, and where they are not smooth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from srm_mbs.errors import InputError
from srm_mbs.force_element import ForceElement
from srm_mbs.laws import Law

if TYPE_CHECKING:
    from srm_mbs.drives import Drive

NamedLaw = tuple[str, Law]
"""An element, and a law over time that it follows."""


def laws_over_time(drives: Sequence[Drive], forces: Sequence[ForceElement]) -> tuple[NamedLaw, ...]:
    """Every law that drives and force elements follow."""
    found = [(f"drive {drive.name!r}", drive.law) for drive in drives]
    for force in forces:
        given = getattr(force, "law", None) or ()
        laws = given if isinstance(given, tuple) else (given,)
        found += [(f"force {force.name!r}", law) for law in laws]
    return tuple(found)


def check_covers(laws: Sequence[NamedLaw], t_end: float) -> None:
    """Refuse a run to ``t_end`` (s) that is longer than a table.

    Raises
    ------
    InputError
        Naming what has the table.
    """
    for element, law in laws:
        last = law.span[1]
        if last < t_end:
            raise InputError(
                f"its table ends at t = {last:g} s, before the run, at {t_end:g} s",
                element=element,
                remedy="Extend the table, or end the run earlier",
            )


def knots_between(laws: Sequence[NamedLaw], t0: float, t_end: float) -> tuple[float, ...]:
    """Times (s) between ``t0`` and ``t_end`` at which a law is not smooth, in order."""
    times = {knot for _, law in laws for knot in law.knots}
    return tuple(sorted(knot for knot in times if t0 < knot < t_end))
