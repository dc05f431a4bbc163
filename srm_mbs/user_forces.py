"""Forces that are Python functions of time and state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import pinocchio as pin

from srm_mbs.anchors import Anchor, name_places
from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.force_element import ForceElement


@dataclass(frozen=True)
class UserForce(ForceElement):
    """A function of the user's, called at every stage of every step.

    It should be smooth; where it is not, give the times as ``breakpoints`` to
    :func:`srm_mbs.simulate`.  The compiled kernel calls back for it, which costs most of its speed.
    It is not saved with a run, and no description has it.

    Parameters
    ----------
    function
        (t, q, v) -> generalised forces (nv,), N and N m; with ``at`` -> (6,), force (N) then moment
        (N m) on the link at the anchor's origin, in world axes.
    at
        An anchor on a moving link, or None.
    name
        Unique name; by default that of the function.

    Raises
    ------
    InputError
        If ``function`` cannot be called, or ``at`` is no anchor.
    """

    type: ClassVar[str] = "user"
    function: Callable[[float, FloatArray, FloatArray], Any]
    at: Anchor | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise InputError(
                f"{self.function!r} cannot be called",
                element=f"force {self.name or 'user'!r}",
                remedy="Give a function of (t, q, v)",
            )
        if not self.name:
            made = getattr(self.function, "__name__", "function").strip("<>")
            object.__setattr__(self, "name", f"user_{made}")
        name_places(f"force {self.name!r}", self.at)

    def check(self, model: pin.Model) -> None:
        if self.at is None:
            return
        try:
            joint, _ = self.at.resolve(model)
        except InputError as error:
            error.element = f"force {self.name!r}, anchor at"
            raise
        if joint == 0:
            raise InputError(
                f"{self.at.where!r} does not move",
                element=f"force {self.name!r}",
                remedy="Let the force act on a moving link",
            )
