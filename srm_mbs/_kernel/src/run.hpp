// Twin of srm_mbs/integration/driver.py: propose a step, make it, judge it, record it; in chunks.
#pragma once

#include <memory>
#include <vector>

#include "control.hpp"

namespace srm {

enum class Stop {
    chunk = 0,       // the chunk is full: call again
    finished = 1,
    too_short = 2,   // the step is below round-off
    standstill = 3,  // the last steps covered almost nothing
    closures = 4,    // the step made last opens the loops
    evaluation = 5,  // a fixed step could not be evaluated
    breakpoint = 6,  // the next piece begins, and Python has to look at it first
    arrival = 7,     // the end lies beside a singular configuration: Python prepares for it
};

// The constants of srm_mbs/integration/driver.py.
struct LoopConstants {
    double smallest_step, standstill, large_correction, open, lost;
    int watched_steps;
    double look, closer, allowed;  // breakpoints.py
};

// The pieces of a run between breakpoints; see srm_mbs/integration/breakpoints.py.
struct Pieces {
    std::vector<double> ends, first, last;  // (n,)
    std::vector<char> given;                // (n - 1,)
};

struct Attempt {
    double t, h, error_ratio;
    int verdict;
};

// eps = factor h^power; factor 0: eps -> 0.
struct Regularisation {
    double factor = 0.0, power = 0.0;
};

// A zone that a step used, for its dense output.
struct ZoneRecord {
    long step;
    double threshold;
    History history;
};

class Run {
public:
    Run(System& system, SplitStep step, std::unique_ptr<Control> control, LoopConstants constants,
        Memory memory, const double* state, double t0, Pieces pieces, double max_step, Regularisation eps);

    // Makes up to `steps` accepted steps, or as many as take `seconds`.
    Stop advance(long steps, double seconds);

    // Goes on from elsewhere, as the reference stands there; what is recorded stays.
    void resume(double t, const double* state, const Memory& memory, const ControlState& control);
    // Proposes, makes and judges one step; `verdict` is only set if there was one.
    Stop attempt(Verdict& verdict);
    // Goes on to the next piece; whether its first stage is accurate as it was evaluated: a
    // singular configuration may be so near that it is not.
    bool enter();
    // Goes on to `end` as a run of its own, evaluated within [first, last]; the records of the
    // steps before are dropped.  `anew`: forces may have jumped.  With `grid` > 0, fixed steps of
    // that length are counted from here.
    Stop go_on(double end, double first, double last, bool anew, double grid, double seconds);

    double t() const { return t_; }
    double last_h() const { return h_; }
    double t_end() const { return pieces_.ends.back(); }
    // Whether the next piece has still to be entered.
    bool at_breakpoint() const { return t_ >= pieces_.ends[piece_] && t_ < t_end(); }
    double seen() const { return seen_; }
    double near() const { return near_; }
    // Goes on as another run would that has seen and is looking for this.
    void adopt(double seen, double near) {
        seen_ = seen;
        near_ = near;
    }
    long piece() const { return static_cast<long>(piece_); }
    long count() const { return static_cast<long>(times.size()); }

    System& system;
    SplitStep step;
    std::unique_ptr<Control> control;
    Memory memory;
    std::vector<double> state;

    // Records of the accepted steps, one after the other.
    std::vector<double> times, states, rates, corrections, sigmas, ranks, error_ratios,
        placements, held;
    std::vector<double> end_rate;
    std::vector<double> breaks, break_rates;  // numbers of the steps before breakpoints; rates there
    std::vector<ZoneRecord> zones;
    std::vector<Attempt> attempts;
    // Of the steps whose records were dropped.
    long steps_before = 0, rejected_before = 0, zones_before = 0;
    bool trouble = false;  // the last attempt could not be evaluated

private:
    bool opens(const StepResult& result);
    void record(const StepResult& result, double t_new, int placement);
    void evaluate_within();
    void forget();
    bool renew();
    double direct_from() const;

    LoopConstants constants_;
    Regularisation eps_;
    Pieces pieces_;
    std::size_t piece_ = 0;
    double t0_, max_step_, t_, h_ = 0.0, smallest_, seen_, near_;
    bool redone_ = false;
};

}  // namespace srm
