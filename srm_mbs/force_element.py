"""What every force element is; the kinds are in :mod:`srm_mbs.forces` and ``user_forces``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import pinocchio as pin


class ForceElement(ABC):
    """What acts on the joints or links of a mechanism; the kinds are in :mod:`srm_mbs.forces`.

    Attributes
    ----------
    type
        Its type in a description.
    name
        Unique name; by default made from the type and what the element acts on.
    has_potential
        Whether its force at rest follows from a potential, which ``solution.energy`` contains.
    """

    type: ClassVar[str]
    has_potential: ClassVar[bool] = False
    name: str

    @abstractmethod
    def check(self, model: pin.Model) -> None:
        """Refuse a joint, link or frame that ``model`` does not have or that cannot take the force.

        Raises
        ------
        InputError
            Naming the element and the remedy.
        """
