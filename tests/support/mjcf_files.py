"""MJCF texts for tests."""

from __future__ import annotations

from pathlib import Path

import pinocchio as pin

import srm_mbs as srm
from srm_mbs.formats.document import Document
from srm_mbs.formats.mjcf.reader import translate
from srm_mbs.formats.translation import Options, Translation
from srm_mbs.formats.urdf.parser import build_urdf

TREE = """<mujoco model="tree">
  <compiler angle="degree" eulerseq="zyx"/>
  <option gravity="0.5 -1 -9.7"/>
  <default>
    <joint damping="0.1"/>
    <geom density="700"/>
    <default class="stiff">
      <joint stiffness="3" springref="20" armature="0.05"/>
      <default class="slides"><joint type="slide" axis="1 0 0" stiffness="40" springref="0.1"/>
      </default>
    </default>
  </default>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="arm" pos="0.1 0.2 0.3" euler="10 -20 30" childclass="stiff">
      <joint name="shoulder_1" pos="0.05 0 0.1" axis="1 0 0" ref="15"/>
      <joint name="shoulder_2" axis="0 1 1" pos="0 0.1 0"/>
      <geom name="g" type="capsule" size="0.04" fromto="0 0 0 0.3 0.1 -0.2"/>
      <geom type="box" size="0.1 0.05 0.02" pos="0.1 0 0" axisangle="1 1 0 40"/>
      <site name="tip" pos="0.3 0.1 -0.2" euler="5 6 7"/>
      <body name="slider" pos="0.3 0 0" quat="0.9 0.1 -0.2 0.3">
        <joint name="slide" class="slides" ref="0.02"/>
        <inertial pos="0.01 0.02 0.03" mass="0.8" diaginertia="0.01 0.02 0.025" euler="10 20 30"/>
        <geom type="sphere" size="0.1"/>
        <body name="ball" pos="0 0.2 0.1" xyaxes="0 1 0.1 -1 0 0.2">
          <joint name="socket" type="ball" pos="0 0.05 0" class="main" stiffness="1.5"/>
          <geom type="ellipsoid" size="0.1 0.05 0.08" mass="0.6" pos="0 0.1 0"/>
          <frame pos="0 0 0.1" euler="0 0 45">
            <geom type="cylinder" size="0.03" fromto="0 0 0 0 0.2 0.1"/>
            <geom type="box" size="0.02" fromto="0 0 0 0.1 0.2 0.1" mass="0.2"/>
          </frame>
        </body>
      </body>
    </body>
    <body name="second" pos="1 0 0">
      <joint name="other" axis="0 1 0"/>
      <inertial pos="0 0 0.2" mass="1" fullinertia="0.02 0.03 0.04 0.001 0.002 0.003"/>
      <body name="badge" pos="0 0 0.4" zaxis="1 1 1"><geom type="box" size="0.1 0.1 0.1"/></body>
    </body>
  </worldbody>
  <tendon><spatial name="wire" stiffness="12" damping="0.3" springlength="0.4">
    <site site="tip"/><site site="far"/></spatial></tendon>
  <worldbody><site name="far" pos="1 1 0"/></worldbody>
</mujoco>
"""
"""Every kind of joint, orientation and geom; two bodies in the world; a spring."""

FOUR_BAR = """<mujoco model="four_bar">
  <compiler angle="radian"/>
  <default><geom type="capsule" size="0.02"/><joint axis="0 1 0"/>
    <equality solref="0.01 1"/></default>
  <worldbody>
    <body name="crank"><joint name="a"/><geom fromto="0 0 0 0 0 0.5"/>
      <body name="coupler" pos="0 0 0.5"><joint name="b"/><geom fromto="0 0 0 1 0 0.3"/></body>
    </body>
    <body name="rocker" pos="1.2 0 0"><joint name="d"/><geom fromto="0 0 0 0 0 0.8"/></body>
  </worldbody>
  <equality>
    <connect name="pin" body1="coupler" body2="rocker" anchor="1 0 0.3"/>
    <connect name="idle" body1="coupler" anchor="0 0 0" active="false"/>
  </equality>
</mujoco>
"""

TWO_LOOPS = """<mujoco model="two_loops">
  <compiler angle="radian"/>
  <worldbody>
    <body name="frame" pos="0 0 1"><freejoint name="root"/>
      <geom type="box" size="0.3 0.2 0.05"/>
      <site name="eye" pos="0.6 0.05 -0.4" euler="0.1 0.2 0.3"/>
      <body name="left" pos="0.3 0 0"><joint name="l" axis="0 1 0"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.4"/>
        <body name="link" pos="0 0 -0.4"><joint name="k" axis="0 1 0"/>
          <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0"/>
          <site name="hook" pos="0.3 0.05 0" euler="0.1 0.2 0.3"/>
        </body>
      </body>
      <body name="right" pos="-0.3 0 0"><joint name="r1" axis="0 1 0"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.4"/>
        <body name="tool" pos="0 0 -0.4"><joint name="r2" type="ball"/>
          <geom type="box" size="0.05 0.1 0.15"/></body>
      </body>
    </body>
    <body name="drum" pos="0 0.5 1"><joint name="wheel" axis="0 1 0"/>
      <geom type="cylinder" size="0.2 0.05"/>
      <body name="fork" pos="0 0.2 0" euler="0.3 0 0"><joint name="tilt" axis="1 0 0"/>
        <geom type="box" size="0.05 0.1 0.15"/></body></body>
  </worldbody>
  <equality>
    <weld name="hold" site1="hook" site2="eye"/>
    <weld name="grip" body1="tool" body2="fork" relpose="0.1 0 0.05 0.9 0.1 0 0.2"
      anchor="0.1 0.2 0"/>
    <joint name="gear" joint1="wheel" joint2="r1" polycoef="0.1 -2 0 0 0"/>
  </equality>
</mujoco>
"""
BODY = '<body name="{}"><joint name="{}"/><geom type="sphere" size="0.1" pos="0.2 0 0"/></body>'
TWO = "".join(BODY.format(*names) for names in (("one", "j"), ("two", "k")))


def file(world: str = TWO, more: str = "") -> str:
    """A file with two hinged bodies by default, and further sections."""
    return f"<mujoco>{more}<worldbody>{world}</worldbody></mujoco>"


def loaded(folder: Path, text: str) -> srm.Mechanism:
    """The mechanism of a file with this text."""
    path = folder / "robot.xml"
    path.write_text(text)
    return srm.load(path)


def model_of(text: str) -> pin.Model:
    """Pinocchio's model of the translated tree."""
    made = translated(text)
    return build_urdf(made.tree, "x.urdf", made.entries.get("base", "fixed")).model


def translated(text: str) -> Translation:
    return translate(Document(text, "robot.xml"), Options())
