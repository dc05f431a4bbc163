#include "across_columns.hpp"

#include <cmath>
#include <type_traits>

#include "processor.hpp"

namespace srm {

namespace {

template <int count>
using Vectors = std::integral_constant<int, count>;

// Columns [from, to) in blocks of four vectors, whose sums fit registers, then of two and of one.
template <class Act>
[[gnu::always_inline]] inline void in_blocks(int from, int to, const Act& act) {
    for (; from + 4 * lanes <= to; from += 4 * lanes) act(Vectors<4>(), from);
    if (from + 2 * lanes <= to) {
        act(Vectors<2>(), from);
        from += 2 * lanes;
    }
    if (from < to) act(Vectors<1>(), from);
}

// out -= c^T T over n rows of T.  Along the tree, many c are zero.
template <int count>
[[gnu::always_inline]] inline void subtract(Vectors<count>, const double* c, const double* T,
                                            std::ptrdiff_t stride, int n, double* out) {
    Lanes sums[count];
    for (int l = 0; l < count; ++l) sums[l] = at(out + lanes * l);
    for (int i = 0; i < n; ++i, T += stride)
        if (c[i] != 0.0)
            for (int l = 0; l < count; ++l) sums[l] -= c[i] * at(T + lanes * l);
    for (int l = 0; l < count; ++l) at(out + lanes * l) = sums[l];
}

template <int count>
[[gnu::always_inline]] inline void multiply(Vectors<count>, const double* W, std::ptrdiff_t stride,
                                            int n, const double* f, double* squares,
                                            double* products) {
    Lanes square[count] = {}, product[count] = {};
    for (int i = 0; i < n; ++i, W += stride)
        for (int l = 0; l < count; ++l) {
            const Lanes w = at(W + lanes * l);
            square[l] += w * w;
            product[l] += f[i] * w;
        }
    for (int l = 0; l < count; ++l) {
        at(squares + lanes * l) = square[l];
        at(products + lanes * l) = product[l];
    }
}

template <int count>
[[gnu::always_inline]] inline void reflect(Vectors<count>, double* W, std::ptrdiff_t stride, int n,
                                           double tau, const double* v) {
    Lanes s[count];
    for (int l = 0; l < count; ++l) s[l] = at(W + lanes * l);
    const double* row = W;
    for (int i = 1; i < n; ++i) {
        row += stride;
        if (v[i] != 0.0)
            for (int l = 0; l < count; ++l) s[l] += v[i] * at(row + lanes * l);
    }
    for (int l = 0; l < count; ++l) {
        s[l] *= tau;
        at(W + lanes * l) -= s[l];
    }
    for (int i = 1; i < n; ++i) {
        W += stride;
        if (v[i] != 0.0)
            for (int l = 0; l < count; ++l) at(W + lanes * l) -= v[i] * s[l];
    }
}

}  // namespace

SRM_FOR_PROCESSOR bool factorise_rows(double* T, int n, int width, double* inverse, double* c) {
    const std::ptrdiff_t stride = width;
    for (int k = n - 1, column = 0; k >= 0; --k, ++column) {
        double* const row = T + k * stride;
        for (int i = 0; i < column; ++i) c[i] = row[(i + 1) * stride + column];
        const int from = column / lanes * lanes;
        in_blocks(from, width, [&](auto count, int j) __attribute__((always_inline)) {
            subtract(count, c, row + stride + j, stride, column, row + j);
        });
        if (!(row[column] > 0.0)) return false;
        inverse[k] = 1.0 / std::sqrt(row[column]);
        for (int j = from; j < width; ++j) row[j] *= inverse[k];
    }
    return true;
}

SRM_FOR_PROCESSOR void multiply_columns(const double* W, std::ptrdiff_t stride, int n, int width,
                                        const double* f, double* squares, double* products) {
    in_blocks(0, width, [&](auto count, int j) __attribute__((always_inline)) {
        multiply(count, W + j, stride, n, f, squares + j, products + j);
    });
}

SRM_FOR_PROCESSOR void reflect_columns(double* W, std::ptrdiff_t stride, int n, int width,
                                       double tau, const double* v) {
    in_blocks(0, width, [&](auto count, int j) __attribute__((always_inline)) {
        reflect(count, W + j, stride, n, tau, v);
    });
}

}  // namespace srm
