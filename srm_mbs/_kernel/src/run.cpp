#include "run.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <utility>

#include "critical.hpp"
#include "errors.hpp"
#include "interpreter.hpp"
#include "limits.hpp"
#include "linear.hpp"
#include "reversals.hpp"

namespace srm {

namespace {
// Attempts between two looks at the clock.
constexpr long clock_every = 16;
// Steps that records have room for at first, and the largest room for their rates (numbers).
constexpr std::size_t first_steps = 64, first_rates = 1 << 14;
}  // namespace

void SmoothIntervals::check() const {
    expect_size("first", first.size(), ends.size());
    expect_size("last", last.size(), ends.size());
    if (ends.empty()) throw std::invalid_argument("ends is empty");
    expect_size("given", given.size(), ends.size() - 1);
    if (!std::is_sorted(ends.begin(), ends.end()))
        throw std::invalid_argument("ends do not increase");
}

void StepRecords::reserve(const StepResult& r) {
    for (auto* numbers : {&times, &ranks, &error_ratios, &placements, &stiff, &held})
        numbers->reserve(first_steps);
    states.reserve(first_steps * r.state.size());
    corrections.reserve(first_steps * r.correction.size());
    sigmas.reserve(first_steps * r.sigmas.size());
    rates.reserve(std::min(first_steps * r.rates.size(), first_rates));
}

void StepRecords::append(const StepResult& r, double t_new, int placement) {
    const auto extend = [](auto& to, const std::vector<double>& from) {
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

void StepRecords::drop_last(const StepResult& r) {
    for (auto* numbers : {&times, &ranks, &error_ratios, &placements, &stiff, &held})
        numbers->pop_back();
    const auto shorten = [](auto& values, std::size_t count) {
        values.erase(values.end() - count, values.end());
    };
    shorten(states, r.state.size());
    shorten(rates, r.rates.size());
    shorten(corrections, r.correction.size());
    shorten(sigmas, r.sigmas.size());
}

void StepRecords::clear() {
    for (auto* values : {&times, &states, &corrections, &sigmas, &ranks, &error_ratios,
                         &placements, &stiff, &held, &breaks, &break_rates})
        values->clear();
    rates.clear();
    zones.clear();
}

Run::Run(System& system, SplitStep step_, const ButcherTableau* stiff,
         std::unique_ptr<Control> control_, IntegratorState memory_, std::vector<double> state_,
         SmoothIntervals intervals, const RunOptions& options, double t0)
    : system(system),
      step(std::move(step_)),
      control(std::move(control_)),
      memory(std::move(memory_)),
      state(std::move(state_)),
      end_rate(2 * system.nv),
      stiff_(stiff),
      intervals_(std::move(intervals)),
      eps_factor_(options.eps_factor),
      eps_power_(options.eps_power),
      t0_(t0),
      max_step_(options.max_step),
      t_(t0),
      smallest_(constants().smallest_step * std::abs(t_end() - t0)),
      open_residual_(constants().open_residual),
      search_below_(constants().search_below),
      examines_(options.examines),
      singular_tolerance_(options.singular_tolerance),
      collocation_(options.collocation),
      one_freedom_(system.nv + (system.driven() ? 1 : 0) - system.structural_rank() == 1) {
    records.reserve(step.result);
    enter_interval();
}

SplitStep& Run::stepper() {
    if (!memory.stiff || !stiff_) return step;
    if (!stiff_step_) stiff_step_.emplace(system, *stiff_, step.constants, step.norm);
    return *stiff_step_;
}

void Run::enter_interval() {
    system.between(intervals_.first[interval_], intervals_.last[interval_]);
    control->set_target_time(intervals_.ends[interval_]);
}

bool Run::enter() {
    ++interval_;
    enter_interval();
    const bool accurate = restart_after_break();
    rest_limit_ = longest_from_rest();
    return accurate;
}

// longest_from_rest() in control/step_size.py.
double Run::longest_from_rest() const {
    if (!system.driven()) return infinity;
    std::vector<double> weights(memory.rate.size());
    for (std::size_t i = 0; i < weights.size(); ++i)
        weights[i] = step.norm.weight(static_cast<int>(i), memory.state_scale[i]);
    const double ahead = intervals_.ends[interval_] - t_;
    const double moved = ahead * ErrorNorm::ratio(memory.rate.data(), weights.data(),
                                                  static_cast<int>(weights.size()));
    return moved < step.norm.negligible ? constants().rest_probe_early * ahead : infinity;
}

// Records a break of the rates at t, and evaluates the first stage after it; whether it is accurate.
bool Run::restart_after_break() {
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

// Evaluates the first stage of an interval; whether it can be, and is accurate.
bool Run::restart_interval() {
    if (passage_) return true;
    system.begin_step(t_, state.data());
    try {
        system.evaluate(t_, state.data(), System::ZoneView{});
    } catch (const EvaluationError&) {
        return false;
    }
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
    prepared_.clear();
    passage_.reset();
    curve_limit_ = infinity;
    memory = std::move(known);
    control->resume(known_control);
    const bool enters = interval_ > 0 && t == ends[interval_ - 1];
    rest_limit_ = enters ? longest_from_rest() : infinity;
}

RunSnapshot Run::snapshot() const {
    RunSnapshot out;
    out.t = t_;
    out.state = state;
    out.memory = memory;
    control->save(out.control);
    out.open_residual = open_residual_;
    out.search_below = search_below_;
    out.first = first_;
    out.known = known_;
    out.quiet = quiet_;
    out.examine_below = examine_below_;
    out.avoided = avoided_;
    out.dead_end = dead_end_;
    out.passage = passage_;
    return out;
}

void Run::restore(const RunSnapshot& snapshot) {
    resume(snapshot.t, snapshot.state, snapshot.memory, snapshot.control);
    open_residual_ = snapshot.open_residual;
    search_below_ = snapshot.search_below;
    first_ = snapshot.first;
    known_ = snapshot.known;
    quiet_ = snapshot.quiet;
    examine_below_ = snapshot.examine_below;
    avoided_ = snapshot.avoided;
    dead_end_ = snapshot.dead_end;
    passage_ = snapshot.passage;
}

Stop Run::attempt(StepDecision& decision) {
    if (!prepared_.empty()) return make_prepared();
    if (passage_) {
        follow(*std::exchange(passage_, std::nullopt));
        if (!prepared_.empty()) return make_prepared();
        // Forces have changed, and it turns back.
        if (!restart_interval()) return Stop::breakpoint;
    }
    const double limit =
        std::min({max_step_, system.step_limit(state.data()), jump_limit_, rest_limit_,
                  curve_limit_});
    const Proposal proposal = control->propose(t_, limit, memory);
    if (proposal.arriving) return Stop::arrival;
    const double h = h_ = proposal.h;
    if (examines_) {
        const double zero = control->next_zero();
        const bool due = !known_ && zero > t_ && memory.sigma < examine_below_;
        if (due && (one_freedom_ || !quiet_) && examine(zero, true)) return make_prepared();
    }
    // The end of the run, or of an interval, may be as close as that.
    const double spacing = std::nextafter(std::abs(t_), infinity) - std::abs(t_);
    if (!(h > std::max(smallest_, 4.0 * spacing)) && proposal.t_new != intervals_.ends[interval_])
        return Stop::too_short;
    const int steps = constants().standstill_steps;
    if (made_ >= steps && made_ % steps == 0 &&
        t_ - watched_time_ < constants().standstill * (t_end() - t0_))
        return Stop::standstill;
    const StepResult* result = nullptr;
    unresolved_.reset();
    system.begin_step(t_, state.data());
    try {
        const double theta =
            eps_factor_ > 0.0 ? -std::expm1(-h / (eps_factor_ * std::pow(h, eps_power_))) : 1.0;
        made_by_ = &stepper();
        result = &made_by_->make(t_, h, state.data(), memory, theta);
    } catch (const EvaluationError&) {
        evaluation_failed = true;
    }
    if (result && examines_) {
        const std::optional<double> zero = crossing(*result);
        if (zero && examine(*zero, false)) return make_prepared();
        const StepBeside step_beside = beside(*result);
        if (step_beside == StepBeside::changes) {
            curve_limit_ = 0.5 * h;
            return Stop::chunk;
        }
        if (step_beside == StepBeside::stays) unresolved_.reset();
    }
    if (result && misses_jump(proposal, *result)) return Stop::chunk;
    decision = control->decide(proposal, result);
    const int placement = redone_ ? 2 : proposal.placed ? 1 : 0;
    redone_ = decision == StepDecision::replaced;
    if (decision != StepDecision::accepted || !result) {
        attempts.push_back({t_, h, result ? result->error_ratio : infinity, decision});
        const bool stuck = !control->adaptive && decision == StepDecision::rejected;
        return stuck ? Stop::evaluation : Stop::chunk;
    }
    evaluation_failed = false;
    quiet_ = result->quiet;
    dead_end_ = dead_end_ && !quiet_;
    // Where sigma rises, the next passage is another one.
    if (result->sigmas.back() > result->sigmas.front()) {
        known_ = false;
        examine_below_ = infinity;
    }
    if (leaves_closures_open(*result)) return Stop::closures;
    if (unresolved_) examined.push_back(*unresolved_);
    if (result->in_zone)
        records.zones.push_back({records.count(), result->zone_threshold, *memory.history});
    record(*result, proposal.t_new, placement);
    const bool jumped = on_jump_;
    jump_limit_ = rest_limit_ = curve_limit_ = infinity;
    jump_tries_ = 0;
    on_jump_ = false;
    inaccurate_ = jumped && t_ < interval_end() && !restart_after_break();
    return t_ < t_end() ? Stop::chunk : Stop::finished;
}

// ReversalSearch.late in integration/reversals.py.
double Run::late_past_layers(const StepResult& r) const {
    double late = -infinity;
    for (const FrictionSum& sum : system.friction_sums()) {
        double tolerance = 0.0;
        for (std::size_t k = 0; k < sum.columns.size(); ++k) {
            const int i = system.nv + sum.columns[k];
            const double scale = std::max(memory.state_scale[i], r.state_scale[i]);
            tolerance += std::abs(sum.coefficients[k]) * step.norm.weight(i, scale);
        }
        std::pair<double, double> stages(infinity, -infinity);
        const std::size_t width = 2 * system.nv;
        for (std::size_t at = 0; at + width < r.rates.size(); at += width) {
            const double rate = sum.of(&r.rates[at]);
            stages = {std::min(stages.first, rate), std::max(stages.second, rate)};
        }
        late = std::max(late, late_past_layer(r.h, sum.of(memory.rate.data()),
                                              sum.of(r.end_rate.data()), stages,
                                              system.friction_speed(), tolerance, constants()));
    }
    return late;
}

// Whether the step is to be made again, with another length: JumpSearch in integration/driver.py.
bool Run::misses_jump(const Proposal& proposal, const StepResult& r) {
    const double h = proposal.h;
    double late = system.past_jump(proposal.t_new, r.state.data());
    on_jump_ = late == 0.0;
    const double turned = control->adaptive ? late_past_layers(r) : -infinity;
    if (control->adaptive && !(r.error_ratio <= 1.0) && !(turned > 0.0)) return false;
    late = std::max(late, turned);
    const bool is_short = h == jump_limit_ && -h < late && late < 0.0;
    if (jump_tries_ == constants().max_jump_steps || !(late > 0.0 || is_short)) return false;
    jump_limit_ = late < h ? h - late : 0.5 * h;
    ++jump_tries_;
    return true;
}

// When the step passes a singular configuration that has not been examined.
std::optional<double> Run::crossing(const StepResult& r) {
    // A step across the middle of a passage may be quiet: sigma is the same at both ends.
    if (known_) return {};
    const auto [low, high] = std::minmax_element(r.sigmas.begin(), r.sigmas.end());
    if (!(2.0 * *low < *high)) return {};
    // No step before the first one has seen sigma fall, and all its stages may lie beyond.
    if (low == r.sigmas.begin()) {
        if (!first_ || !one_freedom_) return {};
        return approached(r);
    }
    std::vector<double> abscissae(made_by_->scheme.c);
    abscissae.push_back(1.0);
    const double zero = zero_within(abscissae, r.sigmas);
    const bool inside = 0.0 < zero && zero <= 1.0;
    return r.t + (inside ? zero : abscissae[low - r.sigmas.begin()]) * r.h;
}

// When the motion comes to the critical configuration next to it, if that is within the step.
std::optional<double> Run::approached(const StepResult& r) {
    UnitClosures closures(system, r.h);
    const auto critical = critical_of_passage(closures, t_, state.data(), memory.rate.data(), t_,
                                              constants());
    if (!critical) return {};
    std::vector<double> away(closures.n);
    closures.difference(state, t_, critical->x, critical->t, away.data());
    double along = 0.0, square = 0.0;
    for (int j = 0; j < system.nv; ++j) {
        const double rate = state[system.nq + j] / closures.unit(j);
        along += away[j] * rate;
        square += rate * rate;
    }
    const double ahead = along / square;
    if (!(0.0 < ahead && ahead < r.h)) return {};
    return r.t + ahead;
}

// CriticalPassages.beside in integration/critical_passages.py.
StepBeside Run::beside(const StepResult& r) {
    if (!one_freedom_ || !control->adaptive) return StepBeside::unknown;
    const auto [low, high] = std::minmax_element(r.sigmas.begin(), r.sigmas.end());
    // Up to the dead point sigma falls.
    if (dead_end_ && *low < constants().examined_again * r.sigmas.back())
        return StepBeside::changes;
    if (!(2.0 * *low < *high)) return StepBeside::unknown;
    UnitClosures closures(system, r.h);
    if (low == r.sigmas.begin()) {
        const double* before = memory.rate.data();
        double turned = 0.0;
        for (int i = 0; i < system.nv; ++i)
            turned += before[i] * r.end_rate[i] / (system.unit(i) * system.unit(i));
        if (!(turned < 0.0)) return StepBeside::unknown;
        avoided_ = critical_of_passage(closures, t_, state.data(), before, t_, constants());
        if (avoided_ && !avoids(*avoided_)) avoided_.reset();
    }
    if (!avoided_) return StepBeside::unknown;
    return step_beside(closures, *avoided_, t_, state, r.t + r.h, r.state, constants());
}

bool Run::avoids(const CriticalConfiguration& critical) const {
    return std::abs(critical.residual) >
           std::max(singular_tolerance_, constants().rounded_residual);
}

// Examines the passage at `zero`, which is expected or lies in a step, and prepares the steps along
// the curve if ordinary steps are not to make it; whether there are any.
bool Run::examine(double zero, bool expected) {
    examine_below_ = constants().examined_again * memory.sigma;
    UnitClosures closures(system, zero - t_);
    const auto critical = critical_of_passage(closures, t_, state.data(), memory.rate.data(), zero,
                                              constants());
    known_ = critical && critical->passed;
    avoided_.reset();
    if (!critical) return false;
    const double residual = std::abs(critical->residual);
    if (!(residual > constants().stepped_residual)) return false;
    if (expected) {  // another one may lie between
        std::vector<double> covered(closures.n);
        closures.difference(critical->x, critical->t, state, t_, covered.data());
        if (norm(covered.data(), closures.n) > constants().critical_farthest) {
            known_ = false;
            return false;
        }
    }
    const bool avoided = avoids(*critical);
    follow({*critical, closures.time_unit, !avoided});
    // A motion that is still to turn back is examined again.
    const bool steps_pass = prepared_.empty() && one_freedom_;
    const ExaminedPassage found{zero, critical->residual, avoided, !prepared_.empty()};
    if (known_ && steps_pass && !expected) unresolved_ = found;
    known_ = (known_ && !steps_pass) || !prepared_.empty();
    if (known_) examined.push_back(found);
    if (steps_pass && avoided) {
        avoided_ = *critical;
        if (leads_to_dead_point(closures, *critical, t_, state, constants())) dead_end_ = true;
    }
    if (!prepared_.empty()) dead_end_ = false;
    return !prepared_.empty();
}

// Prepares the steps of a passage up to the end of the interval; none if there is none, so that
// steps make it as well as they can, and the message says so.
void Run::follow(MotionAlongCurve motion) {
    try {
        prepare(passage_along_curve(system, motion, t_, state, intervals_.ends[interval_],
                                    step.norm.rtol, collocation_, constants()));
    } catch (const EvaluationError&) {
        return;
    }
    if (motion.begun) passage_ = std::move(motion);
}

// Prepares the steps from point to point.
void Run::prepare(const std::vector<PassagePoint>& points) {
    const int nv = system.nv, n = 2 * nv, stages = step.scheme.stages();
    const double first = step.scheme.b.front();
    std::vector<double> abscissae(step.scheme.c);
    abscissae.push_back(1.0);
    for (std::size_t i = points.size(); i-- > 1;) {
        const PassagePoint &from = points[i - 1], &to = points[i];
        StepResult r;
        r.t = from.t;
        r.h = to.t - from.t;
        r.state = to.state;
        r.end_rate = to.rate;
        r.correction.assign(n, 0.0);
        r.state_scale.resize(n);
        system.state_scale(to.state.data(), r.state_scale.data());
        // Rates between the ends only say how far the step leads.
        std::vector<double> moved(from.rate), between(n);
        for (double& value : moved) value *= r.h;
        system.difference(from.state.data(), to.state.data(), moved.data(), between.data());
        for (int j = 0; j < n; ++j)
            between[j] = (between[j] / r.h - first * from.rate[j]) / (1.0 - first);
        r.rates = from.rate;
        for (int k = 1; k < stages; ++k)
            r.rates.insert(r.rates.end(), between.begin(), between.end());
        r.rates.insert(r.rates.end(), to.rate.begin(), to.rate.end());
        for (double c : abscissae) r.sigmas.push_back(from.sigma + c * (to.sigma - from.sigma));
        r.multiplier.assign(nv, 0.0);
        r.rank = system.structural_rank();
        r.critical = true;
        prepared_.emplace_back(std::move(r), to.t);
    }
}

// Makes the next of the prepared steps.
Stop Run::make_prepared() {
    made_by_ = &step;
    step.result = std::move(prepared_.back().first);
    const double t = prepared_.back().second;
    prepared_.pop_back();
    h_ = step.result.h;
    record(step.result, t, StepRecords::critical);
    if (prepared_.empty()) {
        known_ = quiet_ = false;
        examine_below_ = infinity;
        control->moved(t_);
    }
    return t_ < t_end() ? Stop::chunk : Stop::finished;
}

bool Run::end_at(double begin, const std::vector<double>& from, double end, double time_unit,
                 double reach) {
    auto motion = motion_in_layer(system, begin, from, time_unit, singular_tolerance_, reach,
                                  constants());
    if (!motion) return false;
    std::vector<PassagePoint> points;
    try {
        points = passage_along_curve(system, *motion, begin, from, end, step.norm.rtol,
                                     collocation_, constants());
    } catch (const EvaluationError&) {
    }
    if (points.size() < 2) return false;
    records.drop_last(last());
    --made_;
    prepared_.clear();
    prepare(points);
    while (!prepared_.empty()) make_prepared();
    return true;
}

// Moves to the end t of an accepted step.
void Run::record(const StepResult& result, double t, int placement) {
    records.append(result, t, placement);
    end_rate = result.end_rate;
    std::copy(result.state.begin(), result.state.end(), state.begin());
    made_by_->accept(memory);
    t_ = t;
    first_ = false;
    if (made_++ % constants().standstill_steps == 0) watched_time_ = t_;
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
    examined.clear();
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
    if (forces_jump && !restart_interval()) return Stop::breakpoint;
    return advance(0, seconds);
}

Stop Run::advance(long steps, double seconds) {
    using clock = std::chrono::steady_clock;
    const auto started = clock::now();
    const long last = steps > 0 ? records.count() + steps : std::numeric_limits<long>::max();
    StepDecision decision;
    for (long attempted = 1;; ++attempted) {
        sleep_if_ending();
        if (at_breakpoint() && (intervals_.given[interval_] || !enter())) return Stop::breakpoint;
        if (std::exchange(inaccurate_, false)) return Stop::breakpoint;
        const Stop stop = attempt(decision);
        if (stop != Stop::chunk || records.count() >= last) return stop;
        if (attempted % clock_every == 0 &&
            std::chrono::duration<double>(clock::now() - started).count() > seconds)
            return Stop::chunk;
    }
}

}  // namespace srm
