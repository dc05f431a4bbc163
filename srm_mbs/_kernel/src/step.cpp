#include "step.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "errors.hpp"
#include "limits.hpp"
#include "linear.hpp"

namespace srm {

void ButcherTableau::check() const {
    const std::size_t s = b.size();
    if (s == 0) throw std::invalid_argument("b is empty");
    if (gap_centres.empty()) throw std::invalid_argument("gap_centres is empty");
    expect_size("A", A.size(), s * s);
    expect_size("c", c.size(), s);
    if (!error.empty()) expect_size("error", error.size(), s + 1);
    expect_size("gap_half_widths", gap_half_widths.size(), gap_centres.size());
    expect_within("lead", lead, 0, static_cast<long>(s) - 1);
    if (!implicit.empty()) expect_size("implicit", implicit.size(), s * s);
}

void ErrorNorm::check() const {
    expect_size("one", one.size(), atol.size());
    expect_size("unit", unit.size(), atol.size());
}

void IntegratorState::check() const {
    expect_size("state_scale", state_scale.size(), rate.size());
    if (history) expect_size("history.values", 2 * history->nv, rate.size());
}

double ErrorNorm::ratio(const double* error, const double* weights, int n) {
    double sum = 0.0;
    for (int i = 0; i < n; ++i) {
        const double scaled = error[i] / weights[i];
        sum += scaled * scaled;
    }
    return std::sqrt(sum / n);
}

// d0, d1 and d2 are the sizes of the state, of its rate and of the change of that, over the
// tolerance.
double initial_step(System& system, const ErrorNorm& norm, double t, const double* state,
                    const double* rate, const double* state_scale, double span, int order,
                    const Constants& constants, double smooth) {
    smooth = std::min(smooth, span);
    const int n = 2 * system.nv;
    std::vector<double> weights(n), error(n), there(n), probed(n), x(system.nq + system.nv);
    for (int i = 0; i < n; ++i) {
        weights[i] = norm.weight(i, state_scale[i]);
        error[i] = std::max(state_scale[i], norm.one[i]);
    }
    const double d0 = ErrorNorm::ratio(error.data(), weights.data(), n);
    if (!finite(rate, n) || !(largest(rate, n) < constants.rate_overflow))
        throw EvaluationError{Failure::not_finite};
    const double d1 = ErrorNorm::ratio(rate, weights.data(), n);
    if (!std::isfinite(d1)) throw EvaluationError{Failure::not_finite};
    if (!(d1 > 0.0)) return constants.first_step_probe * smooth;
    double h0 = std::min(constants.first_step_probe * d0 / d1, span);
    // Size of the change of the rates over `ahead` (s), with the state moving on or not.
    const auto change = [&](double ahead, double moves) {
        for (int i = 0; i < n; ++i) error[i] = moves * ahead * rate[i];
        system.retract(state, error.data(), x.data());
        system.evaluate(t + ahead, x.data(), System::ZoneView{});
        system.rate(there.data());
        system.chart_rate(error.data(), there.data(), probed.data());
        for (int i = 0; i < n; ++i) probed[i] -= rate[i];
        return ErrorNorm::ratio(probed.data(), weights.data(), n);
    };
    double d2 = change(h0, 1.0) / h0;
    if (!std::isfinite(d2)) throw EvaluationError{Failure::not_finite};
    const double longest = constants.longest_first_step * h0;
    if (h0 == span) {
        // A drive that moves smoothly from rest to rest has the rates of its start at its end.
        for (const double part : {constants.rest_probe_late, constants.rest_probe_early}) {
            const double ahead = part * smooth, changed = change(ahead, 0.0);
            if (changed > constants.rest_ends * d2 * h0) {
                h0 = ahead;
                d2 = changed / ahead;
            }
        }
    }
    if (!(d2 > 0.0)) return std::min(longest, span);
    double tau = d1 / d2, faster = d1;
    if (tau < constants.at_rest * h0 && change(h0, 0.0) > 0.5 * h0 * d2) {
        // The time scale of the change of the rates with time, and the change over it.
        const double shortest = tau, factor = constants.rest_factor;
        for (tau = h0; tau > shortest;) tau /= factor;
        faster = change(tau, 0.0);
        while (tau < h0) {
            const double further = change(factor * tau, 0.0);
            if (tau * faster > constants.first_step_probe && further < faster * std::sqrt(factor))
                break;
            tau *= factor;
            faster = further;
        }
        faster = std::max(faster, constants.first_step_probe / tau);
    }
    const double part = constants.first_step_probe / (tau * faster);
    return std::min({longest, tau * std::pow(part, 1.0 / order), span});
}

IntegratorState first_stage(System& system, double t, const double* state) {
    system.evaluate(t, state, System::ZoneView{});
    const std::size_t nv = static_cast<std::size_t>(system.nv);
    IntegratorState out;
    out.rate.resize(2 * nv);
    out.state_scale.resize(2 * nv);
    system.rate(out.rate.data());
    system.state_scale(state, out.state_scale.data());
    out.sigma = system.sigma();
    if (!system.constrained()) return out;
    std::vector<double> multiplier(nv);
    system.multiplier(multiplier.data());
    out.history.emplace();
    out.history->nv = system.nv;
    out.history->clear();
    out.history->extend(t, multiplier.data(), {}, {});
    return out;
}

SplitStep::SplitStep(System& system, const ButcherTableau& scheme_, const Constants& constants_,
                     const ErrorNorm& norm_)
    : scheme(scheme_),
      norm(norm_),
      constants(constants_),
      system_(system),
      nv_(system.nv),
      n_(2 * system.nv),
      nx_(system.nq + system.nv),
      x_(nx_),
      delta_(n_),
      rate_(n_),
      weights_(n_),
      error_(n_),
      moved_(n_),
      uncertainty_(nv_),
      scratch_(n_),
      noise_(n_) {
    const int s = scheme.stages();
    result.state.resize(nx_);
    result.rates.resize((s + 1) * n_);
    result.end_rate.resize(n_);
    result.correction.resize(system.constrained() ? n_ : 0);
    result.state_scale.resize(n_);
    result.sigmas.resize(s + 1);
    result.multiplier.resize(nv_);
    deficient_stages_.reserve(s + 1);
    apart_.resize(n_);
    if (scheme.implicit.empty()) return;
    const double gamma = scheme.implicit[scheme.lead * (s + 1)];
    linear_ = std::make_unique<LinearStages>(system, gamma, norm.unit, constants);
    linear_weights_.resize(s * s);
    time_shares_.resize(s);
    law_rates_.resize(s * linear_->count());
    law_shares_.resize(linear_->count());
    for (int i = 0; i < s; ++i)
        for (int j = 0; j <= i; ++j) {
            time_shares_[i] += scheme.implicit[i * s + j];
            if (j < i) linear_weights_[i * s + j] = scheme.implicit[i * s + j] / gamma;
        }
}

// The laws of the forces that act in the stage j, or at the end those of the end state itself.
void SplitStep::apply_laws(int j) {
    const int s = scheme.stages(), m = linear_->count();
    applied_ = linear_->applied();
    const double* a = j < s ? &scheme.A[j * s] : scheme.b.data();
    for (int k = scheme.lead; k < j; ++k)
        if (a[k] != 0.0) add(h_ * a[k], law_rates_.data() + k * m, applied_.data(), m);
    system_.apply_laws(j < s && m ? applied_.data() : nullptr);
}

// The rate of the stage j of a linearly implicit scheme, from the chart rate in its place and the
// laws there.
void SplitStep::linear_rate(int j, const std::vector<double>& laws) {
    const int s = scheme.stages(), n = n_, m = linear_->count();
    double *const rate = &result.rates[j * n], *const law_rate = law_rates_.data() + j * m;
    const double* by_time = linear_->by_time().data();
    std::fill(error_.begin(), error_.end(), 0.0);
    std::fill(law_shares_.begin(), law_shares_.end(), 0.0);
    for (int k = scheme.lead; k < j; ++k) {
        const double weight = linear_weights_[j * s + k];
        add(weight, &result.rates[k * n], error_.data(), n);
        add(weight, law_rates_.data() + k * m, law_shares_.data(), m);
    }
    const double share = h_ * time_shares_[j];
    for (int i = 0; i < n; ++i) rate[i] += error_[i] + share * by_time[i];
    linear_->solve(rate, laws.data(), applied_.data(), law_rate);
    for (int i = 0; i < n; ++i) rate[i] -= error_[i];
    for (int k = 0; k < m; ++k) law_rate[k] -= law_shares_[k];
}

// h |lambda|, seen from the last two stages of an explicit step; NaN if they do not differ.
double SplitStep::stiffness() const {
    const int s = scheme.stages(), n = n_;
    const double *last = &result.rates[s * n], *other = last - n;
    double* const change = scratch_.data();
    for (int i = nv_; i < n; ++i) change[i] = last[i] - other[i];
    const double dq = system_.position_norm(apart_.data());
    const double dv = system_.position_norm(&apart_[nv_]);
    if (!(dq > 0.0 && dv > 0.0)) return not_a_number;
    const double da = system_.position_norm(change + nv_);
    return h_ * std::min(da / dv, std::sqrt(da / dq));
}

// Whether the derivative of a rate with friction varies over the step by more than what would stop
// it within the step, and by more than the tolerance: stages take its sign at random.
bool SplitStep::chatters(const IntegratorState& memory) const {
    const int s = scheme.stages(), n = n_;
    for (const FrictionSum& sum : system_.friction_sums()) {
        double tolerance = 0.0;
        for (std::size_t k = 0; k < sum.columns.size(); ++k) {
            const int i = sum.columns[k];
            tolerance +=
                std::abs(sum.coefficients[k]) * norm.weight(nv_ + i, std::abs(memory.rate[i]));
        }
        const double least = std::max({std::abs(sum.of(memory.rate.data())),
                                       std::abs(sum.of(result.end_rate.data())), tolerance}) / h_;
        double low = sum.of(&result.rates[nv_]), high = low;
        for (int j = 1; j <= s; ++j) {
            const double there = sum.of(&result.rates[j * n + nv_]);
            low = std::min(low, there);
            high = std::max(high, there);
        }
        if (high - low > least) return true;
    }
    return false;
}

// Errors of the rates of coordinates on which friction acts that changes its sign within the step:
// reversal_error in methods/stiffness.py.
void SplitStep::add_reversal_errors(const IntegratorState& memory) {
    for (const FrictionSum& sum : system_.friction_sums()) {
        const double before = sum.of(memory.rate.data()), after = sum.of(result.end_rate.data());
        const double resolved = constants.unresolved * system_.friction_speed();
        if (!(before * after < 0.0 && std::abs(after - before) > resolved)) continue;
        for (const int column : sum.columns) {
            const int i = nv_ + column;
            const double jump = std::abs(result.end_rate[i] - memory.rate[i]);
            error_[i] = std::max(error_[i], constants.reversal_share * h_ * jump);
        }
    }
}

// Takes the step into account, which was accepted: methods/stiffness.py.
void SplitStep::count_stiffness(IntegratorState& memory) {
    if (!linear_) {
        if (memory.stiff || !(scheme.stable_to > 0.0) || norm.negligible == 0.0) return;
        // Steps along the curve of closed configurations have no stages.
        const bool shows = !monitored_ && !result.critical;
        if (shows && (stiffness() > scheme.stable_to || chatters(memory))) {
            ++memory.stiff_steps;
            memory.other_steps = 0;
        } else if (memory.stiff_steps && ++memory.other_steps == constants.other_steps) {
            memory.stiff_steps = memory.other_steps = 0;
        }
        if (memory.stiff_steps < std::max(memory.needed_steps, constants.stiff_steps)) return;
        memory.stiff = true;
        memory.stiff_steps = memory.other_steps = 0;
        memory.saved_steps = 0.0;
    } else if (memory.stiff) {
        const double cost = linear_->cost(scheme.stages() - scheme.lead);
        const double size = chatters(memory) ? infinity : linear_->stiffness(h_);
        const double share = size / (constants.not_stiff * cost);
        memory.saved_steps += share - 1.0;
        memory.stiff_steps = share < 1.0 ? memory.stiff_steps + 1 : 0;
        const int least = constants.stiff_steps;
        if (memory.stiff_steps < std::max(constants.dear_steps + std::log2(cost), least / cost))
            return;
        memory.stiff = false;
        memory.stiff_steps = 0;
        const bool paid = memory.saved_steps > 0.0 || size < constants.not_stiff;
        memory.needed_steps = paid ? least : 2 * std::max(memory.needed_steps, least);
    }
}

// Error of h times the tangent rate at a stage that lies off the closures by `error` (n,).
void SplitStep::rate_error(const double* error, double sigma, double change, double* out) const {
    const double reach = change / sigma;
    for (int i = 0; i < nv_; ++i) {
        out[i] = 0.0;
        out[nv_ + i] =
            2.0 * reach * std::abs(error[nv_ + i]) + (reach * reach / h_) * std::abs(error[i]);
    }
}

// The same of a stage that lies off them by rounding.  Projected positions are known to
// position_rounding / sigma.
void SplitStep::rounding_error(double sigma, double change, bool projected, double* out) const {
    const double rounding = constants.position_rounding;
    const double part = projected ? rounding / sigma : rounding;
    double* error = scratch_.data();
    for (int i = 0; i < nv_; ++i) {
        error[i] = part * norm.one[i];
        error[nv_ + i] = change / (h_ * sigma) * error[i];
    }
    rate_error(error, sigma, change, out);
}

// sigma from which the direct solve errs by less than `allowed` tolerances; at most zone_largest.
double SplitStep::direct_from(const IntegratorState& memory, double sigma_change,
                              double allowed) const {
    if (norm.negligible == 0.0) return constants.zone_largest;
    rounding_error(1.0, sigma_change, false, noise_.data());
    for (int i = nv_; i < n_; ++i)
        noise_[i] += h_ * constants.position_rounding * std::abs(memory.rate[i]);
    return std::min(constants.zone_largest,
                    std::sqrt(ErrorNorm::ratio(noise_.data(), weights_.data(), n_) / allowed));
}

// Error of the multiplier predicted for `end`, over the tolerance; 0 with too few nodes.
double SplitStep::prediction_error(const MultiplierHistory& history, double end) {
    if (history.size() < constants.min_history) return 0.0;
    history.uncertainty(end, uncertainty_.data());
    std::fill(noise_.begin(), noise_.begin() + nv_, 0.0);
    for (int i = 0; i < nv_; ++i) noise_[nv_ + i] = h_ * uncertainty_[i];
    return ErrorNorm::ratio(noise_.data(), weights_.data(), n_);
}

// Whether the motion is so slow that it may be held tangential to the last normals: at `threshold`
// that errs by |a| threshold + v^2.
bool SplitStep::holding_suffices(const IntegratorState& memory, double threshold) const {
    if (memory.history->normals.empty()) return false;
    const double speed = system_.position_norm(memory.rate.data());
    double* error = scratch_.data();
    for (int i = 0; i < nv_; ++i) {
        error[i] = 0.0;
        error[nv_ + i] = h_ * (threshold * std::abs(memory.rate[nv_ + i]) +
                               speed * std::abs(memory.rate[i]));
    }
    return ErrorNorm::ratio(error, weights_.data(), n_) < constants.held_tolerance;
}

void SplitStep::prepare_branch(const IntegratorState& memory, double end, double sigma_change) {
    // All stages of a step are projected or none: a mixture of both loses the order.
    const double reach =
        sigma_change > 0.0 ? constants.near_steps * sigma_change : constants.monitored_below;
    branch_.near = memory.sigma < reach || lingers_;
    branch_.projected = false;
    branch_.inaccurate_below = 0.0;
    const MultiplierHistory& history = *memory.history;
    double threshold = constants.zone_largest;
    bool holds = false;
    if (memory.sigma < constants.monitored_below + constants.near_steps * sigma_change) {
        threshold = direct_from(memory, sigma_change, 1.0);
        holds = threshold < constants.zone_largest && holding_suffices(memory, threshold);
        // The tolerance alone sets the width of the zone.  The accuracy that its predictions and
        // projections need is limited by rounding: the weights grow only after that.
        if (!lingers_) add_floor(memory, sigma_change);
        const double error = prediction_error(history, end);
        if (error > 1.0 && !holds) {
            // A prediction that errs by more than the tolerance is no better than a direct solve
            // that errs as much.
            branch_.inaccurate_below = threshold;
            threshold = direct_from(memory, sigma_change, error);
        }
    }
    branch_.zone = System::ZoneView{};
    if (!history.begun()) return;
    const double known = end <= history.known_until ? history.known_below : 0.0;
    double limit = threshold;
    if (history.size() < constants.min_history) limit = std::min(limit, constants.direct_hit);
    branch_.zone.threshold = std::max(limit, known);
    branch_.zone.history = &history;
    branch_.zone.predicts = !holds;
}

// Solves the stage x_, evaluated last, by nodes of its branch; whether they were found.
bool SplitStep::solve_on_branch(double t, double start, const double* state,
                                const IntegratorState& memory) {
    if (result.lost_branch) return false;
    if (!nodes_) nodes_.emplace(system_, constants, norm.singular);
    bool found = true, known = true;
    if (away_.empty()) {
        away_ = memory.history->away;
        known = !away_.empty();
        if (!known) nodes_->find_direction(start, state, away_);
        touches_ = away_.size() > static_cast<std::size_t>(nv_);
        if (touches_ && !linear_) {
            if (!touching_) touching_.emplace(system_, constants);
            found = touching_->prepare(start, state, away_);
        }
        if (touches_ || !known) system_.evaluate(t, x_.data(), System::ZoneView{});
    }
    // Linearly implicit steps have no nodes where branches touch.
    if (away_.empty() || !found || (touches_ && linear_))
        found = false;
    else if (touches_)
        found = touching_->solve(t, x_.data(), *nodes_);
    else
        found = nodes_->solve(t, x_.data(), away_);
    if (!found && !known) {
        // From a start far away, or past a bend, the motion itself leads along its branch.
        std::vector<double> w(x_.end() - nv_, x_.end());
        touches_ = false;
        if (nodes_->spaced(t, x_.data(), w, away_)) {
            system_.evaluate(t, x_.data(), System::ZoneView{});
            found = nodes_->solve(t, x_.data(), away_);
        }
    }
    result.lost_branch = !found;
    return found;
}

// Evaluates the stage x_ at its projection on its branch, by Newton steps that are taken as long as
// they change more than rounding and a negligible part of the tolerance; whether x_ was moved.
bool SplitStep::project_stage(double t, double c, const IntegratorState& memory,
                              double sigma_change) {
    bool moved = false;
    const double change = std::max(sigma_change, std::abs(system_.sigma() - memory.sigma) / c);
    for (int i = 0; i < constants.max_projections; ++i) {
        const double sigma = system_.sigma();
        if (system_.rank_deficient() || !(sigma > 0.0)) break;
        system_.correction(error_.data());
        if (system_.position_norm(error_.data()) > constants.ambiguous_offset * sigma) break;
        rate_error(error_.data(), sigma, change, noise_.data());
        const double effect = ErrorNorm::ratio(noise_.data(), weights_.data(), n_);
        if (effect <= norm.negligible) break;
        rounding_error(sigma, change, true, noise_.data());
        if (effect <= ErrorNorm::ratio(noise_.data(), weights_.data(), n_)) break;
        if (!moved) std::fill(moved_.begin(), moved_.end(), 0.0);
        add(1.0, error_.data(), moved_.data(), n_);
        moved = true;
        for (int k = 0; k < n_; ++k) delta_[k] = -error_[k];
        system_.retract(x_.data(), delta_.data(), x_.data());
        system_.evaluate(t, x_.data(), branch_.zone);
        branch_.projected = true;
    }
    return moved;
}

// Adds to the weights the error that rounding leaves in a step of this length that crosses a
// singular configuration.
void SplitStep::add_floor(const IntegratorState& memory, double sigma_change) {
    const double near = std::min(constants.monitored_below, constants.lead_steps * sigma_change);
    if (!(memory.sigma < near && norm.negligible > 0.0)) return;
    rounding_error(constants.crossing_sigma * sigma_change, sigma_change, true, noise_.data());
    for (int i = 0; i < n_; ++i)
        weights_[i] += std::min(constants.usual_rounding * noise_[i],
                                constants.largest_rounding_floor * norm.one[i]);
}

// Adds to the weights the effect of rounding on the error estimate.
void SplitStep::add_rounding(double sigma_change) {
    // Below the threshold of the zone no multiplier is solved for directly.
    double least = branch_.zone.history ? branch_.zone.threshold : 0.0;
    if (noded_) least = std::max(least, constants.branch_below);
    double lowest = infinity;
    for (int j = 1; j <= scheme.stages(); ++j)
        if (result.sigmas[j] >= least) lowest = std::min(lowest, result.sigmas[j]);
    lowest = std::max(lowest, branch_.inaccurate_below);
    if (scheme.error.empty() ||
        !(0.0 < lowest && lowest < constants.near_steps * sigma_change))
        return;
    rounding_error(lowest, sigma_change, branch_.projected, noise_.data());
    const double weight = largest(scheme.error.data(), scheme.stages() + 1);
    add(weight, noise_.data(), weights_.data(), n_);
}

const StepResult& SplitStep::make(double t, double h, const double* state,
                                  const IntegratorState& memory, double theta) {
    StepResult& r = result;
    const bool constrained = memory.history.has_value();
    const double sigma_change = h * memory.sigma_slope;
    h_ = h;
    monitored_ = constrained && memory.sigma < constants.monitored_below +
                                                   constants.far_steps * sigma_change;
    lingers_ = monitored_ && memory.lingering && theta == 1.0;
    r.stiff = memory.stiff;
    if (monitored_) {
        for (int i = 0; i < n_; ++i) weights_[i] = norm.weight(i, memory.state_scale[i]);
        prepare_branch(memory, t + h, sigma_change);
    }
    r.residual = 0.0;
    r.critical = false;
    evaluate_stages(t, state, memory, sigma_change);
    system_.state_scale(x_.data(), r.state_scale.data());
    const double sigma = r.sigmas[scheme.stages()];
    finish(theta, constrained);
    const double change = std::abs(sigma - memory.sigma);
    r.quiet = !monitored_ && sigma > constants.monitored_below + constants.far_steps * change;
    const bool due = memory.steps < constants.residual_interval ||
                     memory.steps % constants.residual_interval == 0;
    if (due && constrained && theta == 1.0 && !noded_end_) r.residual = system_.closure_residual();
    r.t = t;
    r.h = h;
    estimate_error(memory, sigma_change);
    r.rank = std::min(r.rank, system_.rank());
    r.in_zone = !deficient_stages_.empty() && monitored_ && branch_.zone.history != nullptr;
    r.zone_threshold = monitored_ ? branch_.zone.threshold : 0.0;
    return r;
}

// The stages and the uncorrected end: states in x_, tangent rates in rate_, chart rates in the
// result.
void SplitStep::evaluate_stages(double t, const double* state, const IntegratorState& memory,
                                double sigma_change) {
    const int s = scheme.stages(), n = n_;
    StepResult& r = result;
    const System::ZoneView none;
    std::copy(memory.rate.begin(), memory.rate.end(), r.rates.begin());
    r.sigmas[0] = memory.sigma;
    // While it lives, the system finds the laws of forces.
    struct Tracking {
        System* system;
        explicit Tracking(System* tracked) : system(tracked) {
            if (system) system->track_laws(true);
        }
        ~Tracking() {
            if (system) system->track_laws(false);
        }
    };
    const Tracking tracking(linear_ ? &system_ : nullptr);
    noded_ = noded_end_ = r.lost_branch = false;
    if (lingers_) away_.clear();
    if (linear_) {
        LinearStages::Places places;
        if (monitored_) places = {branch_.zone, branch_.near, {}};
        if (lingers_)
            places.by_nodes = [&](double time, const double* x) -> const StageOnBranch* {
                std::copy_n(x, nx_, x_.begin());
                return solve_on_branch(time, t, state, memory) ? &*nodes_ : nullptr;
            };
        linear_->prepare(t, h_, state, memory.rate, memory.state_scale, memory.laws, places);
        for (int j = 0; j <= scheme.lead; ++j) {
            std::copy_n(linear_->rate().begin(), n, &r.rates[j * n]);
            r.sigmas[j] = memory.sigma;
        }
        applied_ = linear_->applied();
        linear_rate(scheme.lead, linear_->laws());
    }
    deficient_stages_.clear();
    r.rank = std::numeric_limits<int>::max();
    r.held = false;
    moved_end_ = false;
    for (int j = scheme.lead + 1; j <= s; ++j) {
        const bool end = j == s;
        const double* a = end ? scheme.b.data() : &scheme.A[j * s];
        combine(h_, a, j, r.rates.data(), n, delta_.data());
        if (j == s - 1) apart_ = delta_;
        if (end)
            for (int i = 0; i < n; ++i) apart_[i] = delta_[i] - apart_[i];
        system_.retract(state, delta_.data(), x_.data());
        if (linear_) apply_laws(j);
        const double fraction = end ? 1.0 : scheme.c[j];
        const double time = t + fraction * h_;
        system_.evaluate(time, x_.data(), monitored_ && !lingers_ ? branch_.zone : none);
        r.sigmas[j] = system_.sigma();
        if (lingers_ && r.sigmas[j] < constants.branch_below) {
            if (solve_on_branch(time, t, state, memory)) {
                noded_ = true;
                noded_end_ = end;
                x_ = nodes_->state;
                rate_ = nodes_->rate;
                system_.chart_rate(delta_.data(), rate_.data(), &r.rates[j * n]);
                if (linear_ && !end) linear_rate(j, nodes_->laws);
                continue;
            }
            system_.evaluate(time, x_.data(), branch_.zone);
        }
        if (monitored_ && branch_.near && fraction > 0.0) {
            // The chart of the rates is that of the stage before it is projected.
            std::copy(delta_.begin(), delta_.end(), rate_.begin());
            const bool moved = project_stage(time, fraction, memory, sigma_change);
            if (end) moved_end_ = moved;
            std::copy(rate_.begin(), rate_.end(), delta_.begin());
        }
        system_.rate(rate_.data());
        system_.chart_rate(delta_.data(), rate_.data(), &r.rates[j * n]);
        if (linear_ && !end) linear_rate(j, system_.law_values());
        if (system_.rank_deficient()) {
            r.rank = std::min(r.rank, system_.rank());
            deficient_stages_.push_back(j);
            r.held = r.held || system_.held();
        }
    }
}

// The end from the last stage: its correction, and what the history of multipliers takes from it.
void SplitStep::finish(double theta, bool constrained) {
    StepResult& r = result;
    const double sigma = r.sigmas[scheme.stages()];
    r.has_multiplier = false;
    r.away.clear();
    if (!constrained) {
        std::copy(x_.begin(), x_.end(), r.state.begin());
        std::copy(rate_.begin(), rate_.end(), r.end_rate.begin());
        return;
    }
    if (noded_end_) {
        r.state = nodes_->state;
        r.end_rate = nodes_->rate;
        r.correction = nodes_->moved;
        r.multiplier = nodes_->multiplier;
        r.away = nodes_->away;
        r.has_multiplier = true;
        r.normals.clear();
        return;
    }
    const bool rank_deficient = system_.rank_deficient();
    system_.correction(r.correction.data());
    for (int i = 0; i < n_; ++i) {
        r.correction[i] *= theta;
        delta_[i] = -r.correction[i];
    }
    system_.retract(x_.data(), delta_.data(), r.state.data());
    for (int i = 0; i < nv_; ++i) {
        r.end_rate[i] = rate_[i] - r.correction[nv_ + i];
        r.end_rate[nv_ + i] = rate_[nv_ + i];
    }
    if (!rank_deficient && (monitored_ || sigma < constants.monitored_below)) {
        system_.multiplier(r.multiplier.data());
        r.has_multiplier = true;
    }
    if (!rank_deficient && sigma < constants.monitored_below)
        system_.normals(r.normals);
    else
        r.normals.clear();
    if (moved_end_) add(1.0, moved_.data(), r.correction.data(), n_);
}

// The error ratio of the embedded pair.
void SplitStep::estimate_error(const IntegratorState& memory, double sigma_change) {
    StepResult& r = result;
    r.error_ratio = 0.0;
    if (scheme.error.empty()) return;
    const int s = scheme.stages(), n = n_;
    combine(1.0, scheme.error.data(), s + 1, r.rates.data(), n, error_.data());
    for (int i = 0; i < n; ++i) {
        error_[i] = h_ * std::abs(error_[i]);
        weights_[i] = norm.weight(i, std::max(memory.state_scale[i], r.state_scale[i]));
    }
    // stopping_tolerance in methods/stiffness.py.
    for (const FrictionSum& sum : system_.friction_sums())
        for (const int column : sum.columns) {
            const int at = nv_ + column;
            const double most = std::max(norm.atol[at], norm.rtol * norm.unit[at]);
            weights_[at] = std::min(weights_[at], most);
        }
    add_reversal_errors(memory);
    if (linear_)
        for (const FrictionSum& sum : system_.friction_sums()) {
            const double size = system_.friction_tolerance(sum.of(r.end_rate.data()));
            for (std::size_t k = 0; k < sum.columns.size(); ++k) {
                double& weight = weights_[nv_ + sum.columns[k]];
                weight = std::min(weight, size / std::abs(sum.coefficients[k]));
            }
        }
    if (monitored_) {
        // Counted always, the uncertainty of the predicted multiplier would shorten the steps next
        // to the singular configuration for ever.
        if (sigma_change > constants.count_uncertainty_above) {
            for (int j : deficient_stages_) {
                if (j >= s) continue;
                memory.history->uncertainty(r.t + scheme.c[j] * h_, uncertainty_.data());
                for (int i = 0; i < nv_; ++i)
                    error_[nv_ + i] += h_ * std::abs(scheme.b[j]) * uncertainty_[i];
            }
        }
        if (!lingers_) add_floor(memory, sigma_change);
        add_rounding(sigma_change);
    }
    r.error_ratio = ErrorNorm::ratio(error_.data(), weights_.data(), n);
}

void SplitStep::accept(IntegratorState& memory) {
    const StepResult& r = result;
    ++memory.steps;
    count_stiffness(memory);
    if (linear_)
        memory.laws = applied_;
    else
        memory.laws.clear();
    memory.rate.swap(result.end_rate);
    result.end_rate = memory.rate;  // equal sizes: copies without allocating
    memory.sigma = r.sigmas[scheme.stages()];
    std::copy(r.state_scale.begin(), r.state_scale.end(), memory.state_scale.begin());
    if (!memory.history) return;
    if (r.has_multiplier)
        memory.history->extend(r.t + r.h, r.multiplier.data(), std::move(result.normals), r.away);
    else if (!r.in_zone && memory.history->begun())
        memory.history->clear();
}

}  // namespace srm
