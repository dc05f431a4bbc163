"""Which files the file of a mechanism may name, and where they are searched.

Whoever loads a mechanism decides this; no file can, and saved runs do not contain it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pinocchio as pin

from srm_mbs.errors import InputError, safe_repr

MANIFESTS = ("package.xml", "model.config")
"""Files at the top of a package of ROS and of a model of Gazebo."""
PARTS_OF_PACKAGES = frozenset(
    ("description", "mjcf", "model", "models", "robot", "robots", "sdf", "urdf", "worlds", "xml")
)
"""Usual names of the folder of a package that has its model files: their package is above it."""
PACKAGE_DEPTH = 8
"""Number of folders above a model file that are searched for a manifest."""
SEARCH_PATHS = {
    "ROS_PACKAGE_PATH": "",
    "AMENT_PREFIX_PATH": "share",
    "GAZEBO_MODEL_PATH": "",
    "GZ_SIM_RESOURCE_PATH": "",
}
"""Environment variables with lists of folders of packages, and where in these the packages are."""
PACKAGE_SCHEMES = ("package", "model")
SHARED = "example-robot-data"
"""Package of models that everything may read."""
LONGEST_PATH = 1000
"""Characters of the name of a file in a mechanism."""


def path_remedy(name: str, relative_to: str = "") -> str:
    """Remedy for a ``name`` in a file that leads to no file, which may be
    ``relative_to`` something."""
    verb = "Write / instead of \\ in" if "\\" in name else "Check"
    return f"{verb} the path{f', which is relative to {relative_to}' * bool(relative_to)}"


@dataclass(frozen=True)
class Reach:
    """The folders from which a mechanism may read further files.

    Attributes
    ----------
    folders
        Folders of the model and of its package, without symbolic links.
    mesh_dirs
        Folders that the caller has named, without symbolic links; files are searched there too.
    allow_outside
        Whether files anywhere else may be read.
    """

    folders: tuple[Path, ...] = ()
    mesh_dirs: tuple[Path, ...] = ()
    allow_outside: bool = False

    @classmethod
    def of(
        cls,
        path: str | os.PathLike[str],
        mesh_dirs: Iterable[str | os.PathLike[str]] = (),
        allow_outside: bool = False,
    ) -> Reach:
        """The reach of the file ``path`` that the caller has named.

        Raises
        ------
        InputError
            If one of ``mesh_dirs`` is no folder, or ``allow_outside`` is no bool.
        """
        if not isinstance(allow_outside, bool):
            raise InputError(
                f"allow_outside = {safe_repr(allow_outside)} is not True or False",
                element="allow_outside",
                remedy="Give True or False",
            )
        folder = Path(os.path.realpath(Path(path).parent))
        return cls((folder, *_package_of(folder)), _given_folders(mesh_dirs), allow_outside)

    def find(
        self,
        name: str,
        folder: Path,
        what: str,
        in_folder: Callable[[Path], Path] | None = None,
    ) -> Path:
        """The file ``name`` that a file in ``folder`` names, without symbolic links.

        Parameters
        ----------
        name
            A path relative to ``folder``, an absolute one, or a URI: ``file://``, or
            ``package://`` and ``model://`` with a folder above ``folder`` or in the
            search paths of the environment.
        folder
            Where relative paths begin.
        what
            What it is, for messages: ``mesh file``.
        in_folder
            The file that is meant where ``name`` is a folder.

        Raises
        ------
        InputError
            If there is no such file, or it is out of reach.
        """
        if len(name) > LONGEST_PATH or not name.isprintable():
            raise InputError(
                f"the name of the {what} has {len(name)} characters, or some that do not print",
                remedy=f"Give at most {LONGEST_PATH} printable characters",
            )
        outside = None
        for candidate, package in self._candidates(name, folder):
            try:
                if in_folder is not None and candidate.is_dir():
                    if not self._allows(_real(candidate), package):
                        outside = outside or candidate
                        continue
                    candidate = in_folder(candidate)
                if not candidate.exists() or (candidate.is_dir() and in_folder is not None):
                    continue
            except OSError:  # a name that is too long, a folder that is closed to us
                continue
            real = _real(candidate)
            if self._allows(real, package):
                return real
            outside = outside or candidate
        if outside is not None:
            raise self.refusal(name, what)
        raise InputError(f"there is no {what} {name!r}", remedy=path_remedy(name))

    def searched(self, folder: Path) -> tuple[Path, ...]:
        """Where the files that a file in ``folder`` names are searched, for messages; files of a
        package also in the folders above it."""
        own = Path(os.path.realpath(folder))
        return tuple(dict.fromkeys((own, *self.folders, *self.mesh_dirs, *_search_paths())))

    def check(self, path: Path, what: str) -> Path:
        """``path`` without symbolic links.

        Raises
        ------
        InputError
            If it is out of reach.
        """
        real = _real(path)
        if not self._allows(real, None):
            raise self.refusal(str(path), what)
        return real

    def refusal(self, name: str, what: str) -> InputError:
        """The error about the file ``name``, which is out of reach."""
        return InputError(
            f"the {what} {name!r} lies outside the folders of the model",
            remedy="Move it there, name its folder with mesh_dirs=, or allow it with "
            "allow_outside=True (--allow-outside)",
        )

    def _allows(self, real: Path, package: Path | None) -> bool:
        shared = [folder / SHARED for folder in _shared_data()]
        roots = (*self.folders, *self.mesh_dirs, *shared, _bundled_urdfs(), *_search_paths())
        return (
            self.allow_outside
            or any(real.is_relative_to(root) for root in roots)
            or (package is not None and real.is_relative_to(package))
        )

    def _candidates(self, name: str, folder: Path) -> Iterator[tuple[Path, Path | None]]:
        """Where ``name`` may be, each with the package that the name makes accessible."""
        try:
            url = urlsplit(name)
        except ValueError:  # brackets that hold no address
            url = urlsplit("")
        if url.scheme == "file":
            yield Path(unquote(url.path)), None
            return
        if url.scheme not in PACKAGE_SCHEMES:
            for start in (folder, *self.mesh_dirs):
                yield start / name, None
            return
        below = unquote(f"{url.netloc}{url.path}").lstrip("/")
        package, _, rest = below.partition("/")
        above = [folder, *folder.absolute().parents]
        for start in (*above, *self.mesh_dirs, *_search_paths(), *_shared_data()):
            yield start / below, self._package(start / package, package, folder)
        for start in (*self.mesh_dirs, *_search_paths()):
            if start.name == package:
                yield start / rest, None
        for start in self.mesh_dirs:
            yield start / rest, None

    def _package(self, root: Path, name: str, folder: Path) -> Path | None:
        """``root`` without symbolic links if it is a package, or the folder of this ``name`` that
        the model is in."""
        real = _real(root)
        if name in ("", ".", "..") or _is_private(real):
            return None
        contains = any(own.is_relative_to(real) for own in self.folders[:1])
        marked = any((real / manifest).is_file() for manifest in MANIFESTS)
        return real if contains or marked else None


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _is_private(folder: Path) -> bool:
    """Whether a folder is the home of the user, or contains it: no package is that."""
    return Path(os.path.realpath(os.path.expanduser("~"))).is_relative_to(folder)


def _package_of(folder: Path) -> tuple[Path, ...]:
    """The package that the model files in ``folder`` belong to; empty if it is not known."""
    for above in (folder, *folder.parents)[:PACKAGE_DEPTH]:
        if _is_private(above):
            break
        if any((above / manifest).is_file() for manifest in MANIFESTS):
            return (above,)
    usual = folder.name.lower() in PARTS_OF_PACKAGES and not _is_private(folder.parent)
    return (folder.parent,) if usual else ()


def folder_list(given: Any) -> tuple[Any, ...]:
    """``given``, one folder or several, as a tuple.

    Raises
    ------
    InputError
        If it is anything else.
    """
    if isinstance(given, str | os.PathLike):
        return (given,)
    try:
        return tuple(given)
    except TypeError:
        raise InputError(
            f"mesh_dirs = {safe_repr(given)} is not a list of folders",
            element="mesh_dirs",
            remedy="Give a list of folders",
        ) from None


def _given_folders(folders: Any) -> tuple[Path, ...]:
    found = []
    for folder in folder_list(folders):
        if not isinstance(folder, str | os.PathLike) or not os.path.isdir(folder):
            raise InputError(
                f"there is no folder {str(folder)!r}",
                element="mesh_dirs",
                remedy="Give folders that exist",
            )
        found.append(Path(os.path.realpath(folder)))
    return tuple(found)


def _search_paths() -> list[Path]:
    """Folders of packages that the environment names."""
    return [
        _real(Path(entry, below))
        for variable, below in SEARCH_PATHS.items()
        for entry in os.environ.get(variable, "").split(os.pathsep)
        if os.path.isabs(entry)
    ]


def _bundled_urdfs() -> Path:
    """Folder of the bundled URDFs: inside an installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    return (package if (package / "models").is_dir() else package.parent) / "urdf"


def _shared_data() -> list[Path]:
    """The folders above the data of :data:`SHARED`, installed under the prefix of Pinocchio."""
    shared = (prefix / "share" for prefix in Path(pin.__file__).parents)
    return [_real(folder) for folder in shared if (folder / SHARED).is_dir()]
