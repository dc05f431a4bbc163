#include "algebra.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <random>
#include <utility>
#include <vector>

#include <Eigen/Dense>

#include "linear.hpp"
#include "projection.hpp"
#include "struct_binding.hpp"

namespace srm {

namespace {

using Columns = nb::ndarray<const double, nb::f_contig, nb::device::cpu>;

// See dynamics/constraints/row_algebra.py.
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

    void factor_with(const Columns& M, const Array& G, double threshold) {
        if (M.ndim() != 2 || static_cast<int>(M.shape(0)) != nv_ ||
            static_cast<int>(M.shape(1)) != nv_)
            throw nb::value_error("M is not (nv, nv)");
        factor(M.data(), G, threshold);
    }

    nb::object tangential(const Array& w) const {
        std::vector<double> x = checked(w, nv_);
        projection_->whiten_velocity(x.data());
        projection_->remove_normal(x.data());
        projection_->unwhiten(x.data());
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

    // The basis, one vector per row.
    nb::object complement() const {
        const auto count = static_cast<std::size_t>(nv_ - projection_->rank);
        const auto n = static_cast<std::size_t>(nv_);
        std::vector<double> out(count * n);
        projection_->complement(out.data());
        return owned_array(std::move(out), {count, n});
    }

    // Rank of G, and its smallest singular value if the rows are independent, with M = 1 (else 0).
    nb::tuple weakest_of(const Array& G, double threshold) {
        if (one_.empty()) {
            one_.assign(static_cast<std::size_t>(nv_) * nv_, 0.0);
            for (int i = 0; i < nv_; ++i) one_[static_cast<std::size_t>(i) * (nv_ + 1)] = 1.0;
        }
        factor(one_.data(), G, threshold);
        const int rank = projection_->rank;
        return nb::make_tuple(rank, rank == rows_ && rank > 0 ? weakest() : 0.0);
    }

    const Projection& projection() const { return *projection_; }

private:
    void factor(const double* M, const Array& G, double threshold) {
        if (G.ndim() != 2 || static_cast<int>(G.shape(0)) != rows_ ||
            static_cast<int>(G.shape(1)) != nv_)
            throw nb::value_error("G is not (rows, nv)");
        for (int j = 0; j < rows_; ++j) {
            double* const out = projection_->column(j);
            const double* const row = G.data() + static_cast<std::size_t>(j) * nv_;
            for (int k : pattern_.supports[j]) out[k] = row[k];
        }
        projection_->factor(M, zeros_.data(), zeros_.data(), threshold);
    }

    // The smallest singular value of the rows in use: Lanczos' iteration for the largest
    // eigenvalue, its inverse square, of G^+ G^+T, each vector orthogonalised twice against all.
    double weakest() {
        const int largest_count = std::min(nv_, projection_->rank);
        std::vector<std::vector<double>> basis;
        std::vector<double> diagonal, beside, next(nv_), g(rows_);
        std::mt19937 generator(0);
        std::normal_distribution<double> normal;
        for (double& x : next) x = normal(generator);
        // The part of the start in the null space of the rows would be lost to rounding.
        projection_->multiplier(next.data(), g.data());
        projection_->normal(g.data(), next.data());
        double length = norm(next.data(), nv_), found = 0.0;
        for (int k = 0; k < largest_count; ++k) {
            basis.emplace_back(next);
            for (double& x : basis.back()) x /= length;
            projection_->multiplier(basis.back().data(), g.data());
            projection_->normal(g.data(), next.data());
            diagonal.push_back(dot(basis.back().data(), next.data(), nv_));
            for (int twice = 0; twice < 2; ++twice)
                for (const auto& other : basis)
                    add(-dot(other.data(), next.data(), nv_), other.data(), next.data(), nv_);
            length = norm(next.data(), nv_);
            const Eigen::Map<const Eigen::VectorXd> d(diagonal.data(), k + 1);
            const Eigen::Map<const Eigen::VectorXd> e(beside.data(), k);
            solver_.computeFromTridiagonal(d, e);
            found = solver_.eigenvalues()[k];
            const double residual = length * std::abs(solver_.eigenvectors()(k, k));
            if (!(residual > std::numeric_limits<double>::epsilon() * found)) break;
            beside.push_back(length);
        }
        return 1.0 / std::sqrt(found);
    }

    static std::vector<double> checked(const Array& values, int size) {
        if (values.ndim() != 1 || static_cast<int>(values.size()) != size)
            throw nb::value_error("not a vector of the right size");
        return std::vector<double>(values.data(), values.data() + size);
    }

    Pattern pattern_;
    int nv_, rows_;
    std::unique_ptr<Projection> projection_;
    std::vector<double> zeros_, one_;
    Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> solver_;
};

}  // namespace

void bind_algebra(nb::module_& m) {
    nb::class_<Algebra>(m, "Algebra")
        .def(nb::init<std::vector<int>, std::vector<std::vector<int>>, std::vector<int>, double,
                      int, const std::string&>(),
             nb::arg("parents"), nb::arg("supports"), nb::arg("order"), nb::arg("pivot_share"),
             nb::arg("pivot_window"), nb::arg("algebra"))
        .def("factor", &Algebra::factor_with, nb::arg("M"), nb::arg("G"), nb::arg("threshold"))
        .def("tangential", &Algebra::tangential)
        .def("solve", &Algebra::solve)
        .def("multiplier", &Algebra::multiplier)
        .def("complement", &Algebra::complement)
        .def("weakest", &Algebra::weakest_of, nb::arg("G"), nb::arg("threshold"))
        .def_prop_ro("rank", [](const Algebra& a) { return a.projection().rank; })
        .def_prop_ro("sparse", [](const Algebra& a) { return a.projection().sparse(); })
        .def_prop_ro("entries", [](const Algebra& a) { return a.projection().entries(); })
        .def_prop_ro("pivots", [](const Algebra& a) {
            return owned_array(a.projection().pivots());
        })
        .def_prop_ro("row_squares", [](const Algebra& a) {
            return owned_array(a.projection().row_squares());
        });
}

}  // namespace srm
