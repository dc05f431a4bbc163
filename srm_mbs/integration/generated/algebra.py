"""The dense algebra of an evaluation as C, for sizes and zeros that are known beforehand.

It is that of ``DenseProjection`` (dense_projection.cpp), M = L L^T, W = L^-1 G^T, W Pi = Q R, by
the same rules for pivots, and differs where that saves work:

* Coordinates are eliminated from the leaves of the tree to its root, so that L has no entries that
  M has not (Featherstone 2005, Int. J. Robotics Research 24:487), and a column of W only those of
  the coordinates that move its row, and of their ancestors.  White vectors are in this order.
* A reflection leads onto the largest entry of its column instead of the next row, which need not
  have any.  Each column has a set of bits, the rows in which it may differ from zero: reflections
  skip the others.
* Loops run across the columns of W, over all rows of G at once, so that a processor's vectors are
  full and no loop has a remainder.  Columns are not exchanged: those that are done take part in
  later steps, where nothing reads them.
* Norms of columns are updated, and computed again where that loses digits, as LAPACK's xGEQP3
  does.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

LARGEST = 64
"""Coordinates or rows up to which it is generated: a set of rows has as many bits, and beyond it
the kernel's sparse algebra costs less."""


TAKEN = 8
"""Rows of G up to which the vectors of G^T are made of its entries without X in between."""
LARGEST_UNROLLED = 8
"""Coordinates up to which there are no loops over them, and nothing is skipped but what is zero
beforehand.  The factorisation is then written statement by statement: a compiler that has to unroll
loops takes longer."""


def algebra_of(
    nv: int,
    rows: int,
    rank: int,
    mass: Collection[tuple[int, int]],
    jacobian: Collection[tuple[int, int]],
) -> str:
    """The C of the factorisation and of the products with its factors, or an empty text where there
    is none.

    Parameters
    ----------
    nv, rows, rank
        Coordinates, rows of G, and the structural rank.
    mass
        Pairs of coordinates whose entry of M may differ from zero, the smaller one first.
    jacobian
        Row and coordinate of the entries of G that the terms write; other rows are read whole.
    """
    if rank == 0 or max(nv, rows) > LARGEST:
        return ""
    last = nv - 1
    later: list[set[int]] = [set() for _ in range(nv)]  # columns of U in each of its rows
    for i, j in mass:
        if i != j:
            later[last - j].add(last - i)
    given = [sorted(columns) for columns in later]
    for columns in later:
        for i in columns:
            later[i] |= {j for j in columns if j > i}
    reach = [1 << k for k in range(nv)]  # the rows that elimination leads to from each
    for k in reversed(range(nv)):
        for i in later[k]:
            reach[k] |= reach[i]
    support = [0] * rows
    for row, i in jacobian:
        support[row] |= reach[last - i]
    starts, columns_of_rows = [0], []
    for columns in later:
        columns_of_rows += sorted(columns)
        starts.append(len(columns_of_rows))
    unrolled = nv <= LARGEST_UNROLLED
    entries = [(k, i) for k in range(nv) for i in (k, *given[k])]
    values = {
        "LOOPS": _UNROLLED_LOOPS if unrolled else _LOOPS,
        "CLEARED": _UNROLLED_CLEARED if unrolled else _CLEARED,
        "TIMES_Q": _UNROLLED_TIMES_Q if unrolled else _TIMES_Q,
        "N": nv,
        "ROWS": rows,
        "RANK": rank,
        "STARTS": ", ".join(map(str, starts)),
        "LATER": ", ".join(map(str, columns_of_rows or [0])),
        "REACH": ", ".join(f"{bits:#x}u" for bits in reach),
        "SUPPORT": ", ".join(f"{bits:#x}u" for bits in support),
        "SHORT": 0 if unrolled else 4,
        "MASS": "\n".join(
            f"  AT(U[{k}], {i}) = M[{(last - k) * nv + last - i}];" for k, i in entries
        ),
        "JACOBIAN": "\n".join(
            f"  AT(X[{last - i}], {row}) = G[{row * nv + i}];" for row, i in sorted(jacobian)
        ),
        "OTHERS": "\n".join(f"  take_row(w, G, {row});" for row in range(rows) if not support[row]),
    }
    if unrolled:
        vectors: list[list[str]] | None = None
        if rows <= TAKEN and all(support):
            vectors = [["0.0"] * TAKEN for _ in range(nv)]
            for row, i in jacobian:
                vectors[last - i][row] = f"G[{row * nv + i}]"
            values |= {"CLEARED": "", "JACOBIAN": ""}
        ordered = [sorted(columns) for columns in later]
        factor = _unrolled_factor(ordered, entries, rank, vectors)
    else:
        factor = _SPARSE
    text = _HEAD + factor + _SOLVES
    for name, value in values.items():
        text = text.replace(f"@{name}@", str(value))
    return text


def _unrolled_factor(
    later: Sequence[Sequence[int]],
    mass: Sequence[tuple[int, int]],
    rank: int,
    given: Sequence[Sequence[str]] | None,
) -> str:
    """The factorisation without a loop over coordinates.

    Parameters
    ----------
    later
        Columns of U in each of its rows, without the diagonal.
    mass
        Row and column of U of the entries of M.
    given
        Entries (nv, TAKEN) of G^T in the order of U, in C; None where X has them.
    """
    n = len(later)
    known = set(mass)
    out = [f"double u{k}_{i} = M[{(n - 1 - k) * n + n - 1 - i}];" for k, i in mass]
    out += [f"double f{k} = f[{n - 1 - k}];" for k in range(n)]
    out.append("/* M = L D L^T: its chain of operations has no roots. */")
    for k in range(n):
        if later[k]:
            out.append(f"const double d{k} = 1.0 / u{k}_{k};")
        for i in later[k]:
            out += [f"const double l{k}_{i} = d{k} * u{k}_{i};", f"f{i} -= l{k}_{i} * f{k};"]
            for j in later[k][later[k].index(i) :]:
                if (i, j) in known:
                    out.append(f"u{i}_{j} -= l{k}_{i} * u{k}_{j};")
                else:
                    known.add((i, j))
                    out.append(f"double u{i}_{j} = -(l{k}_{i} * u{k}_{j});")
    positive = " & ".join(f"(u{k}_{k} > 0.0)" for k in range(n))
    out.append(f"if (!({positive})) return 1;")
    for k in range(n):
        out.append(f"const double r{k} = sqrt(u{k}_{k}), b{k} = 1.0 / r{k}, w{k} = b{k} * f{k};")
        out += [f"w->inverse[{k}] = b{k};", f"white[{k}] = w{k};", f"AT(w->U[{k}], {k}) = r{k};"]
        out += [f"AT(w->U[{k}], {i}) = b{k} * u{k}_{i};" for i in later[k]]
    body = []
    for k in range(n):
        taken = "".join(f" - l{m}_{k} * y{m}" for m in range(k) if k in later[m])
        first = f"X[{k}][b]" if given is None else f"TAKE(b, {', '.join(given[k])})"
        body += [f"const vec y{k} = {first}{taken};", f"const vec x{k} = X[{k}][b] = b{k} * y{k};"]
    body.append("sums[b] = " + " + ".join(f"w{k} * x{k}" for k in range(n)) + ";")
    body.append("squares[b] = " + " + ".join(f"x{k} * x{k}" for k in range(n)) + ";")
    out += _each_vector(body)
    out.append(
        "const int finite = begin_columns(w, sums, squares, limits, bias, gamma, row_squares);"
    )
    out.append("EACH(b, WIDE) w->rows[b] = ~(flags){0};")
    for k in range(rank):
        out += ["{", *_reflection(k, n), "}"]
    out += [f"w->pivot_row[{k}] = {k};" for k in range(n)]
    return "\n".join(f"  {line}" for line in out) + "\n"


def _each_vector(body: Sequence[str]) -> list[str]:
    """Statements for each vector ``b`` of a row."""
    return [
        "#define BODY(b) { \\",
        *[f"  {line} \\" for line in body],
        "}",
        "EACH_VECTOR",
        "#undef BODY",
    ]


def _reflection(k: int, n: int) -> list[str]:
    """Step ``k`` of the factorisation of W."""
    rows = range(k, n)
    column = f"next_column(w, {k}, squares, limits, {(1 << n) - (1 << k):#x}u)"
    out = [f"const double *const own = (const double *)X + {column};"]
    out += [f"const double v{i} = own[{i} * WIDE * LANES];" for i in rows]
    halves = (" + ".join(f"v{i} * v{i}" for i in rows[part::2]) or "0.0" for part in range(2))
    out.append(f"const double norm2 = ({') + ('.join(halves)});")
    out += [
        "/* 1 / beta, without waiting for the root. */",
        f"const double alpha = v{k}, beta = -copysign(sqrt(norm2), alpha);",
        "const double by = beta * (1.0 / norm2);",
        "const double scale = norm2 > 0.0 ? 1.0 / (alpha - beta) : 0.0;",
        f"pivots[{k}] = fabs(beta);",
        f"w->inverse_pivot[{k}] = by;",
        f"w->tau[{k}] = norm2 > 0.0 ? (beta - alpha) * by : 0.0;",
        f"w->count[{k}] = N;",
        f"EACH(b, HIGH) V[{k}][b] = (vec){{0}};",
        f"AT(V[{k}], {k}) = 1.0;",
    ]
    out += [f"const double s{i} = AT(V[{k}], {i}) = scale * v{i};" for i in rows[1:]]
    sums = " + ".join(f"v{i} * X[{i}][b]" for i in rows)
    body = [
        f"const vec row = X[{k}][b], R = by * ({sums}), moved = row - R;",
        f"X[{k}][b] = R;",
        "squares[b] -= R * R;",
        *[f"X[{i}][b] -= s{i} * moved;" for i in rows[1:]],
    ]
    return [*out, "if (norm2 > 0.0) {", *_each_vector(body), "}"]


_HEAD = """
typedef __UINT64_TYPE__ uint64_t;

#define N @N@
#define ROWS @ROWS@
#define RANK @RANK@
#if defined(__AVX512F__) && ROWS > 4
#define LANES 8
#elif defined(__AVX__) && ROWS > 2
#define LANES 4
#else
#define LANES 2
#endif
typedef double vec __attribute__((vector_size(8 * LANES)));
typedef long long flags __attribute__((vector_size(8 * LANES)));
#define WIDE ((ROWS + LANES - 1) / LANES)
enum { HIGH = (N + LANES - 1) / LANES, SHORT = @SHORT@ };
#define EACH(b, count) _Pragma("GCC unroll 16") for (int b = 0; b < count; ++b)
#define UNROLL(i, first, count) _Pragma("GCC unroll 8") for (int i = first; i < count; ++i)
/* k = 0, 1, ... and backwards, and the columns of U in its row k, backwards: loops that vanish if
 * they are unrolled. */
#define ALWAYS_INLINE inline __attribute__((always_inline))
#define UP(k, count) _Pragma(UNROLLED) for (int k = 0; k < (count); ++k)
#define DOWN(k, count) _Pragma(UNROLLED) for (int k = (count) - 1; k >= 0; --k)
@LOOPS@
#define AT(x, i) (((double *)(x))[i])
#define AT_ROWS(w) ((long long *)(w)->rows)
/* A squared norm is computed again below this part of that which was computed last. */
#define RESOLVED 1e-6
/* The rows in a set of bits, one after the other. */
#define IN(i, bits) (uint64_t rest_ = (bits); rest_; rest_ &= rest_ - 1) \\
    for (int i = __builtin_ctzll(rest_), once_ = 1; once_; once_ = 0)

/* White coordinates, rows of U and of W, are counted from the last coordinate to the first. */
static const unsigned char later[] = {@LATER@};
static const unsigned short starts[] = {@STARTS@};
static const uint64_t reach[] = {@REACH@}, support[] = {@SUPPORT@};

/* A factorisation.  X: W, then the rows of R, each at pivot_row; columns of R as in W. */
typedef struct {
  vec X[N][WIDE], U[N][HIGH], V[RANK][HIGH];  /* V: reflections; up to SHORT entries without gaps */
  flags rows[WIDE];  /* of each column, those that may differ from zero */
  double inverse[N], tau[RANK], inverse_pivot[RANK];
  int order[ROWS], pivot_row[N];
  unsigned char count[RANK], entry[RANK][SHORT + 1];  /* of the entries without gaps: their rows */
} Factors;

const __SIZE_TYPE__ srm_mbs_factors_size = sizeof(Factors);

/* A row of G of which any entry may differ from zero. */
static inline void take_row(Factors *w, const double *G, int row) {
  uint64_t bits = 0;
  for (int i = 0; i < N; ++i) {
    const double value = G[row * N + i];
    AT(w->X[N - 1 - i], row) = value;
    if (value != 0.0) bits |= reach[N - 1 - i];
  }
  AT_ROWS(w)[row] = (long long)bits;
}

/* Computes the squared norm of a column in the rows that are left. */
static __attribute__((noinline, cold)) void square_again(const Factors *w, int column,
                                                         vec *squares, vec *limits,
                                                         uint64_t active) {
  double sum = 0.0;
  for IN(i, (uint64_t)AT_ROWS(w)[column] & active)
    sum += AT(w->X[i], column) * AT(w->X[i], column);
  AT(squares, column) = sum;
  AT(limits, column) = RESOLVED * sum;
}

/* The column of the largest norm in the rows that are left, which is the next in `order`. */
static ALWAYS_INLINE int next_column(Factors *w, int k, vec *squares, vec *limits,
                                     uint64_t active) {
  const double *const square = (const double *)squares, *const limit = (const double *)limits;
  double most = -1.0;
  int best = k;
  _Pragma(UNROLLED) for (int n = k; n < ROWS; ++n) {
    const int j = w->order[n];
    if (square[j] < limit[j]) square_again(w, j, squares, limits, active);
    if (square[j] > most) most = square[j], best = n;
  }
  const int column = w->order[best];
  w->order[best] = w->order[k];
  w->order[k] = column;
  return column;
}

/* gamma, the squares of W's columns, and where they are computed again; whether all are finite. */
static inline int begin_columns(Factors *w, const vec *sums, const vec *squares, vec *limits,
                                const double *bias, double *gamma, double *row_squares) {
  int finite = 1;
  EACH(b, WIDE) limits[b] = RESOLVED * squares[b];
  for (int j = 0; j < ROWS; ++j) {
    w->order[j] = j;
    gamma[j] = AT(sums, j) + bias[j];
    row_squares[j] = AT(squares, j);
    finite &= row_squares[j] < __builtin_inf();
  }
  return finite;
}

/* From M, f, bias and G (rows, N): U with M = U^T U, L^-1 f, gamma = G M^-1 f + bias, the squares
 * of W's columns, |R_kk|, and W Pi = Q R.  1 where M is not positive definite; the last pivot is
 * not a number where W is not finite. */
int srm_mbs_factor(void *work, const double *restrict M, const double *restrict f,
                   const double *restrict bias, const double *restrict G, double *restrict white,
                   double *restrict gamma, double *restrict pivots, double *restrict row_squares) {
  Factors *const restrict w = work;
  vec(*const X)[WIDE] = w->X, (*const V)[HIGH] = w->V;
  vec sums[WIDE], squares[WIDE], limits[WIDE];
  EACH(b, WIDE) sums[b] = squares[b] = (vec){0};
@CLEARED@
@JACOBIAN@
@OTHERS@
"""

_CLEARED = """\
  memset(X, 0, sizeof w->X);
  for (int j = 0; j < ROWS; ++j) AT_ROWS(w)[j] = (long long)support[j];"""

_UNROLLED_CLEARED = "  UNROLL(k, 0, N) EACH(b, WIDE) X[k][b] = (vec){0};"

_SPARSE = """\
  vec(*const U)[HIGH] = w->U;
  memset(U, 0, sizeof w->U);
@MASS@
  for (int i = 0; i < N; ++i) white[i] = f[N - 1 - i];
  for (int k = 0; k < N; ++k) {
    double *const own = (double *)U[k];
    const double pivot = own[k];
    if (!(pivot > 0.0)) return 1;
    const double diagonal = sqrt(pivot), by = 1.0 / diagonal;
    w->inverse[k] = by;
    const double force = white[k] *= by;
    vec x[WIDE];
    EACH(b, WIDE) {
      X[k][b] = x[b] = X[k][b] * by;
      sums[b] += force * x[b];
      squares[b] += x[b] * x[b];
    }
    const int end = starts[k + 1];
    if (starts[k] < end)
      for (int b = k / LANES; b < HIGH; ++b) U[k][b] *= by;
    own[k] = diagonal;
    for (int n = starts[k]; n < end; ++n) {
      const int i = later[n];
      const double u = own[i];
      white[i] -= u * force;
      EACH(b, WIDE) X[i][b] -= u * x[b];
      for (int b = i / LANES; b < HIGH; ++b) U[i][b] -= u * U[k][b];
    }
  }
  const int finite = begin_columns(w, sums, squares, limits, bias, gamma, row_squares);
  uint64_t active = ~(uint64_t)0 >> (64 - N);
  for (int k = 0; k < RANK; ++k) {
    const int column = next_column(w, k, squares, limits, active);
    const uint64_t own = (uint64_t)AT_ROWS(w)[column] & active;
    int row = __builtin_ctzll(own ? own : active);
    double alpha = 0.0, norm2 = 0.0;
    vec s[WIDE];
    EACH(b, WIDE) s[b] = (vec){0};
    for IN(i, own) {
      const double v = AT(X[i], column);
      norm2 += v * v;
      if (fabs(v) > fabs(alpha)) alpha = v, row = i;
      EACH(b, WIDE) s[b] += v * X[i][b];
    }
    const double beta = -copysign(sqrt(norm2), alpha), by = 1.0 / beta;
    pivots[k] = fabs(beta);
    w->inverse_pivot[k] = by;
    w->pivot_row[k] = row;
    w->count[k] = 0;
    active &= ~((uint64_t)1 << row);
    if (!(norm2 > 0.0)) continue;
    w->tau[k] = (beta - alpha) * by;
    /* R_kj = (W_k . W_j) / beta, and s = tau v . W_j = W_rj - R_kj, where that is more than
     * rounding. */
    EACH(b, WIDE) {
      const vec old = X[row][b], moved = old - by * s[b];
      const flags some = moved * moved > 1e-34 * squares[b];
      s[b] = (vec)((flags)moved & some);
      w->rows[b] |= some & (long long)own;
      const vec R = X[row][b] = old - s[b];
      squares[b] -= R * R;
    }
    const double scale = 1.0 / (alpha - beta);
    const int count = __builtin_popcountll(own);
    w->count[k] = (unsigned char)count;
    if (count > SHORT) memset(V[k], 0, sizeof V[k]);
    int n = 0;
    for IN(i, own) {
      const double v = i == row ? 1.0 : scale * AT(X[i], column);
      if (count > SHORT) AT(V[k], i) = v;
      else AT(V[k], n) = v, w->entry[k][n++] = (unsigned char)i;
      if (i != row) EACH(b, WIDE) X[i][b] -= v * s[b];
    }
  }
  int n = RANK;
  for IN(i, active) w->pivot_row[n++] = i;
"""

_LOOPS = """\
#define UNROLLED "GCC unroll 1"
#define LATER(i, k) \\
    for (int n_ = starts[k + 1], i; n_ > starts[k] && (i = later[n_ - 1], 1); --n_)"""

_UNROLLED_LOOPS = """\
#define UNROLLED "GCC unroll 8"
#define LATER(i, k) \\
    _Pragma("GCC unroll 8") for (int i = N - 1; i > k; --i) if (reach[k] >> i & 1)
#if WIDE == 1
#define EACH_VECTOR BODY(0)
#elif WIDE == 2
#define EACH_VECTOR BODY(0) BODY(1)
#elif WIDE == 3
#define EACH_VECTOR BODY(0) BODY(1) BODY(2)
#elif WIDE == 4
#define EACH_VECTOR BODY(0) BODY(1) BODY(2) BODY(3)
#else
#define EACH_VECTOR EACH(b, WIDE) BODY(b)
#endif
/* The vector b of a row of X, of which all entries are given. */
#define TAKE(b, ...) TAKE_##b(__VA_ARGS__)
#if LANES == 8
#define TAKE_0(...) (vec){__VA_ARGS__}
#elif LANES == 4
#define TAKE_0(p, q, r, s, ...) (vec){p, q, r, s}
#define TAKE_1(p, q, r, s, ...) (vec){__VA_ARGS__}
#else
#define TAKE_0(p, q, ...) (vec){p, q}
#define TAKE_1(p, q, r, s, ...) (vec){r, s}
#define TAKE_2(p, q, r, s, t, u, ...) (vec){t, u}
#define TAKE_3(p, q, r, s, t, u, v, w) (vec){v, w}
#endif"""

_UNROLLED_TIMES_Q = """\
/* x = Q x: reflection k leaves the numbers before the k-th, and its own entry there is 1.  Two at
 * a time, whose products with x do not wait for each other. */
static ALWAYS_INLINE void times_q(const Factors *w, double *restrict x) {
  DOWN(n, (RANK + 1) / 2) {
    const int k = 2 * n, next = 2 * n + 1;
    const double *const c = (const double *)w->V[k];
    double second[2] = {0.0, 0.0};
    if (next < RANK) {
      const double *const a = (const double *)w->V[next];
      double first[2] = {0.0, 0.0}, both[2] = {0.0, 0.0};
      UNROLL(i, next, N) {
        first[i & 1] += a[i] * x[i];
        second[i & 1] += c[i] * x[i];
        both[i & 1] += a[i] * c[i];
      }
      const double s = w->tau[next] * (first[0] + first[1]);
      const double t = w->tau[k] * ((x[k] + (second[0] + second[1])) - s * (both[0] + both[1]));
      x[k] -= t;
      UNROLL(i, next, N) x[i] -= s * a[i] + t * c[i];
    } else {
      UNROLL(i, k + 1, N) second[i & 1] += c[i] * x[i];
      const double t = w->tau[k] * (x[k] + (second[0] + second[1]));
      x[k] -= t;
      UNROLL(i, k + 1, N) x[i] -= t * c[i];
    }
  }
}

/* x = R^-T Pi^T g: what the last number changes comes last. */
static ALWAYS_INLINE void solve_pivots(const Factors *w, const double *g, double *restrict x) {
  UP(k, RANK) {
    const int column = w->order[k];
    double y = g[column];
    UNROLL(m, 0, k) y -= x[m] * AT(w->X[m], column);
    x[k] = y * w->inverse_pivot[k];
  }
}

/* white = Q R^-T Pi^T g, of full rank. */
static ALWAYS_INLINE void full_normal(const Factors *w, const double *restrict g,
                                      double *restrict white) {
  UNROLL(i, RANK, N) white[i] = 0.0;
  solve_pivots(w, g, white);
  times_q(w, white);
}"""

_TIMES_Q = """\
/* x = Q x, two reflections at a time, whose products with x do not wait for each other. */
static ALWAYS_INLINE void times_q(const Factors *w, double *restrict white) {
  vec *const x = (vec *)white;
  DOWN(n, RANK / 2) {
    const int k = (RANK & 1) + 2 * n + 2;
    const vec *const a = w->V[k - 1], *const c = w->V[k - 2];
    if (w->count[k - 1] <= SHORT || w->count[k - 2] <= SHORT) {
      reflect(w, k - 1, white);
      reflect(w, k - 2, white);
      continue;
    }
    vec first = {0}, second = {0}, both = {0};
    EACH(b, HIGH) {
      first += a[b] * x[b];
      second += c[b] * x[b];
      both += a[b] * c[b];
    }
    const double s = w->tau[k - 1] * total(first);
    const double t = w->tau[k - 2] * (total(second) - s * total(both));
    EACH(b, HIGH) x[b] -= s * a[b] + t * c[b];
  }
  if (RANK & 1) reflect(w, 0, white);
}

static ALWAYS_INLINE void solve_pivots(const Factors *w, const double *g, double *restrict x) {
  vec left[WIDE] = {{0}};
  memcpy(left, g, ROWS * sizeof *g);
  for (int k = 0; k < RANK; ++k) solve_pivot(w, k, left, x);
}

/* white = Q R^-T Pi^T g, of full rank. */
static ALWAYS_INLINE void full_normal(const Factors *w, const double *restrict g,
                                      double *restrict white) {
  vec x[HIGH] = {{0}};
  solve_pivots(w, g, (double *)x);
  times_q(w, (double *)x);
  memcpy(white, x, N * sizeof *white);
}"""

_SOLVES = """\
  if (!finite) pivots[RANK - 1] = __builtin_nan("");
  return 0;
}

/* Row of white coordinates that each pivot has; from the rank on, the others. */
const int *srm_mbs_pivot_rows(const void *work) { return ((const Factors *)work)->pivot_row; }

static inline double total(vec x) {
#if LANES > 2
  typedef double half __attribute__((vector_size(4 * LANES)));
  half low, high;
  memcpy(&low, &x, sizeof low);
  memcpy(&high, (const char *)&x + sizeof low, sizeof high);
  low += high;
#else
  const vec low = x;
#endif
#if LANES == 8
  return (low[0] + low[2]) + (low[1] + low[3]);
#else
  return low[0] + low[1];
#endif
}

static inline void reflect(const Factors *w, int k, double *restrict x) {
  const double *const V = (const double *)w->V[k];
  const int count = SHORT ? w->count[k] : N;
  if (count <= SHORT) {
    const unsigned char *const at = w->entry[k];
    double s = 0.0;
    for (int n = 0; n < count; ++n) s += V[n] * x[at[n]];
    s *= w->tau[k];
    for (int n = 0; n < count; ++n) x[at[n]] -= s * V[n];
    return;
  }
  vec sums[2] = {{0}};
  EACH(b, HIGH) sums[b & 1] += w->V[k][b] * ((vec *)x)[b];
  const double s = w->tau[k] * total(sums[0] + sums[1]);
  EACH(b, HIGH) ((vec *)x)[b] -= s * w->V[k][b];
}

static ALWAYS_INLINE void solve_pivot(const Factors *w, int k, vec *restrict left,
                                      double *restrict x) {
  const int row = w->pivot_row[k];
  const double y = x[row] = AT(left, w->order[k]) * w->inverse_pivot[k];
  EACH(b, WIDE) left[b] -= y * w->X[row][b];
}

@TIMES_Q@

/* x = Q x or, transposed, x = Q^T x, with the first `rank` reflections. */
void srm_mbs_times_q(const void *work, int rank, int transposed, double *restrict white) {
  const Factors *const w = work;
  vec x[HIGH] = {{0}};
  memcpy(x, white, N * sizeof *white);
  for (int k = 0; k < rank; ++k) reflect(w, transposed ? k : rank - 1 - k, (double *)x);
  memcpy(white, x, N * sizeof *white);
}

static __attribute__((noinline, cold)) void deficient_normal(const Factors *w, int rank,
                                                            const double *g, double *white) {
  vec left[WIDE] = {{0}}, x[HIGH] = {{0}};
  memcpy(left, g, ROWS * sizeof *g);
  for (int k = 0; k < rank; ++k) solve_pivot(w, k, left, (double *)x);
  for (int k = rank; k-- > 0;) reflect(w, k, (double *)x);
  memcpy(white, x, N * sizeof *white);
}

/* white = Q R^-T Pi^T g */
void srm_mbs_normal(const void *work, int rank, const double *restrict g, double *restrict white) {
  if (rank < RANK)
    deficient_normal(work, rank, g, white);
  else
    full_normal(work, g, white);
}

/* g = Pi R^-1 Q^T white */
void srm_mbs_multiplier(const void *work, int rank, const double *restrict white,
                        double *restrict g) {
  const Factors *const w = work;
  vec z[WIDE] = {{0}}, x[HIGH] = {{0}};
  memcpy(x, white, N * sizeof *white);
  for (int k = 0; k < rank; ++k) reflect(w, k, (double *)x);
  for (int k = rank; k-- > 0;) {
    const int row = w->pivot_row[k];
    vec sum = {0};
    EACH(b, WIDE) sum += w->X[row][b] * z[b];
    AT(z, w->order[k]) = (AT(x, row) - total(sum)) * w->inverse_pivot[k];
  }
  memcpy(g, z, ROWS * sizeof *g);
}

/* x = L^-1 x, from coordinates to white ones. */
void srm_mbs_whiten_force(const void *work, double *restrict x) {
  const Factors *const w = work;
  double t[N];
  for (int k = 0; k < N; ++k) t[k] = x[N - 1 - k];
  for (int k = 0; k < N; ++k) {
    const double *const u = (const double *)w->U[k];
    const double value = x[k] = t[k] * w->inverse[k];
    for (int n = starts[k]; n < starts[k + 1]; ++n) t[later[n]] -= u[later[n]] * value;
  }
}

/* x = L^T x, from coordinates to white ones. */
void srm_mbs_whiten_velocity(const void *work, double *restrict x) {
  const Factors *const w = work;
  double t[N];
  for (int k = 0; k < N; ++k) t[k] = x[N - 1 - k];
  for (int k = 0; k < N; ++k) {
    const double *const u = (const double *)w->U[k];
    double sum = u[k] * t[k];
    for (int n = starts[k]; n < starts[k + 1]; ++n) sum += u[later[n]] * t[later[n]];
    x[k] = sum;
  }
}

/* x = L^-T x, from white coordinates. */
void srm_mbs_unwhiten(const void *work, double *restrict x) {
  const Factors *const w = work;
  double t[N];
  DOWN(k, N) {
    const double *const u = (const double *)w->U[k];
    const double by = w->inverse[k];
    double sum = by * x[k];
    LATER(i, k) sum -= (by * u[i]) * t[i];  /* what was known last comes last */
    t[k] = sum;
  }
  for (int k = 0; k < N; ++k) x[N - 1 - k] = t[k];
}
"""
