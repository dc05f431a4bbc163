"""The result of a sweep: a table with one row per case, and the failures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from srm_mbs.errors import InputError, KnownKeys, get_logger
from srm_mbs.formats.files import whole_file
from srm_mbs.model.lazy import cached_property
from srm_mbs.simulation.csv_export import write_table
from srm_mbs.sweeps.cases import Case
from srm_mbs.sweeps.tasks import Outcome

if TYPE_CHECKING:
    import pandas

log = get_logger(__name__)


@dataclass(frozen=True)
class Failure:
    """A case that raised an exception.

    Attributes
    ----------
    index, name, parameters
        Of the case.
    message
        Type and text of the exception.
    traceback
        Its traceback as text.
    """

    index: int
    name: int | str
    parameters: Mapping[str, Any]
    message: str
    traceback: str


class Sweep:
    """Result of :func:`srm_mbs.sweep`.

    Attributes
    ----------
    cases
        Parameters of each case, in the order given.
    failures
        The cases that raised an exception, with their parameters and the traceback.  A run that
        ended early is no failure: its row has the reason.
    resumed
        Number of cases that were read from the file ``resume``.
    """

    def __init__(self, cases: Sequence[Case], outcomes: Sequence[Outcome], resumed: int) -> None:
        self.cases = tuple(case.parameters for case in cases)
        self.resumed = resumed
        self._cases, self._outcomes = tuple(cases), tuple(outcomes)
        self.failures = tuple(
            Failure(case.index, case.name, case.parameters, outcome.message, outcome.traceback)
            for case, outcome in zip(cases, outcomes)
            if outcome.traceback
        )

    def __len__(self) -> int:
        return len(self._cases)

    @cached_property
    def table(self) -> dict[str, NDArray[Any]]:
        """Columns (cases,): ``case``, parameters, ``success``, ``status``, ``message``, measures.

        Parameters with several values have a column for each, ``q0[0]`` or ``q.crank``.  Missing
        numbers are nan, missing texts empty.
        """
        rows: list[dict[str, Any]] = [
            {
                "case": case.name,
                **dict(_flat(case.parameters)),
                "success": outcome.success,
                "status": outcome.status,
                "message": outcome.message,
                **outcome.measures,
            }
            for case, outcome in zip(self._cases, self._outcomes)
        ]
        # The parameters of all cases precede the measures.
        names = {"case": None} | dict.fromkeys(
            name for case in self.cases for name, _ in _flat(case)
        )
        for row in rows:
            names |= dict.fromkeys(row)
        return KnownKeys((name, _column([row.get(name) for row in rows])) for name in names)

    def to_pandas(self) -> pandas.DataFrame:
        """The table as a data frame.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        return _optional("pandas").DataFrame(self.table)

    def to_parquet(self, path: str | Path) -> None:
        """Write the table as a Parquet file.

        Raises
        ------
        InputError
            If pyarrow is not installed.
        OSError
            If the file cannot be written.
        """
        table = _optional("pyarrow").table(self.table)
        parquet = _optional("pyarrow.parquet")
        with whole_file(path) as temporary:
            parquet.write_table(table, str(temporary))
        log.info("written: %s", path)

    def to_csv(self, path: str | Path) -> None:
        """Write the table as comma-separated values, with enough digits to restore the floats.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        write_table(self.table, path)

    def __repr__(self) -> str:
        ended = sum(outcome.success for outcome in self._outcomes)
        return (
            f"Sweep({len(self)} cases, {ended} reached the end, {len(self.failures)} failures, "
            f"{self.resumed} resumed)"
        )


def _flat(parameters: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """(column, value) of the parameters of one case."""
    for name, value in parameters.items():
        if isinstance(value, Mapping):
            yield from _flat({f"{name}.{key}": part for key, part in value.items()})
        elif isinstance(value, np.ndarray | list | tuple) and np.ndim(value):
            yield from _flat({f"{name}[{k}]": part for k, part in enumerate(value)})
        elif isinstance(value, np.generic | np.ndarray):
            yield name, value.item()
        elif value is None or isinstance(value, bool | int | float | str):
            yield name, value
        else:
            yield name, getattr(value, "__qualname__", None) or repr(value)


def _column(values: list[Any]) -> NDArray[Any]:
    """``values`` as integers, booleans, floats with nan, or texts: the first that holds all."""
    present = [value for value in values if value is not None]
    complete = len(present) == len(values)
    if complete and all(isinstance(value, bool) for value in present):
        return np.array(values, dtype=bool)
    if all(isinstance(value, int | float) for value in present):
        whole = complete and not any(isinstance(value, float) for value in present)
        if whole and all(abs(value) < 2**63 for value in present):
            return np.array(values, dtype=np.int64)
        return np.array([np.nan if value is None else value for value in values], dtype=float)
    return np.array(["" if value is None else str(value) for value in values])


def _optional(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(
            f"{name.partition('.')[0]} is not installed",
            remedy='Install it: pip install "srm-mbs[sweep]"; sweep.table and sweep.to_csv do '
            "without",
        ) from error
