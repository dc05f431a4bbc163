"""``python -m benchmarks.thesis --out DIR``: thesis.json and a PNG per table and figure."""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path


def main() -> None:
    """Parse, compute, write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.thesis", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for thesis.json and PNGs")
    parser.add_argument("--page", type=Path, help="also write the page that shows them")
    parser.add_argument("--thin", action="store_true", help="coarse grids, short runs")
    parser.add_argument("--workers", type=int, default=2, help="processes (2)")
    arguments = parser.parse_args()
    # Before numpy is imported, here and in the processes that inherit it: the matrices are tiny.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    from benchmarks.thesis.catalogue import regenerate
    from benchmarks.thesis.entries import write
    from benchmarks.thesis.page import write_page

    started = time.perf_counter()
    arguments.out.mkdir(parents=True, exist_ok=True)
    entries = regenerate(arguments.out, arguments.thin, arguments.workers)
    write(entries, arguments.out / "thesis.json")
    if arguments.page:
        write_page(entries, arguments.out, arguments.page)
    print(f"{len(entries)} tables and figures in {time.perf_counter() - started:.0f} s")


if __name__ == "__main__":
    main()
