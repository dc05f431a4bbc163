"""The layers of the package, and what importing it costs."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache

import pytest

import srm_mbs
from tests.support.sources import MODULES, PACKAGE, syntax_tree

ORDER = (
    {"_typing", "errors", "_kernel"},
    {"model"},
    {"dynamics"},
    {"assembly", "integration"},
    {"formats"},
    {"simulation"},
    {"visualization"},
    {"analysis"},
    {"api"},
    {"sweeps"},
    {"__init__"},
    {"cli"},
    {"__main__"},
)
"""Folders and modules at the top of the package, from the ground up (docs/contributing.md)."""
RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}


@cache
def imports_of(module: str) -> set[str]:
    """Modules of the package that ``module`` imports anywhere: at its top, in functions, for type
    checking, and by ``import_module``."""
    path = MODULES[module]
    package = ["srm_mbs", *path.relative_to(PACKAGE).parent.parts]
    named: list[str] = []
    for node in ast.walk(syntax_tree(module)):
        if isinstance(node, ast.Import):
            named += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            named += [f"{source}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and "import_module" in ast.unparse(node.func):
            named += [arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant)]
    found = set()
    for name in named:
        parts = name.split(".")
        if parts[0] == "srm_mbs":
            while parts[1:] and ".".join(parts[1:]) not in MODULES:
                parts.pop()
            found.add(".".join(parts[1:]) or "__init__")
    return found - {module}


def test_the_top_of_the_package_has_the_folders_of_the_map_only() -> None:
    assert {module.split(".")[0] for module in MODULES} == set(RANK)


@pytest.mark.parametrize("module", MODULES)
def test_every_import_goes_down(module: str) -> None:
    own = module.split(".")[0]
    for target in imports_of(module):
        other = target.split(".")[0]
        assert other == own or RANK[other] < RANK[own], f"{module} imports {target}"


def test_no_imports_go_in_a_circle() -> None:
    left = {module: imports_of(module) for module in MODULES}
    while left:
        free = [module for module, targets in left.items() if not targets & set(left)]
        assert free, f"in or above a circle: {sorted(left)}"
        for module in free:
            del left[module]


@pytest.mark.parametrize("module", MODULES)
def test_no_module_imports_private_names_of_another(module: str) -> None:
    for node in ast.walk(syntax_tree(module)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("srm_mbs"):
            private = [
                alias.name
                for alias in node.names
                if re.match(r"_(?!_)", alias.name) and alias.asname is None
            ]
            assert not private, f"{module} imports {private} from {node.module}"


INTEGRATION = [module for module in MODULES if module.startswith("integration.")]


@pytest.mark.parametrize("module", INTEGRATION)
def test_integration_asks_the_protocol_of_systems_not_their_classes(module: str) -> None:
    for node in ast.walk(syntax_tree(module)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance":
            assert not re.search(r"System\b", ast.unparse(node.args[1])), ast.unparse(node)


@pytest.mark.parametrize("module", MODULES)
def test_nothing_is_written_past_the_attributes_of_an_object(module: str) -> None:
    """Frozen dataclasses would be changed without notice."""
    for node in ast.walk(syntax_tree(module)):
        written: list[ast.expr] = []
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            written = [node.func.value] if node.func.attr in ("update", "setdefault", "pop") else []
        elif isinstance(node, ast.Assign):
            written = [to.value for to in node.targets if isinstance(to, ast.Subscript)]
        for target in written:
            assert not re.search(r"__dict__$|^vars\(", ast.unparse(target)), ast.unparse(node)


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
    unneeded = {"meshcat", "matplotlib", "scipy.optimize", "scipy.spatial", "rich", "typer"}
    assert not unneeded & loaded


def test_every_public_name_can_be_imported() -> None:
    for name in srm_mbs.__all__:
        assert getattr(srm_mbs, name) is not None
    assert sorted(dir(srm_mbs)) == sorted([*srm_mbs.__all__, "__version__"])
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        srm_mbs.nonsense  # noqa: B018
