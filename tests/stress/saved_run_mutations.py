"""Child process: load mutated saved runs, and say what became of each.

``python -m tests.stress.saved_run_mutations FOLDER FIRST LAST`` makes the mutations of these
numbers of the runs in FOLDER, and prints one JSON object per line, flushed, so that a crash loses
nothing: the next number is the culprit.
"""

from __future__ import annotations

import copy
import io
import json
import sys
import time
import warnings
import zipfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import srm_mbs as srm
from srm_mbs.api import SOLUTIONS
from srm_mbs.formats.archive import array_from
from srm_mbs.model.reach import Reach
from srm_mbs.simulation import storage

MEMORY = 6 * 10**9
"""Bytes of address space of the process."""
SLOW = 10.0
"""Seconds that no run of this size takes."""
ARCHIVES_EVERY = 400
"""One in so many mutations changes the text of an archive of Pinocchio: each starts a process."""

Parts = dict[str, bytes]
Rng = np.random.Generator


def members(content: bytes) -> Parts:
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        return {name: file.read(name) for name in file.namelist()}


def archive(parts: Parts) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as out:
        for name, content in parts.items():
            out.writestr(name, content)
    return file.getvalue()


def npy(array: Any) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
    return file.getvalue()


# -- bytes ------------------------------------------------------------------------------------


def changed_bytes(parts: Parts, rng: Rng) -> str:
    name = str(rng.choice(list(parts)))
    content = bytearray(parts[name])
    if not content:
        return "nothing"
    kind = int(rng.integers(4))
    if kind == 0:
        del content[int(rng.integers(len(content))) :]
    elif kind == 1:
        content += rng.bytes(int(rng.integers(1, 100)))
    else:
        for at in rng.integers(0, len(content), int(rng.integers(1, 9))):
            content[at] = int(rng.integers(256))
    parts[name] = bytes(content)
    return f"bytes of {name}"


# -- JSON -------------------------------------------------------------------------------------

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 3, 7, 10**6, -(10**6), 2**31, 2**63, 10**30, 0.5, -0.0),
    *(1e-300, 1e-12, 1e12, 1e29, 1e300, -1e300, float("nan"), float("inf"), -float("inf")),
    *("", "x", "python", "kernel", "world", "dop853", "erk4", "\u202e", "a" * 5000, [], {}, [[]]),
    *([0.0], [1.0, 2.0, 3.0], [0, 0.1], [[0, 0.1], [0, 0.1]], {"type": "sine"}, {"link": "world"}),
)


def places(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths to everything inside ``value``."""
    keys: Any = ()
    if isinstance(value, dict):
        keys = value
    elif isinstance(value, list):
        keys = range(len(value))
    return [path for key in keys for path in ((*at, key), *places(value[key], (*at, key)))]


def changed_json(text: str, rng: Rng) -> tuple[str, str]:
    root = json.loads(text)
    found = places(root)
    # Data of a model have most of the numbers; every part of the text has its turn.
    tops = sorted({path[:2] for path in found})
    top = tops[int(rng.integers(len(tops)))]
    inside = [path for path in found if path[: len(top)] == top]
    path = inside[int(rng.integers(len(inside)))]
    holder = root
    for key in path[:-1]:
        holder = holder[key]
    key, old = path[-1], holder[path[-1]]
    kind = int(rng.integers(8))
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, list):
        holder.insert(key, copy.deepcopy(old))
    elif kind == 2 and isinstance(holder, dict):
        holder[f"{key}_2"] = old
    elif kind in (3, 4) and isinstance(old, float | int) and not isinstance(old, bool):
        holder[key] = [-old, old + 1, 2 * old, old * 1e6, float(old) + 1e-9, int(old)][
            int(rng.integers(6))
        ]
    else:
        holder[key] = VALUES[int(rng.integers(len(VALUES)))]
    return json.dumps(root), ".".join(map(str, path))


# -- arrays -----------------------------------------------------------------------------------

SHAPES: tuple[Callable[[Any, Rng], Any], ...] = (
    lambda a, rng: a[None],
    lambda a, rng: a.ravel(),
    lambda a, rng: a.T,
    lambda a, rng: np.concatenate([a, a]) if a.ndim else a,
    lambda a, rng: a[:-1] if a.ndim else a[None],
    lambda a, rng: a[1:] if a.ndim else a[None],
    lambda a, rng: a[:0] if a.ndim else a[None],
    lambda a, rng: a[..., :-1] if a.ndim else a,
    lambda a, rng: a[::-1] if a.ndim else a,
    lambda a, rng: np.zeros(0),
    lambda a, rng: np.zeros((3, 1)),
)
TYPES = ("f4", "f8", "i8", "i4", "u1", "b1", "U3", "c16", ">f8")
NUMBERS = (
    *(0.0, 1.0, -1.0, 0.5, 2.0, 1e6, -1e6, 1e12, 1e20, 1e29, 1e300, -1e300, 1e-300),
    *(np.nan, np.inf, -np.inf),
)


def changed_array(array: Any, rng: Rng) -> tuple[Any, str]:
    kind = int(rng.integers(5))
    if kind == 0:
        which = int(rng.integers(len(SHAPES)))
        return SHAPES[which](array, rng), f"shape {which}"
    if kind == 1:
        name = TYPES[int(rng.integers(len(TYPES)))]
        if array.dtype.names is None and array.dtype.kind != "U":
            return array.astype(name), f"type {name}"
        return np.zeros(array.shape, name), f"zeros of type {name}"
    if array.dtype.kind not in "fib" or not array.size:
        return np.full((*array.shape, 2), 0.5), "another axis"
    out = array.copy()
    number = NUMBERS[int(rng.integers(len(NUMBERS)))]
    if array.dtype.kind != "f":
        number = float(np.clip(np.nan_to_num(number), -(2**40), 2**40))
    if kind == 2:
        out[...] = number
        return out, f"all {number}"
    at = tuple(int(rng.integers(length)) for length in out.shape)
    if kind == 3:
        out[at] = number
        return out, f"{at} = {number}"
    if array.dtype.kind == "f":
        factor = 10.0 ** rng.uniform(-9, 9)
        out[at] *= factor
        return out, f"{at} times {factor:.0e}"
    out[at] = not out[at]
    return out, f"{at} inverted"


def changed_archive_of_pinocchio(text: str, rng: Rng) -> tuple[str, str]:
    words = text.split(" ")
    at = int(rng.integers(len(words)))
    new = ["0", "1", "-1", "7", "1000000", "nan", "1e300", "x", ""][int(rng.integers(9))]
    words[at] = new
    return " ".join(words), f"word {at} of the archive = {new!r}"


# -- one mutation -----------------------------------------------------------------------------


def mutated(parts: Parts, number: int, rng: Rng) -> str:
    """Change ``parts``, the members of a saved run; what was changed."""
    if storage.CONTENTS in parts and rng.random() < 0.8:
        name = str(rng.choice([name for name in parts if name != storage.CONTENTS]))
        inner = members(parts[name])
        what = mutated(inner, number, rng)
        parts[name] = archive(inner)
        return f"{name}: {what}"
    if storage.CONTENTS in parts:
        if rng.random() < 0.3:
            return changed_bytes(parts, rng)
        text, where = changed_json(parts[storage.CONTENTS].decode(), rng)
        parts[storage.CONTENTS] = text.encode()
        return f"{storage.CONTENTS}: {where}"
    meta = str(array_from(parts["meta.npy"], "meta"))
    model = json.loads(meta)["mechanism"]["model"]
    if isinstance(model, str) and number % ARCHIVES_EVERY < len(FILES):
        entry = json.loads(meta)
        entry["mechanism"]["model"], what = changed_archive_of_pinocchio(model, rng)
        parts["meta.npy"] = npy(np.array(json.dumps(entry)))
        return what
    kind = rng.random()
    if kind < 0.15:
        name = str(rng.choice([name for name in parts if name != "meta.npy"]))
        inner = {name: parts[name]}
        what = changed_bytes(inner, rng)
        parts |= inner
        return what
    if kind < 0.2:
        return changed_bytes(parts, rng)
    if kind < 0.6:
        text, where = changed_json(meta, rng)
        parts["meta.npy"] = npy(np.array(text))
        return f"meta: {where}"
    name = str(rng.choice([name for name in parts if name != "meta.npy"]))
    array, what = changed_array(array_from(parts[name], name), rng)
    parts[name] = npy(array)
    return f"{name}: {what}"


def outcome(content: bytes, rng: Rng) -> dict[str, Any]:
    """``refused`` with a message when it is loaded, ``refused when read`` where a value that the
    file may have makes the equations of motion unsolvable, or ``read``; all else is a fault."""
    try:
        solution = storage.load_from(io.BytesIO(content), Path("run.npz"), SOLUTIONS, Reach())
    except srm.InputError as error:
        message = str(error)
        ours = error.file and error.remedy and "Traceback" not in message and len(message) < 2000
        return {"is": "refused" if ours else "not our words", "message": message}
    start, end = solution.span
    try:
        q, v = solution(np.clip(np.linspace(start, end, 4), start, end))
    except srm.InputError as error:
        return {"is": "refused when read", "message": str(error)}
    try:
        if rng.random() < 0.1 and not solution.settings.controlled:
            _ = solution.crossings, solution.reactions, solution.energy, solution.bifurcations
    except srm.SrmError as error:  # the equations of motion of another possible mechanism
        return {"is": "refused when read", "message": str(error)}
    fits = q.shape == (4, solution.mechanism.model.nq) and len(q) == len(v)
    return {"is": "read" if fits and np.isfinite(q).all() else "not finite"}


FILES: tuple[str, ...] = ()


def main(folder: Path, first: int, last: int) -> None:
    global FILES
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    except ImportError:
        pass
    warnings.simplefilter("ignore")
    np.seterr(all="ignore")
    storage.model_from_archive = lru_cache(maxsize=4)(storage.model_from_archive)
    FILES = tuple(sorted(path.name for path in folder.glob("*.npz")))
    whole = {name: members((folder / name).read_bytes()) for name in FILES}
    for number in range(first, last):
        rng = np.random.default_rng(number)
        name = FILES[number % len(FILES)]
        parts = dict(whole[name])
        what = mutated(parts, number, rng)
        begun = time.process_time()
        print(json.dumps({"number": number, "run": name, "change": what}), flush=True)  # noqa: T201
        try:
            found = outcome(archive(parts), rng)
        except BaseException as error:
            found = {"is": "raised", "message": f"{type(error).__name__}: {error}"}
        if time.process_time() - begun > SLOW:
            found = {"is": "slow", "message": f"{time.process_time() - begun:.1f} s"}
        print(json.dumps(found), flush=True)  # noqa: T201


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
