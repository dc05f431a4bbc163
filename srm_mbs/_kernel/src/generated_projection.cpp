#include "generated_projection.hpp"

#include <algorithm>

#include "errors.hpp"

namespace srm {

GeneratedProjection::GeneratedProjection(int nv, int rows, int structural_rank, double sigma_ref,
                                         const GeneratedAlgebra& algebra)
    : Projection(nv, rows, structural_rank, sigma_ref),
      G_(static_cast<std::size_t>(nv) * rows),
      rows_(rows) {
    for (int row = 0; row < rows; ++row) rows_[row] = filled(row);
    use(algebra);
}

void GeneratedProjection::use(const GeneratedAlgebra& algebra) {
    if (algebra.size != size_) factors_.reset(::operator new(algebra.size, alignment));
    size_ = algebra.size;
    algebra_ = &algebra;
}

double* const* GeneratedProjection::rows_for_code() {
    if (others_written_) std::fill(G_.begin(), G_.end(), 0.0);
    others_written_ = false;
    return rows_.data();
}

double* GeneratedProjection::column(int row) {
    others_written_ = true;
    std::fill_n(filled(row), nv, 0.0);
    return filled(row);
}

void GeneratedProjection::factorise(const double* M, const double* f, const double* bias, double) {
    if (algebra_->factor(factors_.get(), M, f, bias, G_.data(), white_force.data(), gamma_.data(),
                         pivots_.data(), row_squares_.data()) != 0)
        throw EvaluationError{Failure::mass_matrix};
}

void GeneratedProjection::normal(const double* g, double* white) const {
    algebra_->normal(factors_.get(), rank, g, white);
}

void GeneratedProjection::multiplier(const double* white, double* g) const {
    algebra_->multiplier(factors_.get(), rank, white, g);
}

void GeneratedProjection::remove_normal(double* white) const {
    algebra_->times_q(factors_.get(), rank, 1, white);
    for (int k = 0; k < rank; ++k) white[pivot_rows()[k]] = 0.0;
    algebra_->times_q(factors_.get(), rank, 0, white);
}

void GeneratedProjection::keep_normal(double* white) const {
    algebra_->times_q(factors_.get(), rank, 1, white);
    for (int k = rank; k < nv; ++k) white[pivot_rows()[k]] = 0.0;
    algebra_->times_q(factors_.get(), rank, 0, white);
}

void GeneratedProjection::column_of_q(int k, double* out) const {
    std::fill_n(out, nv, 0.0);
    out[pivot_rows()[k]] = 1.0;
    algebra_->times_q(factors_.get(), rank, 0, out);
}

void GeneratedProjection::normals(double* out) const {
    for (int k = 0; k < rank; ++k, out += nv) {
        column_of_q(k, out);
        unwhiten(out);
    }
}

void GeneratedProjection::complement(double* out) const {
    for (int k = rank; k < nv; ++k, out += nv) column_of_q(k, out);
}

}  // namespace srm
