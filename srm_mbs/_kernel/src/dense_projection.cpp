#include "dense_projection.hpp"

#include <cmath>
#include <utility>

#include "errors.hpp"
#include "linear.hpp"

namespace srm {

DenseProjection::DenseProjection(int nv, int rows, int structural_rank, double sigma_ref)
    : Projection(nv, rows, structural_rank, sigma_ref),
      U_(nv * nv),
      A_(nv * rows),
      tau_(rows),
      norms_(rows),
      first_norms_(rows),
      order_(rows) {}

double* DenseProjection::column(int row) {
    double* out = &A_[row * nv];
    std::fill(out, out + nv, 0.0);
    return out;
}

void DenseProjection::cholesky(const double* M) {
    for (int j = 0; j < nv; ++j) {
        double* column = &U_[j * nv];
        for (int i = 0; i < j; ++i)
            column[i] = (M[j * nv + i] - dot(&U_[i * nv], column, i)) / U_[i * nv + i];
        const double pivot = M[j * nv + j] - dot(column, column, j);
        if (!(pivot > 0.0)) throw EvaluationError{Failure::mass_matrix};
        column[j] = std::sqrt(pivot);
    }
}

void DenseProjection::whiten(double* x) const {
    int first = 0;
    while (first < nv && x[first] == 0.0) ++first;
    for (int i = first; i < nv; ++i)
        x[i] = (x[i] - dot(&U_[i * nv + first], x + first, i - first)) / U_[i * nv + i];
}

void DenseProjection::unwhiten(double* x) const {
    for (int i = nv - 1; i >= 0; --i) {
        x[i] /= U_[i * nv + i];
        add(-x[i], &U_[i * nv], x, i);
    }
}

void DenseProjection::whiten_velocity(double* x) const {
    for (int i = 0; i < nv; ++i) {
        const double value = U_[i * nv + i] * x[i];
        add(x[i], &U_[i * nv], x, i);
        x[i] = value;
    }
}

// Householder QR with column pivoting, with the pivot rule of LAPACK's xGEQP3 so that both
// backends choose the same columns; it stops at the structural rank.
void DenseProjection::pivoted_qr() {
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
            if (left * lost * lost <= norm_lost) {
                norms_[j] = first_norms_[j] = below > 0 ? norm(other + k + 1, below) : 0.0;
            } else {
                norms_[j] *= std::sqrt(left);
            }
        }
    }
}

void DenseProjection::times_q_transposed(double* x) const {
    for (int k = 0; k < rank; ++k) {
        const double* column = &A_[k * nv];
        const int below = nv - k - 1;
        const double s = tau_[k] * (x[k] + dot(column + k + 1, x + k + 1, below));
        x[k] -= s;
        add(-s, column + k + 1, x + k + 1, below);
    }
}

void DenseProjection::times_q(double* x) const {
    for (int k = rank - 1; k >= 0; --k) {
        const double* column = &A_[k * nv];
        const int below = nv - k - 1;
        const double s = tau_[k] * (x[k] + dot(column + k + 1, x + k + 1, below));
        x[k] -= s;
        add(-s, column + k + 1, x + k + 1, below);
    }
}

void DenseProjection::normal(const double* g, double* white) const {
    std::fill(white, white + nv, 0.0);
    for (int i = 0; i < rank; ++i) {
        const double* column = &A_[i * nv];
        white[i] = (g[order_[i]] - dot(column, white, i)) / column[i];
    }
    times_q(white);
}

void DenseProjection::keep_normal(double* white) const {
    times_q_transposed(white);
    std::fill(white + rank, white + nv, 0.0);
    times_q(white);
}

void DenseProjection::remove_normal(double* white) const {
    times_q_transposed(white);
    std::fill(white, white + rank, 0.0);
    times_q(white);
}

void DenseProjection::normals(double* out) const {
    for (int k = 0; k < rank; ++k) {
        double* column = out + k * nv;
        std::fill(column, column + nv, 0.0);
        column[k] = 1.0;
        times_q(column);
        unwhiten(column);
    }
}

void DenseProjection::factorise(const double* M, const double* f, const double* bias) {
    cholesky(M);
    std::copy(f, f + nv, white_force.begin());
    whiten(white_force.data());
    for (int j = 0; j < rows; ++j) {
        whiten(&A_[j * nv]);
        gamma_[j] = dot(&A_[j * nv], white_force.data(), nv) + bias[j];
    }
    pivoted_qr();
    for (int k = 0; k < structural_rank; ++k) pivots_[k] = std::abs(A_[k * nv + k]);
}

}  // namespace srm
