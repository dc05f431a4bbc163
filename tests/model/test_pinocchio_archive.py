"""Archives of Pinocchio are read by another process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.model import pinocchio_archive
from srm_mbs.model.pinocchio_archive import model_from_archive


def test_the_model_of_an_archive_is_the_one_that_was_written() -> None:
    model = srm.load("stewart_platform").model

    assert model_from_archive(model.saveToString()) == model


def test_an_archive_whose_indices_are_not_those_of_its_joints_is_refused() -> None:
    model = srm.load("four_bar").model
    for name in ("idx_qs", "nvs", "idx_vs", "parents"):
        changed = pin.Model(model)
        getattr(changed, name)[2] = 7
        with pytest.raises(srm.InputError, match="the archive of its model is damaged: "):
            model_from_archive(changed.saveToString())


@pytest.mark.parametrize("text", ["", "22 serialization::archive", "x" * 1000])
def test_a_text_that_is_no_archive_is_refused(text: str) -> None:
    with pytest.raises(srm.InputError, match="the archive of its model is damaged"):
        model_from_archive(text)


def test_a_crash_of_the_reading_process_is_an_error_of_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "a" / "b" / "crash.py"
    program.parent.mkdir(parents=True)
    program.write_text("import os\nos.abort()\n")
    monkeypatch.setattr(pinocchio_archive, "__file__", str(program))

    with pytest.raises(srm.InputError, match=r"reading it ends with status -?\d+"):
        model_from_archive("text")


def test_the_reading_process_executes_nothing_of_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("json", "numpy", "pinocchio", "resource", "sitecustomize"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'executed')!r}, 'w')\n")
    model = srm.load("four_bar").model
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", ".")
    monkeypatch.syspath_prepend("")

    assert model_from_archive(model.saveToString()) == model
    assert not (tmp_path / "executed").exists()


def test_a_process_that_takes_too_long_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*arguments: Any, timeout: float, **options: Any) -> Any:
        raise subprocess.TimeoutExpired(sys.executable, timeout)

    monkeypatch.setattr(subprocess, "run", never)
    with pytest.raises(srm.InputError, match="takes more than 60 s"):
        model_from_archive("text")
