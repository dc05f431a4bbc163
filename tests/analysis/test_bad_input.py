"""What the analyses refuse, with the messages of ``tests/data/messages/analysis.txt``."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.bundled import load
from tests.support.mechanisms import floating_ring, floating_slider_crank
from tests.support.snapshots import check_refusals


def test_what_cannot_be_analysed_is_refused(tmp_path: Path) -> None:
    four, five, crank, chain = map(load, ("four_bar", "five_bar", "slider_crank", "pendulum_chain"))
    ring, beam = floating_ring(), floating_slider_crank()
    modes, linearise, follow = srm.assembly_modes, srm.linearise, srm.follow
    found = linearise(four)
    run = srm.simulate(four, 0.2, rtol=1e-6)
    fixed = srm.simulate(four, 0.1, step=0.01)
    loose = srm.simulate(four, 2.0, rtol=1e-3)
    steps = srm.simulate(four, 1.0, step=0.1)
    fold = srm.assemble(crank, {"crank": 0.5 * np.pi}).q
    t, q, v, a = run.t, run.q, run.v, run.accelerations
    drive = partial(srm.inverse_dynamics, four, actuated="crank")
    both = np.tile(five.q0, (2, 1)), np.zeros((2, 4)), np.zeros((2, 4))
    at_rest = np.zeros((1, 2))

    def moving(t: float) -> tuple[np.ndarray, ...]:
        return q[0], v[0], a[0]

    calls = {
        "modes: joints still move": lambda: modes(four, hold=[], starts=20),
        "modes: no loops": lambda: modes(chain),
        "modes: nan starts": lambda: modes(four, {"crank": 1.0}, starts=np.nan),
        "modes: half a start": lambda: modes(four, {"crank": 1.0}, starts=2.5),
        "modes: no starts": lambda: modes(four, starts=0),
        "equilibrium: search": lambda: srm.equilibrium(four, search="best"),
        "equilibrium: singular start": lambda: srm.equilibrium(crank, [0.5 * np.pi, np.pi]),
        "linearise: loose run": lambda: linearise(four, *loose(1.85)),
        "linearise: open loop": lambda: linearise(four, four.q0 + 0.1),
        "linearise: too many coordinates": lambda: linearise(four, coordinates=["crank", "rocker"]),
        "linearise: singular": lambda: linearise(beam, beam.q0),
        "linearise: too few positions": lambda: linearise(four, four.q0[:-1]),
        "linearise: too few rates": lambda: linearise(four, four.q0, four.v0[:-1]),
        "linearise: no step": lambda: linearise(four, step=0.0),
        "linearise: small step": lambda: linearise(four, step="small"),
        "mode shape: number": lambda: found.mode_shape(2),
        "mode shape: amplitude as a word": lambda: linearise(five).mode_shape(0, amplitude="far"),
        "mode shape: amplitude": lambda: linearise(five).mode_shape(0, amplitude=3.0),
        "mode shape: no frames": lambda: found.mode_shape(0, frames=0),
        "mode shape: half a frame": lambda: found.mode_shape(0, frames=2.5),
        "follow: nan": lambda: follow(four, {"crank": np.nan}),
        "follow: text": lambda: follow(four, {"crank": "up"}),
        "follow: far": lambda: follow(four, {"crank": [2.0, -1e100]}),
        "follow: dead point": lambda: follow(load("squeezing_mechanism"), {"gamma": 1.0}),
        "follow: lengths": lambda: follow(four, {"crank": [1.0, 2.0], "rocker": [1.0]}),
        "follow: nothing": lambda: follow(four, {}),
        "follow: dependent joints": lambda: follow(four, {"crank": 1.0, "rocker": 1.4}),
        "follow: no loops": lambda: follow(chain, {"link_0": 1.0}),
        "follow: singular start": lambda: follow(crank, {"crank": 1.0}, [0.5 * np.pi, -np.pi]),
        "follow: ball joint": lambda: follow(ring, {"b": 1.0}),
        "follow: duration": lambda: follow(four, {"crank": [2.0, 1.0]}).motion(0),
        "inverse dynamics: positions": lambda: drive((t, q + 0.1, v, a)),
        "inverse dynamics: rates": lambda: drive((t, q, v + 0.1, a)),
        "inverse dynamics: accelerations": lambda: drive((t, q, v, a + 0.1)),
        "inverse dynamics: overflow": lambda: drive((t, q, 1e200 * v, a)),
        "inverse dynamics: long steps": lambda: drive(steps.at([0.5455])),
        "inverse dynamics: three arrays": lambda: drive((t[:1], q[:1], v[:1])),
        "inverse dynamics: times": lambda: drive(moving),
        "inverse dynamics: None": lambda: drive(lambda t: None, t=[0.0, 0.1]),
        "inverse dynamics: two parts": lambda: drive(lambda t: (q[0], v[0]), t=[0.0, 0.1]),
        "inverse dynamics: shape": lambda: drive(lambda t: (q[0], v[:3], a[0]), t=[0.0, 0.1]),
        "inverse dynamics: text": lambda: drive(lambda t: ("a", v[0], a[0]), t=[0.0, 0.1]),
        "inverse dynamics: soon": lambda: drive(moving, t="soon"),
        "inverse dynamics: light": lambda: drive(run, weights="light"),
        "inverse dynamics: two weights": lambda: drive(run, weights=[1.0, 2.0]),
        "inverse dynamics: too few": lambda: srm.inverse_dynamics(
            five, (np.array([0.0, 1.0]), *both), "crank_left"
        ),
        "inverse dynamics: singular": lambda: srm.inverse_dynamics(
            crank, (np.zeros(1), fold[None], at_rest, at_rest), "crank"
        ),
        "certify: the same tolerance": lambda: srm.certify(run, rtol=1e-6),
        "certify: negative tolerance": lambda: srm.certify(run, rtol=-1.0),
        "certify: fixed steps": lambda: srm.certify(fixed, rtol=1e-8),
        "certify: no run": lambda: srm.certify(four),
        "report: picture": lambda: run.report(tmp_path / "report.html", pictures=["phase"]),
    }
    check_refusals("analysis", calls)


def test_an_unknown_joint_is_named_beside_the_known_ones() -> None:
    four = load("four_bar")
    for call in (
        lambda: srm.follow(four, {"wheel": 1.0}),
        lambda: srm.inverse_dynamics(four, srm.simulate(four, 0.1), "wheel"),
    ):
        with pytest.raises(srm.InputError, match="there is no joint 'wheel'"):
            call()
