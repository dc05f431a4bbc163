"""A run seen in the browser while it is computed."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.drawing import draw_picture, import_meshcat, node_names
from srm_mbs.mechanism import Mechanism
from srm_mbs.motion import JointMotion
from srm_mbs.overlays import Overlays, Wanted
from srm_mbs.playback import close, serve, show, wait
from srm_mbs.readout import read_out
from srm_mbs.scene import ASPECT, make_picture
from srm_mbs.web_page import make_page

if TYPE_CHECKING:
    from srm_mbs.motion import Playable

log = logging.getLogger(__name__)

SHARE = 0.03
"""Part of the time of the run that showing it may take."""
OFTEN, SELDOM = 0.01, 0.04
"""Seconds between two calls below and above which they come after twice, or half, as many steps."""
MOST = 4096
PATIENCE = 2.0
"""Seconds for the server to accept one command."""
WIDER = 1.6
"""How much farther away the camera is than the start needs: where the motion goes is not known."""


class LiveView:
    """Shows the state of a run in the browser: ``simulate(mechanism, 10.0, progress=view)``.

    It takes at most :data:`SHARE` of the run's time, by leaving states out.  Bodies only, springs
    and the like come with :meth:`play`.  It is a context manager, which stops serving at its end.

    Parameters
    ----------
    mechanism
        What is simulated.
    open_browser
        Open a browser window; otherwise only serve the page.  Its address is logged.

    Attributes
    ----------
    visualizer
        The meshcat Visualizer.
    shown, spent
        How many states were shown, and the time that it took, s.
    stride
        Steps between two calls that it asks of the run for.

    Raises
    ------
    InputError
        If meshcat is missing or cannot start.
    """

    def __init__(self, mechanism: Mechanism, *, open_browser: bool = True) -> None:
        self._meshcat = import_meshcat()
        start = JointMotion(mechanism, np.zeros(1), np.array(mechanism.q0)[None])
        picture = make_picture(start, 1.0, Wanted())
        view = replace(picture.view, distance=WIDER * picture.view.distance)
        picture = replace(picture, view=view, overlays=Overlays())
        about = read_out(start, start.t) | {"notes": [], "aspect": ASPECT, "live": True}
        page = make_page(self._meshcat, mechanism.name, about, None)
        self.visualizer = serve(self._meshcat, page, picture)
        self._model, self._data = mechanism.model, mechanism.model.createData()
        names = node_names(mechanism)
        root = self.visualizer["/mechanism"]
        drawn = sorted({visual.joint for visual in picture.visuals} - {0})
        self._nodes = [(joint, root[names[joint]]) for joint in drawn]
        self._clock = self.visualizer["/live"]
        import zmq

        # A server that has died must not stop the run.
        self._lost = zmq.ZMQError
        self.visualizer.window.zmq_socket.setsockopt(zmq.RCVTIMEO, int(1000.0 * PATIENCE))
        self._began = self._last = 0.0
        self.spent, self.shown, self.stride = 0.0, 0, 1
        # What a state costs is known before the run.
        began = time.perf_counter()
        self.send(0.0, np.array(mechanism.q0))
        self._cost = time.perf_counter() - began
        self.shown = 0
        show(self.visualizer, mechanism.name, open_browser=open_browser)

    def __call__(self, t: float, h: float, state: FloatArray) -> None:
        """Show the state (nq + nv,) at t (s), if there is time for it."""
        now = time.perf_counter()
        if not self._began:
            self._began = self._last = now
            return
        if now - self._last < OFTEN:
            self.stride = min(2 * self.stride, MOST)
        elif now - self._last > SELDOM:
            self.stride = max(self.stride // 2, 1)
        self._last = now
        if self.spent + self._cost > SHARE * (now - self._began):
            return
        try:
            self.send(t, state[: self._model.nq])
        except self._lost:
            log.warning("the page no longer follows the run: its server does not answer")
            self.spent = math.inf
            return
        self._last = time.perf_counter()
        self._cost = self._last - now
        self.spent += self._cost

    def send(self, t: float, q: FloatArray) -> None:
        """Show the configuration q (nq,) at t (s)."""
        pin.forwardKinematics(self._model, self._data, q)
        for joint, node in self._nodes:
            node.set_transform(self._data.oMi[joint].homogeneous)
        place = np.eye(4)
        place[0, 3] = t
        self._clock.set_transform(place)
        self.shown += 1

    def play(self, solution: Playable, **drawn: Any) -> None:
        """Play the run in the same page.

        Parameters
        ----------
        solution
            The run.
        drawn
            ``trace``, ``gaps`` and ``reactions`` of :func:`srm_mbs.playback.play`.
        """
        draw_picture(self._meshcat, self.visualizer, make_picture(solution, 60.0, Wanted(**drawn)))

    def wait(self) -> None:
        """Serve until Ctrl+C."""
        wait(self.visualizer)

    def close(self) -> None:
        """Stop serving; a page that is open stays as it is."""
        close(self.visualizer)

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        if not self.visualizer.window.zmq_socket.closed:
            self.close()
