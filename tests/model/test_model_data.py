"""Pinocchio models as plain data."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.model.model_data import model_from_data, model_to_data, tree_numbers
from tests.support.bundled import load
from tests.support.mechanisms import DISTINCT_MODELS

AXIS = np.array([0.6, 0.0, 0.8])
JOINTS = {
    **{
        name: (lambda name=name: getattr(pin, f"JointModel{name}")())
        for name in (
            *("RX", "RY", "RZ", "RUBX", "RUBY", "RUBZ", "PX", "PY", "PZ"),
            *("FreeFlyer", "Planar", "Spherical", "SphericalZYX", "Translation"),
        )
    },
    "HX": lambda: pin.JointModelHX(0.1),
    "RevoluteUnaligned": lambda: pin.JointModelRevoluteUnaligned(AXIS),
    "PrismaticUnaligned": lambda: pin.JointModelPrismaticUnaligned(AXIS),
    "HelicalUnaligned": lambda: pin.JointModelHelicalUnaligned(AXIS, 0.1),
    "Universal": lambda: pin.JointModelUniversal(AXIS, np.array([0.0, 1.0, 0.0])),
    "Ellipsoid": lambda: pin.JointModelEllipsoid(0.1, 0.2, 0.3),
}


def with_joint(joint: Any) -> pin.Model:
    """A model whose only joint is ``joint``."""
    model = pin.Model()
    model.addJoint(0, joint, pin.SE3.Random(), "joint")
    model.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Random())
    model.addBodyFrame("body", 1, pin.SE3.Random(), 0)
    model.lowerPositionLimit[:] = -np.inf
    model.damping[:] = 0.5
    return model


def again(model: pin.Model) -> pin.Model:
    return model_from_data(json.loads(json.dumps(model_to_data(model))))


def assert_same(model: pin.Model, other: pin.Model) -> None:
    assert model == other
    assert model_to_data(model) == model_to_data(other)
    for name in ("joints", "inertias", "jointPlacements", "frames", "names", "parents"):
        assert list(getattr(model, name)) == list(getattr(other, name)), name
    rng = np.random.default_rng(0)
    q = pin.integrate(model, pin.neutral(model), rng.uniform(-1.0, 1.0, model.nv))
    v, a = rng.uniform(-1.0, 1.0, (2, model.nv))
    forces = [pin.rnea(each, each.createData(), q, v, a) for each in (model, other)]
    np.testing.assert_array_equal(*forces)


@pytest.mark.parametrize("name", JOINTS)
def test_a_joint_of_every_type_is_the_same_after_json(name: str) -> None:
    model = with_joint(JOINTS[name]())

    assert_same(again(model), model)


def test_a_composite_joint_is_the_same_after_json() -> None:
    joint = pin.JointModelComposite()
    joint.addJoint(pin.JointModelRX(), pin.SE3.Random())
    joint.addJoint(pin.JointModelRevoluteUnaligned(AXIS), pin.SE3.Random())
    model = with_joint(joint)

    assert_same(again(model), model)


def test_a_continuous_joint_about_any_axis_turns_about_it_after_json() -> None:
    urdf = """<robot name="r"><link name="a"/><link name="b"><inertial><mass value="1"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="j" type="continuous"><parent link="a"/><child link="b"/>
    <axis xyz="0.3 -0.5 0.7"/></joint></robot>"""
    model = pin.buildModelFromXML(urdf)
    q = np.array([0.6, 0.8])

    copy = again(model)

    placements = []
    for each in (model, copy):
        data = each.createData()
        pin.forwardKinematics(each, data, q)
        placements.append(data.oMi[1].homogeneous)
    np.testing.assert_allclose(*placements, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("name", DISTINCT_MODELS)
def test_bundled_models_are_the_same_after_json(name: str) -> None:
    model = load(name).model

    assert_same(again(model), model)


def changed(change: Any) -> Any:
    data = model_to_data(srm.load("four_bar").model)
    change(data)
    return data


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d["joints"][1].update(parent=2), "does not stand before it"),
        (lambda d: d["joints"][1].update(parent=-1), "greater than or equal to 0"),
        (lambda d: d["joints"][0]["kind"].update(type="Mimic"), "no joint type 'Mimic'"),
        (lambda d: d["joints"][0]["kind"].update(axes=[]), "1 axes"),
        (lambda d: d["joints"][0]["placement"].__setitem__(0, 2.0), "not a rotation"),
        (lambda d: d["joints"][0]["inertia"].__setitem__(0, -1.0), "negative mass"),
        (lambda d: d["joints"][0]["inertia"].__setitem__(0, float("nan")), "finite number"),
        (lambda d: d["joints"][0]["inertia"].__setitem__(0, 10**400), "consist of numbers"),
        (lambda d: d["joints"][0]["kind"].update(axes=[[None] * 10**6]), "at most 3 items"),
        (lambda d: d.update({f"{k}": 0 for k in range(1000)}), "it has 1007 entries"),
        (lambda d: d["joints"][0].update(name="x" * 2000), "at most 1000 characters"),
        (lambda d: d["frames"][3].update(joint=9), "on no joint"),
        (lambda d: d["frames"][3].update(parent=7), "on no joint or frame before it"),
        (lambda d: d["vectors"]["damping"].append(0.0), "4 numbers, not 3"),
        (lambda d: d["vectors"].update(other=[]), "not those of a model"),
        (lambda d: d.update(nq=3), "Extra inputs"),
        (lambda d: d.pop("frames"), "Field required"),
    ],
)
def test_data_of_no_model_are_refused_with_the_reason(change: Any, says: str) -> None:
    with pytest.raises(srm.InputError, match=says):
        model_from_data(changed(change))


def test_numbers_of_a_tree_are_those_of_its_joints_and_bodies() -> None:
    model = load("stewart_platform").model
    numbers = tree_numbers(model)
    for i, (place, body) in enumerate(zip(model.jointPlacements, model.inertias)):
        R, p = numbers.placements[i, :9].reshape(3, 3), numbers.placements[i, 9:]
        np.testing.assert_array_equal(R, place.rotation)
        np.testing.assert_array_equal(p, place.translation)
        np.testing.assert_array_equal(numbers.bodies[i, :4], [body.mass, *body.lever])
        np.testing.assert_array_equal(numbers.bodies[i, 4:], body.inertia[np.triu_indices(3)])
