#include "step.hpp"

#include <cmath>
#include <limits>

#include "errors.hpp"
#include "linear.hpp"

namespace srm {

double ErrorNorm::ratio(const double* error, const double* weights, int n) {
    double sum = 0.0;
    for (int i = 0; i < n; ++i) {
        const double scaled = error[i] / weights[i];
        sum += scaled * scaled;
    }
    return std::sqrt(sum / n);
}

double initial_step(System& system, const ErrorNorm& norm, double t, const double* state,
                    const double* rate, const double* magnitude, double span, int order,
                    const FirstStepConstants& constants) {
    const int n = 2 * system.nv;
    std::vector<double> weights(n), error(n), there(n), probed(n), x(system.nq + system.nv);
    for (int i = 0; i < n; ++i) {
        weights[i] = norm.weight(i, magnitude[i]);
        error[i] = std::max(magnitude[i], norm.one[i]);
    }
    const double d0 = ErrorNorm::ratio(error.data(), weights.data(), n);
    if (!finite(rate, n) || !(largest(rate, n) < constants.overflow))
        throw EvaluationError{Failure::not_finite};
    const double d1 = ErrorNorm::ratio(rate, weights.data(), n);
    if (!(d1 > 0.0)) return constants.probe * span;
    const double h0 = std::min(constants.probe * d0 / d1, span);
    for (int i = 0; i < n; ++i) error[i] = h0 * rate[i];
    system.retract(state, error.data(), x.data());
    system.evaluate(t + h0, x.data(), System::ZoneView{});
    system.rate(there.data());
    system.chart_rate(error.data(), there.data(), probed.data());
    for (int i = 0; i < n; ++i) probed[i] -= rate[i];
    const double d2 = ErrorNorm::ratio(probed.data(), weights.data(), n) / h0;
    const double longest = constants.longest * h0;
    if (!(d2 > 0.0)) return std::min(longest, span);
    const double tau = d1 / d2;
    return std::min({longest, tau * std::pow(constants.probe / (tau * d1), 1.0 / order), span});
}

SplitStep::SplitStep(System& system, Scheme scheme_, StepConstants constants_, ErrorNorm norm_)
    : scheme(std::move(scheme_)),
      norm(std::move(norm_)),
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
    const int s = scheme.stages;
    result.state.resize(nx_);
    result.rates.resize((s + 1) * n_);
    result.end_rate.resize(n_);
    result.correction.resize(system.constrained() ? n_ : 0);
    result.magnitude.resize(n_);
    result.sigmas.resize(s + 1);
    result.multiplier.resize(nv_);
    weak_stages_.reserve(s + 1);
}

// Change of h times the tangent rate by the normal `error` (n,) of a stage.
void SplitStep::turning(const double* error, double sigma, double change, double* out) const {
    const double reach = change / sigma;
    for (int i = 0; i < nv_; ++i) {
        out[i] = 0.0;
        out[nv_ + i] =
            2.0 * reach * std::abs(error[nv_ + i]) + (reach * reach / h_) * std::abs(error[i]);
    }
}

// What rounding at a stage with `sigma` does to h times the tangent rate.
void SplitStep::rounding(double sigma, double change, bool projected,
                         double* out) const {
    const double part = projected ? constants.rounding / sigma : constants.rounding;
    double* error = scratch_.data();
    for (int i = 0; i < nv_; ++i) {
        error[i] = part * norm.one[i];
        error[nv_ + i] = change / (h_ * sigma) * error[i];
    }
    turning(error, sigma, change, out);
}

// sigma from which the direct solve errs by less than `allowed` tolerances; at most zone_largest.
double SplitStep::known_from(const Memory& memory, double sigma_change, double allowed) const {
    if (norm.negligible == 0.0) return constants.zone_largest;
    rounding(1.0, sigma_change, false, noise_.data());
    for (int i = nv_; i < n_; ++i)
        noise_[i] += h_ * constants.rounding * std::abs(memory.rate[i]);
    return std::min(constants.zone_largest,
                    std::sqrt(ErrorNorm::ratio(noise_.data(), weights_.data(), n_) / allowed));
}

// How far the multiplier predicted for `end` may be off, over the tolerance.
double SplitStep::uncertainty(const History& history, double end) {
    if (history.size < constants.fewest) return 0.0;
    history.uncertainty(end, uncertainty_.data());
    std::fill(noise_.begin(), noise_.begin() + nv_, 0.0);
    for (int i = 0; i < nv_; ++i) noise_[nv_ + i] = h_ * uncertainty_[i];
    return ErrorNorm::ratio(noise_.data(), weights_.data(), n_);
}

bool SplitStep::lingers(const Memory& memory, double threshold) const {
    if (memory.history.normal_count == 0) return false;
    const double speed = system_.size(memory.rate.data());
    double* error = scratch_.data();
    for (int i = 0; i < nv_; ++i) {
        error[i] = 0.0;
        error[nv_ + i] = h_ * (threshold * std::abs(memory.rate[nv_ + i]) +
                               speed * std::abs(memory.rate[i]));
    }
    return ErrorNorm::ratio(error, weights_.data(), n_) < constants.held;
}

void SplitStep::prepare_branch(const Memory& memory, double end, double sigma_change) {
    // All stages of a step or none: a mixture of both loses the order.
    const double reach = sigma_change > 0.0 ? constants.near * sigma_change : constants.watched;
    branch_.near = memory.sigma < reach;
    branch_.projected = false;
    branch_.excused = 0.0;
    const History& history = memory.history;
    double threshold = constants.zone_largest;
    bool lingering = false;
    if (memory.sigma < constants.watched + constants.near * sigma_change) {
        threshold = known_from(memory, sigma_change, 1.0);
        lingering = threshold < constants.zone_largest && lingers(memory, threshold);
        // The zone is as wide as the tolerance asks for; how good its predictions and projections
        // have to be follows from what can be had.
        add_floor(memory, sigma_change);
        const double uncertain = uncertainty(history, end);
        if (uncertain > 1.0 && !lingering) {
            // A prediction that errs by more than the tolerance is no better than a direct solve
            // that does.
            branch_.excused = threshold;
            threshold = known_from(memory, sigma_change, uncertain);
        }
    }
    branch_.zone = System::ZoneView{};
    if (!history.begun()) return;
    const double known = end <= history.known_until ? history.known_below : 0.0;
    double limit = threshold;
    if (history.size < constants.fewest) limit = std::min(limit, constants.hit);
    branch_.zone.threshold = std::max(limit, known);
    branch_.zone.history = &history;
    branch_.zone.normals = &history.normals;
    branch_.zone.normal_count = history.normal_count;
    branch_.zone.predicts = !lingering;
}

// Evaluates the stage x_ at its projection on its branch; whether x_ was moved.
bool SplitStep::onto_branch(double t, double c, const Memory& memory, double sigma_change) {
    bool moved = false;
    const double change = std::max(sigma_change, std::abs(system_.sigma() - memory.sigma) / c);
    for (int i = 0; i < constants.projections; ++i) {
        const double sigma = system_.sigma();
        if (system_.weak() || !(sigma > 0.0) || !branch_.near) break;
        system_.correction(error_.data());
        if (system_.size(error_.data()) > constants.ambiguous * sigma) break;
        turning(error_.data(), sigma, change, noise_.data());
        const double effect = ErrorNorm::ratio(noise_.data(), weights_.data(), n_);
        if (effect <= norm.negligible) break;
        rounding(sigma, change, true, noise_.data());
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
void SplitStep::add_floor(const Memory& memory, double sigma_change) {
    const double near = std::min(constants.watched, constants.lead * sigma_change);
    if (!(memory.sigma < near && norm.negligible > 0.0)) return;
    rounding(constants.crosses * sigma_change, sigma_change, true, noise_.data());
    for (int i = 0; i < n_; ++i)
        weights_[i] += std::min(constants.usual * noise_[i], constants.most_floor * norm.one[i]);
}

// Adds to the weights what rounding does to the error estimate.
void SplitStep::widen(double sigma_change) {
    // Below the threshold of the zone nothing is solved for directly.
    const double least = branch_.zone.history ? branch_.zone.threshold : 0.0;
    double lowest = std::numeric_limits<double>::infinity();
    for (int j = 1; j <= scheme.stages; ++j)
        if (result.sigmas[j] >= least) lowest = std::min(lowest, result.sigmas[j]);
    lowest = std::max(lowest, branch_.excused);
    if (scheme.error.empty() || !(0.0 < lowest && lowest < constants.near * sigma_change)) return;
    rounding(lowest, sigma_change, branch_.projected, noise_.data());
    const double weight = largest(scheme.error.data(), scheme.stages + 1);
    add(weight, noise_.data(), weights_.data(), n_);
}

const StepResult& SplitStep::make(double t, double h, const double* state, const Memory& memory,
                                  double theta) {
    const int s = scheme.stages, n = n_;
    StepResult& r = result;
    const bool constrained = memory.has_history;
    const double sigma_change = h * memory.sigma_slope;
    h_ = h;
    bool watched = false;
    System::ZoneView none;
    if (constrained && memory.sigma < constants.watched + constants.far * sigma_change) {
        watched = true;
        for (int i = 0; i < n; ++i) weights_[i] = norm.weight(i, memory.magnitude[i]);
        prepare_branch(memory, t + h, sigma_change);
    }
    std::copy(memory.rate.begin(), memory.rate.end(), r.rates.begin());
    r.sigmas[0] = memory.sigma;
    weak_stages_.clear();
    r.rank = std::numeric_limits<int>::max();
    r.held = false;
    bool moved = false;
    for (int j = 1; j <= s; ++j) {
        const bool end = j == s;
        const double* a = end ? scheme.b.data() : &scheme.A[j * s];
        std::fill(delta_.begin(), delta_.end(), 0.0);
        for (int k = 0; k < j; ++k)
            if (a[k] != 0.0) add(h * a[k], &r.rates[k * n], delta_.data(), n);
        system_.retract(state, delta_.data(), x_.data());
        const double fraction = end ? 1.0 : scheme.c[j];
        const double time = t + fraction * h;
        system_.evaluate(time, x_.data(), watched ? branch_.zone : none);
        r.sigmas[j] = system_.sigma();
        moved = false;
        if (watched && branch_.near && fraction > 0.0) {
            std::copy(delta_.begin(), delta_.end(), rate_.begin());  // the chart is at the stage
            moved = onto_branch(time, fraction, memory, sigma_change);
            std::copy(rate_.begin(), rate_.end(), delta_.begin());
        }
        system_.rate(rate_.data());
        system_.chart_rate(delta_.data(), rate_.data(), &r.rates[j * n]);
        if (system_.weak()) {
            r.rank = std::min(r.rank, system_.rank());
            weak_stages_.push_back(j);
            r.held = r.held || system_.held();
        }
    }
    system_.magnitudes(x_.data(), r.magnitude.data());
    const double sigma = system_.sigma();
    const bool weak = system_.weak();
    r.has_normals = r.has_multiplier = false;
    r.normal_count = 0;
    if (constrained) {
        system_.correction(r.correction.data());
        for (int i = 0; i < n; ++i) {
            r.correction[i] *= theta;
            delta_[i] = -r.correction[i];
        }
        system_.retract(x_.data(), delta_.data(), r.state.data());
        for (int i = 0; i < nv_; ++i) {
            r.end_rate[i] = rate_[i] - r.correction[nv_ + i];
            r.end_rate[nv_ + i] = rate_[nv_ + i];
        }
        if (!weak && (watched || sigma < constants.watched)) {
            system_.multiplier(r.multiplier.data());
            r.has_multiplier = true;
            if (sigma < constants.watched) {
                system_.normals(r.normals, r.normal_count);
                r.has_normals = r.normal_count > 0;
            }
        }
        if (moved) add(1.0, moved_.data(), r.correction.data(), n);
    } else {
        std::copy(x_.begin(), x_.end(), r.state.begin());
        std::copy(rate_.begin(), rate_.end(), r.end_rate.begin());
    }
    const double change = std::abs(sigma - memory.sigma);
    r.quiet = !watched && sigma > constants.watched + constants.far * change;
    r.gap = 0.0;
    const bool due = memory.steps < constants.gap_every || memory.steps % constants.gap_every == 0;
    if (due && constrained && theta == 1.0) r.gap = system_.gap();
    r.error_ratio = 0.0;
    if (!scheme.error.empty()) {
        std::fill(error_.begin(), error_.end(), 0.0);
        for (int k = 0; k <= s; ++k)
            if (scheme.error[k] != 0.0)
                add(scheme.error[k], &r.rates[k * n], error_.data(), n);
        for (int i = 0; i < n; ++i) {
            error_[i] = h * std::abs(error_[i]);
            weights_[i] = norm.weight(i, std::max(memory.magnitude[i], r.magnitude[i]));
        }
        if (watched) {
            if (sigma_change > constants.count_uncertainty_above) {
                for (int j : weak_stages_) {
                    if (j >= s) continue;
                    memory.history.uncertainty(t + scheme.c[j] * h, uncertainty_.data());
                    for (int i = 0; i < nv_; ++i)
                        error_[nv_ + i] += h * std::abs(scheme.b[j]) * uncertainty_[i];
                }
            }
            add_floor(memory, sigma_change);
            widen(sigma_change);
        }
        r.error_ratio = ErrorNorm::ratio(error_.data(), weights_.data(), n);
    }
    r.t = t;
    r.h = h;
    r.rank = std::min(r.rank, system_.rank());
    r.in_zone = !weak_stages_.empty() && watched && branch_.zone.history != nullptr;
    r.zone_threshold = watched ? branch_.zone.threshold : 0.0;
    return r;
}

void SplitStep::accept(Memory& memory) {
    const StepResult& r = result;
    ++memory.steps;
    memory.rate.swap(result.end_rate);
    result.end_rate = memory.rate;  // equal sizes: copies without allocating
    memory.sigma = r.sigmas[scheme.stages];
    std::copy(r.magnitude.begin(), r.magnitude.end(), memory.magnitude.begin());
    if (!memory.has_history) return;
    if (r.has_multiplier) {
        static const std::vector<double> nothing;
        memory.history.extend(r.t + r.h, r.multiplier.data(), r.has_normals ? r.normals : nothing,
                              r.has_normals ? r.normal_count : 0);
    } else if (!r.in_zone && memory.history.begun()) {
        memory.history.empty();
    }
}

}  // namespace srm
