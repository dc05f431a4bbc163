// Column-pivoted QR of L^-1 G^T for Python: dynamics/constraints/row_algebra.py.
#pragma once

#include <algorithm>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "projection.hpp"
#include "struct_binding.hpp"

namespace srm {

class Algebra {
public:
    Algebra(std::vector<int> parents, std::vector<std::vector<int>> supports,
            std::vector<int> order, double pivot_share, int pivot_window,
            const std::string& choice)
        : pattern_{std::move(parents), std::move(supports), std::move(order), pivot_window,
                   pivot_share},
          nv_(static_cast<int>(pattern_.parents.size())),
          rows_(static_cast<int>(pattern_.supports.size())),
          projection_(make_projection(std::min(nv_, rows_), 1.0, pattern_, choice)),
          zeros_(std::max(nv_, rows_)) {}

    void factor_with(const nb::ndarray<const double, nb::f_contig, nb::device::cpu>& M, const Array& G, double threshold) {
        if (M.ndim() != 2 || static_cast<int>(M.shape(0)) != nv_ ||
            static_cast<int>(M.shape(1)) != nv_)
            throw nb::value_error("M is not (nv, nv)");
        factor(M.data(), G, threshold);
    }

    nb::object tangential(const Array& w) const {
        std::vector<double> x = checked(w, nv_);
        make_tangential(x.data());
        return owned_array(std::move(x));
    }

    nb::object solve(const Array& g) const {
        const std::vector<double> right = checked(g, rows_);
        std::vector<double> x(nv_);
        projection_->normal(right.data(), x.data());
        projection_->unwhiten(x.data());
        return owned_array(std::move(x));
    }

    nb::object multiplier(const Array& white) const {
        const std::vector<double> x = checked(white, nv_);
        std::vector<double> g(rows_);
        projection_->multiplier(x.data(), g.data());
        return owned_array(std::move(g));
    }

    // multiplier() of each row of x (k, nv).
    nb::object combinations(const Array& x) const {
        if (x.ndim() != 2 || static_cast<int>(x.shape(1)) != nv_)
            throw nb::value_error("not rows of nv numbers");
        const std::size_t count = x.shape(0), rows = rows_;
        std::vector<double> out(count * rows);
        for (std::size_t i = 0; i < count; ++i)
            projection_->multiplier(x.data() + i * nv_, &out[i * rows]);
        return owned_array(std::move(out), {count, rows});
    }

    // The basis, one vector per row.
    nb::object complement() const {
        const auto count = static_cast<std::size_t>(nv_ - projection_->rank);
        const auto n = static_cast<std::size_t>(nv_);
        std::vector<double> out(count * n);
        projection_->complement(out.data());
        return owned_array(std::move(out), {count, n});
    }

    // Rank of G, and its smallest singular value if the rows are independent (else 0).
    nb::tuple weakest_of(const Array& G, double threshold) {
        take(G);
        factor_columns(threshold);
        const int rank = projection_->rank;
        return nb::make_tuple(rank, rank == rows_ && rank > 0 ? weakest() : 0.0);
    }

    // The same without a threshold, 0 if a pivot is zero.
    double smallest_of(const Array& G) {
        take(G);
        return smallest_of_rows();
    }

    // Row j of G (nv,), cleared; then the smallest singular value of all rows, however small their
    // pivots are, 0 if one of them is zero.  start: as of weakest().
    double* row(int j) { return projection_->column(j); }
    double smallest_of_rows(std::vector<double>* start = nullptr) {
        factor_columns(-1.0);
        const auto& pivots = projection_->pivots();
        if (std::any_of(pivots.begin(), pivots.end(), [](double p) { return !(p > 0.0); }))
            return 0.0;
        projection_->rank = rows_;
        return weakest(start);
    }

    // Factorises the rows that were written, and solves for the shortest x (nv,) with G x = g.
    void factor_written(double threshold) { factor_columns(threshold); }
    // The same in the metric M (nv, nv), of which the upper triangle is read.
    void factor_in_metric(const double* M, double threshold) {
        projection_->factor(M, zeros_.data(), zeros_.data(), threshold);
    }
    // x = (1 - P) x (nv,), in place.
    void make_tangential(double* x) const {
        projection_->whiten_velocity(x);
        projection_->remove_normal(x);
        projection_->unwhiten(x);
    }
    void shortest(const double* g, double* x) const {
        projection_->normal(g, x);
        projection_->unwhiten(x);
    }
    const std::vector<int>& support(int row) const { return pattern_.supports[row]; }

    int columns() const { return nv_; }
    int rows() const { return rows_; }
    const Projection& projection() const { return *projection_; }

private:
    void factor(const double* M, const Array& G, double threshold) {
        take(G);
        factor_in_metric(M, threshold);
    }

    // With M = 1.
    void factor_columns(double threshold) {
        if (one_.empty()) {
            one_.assign(static_cast<std::size_t>(nv_) * nv_, 0.0);
            for (int i = 0; i < nv_; ++i) one_[static_cast<std::size_t>(i) * (nv_ + 1)] = 1.0;
        }
        factor_in_metric(one_.data(), threshold);
    }

    void take(const Array& G) {
        if (G.ndim() != 2 || static_cast<int>(G.shape(0)) != rows_ ||
            static_cast<int>(G.shape(1)) != nv_)
            throw nb::value_error("G is not (rows, nv)");
        for (int j = 0; j < rows_; ++j) {
            double* const out = row(j);
            const double* const from = G.data() + static_cast<std::size_t>(j) * nv_;
            for (int k : pattern_.supports[j]) out[k] = from[k];
        }
    }

    // start (rows,): about the left singular vector, empty if it is not known, and then that found.
    double weakest(std::vector<double>* start = nullptr);

    static std::vector<double> checked(const Array& values, int size) {
        if (values.ndim() != 1 || static_cast<int>(values.size()) != size)
            throw nb::value_error("not a vector of the right size");
        return std::vector<double>(values.data(), values.data() + size);
    }

    Pattern pattern_;
    int nv_, rows_;
    std::unique_ptr<Projection> projection_;
    std::vector<double> zeros_, one_;
};

void bind_algebra(nb::module_& m);

}  // namespace srm
