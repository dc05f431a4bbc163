"""This package, with its defaults; the tableau and the backend are the variants."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

import srm_mbs as srm
from benchmarks.work_precision.peers.base import (
    Array,
    Outcome,
    Peer,
    Run,
    RunFailedError,
    Runner,
    Setting,
)
from benchmarks.work_precision.problems.base import Problem

TOLERANCES = tuple(10.0**-k for k in range(2, 13))
"""From the loosest that ``simulate`` takes."""
LOOSEST = {"dop853": 1e-2, "dopr54": 1e-3}


class Ours(Peer):
    """``srm.simulate`` and its dense output at the samples."""

    name = "ours"
    modules = ("srm_mbs",)

    @property
    def title(self) -> str:  # type: ignore[override]
        """Tells the Python reference where that is measured in place of the kernel."""
        return "srm_mbs" if srm.backend() != "python" else "srm_mbs (Python reference)"

    def check(self, problem: Problem) -> None:
        """For all problems."""

    def variants(self, stiff: bool = False) -> list[str]:
        """``tableau, backend``; with generated code as the default, the kernel without it as well,
        and the Python backend.  The default tableau has its own name where the problem is stiff;
        elsewhere it is dop853."""
        usual, other = ("auto", "rodas5p") if stiff else ("dop853", "dopr54")
        out = [f"{usual}, auto", f"{other}, auto"]
        if srm.backend() == "generated":
            out.append(f"{usual}, kernel")
        if srm.backend() != "python" and not stiff:
            out.append(f"{usual}, python")
        return out

    def settings(self, problem: Problem) -> Sequence[Setting]:
        return [
            Setting("rtol", tol, name)
            for name in self.variants(problem.stiff)
            for tol in TOLERANCES
            if tol <= LOOSEST.get(name.split(", ")[0], 1e-2)
        ]

    def everyday(self, problem: Problem) -> Setting:
        return Setting("rtol", 1e-8, "dop853, auto")

    def prepare(self, problem: Problem) -> Runner:
        mechanism = problem.mechanism
        _ = mechanism.structure  # the analysis of the closures, done once per mechanism
        self.compiler_time = None
        if srm.backend() == "generated":
            with suppress(srm.InputError):  # mechanisms without code, which the kernel runs
                self.compiler_time = srm.compile(mechanism).seconds or None
        times = problem.times

        def at(setting: Setting) -> Run:
            tableau, backend = setting.variant.split(", ")

            def run() -> Outcome:
                solution = srm.simulate(
                    mechanism,
                    problem.t_end,
                    rtol=setting.value,
                    tableau=tableau,
                    backend=backend,
                )
                if not solution.success:
                    raise RunFailedError(solution.message)
                q, v = solution(times)

                def drift() -> float:
                    return float(solution.at(times).drift[:, 0].max())

                def energy() -> Array:
                    whole = solution.at(np.concatenate([[0.0], times]))
                    torque = problem.tree.torque
                    # What a motor puts in is no change of energy to be counted as an error.
                    return whole.energy if torque is None else whole.energy - whole.q @ torque

                stats = solution.stats
                return Outcome(
                    stats.evaluations,
                    stats.steps,
                    observed=lambda: problem.observe(q, v),
                    own_drift=drift,
                    own_energy=energy,
                )

            return run

        return at
