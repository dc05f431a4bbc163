"""Tests that run on both backends, or on the kernel alone."""

from __future__ import annotations

import pytest

from srm_mbs.integration.kernel import backend

needs_kernel = pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}")
on_both = pytest.mark.parametrize("backend", ["python", pytest.param("kernel", marks=needs_kernel)])
slowly_on_both = pytest.mark.parametrize(
    "backend",
    [
        pytest.param("python", marks=pytest.mark.stress),
        pytest.param("kernel", marks=needs_kernel),
    ],
)
"""As ``on_both``, the reference with the stress tests only."""
