"""A run seen in the browser while it is computed."""

from __future__ import annotations

import signal
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.constraints.rheonomic import constraint_errors
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.visualization.animation.live import SHARE
from srm_mbs.visualization.animation.playback import serve
from tests.support.browsing import bodies_in, opened, placements
from tests.support.bundled import load
from tests.support.commands import run


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may keep a server that lives from answering for longer than a run waits."""
    monkeypatch.setattr("srm_mbs.visualization.animation.live.PATIENCE", 60.0)


@pytest.mark.browser
def test_the_page_follows_the_run_and_then_plays_it(browser: Any) -> None:
    mechanism = load("four_bar")
    solution = srm.simulate(mechanism, 1.5)
    with (
        srm.LiveView(mechanism, open_browser=False) as view,
        opened(browser, view.visualizer.url()) as page,
    ):
        assert page.locator("#bar").is_visible() is False
        for t in (0.4, 1.1):
            view.send(t, np.concatenate(solution(t)))
            page.wait_for_function(f"element('panel').innerText.includes('{t:.3f}')")
            found, expected = bodies_in(page), placements(mechanism, solution(t)[0])
            for joint, name in enumerate(mechanism.joint_names, 1):
                assert np.abs(found[name] - expected[joint].homogeneous).max() < 1e-9
        view.play(solution, reactions=True)
        page.wait_for_function("animator.playing && animator.time > 0.1")
        assert page.evaluate("animator.duration") == pytest.approx(1.5, rel=1e-6)
        page.wait_for_function("!element('bar').hidden")
        # What there is to say about the whole run has come with it.
        page.get_by_role("button", name="Legend").click()  # the window is small
        words = page.locator("#panel").inner_text()
        assert "sigma" in words
        assert "force in the closures" in words


@pytest.mark.browser
def test_the_live_panel_has_the_drift_and_the_energy_since_the_first_step(browser: Any) -> None:
    mechanism = load("four_bar")
    solution = srm.simulate(mechanism, 1.5, rtol=1e-4)
    read = solution.at([0.1, 1.1])
    # Off the closures, as far as none of the run is: the digits are those of the error.
    apart = np.concatenate([read.q[1] + [0.0, 0.0, 1e-3], read.v[1]])
    with (
        srm.LiveView(mechanism, open_browser=False) as view,
        opened(browser, view.visualizer.url()) as page,
    ):
        view(0.1, 0.1, np.concatenate([read.q[0], read.v[0]]))
        for state in (np.concatenate([read.q[1], read.v[1]]), apart):
            view.send(1.1, state)
            q, v = state[None, :3], state[None, 3:]
            g = constraint_errors(mechanism, np.array([1.1]), q, v)[0]
            change = make_system(mechanism).energy(state) - read.energy[0]
            page.wait_for_function(
                """([drift, change]) => {
                  const rows = document.querySelectorAll("#panel tr");
                  if (rows.length !== 3 || rows[0].cells[1].textContent !== "1.100") return false;
                  const read = row => +row.cells[1].textContent.replace("\u2212", "-")
                    .replace("e\u2212", "e-");
                  const close = (a, b) => Math.abs(a - b) <= 6e-3 * Math.abs(b);
                  return close(read(rows[1]), drift) && close(read(rows[2]), change);
                }""",
                arg=[float(np.linalg.norm(g)), float(change)],
            )
        assert page.locator("#panel tr").all_inner_texts()[1].endswith("m")


@pytest.mark.parametrize("backend", ["auto", "python"])
def test_a_run_that_is_watched_is_the_same_and_takes_hardly_longer(backend: str) -> None:
    mechanism = load("jansen_walker")
    compiled = srm.backend() == "kernel" and backend == "auto"
    t_end = 20.0 if compiled else 1.0
    alone = srm.simulate(mechanism, t_end, backend=backend)
    with srm.LiveView(mechanism, open_browser=False) as view:
        calls = []

        def counted(t: float, h: float, state: Any) -> None:
            calls.append(t)
            view(t, h, state)
            counted.stride = view.stride  # type: ignore[attr-defined]

        began = time.perf_counter()
        watched = srm.simulate(mechanism, t_end, backend=backend, progress=counted)
        wall = time.perf_counter() - began
    assert np.array_equal(watched.t, alone.t)
    assert np.array_equal(watched.q, alone.q)
    # Up to the last state, whose time is known only after it.
    assert view.spent - view._cost <= SHARE * wall
    assert calls == sorted(set(calls))
    assert calls[-1] <= t_end
    if compiled:
        assert len(calls) < 0.9 * watched.stats.steps  # the kernel goes on by itself in between


def test_states_are_shown_as_often_as_the_share_of_the_time_allows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mechanism = load("four_bar")
    state = np.concatenate([mechanism.q0, mechanism.v0])
    now = 100.0
    shown = []

    def send(t: float, q: Any) -> None:
        nonlocal now
        shown.append(t)
        now += 0.006

    with srm.LiveView(mechanism, open_browser=False) as view:
        monkeypatch.setattr(
            "srm_mbs.visualization.animation.live.time", SimpleNamespace(perf_counter=lambda: now)
        )
        monkeypatch.setattr(view, "send", send)
        monkeypatch.setattr(view, "_cost", 0.006)
        for _ in range(5000):
            view(now, 0.0, state)
            now += 0.002
    # 10 s, and 6 ms for each state.
    assert len(shown) == pytest.approx(SHARE * (now - 100.0) / 0.006, abs=1.5)
    assert shown[0] - 100.0 == pytest.approx(0.006 / SHARE, abs=0.003)
    assert view.spent == pytest.approx(0.006 * len(shown))


def test_the_command_line_shows_a_run_while_it_is_computed_and_then_plays_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    served = []

    def interrupt(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("webbrowser.open", lambda address, new=0: served.append(address) or True)
    monkeypatch.setattr("srm_mbs.visualization.animation.playback.time.sleep", interrupt)
    said = run("simulate", "four_bar", "--t-end", "0.2", "--live")
    assert len(served) == 1
    assert served[0] in said
    assert "Ctrl-C" in said


def test_a_server_that_dies_ends_the_view_and_not_the_run(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("srm_mbs.visualization.animation.live.PATIENCE", 0.2)
    mechanism = load("four_bar")
    state = np.concatenate([mechanism.q0, mechanism.v0])
    with srm.LiveView(mechanism, open_browser=False) as view:
        view(0.0, 0.0, state)
        process = view.visualizer.window.server_proc
        process.kill()
        process.wait()
        monkeypatch.setattr(view, "_cost", 0.0)  # it need not wait until there is time
        for t in (0.1, 0.2):
            view(t, 0.0, state)
    assert view.shown == 0
    assert caplog.text.count("no longer follows the run") == 1


def test_a_server_that_is_gone_is_an_input_error_with_another_way_to_see_the_run() -> None:
    mechanism = load("four_bar")
    solution = srm.simulate(mechanism, 0.2)
    with srm.LiveView(mechanism, open_browser=False) as view:
        view.visualizer.window.server_proc.kill()
        view.visualizer.window.server_proc.wait()
        for use in (lambda: view.play(solution), lambda: view.send(0.2, solution.steps.states[-1])):
            with pytest.raises(srm.InputError, match=r"has stopped. Use solution\.play\(\)"):
                use()
    with pytest.raises(srm.InputError, match="has stopped"):
        view.play(solution)


def test_a_server_that_answered_too_late_still_plays_the_run(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("srm_mbs.visualization.animation.live.PATIENCE", 0.05)
    mechanism = load("four_bar")
    solution = srm.simulate(mechanism, 0.2)
    state = solution.steps.states[-1]
    with srm.LiveView(mechanism, open_browser=False) as view:
        process = view.visualizer.window.server_proc
        process.send_signal(signal.SIGSTOP)
        with pytest.raises(srm.InputError, match="does not answer"):
            view.send(0.2, state)
        view(0.0, 0.0, state)
        monkeypatch.setattr(view, "_cost", 0.0)
        view(0.2, 0.0, state)
        assert caplog.text.count("no longer follows the run") == 1
        process.send_signal(signal.SIGCONT)
        view.play(solution)


def test_a_view_whose_server_does_not_answer_stops_it_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    served = []

    def stopped(*arguments: Any) -> Any:
        served.append(serve(*arguments))
        served[0].window.server_proc.send_signal(signal.SIGSTOP)
        return served[0]

    monkeypatch.setattr("srm_mbs.visualization.animation.live.serve", stopped)
    monkeypatch.setattr("srm_mbs.visualization.animation.live.REPLY_TIME", 0.05)
    with pytest.raises(srm.InputError, match="the server of the page does not answer"):
        srm.LiveView(load("four_bar"), open_browser=False)
    assert served[0].window.server_proc.poll() is not None
