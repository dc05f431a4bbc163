"""Runs per second of a sweep against the number of workers.

    python -m benchmarks.sweep_throughput [--seconds 2] [--repeats 3] [--workers 1 2] [--json FILE]
    python -m benchmarks.sweep_throughput --short 10000 [--repeats 3] [--workers 2] [--json FILE]
    python -m benchmarks.sweep_throughput --variants 500 [--backend generated] [--repeats 3]
        [--workers 2] [--json FILE]

Run from a checkout; BLAS runs on one thread.  Initial speeds of a four-bar are swept, with short
runs and long ones; with `--short` those of the slider-crank, with runs of 1 s; or, with
`--variants`, the crank of Klann's walker: each case makes a variant of the mechanism, simulates
2 s, and measures the reactions of all its joints.  Every executor has to give the rows of the
serial sweep, to the last bit.  Of variants, Dask with processes is among them, with the settings of
docs/sweeps.md under which it watches itself less: by default its scheduler, in this process, and
its workers take a tenth of two cores, busy or idle.  It comes after the others, beside which it
does not run, in turn with serial sweeps of its own.  Workers have been started, and have run,
before the clock is.  The repeats go through all executors in turn.  Runs per second are those of
the best repeat of each; ratios are medians over the repeats, of the wall times within one, because
the speed of the processor changes between them.  `--seconds` is about what one takes serially.  CPU
time over wall time, of this process, says on a busy machine whether threads run beside each other.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import tomllib
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tomli_w

import srm_mbs as srm
from srm_mbs.formats.load import models_folder

LENGTHS = (1.0, 10.0, 60.0)
"""Ends of the runs, s."""
WARM_UP = 64
"""Cases of the sweep with which workers start."""
VARIANT_END = 2.0
"""End of the runs of variants, s."""
CRANKS = (0.262, 0.274)
"""Least and largest crank (m) of the variants of Klann's walker, whose own is 0.268."""
WATCHING_LESS = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.worker.memory.monitor-interval": "2s",
}
"""Settings of Dask, for a scheduler that shares the cores with the workers: docs/sweeps.md."""


@dataclass(frozen=True)
class Row:
    """Throughput of one executor.

    ``runs_per_second`` is that of the best repeat; ``of_serial`` the median of the wall times of
    the serial sweep over its own, ``busy`` the median of CPU time over wall time of this process;
    of worker processes that is not known.
    """

    t_end: float
    executor: str
    workers: int
    chunk: int | None
    cases: int
    runs_per_second: float
    of_serial: float
    busy: float | None


def cases(mechanism: srm.Mechanism, count: int) -> dict[str, Any]:
    """``count`` initial states, the same positions at different speeds."""
    return {
        "q0": np.tile(mechanism.q0, (count, 1)),
        "v0": np.outer(np.linspace(0.5, 1.5, count), mechanism.v0),
    }


def klann() -> srm.Mechanism:
    """Klann's walker with the length of its crank as a parameter."""
    tables = tomllib.loads((models_folder() / "klann_walker.toml").read_text(encoding="utf-8"))
    points = tables["planar"]["points"]
    x, y = points["O"]
    tables["parameters"] = {"crank": x - points["A"][0]}
    points |= {"A": [f"={x!r} - crank", y], "A_r": [f"={x!r} + crank", y]}
    with TemporaryDirectory() as folder:
        path = Path(folder, "klann.toml")
        path.write_text(tomli_w.dumps(tables), encoding="utf-8")
        return srm.load(path)


def largest_reactions(solution: srm.Solution) -> dict[str, float]:
    """The largest force (N) in each joint."""
    return {
        name: float(np.linalg.norm(wrench[:, :3], axis=1).max())
        for name, wrench in solution.joint_reactions.items()
    }


def same(sweep: srm.Sweep, reference: srm.Sweep) -> bool:
    """Whether two tables are equal but for the time that the runs took."""
    return not sweep.failures and all(
        np.array_equal(column, reference.table[name])
        for name, column in sweep.table.items()
        if name != "wall_time"
    )


Measured = tuple[str, int, int | None, Executor | None]
"""Name, workers, chunk (None: adaptive) and executor of a row."""
SERIAL: Measured = ("serial", 1, 1, None)


def executors(stack: ExitStack, workers: list[int]) -> list[Measured]:
    """The rows of sweeps over starts."""
    out: list[Measured] = [SERIAL]
    for count in workers:
        threads = stack.enter_context(ThreadPoolExecutor(count))
        out.append(("threads", count, None, threads))
    for count in workers:
        processes = stack.enter_context(ProcessPoolExecutor(count, mp_context=get_context("spawn")))
        out += [("processes", count, chunk, processes) for chunk in (None, 1)]
    return out


def timed(run: Callable[[], srm.Sweep]) -> tuple[float, float, srm.Sweep]:
    """Wall time, CPU time of this process (s), and the sweep."""
    start, cpu = time.perf_counter(), time.process_time()
    sweep = run()
    return time.perf_counter() - start, time.process_time() - cpu, sweep


def with_dask(stack: ExitStack, workers: int) -> Executor:
    """Worker processes of Dask, of one thread each."""
    import dask
    from distributed import Client, LocalCluster

    stack.enter_context(dask.config.set(WATCHING_LESS))
    cluster = stack.enter_context(
        LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None
        )
    )
    return stack.enter_context(Client(cluster)).get_executor()


def measure_variants(count: int, repeats: int, workers: list[int], backend: str) -> list[Row]:
    """Throughput of ``count`` variants of Klann's walker, computed by ``backend``."""
    mechanism = klann()
    cranks = np.linspace(*CRANKS, count)

    def run(executor: Executor | None, chunk: int | None, values: Any = cranks) -> srm.Sweep:
        return srm.sweep(
            mechanism,
            None,
            VARIANT_END,
            parameters={"crank": values},
            measure=largest_reactions,
            backend=backend,
            executor=executor,
            chunk=chunk,
        )

    reference = run(None, 1)

    def measured(rows: list[Measured]) -> list[Row]:
        for *_, chunk, executor in rows:
            run(executor, chunk, cranks[:WARM_UP])
        return compared(rows, VARIANT_END, count, repeats, reference, run)

    with ExitStack() as stack:
        rows: list[Measured] = [SERIAL]
        for number in workers:
            threads = stack.enter_context(ThreadPoolExecutor(number))
            processes = ProcessPoolExecutor(number, mp_context=get_context("spawn"))
            rows += [
                ("threads", number, None, threads),
                ("processes", number, None, stack.enter_context(processes)),
            ]
        found = measured(rows)
    for number in workers:
        with ExitStack() as stack:
            found += measured([SERIAL, ("dask", number, None, with_dask(stack, number))])
    return found


def compared(
    rows: list[Measured],
    t_end: float,
    count: int,
    repeats: int,
    reference: srm.Sweep,
    run: Callable[[Executor | None, int | None], srm.Sweep],
) -> list[Row]:
    """Throughput of each executor, of which the first is the serial sweep, over ``repeats`` that go
    through all of them in turn; all have to give the rows of the reference."""
    walls, busy = np.empty((repeats, len(rows))), np.empty((repeats, len(rows)))
    for again in range(repeats):
        for k, (name, _, chunk, executor) in enumerate(rows):
            took, cpu, sweep = timed(lambda e=executor, c=chunk: run(e, c))
            if not same(sweep, reference):
                raise SystemExit(f"{name}: the rows differ from those of the serial sweep")
            walls[again, k], busy[again, k] = took, cpu / took
    rates = count / walls.min(axis=0)
    of_serial = np.median(walls[:, :1] / walls, axis=0)
    return [
        Row(
            t_end,
            name,
            number,
            chunk,
            count,
            float(rates[k]),
            float(of_serial[k]),
            None if name in ("processes", "dask") else float(np.median(busy[:, k])),
        )
        for k, (name, number, chunk, _) in enumerate(rows)
    ]


def measure(
    t_end: float,
    seconds: float,
    repeats: int,
    workers: list[int],
    name: str = "four_bar",
    count: int | None = None,
) -> list[Row]:
    """Throughput of runs of a bundled mechanism; ``count`` of them, or as many as take ``seconds``
    serially."""
    mechanism = srm.load(name)
    with suppress(srm.InputError):  # without a compiler, the kernel makes all runs
        srm.compile(mechanism)  # otherwise code may arrive during a sweep

    def run(count: int, executor: Executor | None, chunk: int | None = None) -> srm.Sweep:
        return srm.sweep(
            mechanism, cases(mechanism, count), t_end, executor=executor, chunk=chunk, rtol=1e-8
        )

    run(4, None)
    took, *_ = timed(lambda: run(4, None))
    count = count or max(WARM_UP, int(4 * seconds / took))
    reference = run(count, None)
    with ExitStack() as stack:
        rows = executors(stack, workers)
        for *_, chunk, executor in rows:
            run(WARM_UP, executor, chunk)
        return compared(
            rows, t_end, count, repeats, reference, lambda e, chunk: run(count, e, chunk)
        )


def tables(arguments: argparse.Namespace) -> Iterator[list[Row]]:
    """The measurements that were asked for, one after the other."""
    repeats, workers = arguments.repeats, arguments.workers
    if arguments.variants:
        yield measure_variants(arguments.variants, repeats, workers, arguments.backend)
    elif arguments.short:
        yield measure(1.0, 0.0, repeats, workers, "slider_crank", arguments.short)
    else:
        for t_end in LENGTHS:
            yield measure(t_end, arguments.seconds, repeats, workers)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--short", type=int, help="runs of 1 s of the slider-crank")
    parser.add_argument("--variants", type=int)
    parser.add_argument("--backend", default="kernel", help="of the runs of variants")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    backend = arguments.backend if arguments.variants else srm.backend()
    print(f"{os.cpu_count()} cores, load {load}; backend {backend}\n")
    print("| run (s) | executor | workers | chunk | cases | runs/s | of serial | CPU / wall |")
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    for found in tables(arguments):
        for row in found:
            rows.append(row)
            busy = "" if row.busy is None else f"{row.busy:.2f}"
            chunk = "" if row.chunk is None else row.chunk
            print(
                f"| {row.t_end:g} | {row.executor} | {row.workers} | {chunk} | {row.cases} "
                f"| {row.runs_per_second:.1f} | {row.of_serial:.2f} | {busy} |",
                flush=True,
            )
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))


if __name__ == "__main__":
    main()
