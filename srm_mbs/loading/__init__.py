"""``load``: from a bundled name or a file of any format to an assembled mechanism."""

from __future__ import annotations

from srm_mbs.loading.assembling import rebuild
from srm_mbs.loading.bundled import bundled_models
from srm_mbs.loading.reading import load, n_four_bar

__all__ = ["bundled_models", "load", "n_four_bar", "rebuild"]
