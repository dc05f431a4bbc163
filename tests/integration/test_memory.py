"""The memory that is left for the steps of a run."""

from __future__ import annotations

from pathlib import Path

import pytest

from srm_mbs.integration import memory

AVAILABLE = "MemTotal:        8000000 kB\nMemAvailable:    2000000 kB\n"


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with 2.048 GB left, whose control groups are in ``groups``."""
    for name, file in (("MEMINFO", "meminfo"), ("GROUPS", "cgroup"), ("GROUP_ROOT", "groups")):
        monkeypatch.setattr(memory, name, tmp_path / file)
    (tmp_path / "meminfo").write_text(AVAILABLE)
    (tmp_path / "groups").mkdir()
    return tmp_path


def group(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / f"memory.{name}").write_text(text)


def test_without_control_groups_it_is_what_the_machine_has_available(machine: Path) -> None:
    assert memory.free_memory() == 2.048e9


def test_a_container_leaves_its_limit_less_its_use_but_for_files_that_can_be_read_again(
    machine: Path,
) -> None:
    (machine / "cgroup").write_text("0::/\n")
    group(machine / "groups", max="1000000000\n", current="400000000\n")
    (machine / "groups" / "memory.stat").write_text("anon 300000000\ninactive_file 100000000\n")
    assert memory.free_memory() == 7e8


def test_the_group_of_the_program_limits_it_too(machine: Path) -> None:
    (machine / "cgroup").write_text("5:cpu:/\n4:memory:/user/run:1\n")
    own = machine / "groups" / "memory" / "user" / "run:1"
    group(own, limit_in_bytes="500000000\n", usage_in_bytes="100000000\n")
    (own / "memory.stat").write_text("total_inactive_file 0\n")
    assert memory.free_memory() == 4e8


def test_a_group_without_a_limit_leaves_what_the_machine_has(machine: Path) -> None:
    (machine / "cgroup").write_text("0::/\n")
    group(machine / "groups", max="max\n", current="400000000\n", stat="inactive_file 0\n")
    assert memory.free_memory() == 2.048e9


def test_where_the_system_does_not_say_it_is_half_of_the_memory_of_the_machine(
    machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (machine / "meminfo").unlink()
    pages = {"SC_PHYS_PAGES": 1000, "SC_PAGE_SIZE": 4096}
    monkeypatch.setattr(memory.os, "sysconf", pages.__getitem__, raising=False)
    assert memory.free_memory() == 0.5 * 4096000.0
    monkeypatch.delattr(memory.os, "sysconf")
    assert memory.free_memory() == float("inf")
