"""The problems, by name; a module each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType

from benchmarks.work_precision.problems.andrews import squeezing_mechanism
from benchmarks.work_precision.problems.base import Problem
from benchmarks.work_precision.problems.cassie import cassie
from benchmarks.work_precision.problems.n_four_bars import n_four_bar
from benchmarks.work_precision.problems.pendulum_chain import pendulum_chain
from benchmarks.work_precision.problems.slider_cranks import regular, whirl
from benchmarks.work_precision.problems.spatial_four_bar import spatial_four_bar
from benchmarks.work_precision.problems.stiff import bushing, friction, governor
from benchmarks.work_precision.problems.walking_robot import walking_robot

PROBLEMS: Mapping[str, Callable[[], Problem]] = MappingProxyType(
    {
        "slider_crank_whirl": whirl,
        "slider_crank_regular": regular,
        **{f"n_four_bar_{n}": partial(n_four_bar, n) for n in (1, 2, 5, 20, 40)},
        "squeezing_mechanism": squeezing_mechanism,
        "spatial_four_bar": spatial_four_bar,
        "walking_robot": walking_robot,
        "cassie": cassie,
        "pendulum_chain": pendulum_chain,
        "bushing": bushing,
        "friction": friction,
        "governor": governor,
    }
)
