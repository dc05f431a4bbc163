#include "critical.hpp"

#include <cmath>

#include "limits.hpp"
#include "linear.hpp"

namespace srm {

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

UnitClosures::UnitClosures(System& system_, double time_unit_)
    : system(system_),
      nv(system.nv),
      n(system.nv + (system.driven() ? 1 : 0)),
      rows(system.rows()),
      time_unit(time_unit_),
      g(rows),
      G(static_cast<std::size_t>(rows) * n),
      move_(2 * nv),
      away_(2 * nv),
      none_(2 * nv) {}

void UnitClosures::evaluate(const std::vector<double>& x, double t) {
    system.closures_at(t, x.data(), g.data(), G.data(), n);
    for (int i = 0; i < rows; ++i) {
        const double scale = system.residual_scale(i);
        g[i] *= scale;
        for (int j = 0; j < n; ++j) G[i * n + j] *= scale * unit(j);
    }
}

void UnitClosures::move(const double* delta, std::vector<double>& x, double& t) {
    for (int j = 0; j < nv; ++j) move_[j] = delta[j] * unit(j);
    system.retract(x.data(), move_.data(), x.data());
    if (n > nv) t += delta[nv] * time_unit;
}

void UnitClosures::difference(const std::vector<double>& from, double t_from,
                              const std::vector<double>& to, double t_to, double* out) {
    system.difference(from.data(), to.data(), none_.data(), away_.data());
    for (int j = 0; j < nv; ++j) out[j] = away_[j] / unit(j);
    if (n > nv) out[nv] = (t_to - t_from) / time_unit;
}

namespace {

// The search for (q, u, delta) with G^T u = 0, g = delta u, |u| = 1 over independent rows of the
// closures, in row units.
class Search {
public:
    Search(UnitClosures& closures, double reach, const Constants& constants)
        : closures_(closures),
          constants_(constants),
          reach_(reach),
          n_(closures.n),
          all_(closures.rows),
          rank_(closures.system.structural_rank()),
          g_(rank_),
          G_(static_cast<std::size_t>(rank_) * n_),
          ahead_(n_),
          behind_(n_),
          move_(n_) {}

    bool run(const std::vector<double>& place, double time) {
        x_ = place;
        time_ = time;
        closures_.evaluate(x_, time_);
        choose_rows();
        take_rows();
        moved_.assign(n_, 0.0);
        return start() && iterate(constants_.critical_decided) < constants_.critical_decided;
    }

    // Brings `found` to rounding; whether the equations hold.
    bool refine() {
        go_back();
        return iterate(constants_.critical_converged) < constants_.critical_accepted;
    }

    // Completes `found`, to rounding, and by the Hessian there; whether the equations hold.
    bool complete() {
        if (!refine()) return false;
        go_back();
        if (!differentiate(true)) return false;
        found.hessian = hessian_;
        found.rows = chosen_;
        return true;
    }

    CriticalConfiguration found;

private:
    // Newton's iteration from (q, u) until the equations are smaller than `converged`; their size,
    // infinite where it fails.
    double iterate(double converged) {
        const int size = n_ + rank_ + 1;
        std::vector<double> value(size), matrix;
        double best = infinity, last = infinity;
        for (int i = 0; i < constants_.critical_iterations; ++i) {
            fill_value(value);
            const double error = largest(value.data(), size);
            if (!(error < best) && error < constants_.critical_accepted) break;
            if (error < best) {
                best = error;
                found.residual = delta_;
                found.x = x_;
                found.t = time_;
                found.u = u_;
            }
            if (error <= converged) break;
            // The curvature by time follows from the part of a drive in u, which has none at first.
            const bool known = last_move_ <= constants_.critical_frozen &&
                               (i == 0 || error < constants_.critical_converging * last) &&
                               (n_ == closures_.nv || moves_ > 1);
            if (!known && !differentiate()) return infinity;
            ++moves_;
            last = error;
            fill_matrix(matrix);
            for (double& v : value) v = -v;
            if (!solve(matrix, value)) return infinity;
            last_move_ = largest(value.data(), n_);
            if (!(last_move_ < reach_)) return infinity;
            closures_.move(value.data(), x_, time_);
            add(1.0, value.data(), moved_.data(), n_);
            if (!(largest(moved_.data(), n_) < reach_)) return infinity;
            add(1.0, value.data() + n_, u_.data(), rank_);
            const double length = norm(u_.data(), rank_);
            for (double& u : u_) u /= length;
            closures_.evaluate(x_, time_);
            take_rows();
            delta_ = dot(u_.data(), g_.data(), rank_);
        }
        return best;
    }

    void go_back() {
        x_ = found.x;
        time_ = found.t;
        u_ = found.u;
        closures_.evaluate(x_, time_);
        take_rows();
        delta_ = found.residual;
    }

    void take_rows() {
        for (int i = 0; i < rank_; ++i) {
            g_[i] = closures_.g[chosen_[i]];
            std::copy_n(&closures_.G[chosen_[i] * n_], n_, &G_[i * n_]);
        }
    }

    // Independent rows, by Gram-Schmidt with the largest remainder next.
    void choose_rows() {
        chosen_.clear();
        if (all_ == rank_) {
            for (int i = 0; i < rank_; ++i) chosen_.push_back(i);
            return;
        }
        std::vector<double> left(closures_.G);
        std::vector<bool> taken(all_, false);
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

    // u: the combination of the rows that is smallest, by inverse iteration from one that has a part
    // in each row.
    bool start() {
        u_.resize(rank_);
        for (int i = 0; i < rank_; ++i) u_[i] = std::cos(1.0 + i);
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

    // The Hessian of u . g, by differences of G^T u: for Newton's steps from here, or central ones.
    // Coordinates that no rows have in common change together.
    bool differentiate(bool central = false) {
        const double length = constants_.critical_difference;
        const ColumnGroups& columns = closures_.system.column_groups();
        hessian_.assign(static_cast<std::size_t>(n_) * n_, 0.0);
        std::fill(behind_.begin(), behind_.end(), 0.0);
        if (!central)
            for (int i = 0; i < rank_; ++i) add(u_[i], &G_[i * n_], behind_.data(), n_);
        const double apart = central ? 2.0 * length : length;
        for (const std::vector<int>& group : columns.groups) {
            gradient(group, length, ahead_);
            if (central) gradient(group, -length, behind_);
            for (const int j : group)
                for (const int k : columns.neighbours[j])
                    hessian_[k * n_ + j] = (ahead_[k] - behind_[k]) / apart;
        }
        return finite(hessian_.data(), n_ * n_);
    }

    // G^T u (n,) where the coordinates of `group` have moved by `length`.
    void gradient(const std::vector<int>& group, double length, std::vector<double>& out) {
        std::fill(move_.begin(), move_.end(), 0.0);
        for (const int j : group) move_[j] = length;
        there_ = x_;
        double time = time_;
        closures_.move(move_.data(), there_, time);
        closures_.evaluate(there_, time);
        std::fill(out.begin(), out.end(), 0.0);
        for (int i = 0; i < rank_; ++i)
            add(u_[i], &closures_.G[chosen_[i] * n_], out.data(), n_);
    }

    void fill_matrix(std::vector<double>& matrix) const {
        const int size = n_ + rank_ + 1;
        matrix.assign(static_cast<std::size_t>(size) * size, 0.0);
        for (int i = 0; i < n_; ++i) {
            std::copy_n(&hessian_[i * n_], n_, &matrix[i * size]);
            // Configurations that are critical together, as those of a free base, stay where they
            // are.
            matrix[i * size + i] +=
                i < closures_.nv ? constants_.critical_ridge : constants_.critical_time_ridge;
            for (int j = 0; j < rank_; ++j) matrix[i * size + n_ + j] = G_[j * n_ + i];
        }
        for (int i = 0; i < rank_; ++i) {
            double* row = &matrix[(n_ + i) * size];
            std::copy_n(&G_[i * n_], n_, row);
            // Combinations that are critical together, as those of loops that are singular at once,
            // stay what they are.
            row[n_ + i] = -delta_ - constants_.critical_ridge;
            row[n_ + rank_] = -u_[i];
            matrix[(n_ + rank_) * size + n_ + i] = u_[i];
        }
    }

    UnitClosures& closures_;
    const Constants& constants_;
    const double reach_;
    const int n_, all_, rank_;
    std::vector<double> g_, G_, u_, hessian_, x_, moved_;
    std::vector<double> ahead_, behind_, move_, there_;  // of differentiate()
    double last_move_ = infinity;
    int moves_ = 0;
    std::vector<int> chosen_;
    double time_ = 0.0, delta_ = 0.0;
};

}  // namespace

std::optional<CriticalConfiguration> critical_near(UnitClosures& closures, double t,
                                                   const std::vector<double>& x, double reach,
                                                   const Constants& constants) {
    Search search(closures, reach, constants);
    if (!search.run(x, t) || !search.refine()) return {};
    return std::move(search.found);
}

std::optional<CriticalConfiguration> critical_of_passage(UnitClosures& closures, double t,
                                                         const double* begin, const double* rate,
                                                         double zero, const Constants& constants) {
    System& system = closures.system;
    const int nv = system.nv, nx = system.nq + nv;
    const double ahead = zero - t;
    std::vector<double> move(2 * nv, 0.0), place(nx), away(closures.n);
    for (int i = 0; i < nv; ++i) move[i] = ahead * (rate[i] + 0.5 * ahead * rate[nv + i]);
    system.retract(begin, move.data(), place.data());
    Search search(closures, constants.critical_reach, constants);
    if (!search.run(place, zero)) return {};
    CriticalConfiguration& found = search.found;
    const auto distance = [&](const std::vector<double>& x) {
        closures.difference(found.x, found.t, x, found.t, away.data());
        return norm(away.data(), nv);
    };
    const double covered = distance(std::vector<double>(begin, begin + nx));
    found.passed = distance(place) < constants.critical_passed * covered;
    const bool singular = !(std::abs(found.residual) > constants.stepped_residual);
    if (!singular && !search.complete()) return {};
    return std::move(found);
}

}  // namespace srm
