"""The command line of the benchmark."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import srm_mbs as srm
from benchmarks.work_precision import machine, plots, records, tables, timing
from benchmarks.work_precision.harness import LIMIT, measure_problem
from benchmarks.work_precision.peers import PEERS
from benchmarks.work_precision.problems import PROBLEMS
from benchmarks.work_precision.reliability import measure_reliability
from benchmarks.work_precision.scaling import measure_scaling
from benchmarks.work_precision.skip import measure_unneeded
from srm_mbs.integration.kernel.backend import check_kernel

SECTIONS = ("work", "reliability", "unneeded", "scaling")
FILE = "results.json"


def parser() -> argparse.ArgumentParser:
    """What the command takes."""
    out = argparse.ArgumentParser(
        prog="python -m benchmarks.work_precision",
        add_help=False,
        description="Compare run time and error with other simulators, on one thread.",
        epilog="Everything takes about two hours. Peers that are not installed are skipped: "
        "pip install mujoco exudyn scikit-sundae scipy-dae heyoka. Results that DIR already "
        "holds are kept, but for what is measured again.",
    )
    out.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="Folder of the results."
    )
    out.add_argument(
        "--problems",
        nargs="+",
        choices=PROBLEMS,
        default=list(PROBLEMS),
        metavar="NAME",
        help=f"Mechanisms and states.  [default: {', '.join(PROBLEMS)}]",
    )
    out.add_argument(
        "--peers",
        nargs="+",
        choices=PEERS,
        default=list(PEERS),
        metavar="NAME",
        help=f"Simulators.  [default: {', '.join(PEERS)}]",
    )
    out.add_argument(
        "--sections",
        nargs="+",
        choices=SECTIONS,
        default=list(SECTIONS),
        metavar="NAME",
        help=f"Parts of the benchmark.  [default: {', '.join(SECTIONS)}]",
    )
    out.add_argument(
        "--repeats",
        type=int,
        default=timing.REPEATS,
        metavar="N",
        help=f"Timed calls per setting, {timing.REPEATS} or more.  [default: %(default)s]",
    )
    out.add_argument(
        "--limit",
        type=float,
        default=LIMIT,
        metavar="S",
        help="CPU time (s) that ends a series.  [default: %(default)g]",
    )
    out.add_argument(
        "--backend",
        choices=("generated", "kernel", "python"),
        default="generated",
        help="Backend of srm_mbs's defaults: the compiled kernel with code that is compiled before "
        "the measurement, as users have it after a while; the kernel without it; or the Python "
        "reference.  [default: %(default)s, without a C compiler kernel]",
    )
    out.add_argument("--thin", action="store_true", help="Take every third setting: a quick look.")
    out.add_argument("-h", "--help", action="help", help="Show this message and exit.")
    return out


def main(arguments: Sequence[str]) -> int:
    """Measure, write results.json, plots and tables; the exit status."""
    chosen = parser().parse_args(arguments)
    if chosen.repeats < timing.REPEATS and not chosen.thin:
        parser().error(f"at least {timing.REPEATS} repeats (fewer only with --thin)")
    if chosen.backend != "python":
        try:
            check_kernel()
        except srm.InputError as error:
            print(
                f"error: {error}. To measure the Python reference in its place, add "
                "--backend python",
                file=sys.stderr,
            )
            return 2
    chosen.out.mkdir(parents=True, exist_ok=True)
    os.environ["SRM_MBS_BACKEND"] = chosen.backend
    path = chosen.out / FILE
    _begun(path, chosen).save(path)
    if "work" in chosen.sections:
        for number, name in enumerate(chosen.problems, 1):
            _say(f"[{number}/{len(chosen.problems)}]")
            _apart(_work, argparse.Namespace(**vars(chosen) | {"problems": [name]}))
    if set(chosen.sections) != {"work"}:
        _apart(_other_sections, chosen)
    written = [path, *plots.draw(records.load(path), chosen.out)]
    written.append(tables.write(records.load(path), chosen.out))
    for each in written:
        _say(f"written: {each}")
    return 0


def _say(text: str) -> None:
    print(text, flush=True)


def _apart(measure: Callable[[argparse.Namespace], None], chosen: argparse.Namespace) -> None:
    """``measure(chosen)`` in a process of its own, from an empty cache of compiled code.

    So the time of compilation is measured as well, of every problem: compiled code and that of
    other simulators serve all mechanisms of one process that share it.

    Raises
    ------
    SystemExit
        If the process fails; what other processes measured is kept.
    """
    with tempfile.TemporaryDirectory() as cache:
        os.environ["SRM_MBS_CACHE"] = cache
        process = multiprocessing.get_context("spawn").Process(target=measure, args=(chosen,))
        process.start()
        process.join()
    if process.exitcode:
        sys.exit(f"error: the measurement ended with exit status {process.exitcode}")


def _begun(path: Path, chosen: argparse.Namespace) -> records.Results:
    """The results in the file that the sections of ``chosen`` do not measure again."""
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
    if path.exists():
        try:
            return records.continued(path, results, chosen.sections, chosen.problems, chosen.peers)
        except ValueError as error:
            parser().error(f"{error}: choose another --out")
    return results


def _work(chosen: argparse.Namespace) -> None:
    """The section "work" of the one problem of ``chosen``, added to the file."""
    path = chosen.out / FILE
    results = records.load(path)
    measure_problem(
        PROBLEMS[chosen.problems[0]](),
        [PEERS[name] for name in chosen.peers],
        results,
        repeats=chosen.repeats,
        limit=chosen.limit,
        choose=(lambda settings: settings[::3]) if chosen.thin else (lambda x: x),
        say=_say,
        save=lambda: results.save(path),
    )
    results.save(path)


def _other_sections(chosen: argparse.Namespace) -> None:
    """The sections of ``chosen`` but "work", added to the file."""
    path = chosen.out / FILE
    results = records.load(path)
    if "reliability" in chosen.sections:
        peers = [PEERS[name] for name in chosen.peers]
        measure_reliability(peers, results, thin=chosen.thin, say=_say)
        results.save(path)
    if "unneeded" in chosen.sections:
        measure_unneeded(results, repeats=chosen.repeats, thin=chosen.thin, say=_say)
        results.save(path)
    if "scaling" in chosen.sections:
        measure_scaling(results, repeats=chosen.repeats, thin=chosen.thin, say=_say)
        results.save(path)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
