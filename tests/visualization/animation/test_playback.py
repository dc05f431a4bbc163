"""Playback: key frames, shapes and camera, and the page in a real browser."""

from __future__ import annotations

import dataclasses
import inspect
import logging
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.visualization.animation import scene, trajectory
from srm_mbs.visualization.animation.overlays import ViewOptions
from srm_mbs.visualization.animation.playback import close, export_html, play
from srm_mbs.visualization.animation.scene import choose_view
from srm_mbs.visualization.animation.shapes import (
    Box,
    Cylinder,
    Mesh,
    Sphere,
    bounding_box,
    visuals_of,
)
from srm_mbs.visualization.animation.trajectory import sample_motion
from tests.support.browsing import assert_in_place, bodies_in, exported, opened, placements
from tests.support.bundled import load
from tests.support.pacing import assert_pace
from tests.support.screenshots import pixels

MEGABYTE = 1e6

# Every shape, every way to give a colour, a fixed joint, and a visual on a turned origin.
ARM = """<robot name="arm">
  <material name="shared"><color rgba="0 0 1 1"/></material>
  <link name="base">
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0 0 -0.1"/><geometry><box size="0.4 0.3 0.2"/></geometry></visual>
  </link>
  <link name="upper">
    <inertial>
      <origin xyz="0.5 0 0"/><mass value="1"/>
      <inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <visual>
      <origin xyz="0.5 0.1 0" rpy="0.3 1.2 -0.4"/>
      <geometry><cylinder radius="0.05" length="0.8"/></geometry>
      <material name="inline"><color rgba="1 0 0 0.5"/></material>
    </visual>
    <visual>
      <geometry><sphere radius="0.08"/></geometry>
      <material name="shared"/>
    </visual>
  </link>
  <link name="lower">
    <inertial>
      <origin xyz="0.25 0 0"/><mass value="0.5"/>
      <inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <visual>
      <origin xyz="0.25 0 0"/>
      <geometry><box size="0.5 0.06 0.04"/></geometry>
      <material name="inline"/>
    </visual>
  </link>
  <link name="tip">
    <visual><geometry>@tip@</geometry></visual>
  </link>
  <joint name="shoulder" type="continuous">
    <parent link="base"/><child link="upper"/><origin rpy="0.2 0 0"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="elbow" type="continuous">
    <parent link="upper"/><child link="lower"/><origin xyz="1 0 0"/><axis xyz="1 0 1"/>
  </joint>
  <joint name="flange" type="fixed">
    <parent link="lower"/><child link="tip"/><origin xyz="0.5 0 0.1" rpy="0 0.5 0"/>
  </joint>
</robot>
"""


def facet(*corners: str) -> str:
    """A triangle of an STL file."""
    loop = "".join(f"vertex {corner}\n" for corner in corners)
    return f"facet normal 0 0 0\nouter loop\n{loop}endloop\nendfacet\n"


CORNER, X, Y, Z = "0 0 0", "1 0 0", "0 1 0", "0 0 2"
SIDES = ((CORNER, Y, X), (CORNER, X, Z), (CORNER, Z, Y), (X, Y, Z))
TETRAHEDRON = f"solid t\n{''.join(facet(*side) for side in SIDES)}endsolid t\n"


def arm(folder: Path, description: str = "", tip: str = '<sphere radius="0.03"/>') -> srm.Mechanism:
    folder.mkdir(exist_ok=True)
    (folder / "arm.urdf").write_text(ARM.replace("@tip@", tip))
    (folder / "arm.toml").write_text(f'format = 1\nurdf = "arm.urdf"\n{description}')
    return srm.load(folder / "arm.toml")


def bare(name: str) -> srm.Mechanism:
    """A bundled mechanism without its pictures."""
    loaded = load(name)
    return srm.Mechanism(loaded.model, loaded.loops, loaded.q0, loaded.v0, name=name)


def moving(mechanism: srm.Mechanism) -> tuple[int, ...]:
    return tuple(range(1, mechanism.model.njoints))


@pytest.fixture(scope="module")
def slider_crank() -> srm.Solution:
    return srm.simulate(load("slider_crank"), 100.0)


@pytest.fixture(scope="module")
def spatial_four_bar() -> srm.Solution:
    return srm.simulate(load("spatial_four_bar"), 2.0)


def test_a_body_that_closures_hold_at_its_origin_is_a_bar_to_its_centre_of_mass() -> None:
    model = pin.Model()
    for name in ("carrier", "load"):
        joint = model.addJoint(model.njoints - 1, pin.JointModelRY(), pin.SE3.Identity(), name)
        model.addBodyFrame(name, joint, pin.SE3.Identity(), 0)
    lever = np.array([0.6, 0.0, 0.3])
    model.appendBodyToJoint(joint, pin.Inertia(1.0, lever, 0.1 * np.eye(3)), pin.SE3.Identity())
    held = srm.LoopClosure("point_on_plane", srm.Anchor("load"), srm.Anchor("world"), (0, 1, 0))
    own = [each for each in visuals_of(srm.Mechanism(model, loops=[held])) if each.joint == joint]
    (bar,) = (each for each in own if isinstance(each.shape, Box))
    np.testing.assert_allclose(bar.placement.translation, lever / 2.0)
    np.testing.assert_allclose(bar.shape.size[2], np.linalg.norm(lever))
    assert any(np.array_equal(each.placement.translation, lever) for each in own)


# Key frames


def test_key_frames_equal_the_forward_kinematics_of_the_dense_output(
    tmp_path: Path, spatial_four_bar: srm.Solution
) -> None:
    floating = arm(tmp_path, 'base = "floating"')
    spinning = srm.simulate(floating, 1.0, v0=np.linspace(-2.0, 3.0, floating.model.nv))
    for solution in (spatial_four_bar, spinning):
        motion = sample_motion(solution, moving(solution.mechanism), 30.0)
        for i in range(0, len(motion.times), 7):
            expected = placements(solution.mechanism, solution(motion.times[i])[0])
            for k, joint in enumerate(motion.joints):
                x, y, z, w = motion.quaternions[i, k]
                rotation = pin.Quaternion(w, x, y, z).matrix()
                assert np.abs(rotation - expected[joint].rotation).max() < 1e-9
                offset = motion.positions[i, k] - expected[joint].translation
                assert np.abs(offset).max() < 1e-9


def test_key_frames_are_uniform_and_reach_from_the_start_to_the_end_of_the_run() -> None:
    solution = srm.simulate(load("four_bar"), 1.03)
    motion = sample_motion(solution, moving(solution.mechanism), 60.0)
    assert motion.times[0] == 0.0
    assert motion.times[-1] == 1.03
    assert len(motion.times) == 63
    assert np.allclose(np.diff(motion.times), 1.03 / 62, rtol=1e-12)
    assert motion.rate == pytest.approx(62 / 1.03)


def test_a_run_of_whole_frames_gets_exactly_those(slider_crank: srm.Solution) -> None:
    motion = sample_motion(slider_crank, (1, 2), 60.0)
    assert len(motion.times) == 6001
    assert motion.rate == pytest.approx(60.0, rel=1e-12)


def test_quaternions_turn_the_short_way_between_key_frames(slider_crank: srm.Solution) -> None:
    mechanism = load("slider_crank_whirl")
    for solution in (slider_crank, srm.simulate(mechanism, 5.0)):
        quaternions = sample_motion(solution, (1, 2), 60.0).quaternions
        assert np.all(np.sum(quaternions[1:] * quaternions[:-1], axis=2) > 0.9)


def test_key_frames_are_thinned_where_bodies_or_seconds_are_many(
    slider_crank: srm.Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trajectory, "MAX_BODY_FRAMES", 5000)
    assert len(sample_motion(slider_crank, (1, 2), 60.0).times) == 2501
    monkeypatch.setattr(trajectory, "MAX_BODY_FRAMES", 100)
    at_least = 1 + round(trajectory.MIN_FPS * 100.0)
    assert len(sample_motion(slider_crank, (1, 2), 60.0).times) == at_least
    assert len(sample_motion(slider_crank, (1, 2), 2.0).times) == 201


def halfway(motion: trajectory.BodyMotion) -> tuple[Any, Any, Any]:
    """Times halfway between key frames, and where bodies are seen there: straight between them."""
    q = motion.quaternions
    turned = q[1:] + q[:-1]
    turned /= np.linalg.norm(turned, axis=2)[:, :, None]
    places = 0.5 * (motion.positions[1:] + motion.positions[:-1])
    return 0.5 * (motion.times[1:] + motion.times[:-1]), places, turned


def test_slow_bodies_have_fewer_key_frames_than_fast_ones_and_are_seen_in_their_places() -> None:
    solution = srm.simulate(load("jansen_walker"), 2.0)
    motion = sample_motion(solution, moving(solution.mechanism), 60.0)
    size = np.ptp(motion.positions.reshape(-1, 3), axis=0).max()
    numbers, counts = np.arange(len(motion.times)), []
    for k in range(len(motion.joints)):
        for rows, scale in ((motion.positions[:, k], size), (motion.quaternions[:, k], 0.5)):
            kept = motion.needed_frames(rows)
            assert kept[:: motion.parts].all()  # the requested ones
            between = np.array(
                [np.interp(numbers, numbers[kept], column[kept]) for column in rows.T]
            )
            off = np.linalg.norm(between.T - rows, axis=1).max() / scale
            assert off <= trajectory.INTERPOLATION_TOLERANCE
            counts.append(kept.sum())
    requested = (len(numbers) - 1) // motion.parts + 1
    assert set(counts) == {requested, len(numbers)}
    assert motion.parts == 2


def test_bodies_of_a_short_fast_run_are_seen_in_their_places_between_key_frames() -> None:
    solution = srm.simulate(load("squeezing_mechanism"), 0.03)  # two turns of the crank
    joints = moving(solution.mechanism)
    motion = sample_motion(solution, joints, 60.0)
    size = np.ptp(motion.positions.reshape(-1, 3), axis=0).max()
    beside, turned = [], []
    for t, places, quaternions in zip(*halfway(motion)):
        expected = placements(solution.mechanism, solution(t)[0])
        for joint, place, quaternion in zip(joints, places, quaternions):
            seen = pin.Quaternion(quaternion).matrix()
            beside.append(np.linalg.norm(place - expected[joint].translation) / size)
            turned.append(np.linalg.norm(pin.log3(seen.T @ expected[joint].rotation)))
    assert np.quantile(beside, 0.98) < trajectory.INTERPOLATION_TOLERANCE
    assert np.quantile(turned, 0.98) < trajectory.INTERPOLATION_TOLERANCE
    assert len(motion.times) < 400


def test_a_wheel_of_whole_turns_between_frames_does_not_stand_still() -> None:
    model = pin.Model()
    hub = model.addJoint(0, pin.JointModelRUBY(), pin.SE3.Identity(), "hub")
    model.appendBodyToJoint(hub, pin.Inertia(1.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    speed = 60.0 * 2.0 * np.pi
    wheel = srm.Mechanism(model, (), q0=np.array([1.0, 0.0]), v0=np.array([speed]))
    motion = sample_motion(srm.simulate(wheel, 1.0), (1,), 60.0)
    for t, _, (quaternion,) in zip(*halfway(motion)):
        angle = 2.0 * np.arctan2(quaternion[1], quaternion[3])
        assert abs(np.angle(np.exp(1j * (angle - speed * t)))) < trajectory.INTERPOLATION_TOLERANCE


def test_a_time_that_is_asked_for_is_a_key_frame_and_the_others_stay() -> None:
    solution = srm.simulate(load("four_bar"), 1.0)
    motion = sample_motion(solution, (1, 2, 3), 10.0, extra=[0.123, 0.5, 1.0])
    plain = sample_motion(solution, (1, 2, 3), 10.0)
    assert set(motion.times) == {*plain.times, 0.123}
    assert np.allclose(np.array(motion.frames) / motion.rate, motion.times, atol=1e-6)
    assert plain.frames == list(range(len(plain.times)))
    place = motion.positions[list(motion.times).index(0.123)]
    for k, expected in enumerate(placements(solution.mechanism, solution(0.123)[0])[1:]):
        assert np.abs(place[k] - expected.translation).max() < 1e-12


# Shapes


@pytest.mark.parametrize("base", ["fixed", "floating", "planar"])
@pytest.mark.parametrize("lock", [(), ("shoulder",), ("elbow",)], ids=str)
def test_shapes_lie_where_pinocchio_puts_them_in_the_whole_model(
    tmp_path: Path, base: str, lock: tuple[str, ...]
) -> None:
    held = "".join(f"{name} = 0.7\n" for name in lock)
    mechanism = arm(tmp_path, f'base = "{base}"\nlock = {list(lock)}\n[initial.q]\n{held}')
    root = {"floating": pin.JointModelFreeFlyer, "planar": pin.JointModelPlanar}.get(base)
    urdf = mechanism.source.urdf  # type: ignore[union-attr]
    whole = pin.buildModelFromXML(urdf, *([] if root is None else [root()]))
    geometry = pin.buildGeomFromUrdfString(whole, urdf, pin.GeometryType.VISUAL)

    pin.seed(3)
    q_whole = pin.randomConfiguration(whole, np.full(whole.nq, -1.0), np.full(whole.nq, 1.0))
    q = np.array(mechanism.q0)
    for name in mechanism.joint_names:
        own, full = mechanism.joint(name), whole.joints[whole.getJointId(name)]
        q[own.idx_q : own.idx_q + own.nq] = q_whole[full.idx_q : full.idx_q + full.nq]
    for name in lock:
        start = whole.joints[whole.getJointId(name)].idx_q
        q_whole[start : start + 2] = np.cos(0.7), np.sin(0.7)

    data, shapes = whole.createData(), geometry.createData()
    pin.updateGeometryPlacements(whole, data, geometry, shapes, q_whole)
    expected = {
        geometry.geometryObjects[i].name: placement for i, placement in enumerate(shapes.oMg)
    }
    bodies = placements(mechanism, q)
    found = {}
    names = ["base_0", "upper_0", "upper_1", "lower_0", "tip_0"]
    for name, visual in zip(names, visuals_of(mechanism)):
        found[name] = bodies[visual.joint] * visual.placement
    assert found.keys() == expected.keys()
    for name, placement in found.items():
        assert np.abs(placement.homogeneous - expected[name].homogeneous).max() < 1e-12, name


def test_shapes_have_the_sizes_and_colours_of_the_urdf(tmp_path: Path) -> None:
    base, rod, ball, lower, tip = visuals_of(arm(tmp_path))
    assert base.shape == Box((0.4, 0.3, 0.2))
    assert rod.shape == Cylinder(0.05, 0.8)
    assert ball.shape == Sphere(0.08)
    assert rod.colour == (1.0, 0.0, 0.0, 0.5)
    assert ball.colour == (0.0, 0.0, 1.0, 1.0)
    assert lower.colour == rod.colour  # used by its name, defined at another link
    assert tip.colour != base.colour  # bodies without colours are told apart


@pytest.mark.parametrize("name", ["tip.stl", "package://robot/tip.stl"])
def test_mesh_files_are_found_beside_the_urdf_and_in_packages(tmp_path: Path, name: str) -> None:
    robot = tmp_path / "robot"
    mechanism = arm(robot, tip=f'<mesh filename="{name}" scale="0.1 0.1 0.2"/>')
    (robot / "tip.stl").write_text(TETRAHEDRON)
    mesh = visuals_of(mechanism)[-1].shape
    assert isinstance(mesh, Mesh)
    assert len(mesh.faces) == 4
    assert np.allclose(bounding_box(mesh), [[0.0, 0.0, 0.0], [0.1, 0.1, 0.4]])


@pytest.mark.parametrize("name", ["package://robot/gone.stl", "tip.stl"])
def test_a_missing_or_unreadable_mesh_is_left_out_with_a_warning_that_names_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    mechanism = arm(tmp_path, tip=f'<mesh filename="{name}"/>')
    (tmp_path / "tip.stl").write_text("this is no mesh")
    with caplog.at_level(logging.WARNING):
        visuals = visuals_of(mechanism)
    assert len(visuals) == 4
    assert name in caplog.text
    assert "'tip'" in caplog.text
    export_html(srm.simulate(mechanism, 0.1), tmp_path / "page.html")


def test_without_visuals_bars_join_the_joints_and_reach_the_anchors_of_the_loops() -> None:
    mechanism = bare("slider_crank")
    visuals = visuals_of(mechanism)
    ends = []
    for visual in visuals:
        if isinstance(visual.shape, Box) and visual.joint > 0:
            half = np.array([0.0, 0.0, 0.5 * visual.shape.size[2]])
            ends.append(
                (visual.joint, *(visual.placement.act(side * half) for side in (-1.0, 1.0)))
            )
    (crank, crank_start, crank_end), (rod, rod_start, rod_end) = ends
    assert (crank, rod) == (1, 2)
    assert np.allclose([crank_start, rod_start], 0.0, atol=1e-12)
    assert np.allclose([crank_end, rod_end], [2.0, 0.0, 0.0])  # the rod's joint; the loop's pin
    hinges = [v for v in visuals if isinstance(v.shape, Cylinder)]
    assert len(hinges) == 2
    for hinge in hinges:
        assert np.allclose(np.abs(hinge.placement.rotation[:, 2]), [0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    "name", ["simple_pendulum", "pendulum_chain", "spatial_four_bar", "slider_crank_slider"]
)
def test_without_visuals_every_part_of_the_tree_is_drawn(name: str) -> None:
    mechanism = bare(name)
    assert {visual.joint for visual in visuals_of(mechanism)} == set(range(mechanism.model.njoints))


# Camera


def screen(view: scene.View, points: Any) -> Any:
    """Positions in the window, 1 at its edges."""
    x, y, z = view.axes @ (np.asarray(points) - view.target).T
    slope = np.tan(np.radians(scene.FIELD_OF_VIEW / 2.0))
    return np.array([x / scene.ASPECT, y]) / (slope * (z + view.distance))


def test_planar_mechanisms_are_seen_from_minus_y_with_z_up() -> None:
    view = choose_view(load("four_bar"), np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 1.0]]))
    assert np.allclose(view.axes, [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    assert np.allclose(view.target, [1.0, 0.0, 0.5])


def test_mechanisms_planar_in_x_y_are_seen_from_above() -> None:
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "hinge")
    model.appendBodyToJoint(joint, pin.Inertia.FromSphere(1.0, 0.1), pin.SE3.Identity())
    view = choose_view(srm.Mechanism(model), np.zeros((1, 3)))
    assert np.allclose(view.axes, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])


def test_spatial_mechanisms_are_seen_from_three_quarters_with_z_up() -> None:
    view = choose_view(load("spatial_four_bar"), np.zeros((1, 3)))
    assert np.all(np.abs(view.axes[2]) > 0.3)
    assert view.axes[0, 2] == pytest.approx(0.0, abs=1e-12)
    assert view.axes[1, 2] > 0.0


@pytest.mark.parametrize("name", ["four_bar", "spatial_four_bar", "pendulum_chain"])
def test_the_whole_motion_fits_in_the_window_and_fills_it(name: str) -> None:
    solution = srm.simulate(load(name), 3.0)
    visuals = visuals_of(solution.mechanism)
    points = []
    for q in solution(np.linspace(0.0, 3.0, 200))[0]:
        bodies = placements(solution.mechanism, q)
        for visual in visuals:
            rotation, offset = bodies[visual.joint].rotation, bodies[visual.joint].translation
            points.append(visual.corners() @ rotation.T + offset)
    seen = np.concatenate(points)
    reach = np.abs(screen(choose_view(solution.mechanism, seen), seen)).max()
    assert 0.75 < reach < 0.9


@pytest.mark.parametrize("size", [1e-6, 1e-3, 1e6])
def test_the_camera_stands_as_near_to_a_small_mechanism_as_its_size_asks_for(size: float) -> None:
    mechanism, points = load("four_bar"), np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 1.0]])
    near, usual = choose_view(mechanism, size * points), choose_view(mechanism, points)
    assert near.distance / size == pytest.approx(usual.distance)


# Files and errors


def test_the_page_of_a_long_run_is_one_file_below_five_megabytes(
    tmp_path: Path, slider_crank: srm.Solution, capsys: pytest.CaptureFixture[str]
) -> None:
    slider_crank.export_html(tmp_path / "page.html")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    assert (tmp_path / "page.html").stat().st_size < 5.0 * MEGABYTE
    assert capsys.readouterr() == ("", "")


def test_the_page_of_many_bodies_is_below_five_megabytes(tmp_path: Path) -> None:
    solution = srm.simulate(load("n_four_bar_40"), 10.0)
    export_html(solution, tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size < 5.0 * MEGABYTE


def test_export_starts_no_process(
    tmp_path: Path, spatial_four_bar: srm.Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a process was started")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    export_html(spatial_four_bar, tmp_path / "page.html")


def test_a_server_that_does_not_start_is_an_input_error(
    tmp_path: Path, spatial_four_bar: srm.Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho 'address already in use' >&2\nexit 1\n")
    python.chmod(0o755)
    monkeypatch.setattr("sys.executable", str(python))
    with pytest.raises(srm.InputError, match=r"cannot start .*exit code 1.*already in use") as info:
        play(spatial_four_bar, open_browser=False, block=False)
    assert "export_html" in str(info.value)


def without_a_step(t: float, q: Any, v: Any) -> Any:
    """A controller whose forces are finite at the start alone."""
    return np.full(3, np.nan if t > 0.0 else 0.0)


def test_a_run_that_fails_at_once_is_shown_as_it_stood(tmp_path: Path) -> None:
    mechanism = load("four_bar")
    solution = srm.simulate(mechanism, 1.0, controller=without_a_step)
    assert len(solution.t) == 1
    export_html(solution, tmp_path / "page.html")
    motion = sample_motion(solution, (1,), 60.0)
    assert motion.positions.shape == (1, 1, 3)


def test_the_server_starts_from_any_folder(
    tmp_path: Path, spatial_four_bar: srm.Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    visualizer = play(spatial_four_bar, open_browser=False, block=False)
    assert visualizer.window.server_proc.poll() is None
    close(visualizer)


def test_play_serves_until_it_is_interrupted_and_leaves_nothing_behind(
    spatial_four_bar: srm.Solution,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    opened = []

    def no_browser(address: str, new: int = 0) -> bool:
        opened.append(address)
        return False

    def interrupt(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("webbrowser.open", no_browser)
    monkeypatch.setattr("time.sleep", interrupt)
    with caplog.at_level(logging.INFO, logger="srm_mbs"):
        visualizer = play(spatial_four_bar, block=True)
    assert visualizer.window.server_proc.poll() is not None
    assert visualizer.window.closed
    assert opened == [visualizer.url()]
    assert opened[0] in caplog.text
    assert capsys.readouterr() == ("", "")
    close(visualizer)  # a second time is harmless


# In the browser


@pytest.fixture(scope="module")
def page_and_run(
    browser: Any, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Any, Any]]:
    """A page of the slider-crank, and its run of whole 1/64 s, exact in single precision."""
    solution = srm.simulate(load("slider_crank"), 8.0)
    folder = tmp_path_factory.mktemp("page")
    with exported(browser, folder, solution, (600, 400), fps=64.0) as page:
        yield page, solution


@pytest.mark.browser
def test_scrubbing_puts_every_body_where_forward_kinematics_does(page_and_run: Any) -> None:
    page, solution = page_and_run
    for t in (0.0, 0.015625, 1.0, 4.296875, 8.0, 2.5):
        assert assert_in_place(page, solution, t) == {"world", "crank", "rod"}


@pytest.mark.browser
def test_only_bodies_that_move_have_key_frames(browser: Any, tmp_path: Path) -> None:
    mechanism = load("pendulum_chain")
    q = np.tile(mechanism.q0, (9, 1))
    q[:, mechanism.joint(mechanism.joint_names[-1]).idx_q] += np.linspace(0.0, 0.5, 9)
    motion = srm.JointMotion(mechanism, np.linspace(0.0, 1.0, 9), q)
    with exported(browser, tmp_path, motion) as page:
        moved = page.evaluate("animator.actions.map(a => a.getRoot().name)")
        keys = page.evaluate("animator.actions.map(a => a._clip.tracks.map(t => t.times.length))")
    assert moved == [mechanism.joint_names[-1]]
    assert keys == [[1, 61]]  # its pivot stays, too


@pytest.mark.browser
def test_between_key_frames_bodies_are_off_by_less_than_a_millimetre(page_and_run: Any) -> None:
    page, solution = page_and_run
    for t in (0.3 + 1 / 128, 1.0 + 1 / 128, 7.1):
        assert_in_place(page, solution, t, within=1e-3)


@pytest.mark.browser
def test_shapes_in_the_page_have_the_extent_and_placement_of_the_visuals(
    browser: Any, tmp_path: Path
) -> None:
    mechanism = arm(tmp_path, tip='<mesh filename="tip.stl" scale="0.1 0.1 0.1"/>')
    (tmp_path / "tip.stl").write_text(TETRAHEDRON)
    with exported(browser, tmp_path, srm.simulate(mechanism, 0.5)) as page:
        found = page.evaluate("""() => {
          viewer.scene.updateMatrixWorld(true);
          const shapes = {};
          for (const body of Object.values(viewer.scene_tree.find(["mechanism"]).children)) {
            const frame = body.object.matrixWorld.clone().invert();
            for (const [name, node] of Object.entries(body.children)) {
              const mesh = node.children["<object>"].object;
              mesh.geometry.computeBoundingBox();
              const {min, max} = mesh.geometry.boundingBox, corners = [];
              for (const x of [min.x, max.x]) for (const y of [min.y, max.y])
                for (const z of [min.z, max.z])
                  corners.push(new MeshCat.THREE.Vector3(x, y, z)
                    .applyMatrix4(mesh.matrixWorld).applyMatrix4(frame).toArray());
              shapes[name] = [corners, mesh.material.color.getHex(), mesh.material.opacity];
            }
          }
          return shapes;
        }""")
    visuals = visuals_of(mechanism)
    assert len(found) == len(visuals) == 5
    for number, visual in enumerate(visuals):
        corners, colour, opacity = found[f"shape_{number}"]
        apart = np.linalg.norm(np.array(corners)[:, None] - visual.corners()[None], axis=2)
        # Round things are polygons in the page: a little smaller than they should be.
        assert apart.min(axis=0).max() < 2e-3
        assert apart.min(axis=1).max() < 2e-3
        parts = [(colour >> shift) & 255 for shift in (16, 8, 0)]
        assert np.allclose(np.array(parts) / 255.0, visual.colour[:3], atol=3e-3)
        assert opacity == pytest.approx(visual.colour[3])


@pytest.mark.browser
def test_the_slider_scrubs_and_the_button_starts_and_stops(page_and_run: Any) -> None:
    page, solution = page_and_run
    page.evaluate("viewer.animator.play()")
    page.locator("#time").evaluate("(node) => { node.value = 3; node.oninput(); }")
    assert page.evaluate("[viewer.animator.playing, viewer.animator.time]") == [False, 3]
    assert_in_place(page, solution, 3.0)
    page.wait_for_function("document.querySelector('output').value === '3.00 / 8.00 s'")
    page.locator("#toggle").click()
    page.wait_for_function("viewer.animator.playing && viewer.animator.time > 3.05")
    page.locator("#toggle").click()
    assert page.evaluate("viewer.animator.playing") is False


@pytest.mark.browser
@pytest.mark.stress
def test_ten_seconds_of_motion_take_ten_seconds(page_and_run: Any) -> None:
    """8 s, the end, and 2 s again."""
    page, solution = page_and_run
    bodies_in(page, 0.0)
    assert assert_pace(page, 10.2) > solution.t[-1] + 1.5


def has_colour(image: Any, colour: tuple[float, ...]) -> bool:
    """Whether 200 pixels have the hue of ``colour``, lit in any way."""
    direction = np.array(colour[:3]) / np.linalg.norm(colour[:3])
    lengths = np.linalg.norm(image, axis=2)
    along = image @ direction
    return bool(np.sum((along > 0.98 * lengths) & (lengths > 0.3)) > 200)


@pytest.mark.browser
def test_the_picture_shows_the_coloured_bodies_on_a_light_background(page_and_run: Any) -> None:
    page, solution = page_and_run
    bodies_in(page, 0.0)
    page.evaluate("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")
    image = pixels(page.screenshot())
    assert np.median(image) > 0.85
    for visual in visuals_of(solution.mechanism):
        if visual.joint and isinstance(visual.shape, Box):
            assert has_colour(image, visual.colour)


@pytest.mark.browser
def test_a_page_without_motion_shows_the_mechanism_and_no_slider(
    browser: Any, tmp_path: Path
) -> None:
    solution = srm.simulate(load("four_bar"), 1.0, controller=without_a_step)
    with exported(browser, tmp_path, solution) as page:
        assert page.locator("#bar").is_visible() is False
        assert len(assert_in_place(page, solution, 0.0)) == 4


@pytest.mark.browser
def test_play_serves_a_page_that_repeats_the_motion_in_real_time(browser: Any) -> None:
    solution = srm.simulate(bare("spatial_four_bar"), 2.0)
    visualizer = play(solution, fps=64.0, open_browser=False, block=False)
    try:
        with opened(browser, visualizer.url(), plays=True) as page:
            page.wait_for_function("viewer.animator.playing")
            assert page.evaluate("viewer.animator.duration") == pytest.approx(2.0, rel=1e-6)
            assert page.evaluate("viewer.animator.actions.every(a => a.repetitions === Infinity)")
            found = assert_in_place(page, solution, 1.25)
            assert found == {"world", *solution.mechanism.joint_names}
    finally:
        close(visualizer)


@pytest.mark.parametrize(
    "method",
    [
        *(getattr(srm.JointMotion, name) for name in ("play", "show", "export_html")),
        *(srm.JointMotion.export_image, srm.JointMotion.export_video, srm.LiveView.play),
    ],
)
def test_every_method_that_shows_a_motion_names_all_overlays(method: Any) -> None:
    parameters = inspect.signature(method).parameters
    assert all(given.kind is not given.VAR_KEYWORD for given in parameters.values())
    for overlay in dataclasses.fields(ViewOptions):
        assert parameters[overlay.name].default == overlay.default
