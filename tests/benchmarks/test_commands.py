"""The commands of the benchmarks that nothing else runs."""

from __future__ import annotations

import importlib
import pkgutil

import pytest

import benchmarks
from benchmarks import singular_cost


def test_every_module_of_the_benchmarks_can_be_imported() -> None:
    names = [
        each.name
        for each in pkgutil.walk_packages(benchmarks.__path__, "benchmarks.")
        if not each.name.endswith("__main__")
    ]
    assert len(names) > 20
    for name in names:
        importlib.import_module(name)


@pytest.mark.stress
@pytest.mark.parametrize("backend", ["kernel", "python"])
def test_the_cost_of_singularity_handling_is_measured_on_equal_runs(backend: str) -> None:
    # `measure` refuses runs that differ.
    row = singular_cost.measure(backend, "five_bar", 0.5, "dop853", 1e-8, repeats=2)
    assert row.evaluations > 100
    assert min(row.least_with, row.least_without) > 0.0
