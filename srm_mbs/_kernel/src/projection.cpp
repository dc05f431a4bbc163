#include "projection.hpp"

#include <stdexcept>

#include "dense_projection.hpp"
#include "errors.hpp"
#include "linear.hpp"
#include "sparse_projection.hpp"
#include "swept_projection.hpp"

namespace srm {

namespace {
constexpr double pivot_zero = 1e-13;
}  // namespace

Projection::Projection(int nv, int rows, int structural_rank, double sigma_ref)
    : nv(nv),
      rows(rows),
      structural_rank(structural_rank),
      sigma_ref(sigma_ref),
      white_force(nv),
      white_multiplier(nv),
      gamma_(rows),
      pivots_(structural_rank),
      row_squares_(rows),
      work_(nv) {
    held_.reserve(nv);
}

void Projection::factor(const double* M, const double* f, const double* bias, double threshold) {
    ++factorisations;
    const double floor = threshold < 0.0 ? pivot_zero : std::max(pivot_zero, threshold * sigma_ref);
    factorise(M, f, bias, floor);
    sigma = smallest_pivot() / sigma_ref;
    if (!(sigma >= 0.0)) throw EvaluationError{Failure::closures};
    rank = structural_rank;
    while (rank > 0 && !(pivots_[rank - 1] >= floor)) --rank;
    rank_deficient = rank < structural_rank;
    held = false;
    normal(gamma_.data(), white_multiplier.data());
}

void Projection::white_project(const double* w, double* white) const {
    double* x = work_.data();
    std::copy(w, w + nv, x);
    whiten_velocity(x);
    std::copy(x, x + nv, white);
    keep_normal(white);
    if (!held) return;
    for (int k = 0; k < held_count_; ++k) {
        const double* h = &held_[static_cast<std::size_t>(k) * nv];
        add(dot(h, x, nv), h, white, nv);
    }
}

void Projection::inverse_gram(const double* g, double* out) const {
    normal(g, work_.data());
    multiplier(work_.data(), out);
}

void Projection::hold(const double* normals, int count) {
    const int missing = std::min(structural_rank - rank, count);
    held_.resize(static_cast<std::size_t>(missing) * nv);
    held_count_ = 0;
    for (int k = 0; k < missing; ++k) {
        double* h = &held_[static_cast<std::size_t>(k) * nv];
        const double* from = normals + static_cast<std::size_t>(count - missing + k) * nv;
        std::copy(from, from + nv, h);
        whiten_velocity(h);
        for (int pass = 0; pass < 2; ++pass) {
            remove_normal(h);
            for (int j = 0; j < held_count_; ++j) {
                const double* other = &held_[static_cast<std::size_t>(j) * nv];
                add(-dot(other, h, nv), other, h, nv);
            }
        }
        const double size = norm(h, nv);
        for (int i = 0; i < nv; ++i) h[i] /= size;
        ++held_count_;
    }
    held = true;
    double* difference = work_.data();
    for (int i = 0; i < nv; ++i) difference[i] = white_force[i] - white_multiplier[i];
    for (int k = 0; k < held_count_; ++k) {
        const double* h = &held_[static_cast<std::size_t>(k) * nv];
        add(dot(h, difference, nv), h, white_multiplier.data(), nv);
    }
}

std::unique_ptr<Projection> make_projection(int structural_rank, double sigma_ref,
                                            const Pattern& pattern, const std::string& choice) {
    const int nv = static_cast<int>(pattern.parents.size());
    const int rows = static_cast<int>(pattern.supports.size());
    if (choice != "auto" && choice != "dense" && choice != "sparse")
        throw std::invalid_argument("algebra must be auto, dense or sparse, not " + choice);
    if (!pattern.order.empty() && choice != "dense")
        return std::make_unique<SweptProjection>(structural_rank, sigma_ref, pattern);
    if (choice == "sparse" || (choice == "auto" && sparse_pays(pattern)))
        return std::make_unique<SparseProjection>(structural_rank, sigma_ref, pattern);
    return make_dense_projection(nv, rows, structural_rank, sigma_ref);
}

}  // namespace srm
