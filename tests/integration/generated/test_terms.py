"""Generated code computes what Pinocchio, the reference and the kernel compute."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.formats.urdf.joint_types import EXTENDED_TYPES, MULTIPLE
from srm_mbs.integration.generated.algebra import algebra_of
from srm_mbs.integration.generated.code import generated_source, load_code
from srm_mbs.integration.generated.expressions import live_nodes
from srm_mbs.integration.generated.frames import shortest_terms
from srm_mbs.integration.generated.structure import UnsupportedElementError, structure_of
from srm_mbs.integration.generated.terms import GROUND, record_terms
from srm_mbs.integration.kernel import backend
from srm_mbs.integration.kernel.system import make_kernel_system
from srm_mbs.model.closures import CLOSURE_TYPES
from srm_mbs.model.forces import FORCE_TYPES, ForceElement
from tests.support.bundled import load
from tests.support.dynamics import mass_matrix, nonlinear_effects
from tests.support.generated import GeneratedFunction, values_of
from tests.support.mechanisms import COMPILED_MODELS, along_x, rod
from tests.support.urdf_files import LINK

pytestmark = [
    pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}"),
    pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler"),
]

_TILTED = np.array([0.6, 0.0, 0.8])
_OTHER = np.array([0.0, -0.8, 0.6])


def _composite() -> pin.JointModelComposite:
    joint = pin.JointModelComposite()
    joint.addJoint(pin.JointModelRX(), along_x(0.2))
    joint.addJoint(pin.JointModelPY(), along_x(0.1))
    joint.addJoint(pin.JointModelUniversal(_TILTED, _OTHER), along_x(-0.3))
    return joint


def _tilted_unbounded() -> object:
    """Pinocchio's class has no constructor with an axis; its reader of URDF has."""
    return pin.buildModelFromXML(
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous">'
        '<parent link="a"/><child link="b"/><axis xyz="0.6 0 0.8"/></joint></robot>'
    ).joints[1]


JOINTS: dict[str, Callable[[], object]] = {
    **{
        name: getattr(pin, f"JointModel{name}")
        for name in (
            *("RX", "RY", "RZ", "RUBX", "RUBY", "RUBZ", "PX", "PY", "PZ"),
            *("Spherical", "SphericalZYX", "Planar", "FreeFlyer", "Translation"),
        )
    },
    "revolute": lambda: pin.JointModelRevoluteUnaligned(_TILTED),
    "unbounded": _tilted_unbounded,
    "prismatic": lambda: pin.JointModelPrismaticUnaligned(_TILTED),
    "HX": lambda: pin.JointModelHX(0.2),
    "HY": lambda: pin.JointModelHY(-0.2),
    "HZ": lambda: pin.JointModelHZ(0.3),
    "helical": lambda: pin.JointModelHelicalUnaligned(_TILTED, 0.2),
    "universal": lambda: pin.JointModelUniversal(_TILTED, _OTHER),
    "composite": _composite,
}


TREES = (
    ("RX", "RY", "RZ", "revolute"),
    ("RUBX", "RUBY", "RUBZ", "unbounded"),
    ("PX", "PY", "PZ", "prismatic"),
    ("HX", "HY", "HZ", "helical"),
    ("Spherical", "SphericalZYX", "Planar", "Translation"),
    ("FreeFlyer", "universal", "composite"),
)
"""Kinds of joints by tree: each tree costs a compilation."""


def _tree(*kinds: Callable[[], object]) -> srm.Mechanism:
    """A hinge, joints of these kinds at angles one after the other, a hinge; a second branch."""
    rng = np.random.default_rng(3)
    model = pin.Model()

    def add(parent: int, joint: object, name: str) -> int:
        placement = pin.SE3(pin.rpy.rpyToMatrix(rng.uniform(-1, 1, 3)), rng.uniform(-1, 1, 3))
        index = model.addJoint(parent, joint, placement, name)
        body = rod(rng.uniform(0.5, 2.0))
        body.lever = rng.uniform(-0.5, 0.5, 3)
        model.appendBodyToJoint(
            index, body, pin.SE3(pin.rpy.rpyToMatrix(*rng.normal(size=3)), np.zeros(3))
        )
        model.addBodyFrame(name, index, pin.SE3.Identity(), 0)
        return index

    first = add(0, pin.JointModelRY(), "root")
    last = first
    for i, make in enumerate(kinds):
        last = add(last, make(), f"joint {i}")
    add(last, pin.JointModelRZ(), "tip")
    add(first, pin.JointModelRX(), "branch")
    model.armature = rng.uniform(0.0, 0.1, model.nv)
    model.gravity = pin.Motion(np.array([0.3, -1.0, -9.0, 0.0, 0.0, 0.0]))
    return srm.Mechanism(model, q0=pin.neutral(model))


def _states(mechanism: srm.Mechanism, count: int) -> list[tuple[FloatArray, FloatArray]]:
    model, rng = mechanism.model, np.random.default_rng(4)
    return [
        (
            pin.integrate(model, mechanism.q0, rng.uniform(-2.0, 2.0, model.nv)),
            rng.uniform(-2.0, 2.0, model.nv),
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize(
    "names",
    [
        *TREES,
        *(pytest.param((name, name), marks=pytest.mark.stress) for name in JOINTS),
    ],
    ids=str,
)
def test_mass_matrix_and_nonlinear_effects_are_pinocchios_for_any_kind_of_joint(
    names: tuple[str, ...],
) -> None:
    mechanism = _tree(*(JOINTS[name] for name in names))
    function, model = GeneratedFunction(mechanism), mechanism.model
    for q, v in _states(mechanism, 5):
        found = function(q, v)
        M, nle = mass_matrix(model, q), nonlinear_effects(model, q, v)
        assert found.status == 0
        assert np.abs(found.M - M).max() < 1e-14 * np.abs(M).max()
        assert np.abs(found.nle - nle).max() < 2e-14 * np.abs(nle).max()


READ = {
    "fixed": "",
    "floating": "",
    "planar": '<axis xyz="0 0 1"/>',
    "spherical": "",
    "universal": '<axis xyz="2 1 2"/><axis2 xyz="0 -3 4"/>',
    "screw": '<axis xyz="0 3 4"/><thread_pitch value="0.3"/>',
    **dict.fromkeys(("continuous", "revolute", "prismatic"), '<axis xyz="{}"/>'),
}
"""Types of joints of URDF and of its extensions, into which the other formats are translated, and
what they need."""
AXIAL = ("continuous", "revolute", "prismatic")
AXES = ("1 0 0", "0 1 0", "0 0 1", "0 -1 0", "0.6 0 -0.8")


def _read(folder: Path, kinds: Iterable[str]) -> srm.Mechanism:
    """Chains of joints of these kinds as :func:`srm.load` reads them."""
    out, parent = ['<robot name="all"><link name="base"/>'], "base"
    for kind in kinds:
        for i, axis in enumerate(AXES if "{}" in READ[kind] else [""]):
            name = f"{kind}_{i}"
            limit = '<limit lower="-2" upper="2" effort="1" velocity="1"/>'
            out.append(LINK.format(name=name, mass=1.0 + 0.1 * len(out), y=0.05 * len(out)))
            out.append(
                f'<joint name="{name} joint" type="{kind}"><parent link="{parent}"/>'
                f'<child link="{name}"/><origin xyz="0.1 0.2 -0.3" rpy="0.3 -0.4 0.5"/>'
                f"{READ[kind].format(axis)}{limit if kind in ('revolute', 'prismatic') else ''}"
                "</joint>"
            )
            parent = name
    path = folder / "all.urdf"
    path.write_text("".join([*out, "</robot>"]))
    return srm.load(path)


def test_terms_of_joints_of_every_type_that_is_read_are_pinocchios(tmp_path: Path) -> None:
    assert {*EXTENDED_TYPES, *MULTIPLE} < READ.keys()
    found: set[str] = set()
    for kinds in (("floating", "planar", "spherical", "fixed"), ("universal", "screw"), AXIAL):
        mechanism = _read(tmp_path, kinds)
        function, model = GeneratedFunction(mechanism), mechanism.model
        found |= {joint.shortname() for joint in model.joints}
        for q, v in _states(mechanism, 3):
            computed = function(q, v)
            M, nle = mass_matrix(model, q), nonlinear_effects(model, q, v)
            assert np.abs(computed.M - M).max() < 1e-14 * np.abs(M).max()
            assert np.abs(computed.nle - nle).max() < 2e-14 * np.abs(nle).max()
    assert len(found) > 12


LENGTH = 1.3
CLOSURES = {
    "point": {},
    "frame": {},
    "revolute": {"axis": (0.0, 0.6, 0.8)},
    "prismatic": {"axis": (1.0, 0.0, 0.0)},
    "cylindrical": {"axis": (0.6, 0.8, 0.0)},
    "universal": {"axis_a": (0.0, 0.0, 1.0), "axis_b": (0.0, 0.6, 0.8)},
    "planar": {"axis": (0.0, 0.0, 1.0)},
    "point_on_line": {"axis": (0.0, 1.0, 0.0)},
    "point_on_plane": {"axis": (0.6, 0.0, 0.8)},
    "distance": {"length": LENGTH},
    "coupling": {"joints": ("j3", "j1"), "polynomial": (0.0, -0.7, 0.3)},
}


def _chain() -> pin.Model:
    """Two ball joints and a hinge between them, at angles, and another hinge after them."""
    rng = np.random.default_rng(5)
    model = pin.Model()
    joint = 0
    for i in range(4):
        at = pin.SE3(pin.rpy.rpyToMatrix(rng.uniform(-1, 1, 3)), rng.uniform(-1, 1, 3))
        made = pin.JointModelRX() if i % 2 else pin.JointModelSpherical()
        joint = model.addJoint(joint, made, at, f"j{i}")
        model.appendBodyToJoint(joint, rod(), pin.SE3.Identity())
        model.addBodyFrame(f"body_{i}", joint, pin.SE3.Identity(), 0)
    return model


def _closed(kinds: Iterable[str], ground: bool) -> srm.Mechanism:
    """A chain whose end is tied to the ground or to its first body by closures of these kinds."""
    model = _chain()
    a = srm.Anchor("body_2", xyz=(0.3, 0.1, -0.2), rpy=(0.1, 0.2, 0.3))
    b = srm.Anchor("world" if ground else "body_0", xyz=(0.2, -0.1, 0.4), rpy=(-0.4, 0.2, 0.9))
    # All of them can be closed at once: a is at b then, and its distance is to a point beside b.
    beside = replace(b, xyz=(b.xyz[0] + LENGTH, *b.xyz[1:]))
    ends = {"distance": (a, beside), "coupling": ()}
    loops = [
        srm.LoopClosure(kind, *ends.get(kind, (a, b)), name=kind, **CLOSURES[kind])
        for kind in kinds
    ]
    return srm.Mechanism(model, loops, q0=pin.neutral(model))


@pytest.mark.parametrize("ground", [pytest.param(True, marks=pytest.mark.stress), False])
def test_rows_of_closures_are_those_of_the_reference(ground: bool) -> None:
    """Of all types in one mechanism."""
    assert CLOSURES.keys() == CLOSURE_TYPES.keys()
    mechanism = _closed(CLOSURES, ground)
    system, function = make_system(mechanism), GeneratedFunction(mechanism)
    for q, v in _states(mechanism, 5):
        system.evaluate(0.0, np.concatenate([q, v]))
        rows, found = system.loops, function(q, v)
        vectors = [(found.g, rows.g), (found.bias, rows.bias), *zip(found.G, rows.G)]
        for own, expected in vectors:
            assert np.abs(own - expected).max() < 1e-13 * max(np.abs(expected).max(), 1.0)


def _agree(mechanism: srm.Mechanism, count: int = 8) -> None:
    """Assert that evaluations by generated code and by the kernel agree, next to start states, and
    the rows of closures alone."""
    system = make_system(mechanism)
    kernel, generated = make_kernel_system(system), make_kernel_system(system, load_code(mechanism))
    for q, v in _states(mechanism, count):
        state = np.concatenate([q, v])
        a, b = kernel.terms(0.3, state), generated.terms(0.3, state)
        assert a["rank"] == b["rank"]
        # Accelerations of bodies that nearly lack inertia carry its condition number.
        M = mass_matrix(mechanism.model, q)
        allowed = max(1e-13 / min(a["sigma"], 1.0), 1e-16 * np.linalg.cond(M))
        for key in ("rate", "correction", "multiplier", "sigma", "constraint_residual"):
            size = np.abs(a[key]).max()
            if np.isfinite(size):
                assert np.abs(a[key] - b[key]).max() <= max(allowed, 1e-12) * max(size, 1e-3), key
        for own, expected in zip(generated.rows_at(0.3, q), kernel.rows_at(0.3, q)):
            largest = np.abs(expected).max(initial=1.0)
            assert np.abs(own - expected).max(initial=0.0) < 1e-13 * largest


@pytest.mark.parametrize("angle", [-1e3, 9e5, 1e7])
def test_joints_that_turned_often_have_the_sines_of_the_kernel(angle: float) -> None:
    """Also beyond the angles that are reduced by the generated code."""
    mechanism = load("four_bar")
    system = make_system(mechanism)
    kernel, generated = make_kernel_system(system), make_kernel_system(system, load_code(mechanism))
    state = np.concatenate([mechanism.q0 + angle * np.array([1.0, 0.0, -1.0]), mechanism.v0])
    a, b = kernel.terms(0.0, state), generated.terms(0.0, state)
    for key in ("rate", "correction", "sigma"):
        assert np.abs(a[key] - b[key]).max() < 1e-12 * np.abs(a[key]).max(), key


@pytest.mark.parametrize("loops", [19, pytest.param(32, marks=pytest.mark.stress)])
def test_evaluations_of_many_loops_are_those_of_the_kernel(loops: int) -> None:
    """With generated algebra, and beyond its sizes with the kernel's."""
    mechanism = srm.n_four_bar(loops)
    algebra = algebra_of(mechanism.model.nv, 2 * loops, 2 * loops, (), ())
    assert (algebra != "") == (loops == 19)
    _agree(mechanism, count=2)


def test_elements_of_equal_cells_are_computed_in_a_loop() -> None:
    """Forces, their laws and guards as well; the order of the joints is not that of the cells."""
    springs = [
        srm.SpringDamper(
            srm.Anchor(f"coupler_{i}", xyz=(0.5, 0.0, 0.1)),
            srm.Anchor(f"crank_{i + 1}", xyz=(0.3 + 0.01 * i, 0.0, 0.0)),
            stiffness=10.0 + i,
            rest_length=0.4,
            name=f"spring {i}",
        )
        for i in range(12)
    ]
    mechanism = replace(srm.n_four_bar(12), forces=springs)
    assert generated_source(mechanism).count("c < 9;") == 2
    _agree(mechanism, count=2)


def _two_legs(bent: float) -> srm.Mechanism:
    """A free body on two legs that are mirrored, with a rod and a spring for each; the shin of the
    second one is turned by an angle (rad) against its thigh."""
    model = pin.Model()
    pelvis = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "pelvis")
    model.appendBodyToJoint(pelvis, rod(), pin.SE3.Identity())
    model.addBodyFrame("pelvis", pelvis, pin.SE3.Identity(), 0)
    kinds = pin.JointModelRX, pin.JointModelRY, pin.JointModelRY, pin.JointModelRZ
    loops, springs = [], []
    for name, side in (("left", 1.0), ("right", -1.0)):
        joint = pelvis
        for i, kind in enumerate(kinds):
            turn = pin.rpy.rpyToMatrix(0.0, bent if i == 2 and side < 0.0 else 0.0, 0.0)
            at = pin.SE3(turn, np.array([0.05, 0.1 * side, -0.3]))
            joint = model.addJoint(joint, kind(), at, f"{name}_{i}")
            inertia = pin.Inertia(1.0 + i, np.array([0.02, 0.01 * side, -0.1]), 0.1 * np.eye(3))
            model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
            model.addBodyFrame(f"{name}_{i}", joint, pin.SE3.Identity(), 0)
        hip, foot = (
            srm.Anchor(body, xyz=(0.1, 0.2 * side, 0.03)) for body in ("pelvis", f"{name}_3")
        )
        shin = replace(foot, link=f"{name}_2")
        springs.append(srm.SpringDamper(hip, shin, stiffness=50.0, damping=2.0, rest_length=0.6))
        loops.append(srm.LoopClosure("distance", hip, foot, name=f"{name} rod", length=1.2))
    return srm.Mechanism(model, loops, forces=springs, q0=pin.neutral(model))


def test_two_legs_are_computed_together_although_one_has_more_zeros() -> None:
    """Of legs that differ in numbers alone and, with a shin at an angle, in zeros as well."""
    equal, unequal = _two_legs(0.0), _two_legs(0.3)
    pairs = [generated_source(own).count("const pair x") for own in (equal, unequal)]
    singles = generated_source(unequal).count("const double x")
    assert min(pairs) > 300
    assert pairs[1] > singles
    _agree(unequal)


@pytest.mark.parametrize("name", COMPILED_MODELS)
def test_evaluations_of_bundled_mechanisms_are_those_of_the_kernel(name: str) -> None:
    _agree(load(name))


FORCES = {
    "spring": srm.SpringDamper(
        srm.Anchor("body_2", xyz=(0.1, 0.2, 0.3)),
        srm.Anchor("body_0", xyz=(0.3, 0.0, 0.1)),
        stiffness=40.0,
        damping=3.0,
        rest_length=0.7,
    ),
    "spring without length": srm.SpringDamper(
        srm.Anchor("body_2", xyz=(0.1, 0.2, 0.3)),
        srm.Anchor("world"),
        stiffness=40.0,
        damping=3.0,
        rest_length=0.0,
    ),
    "rope": srm.SpringDamper(
        srm.Anchor("body_2", xyz=(0.1, 0.2, 0.3)), srm.Anchor("world"), 40.0, 3.0, 0.0, slack=0.1
    ),
    "friction and slack": srm.CouplingSpring(
        ("j1",), (0.8,), 30.0, 0.5, 0.1, slack=0.2, friction=2.0
    ),
    "torque": srm.JointTorque("j1", 2.5),
    "torque over time": srm.JointTorque("j1", 2.5, law=srm.Sine(1.0, frequency_hz=2.0)),
    "torsion": srm.TorsionSpring("j1", stiffness=4.0, damping=0.3, rest_angle=0.2),
    "limit": srm.LimitSpring("j1", lower=-0.3, upper=0.2, stiffness=50.0, damping=2.0, depth=0.4),
    "wrench": srm.Wrench(srm.Anchor("body_1"), force=(1.0, 2.0, 3.0), moment=(0.0, -1.0, 2.0)),
    "wrench of the link": srm.Wrench(
        srm.Anchor("body_1", xyz=(0.1, 0.0, 0.0)),
        force=(1.0, 2.0, 3.0),
        moment=(0.5, -1.0, 2.0),
        frame="link",
        law=srm.Polynomial((1.0, 0.5)),
    ),
    "bushing": srm.Bushing(
        srm.Anchor("body_2", xyz=(0.1, 0.2, 0.3)),
        srm.Anchor("body_0", rpy=(0.3, 0.0, 0.1)),
        stiffness=(10.0, 20.0, 30.0, 1.0, 2.0, 3.0),
        damping=(1.0, 2.0, 3.0, 0.1, 0.2, 0.3),
    ),
}


DRIVES = (
    srm.Drive(srm.Sine(0.2, frequency_hz=1.5), joint="j1"),
    srm.Drive(srm.ConstantSpeed(0.7), joint="j4"),
    srm.Drive(
        srm.Polynomial((0.0, 0.4, 0.3)),
        a=srm.Anchor("body_2", xyz=(0.3, 0.1, -0.2)),
        b=srm.Anchor("world", rpy=(0.1, 0.4, -0.2)),
        axis=(0.0, 0.6, 0.8),
    ),
    srm.Drive(
        srm.MinimumJerk(0.1, duration=1.0),
        a=srm.Anchor("body_3", xyz=(0.1, 0.2, 0.3)),
        b=srm.Anchor("body_0", xyz=(0.0, 0.4, 0.1)),
        distance=True,
    ),
)


def test_drives_of_joints_and_points_with_friction_in_joints_are_those_of_the_kernel() -> None:
    """One of them of a joint whose coordinates are a cosine and a sine."""
    model = _chain()
    joint = model.addJoint(4, pin.JointModelRUBY(), along_x(0.3), "j4")
    model.appendBodyToJoint(joint, rod(), pin.SE3.Identity())
    model.addBodyFrame("body_4", joint, pin.SE3.Identity(), 0)
    model.damping = np.linspace(0.1, 0.5, model.nv)
    model.friction = np.linspace(0.2, 0.4, model.nv)
    _agree(srm.Mechanism(model, drives=DRIVES, q0=pin.neutral(model)))


FORCES_ON_BODIES = ("spring", "spring without length", "rope", "wrench", "wrench of the link")


@pytest.mark.parametrize("names", [tuple(FORCES)[:6], tuple(FORCES)[6:]])
def test_forces_of_elements_are_those_of_the_kernel(names: tuple[str, ...]) -> None:
    assert {force.type for force in FORCES.values()} == FORCE_TYPES.keys()
    plain = _closed(["point_on_plane"], True)
    forces = [replace(FORCES[name], name=name) for name in names]
    _agree(replace(plain, forces=forces))
    q, v = _states(plain, 1)[0]
    state = np.concatenate([q, v])

    def rate(*own: ForceElement) -> FloatArray:
        return make_kernel_system(make_system(replace(plain, forces=own))).terms(0.3, state)["rate"]

    without = rate()
    for name in names:
        assert np.abs(rate(FORCES[name]) - without).max() > 1e-3, name


def _in_frames(mechanism: srm.Mechanism) -> Iterable[dict[str, float]]:
    """The terms at one state in the frame of the ground, and in that of each body."""
    constants = make_system(mechanism).constants()
    structure, parameters = structure_of(mechanism.model, constants)
    q, v = _states(mechanism, 1)[0]
    for frame in range(GROUND, len(structure.motions)):
        terms = record_terms(structure, frame)
        roots = [output.value for output in terms.outputs]
        leaves = {
            node: float(node.text != "held")  # a law over time is 1
            for node in live_nodes(roots)
            if node.operation == "leaf"
        }
        given = zip([*terms.q, *terms.v, *terms.parameters], [*q, *v, *parameters])
        leaves |= {leaf: float(value) for leaf, value in given if leaf.text}
        targets = [output.target for output in terms.outputs]
        yield dict(zip(targets, values_of(roots, leaves)))


@pytest.mark.parametrize(
    "make",
    [
        *(partial(_tree, *(JOINTS[name] for name in names)) for names in TREES),
        lambda: replace(
            _closed(CLOSURES, False),
            forces=[replace(FORCES[name], name=name) for name in FORCES_ON_BODIES],
        ),
    ],
)
def test_terms_are_the_same_in_the_frame_of_any_body(make: Callable[[], srm.Mechanism]) -> None:
    expected, *others = _in_frames(make())
    assert len(others) >= 3
    for found in others:
        assert found.keys() == expected.keys()
        for target, value in expected.items():
            assert abs(found[target] - value) < 1e-12 * max(abs(value), 10.0), target


@pytest.mark.parametrize(
    ("name", "frame"), [("bricard", 1), ("stewart_platform", 0), ("squeezing_mechanism", GROUND)]
)
def test_the_frame_is_in_the_middle_of_a_chain_or_that_of_a_free_body(
    name: str, frame: int
) -> None:
    mechanism = load(name)
    structure, _ = structure_of(mechanism.model, make_system(mechanism).constants())
    assert shortest_terms(structure).frame == frame


def test_points_of_a_rod_that_coincide_are_refused_as_by_the_kernel() -> None:
    plain = _closed(["distance"], True)
    hinge = tuple(plain.model.jointPlacements[2].translation.tolist())
    spring = srm.SpringDamper(
        srm.Anchor("body_1"), srm.Anchor("body_0", xyz=hinge), stiffness=1.0, rest_length=1.0
    )
    mechanism = srm.Mechanism(plain.model, plain.loops, q0=plain.q0, forces=[spring])
    generated = make_kernel_system(make_system(mechanism), load_code(mechanism))
    with pytest.raises(ArithmeticError):
        generated.terms(0.0, np.concatenate([mechanism.q0, np.zeros(mechanism.model.nv)]))


def test_an_ellipsoid_joint_is_named_as_the_reason() -> None:
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelEllipsoid(1.0, 2.0, 3.0), pin.SE3.Identity(), "egg")
    model.appendBodyToJoint(joint, rod(), pin.SE3.Identity())
    mechanism = srm.Mechanism(model, q0=pin.neutral(model))
    with pytest.raises(UnsupportedElementError, match="joint 'egg' is of the type Ellipsoid"):
        structure_of(model, make_system(mechanism).constants())


def test_variants_of_one_topology_share_one_function() -> None:
    slider_crank = load("slider_crank")
    structures = []
    for mass, length in ((1.0, 1.0), (2.0, 1.0), (0.3, 1.7)):
        model = slider_crank.model.copy()
        model.inertias[2] = pin.Inertia(mass, np.array([length / 2, 0.0, 0.0]), 0.1 * np.eye(3))
        variant = srm.Mechanism(model, slider_crank.loops, q0=slider_crank.q0)
        structures.append(structure_of(model, make_system(variant).constants())[0])
        _agree(variant)
    assert structures[0] == structures[1] == structures[2]
