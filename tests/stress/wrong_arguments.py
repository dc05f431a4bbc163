"""Calls of the public functions, and wrong arguments of every kind."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

import srm_mbs as srm


class Raising:
    """An object of which nothing can be asked, not even its representation."""

    def _fail(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("not to be asked")

    __array__ = __float__ = __int__ = __index__ = __len__ = __iter__ = __fspath__ = _fail
    __call__ = __bool__ = __eq__ = __hash__ = __getitem__ = __lt__ = __contains__ = _fail
    __str__ = __add__ = __radd__ = __mul__ = __rmul__ = __repr__ = __format__ = _fail


class RaisingText(str):
    """A text that cannot be shown."""

    def _fail(self, *_: Any) -> Any:
        raise RuntimeError("not to be asked")

    __repr__ = __str__ = __format__ = _fail


HUGE = 10**5000
"""An integer that Python does not write as text."""


def wrong_values() -> list[Any]:
    """New wrong values: wrong types, shapes, signs and sizes."""
    ragged: list[Any] = [[1.0, 2.0], [3.0]]
    itself: list[Any] = []
    itself.append(itself)
    return [
        *(None, True, False, 0, -1, 3, 10**400, -(10**400), 2**63, 0.0, -0.5, 1e300, 1e-300),
        *(float("nan"), float("inf"), -float("inf"), 1j, np.float64("nan"), np.int64(-3)),
        *(
            "",
            "crank",
            "no such",
            "x" * 10_000,
            "a\0b",
            "\ud800",
            "\x1b[2J",
            b"bytes",
            bytearray(2),
        ),
        *([], [1.0], [np.nan], ragged, itself, [None], ["x"], [[]], (), (1, 2, 3), [1e308] * 3),
        *(
            {},
            {"crank": np.nan},
            {"crank": "x"},
            {"crank": [1, 2]},
            {3: 4},
            {None: None},
            set(),
            {1},
        ),
        *(HUGE, -HUGE, [HUGE], [HUGE] * 3, (1.0, 2.0, HUGE), {"crank": HUGE}, {HUGE: 1.0}),
        *([Raising()], {"crank": Raising()}, {1: Raising()}, RaisingText("crank")),
        *([RaisingText("x")], {RaisingText("crank"): 0.0}, {RaisingText("x"): 0.0}),
        *(object(), int, Raising(), Raising, len, lambda: None, lambda *_: None, lambda *_: "x"),
        *(np.zeros(0), np.zeros((3, 3)), np.zeros((1, 1, 1)), np.array(["a"]), np.array(None)),
        *(np.zeros(3, complex), np.full(3, np.nan), np.zeros(100_000), np.array([1, "x"], object)),
        *(iter([1.0]), range(3), (x for x in "ab"), slice(None), ..., NotImplemented),
        *(Path("/no folder/file.html"), Path(), Path("/"), Path("/dev/null"), "."),
        *(datetime.date(2000, 1, 1), pin.Model(), pin.SE3.Identity(), srm, Exception("x")),
    ]


@dataclass(frozen=True)
class Call:
    """A function with arguments that it accepts."""

    function: Callable[..., Any]
    given: tuple[Any, ...] = ()
    named: Mapping[str, Any] = field(default_factory=dict)

    @property
    def places(self) -> tuple[int | str, ...]:
        """Of its arguments."""
        return (*range(len(self.given)), *self.named)

    def run(self, changes: Mapping[int | str, Any]) -> Any:
        """The result with some arguments replaced."""
        given = [changes.get(k, value) for k, value in enumerate(self.given)]
        return self.function(*given, **{k: changes.get(k, v) for k, v in self.named.items()})


def with_a_parameter(folder: Path) -> srm.Mechanism:
    """A bar that hangs from a pin, the place of which is a parameter."""
    path = folder / "bar.toml"
    path.write_text(
        """format = 1
parameters = { pin = 0.2 }
[planar]
points = { O = ["=pin", 0], A = [1, 0] }
bar = [{ name = "bar", points = ["O", "A"], mass = 1 }]
ground = ["O"]
""",
        encoding="utf-8",
    )
    return srm.load(path)


def calls(folder: Path) -> dict[str, Call]:
    """A call of every public function, and of the methods of results; they write to ``folder``."""
    four_bar = srm.load("four_bar")
    solution = srm.simulate(four_bar, 0.3)
    solution.save(folder / "saved.npz")
    q, v = four_bar.q0, four_bar.v0
    dae = srm.SemiExplicitDAE(
        f=lambda t, x: np.array([x[1], 0.0]),
        B=lambda t, x: np.array([[0.0], [1.0]]),
        g=lambda t, x: np.array([x[1] - 1.0]),
        G=lambda t, x: np.array([[0.0, 1.0]]),
    )
    dae_run = srm.solve_dae(dae, (0.0, 0.1), [0.0, 1.0])
    swept = srm.sweep(four_bar, [{"q": {"crank": 1.0}}], 0.05)
    sine = srm.Sine(amplitude=0.1, frequency_hz=1.0)
    anchor, world = srm.Anchor("rocker"), srm.Anchor("world")
    crank = four_bar.joint_names[0]
    simulator = srm.Simulator(four_bar)
    found = srm.linearise(four_bar)
    path = srm.follow(four_bar, {crank: float(q[0]) + 0.1})
    options: dict[str, Any] = {
        **{"method": "psrm", "tableau": "dop853", "rtol": 1e-6, "atol": 1e-6, "step": None},
        **{"first_step": None, "max_step": None, "t_eval": None, "events": None},
        **{"placement": "automatic", "singular_times": (), "progress": False},
        **{"raise_on_failure": False},
    }
    run_options = options | {
        **{"controller": None, "q0": None, "v0": None, "sample_time": None, "breakpoints": ()},
        **{"t0": 0.0, "backend": "auto"},
    }
    return {
        "simulate": Call(srm.simulate, (four_bar, 0.05), run_options),
        "solve_dae": Call(srm.solve_dae, (dae, (0.0, 0.05), [0.0, 1.0]), options),
        "SemiExplicitDAE": Call(srm.SemiExplicitDAE, (dae.f, dae.B, dae.g, dae.G)),
        "load": Call(srm.load, ("four_bar",), {"cut": (), "base": None, "gravity": None}),
        "load_solution": Call(srm.load_solution, (folder / "saved.npz",)),
        "convert": Call(srm.convert, ("four_bar", folder / "c.toml"), {"cut": (), "force": True}),
        "planar": Call(
            srm.planar,
            (),
            {
                **{"points": {"O": (0.0, 0.0), "A": (1.0, 0.0)}, "bars": {"bar": ("O", "A")}},
                **{"ground": ("O",), "mass_per_length": 1.0, "masses": {"bar": 2.0}},
                **{"inertias": {"bar": 1.0}, "lengths": {"bar": 1.0}, "start": {"O": 0.5}},
                **{"rates": {"O": 1.0}, "springs": (), "torques": {"O": 1.0}, "unit": "m"},
                **{"loads": {"A": (0.0, 1.0)}, "drives": None, "sliders": None, "angle": "deg"},
                **{"gravity": (0.0, -9.81), "name": "x", "cut": ()},
            },
        ),
        "bundled_models": Call(srm.bundled_models),
        "n_four_bar": Call(srm.n_four_bar, (2,)),
        "assemble": Call(
            srm.assemble,
            (four_bar, {crank: float(q[0])}),
            {"v": {}, "guess": None, "hold": None, "limits": False},
        ),
        "assembly_modes": Call(
            srm.assembly_modes, (four_bar,), {"q": None, "hold": None, "starts": 3, "seed": 0}
        ),
        "equilibrium": Call(
            srm.equilibrium, (four_bar, {}), {"hold": [crank], "search": "nearest"}
        ),
        "kinematics": Call(srm.kinematics, (four_bar, crank)),
        "linkage_report": Call(srm.linkage_report, (four_bar, crank)),
        "linearise": Call(
            srm.linearise,
            (four_bar, q, v),
            {
                **{"inputs": None, "coordinates": None, "step": 0.003, "controller": None},
                **{"rtol": 1e-6},
            },
        ),
        "follow": Call(srm.follow, (four_bar, {crank: float(q[0]) + 0.01}), {"q": None}),
        "inverse_dynamics": Call(
            srm.inverse_dynamics,
            (four_bar, solution),
            {"actuated": crank, "t": None, "weights": None, "tolerance": 1e-6},
        ),
        "certify": Call(
            srm.certify, (solution,), {"rtol": None, "again": False, "progress": False}
        ),
        "mobility_map": Call(srm.mobility_map, (solution,)),
        "sweep": Call(
            srm.sweep,
            (four_bar, [{"q": {crank: float(q[0])}}], 0.02),
            {
                **{"measure": srm.standard_measures, "options": None, "executor": None},
                **{"chunk": 1, "resume": None, "progress": False, "rtol": 1e-6},
            },
        ),
        "standard_measures": Call(srm.standard_measures, (solution,)),
        "impact": Call(srm.impact, (four_bar, q, v, np.eye(4)[0][:3], 0.5)),
        "Switch": Call(srm.Switch, (four_bar,), {"q": None, "v": None}),
        "Event": Call(
            srm.Event,
            (lambda t, q, v: q[0] - 9.0,),
            {"action": None, "direction": 0.0, "terminal": False},
        ),
        "closures_from_pinocchio": Call(srm.closures_from_pinocchio, (four_bar.model, [])),
        "Mechanism": Call(
            srm.Mechanism,
            (four_bar.model, four_bar.loops),
            {"q0": q, "v0": v, "forces": (), "drives": (), "name": "x", "actuators": {}},
        ),
        "Actuator": Call(
            srm.Actuator,
            (crank,),
            {
                **{"type": "position", "gear": 1.0, "kp": 2.0, "kv": 0.0, "gain": None},
                **{"bias": 0.0, "damping_ratio": 0.1, "reference": 0.0, "control_range": (0, 1)},
                **{"force_range": None},
            },
        ),
        "actuator_controller": Call(
            srm.actuator_controller,
            (replace(four_bar, actuators={crank: srm.Actuator(crank)}), {crank: 1.0}),
        ),
        "Anchor": Call(srm.Anchor, ("crank",), {"xyz": (0.0, 0.0, 0.0), "rpy": (0.0, 0.0, 0.0)}),
        "LoopClosure": Call(srm.LoopClosure, ("point", anchor, anchor), {"name": "x"}),
        "LoopClosure of joints": Call(
            srm.LoopClosure, ("coupling",), {"joints": (crank, "rocker"), "ratio": 1.0}
        ),
        "Drive": Call(srm.Drive, (sine,), {"joint": crank, "axis": None, "name": "x"}),
        "Sine": Call(srm.Sine, (), {"amplitude": 0.1, "frequency_hz": 1.0, "phase": 0.0}),
        "ConstantSpeed": Call(srm.ConstantSpeed, (), {"speed": 1.0}),
        "Polynomial": Call(srm.Polynomial, (), {"coefficients": (0.0, 1.0)}),
        "MinimumJerk": Call(srm.MinimumJerk, (), {"start": 0.0, "target": 1.0, "duration": 1.0}),
        "Table": Call(srm.Table, ((0.0, 1.0, 2.0, 3.0), (0.0, 1.0, 2.0, 3.0))),
        "JointTorque": Call(srm.JointTorque, (crank,), {"torque": None, "law": sine}),
        "SpringDamper": Call(
            srm.SpringDamper,
            (anchor, world),
            {"stiffness": 1.0, "damping": 0.1, "rest_length": 0.1, "name": "x"},
        ),
        "TorsionSpring": Call(srm.TorsionSpring, (crank,), {"stiffness": 1.0, "damping": 0.0}),
        "CouplingSpring": Call(
            srm.CouplingSpring,
            ((crank,), (1.0,)),
            {"stiffness": 1.0, "damping": 0.0, "rest": 0.0},
        ),
        "LimitSpring": Call(
            srm.LimitSpring, (crank,), {"stiffness": 1.0, "lower": -1.0, "upper": 1.0}
        ),
        "Bushing": Call(
            srm.Bushing, (anchor, world), {"stiffness": [1.0] * 6, "damping": [0.0] * 6}
        ),
        "Wrench": Call(srm.Wrench, (anchor,), {"force": (0.0, 0.0, 1.0), "frame": "world"}),
        "UserForce": Call(srm.UserForce, (lambda t, q, v: np.zeros(3),)),
        "PSRM": Call(srm.PSRM, ("dop853",), {"prediction": "exact", "eps": None, "T": "identity"}),
        "SRM": Call(srm.SRM, ("tvd32",), {"iterations": None, "eps": "h", "restart": False}),
        "Simulator": Call(
            srm.Simulator, (four_bar,), {"rtol": 1e-6, "step": None, "method": "psrm"}
        ),
        "backend": Call(srm.backend),
        "compile": Call(srm.compile, (four_bar,)),
        "Simulator.step": Call(simulator.step, (0.001,)),
        "Solution()": Call(solution, (0.1,)),
        "Solution.at": Call(solution.at, ([0.1],)),
        "Solution.joint": Call(solution.joint, (crank,)),
        "Solution.plot": Call(solution.plot, (folder / "p.svg", "state"), {"joints": [crank]}),
        "Solution.to_csv": Call(solution.to_csv, (folder / "r.csv", [0.1])),
        "Solution.save": Call(solution.save, (folder / "r.npz",)),
        "Solution.export_html": Call(
            solution.export_html,
            (folder / "r.html",),
            {"trace": (), "gaps": False, "reactions": False, "arrows": False},
        ),
        "Solution.report": Call(
            solution.report,
            (folder / "r.html",),
            {"again": False, "pictures": (), "animation": False},
        ),
        "DaeSolution()": Call(dae_run, (0.05,)),
        "DaeSolution.plot": Call(dae_run.plot, (folder / "p.svg", "run")),
        "DaeSolution.to_csv": Call(dae_run.to_csv, (folder / "d.csv",)),
        "Sweep.to_csv": Call(swept.to_csv, (folder / "s.csv",)),
        "Sweep.to_parquet": Call(swept.to_parquet, (folder / "s.parquet",)),
        "Linearisation.mode_shape": Call(found.mode_shape, (0,)),
        "FollowedPath.motion": Call(path.motion, (1.0,)),
        "JointMotion": Call(srm.JointMotion, (four_bar, np.array([0.0, 1.0]), np.array([q, q]))),
        "Mechanism.with_parameters": Call(
            with_a_parameter(folder).with_parameters, (), {"pin": 0.3}
        ),
        "Mechanism.with_state": Call(four_bar.with_state, (q, v)),
        "Mechanism.joint": Call(four_bar.joint, (crank,)),
    }
