"""Singular configurations next to given ones."""

from __future__ import annotations

from typing import Any

import numpy as np

from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.singularities.local_analysis import (
    SingularConfiguration,
    analyse_singular,
    nearest_singular,
)


def singular_at(mechanism: Mechanism, q: Any) -> SingularConfiguration:
    """The analysed singular configuration nearest to q (nq,)."""
    geometry = ClosureGeometry(mechanism, mechanism.q0)
    rank = mechanism.structure.rank
    found = nearest_singular(geometry, np.asarray(q, dtype=float), rank, reach=0.3)
    assert found is not None
    return analyse_singular(geometry, found, rank)
