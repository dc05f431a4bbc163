"""The state of a run in the browser while it is computed."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rheonomic import constraint_errors
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.errors import InputError, get_logger
from srm_mbs.model.anchors import Anchor
from srm_mbs.visualization.animation.joint_motion import JointMotion
from srm_mbs.visualization.animation.meshcat_scene import draw_picture, node_names
from srm_mbs.visualization.animation.overlays import Overlays, ViewOptions
from srm_mbs.visualization.animation.page import (
    DRIFT,
    ENERGY,
    drift_unit,
    make_page,
    page_data,
)
from srm_mbs.visualization.animation.playback import (
    REPLY_TIME,
    close,
    serve,
    show,
    wait,
)
from srm_mbs.visualization.animation.scene import make_picture
from srm_mbs.visualization.animation.trajectory import DrawableMotion

log = get_logger(__name__)

SHARE = 0.03
"""Largest part of the wall time of the run that the view takes."""
SHORTEST_INTERVAL, LONGEST_INTERVAL = 0.01, 0.04
"""Seconds between two calls below and above which the stride is doubled or halved."""
LARGEST_STRIDE = 4096
"""Most steps between two calls."""
PATIENCE = 2.0
"""Time (s) for the server to accept one state."""
SERVER_GONE_REMEDY = (
    "Use solution.play(), which starts a server, or solution.export_html(path), which needs none"
)
"""Remedy if the server of a view has stopped."""
CAMERA_MARGIN = 1.6
"""Distance of the camera over the one that shows the start: the extent of the motion is not known
in advance."""


class LiveView:
    """Shows the state of a run in the browser: ``simulate(mechanism, 10.0, progress=view)``.

    The view takes at most the part :data:`SHARE` of the wall time, by leaving states out.  The
    panel has the time, the closure error and the change of the energy since the first step.  Only
    bodies are drawn; :meth:`play` adds springs and overlays.  As a context manager it stops serving
    at its end.

    Parameters
    ----------
    mechanism
        The simulated mechanism.  The closure error and the energy are those of its closures and
        forces, also after an event has released one.
    open_browser
        Open a browser window; otherwise only serve the page.  Its address is logged.

    Attributes
    ----------
    visualizer
        The meshcat Visualizer.
    shown, spent
        Number of states that were shown, and the time that this took, s.
    stride
        Number of steps between two calls that the view requests from the run.

    Raises
    ------
    InputError
        If meshcat is missing or cannot start.
    """

    def __init__(self, mechanism: Mechanism, *, open_browser: bool = True) -> None:
        start = JointMotion(mechanism, np.zeros(1), np.array(mechanism.q0)[None])
        picture = make_picture(start, 1.0, ViewOptions())
        view = replace(picture.view, distance=CAMERA_MARGIN * picture.view.distance)
        picture = replace(picture, view=view, overlays=Overlays())
        data = page_data(start, picture)
        self._system, self._energy = make_system(mechanism), math.nan
        unit = drift_unit(start)
        data["values"] = [{"label": DRIFT, "unit": unit, "live": 1}] if unit else []
        data["values"].append({"label": ENERGY, "unit": "J", "live": 2})
        names = node_names(mechanism)
        self._joints = sorted({visual.joint for visual in picture.visuals} - {0})
        data["live"] = [names[joint] for joint in self._joints]
        page = make_page(mechanism.name, data, None)
        self.visualizer = serve(page, picture)
        self._mechanism, self._data = mechanism, workspace(mechanism.model)
        self._node = self.visualizer["/live"]
        self._began = self._last = 0.0
        self.spent, self.shown, self.stride = 0.0, 0, 1
        # The cost of one state is measured before the run.
        began = time.perf_counter()
        try:
            self._send(0.0, mechanism.start_state, REPLY_TIME)
        except BaseException:
            self.close()
            raise
        self._cost = time.perf_counter() - began
        self.shown, self._energy = 0, math.nan
        show(self.visualizer, mechanism.name, open_browser=open_browser)

    def __call__(self, t: float, h: float, state: FloatArray) -> None:
        """Show the state (nq + nv,) at t (s), if the share of time allows it."""
        now = time.perf_counter()
        if not self._began:
            self._began = self._last = now
            self._energy = self._system.energy(state)
            return
        if now - self._last < SHORTEST_INTERVAL:
            self.stride = min(2 * self.stride, LARGEST_STRIDE)
        elif now - self._last > LONGEST_INTERVAL:
            self.stride = max(self.stride // 2, 1)
        self._last = now
        if self.spent + self._cost > SHARE * (now - self._began):
            return
        try:
            self.send(t, state)
        except InputError:  # a failure of the page must not stop the run
            log.warning("the page no longer follows the run: its server does not answer")
            self.spent = math.inf
            return
        self._last = time.perf_counter()
        self._cost = self._last - now
        self.spent += self._cost

    def send(self, t: float, state: FloatArray) -> None:
        """Show the state (nq + nv,) at t (s).

        Raises
        ------
        InputError
            If the server does not answer, or has stopped.
        """
        self._send(t, state, PATIENCE)

    def _send(self, t: float, state: FloatArray, patience: float) -> None:
        model = self._mechanism.model
        q, v = np.split(state, [model.nq])
        pin.forwardKinematics(model, self._data, q)
        energy = self._system.energy(state)
        if math.isnan(self._energy):
            self._energy = energy
        g, _ = constraint_errors(self._mechanism, np.array([t]), q[None], v[None])
        head = np.zeros((4, 4))
        head[:3, 0] = t, np.linalg.norm(g), energy - self._energy
        # One command for all bodies, because each waits for the server's answer.
        places = [self._data.oMi[joint].homogeneous for joint in self._joints]
        with self.visualizer.window.answering(patience, SERVER_GONE_REMEDY):
            self._node.set_transform(np.hstack([head, *places]))
        self.shown += 1

    def play(
        self,
        solution: DrawableMotion,
        *,
        trace: Sequence[Anchor] = (),
        gaps: bool = False,
        reactions: bool = False,
        arrows: bool = False,
    ) -> None:
        """Play the run in the same page.

        Parameters
        ----------
        solution
            The run.
        trace, gaps, reactions, arrows
            The overlays, as for :meth:`srm_mbs.Solution.play`.

        Raises
        ------
        InputError
            If the server does not answer, or has stopped, or an overlay cannot be drawn.
        """
        picture = make_picture(solution, 60.0, ViewOptions(trace, gaps, reactions, arrows))
        data = page_data(solution, picture)
        with self.visualizer.window.answering(REPLY_TIME, SERVER_GONE_REMEDY):
            self.visualizer["/about"].set_property("about", json.dumps(data, allow_nan=False))
            draw_picture(self.visualizer, picture)

    def wait(self) -> None:
        """Serve until Ctrl-C."""
        wait(self.visualizer)

    def close(self) -> None:
        """Stop serving; an open page keeps its last state."""
        close(self.visualizer)

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        if not self.visualizer.window.closed:
            self.close()
