"""What a run was asked for, as saved runs hold it: everything but Python functions."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from srm_mbs.forces import FORCE_TYPES
from srm_mbs.methods.psrm import PSRM
from srm_mbs.methods.srm import SRM
from srm_mbs.records import Request
from srm_mbs.stepping.events import acting

if TYPE_CHECKING:
    from srm_mbs.solution import Solution

_KINDS = {"PSRM": PSRM, "SRM": SRM}


def request_entry(solution: Solution) -> dict[str, Any] | None:
    """The request of a run as JSON, with what is lost by that named."""
    request = solution.request
    if request is None:
        return None
    options = dict(request.options)
    lost = list(request.lost)
    if options.pop("controller") is not None:
        lost.append("the controller")
    if acting(options.pop("events")):
        lost.append("the actions of events")
    user = [f.name for f in solution.mechanism.forces if f.type not in FORCE_TYPES]
    lost += [f"the function of the force {name!r}" for name in user]
    method = options["method"]
    if type(method) in _KINDS.values():
        fields = asdict(method) | {"tableau": method.scheme.name}
        options["method"] = {"kind": type(method).__name__} | fields
    elif not isinstance(method, str):
        options["method"] = None
        lost.append(f"the method {type(method).__name__}")
    tableau = options["tableau"]
    options["tableau"] = getattr(tableau, "name", tableau)
    for name in ("breakpoints", "singular_times"):
        options[name] = np.asarray(options[name], dtype=float).tolist()
    # Without its events a run does not know where one of them ended it.
    end = solution.span[1] if solution.status == "event" else float(request.t_end)
    return {"t_end": end, "options": options, "lost": lost}


def request_from(entry: dict[str, Any] | None) -> Request | None:
    """The request in a saved run; None if it has none."""
    if entry is None:
        return None
    options = dict(entry["options"]) | {"controller": None, "events": None}
    if "the controller" in entry["lost"]:
        options["sample_time"] = None
    if isinstance(options["method"], dict):
        values = dict(options["method"])
        options["method"] = _KINDS[values.pop("kind")](**values)
    return Request(entry["t_end"], options, tuple(entry["lost"]))
