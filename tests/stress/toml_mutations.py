"""Mutations of descriptions: keys and tables deleted, duplicated, renamed, retyped."""

from __future__ import annotations

import copy
import json
import tomllib
from typing import Any

import numpy as np

from tests.stress.mutation import (
    DEFAULTS,
    LOOPS,
    NAMES,
    REFUSED,
    START,
    TREE,
    Expectation,
    Files,
    Mutation,
    legal,
    misspelt,
    one_of,
    unchanged,
)

Path = tuple[str | int, ...]
ANYTHING = (TREE, LOOPS, START, NAMES, DEFAULTS)
ZERO = [0.0, 0.0, 0.0]
DEFAULT = {
    "base": "fixed", "gravity": [0.0, 0.0, -9.81], "xyz": ZERO, "rpy": ZERO, "loop": [], "force": []
}  # fmt: skip
"""Optional keys whose default can be written out."""
WRONG: dict[type, list[Any]] = {
    str: [3, True, ["x"], {}, "no such word"],
    float: ["1", True, [], {}, float("nan"), float("inf"), 1e31, [1.0, 2.0]],
    int: ["1", [], {}, float("nan"), -1],
    list: ["x", 1.0, True, {}, [1.0], [1.0, 2.0, 3.0, 4.0], [[1.0, 0.0, 0.0]], ["1", "0", "0"]],
    dict: ["x", 3, True, [], ["x"]],
}


def value_text(value: Any) -> str:
    if isinstance(value, dict):
        pairs = (f"{json.dumps(key)} = {value_text(item)}" for key, item in value.items())
        return "{ " + ", ".join(pairs) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(value_text, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value)


def document_text(document: dict[str, Any]) -> str:
    """TOML of ``document``: [[loop]] and [initial] as tables, what they hold as inline values."""
    lines, tables = [], []
    for key, value in document.items():
        if isinstance(value, dict):
            tables.append((f"[{key}]", value))
        elif isinstance(value, list) and value and all(isinstance(v, dict) for v in value):
            tables += [(f"[[{key}]]", item) for item in value]
        else:
            lines.append(f"{json.dumps(key)} = {value_text(value)}")
    for header, table in tables:
        lines += ["", header]
        lines += [f"{json.dumps(key)} = {value_text(value)}" for key, value in table.items()]
    return "\n".join(lines) + "\n"


def paths(value: Any, here: Path = ()) -> list[Path]:
    """Every key and list item of the document; not the numbers of a vector."""
    found: list[Path] = [here] if here else []
    if isinstance(value, dict):
        for key, item in value.items():
            found += paths(item, (*here, key))
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for i, item in enumerate(value):
            found += paths(item, (*here, i))
    return found


def holder(document: Any, path: Path) -> Any:
    """What holds the last key of ``path``."""
    for part in path[:-1]:
        document = document[part]
    return document


class TomlMutator:
    """Draws mutations of the description of one bundled mechanism."""

    def __init__(self, model: str, files: Files) -> None:
        self.model, self.files = model, files
        self.document = tomllib.loads(files.toml)

    def draw(self, rng: np.random.Generator) -> Mutation | None:
        """A random mutation; None if the drawn operation does not apply at the drawn key."""
        document = copy.deepcopy(self.document)
        path = one_of(paths(document), rng)
        operation = one_of([self.delete, self.duplicate, self.rename, self.retype], rng)
        outcome = operation(document, path, rng)
        if outcome is None:
            return None
        change, expectation, text, written_out = outcome
        files = Files(text or document_text(document), self.files.urdf)
        return Mutation(
            self.model,
            f"toml: {'.'.join(map(str, path))} {change}",
            files,
            expectation,
            None if written_out is None else Files(document_text(written_out), self.files.urdf),
        )

    Outcome = tuple[str, Expectation, str | None, dict[str, Any] | None] | None

    def delete(self, document: Any, path: Path, rng: np.random.Generator) -> Outcome:
        key = path[-1]
        written_out = None
        if key in DEFAULT:
            written_out = copy.deepcopy(document)
            holder(written_out, path)[key] = DEFAULT[str(key)]
        del holder(document, path)[key]
        return "deleted", self._without(path), None, written_out

    def _without(self, path: Path) -> Expectation:
        key = path[-1]
        if path[0] == "initial":
            return legal(START)
        if path[0] == "simulation":
            return unchanged(DEFAULTS)
        if key == "name":
            return unchanged(NAMES)
        if key in DEFAULT or isinstance(key, int) or (path[0] == "force" and key == "damping"):
            return legal(*ANYTHING)
        return REFUSED

    def duplicate(self, document: Any, path: Path, rng: np.random.Generator) -> Outcome:
        """A [[loop]] or [[force]] twice has one name twice; any other key twice is no TOML."""
        held, key = holder(document, path), path[-1]
        if isinstance(key, int):
            held.insert(key, copy.deepcopy(held[key]))
            if rng.random() < 0.5:
                return "duplicated", REFUSED, None, None
            held[key]["name"] = "another"
            changes = (TREE, START) if path[0] == "force" else (LOOPS, NAMES)
            return "duplicated under another name", legal(*changes), None, None
        if key in ("loop", "force"):
            return None
        held["MARK"] = held[key]
        text = document_text(document).replace('"MARK"', json.dumps(key))
        text = text.replace("[MARK]", f"[{key}]")
        return "twice", REFUSED, text, None

    def rename(self, document: Any, path: Path, rng: np.random.Generator) -> Outcome:
        held, key = holder(document, path), path[-1]
        if isinstance(key, int):
            return None
        known = [
            k
            for k in (*self.document, "q", "v", "guess", "link", "frame", "xyz", "rpy", "a", "b",
                      "axis", "type", "t_end", "rtol", "atol", "lock", "force", "crank")
            if k not in held
        ]  # fmt: skip
        new = str(rng.choice(known)) if rng.random() < 0.5 else misspelt(str(key), rng)
        if new in held or new == key:
            return None
        held[new] = held.pop(key)
        return f"renamed {new}", self._renamed(path, new), None, None

    def _renamed(self, path: Path, new: str) -> Expectation:
        if path[0] == "initial" and len(path) > 1 and new in ("q", "v", "guess", "crank"):
            return legal(START)
        if path[0] == "simulation" and len(path) > 1 and new in ("t_end", "rtol", "atol"):
            return unchanged(DEFAULTS)
        if (path[-1], new) == ("link", "frame"):
            return legal()
        if {path[-1], new} == {"xyz", "rpy"}:
            return legal(TREE if path[0] == "force" else LOOPS, START)
        return REFUSED

    def retype(self, document: Any, path: Path, rng: np.random.Generator) -> Outcome:
        held, key = holder(document, path), path[-1]
        old = held[key]
        if rng.random() < 0.25:
            other = self._sensible(path, old, rng)
            if other is None or other == old:
                return None
            held[key] = other
            return f"made {other!r}", self._sensibly_changed(path), None, None
        new = one_of(WRONG[type(old)], rng)
        held[key] = new
        named = key == "name" and isinstance(new, str)
        return f"made {new!r}", unchanged(NAMES) if named else REFUSED, None, None

    def _sensible(self, path: Path, old: Any, rng: np.random.Generator) -> Any:
        if path == ("format",):
            return None
        if isinstance(old, float):
            return 1.1 * old + 0.01
        if isinstance(old, list) and old and isinstance(old[0], float):
            return [1.1 * x + 0.01 for x in old]
        if path[-1] == "type":
            return str(rng.choice(["point", "frame", "revolute", "point_on_line"]))
        if path[-1] == "link":
            return str(rng.choice(["crank", "rod", "coupler", "world"]))
        if path == ("base",):
            return str(rng.choice(["floating", "planar"]))
        if isinstance(old, dict) and path[0] in ("initial", "simulation"):
            return {}
        return None

    def _sensibly_changed(self, path: Path) -> Expectation:
        if path[0] == "initial":
            return legal(START)
        if path[0] == "simulation":
            return unchanged(DEFAULTS)
        if path[0] == "loop":
            return legal(LOOPS, START)
        return legal(TREE, LOOPS, START, NAMES)
