r"""Where sweeps cannot pass a singular configuration, the split form does.

Sweeps take short steps: their error is a power of eps, which is about as long as a step.  Next to a
singular configuration their algebra has to be evaluated on the branch (:mod:`.branch`), and what
rounding of the positions, u, does to h times the acceleration there is

    2 w h |v| u / sigma^2,   w = |d sigma / dt| / sigma.

A step that crosses has stages at a fraction of |d sigma / dt| h, so that this grows like 1/h^2 as
steps get shorter, and no tolerance below it can be kept, however short the step.  Longer steps can:
the limit of infinitely many sweeps, whose multiplier is E gamma, is the split form of the same
tableau (:mod:`.split`), and its error has the order of the tableau.  It takes over before the
configuration, and hands back behind it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.methods.base import ErrorNorm, Memory, StepResult, SweepNode
from srm_mbs.methods.branch import WATCHED, BranchStages
from srm_mbs.methods.butcher import ButcherTableau
from srm_mbs.methods.history import MultiplierHistory
from srm_mbs.methods.split import history_after, split_step
from srm_mbs.systems.base import System, Terms

RESOLVED = 0.25
"""Part of a step's change of sigma at which the stages of a well placed step lie that crosses a
singular configuration, about."""


def can_hand_over(system: System, scheme: ButcherTableau, norm: ErrorNorm) -> bool:
    """Whether sweeps of ``system`` may hand over to the split form: with step-size control, and if
    they carry yhat, which can be predicted and stays bounded."""
    adaptive = norm.negligible > 0.0 and scheme.error is not None
    return adaptive and system.has_constraints and system.predicts and system.carries_yhat


def unresolved(stages: BranchStages) -> bool:
    """Whether a singular configuration is near that a step like that of ``stages`` cannot cross
    within the tolerance, because of rounding."""
    change = stages.sigma_change
    if not (stages.memory.sigma < WATCHED and change > 0.0):
        return False
    noise = stages.rounding(RESOLVED * change, change, True)
    return stages.norm(noise, stages.weights) > 1.0


def first_history(terms: Terms, t: float, node: SweepNode) -> MultiplierHistory:
    """What the split form predicts from that takes over from sweeps at ``t``, with ``terms``."""
    if node.history is not None:
        return node.history
    return MultiplierHistory.begin(t, terms.multiplier().copy())


def split_passing(
    system: System,
    scheme: ButcherTableau,
    t: float,
    h: float,
    state: FloatArray,
    memory: Memory,
    norm: ErrorNorm,
    remembers: bool,
) -> StepResult:
    """A step of the split form for sweeps, which all stand where it ends.

    Parameters
    ----------
    remembers
        Whether the sweeps keep a history of their own.
    """
    node = memory.sweeps[-1]
    history = node.history
    if not node.passing or history is None:
        terms = system.evaluate(t, state)
        history = first_history(terms, t, node)
        memory = replace(memory, rate=terms.rate().copy(), sigma=terms.sigma)
    inner = replace(memory, history=history, sweeps=())
    result = split_step(system, scheme, t, h, state, inner, norm, 1.0)
    result.passing = True
    result.rates = _with_extra_stages(system, scheme, state, result)
    passing = float(result.sigmas[-1]) < WATCHED
    multiplier = node.multiplier if result.multiplier is None else result.multiplier
    kept: MultiplierHistory | None = history_after(history, result)
    if not passing:
        multiplier = system.evaluate(t + h, result.state).multiplier().copy()
        kept = MultiplierHistory.begin(t + h, multiplier) if remembers else None
    end = SweepNode(result.state, multiplier, None, 0.0, kept, 0.0, multiplier, passing)
    result.sweeps = (end,) * len(memory.sweeps)
    return result


def _with_extra_stages(
    system: System, scheme: ButcherTableau, state: FloatArray, result: StepResult
) -> FloatArray:
    """Chart rates at all nodes, as sweeps give them."""
    A, c = scheme.dense.extra_A, scheme.dense.extra_c.tolist()
    stages = len(result.rates)
    rates = np.zeros((stages + len(c), system.tangent_size))
    rates[:stages] = result.rates
    for k, ck in enumerate(c):
        delta = (result.h * A[k]) @ rates
        x = system.retract(state, delta)
        terms = system.evaluate(result.t + ck * result.h, x, result.zone)
        rates[stages + k] = system.chart_rate(delta, terms.rate())
    return rates
