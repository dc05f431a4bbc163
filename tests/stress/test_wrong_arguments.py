"""Public functions refuse wrong arguments of every kind with an error of the package."""

from __future__ import annotations

import random
import signal
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import srm_mbs as srm
from srm_mbs.errors import printable, safe_repr
from tests.stress.wrong_arguments import Call, calls, wrong_values

pytestmark = [
    pytest.mark.stress,
    pytest.mark.timeout(200),
    pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="timers of POSIX"),
]

SECONDS, LONGEST = 60.0, 5.0
"""Of all calls together, and of one, which is then interrupted."""
MOST = 400
"""Calls of one function."""


class TooLong(BaseException):
    """A call takes long: a large problem is not a wrong one."""


@contextmanager
def limited() -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        raise TooLong

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, LONGEST)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def outcome(call: Call, place: int | str, value: Any) -> str:
    """``returned``, ``refused``, ``too long``, or the exception that is none of the package."""
    try:
        with warnings.catch_warnings(), limited():
            warnings.simplefilter("ignore")
            call.run({place: value})
    except (srm.SrmError, OSError) as error:
        str(error)  # can be shown
        return "refused"
    except TooLong:
        return "too long"
    except Exception as error:
        return f"{type(error).__name__}: {printable(error)}"[:200]
    return "returned"


def test_wrong_arguments_are_refused_with_an_error_of_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    known = calls(tmp_path)
    seed = random.Random(0)
    ended: Counter[str] = Counter()
    leaked = []
    for name, call in known.items():
        count = len(wrong_values())
        trials = [(place, k) for place in call.places for k in range(count)]
        until = time.monotonic() + SECONDS / len(known)
        for place, k in seed.sample(trials, min(MOST, len(trials))):
            value = wrong_values()[k]
            if (name, place) == ("sweep", "progress") and callable(value):
                continue  # what the user's own function raises stays what it is
            end = outcome(call, place, value)
            ended[end if end in ("returned", "refused", "too long") else "leaked"] += 1
            if end not in ("returned", "refused", "too long"):
                leaked.append(f"{name}, {place!r} = {safe_repr(value):.60}: {end}")
            if time.monotonic() > until:
                break

    assert not leaked, "\n".join(leaked)
    assert ended["refused"] > 3000, ended


def test_every_public_function_is_called(tmp_path: Path) -> None:
    results = {  # made by the package only
        *(
            "Assembly",
            "AssemblyMode",
            "ButcherTableau",
            "Certificate",
            "CrankMotion",
            "DaeSolution",
        ),
        *("EnergyBalance", "Equilibrium", "FollowedPath", "ForceElement", "InverseDynamics"),
        *(
            "Linearisation",
            "Linkage",
            "LinkageReport",
            "MobilityMap",
            "Solution",
            "Sweep",
            "LiveView",
        ),
        *("CLOSURE_TYPES", "FORCE_TYPES", "LAW_TYPES", "TABLEAUS"),
        *(name for name in srm.__all__ if name.endswith(("Error", "Warning"))),
    }
    known = calls(tmp_path)

    assert set(srm.__all__) - results <= set(known)
    for name, call in known.items():
        call.run({})  # the first plot loads Matplotlib's fonts
        assert outcome(call, -1, None) == "returned", name
