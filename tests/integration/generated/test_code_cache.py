"""The cache of compiled code: private, whole, bounded; and compilers that fail."""

from __future__ import annotations

import ctypes
import os
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.integration.generated import code_cache
from srm_mbs.integration.generated.code_cache import CompilationError, compile_and_load
from srm_mbs.integration.kernel import backend
from tests.support.commands import error_line, row, run

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")

SEVEN = "int seven(void) { return 7; }\n"
IN_TWO_UNITS = """
#if UNIT == 1
int three(void);
int seven(void) { return 4 + three(); }
#elif UNIT == 2
int three(void) { return 3; }
#endif
"""
"""The same in two units, which are linked."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache of a test; its folder does not exist at first."""
    monkeypatch.delenv("SRM_MBS_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "srm-mbs" / "code"


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that is the C compiler, to be written."""
    path = tmp_path / "compiler"
    monkeypatch.setenv("CC", str(path))
    monkeypatch.setattr(code_cache, "compiler", code_cache.compiler.__wrapped__)
    return path


def _write_program(path: Path, script: str) -> None:
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o700)


def _seven(path: Path) -> int:
    try:
        return int(ctypes.CDLL(str(path)).seven())
    except OSError as error:
        raise ValueError(str(error)) from error


def test_code_is_compiled_once_and_then_found(folder: Path) -> None:
    value, first = compile_and_load(SEVEN, _seven)
    assert (value, first.seconds > 0.0) == (7, True)
    assert first.path is not None
    assert first.path.parent == folder
    value, second = compile_and_load(SEVEN, _seven)
    assert (value, second.seconds, second.path) == (7, 0.0, first.path)
    assert code_cache.contents()[0] == 1


def test_the_cache_is_the_users_alone(folder: Path) -> None:
    compile_and_load(SEVEN, _seven)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) & 0o077 for path in folder.iterdir()} == {0}
    assert not [path for path in folder.iterdir() if path.name.startswith(code_cache._WORK)]


@pytest.mark.parametrize("mode", [0o777, 0o750, 0o702])
def test_code_is_not_read_from_a_folder_that_is_open_to_others(folder: Path, mode: int) -> None:
    compile_and_load(SEVEN, _seven)
    folder.chmod(mode)
    value, made = compile_and_load(SEVEN, _seven)
    assert value == 7
    assert made.seconds > 0.0
    assert made.path is None


def test_a_folder_of_another_user_or_a_link_is_unsafe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "own"
    own.mkdir(mode=0o700)
    assert code_cache.unsafe_reason(own) is None
    link = tmp_path / "link"
    link.symlink_to(own)
    assert "is no folder" in str(code_cache.unsafe_reason(link))
    uid = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: uid + 1)
    assert "belongs to another user" in str(code_cache.unsafe_reason(own))


def test_a_library_of_another_user_is_not_loaded(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others put it, with its digest, into the folder while it was open to them."""
    assert compile_and_load(SEVEN, _seven)[1].path is not None
    assert compile_and_load(SEVEN, _seven)[1].seconds == 0.0
    uid = os.getuid()
    monkeypatch.setattr(code_cache, "unsafe_reason", lambda _: None)
    monkeypatch.setattr(os, "getuid", lambda: uid + 1)
    assert compile_and_load(SEVEN, _seven)[1].seconds > 0.0


def test_other_files_of_the_folder_are_neither_counted_nor_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The user may have named a folder that has some, the home for example."""
    home = tmp_path / "home"
    home.mkdir(mode=0o700)
    monkeypatch.setenv("SRM_MBS_CACHE", str(home))
    others = [home / name for name in ("libfoo.so", "poetry.lock", "image.sha256", "new-notes")]
    for path in others:
        path.write_text("mine")
    for name in ("compiler", "new-project"):
        (home / name).mkdir()
        others += [home / name, home / name / "work.c"]
        others[-1].write_text("mine")
    for path in others:
        os.utime(path, (0.0, 0.0))
    monkeypatch.setattr(code_cache, "LARGEST", 0)  # all of its own has to go
    compile_and_load(SEVEN, _seven)
    assert all(path.exists() for path in others)
    assert code_cache.contents() == (0, 0)
    monkeypatch.setattr(code_cache, "LARGEST", 2**20)
    compile_and_load(SEVEN, _seven)
    assert code_cache.contents()[0] == 1
    assert code_cache.clear()[0] == 1
    assert sorted(home.rglob("*")) == sorted(others)


def test_without_a_home_code_is_compiled_and_the_command_says_why_it_is_not_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as it is without a home
    value, made = compile_and_load(SEVEN, _seven)
    assert (value, made.path) == (7, None)
    assert not code_cache.keeps_any()
    for arguments in (["cache"], ["cache", "--clear"]):
        assert "this user has no home" in error_line(run(*arguments, status=2))


def test_the_folder_can_be_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SRM_MBS_CACHE", str(tmp_path / "elsewhere"))
    path = compile_and_load(SEVEN, _seven)[1].path
    assert path is not None
    assert path.parent == tmp_path / "elsewhere"


def test_the_cache_alone_compiles_nothing() -> None:
    assert code_cache.load_cached(SEVEN, _seven) is None
    compile_and_load(SEVEN, _seven)
    found = code_cache.load_cached(SEVEN, _seven)
    assert found is not None
    assert (found[0], found[1].seconds) == (7, 0.0)


def test_an_intact_library_that_cannot_be_loaded_is_compiled_again(folder: Path) -> None:
    path = compile_and_load(SEVEN, _seven)[1].path
    assert path is not None
    path.write_bytes(b"of another system")
    path.with_suffix(".sha256").write_text(code_cache._digest(b"of another system"))
    value, made = compile_and_load(SEVEN, _seven)
    assert (value, made.seconds > 0.0) == (7, True)
    assert compile_and_load(SEVEN, _seven)[1].seconds == 0.0


@pytest.mark.parametrize("damage", ["truncated", "changed", "empty", "no digest"])
def test_a_damaged_library_is_compiled_again(folder: Path, damage: str) -> None:
    path = compile_and_load(SEVEN, _seven)[1].path
    assert path is not None
    content = path.read_bytes()
    path.write_bytes(
        {
            "truncated": content[: len(content) // 2],
            "changed": content[:-1] + bytes([content[-1] ^ 1]),
            "empty": b"",
        }.get(damage, content)
    )
    if damage == "no digest":
        path.with_suffix(".sha256").unlink()
    value, made = compile_and_load(SEVEN, _seven)
    assert (value, made.seconds > 0.0) == (7, True)
    assert path.read_bytes() != b""
    assert compile_and_load(SEVEN, _seven)[1].seconds == 0.0


def test_without_a_place_for_the_cache_code_is_compiled_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    occupied = tmp_path / "file"
    occupied.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(occupied))
    value, made = compile_and_load(SEVEN, _seven)
    assert (value, made.path) == (7, None)


def test_a_full_disk_leaves_nothing_half_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    value, made = compile_and_load(SEVEN, _seven)
    assert (value, made.path) == (7, None)
    assert not list(folder.iterdir())


def test_the_cache_keeps_what_was_used_last(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sources = [f"int seven(void) {{ return 7 + {i} * 0; }}\n" for i in range(3)]
    first = compile_and_load(sources[0], _seven)[1].path
    second = compile_and_load(sources[1], _seven)[1].path
    assert first is not None
    assert second is not None
    now = time.time()
    os.utime(second, (now - 50.0, now - 50.0))
    os.utime(first, (now - 100.0, now - 100.0))
    compile_and_load(sources[0], _seven)  # used again
    monkeypatch.setattr(code_cache, "LARGEST", int(2.5 * first.stat().st_size))
    compile_and_load(sources[2], _seven)
    assert first.exists()
    assert not second.exists()
    assert not second.with_suffix(".sha256").exists()


def test_a_missing_compiler_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(code_cache, "compiler", code_cache.compiler.__wrapped__)
    monkeypatch.setattr(code_cache, "_zig", lambda: None)
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CompilationError, match="there is no C compiler"):
        compile_and_load(SEVEN, _seven)


@pytest.mark.parametrize("named", ["nothing-of-this-name", "'an open quotation"])
def test_a_compiler_that_the_environment_names_and_that_is_not_there_is_not_replaced(
    monkeypatch: pytest.MonkeyPatch, named: str
) -> None:
    monkeypatch.setenv("CC", named)
    assert code_cache.compiler.__wrapped__() is None


def test_without_cc_the_compiler_of_the_package_ziglang_is_taken(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, folder: Path
) -> None:
    """Its cc takes the same options; a script in its place, because it has 400 MB."""
    zig, seen = tmp_path / "zig", tmp_path / "seen"
    script = f'echo "$1 $ZIG_GLOBAL_CACHE_DIR" >> {seen}; shift; exec {shutil.which("cc")} "$@"'
    _write_program(zig, script)
    monkeypatch.setattr(code_cache, "_zig", lambda: str(zig))
    monkeypatch.delenv("CC", raising=False)
    usual = code_cache.compiler.__wrapped__()
    assert Path(usual.command[0]).name == "cc"
    monkeypatch.setattr(code_cache, "compiler", code_cache.compiler.__wrapped__)
    which = shutil.which
    monkeypatch.setattr(shutil, "which", lambda name, **more: None if name == "cc" else which(name))
    monkeypatch.delenv("ZIG_GLOBAL_CACHE_DIR", raising=False)
    assert compile_and_load(SEVEN, _seven)[0] == 7
    # What it keeps for later, some of it without bounds, goes with its work.
    command, own = seen.read_text().split()
    assert (command, Path(own).parent) == ("cc", folder)
    assert not Path(own).exists()
    assert code_cache.clear()[0] == 1
    assert not list(folder.iterdir())


@pytest.mark.stress
def test_code_of_the_package_ziglang_computes_what_that_of_cc_does(
    monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    pytest.importorskip("ziglang", reason="ziglang is not installed")
    mechanism = srm.load("four_bar")
    expected = srm.simulate(mechanism, 2.0, backend="generated")
    script = (
        "import srm_mbs as srm; s = srm.simulate(srm.load('four_bar'), 2.0, backend='generated');"
        "print(s.settings.backend, *s.q[-1])"
    )
    hidden = os.environ | {"PATH": str(folder)}
    done = subprocess.run(
        [sys.executable, "-c", script], env=hidden, capture_output=True, text=True, check=True
    )
    by, *q = done.stdout.split()
    assert by == "generated"
    assert np.abs(np.array(q, dtype=float) - expected.q[-1]).max() < 1e-9


def test_the_last_line_of_a_compiler_that_fails_is_the_reason(program: Path) -> None:
    _write_program(program, "echo first >&2; echo cannot do it >&2; exit 3")
    with pytest.raises(CompilationError, match=r"compiler failed: cannot do it"):
        compile_and_load(SEVEN, _seven)


def test_a_compiler_may_be_named_relative_to_the_folder_of_the_program(
    program: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It runs in the folder of its work."""
    _write_program(program, f'exec {shutil.which("cc")} "$@"')
    monkeypatch.chdir(program.parent)
    monkeypatch.setenv("CC", f"./{program.name}")
    assert compile_and_load(SEVEN, _seven)[0] == 7


def test_warnings_of_a_compiler_do_not_matter(program: Path) -> None:
    loud = "i=0; while [ $i -lt 3000 ]; do echo warning: $i; echo warning: $i >&2; i=$((i+1)); done"
    _write_program(program, f'{loud}\nexec {shutil.which("cc")} "$@"')
    assert compile_and_load(SEVEN, _seven)[0] == 7


def test_a_compiler_that_makes_nothing_has_failed(program: Path) -> None:
    _write_program(program, "exit 0")
    with pytest.raises(CompilationError, match="failed: no message"):
        compile_and_load(SEVEN, _seven)


def test_a_compiler_that_makes_rubbish_has_failed(program: Path) -> None:
    _write_program(program, 'while [ "$1" != -o ]; do shift; done; echo rubbish > "$2"')
    with pytest.raises(CompilationError, match="cannot be loaded"):
        compile_and_load(SEVEN, _seven)


def test_a_compiler_that_hangs_is_ended_with_its_children(program: Path, tmp_path: Path) -> None:
    mark = tmp_path / "child"
    _write_program(program, f"(sleep 1.5; touch {mark}) & sleep 60")
    started = time.perf_counter()
    with pytest.raises(CompilationError, match=r"made nothing within 0\.3 s"):
        compile_and_load(SEVEN, _seven, patience=0.3)
    assert time.perf_counter() - started < 5.0
    time.sleep(2.0)
    assert not mark.exists()


def test_units_are_compiled_at_the_same_time_and_linked(program: Path, tmp_path: Path) -> None:
    """Each compiler waits until the other one is at work."""
    started = tmp_path / "started"
    wait = f"echo >> {started}; until [ $(wc -l < {started}) -ge 2 ]; do sleep 0.01; done"
    real = shutil.which("cc")
    _write_program(program, f'case "$*" in *" -c "*) {wait};; esac; exec {real} "$@"')
    value, made = compile_and_load(IN_TWO_UNITS, _seven, 2, patience=60.0)
    assert (value, made.seconds > 0.0) == (7, True)
    assert started.read_text() == "\n\n"


@pytest.mark.parametrize("failing", ["/1.c", "/2.c", "-shared"])
def test_each_unit_and_their_link_may_fail(program: Path, folder: Path, failing: str) -> None:
    cannot = f'case "$*" in *{failing}*) echo cannot do it >&2; exit 3;; esac'
    _write_program(program, f'{cannot}; exec {shutil.which("cc")} "$@"')
    with pytest.raises(CompilationError, match="compiler failed: cannot do it"):
        compile_and_load(IN_TWO_UNITS, _seven, 2)
    assert not list(folder.iterdir())


@pytest.mark.stress
@pytest.mark.parametrize("hanging", ["/1.c", "/2.c", "-shared"])
def test_each_unit_and_their_link_may_hang(
    program: Path, folder: Path, tmp_path: Path, hanging: str
) -> None:
    mark, seen = tmp_path / "child", tmp_path / "seen"
    hangs = f"(sleep 3; touch {mark}) & echo $$ > {seen}; sleep 60"
    script = f'case "$*" in *{hanging}*) {hangs};; esac; exec {shutil.which("cc")} "$@"'
    _write_program(program, script)
    with pytest.raises(CompilationError, match="made nothing within 2 s"):
        compile_and_load(IN_TWO_UNITS, _seven, 2, patience=2.0)
    assert not Path(f"/proc/{seen.read_text().strip()}").exists()
    assert not list(folder.iterdir())
    time.sleep(1.5)
    assert not mark.exists()


def test_another_compiler_does_not_take_the_code_of_the_first(program: Path) -> None:
    real = shutil.which("cc")
    _write_program(program, f'exec {real} "$@"')
    assert compile_and_load(SEVEN, _seven)[1].seconds > 0.0
    assert compile_and_load(SEVEN, _seven)[1].seconds == 0.0
    _write_program(program, f'# another version\nexec {real} "$@"')
    assert compile_and_load(SEVEN, _seven)[1].seconds > 0.0


@pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}")
def test_compile_says_how_it_was_made_and_cache_clears_it(folder: Path) -> None:
    assert "operations, " in run("compile", "four_bar")
    made = "import srm_mbs as srm; print(srm.compile(srm.load('four_bar')))"
    apart = [
        subprocess.run([sys.executable, "-c", made], capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    assert "found" in apart[1].stdout
    assert int(row(run("cache"), "compiled mechanisms")) >= 1
    assert row(run("cache"), "folder") == str(folder)
    run("cache", "--clear")
    assert row(run("cache"), "compiled mechanisms") == "0"
    assert not list(folder.iterdir())


def test_source_is_printed_and_not_compiled(folder: Path) -> None:
    source = run("compile", "four_bar", "--source")
    assert "int srm_mbs_terms(" in source
    assert "turn_all(&(angles){" in source
    assert not folder.exists()


def test_wrong_arguments_of_compile_are_refused() -> None:
    with pytest.raises(srm.InputError, match="Mechanism"):
        srm.compile("four_bar")  # type: ignore[arg-type]
