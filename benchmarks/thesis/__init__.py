"""The tables and figures of the thesis, computed again.

C. B. Macdonald, *The Predicted Sequential Regularization Method for Differential-Algebraic
Equations*, Acadia University 2001.  ``python -m benchmarks.thesis --out DIR``.
"""
