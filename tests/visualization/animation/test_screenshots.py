"""Pictures of runs against those that somebody has looked at, whatever draws them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from srm_mbs.visualization.animation import scene
from srm_mbs.visualization.animation.overlays import ViewOptions
from srm_mbs.visualization.animation.shapes import Visual, visuals_of
from tests.support.screenshots import FOLDER, SHOTS, SIZE, Shot, differences, pixels, taken

KIB = 1024


def reference(name: str) -> Any:
    return pixels((FOLDER / f"{name}.png").read_bytes())


def seen(shot: Shot, browser: Any) -> Any:
    return pixels(taken(shot, browser))


SLOW = {"slider_crank_behind", "spatial_four_bar_bars", "stewart_platform"}


@pytest.mark.browser
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.stress] if n in SLOW else []) for n in SHOTS],
)
def test_a_run_looks_as_it_did(browser: Any, name: str) -> None:
    image = seen(SHOTS[name], browser)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    assert list(differences(image, reference(name))) == []


def test_there_is_one_small_picture_of_each_shot() -> None:
    files = {path.stem: path.stat().st_size for path in FOLDER.iterdir()}
    assert files.keys() == SHOTS.keys()
    assert max(files.values()) < 30 * KIB


def test_pictures_of_different_times_and_mechanisms_are_unlike() -> None:
    images = {name: reference(name) for name in SHOTS}
    for name, image in images.items():
        for other, another in images.items():
            assert bool(list(differences(image, another))) == (name != other)


# What the comparison must see, and what it must not.


def drawn_with(monkeypatch: pytest.MonkeyPatch, browser: Any, shot: Shot, change: Any) -> Any:
    """The picture with changed visuals, from the same place."""
    view = scene.make_picture(shot.run(), 60.0, ViewOptions()).view
    monkeypatch.setattr(scene, "choose_view", lambda mechanism, points: view)
    monkeypatch.setattr(scene, "visuals_of", lambda *given: change(visuals_of(*given)))
    return seen(shot, browser)


def displaced(visuals: list[Visual], joint: int, by: float) -> list[Visual]:
    """The body of a joint, moved ``by`` m along its z axis."""
    move = pin.SE3(np.eye(3), np.array([0.0, 0.0, by]))
    return [
        replace(visual, placement=move * visual.placement) if visual.joint == joint else visual
        for visual in visuals
    ]


@pytest.mark.browser
@pytest.mark.parametrize("name", [pytest.param("crank", marks=pytest.mark.stress), "rod"])
def test_a_body_beside_its_place_by_two_percent_of_the_picture_is_seen(
    browser: Any, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    shot = SHOTS["slider_crank_start"]
    joint = shot.run().mechanism.model.getJointId(name)
    by = 0.02 * 8.0  # the slot is about 8 m long
    image = drawn_with(monkeypatch, browser, shot, lambda found: displaced(found, joint, by))
    assert list(differences(image, reference("slider_crank_start")))


@pytest.mark.browser
@pytest.mark.parametrize(
    ("shot", "name"),
    [
        pytest.param("slider_crank_start", "crank", marks=pytest.mark.stress),
        # The thinnest of all.
        pytest.param("delta_robot_reactions", "sway_1b", marks=pytest.mark.stress),
    ],
)
def test_a_body_that_is_not_there_is_seen(
    browser: Any, monkeypatch: pytest.MonkeyPatch, shot: str, name: str
) -> None:
    joint = SHOTS[shot].run().mechanism.model.getJointId(name)

    def without(visuals: list[Visual]) -> list[Visual]:
        kept = [visual for visual in visuals if visual.joint != joint]
        assert len(kept) < len(visuals)
        return kept

    image = drawn_with(monkeypatch, browser, SHOTS[shot], without)
    assert list(differences(image, reference(shot)))


@pytest.mark.browser
def test_closures_without_their_colours_are_seen(browser: Any) -> None:
    shot = replace(SHOTS["delta_robot_reactions"], drawn=())
    assert list(differences(seen(shot, browser), reference("delta_robot_reactions")))


@pytest.mark.parametrize("name", SHOTS)
def test_what_drivers_and_antialiasing_do_is_not_seen(name: str) -> None:
    from scipy.ndimage import shift

    image = reference(name)
    rng = np.random.default_rng(7)
    moved = shift(image, (0.5, -0.5, 0.0), order=1, mode="nearest")
    harsh = np.round(image * 31.0) / 31.0  # five bits
    noisy = np.clip(image + rng.normal(0.0, 0.02, image.shape), 0.0, 1.0)
    darker = image**1.06
    for other in (moved, harsh, noisy, darker):
        assert list(differences(image, other)) == []
