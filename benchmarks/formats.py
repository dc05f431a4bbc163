"""Which model files load: every URDF, SDF and MJCF file below a folder.

    python -m benchmarks.formats --dir DIR [--seconds 30] [--verbose]

Each file is loaded in a process of its own.  Files that others include (``<mujocoinclude>``) are
not tried.  Prints a table by package, the folder below DIR, and the reasons of refusals; with
``--verbose`` the outcome of each file as well.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

LOAD = """
import sys
import srm_mbs as srm
try:
    srm.load(sys.argv[1], allow_outside=True)
except srm.InputError as error:
    print(f"{error.element}|{error.problem}")
    sys.exit(3)
"""
REFUSED = 3
KINDS = ("loaded", "refused", "no mechanism", "slow", "fault")
NO_MECHANISM = ("nothing in this mechanism can move", "there is no <body>", "unknown element <")
"""Beginnings of refusals of objects, scenes and fragments that others include."""
SUFFIXES = (".xml", ".mjcf", ".urdf", ".sdf", ".world")
ROOTS = {"robot": "URDF", "sdf": "SDF", "mujoco": "MJCF"}
ROOT_TAG = re.compile(rb"<([A-Za-z_][\w.:-]*)")
COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)


@dataclass(frozen=True)
class Outcome:
    """What loading a file came to.

    Attributes
    ----------
    path, format
        Of the file.
    kind
        One of :data:`KINDS`; ``no mechanism``: an object, a scene or a fragment, which others
        include; ``fault``: a traceback or a signal.
    reason
        Of a refusal or a fault.
    seconds
        Wall time, the start of Python included.
    """

    path: Path
    format: str
    kind: str
    reason: str
    seconds: float


def model_files(folder: Path) -> list[tuple[Path, str]]:
    """Model files below ``folder``, and their formats by the root element."""
    found = []
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in SUFFIXES and path.is_file():
            tag = ROOT_TAG.search(COMMENT.sub(b"", path.read_bytes()))
            name = tag[1].decode().rsplit(":", 1)[-1] if tag else ""
            if name in ROOTS:
                found.append((path, ROOTS[name]))
    return found


def attempt(path: Path, form: str, limit: float) -> Outcome:
    """Load one file, for at most ``limit`` seconds."""
    started = time.perf_counter()
    try:
        done = subprocess.run(
            [sys.executable, "-c", LOAD, str(path)],
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Outcome(path, form, "slow", f"longer than {limit:g} s", limit)
    seconds = time.perf_counter() - started
    if done.returncode == 0:
        return Outcome(path, form, "loaded", "", seconds)
    if done.returncode == REFUSED:
        reason = done.stdout.strip()
        element, _, problem = reason.partition("|")
        part = problem.startswith(NO_MECHANISM[:2]) or (
            element == "<mujoco>" and problem.startswith(NO_MECHANISM[2])
        )
        return Outcome(path, form, "no mechanism" if part else "refused", reason, seconds)
    lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    return Outcome(path, form, "fault", lines[-1], seconds)


def table(folder: Path, outcomes: list[Outcome]) -> str:
    """Outcomes by package, in Markdown."""
    rows = Counter((o.path.relative_to(folder).parts[0], o.format, o.kind) for o in outcomes)
    places = sorted({(package, form) for package, form, _ in rows})
    lines = [f"| package | format | files | {' | '.join(KINDS)} |", "|---" * 8 + "|"]
    for place in places:
        kinds = [rows[(*place, kind)] for kind in KINDS]
        lines.append(f"| {' | '.join([*place, str(sum(kinds)), *map(str, kinds)])} |")
    return "\n".join(lines)


def reasons(outcomes: list[Outcome]) -> str:
    """Reasons of refusals and faults, most frequent first, names and numbers left out."""
    known: Counter[str] = Counter()
    for outcome in outcomes:
        if outcome.kind != "loaded":
            problem = outcome.reason.partition("|")[2] or outcome.reason
            known[re.sub(r"'[^']*'|[-+]?\d[\d.e+-]*", "_", problem)] += 1
    return "\n".join(f"{count:5d}  {reason}" for reason, count in known.most_common())


def main() -> None:
    parser = argparse.ArgumentParser(description="Which model files load")
    parser.add_argument("--dir", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=30.0, help="limit of a file")
    parser.add_argument("--verbose", action="store_true", help="print each file")
    arguments = parser.parse_args()
    files = model_files(arguments.dir)
    outcomes = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for outcome in pool.map(lambda file: attempt(*file, arguments.seconds), files):
            outcomes.append(outcome)
            if arguments.verbose:
                place = outcome.path.relative_to(arguments.dir)
                line = f"{outcome.kind:8} {outcome.seconds:6.1f} s  {place}  {outcome.reason}"
                print(line, flush=True)
    print(table(arguments.dir, outcomes))
    print(reasons(outcomes))


if __name__ == "__main__":
    main()
