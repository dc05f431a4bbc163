"""All tables and figures: what computes them, the longest first."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from benchmarks.thesis import figures_pendulum, figures_slider_crank, tables
from benchmarks.thesis.entries import KEYS, Entry

Group = Callable[[Path, bool], list[Entry]]
"""(folder for the PNGs, thinned) -> entries; draws their PNGs."""

GROUPS: tuple[Group, ...] = (
    figures_slider_crank.index_three,
    tables.table_five,
    tables.table_six,
    tables.table_three,
    tables.table_four,
    figures_slider_crank.index_two,
    tables.table_seven,
    tables.table_two,
    tables.table_one,
    figures_slider_crank.impasse,
    figures_pendulum.regularisation,
    figures_pendulum.stabilised,
    figures_slider_crank.adaptive,
    figures_pendulum.reduced,
)


def regenerate(out: Path, thin: bool = False, workers: int = 2) -> list[Entry]:
    """Every entry, in the order of :data:`~benchmarks.thesis.entries.KEYS`; PNGs go to ``out``.

    Parameters
    ----------
    out
        Existing folder.
    thin
        Coarser grids and shorter runs, for tests.
    workers
        Processes; with 1 everything runs in this one.
    """
    entries: list[Entry] = []
    if workers == 1:
        for group in GROUPS:
            entries += group(out, thin)
    else:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            for future in [pool.submit(group, out, thin) for group in GROUPS]:
                entries += future.result()
    return sorted(entries, key=lambda entry: KEYS.index(entry.key))
