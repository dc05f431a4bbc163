"""Structs of the kernel: made by keyword, complete and of the right sizes, or not at all."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import ClosedSystem
from srm_mbs.integration.kernel import backend, marshalling
from srm_mbs.integration.kernel.marshalling import FORCE_KINDS
from srm_mbs.integration.methods.base import IntegratorState
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory
from tests.support.bundled import load

pytestmark = pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}")
core: Any = backend.core


def fields(struct: Any) -> dict[str, Any]:
    """Names and values of a struct."""
    names = [name for name in dir(type(struct)) if not name.startswith("_")]
    return {name: getattr(struct, name) for name in names}


def test_every_constant_has_to_be_given() -> None:
    given = fields(marshalling.CONSTANTS)
    assert len(given) > 40
    assert fields(core.Constants(**given)) == given
    for name in given:
        with pytest.raises(TypeError, match=f"Constants.{name} is not given"):
            core.Constants(**{key: value for key, value in given.items() if key != name})


def test_a_force_element_that_the_kernel_has_not_is_refused_with_the_backend_that_has_it() -> None:
    with pytest.raises(srm.InputError, match=r"no force element 'drag'\. Use backend=.python"):
        marshalling.force_struct(kind="drag")


def test_an_unknown_field_is_refused() -> None:
    with pytest.raises(TypeError, match="Constants has no field tolerance"):
        core.Constants(**fields(marshalling.CONSTANTS), tolerance=1.0)


def test_a_missing_constant_is_an_error_when_the_bridge_is_imported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Kernel:
        @staticmethod
        def Constants(**given: Any) -> Any:  # noqa: N802 - the name of the struct
            del given["safety"]
            return core.Constants(**given)

    monkeypatch.setattr(marshalling, "_core", Kernel)
    with pytest.raises(TypeError, match=r"Constants\.safety is not given"):
        marshalling.constants()


def test_structs_cannot_be_changed() -> None:
    with pytest.raises(AttributeError):
        marshalling.CONSTANTS.safety = 1.0


def test_values_of_another_type_are_refused() -> None:
    given = fields(marshalling.CONSTANTS)
    for name, value in (("safety", "much"), ("max_projections", 2.5), ("safety", None)):
        with pytest.raises(ValueError, match=f"Constants.{name} has another type or size"):
            core.Constants(**given | {name: value})


def test_arrays_of_another_size_are_refused() -> None:
    given = fields(marshalling.tableau_struct(srm.PSRM().scheme))
    for name in ("A", "c", "error", "gap_half_widths"):
        with pytest.raises(ValueError, match=rf"ButcherTableau\.{name} has \d+ numbers instead"):
            core.ButcherTableau(**given | {name: given[name][1:]})
    system = ClosedSystem(load("four_bar"))
    given = fields(marshalling.system_struct(system.constants()))
    for name in ("unit", "residual_scale"):
        with pytest.raises(ValueError, match=rf"SystemData\.{name} has \d+ numbers instead"):
            core.SystemData(**given | {name: given[name][1:]})
    with pytest.raises(ValueError, match=re.escape("Anchor.placement has another type or size")):
        core.Anchor(joint=1, placement=np.zeros(11))


def test_a_force_of_a_kind_that_the_kernel_has_no_formula_for_is_refused() -> None:
    spring = replace(load("four_bar"), forces=[srm.TorsionSpring("crank", 1.0)])
    (force,) = marshalling.system_struct(ClosedSystem(spring).constants()).forces
    given = fields(force)
    assert fields(core.ForceElement(**given))["kind"] == FORCE_KINDS.index("torsion_spring")
    for kind in (-1, len(FORCE_KINDS)):
        with pytest.raises(ValueError, match=f"ForceElement.kind has {kind}, outside of 0 to"):
            core.ForceElement(**given | {"kind": kind})
    core.ForceElement(**given | {"kind": len(FORCE_KINDS) - 1})


def test_a_state_of_another_size_is_refused() -> None:
    system = ClosedSystem(load("four_bar"))
    kernel_system = core.System(system.model, marshalling.system_struct(system.constants()), None)
    for state in (np.zeros(5), np.zeros(7), np.zeros((2, 3))):
        with pytest.raises(ValueError, match=r"state has not the shape \(6,\)"):
            kernel_system.terms(0.0, state)


def test_steps_of_another_shape_are_refused() -> None:
    solution = srm.simulate(load("four_bar"), 1.0, backend="kernel")
    steps, schemes = solution.steps, marshalling.scheme_denses(solution.scheme)
    given = fields(marshalling.steps_struct(steps))
    for name in ("states", "rates", "sigmas", "corrections", "end_rate"):
        array = getattr(steps, name)
        wrong = core.StepArrays(**given | {name: np.ascontiguousarray(array[..., 1:])})
        with pytest.raises(ValueError, match=f"StepArrays.{name} has another shape"):
            core.DenseOutput(
                3,
                3,
                schemes,
                marshalling.dense_constants(),
                wrong,
            )


@pytest.mark.parametrize("normals", [None, np.arange(6.0).reshape(3, 2)])
def test_an_integrator_state_comes_back_as_it_was(normals: np.ndarray | None) -> None:
    values = np.arange(12.0).reshape(4, 3)
    away = None if normals is None else np.arange(6.0).reshape(2, 3)
    history = MultiplierHistory(np.arange(4.0), values, 2.5, 1e-3, normals, away)
    given = IntegratorState(np.arange(6.0), 0.5, np.ones(6), history, 0.25, 7, True, True, 3, 2)
    given.needed_steps, given.saved_steps, given.laws = 30, -2.5, np.arange(2.0)
    found = marshalling.state_from(marshalling.state_struct(given))
    assert found.history is not None
    for name in ("times", "values", "normals", "away"):
        np.testing.assert_array_equal(getattr(found.history, name), getattr(history, name))
    assert (found.history.known_until, found.history.known_below) == (2.5, 1e-3)
    assert (found.sigma, found.sigma_slope, found.steps) == (0.5, 0.25, 7)
    assert found.lingering
    assert (found.stiff, found.stiff_steps, found.other_steps) == (True, 3, 2)
    assert (found.needed_steps, found.saved_steps) == (30, -2.5)
    assert found.laws is not None
    np.testing.assert_array_equal(found.laws, given.laws)
    np.testing.assert_array_equal(found.rate, given.rate)


def data_of(name: str) -> dict[str, Any]:
    return fields(marshalling.system_struct(ClosedSystem(load(name)).constants()))


def one_changed(structs: list[Any], **changes: Any) -> list[Any]:
    """``structs`` with fields of the first replaced."""
    first = structs[0]
    return [type(first)(**fields(first) | changes), *structs[1:]]


BEYOND = 10**6
UNMOVED = np.append(np.eye(3).ravel(), np.zeros(3))
BAD_INDICES: dict[str, tuple[str, Callable[[dict[str, Any]], dict[str, Any]]]] = {
    "structural_rank": ("four_bar", lambda d: {"structural_rank": 3}),
    "structural_rank below zero": ("four_bar", lambda d: {"structural_rank": -1}),
    "rows": ("four_bar", lambda d: {"rows": -1, "residual_scale": np.zeros(0)}),
    "sigma_ref": ("four_bar", lambda d: {"sigma_ref": 0.0}),
    "position_of": ("four_bar", lambda d: {"position_of": [0, 1, 3]}),
    "wrapped_angles": ("four_bar", lambda d: {"wrapped_angles": [3]}),
    "order": ("four_bar", lambda d: {"order": [1, 1]}),
    "residual_scale": ("four_bar", lambda d: {"residual_scale": np.array([1.0, np.nan])}),
    "first_row": ("four_bar", lambda d: {"closures": one_changed(d["closures"], first_row=1)}),
    "joint_a": ("four_bar", lambda d: {"closures": one_changed(d["closures"], joint_a=4)}),
    "joint_b": ("four_bar", lambda d: {"closures": one_changed(d["closures"], joint_b=-1)}),
    "columns": (
        "four_bar",
        lambda d: {"closures": one_changed(d["closures"], columns=[0, 1, BEYOND])},
    ),
    "group": ("stewart_platform", lambda d: {"groups": one_changed(d["groups"], start=BEYOND)}),
    "group size": ("stewart_platform", lambda d: {"groups": one_changed(d["groups"], size=60)}),
    "force": (
        "stewart_platform",
        lambda d: {"forces": one_changed(d["forces"], a=core.Anchor(joint=20, placement=UNMOVED))},
    ),
    "force on a joint": (
        "stewart_platform",
        lambda d: {"forces": one_changed(d["forces"], kind=2, in_v=BEYOND)},
    ),
    "coupling": (
        "differential",
        lambda d: {"joint_rows": one_changed(d["joint_rows"], row=BEYOND)},
    ),
    "coupled joint": (
        "differential",
        lambda d: {"joint_rows": one_changed(d["joint_rows"], in_q=[0, 1, BEYOND])},
    ),
}


@pytest.mark.parametrize("case", BAD_INDICES)
def test_a_row_joint_or_column_that_the_model_does_not_have_is_refused(case: str) -> None:
    name, change = BAD_INDICES[case]
    data = data_of(name)
    with pytest.raises(ValueError, match=r"\w+\.\w+ (has|is not)"):
        core.System(load(name).model, core.SystemData(**data | change(data)), None)


def test_a_model_whose_indices_contradict_each_other_is_refused() -> None:
    data = marshalling.system_struct(ClosedSystem(load("four_bar")).constants())
    for name, value in (("idx_vs", 7), ("parents", 3), ("nqs", 2)):
        model = load("four_bar").model.copy()
        getattr(model, name)[2] = value
        with pytest.raises(ValueError, match="model"):
            core.System(model, data, None)


def test_a_workspace_is_not_renewed_with_arrays_of_other_sizes() -> None:
    system = ClosedSystem(load("four_bar"))
    kernel_system = core.System(system.model, marshalling.system_struct(system.constants()), None)
    good = system.constants_of_start() | {"damping": None, "friction": None}
    for name, size in (("unit", 2), ("residual_scale", 3), ("damping", 1), ("friction", 4)):
        with pytest.raises(ValueError, match=r"has \d numbers instead of \d"):
            kernel_system.renew(**good | {name: np.ones(size)})
    kernel_system.renew(**good)


def test_a_workspace_does_not_move_to_other_joints_or_closures() -> None:
    system = ClosedSystem(load("four_bar"))
    kernel_system = core.System(system.model, marshalling.system_struct(system.constants()), None)
    with pytest.raises(ValueError, match="origins has 0 numbers instead of 2"):
        kernel_system.move(system.model, [])
    with pytest.raises(ValueError, match="model has other joints"):
        kernel_system.move(load("klann_walker").model, system.origins)
    kernel_system.move(system.model, system.origins)
