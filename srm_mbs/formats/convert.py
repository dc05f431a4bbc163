"""``convert``: a file of any format as a TOML description with its URDF."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from xml.etree.ElementTree import Element

import tomli_w

from srm_mbs.errors import InputError, get_logger, naming, unwritable
from srm_mbs.formats.build import Reading, unassembled
from srm_mbs.formats.files import checked_path, write_texts
from srm_mbs.formats.load import Overrides, read
from srm_mbs.formats.toml.parameters import given_parameters
from srm_mbs.model.numbers import flag, name_list
from srm_mbs.model.reach import Reach, folder_list

log = get_logger(__name__)


def convert(
    path: str | Path,
    out: str | Path,
    *,
    cut: Sequence[str] = (),
    force: bool = False,
    mesh_dirs: Sequence[str | Path] = (),
    allow_outside: bool = False,
    keyframe: str | None = None,
    massless: str | Mapping[str, float] | None = None,
    closing_tolerance: float | None = None,
    parameters: Mapping[str, float] | None = None,
) -> tuple[Path, Path, tuple[str, ...]]:
    """Write a mechanism of any format as a TOML description, and its tree as a URDF beside it.

    The files contain the translation that :func:`srm_mbs.load` makes, not the assembled state.

    Parameters
    ----------
    path, cut, mesh_dirs, allow_outside, keyframe, massless, closing_tolerance, parameters
        As for :func:`srm_mbs.load`.
    out
        The description to write, ``.toml``; the URDF gets the same name with ``.urdf``.
    force
        Whether files that exist are overwritten.

    Returns
    -------
    description, urdf, notes
        The paths written, and sentences about what was approximated or ignored.

    Raises
    ------
    InputError
        For input that cannot be read, or output that exists or cannot be written.
    """
    flag(force, "force")
    target = _description_path(out)
    overrides = Overrides(
        cut=name_list(cut, "cut"),
        mesh_dirs=folder_list(mesh_dirs),
        allow_outside=allow_outside,
        keyframe=keyframe,
        massless=massless,
        closing_tolerance=closing_tolerance,
        parameters=given_parameters(parameters),
    )
    return write_description(read(path, overrides), target, inputs=(path,), force=force)


def _description_path(out: str | Path) -> Path:
    """The path of a description to write; raises InputError unless its suffix is ``.toml``."""
    description = checked_path(out, "out")
    if description.suffix.lower() != ".toml":
        raise InputError(
            f"the suffix {description.suffix!r} is not .toml",
            file=str(description),
            remedy="Use .toml",
        )
    return description


def write_description(
    reading: Reading, out: str | Path, *, inputs: Sequence[str | Path] = (), force: bool
) -> tuple[Path, Path, tuple[str, ...]]:
    """Write what was read as a description, and its tree as a URDF beside it.

    Parameters
    ----------
    reading
        What was read; used up.
    out, force
        As for :func:`convert`, and so is what is returned.
    inputs
        Files that are not overwritten in any case, beside those of the reading.

    Raises
    ------
    InputError
        For output that exists or cannot be written.
    """
    description = _description_path(out)
    urdf = description.with_suffix(".urdf")
    source = reading.source
    written = _with_meshes_from(reading.tree, source.urdf, Path(source.urdf_path), urdf)
    meshes = [mesh.get("filename", "") for mesh in reading.tree.iter("mesh")]
    with naming(file=source.path):
        mechanism, _, _ = unassembled(reading)
    kept = {Path(name).resolve() for name in (*inputs, source.path, source.urdf_path)}
    for target in (description, urdf):
        if target.resolve() in kept:
            raise InputError(
                "it is an input of the conversion", file=str(target), remedy="Give another name"
            )
        if target.exists() and not force:
            raise InputError(
                "the file exists",
                file=str(target),
                remedy="Give another name, or overwrite it with force=True (--force)",
            )
    entries = deepcopy(dict(reading.entries)) | {"urdf": urdf.name}
    _move_tables(entries, Path(source.path), description)
    elsewhere = _elsewhere((*meshes, *_tables(entries)), description)
    try:
        write_texts({urdf: written, description: tomli_w.dumps(entries)})
    except OSError as error:
        raise unwritable(error.filename or out, error) from error
    log.info("written: %s and %s", description, urdf)
    notes = mechanism.notes
    if elsewhere:
        names = ", ".join(elsewhere)
        note = f"files stay in other folders: {names}; load it with allow_outside=True"
        notes = (*notes, f"{note} (--allow-outside), or move them")
    return description, urdf, notes


def _seen_from(name: str, original: Path, written: Path) -> str:
    """The relative path ``name`` beside ``original`` as seen from beside ``written``."""
    target = (original.parent / name).resolve()
    return Path(os.path.relpath(target, written.parent.resolve())).as_posix()


def _move_tables(entries: Any, original: Path, written: Path) -> None:
    """Correct, in place, the relative paths of the tables that laws are read from."""
    if isinstance(entries, list):
        for entry in entries:
            _move_tables(entry, original, written)
    elif isinstance(entries, dict):
        for key, value in entries.items():
            if key == "table" and isinstance(value, str) and not Path(value).is_absolute():
                entries[key] = _seen_from(value, original, written)
            else:
                _move_tables(value, original, written)


def _tables(entries: Any) -> Iterator[str]:
    """Paths of the tables that laws are read from."""
    if isinstance(entries, list):
        for entry in entries:
            yield from _tables(entry)
    elif isinstance(entries, dict):
        if isinstance(entries.get("table"), str):
            yield entries["table"]
        yield from _tables(list(entries.values()))


def _elsewhere(names: Iterable[str], written: Path) -> list[str]:
    """The paths among ``names`` that are out of reach of the description ``written``."""
    reach = Reach.of(written)
    found = []
    for name in dict.fromkeys(names):
        try:
            if name and not urlsplit(name).scheme:
                reach.check(written.parent / name, "file")
        except InputError:
            found.append(name)
    return found


def _with_meshes_from(root: Element, text: str, original: Path, written: Path) -> str:
    """The URDF ``root``, whose text is ``text``, with the relative paths of its mesh files as seen
    from ``written``."""
    changed = False
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if not name or urlsplit(name).scheme or Path(name).is_absolute():
            continue
        mesh.set("filename", _seen_from(name, original, written))
        changed = True
    return ET.tostring(root, encoding="unicode") + "\n" if changed else text
