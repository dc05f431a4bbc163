"""Models in Pinocchio's own archives, which saved runs of format 4 hold, read in another process.

An archive holds the memory of a model, indices included: reading one that was changed reads and
writes out of bounds.  A process of its own, with limits of memory and time, reads it and compares
its indices with those of the model that its data describe; only the data come back.

This file is also the program of that process, which is started by its path.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

LARGEST_TEXT = 64 * 10**6
"""Characters of an archive."""
LONGEST_WAIT = 60.0
"""Seconds after which the process is ended."""
PROCESSOR_TIME = 30
"""Seconds of processor time of the process."""
MEMORY = 4 * 10**9
"""Bytes of address space of the process, libraries included."""
INDEX_VECTORS = ("parents", "nqs", "nvs", "idx_qs", "idx_vs")
"""Indices of a model by joint, which follow from its joints."""


def model_from_archive(text: str) -> Any:
    """The model (``pinocchio.Model``) in ``text``, which ``saveToString`` of Pinocchio wrote.

    Raises
    ------
    InputError
        If it holds none: the process that reads it dies, takes too long, or finds indices that are
        not those of the model.
    """
    from srm_mbs.errors import InputError
    from srm_mbs.model.model_data import model_from_data

    def refused(why: str) -> InputError:
        return InputError(
            f"the archive of its model is damaged: {why}",
            element="model",
            remedy="Save the run again",
        )

    if not isinstance(text, str) or len(text) > LARGEST_TEXT:
        raise refused("it is too long, or no text")
    root, working = str(Path(__file__).resolve().parents[2]), os.getcwd()
    further = [path for path in sys.path if os.path.isabs(path) and path != working]
    request = json.dumps({"text": text, "paths": [root, *further]})
    try:
        done = subprocess.run(
            [sys.executable, "-I", str(Path(__file__).resolve())],
            input=request.encode(),
            capture_output=True,
            timeout=LONGEST_WAIT,
            check=False,
            # One thread: more need more memory, and libraries start theirs on import.
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
    except subprocess.TimeoutExpired as error:
        raise refused(f"reading it takes more than {LONGEST_WAIT:g} s") from error
    try:
        answer = json.loads(done.stdout) if done.returncode == 0 else {}
    except (ValueError, RecursionError) as error:
        raise refused("it cannot be read") from error
    if not isinstance(answer, dict) or "model" not in answer:
        why = answer.get("fault") if isinstance(answer, dict) else None
        raise refused(str(why)[:200] if why else f"reading it ends with status {done.returncode}")
    return model_from_data(answer["model"])


def _limit() -> None:
    """Limits of this process, where the platform has them."""
    try:
        import resource
    except ImportError:  # Windows
        return
    limits = {"RLIMIT_AS": MEMORY, "RLIMIT_CPU": PROCESSOR_TIME, "RLIMIT_CORE": 0}
    for name, value in (limits | {"RLIMIT_FSIZE": 0, "RLIMIT_NPROC": 0}).items():
        which = getattr(resource, name, None)
        try:
            if which is not None:
                resource.setrlimit(which, (value, value))
        except (OSError, ValueError):  # already lower, or not there (macOS: RLIMIT_AS)
            continue


def _answer(text: str) -> dict[str, Any]:
    """The data of the model in ``text``, or what is wrong with it."""
    import pinocchio as pin

    from srm_mbs.model.model_data import model_from_data, model_to_data

    model = pin.Model()
    try:
        model.loadFromString(text)
        counts = [len(getattr(model, name)) for name in (*INDEX_VECTORS, "joints", "names")]
        if {*counts, len(model.inertias), len(model.jointPlacements)} != {model.njoints}:
            return {"fault": "its vectors are not those of its joints"}
        found = model_to_data(model)
        again = model_from_data(json.loads(json.dumps(found)))
    except Exception as error:
        return {"fault": getattr(error, "problem", None) or str(error)}
    for name in ("nq", "nv", "njoints", "nframes"):
        if getattr(model, name) != getattr(again, name):
            return {"fault": f"{name} is not that of its joints"}
    for name in INDEX_VECTORS:
        if [int(i) for i in getattr(model, name)] != [int(i) for i in getattr(again, name)]:
            return {"fault": f"{name} are not those of its joints"}
    for ours, theirs in zip(model.joints, again.joints):
        own = ("id", "idx_q", "idx_v", "nq", "nv")
        if [getattr(ours, name) for name in own] != [getattr(theirs, name) for name in own]:
            return {"fault": "the indices of a joint are not its own"}
    return {"model": found}


def main() -> None:
    """Read a request on standard input, and print the answer."""
    request = json.load(sys.stdin)
    sys.path[:0] = request["paths"][:1]
    sys.path += [path for path in request["paths"][1:] if path not in sys.path]
    import pinocchio  # noqa: F401 - its libraries before the limits

    import srm_mbs.model.model_data  # noqa: F401

    _limit()
    json.dump(_answer(request["text"]), sys.stdout)


if __name__ == "__main__":
    main()
