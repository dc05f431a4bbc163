#include "dense_projection.hpp"

#include <cmath>
#include <utility>

#include "across_columns.hpp"
#include "errors.hpp"
#include "linear.hpp"

namespace srm {

namespace {

// Largest nv that is a template argument.
constexpr int largest_unrolled = 8;

// size = nv, or 0: nv is known at run time only.
template <int size>
class DenseProjection final : public Projection {
public:
    DenseProjection(int nv, int rows, int structural_rank, double sigma_ref)
        : Projection(nv, rows, structural_rank, sigma_ref),
          U_(nv * nv),
          inverse_(nv),
          row_(nv),
          A_(nv * rows),
          tau_(rows),
          inverse_pivots_(rows),
          squares_(padded(rows)),
          order_(rows) {
        if (size) return;
        T_.resize(static_cast<std::size_t>(nv) * (padded(nv + 1) + padded(rows)));
        products_.resize(padded(rows));
        first_squares_.resize(rows);
    }

    double* column(int row) override {
        const int n = count();
        double* out = &A_[row * n];
        std::fill(out, out + n, 0.0);
        return out;
    }

    double* filled(int row) override { return &A_[row * count()]; }

    void normal(const double* g, double* white) const override {
        const int n = count();
        std::fill(white, white + n, 0.0);
        for (int i = 0; i < rank; ++i) {
            const double* column = &A_[i * n];
            white[i] = (g[order_[i]] - dot(column, white, i)) * inverse_pivots_[i];
        }
        times_q(white);
    }

    void multiplier(const double* white, double* g) const override {
        const int n = count();
        std::vector<double> x(white, white + n);
        times_q_transposed(x.data());
        std::fill(g, g + rows, 0.0);
        for (int i = rank - 1; i >= 0; --i) {
            const double z = g[order_[i]] = x[i] * inverse_pivots_[i];
            add(-z, &A_[i * n], x.data(), i);
        }
    }

    void remove_normal(double* white) const override {
        times_q_transposed(white);
        std::fill(white, white + rank, 0.0);
        times_q(white);
    }

    void whiten_force(double* x) const override { size ? dots(x) : sums(x); }
    void unwhiten(double* x) const override { size ? sums(x) : dots(x); }

    void whiten_velocity(double* x) const override {
        const int n = count();
        if (size == 0) {
            for (int i = n - 1; i >= 0; --i)
                x[i] = U_[i * n + i] * x[i] + dot(&U_[i * n], x, i);
            return;
        }
        for (int i = 0; i < n; ++i) {
            const double value = U_[i * n + i] * x[i];
            add(x[i], &U_[i * n], x, i);
            x[i] = value;
        }
    }

    void normals(double* out) const override {
        const int n = count();
        for (int k = 0; k < rank; ++k) {
            double* column = out + k * n;
            std::fill(column, column + n, 0.0);
            column[k] = 1.0;
            times_q(column);
            unwhiten(column);
        }
    }

    void complement(double* out) const override {
        const int n = count();
        for (int k = rank; k < n; ++k) {
            double* column = out + (k - rank) * n;
            std::fill(column, column + n, 0.0);
            column[k] = 1.0;
            times_q(column);
        }
    }

    bool sparse() const override { return false; }
    std::size_t entries() const override { return A_.size(); }

private:
    int count() const { return size ? size : nv; }

    // x = U^-T x and x = U^-1 x; L^-1 x and L^-T x.
    void dots(double* x) const {
        const int n = count();
        for (int i = 0; i < n; ++i) x[i] = (x[i] - dot(&U_[i * n], x, i)) * inverse_[i];
    }
    void sums(double* x) const {
        const int n = count();
        for (int i = n - 1; i >= 0; --i) {
            x[i] *= inverse_[i];
            add(-x[i], &U_[i * n], x, i);
        }
    }

    void keep_normal(double* white) const override {
        times_q_transposed(white);
        std::fill(white + rank, white + count(), 0.0);
        times_q(white);
    }

    void factorise(const double* M, const double* f, const double* bias, double) override {
        const int n = count();
        if constexpr (size == 0) {
            factorise_across_columns(M, f, bias);
        } else {
            std::copy(M, M + n * n, U_.begin());
            std::copy(f, f + n, white_force.begin());
            whiten_all();
            for (int j = 0; j < rows; ++j)
                gamma_[j] = dot(&A_[j * n], white_force.data(), n) + bias[j];
            pivoted_qr();
        }
        for (int k = 0; k < structural_rank; ++k) pivots_[k] = std::abs(A_[k * n + k]);
    }

    // The same for nv that is known at run time only.  Norms are updated as long as that loses no
    // digits, as LAPACK does.
    void factorise_across_columns(const double* M, const double* f, const double* bias) {
        const int n = nv, first = padded(n + 1), width = first + padded(rows);
        double* const T = T_.data();
        double* const W = T + first;
        for (int k = 0; k < n; ++k) {
            for (int i = 0; i <= k; ++i)
                T[k * width + n - 1 - i] = T[i * width + n - 1 - k] = M[k * n + i];
            T[k * width + n] = f[k];
            for (int j = 0; j < rows; ++j) W[k * width + j] = A_[j * n + k];
        }
        if (!factorise_rows(T, n, width, inverse_.data(), row_.data()))
            throw EvaluationError{Failure::mass_matrix};
        for (int k = 0; k < n; ++k) {
            for (int i = 0; i <= k; ++i) U_[k * n + i] = T[k * width + n - 1 - i];
            white_force[k] = T[k * width + n];
        }
        multiply_columns(W, width, n, padded(rows), white_force.data(), squares_.data(),
                         products_.data());
        for (int j = 0; j < rows; ++j) {
            order_[j] = j;
            row_squares_[j] = first_squares_[j] = squares_[j];
            gamma_[j] = products_[j] + bias[j];
        }
        const int last = std::min(structural_rank, std::min(n, rows));
        for (int k = 0; k < last; ++k) {
            double* const column = &A_[k * n];
            const int pivot = largest_column(k);
            std::swap(order_[k], order_[pivot]);
            for (int i = 0; i < n; ++i) {
                double* const row = W + i * width;
                column[i] = row[pivot];
                row[pivot] = row[k];
            }
            squares_[pivot] = squares_[k];
            first_squares_[pivot] = first_squares_[k];
            make_reflection(k);
            const int from = (k + 1) / lanes * lanes;
            double* const row = W + k * width;
            reflect_columns(row + from, width, n - k, padded(rows) - from, tau_[k], column + k);
            for (int j = k + 1; j < rows; ++j) {
                squares_[j] -= row[j] * row[j];
                if (squares_[j] > norm_lost * first_squares_[j]) continue;
                squares_[j] = 0.0;
                for (int i = k + 1; i < n; ++i)
                    squares_[j] += W[i * width + j] * W[i * width + j];
                first_squares_[j] = squares_[j];
            }
        }
    }

    int largest_column(int k) const {
        int pivot = k;
        for (int j = k + 1; j < rows; ++j)
            if (squares_[j] > squares_[pivot]) pivot = j;
        return pivot;
    }

    // Cholesky factor U of M in U_, and L^-1 applied to the rows of G and the forces.  Row by row
    // of U, because the updates of one row are independent of each other.
    void whiten_all() {
        const int n = count();
        double* const U = U_.data();
        double* const row = row_.data();
        for (int k = 0; k < n; ++k) {
            const double pivot = U[k * n + k];
            if (!(pivot > 0.0)) throw EvaluationError{Failure::mass_matrix};
            const double diagonal = std::sqrt(pivot), inverse = 1.0 / diagonal;
            U[k * n + k] = diagonal;
            inverse_[k] = inverse;
            for (int j = k + 1; j < n; ++j) row[j] = U[j * n + k] *= inverse;
            for (int j = k + 1; j < n; ++j) {
                double* column = U + j * n;
                for (int i = k + 1; i <= j; ++i) column[i] -= row[i] * row[j];
            }
            eliminate(k, inverse, white_force.data());
            for (int j = 0; j < rows; ++j) eliminate(k, inverse, &A_[j * n]);
        }
    }

    void eliminate(int k, double inverse, double* x) const {
        if (x[k] == 0.0) return;
        const double value = x[k] *= inverse;
        const int n = count();
        for (int i = k + 1; i < n; ++i) x[i] -= row_[i] * value;
    }

    // Householder QR with column pivoting down to the structural rank.  The pivot rule is that of
    // LAPACK's xGEQP3, which the reference calls.  The loop that changes a column also computes its
    // norm, where LAPACK updates the norm as long as that loses no digits.
    void pivoted_qr() {
        const int n = count();
        for (int j = 0; j < rows; ++j) {
            order_[j] = j;
            squares_[j] = row_squares_[j] = dot(&A_[j * n], &A_[j * n], n);
        }
        const int last = std::min(structural_rank, std::min(n, rows));
        for (int k = 0; k < last; ++k) {
            const int pivot = largest_column(k);
            if (pivot != k) {
                std::swap_ranges(&A_[k * n], &A_[k * n] + n, &A_[pivot * n]);
                std::swap(order_[k], order_[pivot]);
                squares_[pivot] = squares_[k];
            }
            reflect(k);
        }
    }

    // Makes the reflection of column k onto its entry k.
    void make_reflection(int k) {
        const int n = count(), below = n - k - 1;
        double* const v = &A_[k * n] + k + 1;
        const double alpha = v[-1], tail = dot(v, v, below);
        double beta = alpha;
        tau_[k] = 0.0;
        if (tail != 0.0) {
            beta = -std::copysign(std::sqrt(alpha * alpha + tail), alpha);
            tau_[k] = (beta - alpha) / beta;
            const double scale = 1.0 / (alpha - beta);
            for (int i = 0; i < below; ++i) v[i] *= scale;
            v[-1] = beta;
        }
        inverse_pivots_[k] = 1.0 / beta;
    }

    // Reflects the columns after column k, of which it makes the reflection.
    void reflect(int k) {
        make_reflection(k);
        const int n = count(), below = n - k - 1;
        const double* const v = &A_[k * n] + k + 1;
        for (int j = k + 1; j < rows; ++j) {
            double* const x = &A_[j * n] + k + 1;
            const double s = tau_[k] * (x[-1] + dot(v, x, below));
            x[-1] -= s;
            double square = 0.0;
            for (int i = 0; i < below; ++i) {
                x[i] -= s * v[i];
                square += x[i] * x[i];
            }
            squares_[j] = square;
        }
    }

    void times_q_transposed(double* x) const {
        for (int k = 0; k < rank; ++k) reflect(k, x);
    }

    void times_q(double* x) const {
        for (int k = rank - 1; k >= 0; --k) reflect(k, x);
    }

    void reflect(int k, double* x) const {
        const int n = count(), below = n - k - 1;
        const double* v = &A_[k * n] + k + 1;
        const double s = tau_[k] * (x[k] + dot(v, x + k + 1, below));
        x[k] -= s;
        add(-s, v, x + k + 1, below);
    }

    // U_: column i of U, M = U^T U, or row i of L, M = L^T L, which has no entries but those of a
    // coordinate and its ancestors, for nv that is known at run time only.
    std::vector<double> U_, inverse_, row_, A_, tau_, inverse_pivots_, squares_;
    // Of factorise_across_columns(): [M | f | G^T], padded, products of the columns with the
    // forces, and their squared norms when these were last summed.
    std::vector<double> T_, products_, first_squares_;
    std::vector<int> order_;
};

template <int size>
std::unique_ptr<Projection> sized(int nv, int rows, int structural_rank, double sigma_ref) {
    if constexpr (size > 0)
        if (nv != size) return sized<size - 1>(nv, rows, structural_rank, sigma_ref);
    return std::make_unique<DenseProjection<size>>(nv, rows, structural_rank, sigma_ref);
}

}  // namespace

std::unique_ptr<Projection> make_dense_projection(int nv, int rows, int structural_rank,
                                                  double sigma_ref) {
    return sized<largest_unrolled>(nv, rows, structural_rank, sigma_ref);
}

}  // namespace srm
