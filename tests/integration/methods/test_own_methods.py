"""Methods of one's own (docs/extending.md), beside those of the package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

import srm_mbs as srm
from srm_mbs.integration.methods.base import StepResult
from tests.support.backends import needs_kernel


@dataclass(frozen=True)
class Counting(srm.PSRM):
    """The PSRM, whose steps are counted."""

    count = 0

    def step(self, *arguments: Any) -> StepResult:
        type(self).count += 1
        return super().step(*arguments)


def test_the_steps_of_a_subclass_of_psrm_are_its_own() -> None:
    mechanism = srm.load("four_bar")
    run = srm.simulate(mechanism, 0.5, method=Counting())
    assert run.settings.backend == "python"
    assert Counting.count >= run.stats.steps > 0
    assert run.q.tolist() == srm.simulate(mechanism, 0.5, backend="python").q.tolist()


@needs_kernel
@pytest.mark.parametrize("backend", ["kernel", "generated"])
def test_the_kernel_does_not_pass_for_a_subclass_of_psrm(backend: str) -> None:
    with pytest.raises(srm.InputError, match="the compiled kernel cannot make this run"):
        srm.simulate(srm.load("four_bar"), 0.5, method=Counting(), backend=backend)


class Partial:
    """A method without the end of the protocol."""

    scheme: Any = srm.TABLEAUS["dopr54"]

    def start(self, *arguments: Any) -> None: ...
    def step(self, *arguments: Any) -> None: ...
    def accept(self, *arguments: Any) -> None: ...


class Named(Partial):
    """A method with a name in place of its tableau."""

    scheme = "dopr54"

    def resume(self, *arguments: Any) -> None: ...


def test_what_a_method_lacks_is_named() -> None:
    mechanism = srm.load("four_bar")
    with pytest.raises(srm.InputError, match="is not a method: it has no resume"):
        srm.simulate(mechanism, 0.5, method=Partial())  # type: ignore[arg-type]
    with pytest.raises(srm.InputError, match="the scheme of the method is 'dopr54'"):
        srm.simulate(mechanism, 0.5, method=Named())  # type: ignore[arg-type]
