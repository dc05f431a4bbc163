#include "linear_stages.hpp"

#include <algorithm>
#include <cmath>

#include "errors.hpp"
#include "limits.hpp"
#include "linear.hpp"

namespace srm {

namespace {

// The power of 2 up to `size`: a step that a sum with a coordinate does not round.
double rounded_down(double size) {
    int exponent = 0;
    std::frexp(size, &exponent);
    return std::ldexp(0.5, exponent);
}

}  // namespace

LinearStages::LinearStages(System& system, double gamma, std::vector<double> unit,
                           const Constants& constants)
    : system_(system),
      nv_(system.nv),
      n_(2 * system.nv),
      count_(system.resolve_laws()),
      gamma_(gamma),
      unit_(std::move(unit)),
      constants_(constants),
      known_state_(system.nq + system.nv),
      known_rate_(n_),
      rate_(n_),
      by_time_(n_),
      applied_(count_),
      laws_(count_),
      A_(nv_ * nv_),
      B_(nv_ * nv_),
      C_(nv_ * nv_),
      D_(nv_ * nv_),
      L_(count_ * n_),
      W_(count_ * nv_),
      S_(nv_ * nv_),
      CS_(nv_ * nv_),
      factors_(nv_ * nv_),
      pivots_(nv_),
      x_(system.nq + system.nv),
      delta_(n_),
      probe_(n_),
      other_(n_),
      work_(n_) {}

void LinearStages::prepare(double t, double h, const double* state,
                           const std::vector<double>& rate,
                           const std::vector<double>& state_scale,
                           const std::vector<double>& laws, const Places& places) {
    const bool lingers = static_cast<bool>(places.by_nodes);
    const bool same = known_ && known_time_ == t && on_branch_ == places.on_branch &&
                      lingers_ == lingers && known_rate_ == rate && known_laws_ == laws &&
                      std::equal(known_state_.begin(), known_state_.end(), state);
    if (!same) {
        known_ = false;
        linearise(t, h, state, state_scale, laws, places);
        known_time_ = t;
        known_rate_ = rate;
        known_laws_ = laws;
        std::copy_n(state, known_state_.size(), known_state_.begin());
        known_ = true;
    }
    factorise(h * gamma_);
}

void LinearStages::linearise(double t, double h, const double* state,
                             const std::vector<double>& state_scale,
                             const std::vector<double>& laws, const Places& places) {
    const int nv = nv_, n = n_, m = count_;
    on_branch_ = places.on_branch;
    lingers_ = static_cast<bool>(places.by_nodes);
    if (!laws.empty()) expect_size("laws", laws.size(), static_cast<std::size_t>(m));
    // The rate of the memory is the one before the last correction, which stiff forces notice.
    system_.apply_laws(laws.empty() ? nullptr : laws.data());
    const bool solved = rate_at(t, state, places, rate_);
    laws_ = laws_there_;
    applied_ = laws.empty() ? laws_ : laws;
    system_.apply_laws(m ? applied_.data() : nullptr);
    std::vector<double> steps(n);
    for (int j = 0; j < n; ++j)
        steps[j] = rounded_down(constants_.difference * std::max(unit_[j], state_scale[j]));
    std::fill(delta_.begin(), delta_.end(), 0.0);
    whole_ = solved || (on_branch_ && !system_.rank_deficient());
    differences_ = 0;
    if (whole_) {
        if (lingers_) widen(state_scale, steps);
        if (!solved) system_.law_accelerations(W_.data());
        along_branch(t, state, steps, solved, places);
        if (solved) by_applied_laws(t, state, places);
    } else if (system_.linearise(t, state, &rate_[nv], steps, C_.data(), D_.data(), W_.data(),
                                 L_.data())) {
        chart_by_coordinates(steps);
    } else {
        system_.law_accelerations(W_.data());
        if (system_.derivatives(state, &rate_[nv], A_.data(), C_.data(), D_.data()))
            by_forces(t, state, steps);
        else
            by_differences(t, state, steps, places);
    }
    for (int j = 0; j < n; ++j) {
        double* const column = whole_   ? &J_[j * n + nv]
                               : j < nv ? &C_[j * nv]
                                        : &D_[(j - nv) * nv];
        for (int k = 0; k < m; ++k)
            if (L_[j * m + k] != 0.0) add(L_[j * m + k], &W_[k * nv], column, nv);
    }
    std::fill(by_time_.begin(), by_time_.end(), 0.0);
    if (!system_.time_dependent()) return;
    const double spacing = std::nextafter(std::abs(t), infinity) - std::abs(t);
    const double tau = rounded_down(
        std::max(constants_.time_difference * h, constants_.shortest_difference * spacing));
    rate_at(t + tau, state, places, probe_);
    rate_at(t + 2.0 * tau, state, places, other_);
    for (int i = 0; i < n; ++i)
        by_time_[i] = (4.0 * (probe_[i] - rate_[i]) - (other_[i] - rate_[i])) / (2.0 * tau);
}

// On the branch at the projection of `state`; whether nodes solved it.
bool LinearStages::rate_at(double t, const double* state, const Places& places,
                           std::vector<double>& out) {
    system_.evaluate(t, state, lingers_ ? System::ZoneView{} : places.zone);
    if (lingers_ && system_.sigma() < constants_.branch_below) {
        if (const StageOnBranch* const stage = places.by_nodes(t, state)) {
            out = stage->rate;
            laws_there_ = stage->laws;
            return true;
        }
        system_.evaluate(t, state, places.zone);
    }
    if (on_branch_ && !system_.rank_deficient()) {
        system_.correction(work_.data());
        for (double& x : work_) x = -x;
        system_.retract(state, work_.data(), x_.data());
        system_.evaluate(t, x_.data(), places.zone);
    }
    system_.rate(out.data());
    laws_there_ = system_.law_values();
    return false;
}

// B, C and D with the laws held, and L, from differences of rates.
void LinearStages::by_differences(double t, const double* state, const std::vector<double>& steps,
                                  const Places& places) {
    const int nv = nv_, n = n_, m = count_;
    differences_ = n;
    for (int j = 0; j < n; ++j) {
        const double step = delta_[j] = steps[j];
        system_.retract(state, delta_.data(), x_.data());
        rate_at(t, x_.data(), places, probe_);
        const bool position = j < nv;
        if (position) {
            system_.chart_rate(delta_.data(), probe_.data(), other_.data());
            for (int i = 0; i < nv; ++i) B_[j * nv + i] = (other_[i] - rate_[i]) / step;
        }
        double* const column = position ? &C_[j * nv] : &D_[(j - nv) * nv];
        for (int i = 0; i < nv; ++i) column[i] = (probe_[nv + i] - rate_[nv + i]) / step;
        for (int k = 0; k < m; ++k) L_[j * m + k] = (laws_there_[k] - laws_[k]) / step;
        delta_[j] = 0.0;
    }
}

// The steps of central differences, over which friction does not change much.
void LinearStages::widen(const std::vector<double>& state_scale, std::vector<double>& steps) const {
    const double slow = system_.friction_sums().empty()
                            ? infinity
                            : constants_.friction_difference * system_.friction_speed();
    for (int j = 0; j < n_; ++j) {
        const double size = constants_.central_difference * std::max(unit_[j], state_scale[j]);
        steps[j] = std::max(steps[j], rounded_down(j < nv_ ? size : std::min(size, slow)));
    }
}

// J with the laws held, and L, along the branch: off it the rates are those of its nearest place, and
// their derivatives along the normals are zero.  Nodes project onto the branch by themselves; where
// the motion lingers differences are central, because nodes round to 1e-13 only.
void LinearStages::along_branch(double t, const double* state, const std::vector<double>& steps,
                                bool solved, const Places& places) {
    const int nv = nv_, n = n_, m = count_;
    J_.resize(static_cast<std::size_t>(n) * n);
    std::vector<double> tangents(static_cast<std::size_t>(nv) * nv, 0.0), normal(nv);
    for (int j = 0; j < nv; ++j) {
        double* const tangent = &tangents[static_cast<std::size_t>(j) * nv];
        tangent[j] = 1.0;
        if (solved) continue;
        system_.normal_part(tangent, normal.data());
        add(-1.0, normal.data(), tangent, nv);
    }
    std::vector<double> delta(n), moved(x_.size());
    // Chart rates in probe_, and laws, at `step` along the direction j.
    const auto probe = [&](int j, double step) {
        const int first = j < nv ? 0 : nv;
        std::fill(delta.begin(), delta.end(), 0.0);
        add(step, &tangents[static_cast<std::size_t>(j - first) * nv], &delta[first], nv);
        system_.retract(state, delta.data(), moved.data());
        rate_at(t, moved.data(), places, probe_);
        system_.chart_rate(delta.data(), probe_.data(), other_.data());
        std::copy_n(other_.begin(), nv, probe_.begin());
    };
    std::vector<double> rate, laws;
    for (int j = 0; j < n; ++j) {
        double* const column = &J_[static_cast<std::size_t>(j) * n];
        double apart = steps[j];
        if (lingers_) {
            probe(j, -apart);
            rate = probe_;
            laws = laws_there_;
        }
        probe(j, apart);
        if (lingers_) apart *= 2.0;
        const std::vector<double>&from = lingers_ ? rate : rate_, &before = lingers_ ? laws : laws_;
        for (int i = 0; i < n; ++i) column[i] = (probe_[i] - from[i]) / apart;
        for (int k = 0; k < m; ++k) L_[j * m + k] = (laws_there_[k] - before[k]) / apart;
    }
}

// W where nodes solve the stage: accelerations are linear in what acts in place of the laws.
void LinearStages::by_applied_laws(double t, const double* state, const Places& places) {
    const double change = std::max(1.0, largest(applied_.data(), count_));
    for (int k = 0; k < count_; ++k) {
        const double own = applied_[k];
        applied_[k] += change;
        rate_at(t, state, places, probe_);
        applied_[k] = own;
        for (int i = 0; i < nv_; ++i)
            W_[k * nv_ + i] = (probe_[nv_ + i] - rate_[nv_ + i]) / change;
    }
}

// The same where A, C and D are known with the forces held.
void LinearStages::by_forces(double t, const double* state, const std::vector<double>& steps) {
    const int nv = nv_, n = n_, m = count_;
    double *const held = probe_.data(), *const forces = other_.data();
    system_.applied_forces(t, state, held);
    std::fill(L_.begin(), L_.end(), 0.0);
    if (system_.separate_forces()) {
        // Each law is that of one coordinate: all positions are moved at once, then all rates.
        for (const int first : {0, nv}) {
            std::copy_n(&steps[first], nv, &delta_[first]);
            system_.retract(state, delta_.data(), x_.data());
            system_.applied_forces(t, x_.data(), forces);
            for (int i = 0; i < nv; ++i) {
                const int k = system_.law_of_coordinate(i), j = first + i;
                if (k >= 0) L_[j * m + k] = (system_.law_values()[k] - laws_[k]) / steps[j];
                delta_[j] = 0.0;
            }
        }
    } else {
        for (int j = 0; j < n; ++j) {
            delta_[j] = steps[j];
            system_.retract(state, delta_.data(), x_.data());
            system_.applied_forces(t, x_.data(), forces);
            delta_[j] = 0.0;
            double* const column = j < nv ? &C_[j * nv] : &D_[(j - nv) * nv];
            for (int i = 0; i < nv; ++i)
                if (forces[i] != held[i])
                    add((forces[i] - held[i]) / steps[j], &A_[i * nv], column, nv);
            for (int k = 0; k < m; ++k)
                L_[j * m + k] = (system_.law_values()[k] - laws_[k]) / steps[j];
        }
    }
    chart_by_coordinates(steps);
}

// B, which is 0 but for joints that need a chart.
void LinearStages::chart_by_coordinates(const std::vector<double>& steps) {
    const int nv = nv_;
    for (const GroupJoint& joint : system_.groups())
        for (int j = joint.start; j < joint.start + joint.size; ++j) {
            delta_[j] = steps[j];
            system_.chart_rate(delta_.data(), rate_.data(), other_.data());
            delta_[j] = 0.0;
            for (int i = 0; i < nv; ++i) B_[j * nv + i] = (other_[i] - rate_[i]) / steps[j];
        }
}

void LinearStages::factorise(double k) {
    const int nv = nv_;
    k_ = k;
    if (whole_) {
        const int n = n_;
        factors_.resize(J_.size());
        pivots_.resize(n);
        for (int j = 0; j < n; ++j) {
            for (int i = 0; i < n; ++i) factors_[j * n + i] = -k * J_[j * n + i];
            factors_[j * n + j] += 1.0;
        }
        if (!lu_factor(factors_.data(), n, pivots_.data()))
            throw EvaluationError{Failure::acceleration};
        return;
    }
    CS_ = C_;
    for (const GroupJoint& joint : system_.groups()) {
        // The inverse of one block, and its product with the columns of C.
        const int size = joint.size, first = joint.start;
        double block[36], inverse[36];
        int pivots[6];
        for (int j = 0; j < size; ++j)
            for (int i = 0; i < size; ++i) {
                block[j * size + i] = (i == j ? 1.0 : 0.0) - k * B_[(first + j) * nv + first + i];
                inverse[j * size + i] = i == j ? 1.0 : 0.0;
            }
        if (!lu_factor(block, size, pivots)) throw EvaluationError{Failure::acceleration};
        for (int j = 0; j < size; ++j) {
            lu_solve(block, size, pivots, &inverse[j * size]);
            std::copy_n(&inverse[j * size], size, &S_[(first + j) * nv + first]);
            double* const column = &CS_[(first + j) * nv];
            std::fill_n(column, nv, 0.0);
            for (int i = 0; i < size; ++i)
                add(inverse[j * size + i], &C_[(first + i) * nv], column, nv);
        }
    }
    for (int j = 0; j < nv; ++j) {
        double* const column = &factors_[j * nv];
        for (int i = 0; i < nv; ++i)
            column[i] = -k * (D_[j * nv + i] + k * CS_[j * nv + i]);
        column[j] += 1.0;
    }
    if (!lu_factor(factors_.data(), nv, pivots_.data()))
        throw EvaluationError{Failure::acceleration};
}

void LinearStages::solve(double* x, const double* laws, const double* applied,
                         double* law_rates) {
    const int nv = nv_, m = count_;
    double* const y = x + nv;
    for (int k = 0; k < m; ++k) add(laws[k] - applied[k], &W_[k * nv], y, nv);
    if (whole_) {
        lu_solve(factors_.data(), n_, pivots_.data(), x);
    } else {
        for (int j = 0; j < nv; ++j)
            if (x[j] != 0.0) add(k_ * x[j], &CS_[j * nv], y, nv);
        lu_solve(factors_.data(), nv, pivots_.data(), y);
        for (int i = 0; i < nv; ++i) x[i] += k_ * y[i];
        for (const GroupJoint& joint : system_.groups()) {
            double out[6] = {};
            for (int j = 0; j < joint.size; ++j)
                add(x[joint.start + j], &S_[(joint.start + j) * nv + joint.start], out, joint.size);
            std::copy_n(out, joint.size, x + joint.start);
        }
    }
    for (int k = 0; k < m; ++k) law_rates[k] = (laws[k] - applied[k]) / k_;
    for (int j = 0; j < n_; ++j) add(x[j], L_.data() + j * m, law_rates, m);
}

void LinearStages::multiply(const std::vector<double>& x, std::vector<double>& out) const {
    const int nv = nv_;
    if (whole_) {
        std::fill(out.begin(), out.end(), 0.0);
        for (int j = 0; j < n_; ++j) add(x[j], &J_[j * n_], out.data(), n_);
        return;
    }
    for (int i = 0; i < nv; ++i) {
        out[i] = x[nv + i];
        out[nv + i] = 0.0;
    }
    for (int j = 0; j < nv; ++j) {
        add(x[j], &B_[j * nv], out.data(), nv);
        add(x[j], &C_[j * nv], &out[nv], nv);
        add(x[nv + j], &D_[j * nv], &out[nv], nv);
    }
}

void LinearStages::jacobian(double* out) const {
    std::vector<double> unit(n_), column(n_);
    for (int j = 0; j < n_; ++j) {
        unit[j] = 1.0;
        multiply(unit, column);
        unit[j] = 0.0;
        std::copy(column.begin(), column.end(), out + static_cast<std::ptrdiff_t>(j) * n_);
    }
}

double LinearStages::stiffness(double h) {
    const int nv = nv_, n = n_, count = constants_.power_iterations;
    const auto scale = [&](int i) { return i < nv ? unit_[i] : unit_[i - nv] / h; };
    const auto size = [&](const std::vector<double>& x) {
        double out = 0.0;
        for (int i = 0; i < n; ++i) out = std::max(out, std::abs(x[i]) / scale(i));
        return out;
    };
    for (int i = 0; i < n; ++i) work_[i] = i % 2 ? -scale(i) : scale(i);
    for (int iteration = 0; iteration < count; ++iteration) {
        if (iteration == count - 2) {
            const double last = size(work_);
            if (!(last > 0.0)) return 0.0;
            for (double& value : work_) value /= last;
        }
        multiply(work_, other_);
        for (int i = 0; i < n; ++i) work_[i] = h * other_[i];
    }
    return std::sqrt(size(work_));
}

}  // namespace srm
