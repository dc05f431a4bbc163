// Dense linear algebra on small column-major arrays.
//
// Mechanisms have a few to a few dozen coordinates, for which a call of a library costs more than
// a loop over plain arrays.  Matrices are column-major, as in LAPACK.
#pragma once

#include <algorithm>
#include <cmath>

namespace srm {

// Four partial sums, so that the compiler may use vector registers.
inline double dot(const double* a, const double* b, int n) {
    double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
    int i = 0;
    for (; i + 4 <= n; i += 4) {
        s0 += a[i] * b[i];
        s1 += a[i + 1] * b[i + 1];
        s2 += a[i + 2] * b[i + 2];
        s3 += a[i + 3] * b[i + 3];
    }
    for (; i < n; ++i) s0 += a[i] * b[i];
    return (s0 + s1) + (s2 + s3);
}

// y += a x
inline void add(double a, const double* x, double* y, int n) {
    for (int i = 0; i < n; ++i) y[i] += a * x[i];
}

// out = h sum_k a_k rows_k over the first `count` rows (n,).  Four components at a time stay in
// registers over all rows; each is summed in the order of k.
inline void combine(double h, const double* a, int count, const double* rows, int n, double* out) {
    int i = 0;
    for (; i + 4 <= n; i += 4) {
        double s[4] = {0.0, 0.0, 0.0, 0.0};
        for (int k = 0; k < count; ++k) {
            if (a[k] == 0.0) continue;
            const double by = h * a[k], *row = rows + k * n + i;
            for (int j = 0; j < 4; ++j) s[j] += by * row[j];
        }
        std::copy_n(s, 4, out + i);
    }
    for (; i < n; ++i) {
        double s = 0.0;
        for (int k = 0; k < count; ++k)
            if (a[k] != 0.0) s += h * a[k] * rows[k * n + i];
        out[i] = s;
    }
}

inline double norm(const double* a, int n) {
    return std::sqrt(dot(a, a, n));
}

inline double largest(const double* a, int n) {
    double out = 0.0;
    for (int i = 0; i < n; ++i) out = std::max(out, std::abs(a[i]));
    return out;
}

inline bool finite(const double* a, int n) {
    for (int i = 0; i < n; ++i)
        if (!std::isfinite(a[i])) return false;
    return true;
}

inline void cross(const double* a, const double* b, double* out) {
    const double x = a[1] * b[2] - a[2] * b[1];
    const double y = a[2] * b[0] - a[0] * b[2];
    const double z = a[0] * b[1] - a[1] * b[0];
    out[0] = x;
    out[1] = y;
    out[2] = z;
}

// A = P L U in place; pivots (n,) has the row that each was exchanged with.  False if A is singular
// or not finite.
inline bool lu_factor(double* A, int n, int* pivots) {
    for (int k = 0; k < n; ++k) {
        double* const column = A + k * n;
        int pivot = k;
        for (int i = k + 1; i < n; ++i)
            if (std::abs(column[i]) > std::abs(column[pivot])) pivot = i;
        pivots[k] = pivot;
        if (!(std::abs(column[pivot]) > 0.0) || !std::isfinite(column[pivot])) return false;
        if (pivot != k)
            for (int j = 0; j < n; ++j) std::swap(A[j * n + k], A[j * n + pivot]);
        const double inverse = 1.0 / column[k];
        for (int i = k + 1; i < n; ++i) column[i] *= inverse;
        for (int j = k + 1; j < n; ++j) {
            double* const other = A + j * n;
            if (other[k] != 0.0) add(-other[k], column + k + 1, other + k + 1, n - k - 1);
        }
    }
    return true;
}

// x = A^-1 x, from the factors of A.
inline void lu_solve(const double* A, int n, const int* pivots, double* x) {
    for (int k = 0; k < n; ++k)
        if (pivots[k] != k) std::swap(x[k], x[pivots[k]]);
    for (int k = 0; k < n; ++k) add(-x[k], A + k * n + k + 1, x + k + 1, n - k - 1);
    for (int k = n - 1; k >= 0; --k) {
        x[k] /= A[k * n + k];
        add(-x[k], A + k * n, x, k);
    }
}

}  // namespace srm
