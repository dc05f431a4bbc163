// Linear algebra on scattered numbers.
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

namespace srm {

inline double gathered(const double* values, const int* rows, int n, const double* x) {
    double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
    int i = 0;
    for (; i + 4 <= n; i += 4) {
        s0 += values[i] * x[rows[i]];
        s1 += values[i + 1] * x[rows[i + 1]];
        s2 += values[i + 2] * x[rows[i + 2]];
        s3 += values[i + 3] * x[rows[i + 3]];
    }
    for (; i < n; ++i) s0 += values[i] * x[rows[i]];
    return (s0 + s1) + (s2 + s3);
}

inline void scattered(double a, const double* values, const int* rows, int n, double* x) {
    for (int i = 0; i < n; ++i) x[rows[i]] += a * values[i];
}

// x = (1 - tau v v^T) x
inline void reflected(double tau, const double* v, const int* rows, int n, double* x) {
    scattered(-tau * gathered(v, rows, n, x), v, rows, n, x);
}

// Room for `more` numbers after the first `used`.
template <class Number>
Number* room(std::vector<Number>& numbers, int used, int more) {
    const std::size_t needed = static_cast<std::size_t>(used) + more;
    if (numbers.size() < needed) numbers.resize(std::max(needed, 2 * numbers.size()));
    return numbers.data() + used;
}

}  // namespace srm
