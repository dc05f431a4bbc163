"""``[[override]]``: a joint or link changed is the same as a URDF with the numbers typed in."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.formats import build
from srm_mbs.formats.load import models_folder
from tests.support.snapshots import check_refusals

DESCRIPTION = """format = 1
urdf = "{urdf}"
[parameters]
longer = 1.1
[[override]]
joint = "coupler"
scale = "=longer"
[[override]]
link = "crank"
scale = "=longer"
inertia_scale = "=longer**2"
xyz = ["=0.5*(longer - 1)", 0, 0]
[[override]]
link = "coupler"
mass = 0.5
inertia = [0, 0, 0, 0.125, 0, 0.125]
[[override]]
joint = "rocker"
xyz = [0.05, 0, 0]
[[loop]]
name = "pin"
type = "point"
a = {{ link = "coupler", xyz = [2.0, 0.0, 0.0] }}
b = {{ link = "rocker", xyz = [1.5, 0.0, 0.0] }}
[initial]
q = {{ crank = 1.0 }}
v = {{ crank = 4.0 }}
guess = {{ coupler = -0.674, rocker = 1.413 }}
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    urdf = models_folder().parent / "urdf" / "four_bar.urdf"
    (tmp_path / "four_bar.urdf").write_text(urdf.read_text(encoding="utf-8"), encoding="utf-8")
    path = tmp_path / "bars.toml"
    path.write_text(DESCRIPTION.format(urdf="four_bar.urdf"), encoding="utf-8")
    return path


@pytest.mark.parametrize("longer", [1.0, 1.1, 1.25])
def test_a_changed_file_has_the_scaled_places_and_inertias(file: Path, longer: float) -> None:
    plain, found = srm.load("four_bar"), srm.load(file, parameters={"longer": longer})
    joint = {name: plain.model.getJointId(name) for name in plain.joint_names}
    for name, shift in {"crank": 0.0, "coupler": 0.0, "rocker": 0.05}.items():
        factor = longer if name == "coupler" else 1.0
        before = plain.model.jointPlacements[joint[name]].translation
        after = found.model.jointPlacements[joint[name]].translation
        np.testing.assert_allclose(after, factor * before + [shift, 0, 0], rtol=1e-15)
    before, after = (each.model.inertias[joint["crank"]] for each in (plain, found))
    assert after.mass == pytest.approx(longer * before.mass, rel=1e-15)
    np.testing.assert_allclose(after.inertia, longer**3 * before.inertia, rtol=1e-14, atol=1e-16)
    moved = before.lever + np.array([0.5 * (longer - 1), 0.0, 0.0])
    np.testing.assert_allclose(after.lever, moved, rtol=1e-15)
    before, after = (each.model.inertias[joint["coupler"]] for each in (plain, found))
    assert after.mass == before.mass + 0.5
    np.testing.assert_allclose(after.inertia, before.inertia + np.diag([0, 0.125, 0.125]))


def test_a_variant_is_the_mechanism_of_a_load_bit_by_bit_without_reading_the_file(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = srm.load(file)
    fresh = srm.load(file, parameters={"longer": 1.2})
    with monkeypatch.context() as patched:
        patched.setattr(build, "build_urdf", None)
        variant = pickle.loads(pickle.dumps(base)).with_parameters(longer=1.2)
    assert variant.model == fresh.model
    for one, other in zip(variant.model.inertias, fresh.model.inertias):
        assert np.array_equal(one.toDynamicParameters(), other.toDynamicParameters())
    for name in ("loops", "points", "notes", "source", "parameters"):
        assert getattr(variant, name) == getattr(fresh, name), name
    for name in ("q0", "v0"):
        assert np.array_equal(getattr(variant, name), getattr(fresh, name))


@pytest.mark.parametrize("longer", [0.0, -1.0, 1e200])
def test_a_variant_with_a_fault_is_refused_as_a_load_is(file: Path, longer: float) -> None:
    base = srm.load(file)
    refusals = []
    for make in (
        lambda: base.with_parameters(longer=longer),
        lambda: srm.load(file, parameters={"longer": longer}),
    ):
        with pytest.raises(srm.SrmError) as refused:
            make()
        refusals.append(str(refused.value))
    assert refusals[0] == refusals[1]


def test_a_variant_and_a_conversion_have_the_changed_numbers(file: Path, tmp_path: Path) -> None:
    variant = srm.load(file).with_parameters(longer=1.2)
    wanted = srm.load(file, parameters={"longer": 1.2})
    assert variant.model == wanted.model
    srm.convert(file, tmp_path / "out.toml", parameters={"longer": 1.2})
    converted = srm.load(tmp_path / "out.toml")
    assert converted.model == wanted.model
    assert "override" not in (tmp_path / "out.toml").read_text(encoding="utf-8")
    solution = srm.simulate(variant, 0.2)
    solution.save(tmp_path / "run.npz")
    assert srm.load_solution(tmp_path / "run.npz").mechanism.model == wanted.model


def test_a_link_that_grows_with_its_joints_is_the_same_mechanism_in_other_units(
    file: Path, tmp_path: Path
) -> None:
    """Lengths and masses times 4: a pendulum four times as long swings half as fast."""
    urdf = """<robot name="p"><link name="base"/><link name="rod"><inertial>
    <origin xyz="0 0 -1"/><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0"
    iyz="0"/></inertial></link><joint name="hinge" type="revolute"><parent link="base"/>
    <child link="rod"/><axis xyz="0 1 0"/><limit effort="1" velocity="1"/></joint></robot>"""
    (tmp_path / "p.urdf").write_text(urdf, encoding="utf-8")
    text = 'format = 1\nurdf = "p.urdf"\n[initial]\nq = { hinge = 0.6 }\n'
    longer = '[[override]]\nlink = "rod"\nscale = 4.0\ninertia_scale = 16.0\nxyz = [0, 0, -3.0]\n'
    runs = []
    for name, more, end in (("one", "", 1.0), ("four", longer, 2.0)):
        (tmp_path / f"{name}.toml").write_text(text + more, encoding="utf-8")
        runs.append(srm.simulate(srm.load(tmp_path / f"{name}.toml"), end, rtol=1e-11).q[-1])
    assert np.abs(runs[0] - runs[1]).max() < 1e-9


def test_messages_about_overrides(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(file.parent)
    text = file.read_text(encoding="utf-8")

    def loading(entry: str) -> object:
        def refused() -> None:
            file.write_text(text + "[[override]]\n" + entry, encoding="utf-8")
            srm.load(file.name)

        return refused

    entries = {
        "no element": "scale = 2.0\n",
        "two elements": 'joint = "crank"\nlink = "crank"\n',
        "an unknown joint": 'joint = "cranc"\n',
        "an unknown link": 'link = "cranc"\n',
        "twice": 'link = "crank"\nmass = 1.0\n',
        "a mass of a joint": 'joint = "crank"\nmass = 1.0\n',
        "a link without inertia": 'link = "world"\nmass = 1.0\n',
        "a negative mass": 'link = "rocker"\nmass = -100.0\n',
        "a negative scale": 'link = "rocker"\nscale = -1.0\n',
        "five moments": 'link = "rocker"\ninertia = [1, 0, 0, 1, 0]\n',
        "an unknown key": 'link = "rocker"\nrpy = [0, 0, 0]\n',
    }
    check_refusals("overrides", {name: loading(entry) for name, entry in entries.items()})


def test_a_planar_linkage_has_expressions_instead(tmp_path: Path) -> None:
    path = tmp_path / "linkage.toml"
    own = (models_folder() / "klann_walker.toml").read_text(encoding="utf-8")
    path.write_text(own + '[[override]]\nlink = "crank"\nmass = 1.0\n', encoding="utf-8")
    with pytest.raises(srm.InputError, match="no joints and links to change"):
        srm.load(path)
