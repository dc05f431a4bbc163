"""Whatever happens while a file is written, the old file or the new one is there, never a part."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.stress.isolation import ROOT

pytestmark = [
    pytest.mark.stress,
    pytest.mark.timeout(120),
    pytest.mark.skipif(os.name != "posix", reason="forks and signals of POSIX"),
]

TRIALS = 8
"""Per file and fault: 7 files, 6 faults, 336 in all."""


@pytest.mark.parametrize(
    "fault", ["full disk", "size limit", "sigint", "sigterm", "sigkill", "two writers"]
)
def test_a_disturbed_write_leaves_the_old_or_the_new_file(fault: str, tmp_path: Path) -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "tests.stress.writing", fault, str(TRIALS), str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )

    assert ran.returncode == 0, ran.stderr
    outcomes = json.loads(ran.stdout)["outcomes"]
    assert sum(sum(counts.values()) for counts in outcomes.values()) == 7 * TRIALS
    total: Counter[str] = Counter()
    for name, counts in outcomes.items():
        # Two files that belong together are replaced one after the other.
        allowed = {"old", "new", "mixed"} if name == "converted.toml" else {"old", "new"}
        assert set(counts) <= allowed, (name, counts)
        total.update(counts)
    # The faults hit, and not every time.
    assert total["old"], outcomes
    assert total["new"], outcomes
