r"""The description of a semi-explicit differential-algebraic equation of index 2.

x' = f(t, x) - B(t, x) y,    0 = g(t, x),    G = dg/dx,    G B regular but for isolated points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from srm_mbs.errors import InputError, safe_repr

Callback = Callable[[float, Any], Any]
"""(t, x) -> array; x has shape (nx,)."""


@dataclass(frozen=True, eq=False)
class SemiExplicitDAE:
    """x' = f(t, x) - B(t, x) y, 0 = g(t, x), with nx states and ny multipliers.

    Parameters
    ----------
    f
        (t, x) -> (nx,), or a number for nx = 1, as of B and G.
    B
        (t, x) -> (nx, ny), or (nx,) for ny = 1.
    g
        (t, x) -> (ny,), or a number for ny = 1.
    G
        (t, x) -> dg/dx (ny, nx), or (nx,) for ny = 1.
    g_t
        (t, x) -> the partial derivative dg/dt (ny,); None if g does not depend on t, or if only
        methods without the exact prediction are used.

    Raises
    ------
    InputError
        If one of them cannot be called.
    """

    f: Callback
    B: Callback
    g: Callback
    G: Callback
    g_t: Callback | None = None

    def __post_init__(self) -> None:
        for name in ("f", "B", "g", "G", "g_t"):
            value = getattr(self, name)
            if not callable(value) and not (name == "g_t" and value is None):
                raise InputError(
                    f"{name} = {safe_repr(value)} cannot be called",
                    element=name,
                    remedy="Give a function of (t, x)",
                )
