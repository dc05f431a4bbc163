"""Messages about bad input, compared whole with ``tests/data/messages/<family>.txt``.

With ``SRM_MBS_UPDATE_SNAPSHOTS=1`` in the environment the file is written instead; read its
difference before committing it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

import srm_mbs as srm

MESSAGES = Path(__file__).parents[1] / "data" / "messages"
UPDATE = "SRM_MBS_UPDATE_SNAPSHOTS"
FOREIGN = re.compile(r"((?:is not valid (?:TOML|YAML)|is not a file name): )(.*?)(?=: '|\. [A-Z])")
"""Words of Python and its parsers, which change with their versions; the line is kept."""
LINE = re.compile(r"line [0-9]+")
LONGEST = 400
"""Characters of a message that are compared; of a longer one the first and last."""


def refused(call: Callable[[], object], folder: Path | None = None) -> str:
    """The message of the :class:`InputError` that ``call`` raises; ``folder`` is left out of it.

    Every such message names a place and ends with its remedy; with a ``folder``, the place is a
    file in it.
    """
    with pytest.raises(srm.InputError) as caught:
        call()
    error = caught.value
    assert type(error) in (srm.InputError, srm.AssemblyError)
    message = str(error)
    assert error.remedy, f"no remedy in: {message}"
    assert message.endswith(error.remedy)
    assert "Traceback" not in message
    assert "pydantic" not in message.lower()
    assert error.file or error.element, f"no place in: {message}"
    if folder is not None:
        assert error.file is not None
        assert error.file.startswith(str(folder))
        assert message.startswith(error.file)
        message = message.replace(f"{folder}{os.sep}", "").replace(str(folder), ".")
    message = FOREIGN.sub(lambda found: found[1] + " ".join(LINE.findall(found[2])), message)
    if len(message) > LONGEST:
        message = f"{message[: LONGEST // 2]} ... {message[-LONGEST // 2 :]}"
    return message.encode("unicode_escape").decode()


def check_refusals(family: str, calls: Mapping[str, Callable[[], object]]) -> None:
    """Compare the messages of calls that are refused, by the name of the case."""
    check_messages(family, {case: refused(call) for case, call in calls.items()})


def check_messages(family: str, messages: Mapping[str, str]) -> None:
    """Compare the messages of a family, by the name of the case, with its file."""
    path = MESSAGES / f"{family}.txt"
    text = "".join(f"{case}\n    {message}\n" for case, message in messages.items())
    text = re.sub(r"(\w+\.py), line \d+", r"\1, line N", text)  # of a function of the tests
    if os.environ.get(UPDATE):
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    assert text == path.read_text(encoding="utf-8"), f"set {UPDATE}=1 if these words are meant"
