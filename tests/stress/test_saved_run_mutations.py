"""Mutated saved runs: refused in our words, or read; never a crash."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.stress.isolation import ROOT
from tests.support.mechanisms import floating_ring

pytestmark = pytest.mark.stress

COUNT = 4_000
SECONDS = 1200.0
MOST_CRASHES = 5
MOST_REFUSED_LATE = 10
"""Runs that load and are refused when their dense output is read."""


def write_runs(folder: Path) -> None:
    """Small runs of every kind: both backends, formats 4 and 5, open and closed chains, drives,
    events, zones, segments, sampled controllers, Python models, redundant rows."""

    def event(t: float, q: Any, v: Any) -> float:
        return float(np.cos(20.0 * t))

    crank = srm.load("slider_crank")
    driven = replace(
        srm.load("slider_crank_regular"),
        drives=[srm.Drive(srm.Sine(amplitude=0.4, omega=9.0), joint="crank")],
    )
    start = srm.assemble(driven)
    runs = {
        "zone": srm.simulate(crank, 1.075, rtol=1e-12, max_step=5e-3),
        "python": srm.simulate(crank, 1.2, backend="python"),
        "events": srm.simulate(srm.load("four_bar"), 0.3, events=[event], t_eval=[0.0, 0.1]),
        "open": srm.simulate(srm.load("pendulum_chain"), 0.2),
        "ring": srm.simulate(floating_ring(), 0.1),
        "ring in python": srm.simulate(floating_ring(), 0.05, backend="python", tableau="dopr54"),
        "driven": srm.simulate(driven, 0.2, q0=start.q, v0=start.v),
        "sampled": srm.simulate(
            srm.load("four_bar"), 0.2, controller=lambda t, q, v: -v, sample_time=0.05
        ),
        "controlled": srm.simulate(srm.load("four_bar"), 0.2, controller=lambda t, q, v: -v),
        "redundant": srm.simulate(srm.load("parallelogram"), 0.3),
        "segments": srm.simulate(
            srm.load("four_bar"), 0.2, events=srm.Event(event, action=lambda t, q, v: None)
        ),
    }
    for name, run in runs.items():
        run.save(folder / f"{name}.npz")
    for path in (ROOT / "tests" / "data").glob("*_format_4.npz"):
        shutil.copy(path, folder)


def outcomes(folder: Path, first: int, last: int) -> list[dict[str, Any]]:
    """What became of the mutations of these numbers; ``died`` for those that take the process
    along, which is then started again."""
    found: list[dict[str, Any]] = []
    while first < last:
        numbers = (str(first), str(last))
        done = subprocess.run(
            [sys.executable, "-m", "tests.stress.saved_run_mutations", str(folder), *numbers],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=SECONDS,
            check=False,
        )
        lines = [json.loads(line) for line in done.stdout.splitlines()]
        found += [change | result for change, result in zip(lines[::2], lines[1::2])]
        if done.returncode == 0:
            break
        assert lines, done.stderr[-2000:]
        died = {"is": "died", "message": f"status {done.returncode}: {done.stderr[-500:]}"}
        if len(lines) % 2:
            found.append(lines[-1] | died)
        if sum(result["is"] == "died" for result in found) >= MOST_CRASHES:
            break
        first = found[-1]["number"] + 1
    return found


def test_mutated_saved_runs_are_refused_or_read_and_crash_nothing(tmp_path: Path) -> None:
    write_runs(tmp_path)

    found = outcomes(tmp_path, 0, COUNT)

    faults = [one for one in found if one["is"] not in ("refused", "read", "refused when read")]
    counts = Counter(one["is"] for one in found)
    print(dict(counts))  # noqa: T201 - shown by pytest -rP
    assert not faults, f"{len(faults)} of {counts}, as {faults[:10]}"
    assert len(found) == COUNT
    # Models that could be, and states so large that a sum with the rates is rounded to them:
    # only the equations of motion at every stage would tell.
    assert counts["refused when read"] <= MOST_REFUSED_LATE
    # Most changes are seen, and those of numbers that a run may have are read.
    assert counts["refused"] > 0.5 * COUNT
    assert counts["read"] > 0.1 * COUNT
    by_run = Counter(one["run"] for one in found if one["is"] == "read")
    assert len(by_run) == len(list(tmp_path.glob("*.npz")))
