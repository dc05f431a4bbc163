"""The regularisation parameter eps of the sweeps: a time, a multiple or a power of the step."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np

from srm_mbs.errors import InputError, safe_repr
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.model.numbers import finite_array

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_FORM = re.compile(
    rf"\s*(?P<factor>{_NUMBER})?\s*\*?\s*h\s*"
    rf"(?:(?:\^|\*\*)\s*(?:(?P<power>{_NUMBER})|\(\s*(?P<top>\d+)\s*/\s*(?P<bottom>\d+)\s*\)))?\s*\Z"
)
_FARTHEST = 50.0
"""Beyond any real stability limit of the explicit schemes of the package."""


@dataclass(frozen=True)
class Regularisation:
    """eps = factor h^power; power 0 for a fixed eps (s), 1 for a multiple of the step.

    With another power, h counts in seconds: eps = factor (h / 1 s)^power s.
    """

    factor: float
    power: float

    def __call__(self, h: float) -> float:
        """eps (s) for a step of length ``h`` (s)."""
        return self.factor * math.pow(h, self.power)


def parse_eps(value: Any) -> Regularisation:
    """eps from a positive number (s) or a text: ``"h"``, ``"5h"``, ``"h^0.667"``, ``"h^(2/3)"``.

    Raises
    ------
    InputError
        If it is neither.
    """
    factor, power = math.nan, 0.0
    if isinstance(value, str):
        match = _FORM.match(value)
        if match:
            factor, power = float(match["factor"] or 1.0), float(match["power"] or 1.0)
            if match["top"] and int(match["bottom"]):
                power = float(Fraction(int(match["top"]), int(match["bottom"])))
            elif match["top"]:
                power = math.nan
    elif isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool):
        number = finite_array(value, ())
        factor = math.nan if number is None else float(number)
    if not (math.isfinite(factor) and factor > 0.0 and math.isfinite(power)):
        raise InputError(
            f"eps = {safe_repr(value)} is neither a positive number nor a power of the step",
            element="eps",
            remedy='Give seconds, or "h", "5h", "h^0.5", "h^(2/3)" with the step h',
        )
    return Regularisation(factor, power)


def stability_function(scheme: ButcherTableau, z: complex) -> complex:
    """R(z): the factor of a step h of z' = lambda z, for h lambda = ``z``."""
    s = scheme.n_stages
    stages = np.linalg.solve(np.eye(s) - z * scheme.A, np.ones(s))
    return complex(1.0 + z * (scheme.b @ stages))


@lru_cache(maxsize=64)
def real_stability_limit(scheme: ButcherTableau) -> float:
    """Largest x such that the scheme damps z' = -z/eps for all h/eps in [0, x].

    2 for fe, trap and heun, 2.51 tvd32, 2.79 erk4, 3.31 dopr54, 6.39 dop853.
    """

    def growth(x: float) -> float:
        return abs(stability_function(scheme, -x))

    grid = np.linspace(0.0, _FARTHEST, 2001)[1:]
    low, high = 0.0, _FARTHEST
    for x in grid.tolist():
        if growth(x) > 1.0 + 1e-12:
            high = x
            break
        low = x
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if growth(middle) <= 1.0 + 1e-12 else (low, middle)
    return low
