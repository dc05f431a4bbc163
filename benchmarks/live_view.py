"""What watching a run while it is computed costs: ``srm.LiveView`` beside the same run alone.

    python -m benchmarks.live_view [--models NAME ...] [--seconds 1.0] [--repeats 5] [--page]

Run from a checkout; BLAS runs on one thread.  Each run is made long enough to take ``--seconds``,
alone and watched by turns; the least CPU times of the process count, and beside them the part of
the wall time that the view spent, which includes waiting for its server.  With ``--page`` a
headless Chromium shows the page meanwhile, on the same machine.
"""

from __future__ import annotations

import argparse
import time
from contextlib import ExitStack
from typing import Any

import srm_mbs as srm

MODELS = ("slider_crank", "four_bar", "stewart_platform", "jansen_walker")


def cpu(mechanism: srm.Mechanism, t_end: float, progress: Any = False) -> tuple[float, float]:
    """CPU and wall time (s) of a run."""
    wall, process = time.perf_counter(), time.process_time()
    srm.simulate(mechanism, t_end, progress=progress)
    return time.process_time() - process, time.perf_counter() - wall


def long_enough(mechanism: srm.Mechanism, seconds: float) -> float:
    """How far (s) the mechanism is simulated in ``seconds`` of computing."""
    t_end = 1.0
    taken, _ = cpu(mechanism, t_end)
    while taken < 0.2 * seconds:
        t_end *= 4.0
        taken, _ = cpu(mechanism, t_end)
    return t_end * seconds / taken


def measured(name: str, seconds: float, repeats: int, page: bool) -> str:
    """A row of the table."""
    mechanism = srm.load(name)
    t_end = long_enough(mechanism, seconds)
    alone, watched, spent, shown = [], [], [], []
    with ExitStack() as stack:
        chromium = None
        if page:
            from srm_mbs.visualization.animation.video import browser

            chromium = stack.enter_context(browser())
        for _ in range(repeats):
            alone.append(cpu(mechanism, t_end)[0])
            with srm.LiveView(mechanism, open_browser=False) as view:
                if chromium is not None:
                    seen = chromium.new_page()
                    seen.goto(view.visualizer.url())
                    seen.wait_for_function("viewer.scene_tree.children.mechanism !== undefined")
                process, wall = cpu(mechanism, t_end, view)
                if chromium is not None:
                    seen.close()
            watched.append(process)
            spent.append(view.spent / wall)
            shown.append(view.shown / wall)
    more = min(watched) / min(alone) - 1.0
    return (
        f"{name:20s} {t_end:8.1f} {min(alone):8.2f} {min(watched):8.2f} {100 * more:7.1f} "
        f"{100 * max(spent):8.1f} {sorted(shown)[repeats // 2]:8.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", nargs="+", default=list(MODELS))
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--page", action="store_true")
    options = parser.parse_args()
    columns = ("run, s", "alone, s", "watched", "more, %", "spent, %", "states/s")
    print(f"{'model':20s} {' '.join(f'{column:>8s}' for column in columns)}")
    for name in options.models:
        print(measured(name, options.seconds, options.repeats, options.page), flush=True)


if __name__ == "__main__":
    main()
