"""Cost per evaluation and per step against size, beside ``pin.constraintDynamics``.

N-four-bars for loops, open chains for coordinates.  ``run``: whole runs of the kernel, without
generated code, over their evaluations or steps.  Where the time goes:

* Pinocchio: in the kernel the pass over the tree in a loop of its own; in the Python backend its
  calls (0.25 us of each is the call itself);
* algebra: in the kernel the rest of an evaluation, closures and forces included; in the Python
  backend LAPACK on matrices of the same size;
* stepping: the time in the kernel that no evaluation accounts for;
* Python around the kernel: the time of a run outside it.

Above ``LOOPS_OF_ALL`` loops the kernel is measured alone, the other cells are empty.

Evaluations in the kernel are measured at states of the run, since near singular configurations
they cost more; the four parts add up to one and are differences of measured times, so that a small
one may come out negative.
"""

from __future__ import annotations

import time
import timeit
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
import pinocchio as pin
from scipy.linalg import lapack

import srm_mbs as srm
from benchmarks.work_precision import timing
from benchmarks.work_precision.peers.pinocchio_dynamics import PinocchioDynamics
from benchmarks.work_precision.problems.base import Problem
from benchmarks.work_precision.problems.n_four_bars import n_four_bar
from benchmarks.work_precision.records import Results
from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.integration.kernel.run import CompiledRun
from srm_mbs.integration.kernel.system import make_kernel_system

LOOPS = (1, 2, 5, 10, 20, 40, 80, 160, 320)
LOOPS_OF_ALL = 160
"""Loops up to which ``constraintDynamics`` and whole runs of the Python backend are measured.

For 320 Pinocchio's own workspace takes 17 GB and 77 s to make (it holds second derivatives, 4 nv^3
numbers), more with its constraints; one evaluation of the Python backend takes 0.1 s.
"""
LINKS = (3, 6, 12, 24, 48, 96)
LONGEST_LOAD = 120.0
"""CPU seconds: sizes whose load-time analysis would take longer are left out."""
RTOL = 1e-8
STEPS = 60
"""About how many steps the measured runs take."""
STATES = 8
"""States of a run at which evaluations are measured."""


def per_call(call: Callable[[], Any], repeats: int, seconds: float = 0.02) -> float:
    """Least CPU microseconds of one call."""
    start = time.process_time()
    call()
    once = max(time.process_time() - start, 1e-7)
    number = max(1, int(seconds / once))
    best = min(timeit.repeat(call, number=number, repeat=repeats, timer=time.process_time))
    return 1e6 * best / number


def parts(mechanism: srm.Mechanism, repeats: int) -> dict[str, float]:
    """Microseconds of an evaluation, of Pinocchio in it, and of LAPACK in it."""
    system = make_system(mechanism)
    state = mechanism.start_state
    model, data = mechanism.model, workspace(mechanism.model)
    q, v = np.array(mechanism.q0), np.array(mechanism.v0)
    zero = np.zeros(model.nv)

    def kinematics() -> None:
        if system.has_constraints:
            pin.crba(model, data, q, pin.Convention.WORLD)
            pin.nonLinearEffects(model, data, q, v)
        else:
            pin.aba(model, data, q, v, zero)

    pin.crba(model, data, q, pin.Convention.WORLD)
    M = np.array(data.M)
    rank = mechanism.structure.rank
    G = np.random.default_rng(0).standard_normal((int(mechanism.structure.kept.sum()), model.nv))

    def algebra() -> None:
        if not system.has_constraints:
            return
        U, _ = lapack.dpotrf(M, lower=0)
        right = np.empty((model.nv, len(G) + 1), order="F")
        right[:, :-1] = G.T
        white = lapack.dtrtrs(U, right, lower=0, trans=1)[0]
        packed, _, tau, _, _ = lapack.dgeqp3(white[:, :-1])
        lapack.dorgqr(packed[:, :rank], tau[:rank])
        lapack.dtrtrs(packed[:rank, :rank], zero[:rank], lower=0, trans=1)
        lapack.dtrtrs(U, right[:, 0], lower=0, trans=0)

    return {
        "evaluation": per_call(lambda: system.evaluate(0.0, state).rate(), repeats),
        "pinocchio": per_call(kinematics, repeats),
        "lapack": per_call(algebra, repeats),
    }


def kernel_evaluation(mechanism: srm.Mechanism, t_end: float, repeats: int) -> tuple[float, float]:
    """Microseconds of an evaluation, and of the pass over the tree in it, in the kernel's own loop:
    means over states of a run."""
    kernel_system = make_kernel_system(make_system(mechanism))
    states = srm.simulate(mechanism, t_end, rtol=RTOL).steps.states
    chosen = states[np.linspace(0, len(states) - 1, STATES).astype(int)]
    number = 20

    def costs(state: FloatArray) -> tuple[float, float]:
        evaluation = per_call(lambda: kernel_system.repeat(0.0, state, number), repeats, 0.005)
        return evaluation, per_call(
            lambda: kernel_system.repeat_tree(state, number), repeats, 0.005
        )

    evaluation, tree = np.mean([costs(state) for state in chosen], axis=0) / number
    return float(evaluation), float(tree)


def _inside(mechanism: srm.Mechanism, t_end: float, repeats: int) -> tuple[float, float]:
    """Least CPU microseconds of a run, and of what it spends in the kernel."""
    advance = CompiledRun.advance
    spent = 0.0

    def timed(run: CompiledRun, steps: int = 0) -> int:
        nonlocal spent
        start = time.process_time()
        try:
            return advance(run, steps)
        finally:
            spent += time.process_time() - start

    found = []
    with patch.object(CompiledRun, "advance", timed):
        for _ in range(3 * repeats):
            spent = 0.0
            start = time.process_time()
            srm.simulate(mechanism, t_end, rtol=RTOL, backend="kernel")
            found.append((time.process_time() - start, spent))
    cost, inside = min(found)
    return 1e6 * cost, 1e6 * inside


def _run_cost(
    mechanism: srm.Mechanism, backend: str, t_end: float, repeats: int
) -> tuple[float, int, int]:
    """Least CPU microseconds of a run, its evaluations and its steps."""

    def run() -> srm.Solution:
        return srm.simulate(mechanism, t_end, rtol=RTOL, backend=backend)

    stats = run().stats
    cpu, _ = timing.repeated(run, repeats)
    return 1e6 * cpu.least, stats.evaluations, max(stats.steps, 1)


def _ours(
    mechanism: srm.Mechanism, repeats: int, whole_python: bool = True
) -> dict[str, float | None]:
    """The columns of ours; without ``whole_python`` those of Python runs are None."""
    by = "python" if srm.backend() == "python" else "kernel"
    probe = srm.simulate(mechanism, 0.5, rtol=RTOL, backend=by)
    t_end = 0.5 * STEPS / max(probe.stats.steps, 1)
    found = parts(mechanism, repeats)
    pinocchio, lapack_part, evaluation = (
        found[key] for key in ("pinocchio", "lapack", "evaluation")
    )
    cost, evaluations, steps = _run_cost(mechanism, by, t_end, repeats)
    auto = cost / evaluations
    row: dict[str, float | None] = {
        "run, per evaluation (us)": auto,
        "run, per step (us)": cost / steps,
    }
    python: float | None = None
    if by == "python":
        python = auto
    else:
        whole, inside = _inside(mechanism, t_end, repeats)
        in_kernel, tree = kernel_evaluation(mechanism, t_end, repeats)
        if whole_python:
            python_cost, python_evaluations, _ = _run_cost(mechanism, "python", t_end, repeats)
            python = python_cost / python_evaluations
        row |= {
            "evaluation in the kernel (us)": in_kernel,
            "of a run: Pinocchio": tree * evaluations / whole,
            "algebra": (in_kernel - tree) * evaluations / whole,
            "stepping": (inside - in_kernel * evaluations) / whole,
            "Python around the kernel": (whole - inside) / whole,
        }
    row |= {
        "Python backend, per evaluation (us)": python,
        "Pinocchio (us)": pinocchio,
        "LAPACK (us)": lapack_part,
    }
    of_a_run = (
        "of a Python run: Pinocchio",
        "LAPACK",
        "Python in evaluations",
        "stepping in Python",
    )
    if python is None:
        return row | dict.fromkeys(of_a_run)
    within = min(evaluation, python)
    shares = (pinocchio, lapack_part, within - pinocchio - lapack_part, python - within)
    return row | {key: share / python for key, share in zip(of_a_run, shares)}


def chain(links: int) -> srm.Mechanism:
    """An open chain of equal bars, released from a bent position."""
    model = pin.Model()
    model.name = f"chain_{links}"
    parent = 0
    length = 1.0 / links
    bar = pin.Inertia(length, np.array([length / 2.0, 0.0, 0.0]), np.eye(3) * length**3 / 12.0)
    for k in range(links):
        offset = np.array([length if k else 0.0, 0.0, 0.0])
        parent = model.addJoint(parent, pin.JointModelRY(), pin.SE3(np.eye(3), offset), f"link_{k}")
        model.appendBodyToJoint(parent, bar, pin.SE3.Identity())
        model.addBodyFrame(f"link_{k}", parent, pin.SE3.Identity(), 0)
    return srm.Mechanism(model, q0=np.full(links, 0.3 / links), v0=np.zeros(links))


def _theirs(problem: Problem, repeats: int) -> float:
    dynamics = PinocchioDynamics(problem)
    q, v = problem.tree.q0, problem.tree.v0
    return per_call(lambda: dynamics.acceleration(q, v), repeats)


def measure_scaling(
    results: Results, *, repeats: int, thin: bool, say: Callable[[str], None]
) -> None:
    """Fill ``results.scaling``: rows by number of loops, and by number of links."""
    loops: list[dict[str, Any]] = []
    results.scaling["Closed loops, N-four-bar"] = loops
    load = 0.0
    for n in LOOPS[:2] if thin else LOOPS:
        problem = n_four_bar(n)
        row: dict[str, Any] = {"loops": n, "nv": 2 * n + 1}
        if load * 8.0 > LONGEST_LOAD:
            say(f"scaling: N = {n} left out: the analysis at load would take too long")
            break
        whole = n <= LOOPS_OF_ALL
        if not whole and srm.backend() == "python":
            say(f"scaling: N = {n} left out: the Python backend would take too much memory")
            break
        load = timing.once(lambda problem=problem: problem.mechanism.structure)[0]
        row["load and analysis (s)"] = load
        row |= _ours(problem.mechanism, repeats, whole)
        per_evaluation = row["run, per evaluation (us)"]
        theirs = _theirs(problem, repeats) if whole else None
        row["constraintDynamics (us)"] = theirs
        row["ours / constraintDynamics"] = theirs and per_evaluation / theirs
        loops.append(row)
        beside = f"{theirs:.1f} us" if theirs else "left out"
        say(
            f"scaling: N = {n}: {per_evaluation:.1f} us per evaluation, constraintDynamics {beside}"
        )
    links: list[dict[str, Any]] = []
    results.scaling["Open chains, coordinates"] = links
    for n in LINKS[:2] if thin else LINKS:
        mechanism = chain(n)
        row = {"nv": n, **_ours(mechanism, repeats)}
        data = mechanism.model.createData()
        q, v, zero = np.array(mechanism.q0), np.array(mechanism.v0), np.zeros(n)
        theirs = per_call(
            lambda model=mechanism.model, data=data, q=q, v=v, zero=zero: pin.aba(
                model, data, q, v, zero
            ),
            repeats,
        )
        row["aba (us)"] = theirs
        row["ours / aba"] = row["run, per evaluation (us)"] / theirs
        links.append(row)
        say(f"scaling: {n} links: {row['run, per evaluation (us)']:.1f} us, aba {theirs:.1f} us")
