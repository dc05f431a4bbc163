#include "critical.hpp"

#include <cmath>
#include <limits>

#include "linear.hpp"

namespace srm {

namespace {

// Solves A x = b in place, A (n, n) by rows; whether it has no zero pivot.
bool solve(std::vector<double>& A, std::vector<double>& b) {
    const std::size_t n = b.size();
    for (std::size_t k = 0; k < n; ++k) {
        std::size_t pivot = k;
        for (std::size_t i = k + 1; i < n; ++i)
            if (std::abs(A[i * n + k]) > std::abs(A[pivot * n + k])) pivot = i;
        if (!(std::abs(A[pivot * n + k]) > 0.0)) return false;
        if (pivot != k) {
            std::swap_ranges(&A[k * n], &A[k * n] + n, &A[pivot * n]);
            std::swap(b[k], b[pivot]);
        }
        for (std::size_t i = k + 1; i < n; ++i) {
            const double factor = A[i * n + k] / A[k * n + k];
            if (factor == 0.0) continue;
            for (std::size_t j = k + 1; j < n; ++j) A[i * n + j] -= factor * A[k * n + j];
            b[i] -= factor * b[k];
        }
    }
    for (std::size_t k = n; k-- > 0;) {
        for (std::size_t j = k + 1; j < n; ++j) b[k] -= A[k * n + j] * b[j];
        b[k] /= A[k * n + k];
    }
    return true;
}

// The search for (q, u, delta) with G^T u = 0, g = delta u, |u| = 1 over independent rows of the
// closures, in row units.
class Search {
public:
    Search(System& system, const Constants& constants, double time_unit)
        : system_(system),
          constants_(constants),
          nv_(system.nv),
          n_(system.nv + (system.driven() ? 1 : 0)),
          all_(system.rows()),
          rank_(system.structural_rank()),
          time_unit_(time_unit),
          g_all_(all_),
          G_all_(static_cast<std::size_t>(all_) * n_),
          g_(rank_),
          G_(static_cast<std::size_t>(rank_) * n_),
          move_(2 * nv_) {}

    std::optional<double> run(const std::vector<double>& place, double time) {
        x_ = place;
        time_ = time;
        evaluate(x_, time_);
        choose_rows();
        take_rows();
        if (!start()) return {};
        const int size = n_ + rank_ + 1;
        std::vector<double> value(size), matrix, moved(n_, 0.0);
        double last_move = std::numeric_limits<double>::infinity(), best = last_move, found = 0.0;
        for (int i = 0; i < constants_.critical_iterations; ++i) {
            fill_value(value);
            const double error = largest(value.data(), size);
            if (!(error < best) && error < constants_.critical_accepted) break;
            if (error < best) {
                best = error;
                found = delta_;
                best_x_ = x_;
            }
            if (error <= constants_.critical_converged) break;
            if (last_move > constants_.critical_frozen && !differentiate()) return {};
            fill_matrix(matrix);
            for (double& v : value) v = -v;
            if (!solve(matrix, value)) return {};
            last_move = largest(value.data(), n_);
            if (!(last_move < constants_.critical_reach)) return {};
            step(value.data(), x_, time_);
            add(1.0, value.data(), moved.data(), n_);
            if (!(largest(moved.data(), n_) < constants_.critical_reach)) return {};
            add(1.0, value.data() + n_, u_.data(), rank_);
            const double length = norm(u_.data(), rank_);
            for (double& u : u_) u /= length;
            evaluate(x_, time_);
            take_rows();
            delta_ = dot(u_.data(), g_.data(), rank_);
        }
        if (!(best < constants_.critical_accepted)) return {};
        return found;
    }

    const std::vector<double>& place() const { return best_x_; }

private:
    void evaluate(const std::vector<double>& x, double time) {
        system_.closures_at(time, x.data(), g_all_.data(), G_all_.data(), n_);
        for (int i = 0; i < all_; ++i) {
            const double scale = system_.residual_scale(i);
            g_all_[i] *= scale;
            for (int j = 0; j < nv_; ++j) G_all_[i * n_ + j] *= scale * system_.unit(j);
            if (n_ > nv_) G_all_[i * n_ + nv_] *= scale * time_unit_;
        }
    }

    void take_rows() {
        for (int i = 0; i < rank_; ++i) {
            g_[i] = g_all_[chosen_[i]];
            std::copy_n(&G_all_[chosen_[i] * n_], n_, &G_[i * n_]);
        }
    }

    // Independent rows, by Gram-Schmidt with the largest remainder next.
    void choose_rows() {
        std::vector<double> left(G_all_);
        std::vector<bool> taken(all_, false);
        chosen_.clear();
        for (int k = 0; k < rank_; ++k) {
            int next = -1;
            double size = -1.0;
            for (int i = 0; i < all_; ++i) {
                const double length = taken[i] ? -1.0 : norm(&left[i * n_], n_);
                if (length > size) {
                    size = length;
                    next = i;
                }
            }
            taken[next] = true;
            chosen_.push_back(next);
            if (!(size > 0.0)) continue;
            const double* e = &left[next * n_];
            for (int i = 0; i < all_; ++i)
                if (!taken[i])
                    add(-dot(e, &left[i * n_], n_) / (size * size), e, &left[i * n_], n_);
        }
    }

    // u: the combination of the rows that is smallest, by inverse iteration.
    bool start() {
        u_.assign(rank_, 0.0);
        u_[rank_ - 1] = 1.0;
        std::vector<double> gram(static_cast<std::size_t>(rank_) * rank_);
        double trace = 0.0;
        for (int i = 0; i < rank_; ++i) {
            for (int j = 0; j < rank_; ++j)
                gram[i * rank_ + j] = dot(&G_[i * n_], &G_[j * n_], n_);
            trace += gram[i * rank_ + i];
        }
        for (int i = 0; i < rank_; ++i) gram[i * rank_ + i] += 1e-12 * trace;
        for (int k = 0; k < 3; ++k) {
            std::vector<double> A(gram);
            if (!solve(A, u_)) return false;
            const double length = norm(u_.data(), rank_);
            if (!(std::isfinite(length) && length > 0.0)) return false;
            for (double& u : u_) u /= length;
        }
        delta_ = dot(u_.data(), g_.data(), rank_);
        return true;
    }

    void fill_value(std::vector<double>& value) const {
        std::fill(value.begin(), value.end(), 0.0);
        for (int i = 0; i < rank_; ++i) {
            add(u_[i], &G_[i * n_], value.data(), n_);
            value[n_ + i] = g_[i] - delta_ * u_[i];
        }
    }

    // The Hessian of u . g, by differences of G^T u.
    bool differentiate() {
        hessian_.assign(static_cast<std::size_t>(n_) * n_, 0.0);
        std::vector<double> here(n_, 0.0), e(n_);
        for (int i = 0; i < rank_; ++i) add(u_[i], &G_[i * n_], here.data(), n_);
        for (int j = 0; j < n_; ++j) {
            std::fill(e.begin(), e.end(), 0.0);
            e[j] = constants_.critical_difference;
            std::vector<double> x(x_);
            double time = time_;
            step(e.data(), x, time);
            evaluate(x, time);
            for (int i = 0; i < rank_; ++i) {
                const double* row = &G_all_[chosen_[i] * n_];
                for (int k = 0; k < n_; ++k) hessian_[k * n_ + j] += u_[i] * row[k];
            }
            for (int k = 0; k < n_; ++k)
                hessian_[k * n_ + j] = (hessian_[k * n_ + j] - here[k]) / e[j];
        }
        return finite(hessian_.data(), n_ * n_);
    }

    void fill_matrix(std::vector<double>& matrix) const {
        const int size = n_ + rank_ + 1;
        matrix.assign(static_cast<std::size_t>(size) * size, 0.0);
        for (int i = 0; i < n_; ++i) {
            std::copy_n(&hessian_[i * n_], n_, &matrix[i * size]);
            // Configurations that are critical together, as those of a free base, stay where they
            // are.
            matrix[i * size + i] += constants_.critical_ridge;
            for (int j = 0; j < rank_; ++j) matrix[i * size + n_ + j] = G_[j * n_ + i];
        }
        for (int i = 0; i < rank_; ++i) {
            double* row = &matrix[(n_ + i) * size];
            std::copy_n(&G_[i * n_], n_, row);
            row[n_ + i] = -delta_;
            row[n_ + rank_] = -u_[i];
            matrix[(n_ + rank_) * size + n_ + i] = u_[i];
        }
    }

    void step(const double* delta, std::vector<double>& x, double& time) {
        for (int j = 0; j < nv_; ++j) move_[j] = delta[j] * system_.unit(j);
        std::fill(move_.begin() + nv_, move_.end(), 0.0);
        system_.retract(x.data(), move_.data(), x.data());
        if (n_ > nv_) time += delta[nv_] * time_unit_;
    }

    System& system_;
    const Constants& constants_;
    const int nv_, n_, all_, rank_;
    const double time_unit_;
    std::vector<double> g_all_, G_all_, g_, G_, move_, u_, hessian_, x_, best_x_;
    std::vector<int> chosen_;
    double time_ = 0.0, delta_ = 0.0;
};

}  // namespace

std::optional<double> residual_of_passage(System& system, double t, const double* begin,
                                          const double* rate, double zero,
                                          const Constants& constants) {
    const int nv = system.nv, nx = system.nq + nv;
    const double ahead = zero - t;
    std::vector<double> move(2 * nv, 0.0), place(nx), away(2 * nv), none(2 * nv, 0.0);
    for (int i = 0; i < nv; ++i) move[i] = ahead * (rate[i] + 0.5 * ahead * rate[nv + i]);
    system.retract(begin, move.data(), place.data());
    Search search(system, constants, ahead);
    const std::optional<double> delta = search.run(place, zero);
    if (!delta) return {};
    const auto distance = [&](const double* x) {
        system.difference(search.place().data(), x, none.data(), away.data());
        double sum = 0.0;
        for (int i = 0; i < nv; ++i) sum += away[i] * away[i] / (system.unit(i) * system.unit(i));
        return std::sqrt(sum);
    };
    if (!(distance(place.data()) < constants.critical_passed * distance(begin))) return {};
    return delta;
}

}  // namespace srm
