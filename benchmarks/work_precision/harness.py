"""Runs peers over their settings and measures them."""

from __future__ import annotations

import importlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict

import numpy as np

from benchmarks.work_precision import timing
from benchmarks.work_precision.peers.base import (
    Budget,
    NotApplicableError,
    Outcome,
    OverBudgetError,
    Peer,
    RunFailedError,
    Runner,
    Setting,
)
from benchmarks.work_precision.problems.base import Problem
from benchmarks.work_precision.records import (
    OURS,
    Measurement,
    Preparation,
    Results,
    Skipped,
)
from benchmarks.work_precision.trees import Equations

FINEST = 2e-10
"""A sweep ends once two settings in a row are this accurate, well within the tightest level."""
LIMIT = 3.0
"""CPU seconds of a call from which a sweep ends."""
Say = Callable[[str], None]


def errors_of(problem: Problem, outcome: Outcome) -> tuple[float, float | None, float | None]:
    """Error, drift (m) and energy change (J) of a run; drift and energy None where unknown."""
    with np.errstate(all="ignore"):
        if outcome.observed is not None:
            error = problem.error(outcome.observed())
            drift = None if outcome.own_drift is None else outcome.own_drift()
            energies = None if outcome.own_energy is None else outcome.own_energy()
        else:
            assert outcome.states is not None  # noqa: S101 - an outcome has one of the two
            q, v = (np.ascontiguousarray(x) for x in outcome.states())
            error = problem.error(problem.observe(q, v))
            equations = Equations(problem.tree)
            if not np.isfinite(error):
                return error, None, None
            drift = equations.largest_gap(q)
            tree = problem.tree
            energies = equations.energy(np.vstack([tree.q0, q]), np.vstack([tree.v0, v]))
        energy = None if energies is None else float(np.abs(energies - energies[0]).max())
    return error, drift, energy


def attempt(problem: Problem, runner: Runner, setting: Setting) -> tuple[Outcome, float] | str:
    """Outcome and CPU seconds of one untimed call, or ``status: message``."""
    try:
        run = runner(setting)
        cpu, _, outcome = timing.once(run)
    except RunFailedError as error:
        return f"failed: {error}"
    except OverBudgetError as error:
        return f"over budget: {error}"
    return outcome, cpu


def measured(
    problem: Problem, peer: Peer, runner: Runner, setting: Setting, repeats: int
) -> tuple[Measurement, float]:
    """One setting: an untimed call for error, drift and energy, then the timed ones; the CPU
    seconds of the untimed call."""
    name = problem.name, peer.name, setting.variant, setting.kind, setting.value
    first = attempt(problem, runner, setting)
    if isinstance(first, str):
        status, message = first.split(": ", 1)
        return Measurement(*name, status, message), 0.0
    outcome, seconds = first
    error, drift, energy = errors_of(problem, outcome)
    if not np.isfinite(error):
        return Measurement(*name, "failed", "the state is not finite"), seconds
    try:
        cpu, wall = timing.repeated(runner(setting), repeats)
    except OverBudgetError as exception:  # a repeat may take longer than the first call
        return Measurement(*name, "over budget", str(exception)), seconds
    measurement = Measurement(
        *name,
        "ok",
        error=error,
        drift=drift,
        energy=energy,
        evaluations=outcome.evaluations,
        steps=outcome.steps,
        cpu=asdict(cpu),
        wall=asdict(wall),
    )
    return measurement, seconds


def sweep(
    problem: Problem,
    peer: Peer,
    runner: Runner,
    settings: Iterable[Setting],
    repeats: int,
    limit: float,
    say: Say,
) -> Iterable[tuple[Measurement, float]]:
    """Measurements of one variant from loose to tight, with their first call's CPU seconds.

    Ends when a call takes longer than ``limit`` (s), or would by its steps, and when two settings
    in a row are accurate to FINEST.
    """
    accurate = 0
    previous: tuple[float, float] | None = None
    for setting in settings:
        if setting.kind == "step" and previous is not None:
            expected = previous[1] * previous[0] / setting.value
            if expected > limit:
                break
        measurement, seconds = measured(problem, peer, runner, setting, repeats)
        say(f"  {peer.name:28s} {_line(measurement)}")
        yield measurement, seconds
        if measurement.status == "over budget":
            break
        if measurement.cpu is not None and measurement.error is not None:
            previous = setting.value, measurement.cpu["median"]
            if measurement.cpu["median"] > limit:
                break
            accurate = accurate + 1 if measurement.error < FINEST else 0
            if accurate == 2:
                break


def _line(measurement: Measurement) -> str:
    setting = f"{measurement.kind} {measurement.setting:.1e} {measurement.variant}"
    if measurement.cpu is None:
        return f"{setting:34s} {measurement.status}: {measurement.message[:60]}"
    milliseconds = 1e3 * measurement.cpu["median"]
    return f"{setting:34s} error {measurement.error:.1e}  CPU {milliseconds:9.2f} ms"


def measure_problem(
    problem: Problem,
    peers: Sequence[Peer],
    results: Results,
    *,
    repeats: int = timing.REPEATS,
    limit: float = LIMIT,
    choose: Callable[[Sequence[Setting]], Sequence[Setting]] = lambda settings: settings,
    say: Say = print,
    save: Callable[[], None] = lambda: None,
) -> None:
    """Append everything about ``problem`` to ``results``.

    Parameters
    ----------
    repeats
        Timed calls per setting.
    limit
        CPU seconds of a call from which a sweep ends.
    choose
        Thins the settings of a sweep.
    say, save
        Shows progress; called after every peer.
    """
    Budget.seconds = 2.0 * limit
    load = timing.once(lambda: problem.mechanism.structure)[0]
    tree = problem.tree
    results.problems[problem.name] = {
        "title": problem.title,
        "t_end": problem.t_end,
        "singular": problem.singular,
        "nv": int(problem.mechanism.model.nv),
        "degrees_of_freedom": problem.mechanism.degrees_of_freedom,
        "loops": len(tree.closures),
        "rate_unit": problem.rate_unit,
        "reference": problem.reference.method,
        "reference_accuracy": problem.reference.accuracy,
    }
    say(f"{problem.name}: {problem.title}")
    for peer in peers:
        missing = peer.missing()
        if missing is not None:
            reason = f"{missing} is not installed"
            say(f"  {peer.name:28s} skipped: {reason}")
            results.skipped.append(Skipped(peer.name, reason, problem.name))
            continue
        for module in peer.modules:  # an import is no part of building a model
            importlib.import_module(module)
        try:
            peer.check(problem)
            build, _, runner = timing.once(lambda peer=peer: peer.prepare(problem))
        except NotApplicableError as error:
            say(f"  {peer.name:28s} skipped: {error}")
            results.skipped.append(Skipped(peer.name, str(error), problem.name))
            continue
        results.peers[peer.name] = peer.title
        variants: dict[str, list[Setting]] = defaultdict(list)
        for setting in choose(peer.settings(problem)):
            variants[setting.variant].append(setting)
        extra: float | None = None
        for settings in variants.values():
            for measurement, seconds in sweep(problem, peer, runner, settings, repeats, limit, say):
                results.measurements.append(measurement)
                if extra is None and measurement.cpu is not None:
                    extra = max(0.0, seconds - measurement.cpu["median"])
        if peer.name == OURS:  # the peers get what was read; we read it
            build += load
        results.preparations.append(
            Preparation(problem.name, peer.name, build, extra, peer.compiler_time)
        )
        save()
