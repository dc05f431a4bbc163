"""Names of foreign files cannot command the terminal that shows them."""

from __future__ import annotations

import logging

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.errors import get_logger, printable, warn

HOSTILE = "a\x1b[2J\u202eb\u2066c\u2028d\x07\x9b\udc80\ufeff"
ESCAPED = r"a\x1b[2J\u202eb\u2066c\u2028d\x07\x9b\udc80\ufeff"


def test_control_and_bidirectional_characters_are_shown_escaped() -> None:
    assert printable(HOSTILE) == ESCAPED
    assert printable("one\ntwo\tthree\r") == r"one\ntwo\tthree\r"
    assert printable("one\ntwo\t", keep="\n") == "one\ntwo\\t"


def test_other_texts_stay_as_they_are() -> None:
    for text in ("", "crank", "Kurbel ä", "曲柄", "\\x1b", "∥g∥ ≤ 1e-9", "כננת"):
        assert printable(text) == text
    assert printable(printable(HOSTILE)) == printable(HOSTILE)


def test_messages_of_errors_show_names_escaped_and_attributes_hold_them() -> None:
    error = srm.InputError(HOSTILE, file=HOSTILE + "\n", element=HOSTILE, remedy=HOSTILE)

    assert str(error) == f"{ESCAPED}\\n: {ESCAPED}: {ESCAPED}. {ESCAPED}"
    assert error.file == HOSTILE + "\n"
    assert error.problem == HOSTILE


@pytest.mark.parametrize(
    "error",
    [
        srm.SrmError(HOSTILE),
        srm.SimulationError(HOSTILE, None),
        srm.AssemblyError(HOSTILE, residuals={}, q=np.zeros(1), remedy=""),
        srm.AnalysisError(HOSTILE, q=np.zeros(1), remedy=""),
    ],
    ids=lambda error: type(error).__name__,
)
def test_every_error_of_the_package_shows_names_escaped(error: srm.SrmError) -> None:
    assert ESCAPED in str(error)
    assert "\x1b" not in str(error)


def test_warnings_show_names_escaped() -> None:
    with pytest.warns(srm.SrmWarning) as caught:
        warn(HOSTILE)

    assert [str(warning.message) for warning in caught] == [ESCAPED]
    assert str(srm.SrmWarning(HOSTILE)) == ESCAPED


def test_the_log_shows_names_escaped_to_every_handler(caplog: pytest.LogCaptureFixture) -> None:
    log = get_logger("srm_mbs.of_a_test")
    assert get_logger("srm_mbs.of_a_test").filters == log.filters

    with caplog.at_level(logging.INFO, "srm_mbs"):
        log.info("%s: %d steps", HOSTILE, 3)
        log.info("%s: %d steps", "crank", 3)

    assert caplog.messages == [f"{ESCAPED}: 3 steps", "crank: 3 steps"]
    assert caplog.records[1].args == ("crank", 3)  # handlers still find the values
