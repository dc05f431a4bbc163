r"""The mechanisms of the thesis as systems, evaluated as it has them.

Nothing is added around singular configurations: no zone and no placement of steps, since the
runs show what the published method does there.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from srm_mbs.dynamics.multibody import ClosedSystem
from srm_mbs.dynamics.system import Terms, Zone

GRAVITY = 9.81
"""m/s^2; the thesis prints no value, and this one gives its figures."""


def slider_crank_state(theta: float, omega: float) -> tuple[FloatArray, FloatArray]:
    """(q, v) of the thesis' slider-crank on its branch theta_2 = 2 pi - theta_1.

    q = (x_1, y_1, theta_1, x_2, y_2, theta_2): centres and angles of the bars (m, rad).
    """
    c, s = np.cos(theta), np.sin(theta)
    q = np.array([c, s, theta, 3 * c, s, 2 * np.pi - theta])
    return q, omega * np.array([-s, c, 1.0, -3 * s, c, -1.0])


def slider_crank(theta: float = 7 * np.pi / 4, omega: float = 0.0) -> srm.Mechanism:
    """Two bars of 2 m and 1 kg in maximal coordinates (thesis, section 5.6).

    Each bar moves on two massless prismatic joints and a revolute one at its centre; the closures
    are the pivot, the pin between the bars, and the end of the second bar on the x axis.
    """
    model = pin.Model()
    model.name = "thesis_slider_crank"
    model.gravity.linear = np.array([0.0, -GRAVITY, 0.0])
    here = pin.SE3.Identity()
    for bar in ("crank", "rod"):
        joint = 0
        for name, kind in (
            ("x", pin.JointModelPX()),
            ("y", pin.JointModelPY()),
            ("theta", pin.JointModelRZ()),
        ):
            joint = model.addJoint(joint, kind, here, f"{bar}_{name}")
        inertia = np.diag([0.0, 1.0, 1.0]) / 3.0
        model.appendBodyToJoint(joint, pin.Inertia(1.0, np.zeros(3), inertia), here)
        model.addBodyFrame(bar, joint, here, 0)
    start, end = (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)
    world = srm.Anchor("world")
    loops = (
        srm.LoopClosure("point", srm.Anchor("crank", xyz=start), world, name="pivot"),
        srm.LoopClosure(
            "point", srm.Anchor("rod", xyz=start), srm.Anchor("crank", xyz=end), name="pin"
        ),
        srm.LoopClosure(
            "point_on_plane", srm.Anchor("rod", xyz=end), world, (0.0, 1.0, 0.0), name="slider"
        ),
    )
    q, v = slider_crank_state(theta, omega)
    return srm.Mechanism(model, loops, q0=q, v0=v)


class _FixedAxesRows:
    """The thesis' rows g, G and Gdot v of the slider-crank: all in world axes.

    The package resolves the pin in the axes of the crank.  On the constraints that is the same, but
    with a tolerance of 0.01 the thesis' runs are so far off them that it shows.  World rows of the
    pin are differences of the world positions of its two points.
    """

    _SELECT = np.array(
        # pivot x, y; crank tip x, y; rod start x, y; rod end y
        [
            [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        ]
    )

    def __init__(self, mechanism: srm.Mechanism) -> None:
        pivot, pin_, slider = mechanism.loops
        world = srm.Anchor("world")
        points = (
            pivot,
            srm.LoopClosure("point", pin_.b, world, name="tip"),
            srm.LoopClosure("point", pin_.a, world, name="start"),
            slider,
        )
        keep = np.array(3 * [True, True, False] + [True])
        self._points = LoopKinematics(mechanism.model, points, keep=keep)
        scale = mechanism.structure.row_scale[mechanism.structure.kept]
        self._select = self._SELECT / scale[:, None]

    def fill(
        self, rows: LoopKinematics, data: pin.Data, q: FloatArray, v: FloatArray | None
    ) -> None:
        """Put g, G and Gdot v into ``rows``."""
        points, select = self._points, self._select
        points.update(data, q, v)
        rows.g[:], rows.G[:] = select @ points.g, select @ points.G
        rows.bias[:] = select @ points.bias


class Published(ClosedSystem):
    """Index 3, stabilised: the sweeps of (2.6), without a zone around singular configurations."""

    carries_yhat = False

    def __init__(self, mechanism: srm.Mechanism) -> None:
        super().__init__(mechanism)
        fixed, rows = _FixedAxesRows(mechanism), self.loops

        def update(data: pin.Data, q: FloatArray, v: FloatArray | None = None) -> None:
            fixed.fill(rows, data, q, v)

        # The terms hold these rows already: they are filled differently, not replaced.
        rows.update = update  # type: ignore[method-assign]


class _Index2Terms:
    """Terms whose sweep leaves the positions alone; the rest of the contract is not used."""

    def __init__(self, terms: Terms, v: FloatArray) -> None:
        self._terms = terms
        self._v = v
        self.sigma, self.rank, self.rank_deficient = terms.sigma, terms.rank, terms.rank_deficient

    def rate(self) -> FloatArray:
        return self._terms.rate()

    def sweep(self, previous: FloatArray, eps: float) -> tuple[FloatArray, FloatArray]:
        rate, yhat = self._terms.sweep(previous, eps)
        rate[: self._v.size] = self._v
        return rate, yhat


class Index2(Published):
    """Index 2: the constraint is G v = 0 alone, (2.4): q' = v without -E g/eps."""

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> Terms:
        """See :class:`~srm_mbs.dynamics.system.System`."""
        terms = super().evaluate(t, state, zone)
        return _Index2Terms(terms, state[self.nq :])  # type: ignore[return-value]


class _PendulumTerms:
    """Terms of the pendulum at one point."""

    sigma = 1.0
    rank = 1
    rank_deficient = False

    def __init__(self, state: FloatArray) -> None:
        p, v = state[:2], state[2:]
        self._v = v
        # G = 2 p^T and M = 1, so E = p / (2 p.p) and P = p p^T / p.p.
        self._g = p @ p - 1.0
        self._direction = p / (p @ p)
        self._p = p

    def _project(self, w: FloatArray) -> FloatArray:
        return self._direction * (self._p @ w)

    def _force(self) -> FloatArray:
        return np.array([0.0, -GRAVITY])

    def rate(self) -> FloatArray:
        centripetal = self._direction * (self._v @ self._v)
        force = self._force()
        return np.concatenate([self._v, force - self._project(force) - centripetal])

    def sweep(self, previous: FloatArray, eps: float) -> tuple[FloatArray, FloatArray]:
        yhat = self._project(previous + self._v / eps)
        dp = self._v - self._direction * (0.5 * self._g / eps)
        return np.concatenate([dp, self._force() - yhat]), yhat


class CartesianPendulum:
    """Unit mass on a massless unit rod, state (x, z, x', z') in m and m/s; g = x^2 + z^2 - 1.

    Only what fixed-step sweeps of (2.6) need of the contract of
    :class:`~srm_mbs.dynamics.system.System`.
    """

    has_constraints = True
    time_unit = " s"
    singularities = None
    branch_system = None
    carries_yhat = False
    predicts = True
    tangent_size = 4
    multiplier_size = 2
    multiplier_part = slice(2, 4)

    def __init__(self) -> None:
        self.evaluations = 0

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> Terms:
        """G, E and P in closed form."""
        self.evaluations += 1
        return _PendulumTerms(state)  # type: ignore[return-value]

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """x + dx."""
        return state + delta

    def chart_rate(self, delta: FloatArray, rate: FloatArray) -> FloatArray:
        """``rate`` itself."""
        return rate

    def state_scale(self, state: FloatArray) -> FloatArray:
        """|x|."""
        return np.abs(state)

    def constraint_residual(self, t: float, state: FloatArray) -> float:
        """|g|."""
        return abs(float(state[:2] @ state[:2]) - 1.0)

    friction_speed = np.inf

    @property
    def friction_sums(self) -> FloatArray:
        """None: there is no friction."""
        return np.zeros((0, self.multiplier_part.start))

    def friction_tolerance(self, v: FloatArray) -> FloatArray:
        return np.full(self.tangent_size, np.inf)

    def step_limit(self, state: FloatArray) -> float:
        """No limit."""
        return np.inf

    def rescale(self, t: float, state: FloatArray) -> bool:
        """False: there is nothing that sizes are relative to."""
        return False

    def begin_step(self, t: float, state: FloatArray) -> None:
        """Nothing jumps."""

    def past_jump(self, t: float, state: FloatArray) -> float:
        """Nothing jumps."""
        return -np.inf
