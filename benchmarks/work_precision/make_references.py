"""Compute the stored references again.

    python -m benchmarks.work_precision.make_references [PROBLEM ...]

One-degree problems: the reduced equation in extended precision, extrapolated midpoint rule of order
16, with two step sizes.  Others: the index-1 equations from Pinocchio's kinematics by a dense KKT
solve, Gauss collocation of order 12 with a projection after every step and two step sizes, and
SciPy's DOP853 near round-off without one; their largest difference is the accuracy that is stored.
Stiff problems: the reduced equations by SciPy's Radau with two tolerances.
"""

from __future__ import annotations

import argparse

import numpy as np

from benchmarks.work_precision.problems import PROBLEMS, andrews
from benchmarks.work_precision.problems.base import Array, Problem
from benchmarks.work_precision.references import (
    Reference,
    by_gauss,
    by_scipy,
    reduced_reference,
    write,
)
from benchmarks.work_precision.trees import Equations
from tests.support.stiff import by_radau

SUBSTEPS = (10, 12)
"""Steps from one sample to the next, of the two runs."""
RTOLS = (1e-12, 1e-11)
"""Tolerances of the two runs of a stiff problem."""


def reduced(problem: Problem) -> Reference:
    """From the one-degree model."""
    model = problem.reduced
    if model is None:
        raise ValueError(f"{problem.name} has no reduced model")
    reference = reduced_reference(model.field, model.start, problem.times)
    scipy = by_scipy(model.field, np.array(model.start), problem.times)
    print(f"  SciPy near round-off differs by {np.abs(scipy - reference.observed).max():.1e}")
    return reference


def stiff(problem: Problem) -> Reference:
    """From the reduced equations of a stiff problem."""
    model = problem.reduced
    if model is None:
        raise ValueError(f"{problem.name} has no reduced model")
    start = np.array(model.start)
    fine, coarse = (by_radau(model.field, start, problem.times, rtol) for rtol in RTOLS)
    difference = np.abs(fine - coarse)
    difference[:, problem.rates :] /= problem.rate_unit
    return Reference(
        fine, float(difference.max()), "reduced equations, SciPy's Radau with two tolerances"
    )


def index_one(problem: Problem) -> Reference:
    """From the index-1 equations of the peers' tree."""
    tree = problem.tree
    equations = Equations(tree)
    nq = tree.model.nq

    def field(t: float, y: Array) -> Array:
        q, v = equations.normalised(y[:nq]), y[nq:]
        return np.concatenate([equations.position_rate(q, v), equations.acceleration(q, v)[0]])

    def project(y: Array) -> Array:
        return np.concatenate(equations.projected(equations.normalised(y[:nq]), y[nq:]))

    def observed(y: Array) -> Array:
        return problem.observe(y[:, :nq], y[:, nq:])

    start = np.concatenate([tree.q0, tree.v0])
    runs = [observed(by_gauss(field, start, problem.times, k, project=project)) for k in SUBSTEPS]
    other = observed(by_scipy(field, start, problem.times))
    differences = [np.abs(run - runs[1]) for run in (runs[0], other)]
    for difference in differences:
        difference[:, problem.rates :] /= problem.rate_unit
    print(f"  other step: {differences[0].max():.1e}; SciPy: {differences[1].max():.1e}")
    return Reference(
        runs[1],
        float(max(difference.max() for difference in differences)),
        "index-1 equations by a dense KKT solve, Gauss collocation of order 12 with projection; "
        "SciPy's DOP853 near round-off, without, differs by no more than the accuracy",
    )


def squeezing(problem: Problem) -> Reference:
    """From the printed equations of the squeezing mechanism, in its own angles."""
    tree = problem.tree
    order = np.argsort(andrews.TREE_ORDER)
    start = andrews.project(np.concatenate([tree.q0[order], tree.v0[order]]))
    field = andrews.field
    runs = [
        andrews.in_tree_order(y)
        for y in (
            by_gauss(field, start, problem.times, SUBSTEPS[1], project=andrews.project),
            by_gauss(field, start, problem.times, SUBSTEPS[0], project=andrews.project),
            by_scipy(field, start, problem.times),
        )
    ]
    differences = [np.abs(run - runs[0]) for run in runs[1:]]
    for difference in differences:
        difference[:, problem.rates :] /= problem.rate_unit
    print(f"  other step: {differences[0].max():.1e}; SciPy: {differences[1].max():.1e}")
    return Reference(
        runs[0],
        float(max(difference.max() for difference in differences)),
        "index-1 equations as printed in the DAE test set, Gauss collocation of order 12 with "
        "projection; SciPy's DOP853 near round-off, without, differs by no more than the accuracy",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("problems", nargs="*", metavar="PROBLEM", help=", ".join(PROBLEMS))
    for name in parser.parse_args().problems or PROBLEMS:
        print(name, flush=True)
        problem = PROBLEMS[name]()
        if name == "squeezing_mechanism":
            reference = squeezing(problem)
        elif problem.stiff:
            reference = stiff(problem)
        else:
            reference = index_one(problem) if problem.reduced is None else reduced(problem)
        path = write(name, reference)
        print(f"  {path.name}: accuracy {reference.accuracy:.1e}")


if __name__ == "__main__":
    main()
