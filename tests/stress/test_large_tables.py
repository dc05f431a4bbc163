"""A table of ten million rows is data: it is read, in time and in little memory."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.stress.isolation import ROOT
from tests.support.memory import ON_LINUX
from tests.support.urdf_files import tree

pytestmark = [
    pytest.mark.stress,
    pytest.mark.skipif(not ON_LINUX, reason="reads /proc/self/status"),
]

ROWS = 10**7
MEGABYTES = 500
"""Of the process at most, the package included."""
SECONDS = 10.0
"""CPU time: three on an idle machine."""
READ = """
import json, sys, time
import srm_mbs as srm
from tests.support import memory
begun = time.process_time()
table = srm.load(sys.argv[1]).forces[0].law
seconds = time.process_time() - begun
print(json.dumps([len(table.t), table.span, table.values[3], seconds, memory.largest()]))
"""


def test_ten_million_rows_are_read_as_the_law_of_a_force(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(tree())
    (tmp_path / "robot.toml").write_text(
        'format = 1\nurdf = "robot.urdf"\n[[force]]\ntype = "torque"\njoint = "hip"\n'
        'law = { type = "table", table = "long.csv" }\n'
    )
    path = tmp_path / "long.csv"
    with path.open("w") as file:
        file.write("t,value\n")
        for start in range(0, ROWS, 10**6):
            rows = range(start, start + 10**6)
            file.write("".join(f"{k / 1000:.3f},0.{k % 997:03d}125\n" for k in rows))

    done = subprocess.run(
        [sys.executable, "-c", READ, str(tmp_path / "robot.toml")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )

    count, span, value, seconds, used = json.loads(done.stdout)
    assert (count, span, value) == (ROWS, [0.0, (ROWS - 1) / 1000], 0.003125)
    assert used < MEGABYTES
    assert seconds < SECONDS
