#include "projection.hpp"

#include <cmath>
#include <limits>
#include <utility>

#include "errors.hpp"
#include "linear.hpp"

namespace srm {

namespace {
constexpr double pivot_zero = 1e-13;
// LAPACK's xGEQP3 recomputes a column norm once its downdate has lost this much.
const double recompute = std::sqrt(0.5 * std::numeric_limits<double>::epsilon());
}  // namespace

Projection::Projection(int nv, int rows, int structural_rank, double sigma_ref)
    : nv(nv),
      rows(rows),
      structural_rank(structural_rank),
      sigma_ref(sigma_ref),
      white_force(nv),
      white_multiplier(nv),
      U_(nv * nv),
      A_(nv * rows),
      tau_(rows),
      norms_(rows),
      first_norms_(rows),
      gamma_(rows),
      work_(nv + rows),
      order_(rows) {
    held_.reserve(nv * nv);
}

void Projection::cholesky(const double* M) {
    for (int j = 0; j < nv; ++j) {
        double* column = &U_[j * nv];
        for (int i = 0; i < j; ++i)
            column[i] = (M[j * nv + i] - dot(&U_[i * nv], column, i)) / U_[i * nv + i];
        const double pivot = M[j * nv + j] - dot(column, column, j);
        if (!(pivot > 0.0)) throw EvaluationError{Failure::mass_matrix};
        column[j] = std::sqrt(pivot);
    }
}

void Projection::whiten(double* x) const {
    int first = 0;
    while (first < nv && x[first] == 0.0) ++first;
    for (int i = first; i < nv; ++i)
        x[i] = (x[i] - dot(&U_[i * nv + first], x + first, i - first)) / U_[i * nv + i];
}

void Projection::unwhiten(double* x) const {
    for (int i = nv - 1; i >= 0; --i) {
        x[i] /= U_[i * nv + i];
        add(-x[i], &U_[i * nv], x, i);
    }
}

void Projection::whiten_velocity(double* x) const {
    for (int i = 0; i < nv; ++i) {
        const double value = U_[i * nv + i] * x[i];
        add(x[i], &U_[i * nv], x, i);
        x[i] = value;
    }
}

// Householder QR with column pivoting, with the pivot rule of LAPACK's xGEQP3 so that both
// backends choose the same columns; it stops at the structural rank.
void Projection::pivoted_qr() {
    for (int j = 0; j < rows; ++j) {
        order_[j] = j;
        norms_[j] = first_norms_[j] = norm(&A_[j * nv], nv);
    }
    const int count = std::min(structural_rank, std::min(nv, rows));
    for (int k = 0; k < count; ++k) {
        int pivot = k;
        for (int j = k + 1; j < rows; ++j)
            if (norms_[j] > norms_[pivot]) pivot = j;
        if (pivot != k) {
            std::swap_ranges(&A_[k * nv], &A_[k * nv] + nv, &A_[pivot * nv]);
            std::swap(order_[k], order_[pivot]);
            norms_[pivot] = norms_[k];
            first_norms_[pivot] = first_norms_[k];
        }
        double* column = &A_[k * nv];
        const int below = nv - k - 1;
        const double tail = norm(column + k + 1, below);
        if (tail == 0.0) {
            tau_[k] = 0.0;
        } else {
            const double alpha = column[k];
            const double beta = -std::copysign(std::hypot(alpha, tail), alpha);
            tau_[k] = (beta - alpha) / beta;
            const double scale = 1.0 / (alpha - beta);
            for (int i = k + 1; i < nv; ++i) column[i] *= scale;
            column[k] = beta;
        }
        for (int j = k + 1; j < rows; ++j) {
            double* other = &A_[j * nv];
            if (tau_[k] != 0.0) {
                const double s = tau_[k] * (other[k] + dot(column + k + 1, other + k + 1, below));
                other[k] -= s;
                add(-s, column + k + 1, other + k + 1, below);
            }
            if (norms_[j] == 0.0) continue;
            const double part = std::abs(other[k]) / norms_[j];
            const double left = std::max(0.0, 1.0 - part * part);
            const double lost = norms_[j] / first_norms_[j];
            if (left * lost * lost <= recompute) {
                norms_[j] = first_norms_[j] = below > 0 ? norm(other + k + 1, below) : 0.0;
            } else {
                norms_[j] *= std::sqrt(left);
            }
        }
    }
}

void Projection::times_q_transposed(double* x) const {
    for (int k = 0; k < rank; ++k) {
        const double* column = &A_[k * nv];
        const int below = nv - k - 1;
        const double s = tau_[k] * (x[k] + dot(column + k + 1, x + k + 1, below));
        x[k] -= s;
        add(-s, column + k + 1, x + k + 1, below);
    }
}

void Projection::times_q(double* x) const {
    for (int k = rank - 1; k >= 0; --k) {
        const double* column = &A_[k * nv];
        const int below = nv - k - 1;
        const double s = tau_[k] * (x[k] + dot(column + k + 1, x + k + 1, below));
        x[k] -= s;
        add(-s, column + k + 1, x + k + 1, below);
    }
}

void Projection::normal(const double* g, double* white) const {
    std::fill(white, white + nv, 0.0);
    for (int i = 0; i < rank; ++i) {
        const double* column = &A_[i * nv];
        white[i] = (g[order_[i]] - dot(column, white, i)) / column[i];
    }
    times_q(white);
}

void Projection::white_project(const double* w, double* white) const {
    double* x = work_.data();
    std::copy(w, w + nv, x);
    whiten_velocity(x);
    std::copy(x, x + nv, white);
    times_q_transposed(white);
    std::fill(white + rank, white + nv, 0.0);
    times_q(white);
    if (!held) return;
    for (int k = 0; k < held_count_; ++k) {
        const double* h = &held_[k * nv];
        add(dot(h, x, nv), h, white, nv);
    }
}

void Projection::remove_normal(double* white) const {
    times_q_transposed(white);
    std::fill(white, white + rank, 0.0);
    times_q(white);
}

void Projection::normals(double* out) const {
    for (int k = 0; k < rank; ++k) {
        double* column = out + k * nv;
        std::fill(column, column + nv, 0.0);
        column[k] = 1.0;
        times_q(column);
        unwhiten(column);
    }
}

void Projection::factor(const double* M, const double* f, const double* bias, double threshold) {
    ++factorisations;
    cholesky(M);
    std::copy(f, f + nv, white_force.begin());
    whiten(white_force.data());
    for (int j = 0; j < rows; ++j) {
        whiten(&A_[j * nv]);
        gamma_[j] = dot(&A_[j * nv], white_force.data(), nv) + bias[j];
    }
    pivoted_qr();
    const int structural = structural_rank;
    sigma = std::abs(A_[(structural - 1) * nv + structural - 1]) / sigma_ref;
    if (!(sigma >= 0.0)) throw EvaluationError{Failure::closures};
    const double floor = threshold < 0.0 ? pivot_zero : std::max(pivot_zero, threshold * sigma_ref);
    rank = structural;
    while (rank > 0 && !(std::abs(A_[(rank - 1) * nv + rank - 1]) >= floor)) --rank;
    weak = rank < structural;
    held = false;
    normal(gamma_.data(), white_multiplier.data());
}

void Projection::hold(const double* normals, int count) {
    const int missing = std::min(structural_rank - rank, count);
    held_.resize(static_cast<std::size_t>(missing) * nv);
    held_count_ = 0;
    for (int k = 0; k < missing; ++k) {
        double* h = &held_[k * nv];
        const double* from = normals + (count - missing + k) * nv;
        std::copy(from, from + nv, h);
        whiten_velocity(h);
        for (int pass = 0; pass < 2; ++pass) {
            remove_normal(h);
            for (int j = 0; j < held_count_; ++j)
                add(-dot(&held_[j * nv], h, nv), &held_[j * nv], h, nv);
        }
        const double size = norm(h, nv);
        for (int i = 0; i < nv; ++i) h[i] /= size;
        ++held_count_;
    }
    held = true;
    double* gap = work_.data();
    for (int i = 0; i < nv; ++i) gap[i] = white_force[i] - white_multiplier[i];
    for (int k = 0; k < held_count_; ++k) {
        const double* h = &held_[k * nv];
        add(dot(h, gap, nv), h, white_multiplier.data(), nv);
    }
}

}  // namespace srm
