"""Every file is read and parsed once per load, and the mechanism is constructed once."""

from __future__ import annotations

import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import yaml
from defusedxml import ElementTree as SafeTree

import srm_mbs as srm
from srm_mbs.formats import csv_table
from srm_mbs.formats.load import models_folder
from tests.support import sdf_files
from tests.support.mjcf_files import FOUR_BAR
from tests.support.urdf_files import tree

GEPETTO = "joint_name: [hip]\njoint_type: [SPHERICAL]\nname_mot: [knee]\n"
DRIVEN = """format = 1
urdf = "robot.urdf"
[[drive]]
joint = "hip"
type = "table"
table = "motion.csv"
value = "hip"
[[force]]
type = "wrench"
at = { link = "rim" }
table = "motion.csv"
"""
TABLE = "t,hip,fx\n" + "".join(f"{k / 10},0.0,{k}.0\n" for k in range(6))


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counter[Any]:
    """Files that were read, by name, and texts that were parsed, by language."""
    found: Counter[Any] = Counter()

    def count(owner: Any, name: str, key: Any) -> None:
        call = getattr(owner, name)

        def counting(*args: Any, **options: Any) -> Any:
            found[key(*args)] += 1
            return call(*args, **options)

        monkeypatch.setattr(owner, name, counting)

    count(Path, "read_text", lambda path, *_: path.name)
    count(csv_table, "read_csv", lambda path: path.name)
    for owner, name, language in (
        (tomllib, "loads", "TOML"),
        (SafeTree, "fromstring", "XML"),
        (yaml, "safe_load", "YAML"),
    ):
        count(owner, name, lambda *_, language=language: language)
    count(srm.Mechanism, "__post_init__", lambda *_: "mechanism")
    return found


ONE_FILE = {
    "robot.urdf": tree(),
    "coupled.urdf": tree(joints={"knee": '<mimic joint="hip"/>'}),
    "robot.sdf": sdf_files.four_bar(),
    "robot.xml": FOUR_BAR,
}


@pytest.mark.parametrize("name", ONE_FILE)
def test_a_model_file_is_read_and_parsed_once(
    name: str, tmp_path: Path, counted: Counter[Any]
) -> None:
    (tmp_path / name).write_text(ONE_FILE[name])
    srm.load(tmp_path / name)
    assert counted == {name: 1, "XML": 1, "mechanism": 1}


def test_a_description_and_the_files_it_names_are_read_once(
    tmp_path: Path, counted: Counter[Any]
) -> None:
    (tmp_path / "robot.urdf").write_text(tree())
    (tmp_path / "robot.toml").write_text(DRIVEN)
    (tmp_path / "motion.csv").write_text(TABLE)
    srm.load(tmp_path / "robot.toml")
    files = ("robot.toml", "robot.urdf", "motion.csv")
    assert counted == dict.fromkeys((*files, "TOML", "XML", "mechanism"), 1)


def test_a_bundled_description_is_parsed_once(counted: Counter[Any]) -> None:
    srm.load("four_bar")
    assert (models_folder() / "four_bar.toml").is_file()
    assert counted == dict.fromkeys(
        ("four_bar.toml", "four_bar.urdf", "TOML", "XML", "mechanism"), 1
    )


def test_a_description_of_an_sdf_file_is_parsed_once(tmp_path: Path, counted: Counter[Any]) -> None:
    (tmp_path / "robot.sdf").write_text(sdf_files.four_bar())
    (tmp_path / "robot.toml").write_text('format = 1\nsdf = "robot.sdf"\n')
    srm.load(tmp_path / "robot.toml")
    assert counted == dict.fromkeys(("robot.toml", "robot.sdf", "TOML", "XML", "mechanism"), 1)


def test_a_gepetto_file_and_its_urdf_are_parsed_once(tmp_path: Path, counted: Counter[Any]) -> None:
    (tmp_path / "robot.urdf").write_text(tree())
    (tmp_path / "robot.yaml").write_text(GEPETTO)
    srm.load(tmp_path / "robot.yaml")
    assert counted == dict.fromkeys(("robot.yaml", "robot.urdf", "YAML", "XML", "mechanism"), 1)


def test_a_conversion_parses_its_file_once(tmp_path: Path, counted: Counter[Any]) -> None:
    (tmp_path / "robot.sdf").write_text(sdf_files.four_bar())
    srm.convert(tmp_path / "robot.sdf", tmp_path / "out.toml")
    assert counted == {"robot.sdf": 1, "XML": 1, "mechanism": 1}
