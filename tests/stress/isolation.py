"""Work in a child process that may crash or hang; the culprit is found by bisection."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SECONDS_PER_PATH, SECONDS_TO_START = 2.0, 60.0
BATCH = 125
"""Largest number of paths in one process."""


def load_isolated(paths: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Outcome (``load_batch.outcome``) by path; ``died`` for those that take the process along."""
    results: dict[str, dict[str, Any]] = {}
    for start in range(0, len(paths), BATCH):
        results |= _load_batch(paths[start : start + BATCH])
    return results


def fault_of(got: dict[str, Any]) -> str | None:
    """What is wrong with an outcome whatever the input: a crash, or a message that is not ours."""
    if got["is"] == "loaded":
        return None
    message = str(got["message"])
    if got["is"] != "refused":
        return message
    if "Traceback" in message or "pydantic" in message.lower():
        return f"not in our words: {message}"
    return None if got["file"] else f"the message names no file: {message}"


def _load_batch(paths: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The outcomes of one process; a batch whose process dies, hangs or writes anything to standard
    error is halved until single paths are left."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.stress.load_batch"],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    hung = False
    try:
        out, err = process.communicate(
            "\n".join(paths), timeout=SECONDS_TO_START + SECONDS_PER_PATH * len(paths)
        )
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
        hung = True
    healthy = process.returncode == 0 and not err and not hung
    if healthy:
        results = [json.loads(line) for line in out.splitlines()]
        return {result["path"]: result for result in results}
    if len(paths) == 1:
        end = "it hangs" if hung else f"exit status {process.returncode}"
        return {paths[0]: {"is": "died", "message": f"{end}; standard error: {err[-2000:]!r}"}}
    half = len(paths) // 2
    halves = {**_load_batch(paths[:half]), **_load_batch(paths[half:])}
    if not any(result["is"] == "died" for result in halves.values()):
        halves[paths[-1]] = {"is": "died", "message": f"only the whole batch does: {err[-2000:]!r}"}
    return halves
