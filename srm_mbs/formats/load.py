"""``load``: from the name of a bundled mechanism, or a file of any format, to a mechanism."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import tomli_w

from srm_mbs.dynamics.constraints.reusable_analysis import ReusableAnalysis
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError, get_logger, naming, safe_repr
from srm_mbs.formats.build import Reading, assembled
from srm_mbs.formats.document import Document, RepeatedDocument
from srm_mbs.formats.registry import DESCRIPTION, LINKAGE, Format, find_format, of_key
from srm_mbs.formats.toml.description import Description, check_description
from srm_mbs.formats.toml.parameters import (
    Place,
    Resolved,
    expressions,
    given_parameters,
    nested,
)
from srm_mbs.formats.translation import KnownTree, Options, TreeParts, merged
from srm_mbs.formats.urdf.override import override, without_overrides
from srm_mbs.formats.urdf.parser import ROOT_JOINTS
from srm_mbs.formats.urdf.variants import OverridableTree
from srm_mbs.formats.variants import VARYING, KnownLinkage
from srm_mbs.model.copies import copied
from srm_mbs.model.mechanism import Source, SourceTexts, variant_maker
from srm_mbs.model.numbers import (
    LARGEST_MAGNITUDE,
    choice,
    finite_array,
    name_list,
    positive_integer,
)
from srm_mbs.model.reach import Reach, folder_list, path_remedy

log = get_logger(__name__)

GENERATED = re.compile(r"n_four_bar_([1-9][0-9]{0,8})\Z")
"""Names of generated mechanisms, with the number of loops."""


KEPT_NAMES = 64
"""Files whose URDFs have names already: variants are read from one file."""


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


@dataclass(frozen=True)
class Overrides:
    """Arguments of :func:`load`.

    ``gravity``, ``base`` and ``cut`` replace values of the file (None or empty: the file's);
    so do ``massless`` and ``closing_tolerance`` (None: the file's).  ``keyframe`` names one of its
    states; ``mesh_dirs`` and ``allow_outside`` say which other files it may name;
    ``parameters`` are values of parameters of a description.
    """

    gravity: Sequence[float] | None = None
    base: str | None = None
    cut: tuple[str, ...] = ()
    mesh_dirs: tuple[str | Path, ...] = ()
    allow_outside: bool = False
    keyframe: str | None = None
    massless: str | Mapping[str, float] | None = None
    closing_tolerance: float | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)

    def entries(self) -> dict[str, Any]:
        """The options that are keys of a description, which a saved run and a conversion keep."""
        given = {"massless": self.massless, "closing_tolerance": self.closing_tolerance}
        if isinstance(self.massless, Mapping):
            given["massless"] = dict(self.massless)
        return {key: value for key, value in given.items() if value is not None}


def _gravity(value: Any) -> tuple[float, float, float]:
    array = finite_array(value, (3,))
    if array is None or not (np.abs(array) <= LARGEST_MAGNITUDE).all():
        raise InputError(
            f"gravity = {safe_repr(value)} is not three finite numbers",
            element="gravity",
            remedy="Give [x, y, z] in m/s^2",
        )
    x, y, z = array.tolist()
    return (x, y, z)


@lru_cache(maxsize=KEPT_NAMES)
def _urdf_name(file: str) -> str:
    """Name of the URDF that a translation of ``file`` makes."""
    return Path(file).with_suffix(".urdf").name


def _translated(
    own: Document,
    entries: Mapping[str, Any],
    description: Description,
    found: Format,
    model: Document,
    overrides: Overrides,
    reach: Reach,
    known: KnownLinkage | None = None,
) -> Reading:
    """Translate ``model``, the file that the description names, and merge the two."""
    keyframe = overrides.keyframe
    if keyframe is not None and not (isinstance(keyframe, str) and found.key == "mjcf"):
        raise InputError(
            f"{safe_repr(keyframe)} is no keyframe: the model file is a {found.name}",
            element="keyframe",
            remedy="Give the name of a keyframe of an MJCF file",
        )
    cut = overrides.cut or tuple(description.cut)
    base = None if overrides.base is None else choice(overrides.base, ROOT_JOINTS, "base")
    tree = None if known is None else known.tree
    options = Options(cut, entries, reach, keyframe, base, description.planar, tree)
    translation = found.translate(model, options)
    given, as_read, overridable = overrides.entries(), bool(own.text), None
    if description.override:
        if found is LINKAGE:
            raise InputError(
                "a planar linkage has no joints and links to change",
                file=own.file,
                element="override",
                remedy='Give its points and masses expressions, as "=2*crank"',
            )
        if found.key == "urdf" and not translation.entries:
            overridable = OverridableTree.of(translation.tree, description.override, model.file)
        override(translation.tree, description.override, own.file, model.file)
        translation = replace(translation, write=None)  # the text of the changed tree
        entries, as_read = without_overrides(entries), False
    if translation.entries or found.key != "urdf":
        entries = merged(entries, translation.entries, _urdf_name(model.file))
        as_read = False
    elements = None
    if known is not None and translation.model is not None and not given:
        elements = known.elements(entries)
    if elements is not None:
        description = elements.description
    elif given or not as_read:
        entries = {**entries, **given}
        description = check_description(entries, own.file)
        as_read = False
    gravity = description.gravity if overrides.gravity is None else overrides.gravity
    text = own.text if as_read else partial(tomli_w.dumps, entries)
    source = Source(
        SourceTexts(text, lambda: translation.urdf),
        urdf_path=translation.urdf_file or model.file,
        path=own.file,
        base=description.base if base is None else base,
        gravity=_gravity(gravity),
        format=found.name,
        reach=reach,
    )
    log.debug("%s: read as %s", model.file, found.name)
    notes = (*model.notes, *translation.notes)
    return Reading(
        description,
        entries,
        translation.tree,
        source,
        notes,
        translation.file_terms,
        parts=translation.parts,
        model=translation.model,
        elements=elements,
        vary=translation.vary,
        overridable=overridable,
    )


def _varied(
    known: KnownLinkage, found: Resolved, whole: Callable[[], Source], variants: _Variants
) -> Reading | None:
    """A variant of which nothing but numbers is read; None where it has to be read as a ``whole``,
    as its texts are when they are asked for."""
    varied = known.varied(found.numbers)
    if varied is None:
        return None
    source, made = known.source, cache(whole)
    return Reading(
        varied.elements.description,
        {},
        Element("robot"),
        Source(
            SourceTexts(lambda: made().description, lambda: made().urdf),
            source.urdf_path,
            source.path,
            source.base,
            source.gravity,
            source.format,
            source.reach,
            found.values,
        ),
        notes=(*varied.notes, *found.notes),
        file_terms=known.numbers,
        kind=variants.kind,
        variants=variants,
        analysis=variants.analysis,
        model=varied.model,
        elements=varied.elements,
    )


def _of_description(
    own: Document,
    overrides: Overrides,
    reach: Reach,
    urdf: str | None = None,
    origin: _Variants | None = None,
) -> Reading:
    """Read a description; its model file is read from disk unless ``urdf`` is its text.  A variant
    has an ``origin``."""
    found = Resolved(own.toml, overrides.parameters, own.file)

    def whole(known: KnownLinkage | None) -> tuple[Reading, str | None]:
        entries = found.entries
        document = own if entries is own.toml else Document("", own.file)
        description = check_description(entries, own.file)
        return _of_tables(document, entries, description, overrides, reach, urdf, known)

    variants, known = None, None
    if origin is not None:
        variants, known = copied(origin, overrides=overrides), origin.known
        if known is not None and not overrides.entries():
            varied = _varied(known, found, lambda: whole(None)[0].source, variants)
            if varied is not None:
                return varied
    reading, model = whole(known)
    if variants is None and found.values:
        variants = _Variants(own, overrides, reach, model)
    return replace(
        reading,
        source=replace(reading.source, parameters=found.values),
        notes=(*reading.notes, *found.notes),
        variants=variants,
        analysis=None if variants is None else variants.analysis,
        kind=Mechanism if variants is None else variants.kind,
    )


@dataclass(frozen=True, eq=False)
class _Variants:
    """A description with parameters, and the text of its model file if it names one.

    ``analysis`` and ``known`` are those of the mechanism that was loaded first: all variants are
    compared with it, so that they do not depend on the order in which they are made.  ``kind`` is
    their class.
    """

    own: Document
    overrides: Overrides
    reach: Reach
    model: str | None
    kind: type[Mechanism] = Mechanism
    analysis: ReusableAnalysis | None = None
    known: KnownLinkage | None = None

    @property
    def definition(self) -> tuple[Any, ...]:
        return (self.own.text or tomli_w.dumps(self.own.toml), self.model, self.overrides)

    def __call__(self, parameters: Mapping[str, Any]) -> Mechanism:
        values = {**self.overrides.parameters, **given_parameters(parameters)}
        with naming(file=self.own.file):
            overrides = copied(self.overrides, parameters=values)
            reading = _of_description(self.own, overrides, self.reach, self.model, self)
            mechanism = assembled(reading)
        variant_maker.keep(mechanism, reading.variants)
        return mechanism


def _of_tables(
    own: Document,
    entries: Mapping[str, Any],
    description: Description,
    overrides: Overrides,
    reach: Reach,
    urdf: str | None,
    known: KnownLinkage | None,
) -> tuple[Reading, str | None]:
    """Read what a description, whose tables are checked, consists of or names; with the text of its
    model file."""
    if description.planar is not None:
        read = _translated(own, entries, description, LINKAGE, own, overrides, reach, known)
        return read, None
    key, name = description.model_file
    path = Path(own.file).parent / name
    if urdf is not None:
        # With other values of parameters it is a variant, of several probably.
        kind = RepeatedDocument if overrides.parameters else Document
        model = kind(urdf, str(path))
    else:
        with naming(file=own.file, element=key):
            reach.check(path, "file")
        try:
            model = Document.read(path)
        except InputError as error:
            relative = path_remedy(name, "the description")
            raise InputError(
                f"the {key.upper()} {name!r} cannot be read ({error.problem}: {str(path)!r})",
                file=own.file,
                element=key,
                remedy=error.remedy if os.path.exists(path) else relative,
            ) from error
    found = of_key(key, path, model)
    reading = _translated(own, entries, description, found, model, overrides, reach)
    return reading, model.text


def mechanism_of(reading: Reading) -> Mechanism:
    """The assembled mechanism, which knows its variants.

    Raises
    ------
    InputError, AssemblyError
        As :func:`load`.
    """
    with naming(file=reading.source.path):
        mechanism = assembled(reading)
    if isinstance(reading.variants, _Variants):
        variants = replace(
            reading.variants,
            analysis=ReusableAnalysis.of(mechanism),
            known=_known_linkage(reading, mechanism, reading.variants.own),
            kind=reading.kind,
        )
        variant_maker.keep(mechanism, variants)
    return mechanism


def _known_linkage(reading: Reading, mechanism: Mechanism, own: Document) -> KnownLinkage | None:
    """A mechanism for its variants; None where more than its numbers made its tree, or where its
    variants need the URDF itself."""
    description, model = reading.description, mechanism.model
    changed = description.lock or description.massless != "refused" or model.armature.any()
    if changed or description.gravity_compensation:
        return None
    parts, overridable, places = reading.parts, reading.overridable, expressions(own.toml)
    if overridable is not None:
        # What the check of the file notes may be about its numbers.
        fits = mechanism.notes == reading.notes and _are_overridden(places, description)
        overridable = overridable.with_numbers(nested(places)) if fits else None
    if parts is None and overridable is None:
        return None
    tree = KnownTree(parts or TreeParts((), ()), model, mechanism.tree_results)
    # Variants take over the rows of those that the mechanism has as they are described.
    kept = {loop.name: loop for loop in mechanism.loops}
    described = description.closures()
    closures = tuple(kept[one.name] if kept.get(one.name) == one else one for one in described)
    return KnownLinkage(
        tree,
        description,
        reading.entries,
        closures,
        mechanism.points,
        replace(reading.source, texts=SourceTexts("", "")),
        None if reading.vary is None else reading.vary(places),
        overridable,
        {key: numbers for key, numbers in nested(places).items() if key in VARYING},
    )


def _are_overridden(places: Iterable[Place], description: Description) -> bool:
    """Whether all numbers at ``places`` are those of ``[[override]]``, of the start, of points, or
    of both ends of closures."""
    for place in places:
        match place:
            case ["loop", int(i), "a" | "b", *_]:
                loop = description.loop[i]
                if loop.a is None or loop.b is None:
                    return False
            case ["override" | "points" | "initial", *_]:
                pass
            case _:
                return False
    return True


def _of_file(path: Path, overrides: Overrides) -> Reading:
    if path.is_dir():
        raise InputError("it is a directory", remedy="Give a file in it")
    reach = Reach.of(path, overrides.mesh_dirs, overrides.allow_outside)
    document = Document.read(path)
    found = find_format(path, document)
    if found is DESCRIPTION:
        return _of_description(document, overrides, reach)
    if overrides.parameters:
        raise InputError(
            f"a {found.name} has no parameters",
            element="parameters",
            remedy="Give a TOML description with [parameters]",
        )
    entries = {"format": 1, "urdf": path.name}
    own = Document(tomli_w.dumps(entries), document.file)
    description = check_description(entries, own.file)
    return _translated(own, entries, description, found, document, overrides, reach)


def read(name: str | Path, overrides: Overrides) -> Reading:
    """Read a bundled mechanism or a file of any format; see :func:`load`.

    Raises
    ------
    InputError
        For anything that cannot be read, naming file, element and remedy.
    """
    try:
        given = os.fspath(name)
    except Exception:  # objects may raise anything
        given = None
    if not isinstance(given, str):
        raise InputError(
            f"{type(name).__name__} is not a type of names and paths",
            element="path",
            remedy="Give a bundled mechanism or the path of a file; srm.Mechanism takes a "
            "pinocchio.Model",
        )
    name = str.__str__(given)  # a subclass formats itself as it likes
    is_name = not Path(name).suffix and "/" not in name and "\\" not in name
    if is_name and name in bundled_models():
        name = str(models_folder() / f"{name}.toml")
    elif is_name and not (name and Path(name).exists()):  # "" would be the working folder
        generated = GENERATED.match(name)
        if generated is None:
            raise InputError(
                f"there is no bundled mechanism {safe_repr(name)}",
                remedy=f"Known: {', '.join(bundled_models())}; or give the path of a file",
            )
        return _generated(int(generated[1]), overrides)
    with naming(file=name):
        return _of_file(Path(name), overrides)


def read_tables(entries: dict[str, Any], name: str) -> Reading:
    """Read the tables of a description with a section ``[planar]``, which messages call ``name``.

    Raises
    ------
    InputError
        For what the tables cannot be, naming the element and the remedy.
    """
    return _of_description(Document.of_tables(entries, name), Overrides(), Reach())


def load(
    path: str | Path,
    *,
    gravity: Sequence[float] | None = None,
    base: str | None = None,
    cut: Sequence[str] = (),
    mesh_dirs: Sequence[str | Path] = (),
    allow_outside: bool = False,
    keyframe: str | None = None,
    massless: str | Mapping[str, float] | None = None,
    closing_tolerance: float | None = None,
    parameters: Mapping[str, float] | None = None,
) -> Mechanism:
    """Load a mechanism and assemble its initial state.

    Parameters
    ----------
    path
        Name of a bundled mechanism (:func:`bundled_models`; ``n_four_bar_<N>`` for any N), or a
        file: a ``.toml`` description, or one of the formats of ``docs/formats.md``, recognised by
        its content.
    gravity : (3,) m/s^2
        Instead of the file's.
    base
        ``fixed``, ``floating`` or ``planar``, instead of the file's.
    cut
        Names of the joints at which to cut the loops of a file whose joints form a graph: they
        become closures, the others stay joints.
    mesh_dirs
        Further folders in which files that it names (meshes, included files) are searched.
    allow_outside
        Whether it may name files anywhere.  By default they lie, symbolic links resolved, in its
        folder, in its package, in packages found through the environment, or in ``mesh_dirs``
        (``docs/formats.md``); the mechanism keeps the decision for its animations.
    keyframe
        Name of the keyframe of an MJCF file in which the mechanism starts (its number from 0, as
        text, if it has no name), instead of the pose of the file.  With closures its positions are
        the guess from which they close, and its rates are left out.
    massless
        What to do about moving ends of chains without inertia, which are an error by default:
        ``"fix"`` locks the joints that move nothing but them; ``{"mass": m, "inertia": I}`` gives
        each of their links a ball of m (kg) and I (kg m^2) at its origin.  A note names them.
    closing_tolerance
        Accuracy (m, rad) of the data of overconstrained loops that do not close exactly: closure
        rows that the others imply to this tolerance, along the motion too, are left out, and a note
        names them.  By default such loops are an error that names the residual.
    parameters
        Values of parameters of a description instead of those of its table ``[parameters]``,
        name -> number.

    Raises
    ------
    InputError
        For anything that cannot be read, naming file, element and remedy.
    AssemblyError
        If the loops cannot close or held values contradict each other.
    """
    overrides = Overrides(
        gravity,
        base,
        name_list(cut, "cut"),
        folder_list(mesh_dirs),
        allow_outside,
        keyframe,
        massless,
        closing_tolerance,
        given_parameters(parameters),
    )
    return mechanism_of(read(path, overrides))


LARGEST_N, LARGEST_DENSE_N = 1000, 300
"""Loops of a generated N-four-bar with the kernel, whose memory grows as N^2, and without it, as
N^3."""


def largest_n() -> int:
    """Loops of the largest N-four-bar that is made here."""
    from srm_mbs._kernel import core

    return LARGEST_DENSE_N if core is None else LARGEST_N


def n_four_bar_texts(n: int) -> tuple[str, str]:
    """Description and URDF of the N-four-bar with ``n`` loops (n >= 1)."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["number"] = "{:.10g}".format  # without the noise of rounding
    toml, urdf = (
        environment.get_template(f"n_four_bar.{suffix}.j2").render(n=n)
        for suffix in ("toml", "urdf")
    )
    return toml, urdf


def _generated(n: int, overrides: Overrides) -> Reading:
    largest = largest_n()
    if n > largest:
        raise InputError(
            f"an N-four-bar with N = {safe_repr(n)} is too large for the memory of its analysis",
            element="n",
            remedy=f"Take N <= {largest}"
            + (f", or N <= {LARGEST_N} with the compiled kernel" if largest < LARGEST_N else ""),
        )
    text, urdf = n_four_bar_texts(n)
    own = Document(text, f"n_four_bar_{n}, generated")
    return _of_description(own, overrides, Reach(), urdf)


def n_four_bar(n: int) -> Mechanism:
    """The IFToMM N-four-bar benchmark with ``n`` loops (n >= 1), assembled.

    Benchmark A02 of the IFToMM Technical Committee for Multibody Dynamics (Library of
    Computational Benchmark Problems): 2 N + 1 uniform rods of 1 m and 1 kg, of which N + 1
    are cranks pivoted at (i, 0, 0) and N are couplers between neighbouring crank tips, under
    gravity of 9.81 m/s^2.  It starts with the cranks upright and the first crank tip moving at
    1 m/s in +x.  It has one degree of freedom, and N + 1 whenever the cranks are horizontal.  The
    common crank angle obeys

        I theta'' = -g W cos(theta),   I = (N + 1)/3 + N,   W = (N + 1)/2 + N,

    with theta(0) = pi/2, theta'(0) = -1/s; at t = 10 s the first crank tip is
    at x = 0.3284581115, z = 0.9445185382 (N = 2) and x = 0.1805122267, z = 0.9835727406 (N = 40).

    Raises
    ------
    InputError
        If n < 1 or n > 1000 (300 without the compiled kernel).
    """
    loops = positive_integer(n, "n", "Give the number of loops", " of loops")
    return assembled(_generated(loops, Overrides()))
