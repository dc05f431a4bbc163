"""The public entry points that put the layers together: runs, and results with pictures and files.

:func:`simulate` and :func:`solve_dae` hand their options to the one runner
(:mod:`srm_mbs.simulation`) and choose the classes of the results.  :class:`Solution` is a
:class:`~srm_mbs.simulation.result.SimulationResult` that can be looked at, saved and reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from srm_mbs.dynamics.controllers import Controller
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.errors import FailedRunWarning, warn
from srm_mbs.formats.files import checked_path
from srm_mbs.integration.driver import RunStatus, Tick
from srm_mbs.integration.generated.code import CompiledMechanism, compile_mechanism
from srm_mbs.integration.methods.base import Method
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.dae import SemiExplicitDAE
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.reach import Reach
from srm_mbs.simulation.dae_result import DaeResult
from srm_mbs.simulation.dae_run import run_dae
from srm_mbs.simulation.options import SINGULAR_TOLERANCE, RunOptions
from srm_mbs.simulation.result import RunOutcome, SimulationResult
from srm_mbs.simulation.segmented_result import ResultTypes, SegmentedResult
from srm_mbs.simulation.segmented_run import run
from srm_mbs.visualization.animation.joint_motion import AnimationMixin

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srm_mbs.analysis.accuracy.certificate import Certificate

Outcome = TypeVar("Outcome", bound=RunOutcome)


class Solution(AnimationMixin, SimulationResult):
    """Result of :func:`simulate`: states and physical quantities, pictures, files, report."""

    @property
    def degrees_of_freedom(self) -> NDArray[np.int_]:
        """Momentary degrees of freedom (n,) at ``t``; more in :func:`srm_mbs.mobility_map`."""
        from srm_mbs.simulation.mobility import mobility_map

        return mobility_map(self).degrees_of_freedom

    def to_csv(
        self,
        path: str | Path,
        t: Any = None,
        *,
        points: Sequence[Anchor | str] = (),
        reactions: bool = False,
    ) -> None:
        """Write the motion as a table; see :mod:`srm_mbs.simulation.csv_export`.

        Parameters
        ----------
        path
            File name; ``.csv`` is usual and is not added.
        t : (k,) s
            Times of its rows, in any order; by default ``solution.t``.
        points
            Points of links whose position, velocity and acceleration are added: anchors such as
            ``srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))``, or names of points of the mechanism.
        reactions
            Whether the reactions of closures and joints are added.

        Raises
        ------
        InputError
            If a point does not exist; for reactions of a loaded run that had a controller, whose
            points have no accelerations in the table.
        OSError
            If the file cannot be written.
        """
        from srm_mbs.simulation.csv_export import write_csv

        write_csv(self if t is None else self.at(t), checked_path(path), points, reactions)

    def save(self, path: str | Path, full_paths: bool = False) -> None:
        """Write everything needed to replay and interpolate the run, description included.

        Parameters
        ----------
        path
            File name; ``.npz`` is usual and is not added.
        full_paths
            Whether the file names the folders in which the files of the mechanism lay; by default
            it holds their names alone, and names of meshes relative to the model.

        Raises
        ------
        InputError
            If a tableau or closure type is not the package's, or the run is too large to be read.
        OSError
            If the file cannot be written; a file that was there is then as it was.
        """
        from srm_mbs.simulation.storage import save_solution

        save_solution(self, checked_path(path), full_paths)

    def plot(
        self,
        path: str | Path | None = None,
        kind: str = "run",
        *,
        joints: Sequence[str] | None = None,
        accelerations: bool = False,
        loops: Sequence[str] | None = None,
        rows: bool = False,
        points: Sequence[Anchor | str] | None = None,
        x: str | None = None,
        unit: str | None = None,
        at: Sequence[float] | None = None,
        crank: str | None = None,
        view: Any = None,
        title: str | None = None,
        size: str | tuple[float, float] | None = None,
        dpi: float | None = None,
    ) -> Figure:
        """A picture of the run; docs/plots.md shows each kind.

        Parameters
        ----------
        path
            Where to save the figure (the suffix decides the format: png, pdf or svg); not saved if
            omitted.
        kind
            ``run``: drift, energy, sigma and step sizes with rejected steps and singular passages
            marked.  ``state``: positions and rates of joints.  ``balance``: energies, works, and
            the residual of the energy balance.  ``reactions``: forces and moments in closures and
            joints.
            ``sigma``: sigma, all kinds of steps, and the error estimates.  ``phase``: rate over
            position of joints.  ``path``: paths of points in space.  ``point``: position, velocity
            and acceleration of points.  ``poses``: the mechanism at several times in one picture.
        joints
            Names, by default as many as fit: with ``state``, ``phase`` and ``reactions``.
        accelerations
            Whether to draw accelerations, too: with ``state``.
        loops
            Names of closures: with ``reactions``.
        rows
            Whether to draw the multiplier of each row: with ``reactions``.
        points
            Anchors such as ``srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))``, or names of points of the
            mechanism: with ``path`` and ``point``, and with ``poses``, which draws their paths.
        x
            Joint on the horizontal axis instead of time: with ``state``, ``reactions`` and
            ``point``.
        unit
            Unit of that joint, ``"rad"`` or ``"deg"``, ``"m"`` or ``"mm"``; with ``poses`` that of
            the axes, ``"m"`` or ``"mm"``.
        at
            Times (s), or positions of the crank (degrees, m): with ``poses``.
        crank
            Joint of these positions: with ``poses``.
        view
            Direction of view, ``"x"``, ``"y"``, ``"z"`` or a vector: with ``poses``.
        title
            The title.
        size
            ``"column"`` (3.5 inch wide), ``"page"`` (7 inch) or width and height (inch).
        dpi
            Dots per inch of a png.

        Returns
        -------
        matplotlib.figure.Figure
            Without pyplot: it is on no screen, and need not be closed.

        Raises
        ------
        InputError
            For an unknown kind, joint, loop, point or suffix, or an option that the kind does not
            have; if the run has not what is to be drawn; for balance and reactions of a loaded run
            that had a controller.
        ControllerError, EvaluationError
            If forces cannot be evaluated again.
        OSError
            If the file cannot be written.
        """
        given = locals()  # every other parameter is an option
        for name in ("self", "path", "kind"):
            del given[name]
        from srm_mbs.visualization.plotting import plot_solution

        return plot_solution(self, path, kind, given)

    def report(
        self,
        path: str | Path,
        *,
        animation: bool = True,
        pictures: Sequence[str] | None = None,
        certificate: Certificate | None = None,
        rtol: float | None = None,
        again: bool = True,
        progress: Any = False,
        full_paths: bool = False,
    ) -> None:
        """Write one page about the run; see :func:`srm_mbs.analysis.report.report.write_report`.

        Parameters
        ----------
        path
            Name of the file, usually ``.html``; an existing one is replaced.
        animation
            Whether to include the animation, which is most of the file.
        pictures
            Kinds of :meth:`plot` among ``run``, ``state``, ``balance``, ``reactions`` and
            ``sigma``; by default all.
        certificate
            From :func:`srm_mbs.certify` of this run; by default it is computed with ``rtol``,
            ``again`` and ``progress``, which are those of that function.
        full_paths
            Whether the page names the folders of the mechanism's files.

        Raises
        ------
        InputError
            If ``rtol`` or a kind of plot is not valid, or the animation or the file cannot be
            written.
        """
        from srm_mbs.analysis.report.report import write_report

        write_report(
            self,
            path,
            animation=animation,
            pictures=pictures,
            certificate=certificate,
            rtol=rtol,
            again=again,
            progress=progress,
            full_paths=full_paths,
        )


class SegmentedSolution(SegmentedResult, Solution):
    """Result of :func:`simulate` with event actions: smooth segments on one time axis."""

    @cached_property
    def degrees_of_freedom(self) -> Any:
        """See :attr:`Solution.degrees_of_freedom`."""
        return self.rows_of_parts(lambda part: part.degrees_of_freedom)

    def save(self, path: str | Path, full_paths: bool = False) -> None:
        """Write all segments into one file; see :meth:`Solution.save`."""
        from srm_mbs.simulation.storage import save_segments

        save_segments(self, checked_path(path), full_paths)


class DaeSolution(DaeResult):
    """Result of :func:`solve_dae`: states and multipliers, pictures, tables."""

    def plot(
        self,
        path: str | Path | None = None,
        kind: str = "run",
        *,
        title: str | None = None,
        size: str | tuple[float, float] | None = None,
        dpi: float | None = None,
    ) -> Figure:
        """A picture of the run.

        Parameters
        ----------
        path
            Where to save the figure (the suffix decides the format: png, pdf or svg); not saved if
            omitted.
        kind
            ``run``: drift, sigma and step sizes.  ``state``: states and multipliers.
        title
            The title.
        size
            ``"column"`` (3.5 inch wide), ``"page"`` (7 inch) or width and height (inch).
        dpi
            Dots per inch of a png.

        Raises
        ------
        InputError
            For an unknown kind or suffix, or an option that is not valid.
        OSError
            If the file cannot be written.
        """
        from srm_mbs.visualization.plotting import plot_dae

        return plot_dae(self, path, kind, {"title": title, "size": size, "dpi": dpi})


SOLUTIONS = ResultTypes(Solution, SegmentedSolution)
"""Classes of the results of :func:`simulate` and :func:`load_solution`."""


def simulate(
    mechanism: Mechanism,
    t_end: float,
    *,
    t0: float = 0.0,
    q0: Any = None,
    v0: Any = None,
    method: str | Method = "psrm",
    tableau: str | ButcherTableau | None = None,
    rtol: float = 1e-6,
    atol: Any = None,
    step: float | None = None,
    first_step: float | None = None,
    max_step: float | None = None,
    t_eval: Any = None,
    events: Any = None,
    controller: Controller | None = None,
    sample_time: float | None = None,
    breakpoints: Any = (),
    placement: str = "automatic",
    singular_times: Any = (),
    progress: bool | Tick = False,
    backend: str = "auto",
    raise_on_failure: bool = False,
    singular_tolerance: float = SINGULAR_TOLERANCE,
) -> Solution:
    """Simulate ``mechanism`` from ``t0`` to ``t_end`` (s).

    Parameters
    ----------
    mechanism
        From :func:`srm_mbs.load`, or built from a ``pin.Model``.
    t_end
        End of the run (s), after ``t0``.
    t0
        Start of the run (s).  Drives count from 0: ``q0`` and ``v0`` are then a state of the
        motion that they prescribe from the mechanism's own initial state.
    q0 : (nq,), v0 : (nv,)
        Initial state instead of the mechanism's own.  It satisfies the closures and their rates to
        1e-8 (in rad and scene diagonals, and those over the characteristic time), or is moved onto
        them as at the end of a step, by at most ten times the tolerance in the norm of the error
        control: any state of a run of the same tolerance will do, of dense output as well.  The
        motion begins at ``solution.q[0]``, ``solution.v[0]``.  Other states are refused.
    method
        ``"psrm"``, ``"srm"`` or a method object: :class:`srm_mbs.PSRM`, :class:`srm_mbs.SRM`.
    tableau
        Runge-Kutta scheme for a method given by name; by default ``"auto"`` for psrm, which is
        ``"dop853"`` and, where the motion is stiff, ``"rodas5p"``; ``"tvd32"`` for srm.
    rtol
        Relative tolerance: at most 1e-2 for the split PSRM with auto and dop853, 1e-3 with another,
        1e-4 for sweeps; at least 1e-12 with closures or drives (1e-11 with tvd32), 2.2e-14 without:
        below, rounding decides.  Others are replaced with a warning.
    atol
        Absolute tolerance: a number, (nv,) or (2 nv,).  By default rtol times the unit of each
        coordinate: 1 rad, the scene diagonal for lengths, and those times the mechanism's
        characteristic rate for velocities (:class:`srm_mbs.dynamics.scaling.Units`).
    step
        Fixed step (s) instead of step-size control.  A step is split where a stage would lie on
        a singular configuration; the run then returns to the grid.
    first_step, max_step
        First and longest step (s) of the step-size control.
    t_eval : (n,)
        Times (s) at which the solution is given; by default the ends of the steps.  With them,
        steps of more than 8 MB are not kept: what needs them (dense output, crossings, pictures,
        saving) makes the run again, or is refused if it called a controller or forces of the user.
    events
        A function (t, q, v) -> float or a list of them; an event is where it passes zero.  As in
        ``scipy.integrate.solve_ivp``, the attribute ``terminal`` of the function (a bool, or a
        number of occurrences) ends the run there with status ``event``, and ``direction`` (> 0
        or < 0) counts only zeros passed upwards or downwards.  Located on the dense output
        (:mod:`srm_mbs.integration.events`).  The attribute ``action`` changes the state or the
        mechanism there (:class:`srm_mbs.Event`).  Zeros at the start are no events, but for those
        of events with an action and a direction that leave to the forbidden side, which act at once
        (:mod:`srm_mbs.integration.contacts`).
    controller
        (t, q, v) -> generalised forces (nv,), N and N m, or a mapping {joint: force} with numbers
        for joints of one degree of freedom and arrays (joint.nv,) for others; joints that it does
        not name have none.  Called at every stage, of rejected steps too; with ``sample_time`` at
        0, T, 2 T, ... only, and what it returned is held in between, as one needs that has memory
        (an integral term, a filter) or adds noise.
    sample_time
        T (s) of a sampled controller.  Steps end on the samples.
    breakpoints : (k,)
        Times (s) at which a force jumps or has a kink, in any order; those outside the run are
        ignored.  Steps end there, and every scheme keeps its order; those of drives and tables
        of the mechanism are known.
    placement
        How steps are placed around singular configurations: ``"automatic"``, from sigma;
        ``"halved"``, the thesis' rule 2.4.1 (1): a step h that ends on one is replaced by h/2
        (h/4 where the tableau has inner stages) and then h; or ``"off"``.
    singular_times : (k,)
        Times (s) on which no stage or end of a step may lie, beside what ``placement`` does
        (thesis, 2.4.1 (2)); those outside the run are ignored.
    progress
        True for a progress bar (on a terminal only), or a callable (t, h, state).
    backend
        ``"python"``, the readable reference; ``"kernel"``, the compiled kernel, which is many times
        faster and has the split PSRM with automatic placement or none; ``"generated"``, the kernel
        with code that is generated and compiled for this mechanism (:func:`srm_mbs.compile`);
        ``"auto"``, the kernel wherever it can be used (:func:`srm_mbs.backend`), with generated
        code if the mechanism has it when the run begins.  Mechanisms that are used much get it
        (docs/kernel.md).  With ``settings.backend`` of its solution a run is repeated bit by bit.
    raise_on_failure
        Raise :class:`SimulationError` instead of returning a partial solution.
    singular_tolerance
        Residual, over the size of the mechanism (scene diagonal, rad), up to which the closures
        count as exactly singular where branches almost cross: data rounded to ten digits then go
        straight on.  Above it the motion follows the data, and avoids the singular configuration.
        0 follows the data always (docs/singular_configurations.md).

    Returns
    -------
    Solution
        With ``success`` False, everything computed so far and a :class:`SrmWarning` if the run
        could not go on; ``error`` is the exception of a controller, force or event function that
        failed during the run.

    Raises
    ------
    InputError
        For invalid input, before any stepping.
    SimulationError
        Only with ``raise_on_failure``.
    ControllerError, EventError
        If a controller, force or event function raises, or returns another shape or numbers that
        are not finite, at the start of the run; what it raised is the ``__cause__``.
    """
    options = locals()  # every other parameter is one
    del options["mechanism"]
    return _with_warning(run(mechanism, RunOptions(**options), SOLUTIONS))


def _with_warning(result: Outcome) -> Outcome:
    """``result``, with a warning if the run failed, so that nobody reads half of it as the whole.

    Runs that the package makes for itself, such as those of a certificate, do not warn.
    """
    if result.status is RunStatus.FAILED:
        warn(result.message, FailedRunWarning)
    return result


def solve_dae(
    problem: SemiExplicitDAE,
    t_span: tuple[float, float],
    x0: Any,
    *,
    method: str | Method = "psrm",
    tableau: str | ButcherTableau | None = None,
    rtol: float = 1e-6,
    atol: Any = None,
    step: float | None = None,
    first_step: float | None = None,
    max_step: float | None = None,
    t_eval: Any = None,
    events: Any = None,
    placement: str = "automatic",
    singular_times: Any = (),
    progress: bool | Tick = False,
    raise_on_failure: bool = False,
) -> DaeSolution:
    """Solve x' = f(t, x) - B(t, x) y, 0 = g(t, x) over ``t_span``.

    The driver, the step-size control and the placement around isolated singularities of G B are
    those of :func:`srm_mbs.simulate`.

    Parameters
    ----------
    problem
        The equations.
    t_span : (t0, t1)
        Start and end.
    x0 : (nx,)
        Initial state, with g(t0, x0) = 0; up to ten times the tolerance it is moved there, so that
        any state of a run of the same tolerance will do.
    method
        ``"psrm"`` (split), ``"srm"`` or a method object.  The T of its sweeps is I, (GB)^T, or
        (GB)^-1; the last one carries B y, form (2.4) of the thesis.  Isolated singularities of
        G B are passed by the split form, and by sweeps with T = (GB)^-1: restarted ones with
        ``carry`` at a tolerance of 1e-4 with errors below 2e-4, at 1e-6 below 2e-6
        (``tests/simulation/test_dae.py``); without it they turn off.  Sweeps with own histories,
        whose first one is off the constraints by O(eps), would leave on another branch of g = 0;
        next to the singularity they are restarted, and the message says when.  Sweeps that carry y,
        which is not bounded there, would leave on another branch, however small the step: x' is
        compared across every passage, and a run with sweeps that took another branch fails there,
        with a message that names the remedy.
    tableau
        Runge-Kutta scheme for a method given by name.
    rtol
        Relative tolerance, at most 1e-4.
    atol
        Absolute tolerance, a number or (nx,); rtol by default, for states of order one.
    step
        Fixed step instead of step-size control.
    first_step, max_step
        First and longest step of the step-size control.
    t_eval : (n,)
        Times at which the solution is given; by default the ends of the steps.
    events
        A function (t, x) -> float or a list of them; an event is where it passes zero.  As in
        ``scipy.integrate.solve_ivp``, the attribute ``terminal`` of the function (a bool, or a
        number of occurrences) ends the run there with status ``event``, and ``direction`` (> 0
        or < 0) counts only zeros passed upwards or downwards
        (:mod:`srm_mbs.integration.events`).
    placement
        How steps are placed around singular points of G B: ``"automatic"``, ``"halved"`` (thesis,
        2.4.1 (1)) or ``"off"``; as in :func:`srm_mbs.simulate`.
    singular_times : (k,)
        Times on which no stage or end of a step may lie (thesis, 2.4.1 (2)).
    progress
        True for a progress bar (on a terminal only), or a callable (t, h, x).
    raise_on_failure
        Raise :class:`SimulationError` instead of returning a partial solution.

    Returns
    -------
    DaeSolution
        With ``success`` False, everything computed so far and a :class:`SrmWarning` if the run
        could not go on: a function of the problem that raises, or returns what is not finite,
        included.

    Raises
    ------
    InputError
        For invalid input, before any stepping, and functions of the problem that cannot be used at
        the start.
    SimulationError
        Only with ``raise_on_failure``.
    EventError
        If an event function raises, or does not return one finite number, at the start; what it
        raised is the ``__cause__``.
    """
    options = locals()  # every other parameter is one
    for name in ("problem", "t_span", "x0"):
        del options[name]
    return _with_warning(
        run_dae(problem, t_span, x0, RunOptions(t_end=None, **options), DaeSolution)
    )


def load_solution(
    path: str | Path, *, mesh_dirs: Sequence[str | Path] = (), allow_outside: bool = False
) -> Solution:
    """Read a run that :meth:`Solution.save` wrote; dense output and plots work as before.

    Meshes are looked for beside the file.  A controller is not saved: reactions of a controlled run
    cannot be computed afterwards, unless it was sampled; what it held is saved.

    Parameters
    ----------
    path
        A file of :meth:`Solution.save`.
    mesh_dirs, allow_outside
        Where its animations may read meshes, as for :func:`srm_mbs.load`; the folder of the model
        is that of ``path``.

    Raises
    ------
    InputError
        If the file is missing, is no saved run, is of another format, or unpacks to more than 20
        times its size and 64 MB, or more than 2 GB.
    """
    from srm_mbs.simulation.storage import load_result

    checked = checked_path(path)
    return load_result(checked, SOLUTIONS, Reach.of(checked, mesh_dirs, allow_outside))


def compile(mechanism: Mechanism) -> CompiledMechanism:
    """Generate the code of a mechanism's terms and compile it, for all runs to come.

    Runs with ``backend="auto"`` do so by themselves once the mechanism has used as much CPU time as
    compilation takes.

    The code computes what an evaluation of this mechanism needs: constants, zeros and units are
    gone.  It stays in a folder of the user's cache, and mechanisms of the same structure share it,
    whatever their masses, lengths and stiffnesses (docs/kernel.md).

    Parameters
    ----------
    mechanism
        From :func:`srm_mbs.load`, or built from a ``pin.Model``.

    Returns
    -------
    CompiledMechanism
        Statements of one evaluation, time (s) that compilation took, or 0, where the code lies, and
        its source in C.

    Raises
    ------
    InputError
        If no code can be generated for an element of the mechanism, or there is no C compiler.
    """
    check_mechanism(mechanism)
    return compile_mechanism(mechanism)
