"""Every file is read and parsed once per load; the mechanism is made and analysed once."""

from __future__ import annotations

import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import networkx  # noqa: F401 - its import reads files, which do not count
import numpy as np
import pytest
import yaml
from defusedxml import ElementTree as SafeTree

import srm_mbs as srm
from srm_mbs.dynamics.constraints import structure
from srm_mbs.formats import csv_table
from srm_mbs.formats import files as reading
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

    count(reading, "open_regular", lambda path, *_: Path(path).name)
    count(csv_table, "read_csv", lambda path: path.name)
    for owner, name, language in (
        (tomllib, "loads", "TOML"),
        (SafeTree.DefusedXMLParser, "close", "XML"),
        (yaml, "load", "YAML"),
    ):
        count(owner, name, lambda *_, language=language: language)
    count(srm.Mechanism, "__post_init__", lambda *_: "mechanism")
    return found


# Case: the files, of which the first is loaded, and the languages that are parsed.
FILES: dict[str, tuple[dict[str, str], tuple[str, ...]]] = {
    "a URDF": ({"robot.urdf": tree()}, ("XML",)),
    "a URDF with a coupling": (
        {"coupled.urdf": tree(joints={"knee": '<mimic joint="hip"/>'})},
        ("XML",),
    ),
    "an SDF": ({"robot.sdf": sdf_files.four_bar()}, ("XML",)),
    "an MJCF": ({"robot.xml": FOUR_BAR}, ("XML",)),
    "a description and the files it names": (
        {"robot.toml": DRIVEN, "robot.urdf": tree(), "motion.csv": TABLE},
        ("TOML", "XML"),
    ),
    "a description of an SDF": (
        {"robot.toml": 'format = 1\nsdf = "robot.sdf"\n', "robot.sdf": sdf_files.four_bar()},
        ("TOML", "XML"),
    ),
    "a Gepetto file": ({"robot.yaml": GEPETTO, "robot.urdf": tree()}, ("YAML", "XML")),
}


@pytest.mark.parametrize("case", FILES)
def test_every_file_is_read_and_parsed_once(
    case: str, tmp_path: Path, counted: Counter[Any]
) -> None:
    files, languages = FILES[case]
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    srm.load(tmp_path / next(iter(files)))
    assert counted == dict.fromkeys((*files, *languages, "mechanism"), 1)


def test_a_bundled_description_is_parsed_once(counted: Counter[Any]) -> None:
    srm.load("four_bar")
    assert counted == dict.fromkeys(
        ("four_bar.toml", "four_bar.urdf", "TOML", "XML", "mechanism"), 1
    )


def test_a_conversion_parses_its_file_once(tmp_path: Path, counted: Counter[Any]) -> None:
    (tmp_path / "robot.sdf").write_text(sdf_files.four_bar())
    srm.convert(tmp_path / "robot.sdf", tmp_path / "out.toml")
    assert counted == {"robot.sdf": 1, "XML": 1, "mechanism": 1}


@pytest.mark.parametrize("more", ["", "v = { a = 1.0 }\n"])
def test_loops_are_analysed_where_they_are_closed(
    more: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once, from an open guess too; given rates are where the walks of the analysis begin."""
    analysed = []
    analyse = structure.analyse

    def recorded(mechanism: Any) -> Any:
        analysed.append(mechanism)
        return analyse(mechanism)

    monkeypatch.setattr(structure, "analyse", recorded)
    (tmp_path / "robot.sdf").write_text(sdf_files.four_bar())
    guess = "[initial]\nguess = { a = 0.5, b = 1.0 }\n"
    (tmp_path / "robot.toml").write_text(f'format = 1\nsdf = "robot.sdf"\n{guess}{more}')
    mechanism = srm.load(tmp_path / "robot.toml")
    assert mechanism.structure.rank == 2
    assert len(analysed) == 1
    assert np.array_equal(analysed[0].v0, mechanism.v0)
    for each in analysed:
        assert np.abs(each.initial_errors[0]).max() < 1e-11
