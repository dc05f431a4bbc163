"""Kinetic energy is that of the bodies and of the rotors on their joints, whatever the joint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system

AXIS = np.array([0.6, 0.0, 0.8])
JOINTS = {
    "RX": pin.JointModelRX,
    "RY": pin.JointModelRY,
    "RZ": pin.JointModelRZ,
    "RUBX": pin.JointModelRUBX,
    "RUBY": pin.JointModelRUBY,
    "RUBZ": pin.JointModelRUBZ,
    "PX": pin.JointModelPX,
    "PY": pin.JointModelPY,
    "PZ": pin.JointModelPZ,
    "HX": lambda: pin.JointModelHX(0.1),
    "HY": lambda: pin.JointModelHY(0.1),
    "HZ": lambda: pin.JointModelHZ(0.1),
    "RevoluteUnaligned": lambda: pin.JointModelRevoluteUnaligned(AXIS),
    "PrismaticUnaligned": lambda: pin.JointModelPrismaticUnaligned(AXIS),
    "HelicalUnaligned": lambda: pin.JointModelHelicalUnaligned(AXIS, 0.1),
    "Spherical": pin.JointModelSpherical,
    "SphericalZYX": pin.JointModelSphericalZYX,
    "Translation": pin.JointModelTranslation,
    "Planar": pin.JointModelPlanar,
    "Universal": lambda: pin.JointModelUniversal(np.array([1.0, 0, 0]), np.array([0, 1.0, 0])),
    "FreeFlyer": pin.JointModelFreeFlyer,
}


@pytest.mark.parametrize("armature", [0.0, 1.5])
@pytest.mark.parametrize("name", JOINTS)
def test_it_is_the_sum_over_bodies_and_rotors(name: str, armature: float) -> None:
    rng = np.random.default_rng(3)
    model = pin.Model()
    parent = 0
    for i, joint in enumerate((JOINTS[name](), pin.JointModelRY())):
        parent = model.addJoint(parent, joint, pin.SE3.Random(), f"joint_{i}")
        model.appendBodyToJoint(parent, pin.Inertia.Random(), pin.SE3.Identity())
    model.armature = armature * rng.uniform(0.5, 1.0, model.nv)
    q = pin.integrate(model, pin.neutral(model), rng.uniform(-1.0, 1.0, model.nv))
    v = rng.standard_normal(model.nv)
    data = model.createData()
    pin.forwardKinematics(model, data, q, v)
    bodies = sum(model.inertias[i].vtiv(data.v[i]) for i in range(1, model.njoints))
    rotors = model.armature @ v**2

    found = make_system(srm.Mechanism(model)).kinetic_energy(q, v)

    assert found == pytest.approx(0.5 * (bodies + rotors), rel=1e-13)


MJCF = """<mujoco><worldbody><body name="b"><joint name="hip" axis="0 1 0" armature="1"/>
<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
SDF = """<sdf version="1.9"><model name="m">
<link name="b"><inertial><mass>1</mass>
  <inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia></inertial></link>
<joint name="hip" type="revolute"><parent>world</parent><child>b</child>
  <axis><xyz>0 1 0</xyz></axis></joint></model></sdf>"""
URDF = """<robot name="m"><link name="base"/><link name="b"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hip" type="revolute"><parent link="base"/><child link="b"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/>{}</joint></robot>"""


@pytest.mark.parametrize(
    ("name", "text", "inertia"),
    [
        ("m.xml", MJCF, 2.0),
        ("m.sdf", SDF, 1.0),
        ("m.urdf", URDF.format(""), 1.0),
        ("m.urdf", URDF.format('<dynamics armature="1"/>'), 2.0),
    ],
)
def test_files_of_each_format_give_the_energy_of_their_mass_matrix(
    name: str, text: str, inertia: float, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    mechanism = srm.load(tmp_path / name)
    run = srm.simulate(mechanism, 0.1, v0=[1.0])
    np.testing.assert_allclose(run.energy_balance.kinetic, 0.5 * inertia, rtol=1e-9)
