"""The dense algebra of an evaluation as C, for sizes that are known when it is compiled.

It is ``DenseProjection::factorise`` of dense_projection.cpp: M = L L^T, W = L^-1 G^T and its QR
with column pivoting, by the same rules for pivots and signs.  There the loops run along the columns
of W, which are short and get shorter; here they run across them, over all rows of G at once, so
that a processor's vectors are full and no loop has a remainder.  Columns are not exchanged: those
that are done take part in later steps, where nothing reads them.
"""

from __future__ import annotations

SMALLEST = 3
"""Coordinates from which it is generated: the kernel's loops over fewer are unrolled, too."""
LARGEST = 48
"""Coordinates or rows up to which it is generated: beyond them the kernel's sparse algebra costs
less."""


def algebra_of(nv: int, rows: int, rank: int) -> str:
    """The C of the factorisation, or an empty text where there is none.

    Parameters
    ----------
    nv, rows, rank
        Coordinates, rows of G, and the structural rank.
    """
    if rank == 0 or nv < SMALLEST or max(nv, rows) > LARGEST:
        return ""
    sizes = f"enum {{ N = {nv}, ROWS = {rows}, RANK = {rank} }};"
    return _FACTOR.replace("@SIZES@", sizes)


_FACTOR = """
@SIZES@

#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
typedef double vec __attribute__((vector_size(8 * LANES)));
enum { WIDE = (ROWS + LANES - 1) / LANES, HIGH = N / LANES + 1 };
#define EACH(b, count) _Pragma("GCC unroll 16") for (int b = 0; b < count; ++b)

/* From M and G (in A, row by row), f and bias: U with M = U^T U and the inverse of its diagonal,
 * L^-1 f, gamma = G M^-1 f + bias, the squares of W's columns, and in A, tau, inverse pivots and
 * order W Pi = Q R.  1 where M is not positive definite. */
int srm_mbs_factor(const double *restrict M, const double *restrict f, const double *restrict bias,
                   double *restrict A, double *restrict U, double *restrict inverse,
                   double *restrict white, double *restrict gamma, double *restrict tau,
                   double *restrict inverse_pivots, double *restrict row_squares,
                   int *restrict order) {
  vec X[N][WIDE], C[N][HIGH];  /* W; U and, in its column N, L^-1 f */
  for (int i = 0; i < N; ++i) {
    double *const row = (double *)X[i], *const upper = (double *)C[i];
    EACH(b, WIDE) X[i][b] = (vec){0};
    EACH(b, HIGH) C[i][b] = (vec){0};
    for (int j = 0; j < ROWS; ++j) row[j] = A[j * N + i];
    for (int j = i; j < N; ++j) upper[j] = M[j * N + i];
    upper[N] = f[i];
  }
  for (int k = 0; k < N; ++k) {
    const double *const own = (const double *)C[k];
    const double pivot = own[k];
    if (!(pivot > 0.0)) return 1;
    const double diagonal = sqrt(pivot), by = 1.0 / diagonal;
    inverse[k] = by;
    vec x[WIDE], c[HIGH];
    EACH(b, HIGH) C[k][b] = c[b] = C[k][b] * by;
    EACH(b, WIDE) X[k][b] = x[b] = X[k][b] * by;
    U[k * N + k] = diagonal;
    for (int i = k + 1; i < N; ++i) {
      const double u = own[i];
      U[i * N + k] = u;
      if (u == 0.0) continue;
      EACH(b, HIGH) C[i][b] -= u * c[b];
      EACH(b, WIDE) X[i][b] -= u * x[b];
    }
  }
  vec sums[WIDE], squares[WIDE];
  EACH(b, WIDE) sums[b] = squares[b] = (vec){0};
  for (int i = 0; i < N; ++i) {
    const double w = white[i] = ((const double *)C[i])[N];
    EACH(b, WIDE) {
      sums[b] += w * X[i][b];
      squares[b] += X[i][b] * X[i][b];
    }
  }
  const double *const square = (const double *)squares;
  for (int j = 0; j < ROWS; ++j) {
    order[j] = j;
    gamma[j] = ((const double *)sums)[j] + bias[j];
    row_squares[j] = square[j];
  }
  for (int k = 0; k < RANK; ++k) {
    int best = k;
    for (int j = k + 1; j < ROWS; ++j)
      if (square[order[j]] > square[order[best]]) best = j;
    const int column = order[best];
    order[best] = order[k];
    order[k] = column;
    double *const v = A + k * N;
    for (int i = 0; i < N; ++i) v[i] = ((const double *)X[i])[column];
    double tails[4] = {0.0, 0.0, 0.0, 0.0};
    for (int i = k + 1; i < N; ++i) tails[i & 3] += v[i] * v[i];
    const double tail = (tails[0] + tails[1]) + (tails[2] + tails[3]), alpha = v[k];
    double beta = alpha, t = 0.0;
    if (tail != 0.0) {
      beta = -copysign(sqrt(alpha * alpha + tail), alpha);
      t = (beta - alpha) / beta;
      const double scale = 1.0 / (alpha - beta);
      for (int i = k + 1; i < N; ++i) v[i] *= scale;
      v[k] = beta;
    }
    tau[k] = t;
    inverse_pivots[k] = 1.0 / beta;
    vec s[WIDE];
    EACH(b, WIDE) s[b] = X[k][b];
    for (int i = k + 1; i < N; ++i) EACH(b, WIDE) s[b] += v[i] * X[i][b];
    EACH(b, WIDE) {
      s[b] *= t;
      X[k][b] -= s[b];
      squares[b] = (vec){0};
    }
    for (int i = k + 1; i < N; ++i) EACH(b, WIDE) {
      const vec left = X[i][b] - v[i] * s[b];
      X[i][b] = left;
      squares[b] += left * left;
    }
  }
  return 0;
}
"""
