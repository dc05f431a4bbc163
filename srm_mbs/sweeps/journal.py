"""The journal of a sweep that can be resumed: a file with one JSON line per finished case.

The first line identifies the sweep by fingerprints of everything that determines the results.  A
case is identified by the fingerprint of its parameters, and equal cases are numbered, so that cases
may be added, removed or reordered when the sweep is resumed.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, cast

from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError, __version__, printable
from srm_mbs.formats.files import checked_path, read_bytes
from srm_mbs.model.mechanism import variant_maker
from srm_mbs.sweeps.cases import Case, varied
from srm_mbs.sweeps.fingerprint import fingerprint
from srm_mbs.sweeps.tasks import Outcome, Task

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

FORMAT = 1
"""Version of the file format."""
LARGEST_JOURNAL = 4 * 10**9
"""Bytes of a journal that is read: some million cases."""


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
        If the file belongs to another sweep, is damaged before its last line, is written by
        another sweep at the same time, or cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], task: Task, cases: Sequence[Case]) -> None:
        self._path = path = checked_path(path, "resume")
        self._keys = _keys(cases)
        self.known: dict[int, Outcome] = {}
        # Fingerprints of everything that determines the results.
        parts: dict[str, Any] = {
            "mechanism": task.source,
            "t_end": task.t_end,
            "measure": task.measure,
            "options": [task.options, task.simulate_options],
        }
        names = varied(task.source)
        if any(name in case.parameters for case in cases for name in names):
            variants = variant_maker(cast(Mechanism, task.source))
            parts["parameters"] = None if variants is None else variants.definition
        sweep = {name: _checked_fingerprint(value, name) for name, value in parts.items()}
        head = {"format": FORMAT, "version": __version__, "sweep": sweep}
        try:
            if path.exists():
                self._read(head)  # refuses devices and pipes, which opening would wait for
            # Unbuffered, so that a line is written at once or refused at once.
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            raise self._open_error(error) from error
        try:
            self._lock()
            whole = self._read(head)  # nobody else writes from here on
            # The last line is incomplete if the process was killed.
            self._file.truncate(whole)
            if not whole:
                self._write(head)
        except OSError as error:
            self._file.close()
            raise self._open_error(error) from error
        except BaseException:
            self._file.close()
            raise

    def _open_error(self, error: OSError) -> InputError:
        return InputError(
            f"it cannot be used: {error.strerror}",
            file=str(self._path),
            element="resume",
            remedy="Give a file in a folder that can be written",
        )

    def _lock(self) -> None:
        """Refuse the journal of a sweep that is running; the lock ends with the process."""
        if fcntl is None:
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                "another sweep is writing to it",
                file=str(self._path),
                element="resume",
                remedy="Give another file, or wait until it has ended",
            ) from error
        except OSError:
            return  # a file system without locks

    def _read(self, head: Mapping[str, Any]) -> int:
        """Read the known outcomes; returns the length (bytes) of the complete lines.

        Refuses the file of another sweep or format.
        """
        data = read_bytes(self._path, LARGEST_JOURNAL)
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
                key, outcome = entry["case"], _outcome(entry["outcome"])
                if key in index:
                    self.known.setdefault(index[key], outcome)
            except (ValueError, KeyError, TypeError, RecursionError) as error:
                raise self._fault(f"line {number} is damaged") from error
        if not isinstance(found, dict) or found.get("format") != FORMAT:
            raise self._fault("it is not a file of a sweep, or is of another format")
        own, other = head["sweep"], found.get("sweep")
        if not isinstance(other, dict):
            raise self._fault("line 1 is damaged")
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
        """Append ``entry``; a line that does not fit on the disk leaves nothing."""
        line = memoryview(json.dumps(entry).encode() + b"\n")
        start = os.fstat(self._file.fileno()).st_size
        try:
            while line:
                line = line[self._file.write(line) :]
        except OSError:
            self._file.truncate(start)
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _outcome(entry: Any) -> Outcome:
    """The outcome that :meth:`Journal.add` wrote as ``entry``.

    Raises
    ------
    TypeError
        If it has other keys or values of other types.
    """
    outcome = Outcome(**entry)
    texts = (outcome.status, outcome.message, *outcome.measures)
    if not isinstance(outcome.success, bool) or not all(isinstance(text, str) for text in texts):
        raise TypeError("no outcome of a case")
    if not isinstance(outcome.measures, dict) or outcome.traceback:
        raise TypeError("no outcome of a case")
    for value in outcome.measures.values():
        if not isinstance(value, int | float | str | None):
            raise TypeError("no measure")
    return outcome


def _checked_fingerprint(value: Any, what: str) -> str:
    try:
        return fingerprint(value)
    except Exception as error:  # objects may raise anything when they are pickled
        raise InputError(
            f"what it holds cannot be compared with a later sweep: {printable(error)}",
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
