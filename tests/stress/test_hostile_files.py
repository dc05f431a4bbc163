"""Files that are made to exhaust time or memory, or to reach other files: each is refused with a
message within two seconds of CPU time and 500 MB."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.stress.isolation import ROOT
from tests.support.urdf_files import tree

pytestmark = [
    pytest.mark.stress,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of memory by /proc"),
]
SECONDS = 2.0
"""CPU time of a refusal."""
LONG = 10**6
Case = Callable[[Path], str]
"""Writes files into a folder and returns the name of the one to load."""


def _write(folder: Path, **files: str | bytes) -> None:
    """Files by name, with ``__`` for the dot."""
    for name, content in files.items():
        data = content.encode() if isinstance(content, str) else content
        (folder / name.replace("__", ".")).write_bytes(data)


def _one(name: str, content: Callable[[], str | bytes]) -> Case:
    def write(folder: Path) -> str:
        _write(folder, **{name.replace(".", "__"): content()})
        return name

    return write


def _described(more: str, **files: str | bytes) -> Case:
    """A description of a good URDF, with ``more``."""

    def write(folder: Path) -> str:
        _write(folder, robot__urdf=tree(), robot__toml=f'format = 1\nurdf = "robot.urdf"\n{more}')
        _write(folder, **files)
        return "robot.toml"

    return write


DRIVE = '[[drive]]\njoint = "hip"\ntype = "table"\ntable = "{}"\n'
BODY = '<worldbody><body name="b"><joint/><geom type="sphere" size="1"/></body></worldbody>'
SDF_LINK = (
    '<link name="l"><inertial><mass>1</mass><inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz>'
    "</inertia></inertial></link>"
)
LOOP = '[[loop]]\nname = "l{}"\ntype = "point"\na = {{ link = "shin" }}\nb = {{ link = "rim" }}\n'


def _special(content: Callable[[str], Case]) -> dict[str, Case]:
    """The same with a device and with a pipe."""

    def piped(folder: Path) -> str:
        os.mkfifo(folder / "pipe")
        return content("pipe")(folder)

    return {"/dev/zero": content("/dev/zero"), "a pipe": piped}


def _link(suffix: str) -> Callable[[str], Case]:
    """The model file itself is a link to a device, or a pipe."""

    def case(name: str) -> Case:
        def write(folder: Path) -> str:
            (folder / f"model{suffix}").symlink_to(name if name[0] == "/" else folder / name)
            return f"model{suffix}"

        return write

    return case


def _mjcf_include(name: str) -> Case:
    return _one("m.xml", lambda: f'<mujoco><include file="{name}"/>{BODY}</mujoco>')


def _sdf_include(name: str) -> Case:
    inner = f"<model name='m'>{SDF_LINK}<include><uri>{name}</uri></include></model>"
    return _one("m.sdf", lambda: f"<sdf version='1.9'>{inner}</sdf>")


def _mesh(name: str) -> Case:
    asset = f'<asset><mesh name="m" inertia="exact" file="{name}"/></asset>'
    body = '<body name="b"><joint/><geom type="mesh" mesh="m"/></body>'
    text = f"<mujoco>{asset}<worldbody>{body}</worldbody></mujoco>"
    return _one("m.xml", lambda: text)


def _sdf_circle(folder: Path) -> str:
    for k in range(20):
        both = "".join(
            f"<include><uri>m{i}.sdf</uri><name>n{i}{j}</name></include>"
            for j, i in enumerate(((k + 1) % 20, (k + 7) % 20))
        )
        text = f"<sdf version='1.9'><model name='m{k}'>{SDF_LINK}{both}</model></sdf>"
        (folder / f"m{k}.sdf").write_text(text)
    return "m0.sdf"


def _mjcf_circle(folder: Path) -> str:
    for k in range(20):
        both = "".join(f'<include file="m{i % 20}.xml"/>' for i in (k + 1, k + 7))
        (folder / f"m{k}.xml").write_text(f"<mujoco>{both}{BODY}</mujoco>")
    return "m0.xml"


def _replicated(opened: str) -> str:
    """An MJCF file with a body in the replicates that ``opened`` begins."""
    closed = "</replicate>" * opened.count("<")
    body = '<body name="b"><joint name="j"/><geom size="0.1"/></body>'
    return f"<mujoco><worldbody>{opened}{body}{closed}</worldbody></mujoco>"


def _sparse(folder: Path) -> str:
    with (folder / "robot.urdf").open("wb") as file:
        file.write(b'<robot name="r">')
        file.truncate(10**12)
    return "robot.urdf"


def _billion(folder: Path) -> str:
    entities = "".join(f'<!ENTITY e{k + 1} "{f"&e{k};" * 10}">' for k in range(10))
    text = f'<!DOCTYPE robot [<!ENTITY e0 "ha">{entities}]><robot name="&e10;"/>'
    (folder / "robot.urdf").write_text(text)
    return "robot.urdf"


def _named(name: str) -> str:
    return tree().replace("thigh", name)


CASES: dict[str, Case] = {
    **{f"model: {k}": v for k, v in _special(_link(".urdf")).items()},
    **{f"description: {k}": v for k, v in _special(_link(".toml")).items()},
    **{
        f"urdf of a description: {k}": v
        for k, v in _special(
            lambda name: _one("m.toml", lambda: f'format = 1\nurdf = "{name}"\n')
        ).items()
    },
    **{f"table: {k}": v for k, v in _special(lambda n: _described(DRIVE.format(n))).items()},
    **{f"MJCF include: {k}": v for k, v in _special(_mjcf_include).items()},
    **{f"SDF include: {k}": v for k, v in _special(_sdf_include).items()},
    **{f"mesh of MJCF: {k}": v for k, v in _special(_mesh).items()},
    "SDF files that include each other twice": _sdf_circle,
    "MJCF files that include each other twice": _mjcf_circle,
    "24,000 bodies by a replicate": _one("m.xml", lambda: _replicated('<replicate count="24000">')),
    "replicates of replicates": _one("m.xml", lambda: _replicated('<replicate count="300">' * 250)),
    "100,000 dotted keys in one": _one("m.toml", lambda: "format = 1\n" + "a." * 10**5 + "b = 1\n"),
    "100,000 dotted keys in a header": _one(
        "m.toml", lambda: "format = 1\n[" + "'a' . " * 10**5 + "b]\n"
    ),
    "100,000 dotted keys in lines": _one(
        "m.toml", lambda: "format = 1\n" + "".join(f"a.b.c{k} = 1\n" for k in range(10**5))
    ),
    "nested lists of TOML": _one("m.toml", lambda: "format = 1\nx = " + "[" * 10**5),
    "nested tables of TOML": _one("m.toml", lambda: "format = 1\nx = " + "{a=" * 10**5),
    "an attribute of 100 MB": _one(
        "robot.urdf", lambda: b'<robot name="' + b"a" * 10**8 + b'"><link name="l"/></robot>'
    ),
    "an attribute of 60 MB": _one(
        "robot.urdf", lambda: b'<robot name="' + b"a" * (6 * 10**7) + b'"><link name="l"/></robot>'
    ),
    "a terabyte of zeros": _sparse,
    "a billion laughs": _billion,
    "10 million elements": _one(
        "robot.urdf", lambda: '<robot name="r">' + "<a/>" * 10**7 + "</robot>"
    ),
    "5 million attributes": _one(
        "robot.urdf", lambda: "<robot " + "".join(f'a{k}="" ' for k in range(5 * 10**6)) + "/>"
    ),
    "elements in each other": _one("robot.urdf", lambda: "<robot>" * 10**6),
    "elements in each other that are closed": _one(
        "robot.urdf", lambda: "<robot>" * 10**5 + "</robot>" * 10**5
    ),
    "blank lines before nothing": _one("robot.urdf", lambda: "\n" * 40 + "<"),
    "a million blank lines": _one("robot.txt", lambda: "\n" * LONG),
    "blank lines and comments": _one("robot.urdf", lambda: "\n<!-- -->" * 10**5 + "<"),
    "comments that do not end": _one("robot.urdf", lambda: "<!--" * LONG),
    "doctypes": _one("robot.urdf", lambda: "<!DOCTYPE [" * LONG),
    "keys of Gepetto": _one("robot.yaml", lambda: "type" + " " * LONG + "\n" + "type\n" * 10**5),
    "joints of Gepetto": lambda folder: (
        _write(
            folder,
            robot__urdf=tree(),
            robot__yaml="joint_name: ["
            + "hip, " * 10**5
            + "]\njoint_type: ["
            + "FIXED, " * 10**5
            + "]\n",
        )
        or "robot.yaml"
    ),
    "anchors of YAML": _one(
        "robot.yaml",
        lambda: (
            "type: &a0 [x]\n" + "".join(f"k{k}: &a{k + 1} [*a{k}, *a{k}]\n" for k in range(100))
        ),
    ),
    "nested lists of YAML": _one("robot.yaml", lambda: "type: " + "[" * 10**5),
    "3,000 identical loops": _described("".join(LOOP.format(k) for k in range(3000))),
    "3,000 identical loops without names": _described(
        "".join(LOOP.replace('name = "l{}"\n', "").format() for _ in range(3000))
    ),
    "a long name in a URDF": _one("robot.urdf", lambda: _named("n" * LONG)),
    "a long name in TOML": _described(LOOP.format("n" * LONG)),
    "a long key": _described("n" * LONG + " = 1\n"),
    "a long link in TOML": _described(LOOP.format(1).replace("shin", "n" * LONG)),
    "a long name in SDF": _one(
        "m.sdf",
        lambda: f"<sdf version='1.9'><model name='{'m' * LONG}'>{SDF_LINK}</model></sdf>",
    ),
    "a long name in MJCF": _one(
        "m.xml", lambda: f"<mujoco>{BODY}</mujoco>".replace('"b"', f'"{"b" * LONG}"')
    ),
    "a long name in YAML": lambda folder: (
        _write(
            folder,
            robot__urdf=tree(),
            robot__yaml=f"joint_name: [{'n' * LONG}]\njoint_type: [FIXED]\n",
        )
        or "robot.yaml"
    ),
    "a long path": _one("m.toml", lambda: f'format = 1\nurdf = "{"u" * LONG}"\n'),
    "a long tag": _one("robot.urdf", lambda: f"<{'r' * LONG}/>"),
    "a long column": _described(DRIVE.format("t.csv"), t__csv="n" * LONG + ",value\n1,2\n"),
    "a long line in a table": _described(DRIVE.format("t.csv"), t__csv="t,value\n" + "1," * 10**7),
    "a long cell": _described(DRIVE.format("t.csv"), t__csv='t,value\n"' + "1" * 10**7),
    "control characters in a name": _described(LOOP.format("a\\u001b[2Jb")),
    "a description of 60 MB": _one("m.toml", lambda: "format = 1\n" + "#\n" * (3 * 10**7)),
    "a chain that is no tree": _one(
        "robot.urdf",
        lambda: (
            '<robot name="r">'
            + "".join(f'<link name="l{k}"/>' for k in range(20_000))
            + "".join(
                f'<joint name="j{k}" type="fixed"><parent link="l{k}"/>'
                f'<child link="l{k + 1}"/></joint>'
                for k in range(19_999)
            )
            + '<loop name="x" type="point"><predecessor link="l0"/>'
            + '<successor link="l19999"/></loop>'
            + "</robot>"
        ),
    ),
}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """What became of each case, by its name."""
    paths = {}
    for k, (name, write) in enumerate(CASES.items()):
        folder = tmp_path_factory.mktemp(f"hostile{k}")
        paths[str(folder / write(folder))] = name
    done = subprocess.run(
        [sys.executable, "-m", "tests.stress.hostile_load"],
        cwd=ROOT,
        input="\n".join(paths),
        capture_output=True,
        text=True,
        check=True,
    )
    found = map(json.loads, done.stdout.splitlines())
    return {paths[outcome["path"]]: outcome for outcome in found}


@pytest.mark.parametrize("case", CASES)
def test_a_hostile_file_is_refused_soon(case: str, outcomes: dict[str, dict[str, Any]]) -> None:
    outcome = outcomes[case]
    assert outcome["is"] == "refused", outcome["message"]
    assert outcome["seconds"] < SECONDS
    assert len(outcome["message"]) < 5000
