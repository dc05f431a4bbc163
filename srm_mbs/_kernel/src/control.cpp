#include "control.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "limits.hpp"
#include "linear.hpp"

namespace srm {

namespace {

std::vector<double> with_end(const ButcherTableau& scheme) {
    std::vector<double> out(scheme.c);
    out.push_back(1.0);
    return out;
}

// max_j |sigma_j - sigma_0| / (c_j h) over the stages with c_j >= from (1/s).
double sigma_slope(const std::vector<double>& abscissae, const std::vector<double>& sigmas,
                   double h, double from = 0.0) {
    double out = 0.0;
    for (std::size_t j = 0; j < sigmas.size(); ++j)
        if (abscissae[j] > 0.0 && abscissae[j] >= from)
            out = std::max(out, std::abs(sigmas[j] - sigmas[0]) * (1.0 / abscissae[j]));
    return out / h;
}

// A step of about the length h: times far from zero are coarse, and the motion is to advance by what
// the clock does.
Proposal over(double t, double h, const Constants& constants, bool placed = false) {
    const double t_new = t + h, size = std::abs(t_new);
    if (std::nextafter(size, infinity) - size > constants.clock_rounding * h) h = t_new - t;
    return {h, t_new, placed};
}

// A step of at most h that neither passes `end` nor leaves a sliver before it.
Proposal until(double t, double h, double end, const Constants& constants) {
    const double remaining = end - t;
    if (h >= remaining * (1.0 - 1e-12)) return {remaining, end};
    if (2.0 * h > remaining) h = 0.5 * remaining;
    return over(t, h, constants);
}

}  // namespace

Proposal PIControl::propose(double t, double limit, IntegratorState& memory) {
    order_ = orders_[memory.stiff];
    return until(t, std::min(h_, limit), t_end_, constants_);
}

StepDecision PIControl::decide(const Proposal& proposal, const StepResult* result) {
    const Constants& c = constants_;
    double xi = result ? result->error_ratio : c.failed_evaluation;
    if (!(xi < c.failed_evaluation)) xi = c.failed_evaluation;
    const double k = order_;
    if (xi > 1.0) {
        h_ = proposal.h * std::max(c.min_factor, c.safety * std::pow(xi, -1.0 / k));
        just_rejected_ = true;
        return StepDecision::rejected;
    }
    double factor = c.safety * std::pow(std::max(xi, c.error_floor), -c.integral / k) *
                    std::pow(xi_old_, c.proportional / k);
    factor = std::min(c.max_factor, std::max(c.min_factor, factor));
    if (just_rejected_) factor = std::min(factor, 1.0);
    double h = proposal.h * factor;
    // The step was cut to end there: after a breakpoint the step wanted before is the better guess.
    if (proposal.t_new == t_end_ && proposal.h < h_) h = std::max(h, h_);
    h_ = h;
    xi_old_ = std::max(xi, c.previous_error_floor);
    just_rejected_ = false;
    return StepDecision::accepted;
}

Proposal FixedStep::propose(double t, double limit, IntegratorState&) {
    double target = t0_ + static_cast<double>(index_) * step_;
    if (target > t_end_ - 1e-9 * step_) target = t_end_;
    if (limit < target - t - sliver()) return over(t, limit, constants_);
    return {target - t, target};
}

StepDecision FixedStep::decide(const Proposal& proposal, const StepResult* result) {
    if (!result || !finite(result->state.data(), static_cast<int>(result->state.size())))
        return StepDecision::rejected;
    moved(proposal.t_new);
    return StepDecision::accepted;
}

Gaps::Gaps(const ButcherTableau& scheme, double clearance) {
    centre_ = scheme.gap_centres[0];
    clearance_ = clearance * scheme.gap_half_widths[0];
    first_ = 1.0;
    for (double c : scheme.c)
        if (c > 0.0) first_ = std::min(first_, c);
    std::vector<std::pair<double, double>> wide;
    for (std::size_t i = 0; i < scheme.gap_centres.size(); ++i)
        if (scheme.gap_half_widths[i] > clearance_)
            wide.emplace_back(scheme.gap_centres[i],
                              scheme.gap_centres[i] + scheme.gap_half_widths[i] - clearance_);
    std::sort(wide.begin(), wide.end());
    for (const auto& [centre, end] : wide) {
        wide_centres_.push_back(centre);
        wide_ends_.push_back(end);
    }
}

double Gaps::longest_step(double distance, double h) const {
    const double position = distance / h;
    if (position >= 1.0 + centre_) return h;
    if (position <= 0.5 * first_) return h;
    for (std::size_t i = 0; i < wide_ends_.size(); ++i)
        if (position <= wide_ends_[i]) return distance / std::max(position, wide_centres_[i]);
    return distance / (1.0 + centre_);
}

bool Gaps::ends_on(double distance, double h) const {
    return std::abs(distance / h - 1.0) < clearance_;
}

double Gaps::step_over(double distance) const { return distance / wide_ends_.back(); }

StagePlaces::StagePlaces(const ButcherTableau& scheme, double clearance, double slope_from)
    : gaps(scheme, clearance),
      abscissae(with_end(scheme)),
      middle(0),
      slope_from(slope_from) {
    for (std::size_t k = 1; k < abscissae.size(); ++k)
        if (std::abs(abscissae[k] - 0.5) < std::abs(abscissae[middle] - 0.5))
            middle = static_cast<int>(k);
}

SingularityPlacement::SingularityPlacement(std::unique_ptr<Control> inner,
                                           const ButcherTableau& scheme,
                                           const ButcherTableau& stiff, double t_end,
                                           const Constants& constants, bool arrivals,
                                           bool scatters)
    : ControlWrapper(std::move(inner)),
      constants_(constants),
      t_end_(t_end),
      first_arrival_(arrivals && inner_->adaptive ? Arrival::watched : Arrival::none),
      arrival_(first_arrival_),
      members_{{scheme, constants.clearance, scatters ? constants.scatter_from : 0.0},
               {stiff, constants.clearance, scatters ? constants.scatter_from : 0.0}},
      zero_(not_a_number) {}

Proposal SingularityPlacement::propose(double t, double limit, IntegratorState& memory) {
    places_ = &members_[memory.stiff];
    if (redo_ > 0.0) limit = std::min(limit, redo_);
    if (adaptive && slope_ > 0.0) limit = std::min(limit, constants_.max_sigma_change / slope_);
    memory.sigma_slope = slope_;
    const Proposal proposal = inner_->propose(t, limit, memory);
    if (arrives(t, proposal)) arrival_ = Arrival::due;
    lingering_ = memory.lingering = lingers(proposal, memory);
    if (lingering_) return proposal;
    if (arrival_ == Arrival::due) {
        arrival_ = Arrival::none;
        return {proposal.h, proposal.t_new, proposal.placed, true};
    }
    // Where the multipliers are known, stages may be on the singular configuration.
    known_ = memory.history && memory.history->known_until >= t_end_;
    if (known_) return proposal;
    if (!(redo_ > 0.0) && zero_ > t) {
        const double h = placed_step(zero_ - t, proposal.h, t);
        if (h != proposal.h) {
            ++placed;
            return over(t, h, constants_, true);
        }
    }
    return proposal;
}

// Whether stages next to a singular configuration are to be solved by nodes of the branch: the
// motion turns back, is slow or ends there.
bool SingularityPlacement::lingers(const Proposal& proposal, const IntegratorState& memory) const {
    if (lost_branch_ || !memory.history) return false;
    if (memory.history->known_until >= proposal.t_new) return false;
    if (!adaptive) return !memory.history->away.empty();
    if (arrival_ == Arrival::due) return true;
    if (!(memory.sigma < constants_.monitored_below)) return false;
    return turning_ || !memory.history->away.empty();
}

// Whether it is found that the run, or its interval, ends next to a singular configuration.
bool SingularityPlacement::arrives(double t, const Proposal& proposal) const {
    if (arrival_ != Arrival::watched) return false;
    if (!(zero_ > t) || !(std::abs(zero_ - t_end_) * slope_ < constants_.singular_end))
        return false;
    // Of many loops sigma is no parabola, and its zero not known that well: only the step to the
    // end will tell.
    if (!(zero_error_ < constants_.singular_end)) return false;
    return proposal.t_new >= t_end_ ||
           (t_end_ - t) * slope_ <= constants_.arrival_sigma_change;
}

double SingularityPlacement::placed_step(double distance, double h, double t) const {
    // The run, or its interval, ends there.
    const Gaps& gaps = places_->gaps;
    if (t + h >= t_end_ && gaps.ends_on(distance, h)) return h;
    if (adaptive) return gaps.longest_step(distance, h);
    // Where a grid point is singular, a fixed step may pass it: no shorter step could.
    if (!gaps.ends_on(distance, h)) return distance < h ? gaps.longest_step(distance, h) : h;
    const double over = gaps.step_over(distance);
    return t + over <= t_end_ ? over : h;
}

// A better step length if a stage or the end came too close, else NaN.
double SingularityPlacement::better_step(double h, const std::vector<double>& sigmas,
                                         double slope, bool last) const {
    const double reach =
        std::min(constants_.too_close * std::max(slope_, slope) * h, 0.5 * sigmas[0]);
    double lowest = infinity, lowest_movable = infinity;
    for (std::size_t j = 0; j < sigmas.size(); ++j) {
        lowest = std::min(lowest, sigmas[j]);
        const double c = places_->abscissae[j];
        if (c > 0.0 && (!last || c < 1.0)) lowest_movable = std::min(lowest_movable, sigmas[j]);
    }
    if (!(lowest < reach) || !(lowest_movable < reach)) return not_a_number;
    const double zero = zero_within(places_->abscissae, sigmas);
    if (!(zero > 0.0)) return not_a_number;
    return places_->gaps.longest_step(zero * h, 0.98 * h);
}

StepDecision SingularityPlacement::decide(const Proposal& proposal, const StepResult* result) {
    const double h = proposal.h;
    const std::vector<double>& abscissae = places_->abscissae;
    const int middle = places_->middle;
    double slope = 0.0;
    if (result && result->quiet) {
        const std::vector<double>& sigmas = result->sigmas;
        const double start = sigmas[0], c = abscissae[middle];
        slope = std::max(std::abs(sigmas.back() - start),
                         c > 0.0 ? std::abs(sigmas[middle] - start) / c : 0.0) / h;
    } else if (result) {
        slope = sigma_slope(abscissae, result->sigmas, h, places_->slope_from);
        const bool last = proposal.t_new >= t_end_;
        // Where a method has no nodes, the end is solved as any stage.
        const bool unsolved = last && arrival_ == Arrival::due && result->away.empty() &&
                              result->sigmas.back() < constants_.branch_below;
        if (lingering_ && (result->lost_branch || unsolved)) {
            lost_branch_ = true;
            redo_ = h;
            ++replaced;
            return StepDecision::replaced;
        }
        if (last && !lingering_ && arrival_ == Arrival::watched &&
            result->sigmas.back() < constants_.singular_end) {
            arrival_ = Arrival::due;
            redo_ = h;
            // The first step of a run knows no other slope, and would prepare nothing.
            if (slope_ == 0.0) slope_ = slope;
            ++replaced;
            return StepDecision::replaced;
        }
        if (redone_ < constants_.max_placements && !known_ && !lingering_) {
            const double better = better_step(h, result->sigmas, slope, last);
            if (0.0 < better && better < h) {
                redo_ = better;
                ++redone_;
                ++replaced;
                return StepDecision::replaced;
            }
        }
    }
    const StepDecision decision = inner_->decide(proposal, result);
    redo_ = 0.0;
    redone_ = 0;
    if (decision == StepDecision::rejected && arrival_ < first_arrival_) {
        // What was prepared without nodes was another step to the end.
        arrival_ = first_arrival_;
        lost_branch_ = false;
    }
    if (decision == StepDecision::accepted && result) {
        slope_ = std::max(slope, 0.5 * slope_);
        turning_ = !result->quiet && result->sigmas.back() < constants_.monitored_below &&
                   (slope_ * h < constants_.slow_sigma_change ||
                    std::abs(extreme_sigma(abscissae, middle, result->sigmas,
                                           constants_.turning_misfit)) <
                        constants_.turning_sigma);
        lost_branch_ = lost_branch_ && !result->quiet;
        zero_ = expected_ = not_a_number;
        const std::vector<double>& sigmas = result->sigmas;
        const double start = sigmas[0], end = sigmas.back();
        if (!result->quiet) {
            const double ahead = zero_ahead(abscissae[middle], start, sigmas[middle], end,
                                            constants_.zero_horizon);
            zero_ = result->t + h * ahead;
            zero_error_ = error_of_parabola(abscissae, middle, sigmas, ahead);
            if (ahead < 1.0 + constants_.expected_steps) expected_ = zero_;
        }
        if (std::isnan(expected_) && end < start && end < constants_.expected_sigma)
            expected_ = result->t + h * (start / (start - end));
    }
    return decision;
}

SlopeOfSigma::SlopeOfSigma(std::unique_ptr<Control> inner, const ButcherTableau& scheme,
                           const ButcherTableau& stiff)
    : ControlWrapper(std::move(inner)), members_{with_end(scheme), with_end(stiff)} {}

Proposal SlopeOfSigma::propose(double t, double limit, IntegratorState& memory) {
    abscissae_ = &members_[memory.stiff];
    memory.sigma_slope = slope_;
    return inner_->propose(t, limit, memory);
}

StepDecision SlopeOfSigma::decide(const Proposal& proposal, const StepResult* result) {
    const StepDecision decision = inner_->decide(proposal, result);
    if (decision == StepDecision::accepted && result)
        slope_ = std::max(sigma_slope(*abscissae_, result->sigmas, proposal.h), 0.5 * slope_);
    return decision;
}

BranchGuard::BranchGuard(std::unique_ptr<Control> inner, const System& system,
                         const Constants& constants)
    : ControlWrapper(std::move(inner)),
      system_(system),
      constants_(constants),
      work_(2 * system.nv) {}

Proposal BranchGuard::propose(double t, double limit, IntegratorState& memory) {
    const Proposal proposal = inner_->propose(t, std::min(limit, limit_), memory);
    placed = inner_->placed;
    return proposal;
}

// Whether the velocity changed, in a step next to a singular configuration, by more than its
// accelerations explain.
bool BranchGuard::velocity_jumps(const StepResult& result) const {
    const auto [low, high] = std::minmax_element(result.sigmas.begin(), result.sigmas.end());
    if (!(2.0 * *low < *high)) return false;
    const int nv = system_.nv;
    const double *start = result.rates.data(), *end = result.end_rate.data();
    double *halfway = work_.data(), *jump = halfway + nv;
    for (int i = 0; i < nv; ++i) {
        halfway[i] = 0.5 * result.h * (start[nv + i] + end[nv + i]);
        jump[i] = end[i] - start[i] - halfway[i];
    }
    const double size = std::max({system_.position_norm(start), system_.position_norm(end),
                                  system_.position_norm(halfway)});
    return system_.position_norm(jump) > constants_.branch_change * size;
}

StepDecision BranchGuard::decide(const Proposal& proposal, const StepResult* result) {
    const bool suspect = result && !result->quiet && velocity_jumps(*result);
    if (suspect && tries_ < constants_.max_guard_retries) {
        limit_ = 0.5 * proposal.h;
        ++tries_;
        ++replaced;
        return StepDecision::replaced;
    }
    const long before = inner_->replaced;
    const StepDecision decision = inner_->decide(proposal, result);
    replaced += inner_->replaced - before;
    if (decision == StepDecision::accepted && result) {
        if (suspect) suspect_times.push_back(proposal.t_new);
        limit_ = infinity;
        tries_ = 0;
    }
    return decision;
}

namespace {

// Least-squares polynomials of one degree at the abscissae c: Householder QR of the Vandermonde
// matrix.
class PolynomialFit {
public:
    PolynomialFit(const std::vector<double>& c, int degree)
        : rows_(static_cast<int>(c.size())),
          columns_(degree + 1),
          A_(static_cast<std::size_t>(rows_) * columns_),
          head_(columns_),
          diagonal_(columns_) {
        for (int i = 0; i < rows_; ++i) {
            double power = 1.0;
            for (int j = 0; j < columns_; ++j, power *= c[i]) A_[j * rows_ + i] = power;
        }
        for (int k = 0; k < columns_; ++k) {
            const double* a = &A_[k * rows_];
            diagonal_[k] = -std::copysign(norm(a + k, rows_ - k), a[k]);
            head_[k] = a[k] - diagonal_[k];
            for (int j = k + 1; j < columns_; ++j) reflect(k, &A_[j * rows_]);
        }
    }

    // Norm of the residual for `values`, which are reflected in place.
    double residual(std::vector<double>& values) const {
        for (int k = 0; k < columns_; ++k) reflect(k, values.data());
        return norm(values.data() + columns_, rows_ - columns_);
    }

    // The coefficients, lowest power first, from reflected values.
    void solve(const std::vector<double>& values, double* coefficients) const {
        for (int k = columns_ - 1; k >= 0; --k) {
            double sum = values[k];
            for (int j = k + 1; j < columns_; ++j) sum -= A_[j * rows_ + k] * coefficients[j];
            coefficients[k] = sum / diagonal_[k];
        }
    }

private:
    void reflect(int k, double* x) const {
        const double* a = &A_[k * rows_];
        const int below = rows_ - k - 1;
        const double s =
            (head_[k] * x[k] + dot(a + k + 1, x + k + 1, below)) / (-diagonal_[k] * head_[k]);
        x[k] -= s * head_[k];
        add(-s, a + k + 1, x + k + 1, below);
    }

    int rows_, columns_;
    std::vector<double> A_, head_, diagonal_;
};

}  // namespace

Parabola::Parabola(double c, double start_, double middle, double end) : start(start_) {
    const bool inside = 0.1 < c && c < 0.9;
    b = inside ? ((middle - start) / c - (end - start)) / (c - 1.0) : 0.0;
    a = end - start - b;
}

double error_of_parabola(const std::vector<double>& abscissae, int middle,
                         const std::vector<double>& sigmas, double ahead) {
    const double c = abscissae[middle];
    const Parabola parabola(c, sigmas[0], sigmas[middle], sigmas.back());
    const auto cubic = [c](double x) { return std::abs(x * (x - c) * (x - 1.0)); };
    double misfit = 0.0, largest_cubic = 0.0;
    for (std::size_t j = 0; j < sigmas.size(); ++j) {
        misfit = std::max(misfit, std::abs(parabola(abscissae[j]) - sigmas[j]));
        largest_cubic = std::max(largest_cubic, cubic(abscissae[j]));
    }
    return largest_cubic > 0.0 ? misfit * cubic(ahead) / largest_cubic : misfit;
}

double zero_within(const std::vector<double>& abscissae, const std::vector<double>& sigmas) {
    const int n = static_cast<int>(abscissae.size());
    std::vector<int> order(n);
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(),
                     [&](int a, int b) { return abscissae[a] < abscissae[b]; });
    std::vector<double> c(n), sigma(n), values(n);
    for (int i = 0; i < n; ++i) {
        c[i] = abscissae[order[i]];
        sigma[i] = sigmas[order[i]];
    }
    if (!(*std::max_element(sigma.begin(), sigma.end()) > 0.0)) return not_a_number;
    const PolynomialFit polynomials(c, n > 4 ? 2 : 1);
    double best = infinity, zero = not_a_number;
    for (int k = 1; k <= n; ++k) {
        const double after = k < n ? c[k] : 1.1;
        if (after <= c[k - 1]) continue;
        for (int i = 0; i < n; ++i) values[i] = i < k ? sigma[i] : -sigma[i];
        const double error = polynomials.residual(values);
        if (!(error < best)) continue;
        double p[3] = {0.0, 0.0, 0.0};
        polynomials.solve(values, p);
        double roots[2];
        int found = 0;
        if (p[2] == 0.0) {
            if (p[1] != 0.0) roots[found++] = -p[0] / p[1];
        } else {
            const double discriminant = p[1] * p[1] - 4.0 * p[2] * p[0];
            if (discriminant >= 0.0) {
                const double q = -0.5 * (p[1] + std::copysign(std::sqrt(discriminant), p[1]));
                roots[found++] = q / p[2];
                if (q != 0.0) roots[found++] = p[0] / q;
                if (found == 2 && roots[1] < roots[0]) std::swap(roots[0], roots[1]);
            }
        }
        for (int i = 0; i < found; ++i) {
            if (c[k - 1] - 0.02 <= roots[i] && roots[i] <= after + 0.02) {
                best = error;
                zero = roots[i];
                break;
            }
        }
    }
    return zero;
}

double extreme_sigma(const std::vector<double>& abscissae, int middle,
                     const std::vector<double>& sigmas, double allowed) {
    const double c = abscissae[middle], start = sigmas[0];
    if (!(0.1 < c && c < 0.9)) return infinity;
    double best = infinity, extreme = infinity;
    for (const auto& [sign, last_sign] :
         {std::pair{1.0, 1.0}, {1.0, -1.0}, {-1.0, -1.0}, {-1.0, 1.0}}) {
        const double end = last_sign * sigmas.back();
        const Parabola parabola(c, start, sign * sigmas[middle], end);
        double misfit = 0.0;
        for (std::size_t j = 0; j < sigmas.size(); ++j) {
            const double off = std::abs(parabola(abscissae[j])) - sigmas[j];
            misfit += off * off;
        }
        if (!(misfit < best)) continue;
        best = misfit;
        const double a = parabola.a, b = parabola.b;
        extreme = b == 0.0 ? infinity : start - a * a / (4.0 * b);
    }
    const auto [low, high] = std::minmax_element(sigmas.begin(), sigmas.end());
    const double misfit = std::sqrt(best / static_cast<double>(sigmas.size()));
    return misfit <= allowed * (*high - *low) ? extreme : infinity;
}

double zero_ahead(double c, double start, double middle, double end, double horizon) {
    if (!(end < start)) return not_a_number;
    const double line = start / (start - end);
    const double within = line > horizon ? not_a_number : line;
    double zero = line;
    const Parabola parabola(c, start, middle, end);
    const double a = parabola.a, b = parabola.b, root = a * a - 4.0 * b * start;
    if (root >= 0.0 && a < 0.0) {
        zero = 2.0 * start / (-a + std::sqrt(root));
    } else if (a + 2.0 * b >= 0.0 || root < 0.0) {
        return within;
    }
    if (1.0 < zero && zero < horizon) return zero;
    return 1.0 < line && line < horizon && zero <= 1.0 ? line : not_a_number;
}

}  // namespace srm
