"""The compiled kernel is loaded where it can be, and its absence is explained where not."""

from __future__ import annotations

import importlib
import logging
import runpy
import shutil
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import srm_mbs as srm
import srm_mbs._kernel
import srm_mbs.integration.kernel.backend
from srm_mbs._kernel.build_hash import fingerprint

BUILT, CORE = "srm_mbs._kernel.built", "srm_mbs._kernel._core"
PACKAGE = Path(srm_mbs._kernel.__file__).parent


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


def built_against(pinocchio: str, sources: str = fingerprint(PACKAGE)) -> ModuleType:
    module = ModuleType(BUILT)
    module.PINOCCHIO = pinocchio  # type: ignore[attr-defined]
    module.SOURCES = sources  # type: ignore[attr-defined]
    return module


def load(folder: Path = PACKAGE) -> tuple[ModuleType | None, str]:
    """What a process finds that imports the package for the first time."""
    package = runpy.run_path(str(folder / "__init__.py"))
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


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """``srm_mbs/_kernel`` of a checkout with sources of its own."""
    folder = tmp_path / "srm_mbs" / "_kernel"
    (folder / "src").mkdir(parents=True)
    shutil.copy(PACKAGE / "__init__.py", folder)
    (folder / "src" / "run.cpp").write_text("int run() { return 1; }\n")
    (folder / "src" / "run.hpp").write_text("int run();\n")
    (tmp_path / "CMakeLists.txt").write_text("project(kernel)\n")
    return folder


CHANGES: dict[str, Callable[[Path], object]] = {
    "a source": lambda folder: (folder / "src" / "run.cpp").write_text("int run() { return 2; }\n"),
    "a new header": lambda folder: (folder / "src" / "new.hpp").write_text("int run();\n"),
    "another name": lambda folder: (folder / "src" / "run.hpp").rename(folder / "src" / "go.hpp"),
    "one fewer": lambda folder: (folder / "src" / "run.hpp").unlink(),
    "how it is built": lambda folder: (folder.parents[1] / "CMakeLists.txt").write_text(""),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_kernel_built_before_its_sources_changed_is_refused_before_it_is_loaded(
    imported: dict[str, Any], checkout: Path, change: Callable[[Path], object]
) -> None:
    core = ModuleType(CORE)
    imported |= {BUILT: built_against(version("pin"), fingerprint(checkout)), CORE: core}
    assert load(checkout) == (core, "")
    imported["seen"].clear()
    change(checkout)
    assert load(checkout) == (
        None,
        "it was built from other sources (install again: pip install -e .)",
    )
    assert imported["seen"] == [BUILT]


def test_a_kernel_that_does_not_say_from_what_it_was_built_is_refused_beside_sources(
    imported: dict[str, Any], checkout: Path
) -> None:
    old = built_against(version("pin"))
    del old.SOURCES
    imported |= {BUILT: old, CORE: ModuleType(CORE)}
    core, missing = load(checkout)
    assert core is None
    assert "built from other sources" in missing


def test_an_installation_without_sources_uses_the_kernel_that_came_with_it(
    imported: dict[str, Any], checkout: Path
) -> None:
    core = ModuleType(CORE)
    imported |= {BUILT: built_against(version("pin"), fingerprint(checkout)), CORE: core}
    shutil.rmtree(checkout / "src")
    (checkout.parents[1] / "CMakeLists.txt").unlink()
    assert fingerprint(checkout) == ""
    assert load(checkout) == (core, "")


def test_files_that_are_no_sources_do_not_count(checkout: Path) -> None:
    before = fingerprint(checkout)
    (checkout / "src" / "run.cpp.orig").write_text("an editor's copy")
    (checkout / "src" / ".#run.cpp").symlink_to("nobody@nowhere")  # an editor's lock
    assert fingerprint(checkout) == before


def test_an_outdated_kernel_is_told_once_and_named_where_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("SRM_MBS_BACKEND", raising=False)
    monkeypatch.setattr(srm_mbs.integration.kernel.backend, "core", None)
    monkeypatch.setattr(srm_mbs.integration.kernel.backend, "missing", srm_mbs._kernel.OUTDATED)
    srm_mbs.integration.kernel.backend.warn_outdated.cache_clear()
    mechanism = srm.load("four_bar")
    with caplog.at_level(logging.WARNING, "srm_mbs"):
        srm.simulate(mechanism, 0.1, backend="python")
        assert not caplog.records
        for _ in range(2):
            assert srm.simulate(mechanism, 0.1).settings.backend == "python"
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert "it was built from other sources" in record.getMessage()
    assert "pip install -e ." in record.getMessage()
    with pytest.raises(srm.InputError, match="it was built from other sources"):
        srm.simulate(mechanism, 0.1, backend="kernel")


def test_without_kernel_runs_use_the_reference_and_the_kernel_cannot_be_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("SRM_MBS_BACKEND", raising=False)
    monkeypatch.setattr(srm_mbs.integration.kernel.backend, "core", None)
    monkeypatch.setattr(srm_mbs.integration.kernel.backend, "missing", "it was not built")
    mechanism = srm.load("four_bar")
    assert srm.backend() == "python"
    assert srm.simulate(mechanism, 0.1).settings.backend == "python"
    with pytest.raises(srm.InputError, match="it was not built") as caught:
        srm.simulate(mechanism, 0.1, backend="kernel")
    assert caught.value.element == "backend"
    assert "Use the backend auto" in str(caught.value)


@pytest.mark.parametrize("asks", [partial(srm.simulate, t_end=0.1), srm.Simulator])
def test_there_is_no_other_backend(asks: Callable[..., object]) -> None:
    with pytest.raises(srm.InputError, match="there is no backend 'fortran'") as caught:
        asks(srm.load("four_bar"), backend="fortran")
    assert caught.value.element == "backend"
