"""Actuators of MJCF files against MuJoCo's ``qfrc_actuator``, and what is noted."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.mjcf_files import BODY, TWO, file, loaded

pytest.importorskip("mujoco")
from tests.support.actuators import check_forces

THREE = (
    TWO + '<body name="three"><joint name="s" type="slide" ref="0.2" range="-1 3" armature="2"/>'
)
THREE += '<geom size="0.1"/></body>'
THREE = THREE.replace('name="k"', 'name="k" ref="30" range="-40 70" actuatorfrcrange="-3 2"')
SERVOS = """<actuator>
  <motor name="m" joint="j" gear="2.5" ctrlrange="-1 1" forcerange="-0.7 2"/>
  <position name="p" joint="k" kp="7" kv="0.3" gear="-2" forcerange="-9 9"/>
  <velocity name="v" joint="s" kv="4" ctrlrange="-3 0.5" gear="0.5"/>
</actuator>"""
GENERAL = """<actuator>
  <general name="a" joint="j" gainprm="0.016" biastype="affine" biasprm="0.3 -100 -10"/>
  <general name="b" joint="s" gainprm="3" biasprm="1 2 3" gear="4"/>
  <general name="c" jointinparent="k" gainprm="5" biastype="affine" biasprm="0 -5 0.8"/>
  <general name="d" joint="s" gainprm="2" biastype="affine" biasprm="0 0 -1"/>
  <general name="e" joint="s" gainprm="2" biastype="affine" biasprm="0 -3 0.5"/>
</actuator>"""
RANGES = """<actuator>
  <position name="p" joint="k" kp="70" dampratio="0.7" inheritrange="0.5" gear="3"/>
  <position name="q" joint="s" kp="2" dampratio="1.5" inheritrange="1"/>
</actuator>"""


@pytest.mark.parametrize(
    "actuators", [SERVOS, GENERAL, RANGES], ids=["servos", "general", "ranges"]
)
def test_forces_are_those_of_mujoco(actuators: str, tmp_path: Path) -> None:
    mechanism = loaded(tmp_path, file(THREE, actuators))
    assert len(mechanism.actuators) == actuators.count("name=")
    assert check_forces(tmp_path / "robot.xml", mechanism) > 1.0


DEFAULTS = (
    '<motor gear="3"/>',
    '<position kp="5" kv="0.4"/>',
    '<position kp="5" dampratio="0.4" ctrlrange="-1 2"/>',
    '<velocity kv="6" forcerange="-2 8"/>',
    '<general gainprm="2" biastype="affine" biasprm="0.5 -3 -0.2"/>',
    "<muscle/>",
)
ELEMENTS = ("<motor {}/>", "<position {}/>", '<position kp="9" {}/>', "<velocity {}/>")


@pytest.mark.parametrize(("outer", "inner"), [*product(DEFAULTS[:-1], repeat=2)])
def test_all_kinds_share_the_default_of_their_class(outer: str, inner: str, tmp_path: Path) -> None:
    elements = "".join(
        element.format(f'name="a{k}{name}" joint="{joint}" class="{name}"')
        for name in ("main", "soft")
        for k, (element, joint) in enumerate(zip((*ELEMENTS, "<general {}/>"), "jksjs"))
    )
    given = f'<default>{outer}<default class="soft">{inner}</default></default>'
    world = THREE.replace('actuatorfrcrange="-3 2"', "")
    mechanism = loaded(tmp_path, file(world, f"{given}<actuator>{elements}</actuator>"))
    assert len(mechanism.actuators) == 10
    assert check_forces(tmp_path / "robot.xml", mechanism) > 1.0


@pytest.mark.parametrize("element", ELEMENTS)
def test_motors_and_servos_do_without_the_muscle_of_their_class(
    element: str, tmp_path: Path
) -> None:
    given = f"<default>{DEFAULTS[-1]}</default>"
    named = element.format('name="a" joint="j"')
    actuator = f"<actuator>{named}</actuator>"
    mechanism = loaded(tmp_path, file(THREE, given + actuator))
    assert check_forces(tmp_path / "robot.xml", mechanism) > 1.0


@pytest.mark.parametrize(
    ("option", "count"),
    [
        ("<option><flag clampctrl='disable'/></option>", 3),
        ("<option><flag actuation='disable'/></option>", 0),
        ("<option actuatorgroupdisable='2'/>", 2),
    ],
)
def test_options_that_switch_actuators_off_act(option: str, count: int, tmp_path: Path) -> None:
    actuators = SERVOS.replace("<velocity", '<velocity group="2"')
    mechanism = loaded(tmp_path, file(THREE, option + actuators))
    assert len(mechanism.actuators) == count
    if count:
        assert check_forces(tmp_path / "robot.xml", mechanism) > 1.0
    else:
        assert any("actuators are disabled" in note for note in mechanism.notes)


def test_an_attached_file_brings_its_actuators(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(file(THREE, SERVOS))
    main = file(
        '<body name="base"><joint name="base"/><geom size="0.2"/>'
        '<attach model="arm" body="two" prefix="l_"/></body>',
        '<asset><model name="arm" file="arm.xml"/></asset>'
        '<actuator><motor name="turn" joint="base"/></actuator>',
    )
    mechanism = loaded(tmp_path, main)
    assert list(mechanism.actuators) == ["turn", "l_p"]
    assert check_forces(tmp_path / "robot.xml", mechanism) > 1.0


UNREAD = {
    '<muscle name="a" joint="j"/>': "<muscle> actuators are not read",
    '<damper name="a" joint="j"/>': "<damper> actuators are not read",
    '<motor name="a" tendon="t"/>': "on a tendon are not read",
    '<motor name="a" site="site"/>': "on a site are not read",
    '<motor name="a" joint="ball"/>': "on a ball joint are not read",
    '<position name="a" joint="j" timeconst="0.1"/>': "with dynamics (filterexact)",
    '<general name="a" joint="j" dyntype="integrator"/>': "with dynamics (integrator)",
    '<general name="a" joint="j" gaintype="affine"/>': "with the gaintype 'affine'",
    '<general name="a" joint="j" biastype="muscle"/>': "with the biastype 'muscle'",
    '<motor name="a" joint="j" nsample="3" delay="0.01"/>': "with delay are not read",
    '<motor name="a" joint="locked"/>': "of joints that are locked are left out",
}


@pytest.mark.parametrize("element", UNREAD)
def test_what_is_not_read_is_noted_by_name(element: str, tmp_path: Path) -> None:
    world = (
        TWO
        + BODY.format("three", "locked")
        + BODY.format("four", "ball").replace('name="ball"', 'name="ball" type="ball"')
    )
    world += '<site name="site"/>'
    more = (
        '<tendon><fixed name="t"><joint joint="k" coef="1"/></fixed></tendon>'
        '<equality><joint joint1="locked"/></equality>'
        f'<actuator>{element}<motor joint="k"/></actuator>'
    )
    mechanism = loaded(tmp_path, file(world, more))
    assert list(mechanism.actuators) == ["k"]
    (note,) = (note for note in mechanism.notes if "'a'" in note)
    assert UNREAD[element] in note


def test_actuators_without_names_have_those_of_their_joints(tmp_path: Path) -> None:
    more = (
        '<actuator><motor joint="j"/><position joint="j"/><motor name="k" joint="j"/>'
        '<motor joint="k"/><motor joint="k"/></actuator>'
    )
    mechanism = loaded(tmp_path, file(TWO, more))
    assert list(mechanism.actuators) == ["j", "j_position", "k", "k_motor", "k_motor_2"]


@pytest.mark.parametrize(
    ("element", "problem"),
    [
        ('<motor name="a" joint="x"/>', "there is no joint 'x'"),
        ('<motor name="a"/>', "it has no joint"),
        ('<motor name="a" joint="j" gear="0"/>', "gear is zero"),
        ('<motor name="a" joint="j" ctrlrange="1 -1"/>', "the ctrlrange does not increase"),
        ('<motor name="a" joint="j" speed="1"/>', "speed"),
        ('<motor name="a" joint="j" class="x"/>', "there is no default class 'x'"),
        ('<position name="a" joint="j" kv="1" dampratio="1"/>', "kv and dampratio are both given"),
        ('<position name="a" joint="j" inheritrange="1"/>', "the joint has no range"),
        ('<motor name="a" joint="j"/><motor name="a" joint="k"/>', "two actuators have this name"),
    ],
)
def test_a_wrong_actuator_is_one_error_that_names_it(
    element: str, problem: str, tmp_path: Path
) -> None:
    with pytest.raises(srm.InputError, match="actuator 'a'") as caught:
        loaded(tmp_path, file(TWO, f"<actuator>{element}</actuator>"))
    assert problem in str(caught.value)


def test_armature_and_damping_of_actuators_are_noted(tmp_path: Path) -> None:
    more = '<actuator><motor name="a" joint="j" armature="0.2" damping="0.1"/></actuator>'
    notes = loaded(tmp_path, file(TWO, more)).notes
    assert "armature of actuators does not act: actuator 'a'" in notes
    assert "damping of actuators does not act: actuator 'a'" in notes


def test_conversion_keeps_the_actuators(tmp_path: Path) -> None:
    mechanism = loaded(tmp_path, file(THREE, GENERAL.replace("</actuator>", RANGES[10:])))
    srm.convert(tmp_path / "robot.xml", tmp_path / "made.toml")
    again = srm.load(tmp_path / "made.toml")
    assert again.actuators == mechanism.actuators
    assert len(again.actuators) == 7
    assert np.ptp([actuator.kv for actuator in again.actuators.values()]) > 1.0
