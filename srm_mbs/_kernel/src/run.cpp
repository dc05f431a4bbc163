#include "run.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>

#include "critical.hpp"
#include "errors.hpp"
#include "interpreter.hpp"
#include "linear.hpp"

namespace srm {

namespace {
constexpr double inf = std::numeric_limits<double>::infinity();
// Attempts between two looks at the clock.
constexpr long clock_every = 16;
}  // namespace

void SmoothIntervals::check() const {
    expect_size("first", first.size(), ends.size());
    expect_size("last", last.size(), ends.size());
    if (ends.empty()) throw std::invalid_argument("ends is empty");
    expect_size("given", given.size(), ends.size() - 1);
    if (!std::is_sorted(ends.begin(), ends.end()))
        throw std::invalid_argument("ends do not increase");
}

void StepRecords::append(const StepResult& r, double t_new, int placement) {
    const auto extend = [](std::vector<double>& to, const std::vector<double>& from) {
        to.insert(to.end(), from.begin(), from.end());
    };
    times.push_back(t_new);
    extend(states, r.state);
    extend(rates, r.rates);
    extend(corrections, r.correction);
    extend(sigmas, r.sigmas);
    ranks.push_back(r.rank);
    error_ratios.push_back(r.error_ratio);
    placements.push_back(placement);
    stiff.push_back(r.stiff ? 1.0 : 0.0);
    held.push_back(r.held ? 1.0 : 0.0);
}

void StepRecords::clear() {
    for (auto* values : {&times, &states, &rates, &corrections, &sigmas, &ranks, &error_ratios,
                         &placements, &stiff, &held, &breaks, &break_rates})
        values->clear();
    zones.clear();
}

Run::Run(System& system, SplitStep step_, std::unique_ptr<SplitStep> stiff_step,
         std::unique_ptr<Control> control_, IntegratorState memory_, std::vector<double> state_,
         SmoothIntervals intervals, const RunOptions& options)
    : system(system),
      step(std::move(step_)),
      control(std::move(control_)),
      memory(std::move(memory_)),
      state(std::move(state_)),
      end_rate(2 * system.nv),
      stiff_step_(std::move(stiff_step)),
      intervals_(std::move(intervals)),
      eps_factor_(options.eps_factor),
      eps_power_(options.eps_power),
      t0_(options.t0),
      max_step_(options.max_step),
      t_(options.t0),
      smallest_(constants().smallest_step * std::abs(t_end() - options.t0)),
      open_residual_(constants().open_residual),
      search_below_(constants().search_below),
      examines_(options.examines) {
    enter_interval();
}

void Run::enter_interval() {
    system.between(intervals_.first[interval_], intervals_.last[interval_]);
    control->set_target_time(intervals_.ends[interval_]);
}

bool Run::enter() {
    ++interval_;
    enter_interval();
    records.breaks.push_back(static_cast<double>(records.count()));
    records.break_rates.insert(records.break_rates.end(), end_rate.begin(), end_rate.end());
    return restart_interval();
}

// sigma from which rounding in the first stage is harmless over the interval.
double Run::direct_from() const {
    const double largest = constants().zone_largest;
    if (step.norm.negligible == 0.0) return largest;
    const double span = intervals_.ends[interval_] - t_;
    const double curvature = 3.0 * memory.sigma_slope * memory.sigma_slope;
    const int nv = system.nv;
    double sum = 0.0;
    for (int i = 0; i < nv; ++i) {
        const double error = span * constants().position_rounding *
                             (std::abs(memory.rate[nv + i]) + curvature * step.norm.one[i]);
        const double scaled = error / step.norm.weight(nv + i, memory.state_scale[nv + i]);
        sum += scaled * scaled;
    }
    const double tolerances = std::sqrt(sum / (2 * nv)) / constants().rounding_share;
    return std::min(largest, std::sqrt(tolerances));
}

// Evaluates the first stage of an interval; whether it is accurate.
bool Run::restart_interval() {
    system.evaluate(t_, state.data(), System::ZoneView{});
    system.rate(memory.rate.data());
    memory.laws.clear();
    memory.sigma = system.sigma();
    system.state_scale(state.data(), memory.state_scale.data());
    if (!memory.history) return true;
    memory.history->clear();
    std::vector<double> multiplier(system.nv);
    system.multiplier(multiplier.data());
    memory.history->extend(t_, multiplier.data(), {}, {});
    if (memory.sigma >= constants().search_below) search_below_ = constants().search_below;
    if (!(memory.sigma < search_below_) || !(memory.sigma < direct_from())) return true;
    search_below_ = constants().search_factor * memory.sigma;
    return false;
}

// Whether a step left the closures open; almost always known without computing anything.
bool Run::leaves_closures_open(const StepResult& r) {
    const int n = static_cast<int>(r.correction.size());
    if (n == 0) return false;
    // Far from singular configurations, a step within the tolerance has a correction to match.
    const bool within = 0.0 < r.error_ratio && r.error_ratio <= 1.0;
    if (r.quiet && within && r.residual <= open_residual_) return false;
    bool large = !(r.residual < constants().lost_residual);
    for (int i = 0; i < n && !large; ++i)
        large = !(std::abs(r.correction[i]) < constants().large_correction * step.norm.one[i]);
    // With every structural row in use the correction closes all rows, or the rank is wrong.
    const bool unused = !r.in_zone && r.residual > 2.0 * open_residual_;
    if (!(large || unused)) return false;
    const double residual = system.closure_residual_at(r.t + r.h, r.state.data());
    if (!(residual < constants().lost_residual)) return true;
    if (unused && residual > 0.5 * r.residual) return true;
    open_residual_ = std::max(open_residual_, r.residual);
    return false;
}

void Run::resume(double t, const std::vector<double>& from, IntegratorState known,
                 const ControlState& known_control) {
    t_ = t;
    const auto& ends = intervals_.ends;
    const auto at = std::upper_bound(ends.begin(), ends.end() - 1, t);
    interval_ = static_cast<std::size_t>(at - ends.begin());
    enter_interval();
    state = from;
    memory = std::move(known);
    control->resume(known_control);
}

RunSnapshot Run::snapshot() const {
    RunSnapshot out;
    out.t = t_;
    out.state = state;
    out.memory = memory;
    control->save(out.control);
    out.open_residual = open_residual_;
    out.search_below = search_below_;
    return out;
}

void Run::restore(const RunSnapshot& snapshot) {
    resume(snapshot.t, snapshot.state, snapshot.memory, snapshot.control);
    open_residual_ = snapshot.open_residual;
    search_below_ = snapshot.search_below;
}

Stop Run::attempt(StepDecision& decision) {
    const double limit = std::min(max_step_, system.step_limit(state.data()));
    const Proposal proposal = control->propose(t_, limit, memory);
    if (proposal.arriving) return Stop::arrival;
    const double h = h_ = proposal.h;
    if (examines_) {
        const double zero = control->next_zero();
        if (!known_ && zero > t_ && examine(zero)) return Stop::passage;
    }
    const double spacing = std::nextafter(std::abs(t_), inf) - std::abs(t_);
    if (!(h > std::max(smallest_, 4.0 * spacing))) return Stop::too_short;
    const int steps = constants().standstill_steps;
    if (made_ >= steps && made_ % steps == 0 &&
        t_ - watched_time_ < constants().standstill * (t_end() - t0_))
        return Stop::standstill;
    const StepResult* result = nullptr;
    try {
        const double theta =
            eps_factor_ > 0.0 ? -std::expm1(-h / (eps_factor_ * std::pow(h, eps_power_))) : 1.0;
        made_by_ = &stepper();
        result = &made_by_->make(t_, h, state.data(), memory, theta);
    } catch (const EvaluationError&) {
        evaluation_failed = true;
    }
    if (result && examines_ && passes_residual(*result)) return Stop::passage;
    decision = control->decide(proposal, result);
    const int placement = redone_ ? 2 : proposal.placed ? 1 : 0;
    redone_ = decision == StepDecision::replaced;
    if (decision != StepDecision::accepted || !result) {
        attempts.push_back({t_, h, result ? result->error_ratio : inf, decision});
        const bool stuck = !control->adaptive && decision == StepDecision::rejected;
        return stuck ? Stop::evaluation : Stop::chunk;
    }
    evaluation_failed = false;
    // Where sigma rises, the next passage is another one.
    if (result->sigmas.back() > result->sigmas.front()) known_ = false;
    if (leaves_closures_open(*result)) return Stop::closures;
    if (result->in_zone)
        records.zones.push_back({records.count(), result->zone_threshold, *memory.history});
    records.append(*result, proposal.t_new, placement);
    end_rate = result->end_rate;
    std::copy(result->state.begin(), result->state.end(), state.begin());
    made_by_->accept(memory);
    t_ = proposal.t_new;
    if (made_++ % steps == 0) watched_time_ = t_;
    return t_ < t_end() ? Stop::chunk : Stop::finished;
}

// Whether the step passes a critical configuration that has a residual, and was not looked at.
bool Run::passes_residual(const StepResult& r) {
    if (known_ || r.quiet) return false;
    const auto [low, high] = std::minmax_element(r.sigmas.begin(), r.sigmas.end());
    if (low == r.sigmas.begin() || !(2.0 * *low < *high)) return false;
    std::vector<double> abscissae(made_by_->scheme.c);
    abscissae.push_back(1.0);
    const double zero = zero_within(abscissae, r.sigmas);
    const bool inside = 0.0 < zero && zero <= 1.0;
    return examine(r.t + (inside ? zero : abscissae[low - r.sigmas.begin()]) * r.h);
}

// Whether the critical configuration of the passage expected at `zero` has a residual.
bool Run::examine(double zero) {
    const auto residual =
        residual_of_passage(system, t_, state.data(), memory.rate.data(), zero, constants());
    known_ = residual.has_value();
    passage_ = zero;
    return residual && std::abs(*residual) > constants().rounded_residual;
}

void Run::append(const StepResult& result, double t) {
    constexpr int critical = 3;  // STEP_PLACEMENTS of dense_output.py
    records.append(result, t, critical);
    if (made_++ % constants().standstill_steps == 0) watched_time_ = t;
    end_rate = result.end_rate;
    state = result.state;
}

void Run::move_to(double t, IntegratorState known) {
    t_ = t;
    memory = std::move(known);
    known_ = false;
    control->moved(t);
}

void Run::drop_records() {
    steps_before += records.count();
    zones_before += static_cast<long>(records.zones.size());
    for (const Attempt& a : attempts) rejected_before += a.decision == StepDecision::rejected;
    records.clear();
    attempts.clear();
}

Stop Run::go_on(double end, double first, double last, bool forces_jump,
                double grid, double seconds) {
    drop_records();
    made_ = 0;
    t0_ = t_;
    smallest_ = constants().smallest_step * std::abs(end - t_);
    intervals_.ends.assign(1, end);
    intervals_.first.assign(1, first);
    intervals_.last.assign(1, last);
    intervals_.given.clear();
    interval_ = 0;
    evaluation_failed = false;
    enter_interval();
    if (grid > 0.0) control->start_grid(t_, grid);
    if (forces_jump) {
        try {
            if (!restart_interval()) return Stop::breakpoint;
        } catch (const EvaluationError&) {
            return Stop::breakpoint;
        }
    }
    return advance(0, seconds);
}

Stop Run::advance(long steps, double seconds) {
    using clock = std::chrono::steady_clock;
    const auto started = clock::now();
    const long last = steps > 0 ? records.count() + steps : std::numeric_limits<long>::max();
    StepDecision decision;
    for (long attempted = 1;; ++attempted) {
        sleep_if_ending();
        if (at_breakpoint()) {
            if (intervals_.given[interval_]) return Stop::breakpoint;
            try {
                if (!enter()) return Stop::breakpoint;
            } catch (const EvaluationError&) {
                return Stop::breakpoint;
            }
        }
        const Stop stop = attempt(decision);
        if (stop != Stop::chunk || records.count() >= last) return stop;
        if (attempted % clock_every == 0 &&
            std::chrono::duration<double>(clock::now() - started).count() > seconds)
            return Stop::chunk;
    }
}

}  // namespace srm
