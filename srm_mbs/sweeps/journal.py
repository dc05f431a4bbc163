"""The journal of a sweep that can be resumed: a file with one JSON line per finished case.

The first line identifies the sweep by fingerprints of everything that determines the results.  A
case is identified by the fingerprint of its parameters, and equal cases are numbered, so that cases
may be added, removed or reordered when the sweep is resumed.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from srm_mbs.errors import InputError, __version__
from srm_mbs.sweeps.cases import Case
from srm_mbs.sweeps.fingerprint import fingerprint
from srm_mbs.sweeps.tasks import Outcome, Task

FORMAT = 1
"""Version of the file format."""


class Journal:
    """Finished cases of a sweep, read from and appended to a file.

    Parameters
    ----------
    path
        Path of the file, which is created if it does not exist.
    task, cases
        Of the sweep.

    Attributes
    ----------
    known
        Index of a case -> outcome, for the cases in the file.

    Raises
    ------
    InputError
        If the file belongs to another sweep, is damaged before its last line, or cannot be written.
    """

    def __init__(self, path: Path, task: Task, cases: Sequence[Case]) -> None:
        self._path = path
        self._keys = _keys(cases)
        self.known: dict[int, Outcome] = {}
        # Fingerprints of everything that determines the results.
        parts = {
            "mechanism": task.source,
            "t_end": task.t_end,
            "measure": task.measure,
            "options": [task.options, task.simulate_options],
        }
        sweep = {name: _checked_fingerprint(value, name) for name, value in parts.items()}
        head = {"format": FORMAT, "version": __version__, "sweep": sweep}
        try:
            whole = self._read(head) if path.exists() else 0
            self._file = path.open("r+" if whole else "w", encoding="utf-8")
            # The last line is incomplete if the process was killed.
            self._file.seek(whole)
            self._file.truncate()
            if not whole:
                self._write(head)
        except OSError as error:
            raise InputError(
                f"it cannot be used: {error.strerror}",
                file=str(path),
                element="resume",
                remedy="Give a file in a folder that can be written",
            ) from error

    def _read(self, head: Mapping[str, Any]) -> int:
        """Read the known outcomes; returns the length (bytes) of the complete lines.

        Refuses the file of another sweep or format.
        """
        data = self._path.read_bytes()
        whole = data.rfind(b"\n") + 1
        lines = data[:whole].splitlines()
        if not lines:
            if data and not json.dumps(head).encode().startswith(data):
                raise self._fault("it is not a file of a sweep")
            return 0
        index = {key: k for k, key in enumerate(self._keys)}
        for number, line in enumerate(lines, 1):
            try:
                entry = json.loads(line)
                if number == 1:
                    found = entry
                    continue
                key, outcome = entry["case"], Outcome(**entry["outcome"])
                if key in index:
                    self.known.setdefault(index[key], outcome)
            except (ValueError, KeyError, TypeError) as error:
                raise self._fault(f"line {number} is damaged") from error
        if not isinstance(found, dict) or found.get("format") != FORMAT:
            raise self._fault("it is not a file of a sweep, or is of another format")
        own, other = head["sweep"], found.get("sweep", {})
        different = [name for name in own if other.get(name) != own[name]]
        if found.get("version") != head["version"]:
            different.append(f"version of srm_mbs ({found.get('version')})")
        if different:
            raise self._fault(f"it belongs to a sweep that differs in {', '.join(different)}")
        return whole

    def _fault(self, problem: str) -> InputError:
        return InputError(
            problem,
            file=str(self._path),
            element="resume",
            remedy="Give another file, or remove this one to begin anew",
        )

    def add(self, case: Case, outcome: Outcome) -> None:
        """Write the outcome of a case, unless it raised: such cases are repeated."""
        if outcome.traceback:
            return
        kept = {key: value for key, value in asdict(outcome).items() if key != "traceback"}
        self._write({"case": self._keys[case.index], "outcome": kept})

    def _write(self, entry: Mapping[str, Any]) -> None:
        self._file.write(json.dumps(entry) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _checked_fingerprint(value: Any, what: str) -> str:
    try:
        return fingerprint(value)
    except Exception as error:  # objects may raise anything when they are pickled
        raise InputError(
            f"what it holds cannot be compared with a later sweep: {error}",
            element=what,
            remedy="Leave resume= out, or give functions and values that can be pickled",
        ) from error


def _keys(cases: Sequence[Case]) -> list[str]:
    seen: Counter[str] = Counter()
    out = []
    for case in cases:
        key = _checked_fingerprint(case.parameters, case.where)
        seen[key] += 1
        out.append(key if seen[key] == 1 else f"{key}-{seen[key]}")
    return out
