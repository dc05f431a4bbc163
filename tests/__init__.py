"""Tests, with BLAS on one thread."""

import os

# Before NumPy loads: BLAS threads would only get in each other's way on small matrices.
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
