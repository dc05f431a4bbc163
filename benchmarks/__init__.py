"""Measurements behind the numbers in the documentation; BLAS on one thread.

They measure what a user of a mechanism has after a while: with generated code, compiled before the
measurement, where there is a C compiler.  Another backend can be asked for in the environment.
"""

import os

# Before NumPy loads: BLAS threads would only get in each other's way on small matrices.
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

# With "auto" the first runs would be the kernel's, and the next ones depend on the load.
os.environ.setdefault("SRM_MBS_BACKEND", "generated")
