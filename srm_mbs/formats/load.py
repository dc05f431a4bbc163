"""``load``: from a bundled name or a file of any format to an assembled mechanism.

The mechanisms that come with the package.

``load``: from a bundled name or a file of any format to an assembled mechanism.
"""

from __future__ import annotations

import json
import logging
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError
from srm_mbs.formats.build import assembled, rebuild
from srm_mbs.formats.generators import n_four_bar as _n_four_bar_texts
from srm_mbs.formats.registry import DESCRIPTION, Format, find_format, of_key
from srm_mbs.formats.toml.description import Description, parse_description
from srm_mbs.formats.toml.schema import LARGEST
from srm_mbs.formats.translation import Options, merged
from srm_mbs.formats.urdf.parser import ROOT_JOINTS
from srm_mbs.model.mechanism import Source

_GENERATED = re.compile(r"n_four_bar_([1-9][0-9]{0,8})\Z")


def models_folder() -> Path:
    """Folder of the bundled descriptions: inside an installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "models"
    return installed if installed.is_dir() else package.parent / "models"


def bundled_models() -> tuple[str, ...]:
    """Names that :func:`srm_mbs.load` takes without a path.

    ``n_four_bar_<N>`` is generated for any N beside those listed.
    """
    return tuple(sorted(path.stem for path in models_folder().glob("*.toml")))


def generated_size(name: str) -> int | None:
    """N if ``name`` is ``n_four_bar_<N>``, else None."""
    match = _GENERATED.match(name)
    return int(match[1]) if match else None


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Overrides:
    """What the caller of :func:`load` wants instead of what the file says; None: nothing."""

    gravity: Sequence[float] | None = None
    base: str | None = None
    cut: tuple[str, ...] = ()


def read_text(path: Path) -> str:
    """Text of a file.

    Raises
    ------
    InputError
        If there is none, or it is not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8-sig")  # Windows editors put a mark first
    except FileNotFoundError as error:
        raise InputError(
            "there is no such file", file=str(path), remedy="Check the path"
        ) from error
    except UnicodeDecodeError as error:
        if path.suffix.lower() == ".npz":
            raise InputError(
                "it is not the file of a mechanism",
                file=str(path),
                remedy="Give a saved run to srm.load_solution, or to srm-mbs plot, play or report",
            ) from error
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
        raise InputError(
            f"it is not a file name: {error}", file=repr(path), remedy="Correct the path"
        ) from error


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


@dataclass(frozen=True)
class Reading:
    """A file as it was read: what :mod:`srm_mbs.formats.build` takes.

    Attributes
    ----------
    description, source
        The parsed description, and the texts of it and of its URDF.
    notes
        Sentences about what was approximated or ignored.
    """

    description: Description
    source: Source
    notes: tuple[str, ...] = ()


def _reading(
    own: str,
    file: str,
    found: Format,
    text: str,
    model_path: Path,
    overrides: Overrides,
) -> Reading:
    """Translate ``text``, the file that the description ``own`` names, and merge the two."""
    description = parse_description(own, file)
    raw = tomllib.loads(own)
    options = Options(overrides.cut or tuple(description.cut), raw)
    translation = found.translate(text, str(model_path), options)
    if translation.entries or found.key != "urdf":
        entries = merged(
            tomllib.loads(own), translation.entries, model_path.with_suffix(".urdf").name
        )
        own = tomli_w.dumps(entries)
        description = parse_description(own, file)
    base = overrides.base
    base = description.base if base is None else base
    if not isinstance(base, str) or base not in ROOT_JOINTS:
        raise InputError(
            f"there is no base {base!r}", element="base", remedy=f"Known: {', '.join(ROOT_JOINTS)}"
        )
    gravity = overrides.gravity
    source = Source(
        description=own,
        urdf=translation.urdf,
        urdf_path=translation.urdf_file or str(model_path),
        path=file,
        base=base,
        gravity=_gravity(description.gravity if gravity is None else gravity),
        format=found.name,
    )
    log.debug("%s: read as %s", model_path, found.name)
    return Reading(description, source, translation.notes)


def _of_description(text: str, file: str, overrides: Overrides, urdf: str | None = None) -> Reading:
    """Read a description given as text; the URDF is read from disk if it is None."""
    description = parse_description(text, file)
    key, name = description.model_file
    path = Path(file).parent / name
    if urdf is None:
        try:
            urdf = read_text(path)
        except InputError as error:
            raise InputError(
                f"the {key.upper()} {name!r} cannot be read ({error.problem}: {str(path)!r})",
                file=file,
                element=key,
                remedy="Check the path, which is relative to the description",
            ) from error
    return _reading(text, file, of_key(key, path, urdf), urdf, path, overrides)


def _of_file(path: Path, overrides: Overrides) -> Reading:
    if path.is_dir():
        raise InputError("it is a directory", remedy="Give a file in it")
    text, file = read_text(path), str(path)
    found = find_format(path, text)
    if found is DESCRIPTION:
        return _of_description(text, file, overrides)
    # A JSON string is a TOML string too.
    own = f"format = 1\nurdf = {json.dumps(path.name)}\n"
    return _reading(own, file, found, text, path, overrides)


def read(name: str | Path, overrides: Overrides) -> Reading:
    """Read a bundled mechanism or a file of any format; see :func:`load`.

    Raises
    ------
    InputError
        For anything that cannot be read, naming file, element and remedy.
    """
    name = str(name)
    is_name = not Path(name).suffix and "/" not in name and "\\" not in name
    if is_name and name in bundled_models():
        name = str(models_folder() / f"{name}.toml")
    elif is_name and not (name and Path(name).exists()):  # "" would be the working folder
        size = generated_size(name)
        if size is None:
            raise InputError(
                f"there is no bundled mechanism {name!r}",
                remedy=f"Known: {', '.join(bundled_models())}; or give the path of a file",
            )
        return _generated(size, overrides)
    try:
        return _of_file(Path(name), overrides)
    except InputError as error:
        raise error.located(name) from error.__cause__


def load(
    path: str | Path,
    *,
    gravity: Sequence[float] | None = None,
    base: str | None = None,
    cut: Sequence[str] = (),
) -> Mechanism:
    """Load a mechanism and assemble its initial state.

    Parameters
    ----------
    path
        Name of a bundled mechanism (:func:`bundled_models`; ``n_four_bar_<N>`` for any N), or a
        file: a ``.toml`` description, or one of the formats of ``docs/formats.md``, which is
        found out by its content.
    gravity : (3,) m/s^2
        Instead of the file's.
    base
        ``fixed``, ``floating`` or ``planar``, instead of the file's.
    cut
        Names of the joints at which to cut the loops of a file whose joints form a graph: they
        become closures, the others stay joints.

    Raises
    ------
    InputError
        For anything that cannot be read, naming file, element and remedy.
    AssemblyError
        If the loops cannot close or held values contradict each other.
    """
    reading = read(path, Overrides(gravity, base, tuple(cut)))
    try:
        return assembled(reading.description, reading.source, reading.notes)
    except InputError as error:
        raise error.located(reading.source.path) from error.__cause__


LARGEST_N, LARGEST_DENSE_N = 1000, 300
"""Loops of a generated N-four-bar with the kernel, whose memory grows as N^2, and without it, as
N^3."""


def largest_n() -> int:
    """Loops of the largest N-four-bar that is made here."""
    from srm_mbs._kernel import core

    return LARGEST_DENSE_N if core is None else LARGEST_N


def _generated(n: int, overrides: Overrides) -> Reading:
    largest = largest_n()
    if n > largest:
        raise InputError(
            f"an N-four-bar with N = {n} is too large for the memory of its load-time analysis",
            element="n",
            remedy=f"Take N <= {largest}"
            + (f", or N <= {LARGEST_N} with the compiled kernel" if largest < LARGEST_N else ""),
        )
    text, urdf = _n_four_bar_texts(n)
    return _of_description(text, f"n_four_bar_{n}, generated", overrides, urdf)


def n_four_bar(n: int) -> Mechanism:
    """The IFToMM N-four-bar benchmark with ``n`` loops (n >= 1), assembled.

    Raises
    ------
    InputError
        If n < 1 or n > 1000 (300 without the compiled kernel).
    """
    if not isinstance(n, Integral) or n < 1:
        raise InputError(
            f"an N-four-bar needs n >= 1, not {n!r}", element="n", remedy="Give a positive integer"
        )
    reading = _generated(int(n), Overrides())
    return assembled(reading.description, reading.source)


__all__ = ["bundled_models", "load", "n_four_bar", "rebuild"]
