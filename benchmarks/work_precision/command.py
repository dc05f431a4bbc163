"""The command line of the benchmark."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import srm_mbs as srm
from benchmarks.work_precision import machine, plots, records, tables, timing
from benchmarks.work_precision.harness import LIMIT, measure_problem
from benchmarks.work_precision.peers import PEERS
from benchmarks.work_precision.problems import PROBLEMS
from benchmarks.work_precision.reliability import measure_reliability
from benchmarks.work_precision.scaling import measure_scaling
from benchmarks.work_precision.skip import measure_unneeded

SECTIONS = ("work", "reliability", "unneeded", "scaling")
FILE = "results.json"


def parser() -> argparse.ArgumentParser:
    """What the command takes."""
    out = argparse.ArgumentParser(
        prog="python -m benchmarks.work_precision",
        description="Run time against error, beside other simulators, on one thread.",
        epilog="Everything takes about two hours. Peers that are not installed are skipped: "
        "pip install mujoco exudyn scikit-sundae scipy-dae.",
    )
    out.add_argument("--out", type=Path, required=True, metavar="DIR", help="where results go")
    out.add_argument(
        "--problems",
        nargs="+",
        choices=PROBLEMS,
        default=list(PROBLEMS),
        metavar="NAME",
        help=f"all by default: {', '.join(PROBLEMS)}",
    )
    out.add_argument(
        "--peers",
        nargs="+",
        choices=PEERS,
        default=list(PEERS),
        metavar="NAME",
        help=f"all by default: {', '.join(PEERS)}",
    )
    out.add_argument(
        "--sections",
        nargs="+",
        choices=SECTIONS,
        default=list(SECTIONS),
        metavar="NAME",
        help=f"all by default: {', '.join(SECTIONS)}",
    )
    out.add_argument(
        "--repeats", type=int, default=timing.REPEATS, help="timed calls per setting, 5 or more"
    )
    out.add_argument(
        "--limit", type=float, default=LIMIT, metavar="S", help="CPU time that ends a sweep"
    )
    out.add_argument("--thin", action="store_true", help="every third setting: a quick look")
    return out


def main(arguments: Sequence[str]) -> int:
    """Measure, write results.json, plots and tables; the exit status."""
    chosen = parser().parse_args(arguments)
    if chosen.repeats < timing.REPEATS and not chosen.thin:
        parser().error(f"at least {timing.REPEATS} repeats (fewer only with --thin)")
    chosen.out.mkdir(parents=True, exist_ok=True)
    path = chosen.out / FILE
    results = records.Results(
        machine.describe(),
        machine.versions(),
        {
            "repeats": chosen.repeats,
            "limit": chosen.limit,
            "thin": chosen.thin,
            "backend": srm.backend(),
        },
    )
    peers = [PEERS[name] for name in chosen.peers]

    def say(text: str) -> None:
        print(text, flush=True)

    def save() -> None:
        results.save(path)

    if "work" in chosen.sections:
        for number, name in enumerate(chosen.problems, 1):
            say(f"[{number}/{len(chosen.problems)}]")
            measure_problem(
                PROBLEMS[name](),
                peers,
                results,
                repeats=chosen.repeats,
                limit=chosen.limit,
                choose=(lambda settings: settings[::3]) if chosen.thin else (lambda x: x),
                say=say,
                save=save,
            )
    if "reliability" in chosen.sections:
        measure_reliability(peers, results, thin=chosen.thin, say=say)
        save()
    if "unneeded" in chosen.sections:
        measure_unneeded(results, repeats=chosen.repeats, thin=chosen.thin, say=say)
        save()
    if "scaling" in chosen.sections:
        measure_scaling(results, repeats=chosen.repeats, thin=chosen.thin, say=say)
        save()
    save()
    written = [path, *plots.draw(records.load(path), chosen.out)]
    written.append(tables.write(records.load(path), chosen.out))
    for each in written:
        say(f"written: {each}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
