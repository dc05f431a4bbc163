"""``python -m tests.stress.hostile_load``: loads the paths on standard input, each in a process of
its own with little memory, and prints what became of each as a line of JSON."""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import time
from pathlib import Path

import srm_mbs as srm
from srm_mbs.visualization.animation.shapes import visuals_of

MEGABYTES, SECONDS = 500, 60
"""Memory beside that of the imported package, and CPU time of a load that is broken off."""


def _limit() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    size = pages * resource.getpagesize() + MEGABYTES * 10**6
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    signal.alarm(2 * SECONDS)  # of one that waits


def _outcome(path: str) -> dict[str, object]:
    start = time.process_time()
    found: dict[str, object]
    try:
        mechanism = srm.load(path)
        found = {"is": "loaded", "message": "", "shapes": len(visuals_of(mechanism))}
    except srm.InputError as error:
        found = {"is": "refused", "message": str(error)}
    except BaseException as error:
        found = {"is": "leaked", "message": f"{type(error).__name__}: {error}"[:500]}
    return {"path": path, "seconds": time.process_time() - start, **found}


def main() -> None:
    visuals_of(srm.load("four_bar"))  # whatever is imported late
    for path in sys.stdin.read().splitlines():
        sys.stdout.flush()
        child = os.fork()
        if not child:
            _limit()
            sys.stdout.write(json.dumps(_outcome(path)) + "\n")
            sys.stdout.flush()
            os._exit(0)
        status = os.waitpid(child, 0)[1]
        if status:
            died = {"path": path, "is": "died", "message": f"status {status}"}
            sys.stdout.write(json.dumps(died) + "\n")


if __name__ == "__main__":
    main()
