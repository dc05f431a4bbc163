"""The peers, by name; a module each.  Importing this imports no simulator but Pinocchio."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from benchmarks.work_precision.peers.base import Peer
from benchmarks.work_precision.peers.exudyn_alpha import ExudynAlpha
from benchmarks.work_precision.peers.mujoco_rk4 import MujocoRK4
from benchmarks.work_precision.peers.ours import Ours
from benchmarks.work_precision.peers.pinocchio_dop853 import (
    PinocchioDOP853,
    PinocchioDOP853Baumgarte,
)
from benchmarks.work_precision.peers.pinocchio_projected import PinocchioRK4Projected
from benchmarks.work_precision.peers.pinocchio_rk4 import PinocchioRK4Baumgarte
from benchmarks.work_precision.peers.reduced_implicit import (
    ReducedCVODE,
    ReducedIDA,
    ReducedRadau,
)
from benchmarks.work_precision.peers.reduced_ode import ReducedODE
from benchmarks.work_precision.peers.reduced_taylor import ReducedTaylor
from benchmarks.work_precision.peers.scipy_dae_radau import ScipyDaeRadau
from benchmarks.work_precision.peers.sundials_ida import SundialsIDA

PEERS: Mapping[str, Peer] = MappingProxyType(
    {
        peer.name: peer
        for peer in (
            Ours(),
            ReducedODE(),
            ReducedTaylor(),
            PinocchioDOP853(),
            PinocchioDOP853Baumgarte(),
            PinocchioRK4Baumgarte(),
            PinocchioRK4Projected(),
            MujocoRK4(),
            ExudynAlpha(),
            SundialsIDA(),
            ScipyDaeRadau(),
            ReducedRadau(),
            ReducedCVODE(),
            ReducedIDA(),
        )
    }
)
