"""A mechanism in the compiled kernel, and the reference with the kernel's regular stages."""

from __future__ import annotations

from typing import Any

from srm_mbs._kernel import core
from srm_mbs.arrays import FloatArray
from srm_mbs.systems.base import Zone
from srm_mbs.systems.multibody import ClosedSystem, OpenSystem


def twin_of(system: ClosedSystem | OpenSystem) -> Any:
    """The kernel's twin of ``system``, with a workspace of its own."""
    held = system.held
    calls = system.calls_forces or (system.controlled and held is None)
    controller = system.called_force if calls else None
    twin = core.System(system.model, system.constants(), controller)  # type: ignore[union-attr]
    if held is not None:
        for t, force in zip(held.times, held.values):
            twin.hold(t, force, True)
    return twin


class _TwinTerms:
    """Terms of a regular stage, evaluated by the kernel."""

    weak = False
    held = False

    def __init__(self, found: dict[str, Any]) -> None:
        self.sigma: float = found["sigma"]
        self.rank: int = found["rank"]
        self._found = found

    def rate(self) -> FloatArray:
        return self._found["rate"]  # type: ignore[no-any-return]

    def multiplier(self) -> FloatArray:
        return self._found["multiplier"]  # type: ignore[no-any-return]


class Evaluator:
    """A system whose stages outside the zone are evaluated by the kernel.

    Parameters
    ----------
    system, twin
        The mechanism, and what :func:`twin_of` made of it.
    """

    def __init__(self, system: ClosedSystem | OpenSystem, twin: Any) -> None:
        self._system = system
        self._twin = twin

    def __getattr__(self, name: str) -> Any:
        return getattr(self._system, name)

    def between(self, first: float, last: float) -> None:
        """Times of both within [``first``, ``last``] (s); see :mod:`..stepping.breakpoints`."""
        self._system.between(first, last)
        self._twin.between(first, last)

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> Any:
        """Terms of a stage; see :class:`~srm_mbs.systems.base.System`."""
        if zone is None:
            try:
                return _TwinTerms(self._twin.terms(t, state))
            except ArithmeticError:
                pass  # the reference says why
        return self._system.evaluate(t, state, zone)
