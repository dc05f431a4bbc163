"""Mutated descriptions and URDFs: refused in our words, or what the file says; never a crash."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from srm_mbs.formats.load import models_folder
from tests.stress.isolation import ROOT, fault_of, load_isolated
from tests.stress.mutation import DEFAULTS, LOOPS, NAMES, START, TREE, Files, Mutation
from tests.stress.toml_mutations import TomlMutator
from tests.stress.urdf_mutations import UrdfMutator
from tests.support.mechanisms import DISTINCT_MODELS

pytestmark = pytest.mark.stress

COUNT = 1000
ON_THE_COMMAND_LINE = 20
PARTS = (TREE, LOOPS, START, DEFAULTS, NAMES)


def bundled_files() -> dict[str, Files]:
    out = {}
    for name in DISTINCT_MODELS:
        toml = (models_folder() / f"{name}.toml").read_text()
        urdf = tomllib.loads(toml).get("urdf")
        if urdf is not None:  # linkages typed in have none
            out[name] = Files(toml, (models_folder() / urdf).read_text())
    return out


def draw(count: int, seed: int = 0) -> list[Mutation]:
    """``count`` different mutations, 60 % of them of URDFs, over all bundled mechanisms."""
    rng = np.random.default_rng(seed)
    mutators: list[tuple[UrdfMutator, TomlMutator]] = []
    for name, files in bundled_files().items():
        initial = tomllib.loads(files.toml).get("initial", {})
        described = {joint for table in initial.values() for joint in table}
        mutators.append((UrdfMutator(name, files, described), TomlMutator(name, files)))
    found: dict[Files, Mutation] = {}
    while len(found) < count:
        of_urdf, of_toml = mutators[int(rng.integers(len(mutators)))]
        mutation = (of_urdf if rng.random() < 0.6 else of_toml).draw(rng)
        if mutation is not None:
            found.setdefault(mutation.files, mutation)
    return list(found.values())


def write(folder: Path, files: Files) -> str:
    """The description's path; beside it the URDF that it names."""
    folder.mkdir()
    (folder / "models").mkdir()
    (folder / "urdf").mkdir()
    path = folder / "models" / "mutated.toml"
    path.write_text(files.toml)
    for name in {Path(urdf).name for urdf in re.findall(r'"([^"]*\.urdf)"', files.toml)}:
        (folder / "urdf" / name).write_text(files.urdf)
    return str(path)


def same(ours: Any, theirs: Any, tolerance: float = 1e-10) -> bool:
    """Equal, numbers up to rounding."""
    if isinstance(ours, list) and isinstance(theirs, list):
        alike = (same(a, b, tolerance) for a, b in zip(ours, theirs))
        return len(ours) == len(theirs) and all(alike)
    if isinstance(ours, float) and isinstance(theirs, float):
        return bool(np.isclose(ours, theirs, rtol=tolerance, atol=tolerance))
    return bool(ours == theirs)


def differences(ours: dict[str, Any], theirs: dict[str, Any]) -> set[str]:
    return {part for part in PARTS if not same(ours[part], theirs[part])}


def complaint(
    mutation: Mutation,
    got: dict[str, Any],
    original: dict[str, Any],
    written_out: dict[str, Any] | None,
) -> str | None:
    """What is wrong with an outcome; None if it is as expected."""
    expected = mutation.expectation
    fault = fault_of(got)
    if fault is not None or got["is"] == "refused":
        return fault or (None if expected.refused else f"refused: {got['message']}")
    if not expected.loads:
        return f"loaded; differs in {differences(got, original) or 'nothing'}"
    if written_out is not None:
        if written_out["is"] != "loaded":
            return f"loaded, but with the default written out it is {written_out}"
        if differs := differences(got, written_out):
            return f"differs in {differs} from the same with the default written out"
    if expected.remarked and not got["remarks"] > original["remarks"]:
        return "loaded without a note"
    if expected.noted and got["remarks"] > original["remarks"]:
        return None
    differs = differences(got, original) - expected.changes
    if expected.changes == {LOOPS, NAMES}:  # one closure twice: redundant rows, the same motion
        if got["freedom"] != original["freedom"]:
            return "a closure that stands there twice changes the degrees of freedom"
        # The search goes another way; in free directions it ends at another point nearby.
        if same(got[START], original[START], 1e-6):
            differs -= {START}
    return f"silently different in {differs}" if differs else None


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Mutation, str]]:
    """Every mutation with the path of its description."""
    folder = tmp_path_factory.mktemp("mutated")
    mutations = draw(COUNT)
    return [
        (mutation, write(folder / str(i), mutation.files)) for i, mutation in enumerate(mutations)
    ]


@pytest.fixture(scope="module")
def outcomes(
    written: list[tuple[Mutation, str]], tmp_path_factory: pytest.TempPathFactory
) -> list[tuple[Mutation, dict[str, Any], str | None]]:
    """Every mutation with its outcome and what is wrong with it."""
    folder = tmp_path_factory.mktemp("unmutated")
    originals = {name: write(folder / name, files) for name, files in bundled_files().items()}
    written_out = {
        path: write(folder / str(i), mutation.written_out)
        for i, (mutation, path) in enumerate(written)
        if mutation.written_out is not None
    }
    results = load_isolated(
        [*originals.values(), *(path for _, path in written), *written_out.values()]
    )
    out = []
    for mutation, path in written:
        original, same_again = results[originals[mutation.model]], written_out.get(path, "")
        why = complaint(mutation, results[path], original, results.get(same_again))
        out.append((mutation, results[path], why))
    return out


@pytest.mark.timeout(600)
def test_a_mutated_mechanism_is_refused_or_is_what_the_file_says(
    outcomes: list[tuple[Mutation, dict[str, Any], str | None]],
) -> None:
    wrong = [f"{m.model}, {m.change}: {why}" for m, _, why in outcomes if why is not None]
    assert not wrong, f"{len(wrong)} of {len(outcomes)}:\n" + "\n".join(wrong)


def test_mutations_reach_what_they_should(
    outcomes: list[tuple[Mutation, dict[str, Any], str | None]],
) -> None:
    """Guards the test above: all kinds occur, and neither outcome is rare."""
    loaded = sum(got["is"] == "loaded" for _, got, _ in outcomes)
    assert 0.1 * COUNT < loaded < 0.6 * COUNT
    for word in ("urdf", "toml", "deleted", "duplicated", "renamed", "made", "twice", "without"):
        assert sum(word in mutation.change for mutation, _, _ in outcomes) >= 10, word


@pytest.mark.timeout(600)
def test_mutated_mechanisms_on_the_command_line_end_with_one_line_and_a_status(
    outcomes: list[tuple[Mutation, dict[str, Any], str | None]],
    written: list[tuple[Mutation, str]],
) -> None:
    for i in range(0, COUNT, COUNT // ON_THE_COMMAND_LINE):
        (mutation, path), (_, outcome, _) = written[i], outcomes[i]
        command = ["info"] if i % 40 else ["simulate", "--t-end", "0.01"]
        run = subprocess.run(
            [sys.executable, "-m", "srm_mbs", command[0], path, *command[1:]],
            cwd=ROOT, capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        said = f"{mutation.model}, {mutation.change}: {run.stdout}\n{run.stderr}"
        assert "Traceback" not in run.stdout + run.stderr, said
        assert run.returncode in ((2,) if outcome["is"] == "refused" else (0, 1)), said
        if run.returncode == 2:
            assert run.stderr.startswith("error: "), said
            assert len(run.stderr.splitlines()) == 1, said
