"""Configurations over the position of a crank, which a hand turns in the page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.manifold import joint_track
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import is_angle


@dataclass(frozen=True)
class CrankMark:
    """A dead point of the crank, or a singular configuration.

    Attributes
    ----------
    time
        In the animation, s.
    position
        Of the crank, rad or m.
    loops
        The loops whose rows lose rank there; none at a dead point.
    """

    time: float
    position: float
    loops: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class CrankPositions:
    """The data of a :class:`~srm_mbs.CrankMotion`, without the methods that show it."""

    mechanism: Mechanism
    t: FloatArray
    q: FloatArray
    crank: str
    positions: FloatArray
    rates: FloatArray
    start: float
    turns: bool
    closed: bool
    marks: tuple[CrankMark, ...]
    transmission_angle: FloatArray | None

    def __repr__(self) -> str:
        motion = "turns fully" if self.turns else f"{len(self.dead_points)} dead points"
        return (
            f"CrankMotion({self.mechanism.name!r}, crank={self.crank!r}, {motion}, "
            f"{len(self.singular_positions)} singular, {len(self.t)} configurations)"
        )

    @property
    def unit(self) -> str:
        """``rad`` or ``m``, that of the crank."""
        return "rad" if is_angle(self.mechanism.model, self.crank) else "m"

    @property
    def dead_points(self) -> tuple[float, ...]:
        """Positions (rad, m) at which the crank turns back."""
        return tuple(mark.position for mark in self.marks if not mark.loops)

    @property
    def singular_positions(self) -> tuple[float, ...]:
        """Positions (rad, m) of the crank in the singular configurations."""
        return tuple(mark.position for mark in self.marks if mark.loops)

    def rows(self) -> Iterator[tuple[str, str]]:
        """Range, dead points and singular configurations as a table: (quantity, value)."""
        unit = self.unit
        if self.turns:
            yield "crank", f"{self.crank} turns fully"
        else:
            low, high = self.positions.min(), self.positions.max()
            yield "crank", f"{self.crank} moves from {low:.6g} to {high:.6g} {unit}"
        for mark in self.marks:
            at = f"{self.crank} = {mark.position:.9g} {unit}"
            if mark.loops:
                yield "singular configuration", f"{at}, loops {', '.join(mark.loops)}"
            else:
                yield "dead point", at

    def track(self, joint: str) -> FloatArray:
        """Positions (n,) of a joint of one degree of freedom, rad (unwrapped) or m."""
        return joint_track(self.mechanism, self.q, joint)
