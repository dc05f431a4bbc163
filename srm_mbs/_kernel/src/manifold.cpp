#include "manifold.hpp"

#include <algorithm>
#include <cmath>
#include <functional>

#include <Eigen/Cholesky>

#include "errors.hpp"
#include "limits.hpp"
#include "linear.hpp"
#include "workspace.hpp"

namespace srm {

namespace {

using Matrix = Eigen::MatrixXd;
using Block = Eigen::Map<const Matrix, 0, Eigen::OuterStride<>>;

// The Cholesky factors of the block [first, end) of M (nv, nv), of which the upper triangle is read.
Eigen::LLT<Matrix, Eigen::Upper> factors_of(const double* M, int nv, int first, int end) {
    const int n = end - first;
    const Block block(M + static_cast<std::size_t>(first) * (nv + 1), n, n,
                      Eigen::OuterStride<>(nv));
    Eigen::LLT<Matrix, Eigen::Upper> out(block);
    if (out.info() != Eigen::Success) throw EvaluationError{Failure::mass_matrix};
    return out;
}

}  // namespace

void System::rows_and_mass(const double* q, double* G) {
    auto& w = *work_;
    w.place(q);
    w.v.setZero();
    pinocchio_model::compute_terms(w);
    update_closures(q, false);
    for (int row = 0; row < data_.rows; ++row) {
        const double* const from = filled(row);
        std::copy(from, from + nv, G + static_cast<std::size_t>(row) * nv);
    }
}

const double* System::mass_matrix() const { return work_->data.M.data(); }

std::vector<double> System::world_jacobian() const {
    const auto J = work_->world_jacobian();
    return {J.data(), J.data() + J.size()};
}

void ScaledRows::check() const {
    expect_size("others", others.size(), eliminated.size());
    expect_size("shares", shares.size(), eliminated.size());
    const long rows = static_cast<long>(scale.size()), nv = static_cast<long>(unit.size());
    expect_within("eliminated", eliminated, 0, rows - 1);
    expect_within("others", others, 0, rows - 1);
    expect_within("row_unit", static_cast<long>(row_unit.size()), 0, rows);
    expect_within("trees", trees, 0, nv);
    for (std::size_t i = 1; i < trees.size(); ++i)
        expect_within("trees", trees[i], trees[i - 1], nv);
}

double close_loops(System& system, Algebra& algebra, const double* row_unit, const double* units,
                   const ClosingLimits& limits, std::vector<double>& q) {
    const int rows = algebra.rows(), nv = system.nv, nq = system.nq;
    std::vector<double> at(nq + nv, 0.0), delta(2 * nv, 0.0), g(system.rows());
    std::vector<double> G(static_cast<std::size_t>(system.rows()) * nv);
    std::copy_n(q.begin(), nq, at.begin());
    double error = infinity;
    for (int k = 1; k <= limits.evaluations; ++k) {
        system.closures_at(0.0, at.data(), g.data(), G.data(), nv);
        double size = 0.0, longest = 0.0;
        for (int row = 0; row < rows; ++row) {
            g[row] /= row_unit[row];
            size = std::isnan(g[row]) ? g[row] : std::max(size, std::abs(g[row]));
            if (std::isnan(size)) break;
        }
        const bool stuck = 0.5 * error < size && size <= limits.rounding;
        error = size;
        if (stuck || !(size > limits.tolerance) || k == limits.evaluations) break;
        for (int row = 0; row < rows; ++row) {
            double* const out = algebra.row(row);
            double squares = 0.0;
            for (const int j : algebra.support(row)) {
                out[j] = G[static_cast<std::size_t>(row) * nv + j] * (units[j] / row_unit[row]);
                squares += out[j] * out[j];
            }
            longest = std::max(longest, squares);
        }
        try {
            algebra.factor_written(limits.cut * std::sqrt(longest));
        } catch (const EvaluationError&) {
            break;
        }
        algebra.shortest(g.data(), delta.data());
        for (int j = 0; j < nv; ++j) delta[j] *= -units[j];
        system.retract(at.data(), delta.data(), at.data());
    }
    std::copy_n(at.begin(), nq, q.begin());
    return error;
}

ScaledSampler::ScaledSampler(System& system, const ScaledRows& rows, Algebra& all, Algebra& loops,
                             Algebra& in_units)
    : system_(system),
      rows_(rows),
      all_(all),
      loops_(loops),
      in_units_(in_units),
      G_(static_cast<std::size_t>(system.rows()) * system.nv) {
    const auto nv = static_cast<std::size_t>(system.nv);
    expect_size("scale", rows.scale.size(), static_cast<std::size_t>(system.rows()));
    expect_size("unit", rows.unit.size(), nv);
    const bool misfits = system.driven() || system.constrained() || all.rows() != system.rows() ||
                         loops.rows() != in_units.rows() || loops.rows() > all.rows() ||
                         rows.row_unit.size() != static_cast<std::size_t>(loops.rows());
    for (const Algebra* each : {&all, &loops, &in_units})
        if (misfits || each->columns() != system.nv)
            throw std::invalid_argument("the rows are not those of the system and of the algebra");
}

void ScaledSampler::write(Algebra& algebra, int rows) {
    for (int row = 0; row < rows; ++row) {
        double* const out = algebra.row(row);
        const double* const from = &G_[static_cast<std::size_t>(row) * system_.nv];
        for (const int j : algebra.support(row)) out[j] = from[j] / rows_.scale[row];
    }
}

void ScaledSampler::factorise(const double* q) {
    const int nv = system_.nv;
    system_.rows_and_mass(q, G_.data());
    for (std::size_t k = 0; k < rows_.eliminated.size(); ++k)
        add(-rows_.shares[k], &G_[static_cast<std::size_t>(rows_.others[k]) * nv],
            &G_[static_cast<std::size_t>(rows_.eliminated[k]) * nv], nv);
    write(all_, all_.rows());
    all_.factor_in_metric(system_.mass_matrix(), rows_.null_pivot);
    if (&loops_ == &all_) return;
    write(loops_, loops_.rows());
    loops_.factor_in_metric(system_.mass_matrix(), rows_.null_pivot);
}

void ScaledSampler::sample(const std::vector<double>& q, WalkSamples& out) const {
    const auto add_pivots = [](const Algebra& algebra, std::vector<double>& to) {
        const auto& pivots = algebra.projection().pivots();
        to.insert(to.end(), pivots.begin(), pivots.end());
        std::sort(to.end() - static_cast<std::ptrdiff_t>(pivots.size()), to.end(),
                  std::greater<double>());
    };
    out.configurations.insert(out.configurations.end(), q.begin(), q.end());
    add_pivots(all_, out.pivots);
    add_pivots(loops_, out.of_loops);
    const auto& squares = all_.projection().row_squares();
    for (std::size_t row = 0; row < squares.size(); ++row)
        out.largest[row] = std::max(out.largest[row], std::sqrt(squares[row]));
    ++out.count;
}

// x = L^-T x, where M = L L^T was evaluated last.
void ScaledSampler::make_isotropic(double* x) const {
    for (std::size_t i = 0; i + 1 < rows_.trees.size(); ++i) {
        const int first = rows_.trees[i], end = rows_.trees[i + 1];
        Eigen::Map<Eigen::VectorXd> own(x + first, end - first);
        factors_of(system_.mass_matrix(), system_.nv, first, end).matrixU().solveInPlace(own);
    }
}

// A closed configuration about `reach` units from q along `direction`; false if none was found.
bool ScaledSampler::step(const double* q, const double* direction, double reach,
                         std::vector<double>& moved) {
    const int nv = system_.nv, nq = system_.nq;
    double size = 0.0;
    for (int j = 0; j < nv; ++j) size = std::max(size, std::abs(direction[j] / rows_.unit[j]));
    if (!(size > 0.0)) return false;
    std::vector<double> at(nq + nv, 0.0), delta(2 * nv, 0.0), ahead(nq + nv);
    std::copy_n(q, nq, at.begin());
    for (int j = 0; j < nv; ++j) delta[j] = direction[j] * (reach / size);
    for (int k = 0; k < rows_.halvings; ++k) {
        system_.retract(at.data(), delta.data(), ahead.data());
        moved.assign(ahead.begin(), ahead.begin() + nq);
        if (close_loops(system_, in_units_, rows_.row_unit.data(), rows_.unit.data(),
                        rows_.closing, moved) < rows_.closed)
            return true;
        for (double& x : delta) x *= 0.5;
    }
    return false;
}

void ScaledSampler::walk(std::vector<double> q, bool sample_start, int steps,
                         const double* directions, const double* reaches, const double* first,
                         WalkSamples& out) {
    const int nv = system_.nv;
    out.largest.resize(all_.rows());
    factorise(q.data());
    if (sample_start) sample(q, out);
    std::vector<double> direction(nv), moved;
    for (int k = 0; k < steps && loops_.projection().rank < nv; ++k) {
        if (k == 0 && first) {
            std::copy_n(first, nv, direction.begin());
        } else {
            std::copy_n(directions + static_cast<std::size_t>(k) * nv, nv, direction.begin());
            make_isotropic(direction.data());
            loops_.make_tangential(direction.data());
        }
        if (!step(q.data(), direction.data(), reaches[k], moved)) continue;
        q = moved;
        factorise(q.data());
        sample(q, out);
    }
}

void ScaledSampler::open_norms(const std::vector<double>& q, std::size_t n, const double* spreads,
                               double* squares, double* uncancelled) {
    const int nv = system_.nv, nq = system_.nq;
    std::vector<double> at(nq + nv, 0.0), delta(2 * nv, 0.0), there(nq + nv);
    std::copy_n(q.begin(), nq, at.begin());
    for (std::size_t i = 0; i < n; ++i) {
        std::copy_n(spreads + i * nv, nv, delta.begin());
        system_.retract(at.data(), delta.data(), there.data());
        factorise(there.data());
        const auto& found = all_.projection().row_squares();
        for (std::size_t row = 0; row < found.size(); ++row) squares[row] += found[row];
        const std::vector<double> J = system_.world_jacobian();
        for (std::size_t tree = 0; tree + 1 < rows_.trees.size(); ++tree) {
            const int begin = rows_.trees[tree], end = rows_.trees[tree + 1];
            const Matrix inverse = factors_of(system_.mass_matrix(), nv, begin, end)
                                       .solve(Matrix::Identity(end - begin, end - begin));
            for (int j = begin; j < end; ++j) {
                const double* const column = &J[6 * static_cast<std::size_t>(j)];
                const double turn = norm(column + 3, 3);
                const double shift = norm(column, 3) + rows_.length * turn;
                const double mobility = inverse(j - begin, j - begin);
                uncancelled[0] += mobility * shift * shift;
                uncancelled[1] += mobility * turn * turn;
            }
        }
    }
}

}  // namespace srm
