"""Saved runs of several segments: the files of the segments in one archive."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from srm_mbs.errors import InputError
from srm_mbs.request_storage import request_entry, request_from
from srm_mbs.segmented import SegmentedSolution
from srm_mbs.storage import OTHER_VERSION, SAVED_BY, load_plain, save_solution

if TYPE_CHECKING:
    from srm_mbs.solution import Solution

CONTENTS = "segments.json"
FORMAT = 1


def save_segments(solution: SegmentedSolution, path: Path) -> None:
    """Write ``solution`` to ``path``.

    Raises
    ------
    InputError
        As :func:`srm_mbs.storage.save_solution`.
    OSError
        If the file cannot be written.
    """
    contents = {
        "format": FORMAT,
        "count": len(solution.segments),
        "status": solution.status,
        "message": solution.message,
        "request": request_entry(solution),
        "t_eval": None if solution.t_eval is None else solution.t_eval.tolist(),
    }
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(CONTENTS, json.dumps(contents))
        for k, segment in enumerate(solution.segments):
            kept = io.BytesIO()
            save_solution(segment, kept)
            archive.writestr(f"{k}.npz", kept.getvalue())


def load_segments(path: Path) -> Solution | None:
    """The run in ``path``; None if it is no archive of segments.

    Raises
    ------
    InputError
        If it is one, but damaged or of another format.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            segmented = CONTENTS in archive.namelist()
    except Exception:  # what is damaged is named by the reader of plain runs
        return None
    if not segmented:
        return None
    with zipfile.ZipFile(path) as archive:
        try:
            contents = json.loads(archive.read(CONTENTS))
            if contents["format"] != FORMAT:
                raise InputError(
                    f"its segments have format {contents['format']}, this version reads {FORMAT}",
                    remedy=OTHER_VERSION,
                )
            t_eval = contents["t_eval"]
            whole = SegmentedSolution(
                [
                    load_plain(io.BytesIO(archive.read(f"{k}.npz")), f"{path}, segment {k}")
                    for k in range(contents["count"])
                ],
                t_eval=None if t_eval is None else np.array(t_eval),
                status=contents["status"],
                message=contents["message"],
            )
            whole.request = request_from(contents.get("request"))
            return whole
        except InputError as error:
            raise error.located(str(path)) from error
        except Exception as error:
            raise InputError(
                f"it is not a saved run: {error}", file=str(path), remedy=SAVED_BY
            ) from error
