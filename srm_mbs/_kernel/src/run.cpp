#include "run.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>

#include "errors.hpp"
#include "linear.hpp"

namespace srm {

namespace {
constexpr double inf = std::numeric_limits<double>::infinity();
// Attempts between two looks at the clock.
constexpr long clock_every = 16;
}  // namespace

Run::Run(System& system, SplitStep step_, std::unique_ptr<Control> control, LoopConstants constants,
         Memory memory, const double* start, double t0, Pieces pieces, double max_step,
         Regularisation eps)
    : system(system),
      step(std::move(step_)),
      control(std::move(control)),
      memory(std::move(memory)),
      state(start, start + system.nq + system.nv),
      end_rate(2 * system.nv),
      constants_(constants),
      eps_(eps),
      pieces_(std::move(pieces)),
      t0_(t0),
      max_step_(max_step),
      t_(t0),
      smallest_(constants.smallest_step * std::abs(t_end() - t0)),
      seen_(constants.open),
      near_(constants.look) {
    evaluate_within();
}

void Run::evaluate_within() {
    system.between(pieces_.first[piece_], pieces_.last[piece_]);
    control->aim(pieces_.ends[piece_]);
}

bool Run::enter() {
    ++piece_;
    evaluate_within();
    breaks.push_back(static_cast<double>(count()));
    break_rates.insert(break_rates.end(), end_rate.begin(), end_rate.end());
    return renew();
}

// sigma from which rounding in the first stage is harmless over the piece.
double Run::direct_from() const {
    const double largest = step.constants.zone_largest;
    if (step.norm.negligible == 0.0) return largest;
    const double span = pieces_.ends[piece_] - t_, turning = 3.0 * memory.sigma_slope * memory.sigma_slope;
    const int nv = system.nv;
    double sum = 0.0;
    for (int i = 0; i < nv; ++i) {
        const double error = span * step.constants.rounding *
                             (std::abs(memory.rate[nv + i]) + turning * step.norm.one[i]);
        const double scaled = error / step.norm.weight(nv + i, memory.magnitude[nv + i]);
        sum += scaled * scaled;
    }
    return std::min(largest, std::sqrt(std::sqrt(sum / (2 * nv)) / constants_.allowed));
}

// The first stage of a piece; whether it is accurate.
bool Run::renew() {
    system.evaluate(t_, state.data(), System::ZoneView{});
    system.rate(memory.rate.data());
    memory.sigma = system.sigma();
    system.magnitudes(state.data(), memory.magnitude.data());
    if (!memory.has_history) return true;
    memory.history.empty();
    std::vector<double> multiplier(system.nv);
    system.multiplier(multiplier.data());
    memory.history.extend(t_, multiplier.data(), {}, 0);
    if (memory.sigma >= constants_.look) near_ = constants_.look;
    if (!(memory.sigma < near_) || !(memory.sigma < direct_from())) return true;
    near_ = constants_.closer * memory.sigma;
    return false;
}

// Whether a step left the loops open; almost always without computing anything.
bool Run::opens(const StepResult& r) {
    const int n = static_cast<int>(r.correction.size());
    if (n == 0) return false;
    // Far from everything singular, a step within the tolerance has a correction to match.
    if (r.quiet && 0.0 < r.error_ratio && r.error_ratio <= 1.0 && r.gap <= seen_) return false;
    bool large = !(r.gap < constants_.lost);
    for (int i = 0; i < n && !large; ++i)
        large = !(std::abs(r.correction[i]) < constants_.large_correction * step.norm.one[i]);
    // With every structural row in use the correction closes all rows, or the rank is wrong.
    const bool unused = !r.in_zone && r.gap > 2.0 * seen_;
    if (!(large || unused)) return false;
    const double gap = system.closure_gap(r.t + r.h, r.state.data());
    if (!(gap < constants_.lost) || (unused && gap > 0.5 * r.gap)) return true;
    seen_ = std::max(seen_, r.gap);
    return false;
}

void Run::record(const StepResult& r, double t_new, int placement) {
    const auto append = [](std::vector<double>& to, const std::vector<double>& from) {
        to.insert(to.end(), from.begin(), from.end());
    };
    if (r.in_zone) zones.push_back({count(), r.zone_threshold, memory.history});
    times.push_back(t_new);
    append(states, r.state);
    append(rates, r.rates);
    append(corrections, r.correction);
    append(sigmas, r.sigmas);
    ranks.push_back(r.rank);
    error_ratios.push_back(r.error_ratio);
    placements.push_back(placement);
    held.push_back(r.held ? 1.0 : 0.0);
    end_rate = r.end_rate;
}

void Run::resume(double t, const double* from, const Memory& known, const ControlState& known_control) {
    t_ = t;
    const auto& ends = pieces_.ends;
    piece_ = static_cast<std::size_t>(std::upper_bound(ends.begin(), ends.end() - 1, t) - ends.begin());
    evaluate_within();
    std::copy(from, from + state.size(), state.begin());
    memory = known;
    control->resume(known_control);
}

Stop Run::attempt(Verdict& verdict) {
    const double limit = std::min(max_step_, system.step_limit(state.data()));
    const Proposal proposal = control->propose(t_, limit, memory);
    if (proposal.arriving) return Stop::arrival;
    const double h = h_ = proposal.h;
    const double spacing = std::nextafter(std::abs(t_), inf) - std::abs(t_);
    if (!(h > std::max(smallest_, 4.0 * spacing))) return Stop::too_short;
    const long made = count();
    if (made >= constants_.watched_steps && made % constants_.watched_steps == 0 &&
        t_ - times[made - constants_.watched_steps] < constants_.standstill * (t_end() - t0_))
        return Stop::standstill;
    const StepResult* result = nullptr;
    try {
        const double theta =
            eps_.factor > 0.0 ? -std::expm1(-h / (eps_.factor * std::pow(h, eps_.power))) : 1.0;
        result = &step.make(t_, h, state.data(), memory, theta);
    } catch (const EvaluationError&) {
        trouble = true;
    }
    verdict = control->judge(proposal, result);
    const int placement = redone_ ? 2 : proposal.placed ? 1 : 0;
    redone_ = verdict == Verdict::replaced;
    if (verdict != Verdict::accepted || !result) {
        attempts.push_back(
            {t_, h, result ? result->error_ratio : inf, static_cast<int>(verdict)});
        return !control->adaptive && verdict == Verdict::rejected ? Stop::evaluation : Stop::chunk;
    }
    trouble = false;
    if (opens(*result)) return Stop::closures;
    record(*result, proposal.t_new, placement);
    std::copy(result->state.begin(), result->state.end(), state.begin());
    step.accept(memory);
    t_ = proposal.t_new;
    return t_ < t_end() ? Stop::chunk : Stop::finished;
}

void Run::forget() {
    steps_before += count();
    zones_before += static_cast<long>(zones.size());
    for (const Attempt& a : attempts)
        rejected_before += a.verdict == static_cast<int>(Verdict::rejected);
    for (auto* records : {&times, &states, &rates, &corrections, &sigmas, &ranks, &error_ratios,
                          &placements, &held, &breaks, &break_rates})
        records->clear();
    zones.clear();
    attempts.clear();
}

Stop Run::go_on(double end, double first, double last, bool anew, double grid, double seconds) {
    forget();
    t0_ = t_;
    smallest_ = constants_.smallest_step * std::abs(end - t_);
    pieces_.ends.assign(1, end);
    pieces_.first.assign(1, first);
    pieces_.last.assign(1, last);
    pieces_.given.clear();
    piece_ = 0;
    trouble = false;
    evaluate_within();
    if (grid > 0.0) control->grid(t_, grid);
    if (anew) {
        try {
            if (!renew()) return Stop::breakpoint;
        } catch (const EvaluationError&) {
            return Stop::breakpoint;
        }
    }
    return advance(0, seconds);
}

Stop Run::advance(long steps, double seconds) {
    using clock = std::chrono::steady_clock;
    const auto started = clock::now();
    const long last = steps > 0 ? count() + steps : std::numeric_limits<long>::max();
    Verdict verdict;
    for (long attempted = 1;; ++attempted) {
        if (at_breakpoint()) {
            if (pieces_.given[piece_]) return Stop::breakpoint;
            try {
                if (!enter()) return Stop::breakpoint;
            } catch (const EvaluationError&) {
                return Stop::breakpoint;
            }
        }
        const Stop stop = attempt(verdict);
        if (stop != Stop::chunk || count() >= last) return stop;
        if (attempted % clock_every == 0 &&
            std::chrono::duration<double>(clock::now() - started).count() > seconds)
            return Stop::chunk;
    }
}

}  // namespace srm
