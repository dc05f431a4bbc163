"""Python, the command line and the benchmark name the same backend in every folder.

A checkout has no extension module of its own: it uses that of the srm-mbs that is installed beside
it, here a copy with the extension of this process.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import srm_mbs as srm
import srm_mbs._kernel
from benchmarks.work_precision import command
from srm_mbs.integration.generated.code_cache import compiler

ROOT = Path(__file__).parents[2]
EXTENSION = getattr(srm_mbs._kernel.core, "__file__", None)
pytestmark = pytest.mark.skipif(EXTENSION is None, reason=f"no kernel: {srm_mbs._kernel.missing}")

RUN = """
import logging
import srm_mbs as srm
logging.basicConfig(level=logging.INFO, format="%(message)s")
print(srm.__file__)
for _ in range(2):
    print(repr(srm.simulate(srm.load("four_bar"), 0.1)))
print(srm.backend())
"""
BENCHMARK = ["benchmark", "--out", "measured", "--thin", "--repeats", "1", "--limit", "0.01"]
BENCHMARK += ["--sections", "work", "--problems", "pendulum_chain", "--peers", "ours"]
SITECUSTOMIZE = """
# An editable installation would find the modules of its own checkout, whatever the folder.
import sys
sys.meta_path[:] = [each for each in sys.meta_path if "Redirecting" not in type(each).__name__]
"""


class Machine:
    """A checkout, an installed srm-mbs, a folder that has nothing of both."""

    def __init__(self, top: Path) -> None:
        self.checkout, self.site, self.neutral = (
            top / name for name in ("checkout", "site", "neutral")
        )
        self.neutral.mkdir()
        compiled = shutil.ignore_patterns("_core*.so", "_core*.pyd", "built.py")
        for name in ("srm_mbs", "models", "urdf", "benchmarks", "tests"):
            shutil.copytree(ROOT / name, self.checkout / name, ignore=compiled)
        for name in ("CMakeLists.txt", "pyproject.toml"):
            shutil.copy(ROOT / name, self.checkout)

        package = self.site / "srm_mbs"
        shutil.copytree(self.checkout / "srm_mbs", package)
        shutil.rmtree(package / "_kernel" / "src")
        for name in ("models", "urdf"):
            shutil.copytree(ROOT / name, package / name)
        built = Path(str(EXTENSION))
        for path in (built, built.with_name("built.py")):
            shutil.copy(path, package / "_kernel")
        distribution = self.site / f"srm_mbs-{srm.__version__}.dist-info"
        distribution.mkdir()
        metadata = f"Metadata-Version: 2.1\nName: srm-mbs\nVersion: {srm.__version__}\n"
        (distribution / "METADATA").write_text(metadata)
        origin = {"url": self.checkout.as_uri(), "dir_info": {}}
        (distribution / "direct_url.json").write_text(json.dumps(origin))
        (self.site / "sitecustomize.py").write_text(SITECUSTOMIZE)
        self.script = self.site / "bin" / "srm-mbs"
        self.script.parent.mkdir()
        self.script.write_text("from srm_mbs.__main__ import main\nmain()\n")

    def python(self, folder: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        """Start Python in ``folder``, with the copy as the first installed package."""
        environment = {key: value for key, value in os.environ.items() if key[:4] != "SRM_"}
        return subprocess.run(
            [sys.executable, *map(str, arguments)],
            cwd=folder,
            env=environment
            | {
                "PYTHONPATH": str(self.site),
                "PYTHONDONTWRITEBYTECODE": "1",
                "SRM_MBS_CACHE": str(self.neutral.with_name("cache")),
            },
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Machine:
    return Machine(tmp_path_factory.mktemp("machine"))


@pytest.mark.parametrize("folder", ["checkout", pytest.param("neutral", marks=pytest.mark.stress)])
def test_python_and_the_command_line_use_the_kernel_in_every_folder(
    machine: Machine, folder: str
) -> None:
    place = machine.neutral if folder == "neutral" else machine.checkout
    imported = machine.site if folder == "neutral" else machine.checkout

    run = machine.python(place, "-c", RUN)
    source, *solutions, backend = run.stdout.splitlines()
    assert Path(source).is_relative_to(imported), run.stderr
    assert backend == "kernel"
    assert [text.endswith("finished, kernel)") for text in solutions] == [True, True]
    assert run.stderr.count(", backend kernel\n") == 2
    assert "Warning" not in run.stderr

    for start in ([machine.script], ["-m", "srm_mbs"]):
        shown = machine.python(place, *start, "info", "four_bar")
        assert shown.returncode == 0, shown.stderr
        (line,) = (line for line in shown.stdout.splitlines() if line.startswith("runs on"))
        assert line.endswith("the compiled kernel")
        assert "not available" not in shown.stdout


@pytest.mark.stress
def test_the_benchmark_of_a_checkout_measures_the_kernel(machine: Machine) -> None:
    run = machine.python(machine.checkout, machine.script, *BENCHMARK)
    assert run.returncode == 0, run.stderr
    results = json.loads((machine.checkout / "measured" / "results.json").read_text())
    generated = compiler() is not None
    assert results["settings"]["backend"] == ("generated" if generated else "kernel")
    (preparation,) = results["preparations"]
    assert (preparation["compiler"] is not None) == generated
    variants = {row["variant"] for row in results["measurements"]}
    assert ("dop853, kernel" in variants) == generated
    assert results["peers"] == {"ours": "srm_mbs"}
    elsewhere = machine.python(machine.neutral, machine.script, *BENCHMARK)
    assert elsewhere.returncode == 2
    assert "top of a checkout" in elsewhere.stderr


@pytest.mark.stress
def test_a_checkout_with_changed_sources_warns_once_and_its_benchmark_refuses(
    tmp_path: Path,
) -> None:
    machine = Machine(tmp_path)
    place = machine.checkout
    with (place / "srm_mbs" / "_kernel" / "src" / "run.cpp").open("a") as source:
        source.write("// another comment\n")

    def explains(text: str) -> bool:
        """Whether ``text`` has the reason and the remedy."""
        reason = f"it was built from other sources than those in {place}"
        return reason in text and f"pip install {place}" in text

    run = machine.python(place, "-c", RUN)
    _, *solutions, backend = run.stdout.splitlines()
    assert backend == "python"
    assert [text.endswith("finished, python)") for text in solutions] == [True, True]
    assert run.stderr.count(", backend python\n") == 2
    (warning,) = (line for line in run.stderr.splitlines() if "SrmWarning" in line)
    assert explains(warning)

    asked = machine.python(
        place, "-m", "srm_mbs", "simulate", "four_bar", "--t-end", "0.1", "--backend", "kernel"
    )
    assert asked.returncode == 2
    assert explains(asked.stderr), asked.stderr
    assert "compiler" not in asked.stderr
    shown = machine.python(place, "-m", "srm_mbs", "info", "four_bar")
    assert "the Python reference" in shown.stdout
    assert explains(shown.stdout), shown.stdout

    refused = machine.python(place, machine.script, *BENCHMARK)
    assert refused.returncode == 2
    assert explains(refused.stderr), refused.stderr
    assert "Traceback" not in refused.stderr
    assert not (place / "measured").exists()
    measured = machine.python(place, machine.script, *BENCHMARK, "--backend", "python")
    assert measured.returncode == 0, measured.stderr
    assert "Warning" not in measured.stderr
    results = json.loads((place / "measured" / "results.json").read_text())
    assert results["settings"]["backend"] == "python"
    assert results["peers"] == {"ours": "srm_mbs (Python reference)"}
    assert "was measured on its Python reference" in (place / "measured" / "tables.md").read_text()


def test_the_benchmark_does_not_take_a_variable_for_the_question(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SRM_MBS_BACKEND", "python")
    assert command.main(["--out", str(tmp_path / "measured")]) == 2
    said = capsys.readouterr().err
    assert "SRM_MBS_BACKEND" in said
    assert "--backend python" in said
    assert not (tmp_path / "measured").exists()
