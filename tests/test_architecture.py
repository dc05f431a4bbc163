"""The layers of the package, and what importing it costs."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import srm_mbs

PACKAGE = Path(srm_mbs.__file__).parent

# From the bottom up; a module may import its own layer and those before it.
LAYERS = (
    (
        "_kernel",
        "arrays",
        "derivations",
        "errors",
        "provenance",
        "records",
        "semi_explicit",
        "shown",
    ),
    ("workspaces",),
    ("anchors", "closures", "csv_tables", "force_element", "laws"),
    ("force_checks", "inertias", "loop_closure", "mechanism_checks", "time_dependence"),
    ("mechanism",),
    ("coordinates", "drives", "pinocchio_constraints", "forces", "user_forces", "systems"),
    ("methods",),
    ("stepping",),
    ("closing", "compiled", "driven_start", "kernel"),
    ("closing_failure", "continuation", "joint_limits"),
    ("assembly", "consistent_rates", "dae_solution", "motion", "segmented", "solution"),
    ("loading",),
    ("request_storage", "segment_storage", "storage"),
    ("options", "progress", "run_log"),
    ("collecting", "preparation"),
    ("dae", "simulation"),
    ("actions", "segments", "simulator", "stepwise", "sweeps"),
    ("analysis",),
    ("spans", "visuals", "readout", "page_server", "web_page"),
    ("moving", "closure_overlays", "overlays"),
    ("scene", "drawing"),
    ("plotting", "playback", "rendering", "summary", "export"),
    ("live", "notebook", "markup", "still"),
    ("report_sections",),
    ("report_accuracy",),
    ("report",),
    ("findings",),
    ("cli_output",),
    ("cli_analysis", "cli_playback", "cli_plots", "cli_report"),
    ("cli",),
    ("__main__",),
)
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
MODULES = sorted(
    path for path in PACKAGE.rglob("*.py") if path.name != "__init__.py" or path.parent != PACKAGE
)


def layer(module: str) -> int:
    return LEVEL[module.split(".")[1]]


def name_of(path: Path) -> str:
    relative = path.relative_to(PACKAGE.parent).with_suffix("")
    return ".".join(part for part in relative.parts if part != "__init__")


def module_level_imports(path: Path) -> list[ast.ImportFrom]:
    """Imports executed when the module is; those for type checking only are left out."""
    tree = ast.parse(path.read_text())
    return [node for node in tree.body if isinstance(node, ast.ImportFrom)]


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_imports_go_downwards_only(path: Path) -> None:
    own = layer(name_of(path))
    for node in module_level_imports(path):
        if node.module and node.module.startswith("srm_mbs."):
            assert layer(node.module) <= own, f"{name_of(path)} imports {node.module}"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_no_module_imports_private_names_of_another(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("srm_mbs"):
            private = [
                alias.name
                for alias in node.names
                if alias.name.startswith("_") and alias.asname is None
            ]
            assert not private, f"{name_of(path)} imports {private} from {node.module}"


def loaded_by(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint(*sorted(sys.modules), sep='\\n')"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent
    )
    return set(run.stdout.split())


def test_importing_the_package_loads_nothing_heavy() -> None:
    loaded = loaded_by("import srm_mbs")
    heavy = {"meshcat", "matplotlib", "scipy.optimize", "rich", "typer", "pydantic", "pinocchio"}
    assert not heavy & loaded


def test_simulating_an_assembled_mechanism_loads_no_optimiser_browser_or_plots() -> None:
    loaded = loaded_by("import srm_mbs as srm\nsrm.simulate, srm.Mechanism, srm.PSRM")
    assert not {"meshcat", "matplotlib", "scipy.optimize", "rich", "typer"} & loaded


def test_every_public_name_can_be_imported() -> None:
    for name in srm_mbs.__all__:
        assert getattr(srm_mbs, name) is not None
    assert set(srm_mbs.__all__) <= set(dir(srm_mbs))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        srm_mbs.nonsense  # noqa: B018
