"""The compiled kernel is loaded where it can be, and its absence is explained where not."""

from __future__ import annotations

import shutil
import sys
import warnings
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path

import pytest

import srm_mbs as srm
import srm_mbs._kernel
import srm_mbs.integration.kernel.backend
from srm_mbs._kernel import INSTALL_AGAIN, load
from srm_mbs._kernel.build_hash import fingerprint

CORE = "srm_mbs._kernel._core"
PIN = version("pin")


@pytest.fixture(autouse=True)
def _own_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loading a kernel enters it into ``sys.modules``: afterwards the entry is as it was."""
    monkeypatch.setitem(sys.modules, CORE, sys.modules.get(CORE))


def build(folder: Path, sources: str | None, pinocchio: str = PIN, core: str = "") -> Path:
    """A kernel in ``folder``, whose extension module is the Python text ``core``."""
    folder.mkdir(parents=True, exist_ok=True)
    written = f"PINOCCHIO = {pinocchio!r}\n"
    if sources is not None:
        written += f"SOURCES = {sources!r}\n"
    (folder / "built.py").write_text(written)
    (folder / "_core.py").write_text(core)
    return folder


def install(site: Path, record: str = "{}") -> Path:
    """``srm_mbs/_kernel`` of an srm-mbs installed in ``site``, as without a C++ compiler."""
    distribution = site / "srm_mbs-0.1.0.dist-info"
    distribution.mkdir(parents=True)
    (distribution / "METADATA").write_text("Metadata-Version: 2.1\nName: srm-mbs\nVersion: 0.1.0\n")
    (distribution / "direct_url.json").write_text(record)
    folder = site / "srm_mbs" / "_kernel"
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """``srm_mbs/_kernel`` of an installation, which has no sources."""
    return install(tmp_path / "site")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """``srm_mbs/_kernel`` of a checkout with sources of its own."""
    folder = tmp_path / "check out" / "srm_mbs" / "_kernel"
    (folder / "src").mkdir(parents=True)
    (folder / "src" / "run.cpp").write_text("int run() { return 1; }\n")
    (folder / "src" / "run.hpp").write_text("int run();\n")
    (folder.parents[1] / "CMakeLists.txt").write_text("project(kernel)\n")
    return folder


def loaded_from(folder: Path, *search: Path) -> Path:
    """The folder of the kernel that the package in ``folder`` uses."""
    found = load(folder, [str(entry) for entry in search])
    assert found.core is not None, found.missing
    assert found.missing == found.remedy == ""
    assert sys.modules[CORE] is found.core
    assert found.core.__name__ == CORE
    return Path(str(found.core.__file__)).parent


def refused(folder: Path, *search: Path) -> tuple[str, str]:
    """Why the package in ``folder`` has no kernel, and the remedy; none was loaded."""
    before = sys.modules[CORE]
    found = load(folder, [str(entry) for entry in search])
    assert found.core is None
    assert sys.modules[CORE] is before
    return found.missing, found.remedy


def in_place(checkout: Path) -> str:
    return f"pip install '{checkout.parents[1]}'"


def test_an_installation_uses_the_kernel_beside_it(installed: Path, tmp_path: Path) -> None:
    build(installed, "hash of its sources")
    build(install(tmp_path / "other"), "hash of its sources")
    assert fingerprint(installed) == ""
    assert loaded_from(installed, tmp_path / "other") == installed


def test_an_installation_without_kernel_does_not_take_that_of_another(
    installed: Path, tmp_path: Path
) -> None:
    build(install(tmp_path / "other"), "")
    missing, remedy = refused(installed, tmp_path / "other", installed.parents[1])
    assert "it was not built when srm-mbs was installed" in missing
    assert "no C++17 compiler" in missing
    assert INSTALL_AGAIN in remedy
    assert "pip install --force-reinstall --no-deps" in remedy


def test_a_checkout_uses_the_installed_kernel_that_was_built_from_its_sources(
    checkout: Path, installed: Path, tmp_path: Path
) -> None:
    build(installed, fingerprint(checkout))
    empty = tmp_path / "empty"
    assert loaded_from(checkout, checkout.parents[1], empty, installed.parents[1]) == installed


def test_a_checkout_passes_over_installed_kernels_of_other_sources(
    checkout: Path, installed: Path, tmp_path: Path
) -> None:
    build(installed, "other sources")
    second = build(install(tmp_path / "second"), fingerprint(checkout))
    assert loaded_from(checkout, installed.parents[1], tmp_path / "second") == second


def test_a_checkout_with_a_kernel_of_its_own_uses_that(checkout: Path, installed: Path) -> None:
    build(installed, fingerprint(checkout))
    build(checkout, fingerprint(checkout))
    assert loaded_from(checkout, installed.parents[1]) == checkout


def test_another_patch_of_pinocchio_is_the_same_interface(installed: Path) -> None:
    major, minor, *_ = PIN.split(".")
    build(installed, "", f"{major}.{minor}.99")
    assert loaded_from(installed) == installed


@pytest.mark.parametrize("other", ["3.9.0", "4.0.0", "5.1.0"])
def test_a_kernel_built_against_another_pinocchio_is_refused_before_it_is_loaded(
    checkout: Path, installed: Path, other: str
) -> None:
    build(installed, fingerprint(checkout), other, core="raise SystemError")
    because = f"it was built against Pinocchio {other}, but pin {PIN} is installed"
    # Built again it would be against the same Pinocchio: srm-mbs asks for that minor version.
    assert refused(installed) == (because, f'Run: pip install "pin=={other[:3]}.*"')
    assert refused(checkout, installed.parents[1]) == (because, f"Run: {in_place(checkout)}")


def test_a_checkout_beside_an_installation_without_compiler_says_so(
    checkout: Path, installed: Path
) -> None:
    missing, remedy = refused(checkout, installed.parents[1])
    assert "it was not built when srm-mbs was installed" in missing
    assert remedy == f"With a C++17 compiler, run: {in_place(checkout)} -v"


def test_a_checkout_with_nothing_installed_says_so(checkout: Path, tmp_path: Path) -> None:
    missing, remedy = refused(checkout, checkout.parents[1], tmp_path / "nowhere")
    assert "no srm-mbs is installed" in missing
    assert "compiler" not in missing
    assert remedy == f"Run: {in_place(checkout)}"


def test_a_kernel_that_the_system_cannot_load_gives_the_reason(
    checkout: Path, installed: Path
) -> None:
    reason = "libboost_python311.so.1.90.0: cannot open shared object file"
    build(installed, fingerprint(checkout), core=f"raise ImportError({reason!r})")
    assert refused(installed) == (f"it cannot be loaded: {reason}", f"Run: {INSTALL_AGAIN}")
    assert refused(checkout, installed.parents[1]) == (
        f"it cannot be loaded: {reason}",
        f"Run: {in_place(checkout)}",
    )


def test_a_kernel_for_another_python_cannot_be_loaded(checkout: Path, installed: Path) -> None:
    build(installed, fingerprint(checkout))
    (installed / "_core.py").rename(installed / "_core.cpython-27-other.so")
    assert "no _core for this Python" in refused(checkout, installed.parents[1])[0]


CHANGES: dict[str, Callable[[Path], object]] = {
    "a source": lambda folder: (folder / "src" / "run.cpp").write_text("int run() { return 2; }\n"),
    "a new header": lambda folder: (folder / "src" / "new.hpp").write_text("int run();\n"),
    "another name": lambda folder: (folder / "src" / "run.hpp").rename(folder / "src" / "go.hpp"),
    "one fewer": lambda folder: (folder / "src" / "run.hpp").unlink(),
    "how it is built": lambda folder: (folder.parents[1] / "CMakeLists.txt").write_text(""),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.parametrize("editable", [False, True])
def test_a_kernel_built_before_its_sources_changed_is_refused_before_it_is_loaded(
    checkout: Path, tmp_path: Path, change: Callable[[Path], object], editable: bool
) -> None:
    site = tmp_path / "site"
    record = '{"dir_info": {"editable": true}, "url": "file://"}' if editable else "{}"
    built = build(install(site, record), fingerprint(checkout))
    assert loaded_from(checkout, site) == built
    change(checkout)
    (built / "_core.py").write_text("raise SystemError")
    command = in_place(checkout)
    assert refused(checkout, site) == (
        f"it was built from other sources than those in {checkout.parents[1]}",
        f"Run: {command.replace('install', 'install -e', 1) if editable else command}",
    )


def test_a_kernel_that_does_not_say_from_what_it_was_built_is_refused_beside_sources(
    checkout: Path,
) -> None:
    build(checkout, None, core="raise SystemError")
    assert "built from other sources" in refused(checkout)[0]


def test_an_installation_without_sources_uses_the_kernel_that_came_with_it(checkout: Path) -> None:
    build(checkout, fingerprint(checkout))
    shutil.rmtree(checkout / "src")
    (checkout.parents[1] / "CMakeLists.txt").unlink()
    assert fingerprint(checkout) == ""
    assert loaded_from(checkout) == checkout


def test_files_that_are_no_sources_do_not_count(checkout: Path) -> None:
    before = fingerprint(checkout)
    (checkout / "src" / "run.cpp.orig").write_text("an editor's copy")
    (checkout / "src" / ".#run.cpp").symlink_to("nobody@nowhere")  # an editor's lock
    assert fingerprint(checkout) == before


@pytest.fixture
def without_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that has no kernel, and has not warned of it."""
    monkeypatch.delenv("SRM_MBS_BACKEND", raising=False)
    monkeypatch.setattr(srm_mbs.integration.kernel.backend, "core", None)
    monkeypatch.setattr(srm_mbs.integration.kernel.backend, "missing", "it was not built")
    monkeypatch.setattr(srm_mbs.integration.kernel.backend, "remedy", "Run: pip install .")
    srm_mbs.integration.kernel.backend.warn_missing.cache_clear()


@pytest.mark.parametrize("asks", [partial(srm.simulate, t_end=0.1), srm.Simulator])
@pytest.mark.usefixtures("without_kernel")
def test_runs_that_the_kernel_would_make_warn_once_with_reason_and_remedy(
    asks: Callable[..., object],
) -> None:
    mechanism = srm.load("four_bar")
    asks(mechanism, backend="python")
    asks(mechanism, method="srm")
    with pytest.warns(srm.SrmWarning) as caught:
        asks(mechanism)
    asks(mechanism)  # another warning would be an error
    (warning,) = caught
    assert "the compiled kernel is not available: it was not built" in str(warning.message)
    assert str(warning.message).endswith("Run: pip install .")
    assert warning.filename == __file__


@pytest.mark.usefixtures("without_kernel")
def test_who_asks_for_the_reference_is_not_warned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SRM_MBS_BACKEND", "python")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        srm.simulate(srm.load("four_bar"), 0.1)


@pytest.mark.usefixtures("without_kernel")
def test_without_kernel_runs_use_the_reference_and_the_kernel_cannot_be_asked_for() -> None:
    mechanism = srm.load("four_bar")
    assert srm.backend() == "python"
    with pytest.warns(srm.SrmWarning):
        solution = srm.simulate(mechanism, 0.1)
    assert solution.settings.backend == "python"
    assert repr(solution).endswith("finished, python)")
    with pytest.raises(srm.InputError, match="it was not built") as caught:
        srm.simulate(mechanism, 0.1, backend="kernel")
    assert caught.value.element == "backend"
    assert "Run: pip install ." in str(caught.value)
    assert "Use the backend auto" in str(caught.value)
    with pytest.raises(srm.InputError, match="split PSRM only") as caught:
        srm.simulate(mechanism, 0.1, method="srm", backend="kernel")
    assert "pip install" not in str(caught.value)


@pytest.mark.parametrize("asks", [partial(srm.simulate, t_end=0.1), srm.Simulator])
def test_there_is_no_other_backend(asks: Callable[..., object]) -> None:
    with pytest.raises(srm.InputError, match="there is no backend 'fortran'") as caught:
        asks(srm.load("four_bar"), backend="fortran")
    assert caught.value.element == "backend"
