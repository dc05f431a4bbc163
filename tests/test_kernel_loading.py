"""The compiled kernel is loaded where it can be, and its absence is explained where not."""

from __future__ import annotations

import importlib
import runpy
from importlib.metadata import version
from types import ModuleType
from typing import Any

import pytest

import srm_mbs as srm
import srm_mbs._kernel
import srm_mbs.kernel

BUILT, CORE = "srm_mbs._kernel.built", "srm_mbs._kernel._core"


@pytest.fixture
def imported(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Modules by name that loading the kernel finds, and under ``seen`` the names it asked for.

    An exception in place of a module is raised.
    """
    modules: dict[str, Any] = {"seen": []}

    def find(name: str) -> ModuleType:
        modules["seen"].append(name)
        if isinstance(modules[name], Exception):
            raise modules[name]
        found: ModuleType = modules[name]
        return found

    monkeypatch.setattr(importlib, "import_module", find)
    return modules


def built_against(pinocchio: str) -> ModuleType:
    module = ModuleType(BUILT)
    module.PINOCCHIO = pinocchio  # type: ignore[attr-defined]
    return module


def load() -> tuple[ModuleType | None, str]:
    """What a process finds that imports the package for the first time."""
    package = runpy.run_path(srm_mbs._kernel.__file__)
    return package["core"], package["missing"]


def test_the_kernel_built_against_the_installed_pinocchio_is_loaded(
    imported: dict[str, Any],
) -> None:
    core = ModuleType(CORE)
    imported |= {BUILT: built_against(version("pin")), CORE: core}
    assert load() == (core, "")


def test_another_patch_of_pinocchio_is_the_same_interface(imported: dict[str, Any]) -> None:
    core = ModuleType(CORE)
    major, minor, *_ = version("pin").split(".")
    imported |= {BUILT: built_against(f"{major}.{minor}.99"), CORE: core}
    assert load() == (core, "")


@pytest.mark.parametrize("other", ["3.9.0", "4.0.0", "5.1.0"])
def test_a_kernel_built_against_another_pinocchio_is_refused_before_it_is_loaded(
    imported: dict[str, Any], other: str
) -> None:
    imported |= {BUILT: built_against(other), CORE: ModuleType(CORE)}
    core, missing = load()
    assert core is None
    assert f"built against Pinocchio {other}, but pin {version('pin')} is installed" in missing
    assert "pip install --force-reinstall --no-deps" in missing
    assert imported["seen"] == [BUILT]


def test_an_installation_without_compiler_says_how_to_get_the_kernel(
    imported: dict[str, Any],
) -> None:
    imported |= {BUILT: ModuleNotFoundError(f"No module named {BUILT!r}")}
    core, missing = load()
    assert core is None
    assert "no C++17 compiler" in missing
    assert "pip install --force-reinstall --no-deps" in missing
    assert imported["seen"] == [BUILT]


def test_a_kernel_that_the_system_cannot_load_gives_the_reason(imported: dict[str, Any]) -> None:
    reason = "libboost_python311.so.1.90.0: cannot open shared object file"
    imported |= {BUILT: built_against(version("pin")), CORE: ImportError(reason)}
    core, missing = load()
    assert core is None
    assert reason in missing
    assert "pip install --force-reinstall --no-deps" in missing


def test_without_kernel_runs_use_the_reference_and_the_kernel_cannot_be_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("SRM_MBS_BACKEND", raising=False)
    monkeypatch.setattr(srm_mbs.kernel, "core", None)
    monkeypatch.setattr(srm_mbs.kernel, "missing", "it was not built")
    mechanism = srm.load("four_bar")
    assert srm.backend() == "python"
    assert srm.simulate(mechanism, 0.1).settings.backend == "python"
    with pytest.raises(srm.InputError, match="it was not built") as caught:
        srm.simulate(mechanism, 0.1, backend="kernel")
    assert caught.value.element == "backend"
    assert 'backend="auto"' in str(caught.value)
