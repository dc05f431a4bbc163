// Cholesky factorisation, whitening and pivoted QR with loops across all columns.
//
// Arrays are row-major: neighbouring numbers of a vector belong to neighbouring columns, so that
// vectors are full however short columns are, and no sum runs across the numbers of one.  Loops
// take whole vectors: columns are padded to a multiple of `lanes`, and may start before the first
// one.  All functions are compiled for the processor (processor.hpp).
#pragma once

#include <cstddef>

namespace srm {

// Doubles of a vector of AVX2.
constexpr int lanes = 4;
typedef double Lanes __attribute__((vector_size(8 * lanes), aligned(8), may_alias));
inline Lanes& at(double* x) { return *reinterpret_cast<Lanes*>(x); }
inline const Lanes& at(const double* x) { return *reinterpret_cast<const Lanes*>(x); }
constexpr int padded(int count) { return (count + lanes - 1) / lanes * lanes; }

// Replaces the rows of T = [M | B] (n, width) by those of [L | L^-T B], M = L^T L, from the last to
// the first, and sets the inverses (n,) of L's diagonal; c is room for n numbers.  The columns of M
// and L stand in reverse.  False if M is not positive definite.
bool factorise_rows(double* T, int n, int width, double* inverse, double* c);

// Sets the squares (width,) of W's columns and the products (width,) of these with f (n,).
void multiply_columns(const double* W, std::ptrdiff_t stride, int n, int width, const double* f,
                      double* squares, double* products);

// Subtracts tau v v^T W from W (n, width), v = (1, v[1], ...).
void reflect_columns(double* W, std::ptrdiff_t stride, int n, int width, double tau,
                     const double* v);

}  // namespace srm
