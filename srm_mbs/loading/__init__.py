"""``load``: from a bundled name or a file to an assembled mechanism."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.assembly import assemble
from srm_mbs.coordinates import set_position, set_rate
from srm_mbs.errors import AssemblyError, EvaluationError, InputError
from srm_mbs.loading.bundled import bundled_models, generated_size, models_folder
from srm_mbs.loading.description import (
    LARGEST,
    Description,
    TorqueEntry,
    TorsionSpringEntry,
    parse_description,
)
from srm_mbs.loading.generated import n_four_bar as _n_four_bar_texts
from srm_mbs.loading.urdf import (
    ROOT_JOINTS,
    build_urdf,
    check_inertia,
    lock_joints,
    undetermined_joint,
)
from srm_mbs.mechanism import Mechanism, SimulationDefaults, Source
from srm_mbs.systems.forces import friction_time

__all__ = ["bundled_models", "load", "n_four_bar", "rebuild"]

log = logging.getLogger(__name__)


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")  # Windows editors put a mark first
    except FileNotFoundError as error:
        raise InputError(
            "there is no such file", file=str(path), remedy="Check the path"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(
            f"it is not UTF-8 text: {error}", file=str(path), remedy="Save it as UTF-8"
        ) from error
    except OSError as error:
        raise InputError(
            f"it cannot be read: {error.strerror}",
            file=str(path),
            remedy="Give the path of a readable file",
        ) from error
    except ValueError as error:  # a null character
        raise InputError(f"it is no file name: {error}", file=repr(path)) from error


def _check_joint_names(description: Description, model: pin.Model, file: str) -> None:
    """Refuse names in [initial] and lock that are no moving joints."""
    known = tuple(model.names)[1:]
    places: list[tuple[str, Sequence[str]]] = [
        ("lock", description.lock),
        ("initial.q", list(description.initial.q)),
        ("initial.v", list(description.initial.v)),
        ("initial.guess", list(description.initial.guess)),
        *(
            (f"force[{i}].joint", [force.joint])
            for i, force in enumerate(description.force)
            if isinstance(force, TorqueEntry | TorsionSpringEntry)
        ),
    ]
    for where, names in places:
        for name in names:
            if name not in known:
                raise InputError(
                    f"there is no moving joint {name!r}",
                    file=file,
                    element=where,
                    remedy=f"Known: {', '.join(known)}",
                )
    for i, force in enumerate(description.force):
        if isinstance(force, TorqueEntry | TorsionSpringEntry) and force.joint in description.lock:
            raise InputError(
                f"joint {force.joint!r} is locked",
                file=file,
                element=f"force[{i}].joint",
                remedy="Remove the force, or the joint from lock",
            )
    for i, name in enumerate(description.lock):
        if name in description.lock[:i]:
            raise InputError(
                f"joint {name!r} stands there twice", file=file, element="lock", remedy="Keep one"
            )
    for name in description.initial.q:
        if name in description.initial.guess:
            raise InputError(
                f"joint {name!r} is held in initial.q and guessed in initial.guess",
                file=file,
                element="initial.guess",
                remedy="Keep one of the two",
            )


@contextmanager
def _element(where: str) -> Iterator[None]:
    """Name the key of the description in errors that do not name one."""
    try:
        yield
    except InputError as error:
        error.element = error.element or where
        raise


def _check_frames(description: Description, model: pin.Model) -> None:
    """Refuse an anchor's frame name that means two different frames, say a joint's and a link's."""
    for where, anchor in description.anchors():
        if anchor.frame is None:
            continue
        first, *others = [f for f in model.frames if f.name == anchor.frame] or [None]
        for other in others:
            if other.parentJoint != first.parentJoint or not other.placement.isApprox(
                first.placement, 1e-12
            ):
                raise InputError(
                    f"the name {anchor.frame!r} belongs to a joint and to another joint's link",
                    element=f"{where}.frame",
                    remedy="Rename one of them in the URDF, or write link = instead of frame =",
                )


def _without_locked(
    description: Description, model: pin.Model, file: str
) -> tuple[pin.Model, dict[str, Any], dict[str, Any], dict[str, Any]]:
    """The model without the locked joints, and q, v and guess of those that remain."""
    initial = description.initial
    q, v, guess = dict(initial.q), dict(initial.v), dict(initial.guess)
    if not description.lock:
        return model, q, v, guess
    whole = Mechanism(model)
    frozen = np.array(whole.q0)
    for name in description.lock:
        for where, values in (("initial.q", q), ("initial.guess", guess)):
            if name in values:
                with _element(where):
                    set_position(whole, frozen, name, values.pop(name))
        rate = np.zeros(model.nv)
        with _element("initial.v"):
            set_rate(whole, rate, name, v.pop(name, np.zeros(whole.joint(name).nv)))
        if rate.any():
            raise InputError(
                f"joint {name!r} is locked but has an initial rate",
                file=file,
                element="initial.v",
                remedy="Remove the rate, or the joint from lock",
            )
    return lock_joints(model, list(description.lock), frozen), q, v, guess


def _friction_note(mechanism: Mechanism) -> tuple[str, ...]:
    try:
        time = friction_time(mechanism)
    except EvaluationError:  # in gimbal lock, which is reported elsewhere
        return ()
    if time == np.inf:
        return ()
    return (
        "joint friction F acts as F tanh(v/v_s) with v_s = "
        f"{mechanism.friction_speed:g} rad/s or m/s; a joint at rest keeps steps below about "
        f"{6.0 * time:.0e} s, in proportion to v_s: set it with friction_speed",
    )


def _unassembled(
    description: Description, source: Source
) -> tuple[Mechanism, dict[str, Any], dict[str, Any]]:
    """The mechanism with the guess as its q0, and the held positions and rates."""
    file = source.path
    built = build_urdf(source.urdf, source.urdf_path, source.base, description.lock)
    built.model.gravity.linear = np.array(source.gravity)
    _check_joint_names(description, built.model, file)
    model, q, v, guess = _without_locked(description, built.model, file)
    check_inertia(model, source.urdf_path)
    _check_frames(description, model)
    defaults = description.simulation
    mechanism = Mechanism(
        model,
        description.closures(),
        forces=description.force_elements(),
        friction_speed=description.friction_speed,
        name=description.name or model.name,
        source=source,
        defaults=SimulationDefaults(defaults.t_end, defaults.rtol, defaults.atol),
        notes=built.notes,
    )
    start = np.array(mechanism.q0)
    for where, values in (("initial.guess", guess), ("initial.q", q)):
        for name, value in values.items():
            with _element(where):
                set_position(mechanism, start, name, value)
    for name, value in v.items():
        with _element("initial.v"):
            set_rate(mechanism, np.zeros(model.nv), name, value)
    mechanism = replace(mechanism, q0=start)
    return replace(mechanism, notes=mechanism.notes + _friction_note(mechanism)), q, v


def rebuild(source: Source) -> Mechanism:
    """The mechanism of a saved run; its q0 is the guess of the description, not assembled."""
    return _unassembled(parse_description(source.description, source.path), source)[0]


def _in_gimbal_lock(source: Source, why: str) -> InputError:
    return InputError(
        f"where the loops are closed the accelerations are not determined: {why}",
        file=source.path,
        element="initial",
        remedy="Axes of massless links may be in line there (gimbal lock): give another guess, or "
        "these links inertia",
    )


def _assembled(description: Description, source: Source) -> Mechanism:
    mechanism, q, v = _unassembled(description, source)
    try:
        state = assemble(mechanism, q, v)
        # A fresh mechanism: its structure is analysed from the assembled state.
        mechanism = replace(mechanism, q0=state.q, v0=state.v)
        _ = mechanism.structure
    except AssemblyError as error:
        if description.lock:
            error.remedy = f"{error.remedy}. Locked, so that they cannot help: " + ", ".join(
                map(repr, description.lock)
            )
        raise
    except EvaluationError as error:
        raise _in_gimbal_lock(source, str(error)) from error
    joint = undetermined_joint(mechanism.model, mechanism.q0, source.urdf_path)
    if joint is not None:
        raise _in_gimbal_lock(
            source, f"the joint {mechanism.model.names[joint]!r} moves no inertia there"
        )
    log.info(
        "%s: %d degrees of freedom, rank %d",
        mechanism.name,
        mechanism.degrees_of_freedom,
        mechanism.structure.rank,
    )
    return mechanism


def _gravity(value: Any) -> tuple[float, float, float]:
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != (3,) or not (np.abs(array) <= LARGEST).all():
        raise InputError(
            f"gravity = {value!r} is not three finite numbers",
            element="gravity",
            remedy="Give [x, y, z] in m/s^2",
        )
    return (float(array[0]), float(array[1]), float(array[2]))


def _load_text(
    text: str,
    file: str,
    urdf: str | None,
    overrides: Mapping[str, Any],
) -> Mechanism:
    """Load a description given as text; ``urdf`` is read from disk if None."""
    description = parse_description(text, file)
    urdf_path = Path(file).parent / description.urdf
    if urdf is None:
        try:
            urdf = _read(urdf_path)
        except InputError as error:
            raise InputError(
                f"cannot read the URDF {description.urdf!r} ({error.problem}: {str(urdf_path)!r})",
                file=file,
                element="urdf",
                remedy="The path is relative to the description",
            ) from error
    base = overrides.get("base")
    base = description.base if base is None else base
    if not isinstance(base, str) or base not in ROOT_JOINTS:
        raise InputError(
            f"there is no base {base!r}", element="base", remedy=f"Known: {', '.join(ROOT_JOINTS)}"
        )
    gravity = overrides.get("gravity")
    source = Source(
        description=text,
        urdf=urdf,
        urdf_path=str(urdf_path),
        path=file,
        base=base,
        gravity=_gravity(description.gravity if gravity is None else gravity),
    )
    return _assembled(description, source)


def load(
    path: str | Path,
    *,
    gravity: Sequence[float] | None = None,
    base: str | None = None,
) -> Mechanism:
    """Load a mechanism and assemble its initial state.

    Parameters
    ----------
    path
        Name of a bundled mechanism (:func:`bundled_models`; ``n_four_bar_<N>`` for any N), or a
        ``.toml`` description, or a ``.urdf`` without loops.
    gravity : (3,) m/s^2
        Instead of the description's.
    base
        ``fixed``, ``floating`` or ``planar``, instead of the description's.

    Raises
    ------
    InputError
        For anything that cannot be read, naming file, element and remedy.
    AssemblyError
        If the loops cannot close or held values contradict each other.
    """
    overrides = {"gravity": gravity, "base": base}
    name = str(path)
    is_name = not Path(name).suffix and "/" not in name and "\\" not in name
    if is_name and name in bundled_models():
        name = str(models_folder() / f"{name}.toml")
    elif is_name:
        size = generated_size(name)
        if size is None:
            raise InputError(
                f"there is no bundled mechanism {name!r}",
                remedy=f"Bundled: {', '.join(bundled_models())}; or give a .toml or .urdf path",
            )
        return _generated(size, overrides)
    path = Path(name)
    file = str(path)
    kind = path.suffix.lower()
    try:
        if kind == ".toml":
            return _load_text(_read(path), file, None, overrides)
        if kind == ".urdf":
            # A JSON string is a TOML string too.
            text = f"format = 1\nurdf = {json.dumps(path.name)}\n"
            return _load_text(text, file, _read(path), overrides)
        if path.is_dir():
            raise InputError("it is a directory", remedy="Give a .toml description or a .urdf")
        if not path.exists():
            raise InputError("there is no such file", remedy="Check the path")
    except InputError as error:
        raise error.located(file) from error.__cause__
    raise InputError(
        f"files of type {path.suffix!r} are not read by this version",
        file=file,
        remedy="Give a .toml description or a .urdf",
    )


LARGEST_N = 300
"""Loops of a generated N-four-bar; memory and time of the load-time analysis grow as N^3."""


def _generated(n: int, overrides: Mapping[str, Any]) -> Mechanism:
    if n > LARGEST_N:
        raise InputError(
            f"an N-four-bar with N = {n} is too large for the dense load-time analysis",
            element="n",
            remedy=f"Take N <= {LARGEST_N}",
        )
    text, urdf = _n_four_bar_texts(n)
    return _load_text(text, str(models_folder() / f"n_four_bar_{n}.toml"), urdf, overrides)


def n_four_bar(n: int) -> Mechanism:
    """The IFToMM N-four-bar benchmark with ``n`` loops (n >= 1), assembled.

    Raises
    ------
    InputError
        If n < 1 or n > 300.
    """
    if not isinstance(n, Integral) or n < 1:
        raise InputError(f"an N-four-bar needs n >= 1, not {n!r}", element="n")
    return _generated(int(n), {})
