#include "algebra.hpp"

#include <cmath>
#include <limits>
#include <random>

#include <Eigen/Dense>

#include "linear.hpp"

namespace srm {

namespace {

// Iterations from one look at the eigenvalues to the next, which costs more than an iteration.
constexpr int looked_at_each = 3;
// Length of the next vector, over the largest diagonal entry so far, from which there is none:
// rounding is all that is left of it.
constexpr double exhausted = 1e-12;
// Random part of a first vector that is about known: vectors that have come before it are in it.
constexpr double unknown = 1e-2;

}  // namespace

// Lanczos' iteration for the largest eigenvalue, the inverse square of the smallest singular value,
// of (W^T W)^-1, each vector orthogonalised twice against all.
double Algebra::weakest(std::vector<double>* start) {
    const int n = rows_;
    std::vector<std::vector<double>> basis;
    std::vector<double> diagonal, beside, next(n);
    std::mt19937 generator(0);
    std::normal_distribution<double> normal;
    Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen;
    for (double& x : next) x = normal(generator);
    if (start && !start->empty()) {
        const double part = unknown / norm(next.data(), n);
        for (int i = 0; i < n; ++i) next[i] = part * next[i] + (*start)[i];
    }
    double length = norm(next.data(), n), largest = 0.0, found = 0.0;
    for (int k = 0; k < n; ++k) {
        basis.emplace_back(next);
        for (double& x : basis.back()) x /= length;
        projection_->inverse_gram(basis.back().data(), next.data());
        diagonal.push_back(dot(basis.back().data(), next.data(), n));
        largest = std::max(largest, diagonal.back());
        for (int twice = 0; twice < 2; ++twice)
            for (const auto& other : basis)
                add(-dot(other.data(), next.data(), n), other.data(), next.data(), n);
        length = norm(next.data(), n);
        const bool last = k + 1 == n || !(length > exhausted * largest);
        if (last || (k + 1) % looked_at_each == 0) {
            const Eigen::Map<const Eigen::VectorXd> d(diagonal.data(), k + 1);
            const Eigen::Map<const Eigen::VectorXd> e(beside.data(), k);
            eigen.computeFromTridiagonal(d, e);
            found = eigen.eigenvalues()[k];
            const double residual = length * std::abs(eigen.eigenvectors()(k, k));
            // B. N. Parlett, The Symmetric Eigenvalue Problem, SIAM 1998, 11.7.
            const double gap = k > 0 ? found - eigen.eigenvalues()[k - 1] : 0.0;
            const double error = gap > residual ? residual * residual / gap : residual;
            if (last || !(error > std::numeric_limits<double>::epsilon() * found)) {
                if (!start) break;
                start->assign(n, 0.0);
                for (int i = 0; i <= k; ++i)
                    add(eigen.eigenvectors()(i, k), basis[i].data(), start->data(), n);
                break;
            }
        }
        beside.push_back(length);
    }
    return 1.0 / std::sqrt(found);
}

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
        .def("combinations", &Algebra::combinations)
        .def("complement", &Algebra::complement)
        .def("weakest", &Algebra::weakest_of, nb::arg("G"), nb::arg("threshold"))
        .def("smallest", &Algebra::smallest_of, nb::arg("G"))
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
