// The driver: propose a step, make it, decide on it, record it; in chunks.  See driver.py.
#pragma once

#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "control.hpp"
#include "large_array.hpp"
#include "limits.hpp"
#include "passage.hpp"
#include "struct_fields.hpp"

namespace srm {

enum class Stop {
    chunk = 0,       // the chunk is full: call again
    finished = 1,
    too_short = 2,   // the step is below round-off
    standstill = 3,  // the last steps covered almost nothing
    closures = 4,    // the step made last leaves the closures open
    evaluation = 5,  // a fixed step could not be evaluated
    breakpoint = 6,  // the next interval begins, and Python has to look at it first
    arrival = 7,     // the end lies next to a singular configuration: Python prepares for it
};

#define SRM_SMOOTH_INTERVALS(field)                                                           \
    field(std::vector<double>, ends)                                                          \
    /* Times within which the system is evaluated in each. */                                 \
    field(std::vector<double>, first)                                                         \
    field(std::vector<double>, last)                                                          \
    field(std::vector<int>, given) /* (n - 1,), whether Python enters the interval after each */

// The intervals of a run between breakpoints: breakpoints.py.
struct SmoothIntervals {
    SRM_FIELDS(SRM_SMOOTH_INTERVALS)

    void check() const;
};

#define SRM_RUN_OPTIONS(field)                                                         \
    field(double, step)            /* fixed step (s); 0: step-size control */          \
    field(double, max_step)                                                            \
    field(std::string, placement)  /* "automatic" or "off" */                          \
    field(bool, arrivals)          /* stop before an end next to a singular configuration */ \
    field(bool, examines)          /* follow the residuals of critical configurations */ \
    field(double, singular_tolerance) /* residual (row units) up to which one is singular */ \
    field(Collocation, collocation) /* of passages along curves */                     \
    /* Regularisation eps = eps_factor h^eps_power; eps_factor 0: eps -> 0. */         \
    field(double, eps_factor)                                                          \
    field(double, eps_power)

struct RunOptions {
    SRM_FIELDS(SRM_RUN_OPTIONS)
};

// A passage next to a critical configuration: ExaminedPassage of critical_passages.py.
struct ExaminedPassage {
    double time, residual;
    bool avoided, resolved;
};

struct Attempt {
    double t, h, error_ratio;
    StepDecision decision;
};

// A zone that a step used, for its dense output.
struct ZoneRecord {
    long step;
    double threshold;
    MultiplierHistory history;
};

// The accepted steps, one after the other.
struct StepRecords {
    std::vector<double> times, states, corrections, sigmas, ranks, error_ratios;
    LargeArray rates;                // most of the memory: small pages take time to get and give back
    std::vector<double> placements;  // 0: none, 1: placed, 2: redone, or critical
    std::vector<double> stiff;       // 1: the problem had been found to be stiff
    std::vector<double> held;        // 1: a stage kept the normals of the last node
    std::vector<double> breaks;      // numbers of the steps before breakpoints
    std::vector<double> break_rates; // (breaks, n), tangent rates there
    std::vector<ZoneRecord> zones;

    static constexpr int critical = 3;  // STEP_PLACEMENTS of dense_output.py

    long count() const { return static_cast<long>(times.size()); }
    // Makes room for the first steps, of the sizes of `result`: short runs need no more.
    void reserve(const StepResult& result);
    void append(const StepResult& result, double t_new, int placement);
    // Removes the last step, which is `result`.
    void drop_last(const StepResult& result);
    void clear();
};

#define SRM_RUN_SNAPSHOT(field)                                                    \
    field(double, t)                                                               \
    field(std::vector<double>, state)                                              \
    field(IntegratorState, memory)                                                 \
    field(ControlState, control)                                                   \
    /* Thresholds that change over a run: see Run. */                              \
    field(double, open_residual)                                                   \
    field(double, search_below)                                                    \
    /* Passages next to critical configurations: see Run. */                       \
    field(bool, first)                                                             \
    field(bool, known)                                                             \
    field(bool, quiet)                                                             \
    field(double, examine_below)                                                   \
    field(std::optional<CriticalConfiguration>, avoided)                           \
    field(bool, dead_end)                                                          \
    field(std::optional<MotionAlongCurve>, passage)

// Everything that the next step depends on.
struct RunSnapshot {
    SRM_FIELDS(SRM_RUN_SNAPSHOT)
};

class Run {
public:
    // `stiff`: the scheme where the problem is stiff; may be null.  The structs of the step, `stiff`
    // and `options` are not copied: their owner outlives the run.
    Run(System& system, SplitStep step, const ButcherTableau* stiff,
        std::unique_ptr<Control> control, IntegratorState memory, std::vector<double> state,
        SmoothIntervals intervals, const RunOptions& options, double t0);

    // Makes up to `steps` accepted steps, or as many as take `seconds`.
    Stop advance(long steps, double seconds);

    // Goes on from another state; the records stay.
    void resume(double t, const std::vector<double>& state, IntegratorState memory,
                const ControlState& control);
    RunSnapshot snapshot() const;
    void restore(const RunSnapshot& snapshot);
    // Proposes, makes and decides on one step; `decision` is only set if there was one.
    Stop attempt(StepDecision& decision);
    // Goes on to the next interval; whether its first stage could be evaluated, and is accurate.
    // Next to a singular configuration it may not be.
    bool enter();
    // Goes on to `end` as a run of its own, evaluated within [first, last]; the records of the
    // steps before are dropped.  `forces_jump`: forces may have jumped.  With `grid` > 0, fixed
    // steps of that length are counted from here.
    Stop go_on(double end, double first, double last, bool forces_jump, double grid,
               double seconds);

    // Lets the step of a passage that was made last, from `from` at `begin`, end at `end` within it:
    // CriticalPassages.steps_to in integration/critical_passages.py; whether it does.
    bool end_at(double begin, const std::vector<double>& from, double end, double time_unit,
                double reach);

    double t() const { return t_; }
    double last_h() const { return h_; }
    double t_end() const { return intervals_.ends.back(); }
    // Whether the next interval has still to be entered.
    bool at_breakpoint() const { return t_ >= intervals_.ends[interval_] && t_ < t_end(); }
    // End of the first of the steps over which the progress of the run is measured (s).
    double watched_time() const { return watched_time_; }
    double interval_end() const { return intervals_.ends[interval_]; }
    long interval() const { return static_cast<long>(interval_); }

    // The step made last.
    StepResult& last() { return made_by_->result; }
    const StepResult& last() const { return made_by_->result; }

    System& system;
    SplitStep step;
    std::unique_ptr<Control> control;
    IntegratorState memory;
    std::vector<double> state;

    StepRecords records;
    std::vector<double> end_rate;  // (n,), tangent rate at the end of the last step
    std::vector<Attempt> attempts;
    std::vector<ExaminedPassage> examined;  // with a residual
    // Of the steps whose records were dropped.
    long steps_before = 0, rejected_before = 0, zones_before = 0;
    bool evaluation_failed = false;  // in the last attempt

private:
    bool leaves_closures_open(const StepResult& result);
    std::optional<double> crossing(const StepResult& result);
    std::optional<double> approached(const StepResult& result);
    bool examine(double zero, bool expected);
    StepBeside beside(const StepResult& result);
    bool avoids(const CriticalConfiguration& critical) const;
    double late_past_layers(const StepResult& result) const;
    bool misses_jump(const Proposal& proposal, const StepResult& result);
    void follow(MotionAlongCurve motion);
    void prepare(const std::vector<PassagePoint>& points);
    Stop make_prepared();
    void record(const StepResult& result, double t, int placement);
    void enter_interval();
    void drop_records();
    bool restart_after_break();
    bool restart_interval();
    double direct_from() const;
    double longest_from_rest() const;

    const Constants& constants() const { return step.constants; }
    SplitStep& stepper();

    const ButcherTableau* const stiff_;
    std::optional<SplitStep> stiff_step_;  // made where the problem is first found to be stiff
    SplitStep* made_by_ = &step;

    SmoothIntervals intervals_;
    std::size_t interval_ = 0;
    double eps_factor_, eps_power_;
    double t0_, max_step_, t_, h_ = 0.0, smallest_;
    // Residual from which a step is looked at whether its correction closes all rows.
    double open_residual_;
    // sigma below which the next interval looks for a singular configuration.
    double search_below_;
    bool redone_ = false;
    long made_ = 0;  // steps, whether their records are still here or not
    double watched_time_ = 0.0;
    // The search for the end of a step on a jump of forces: JumpSearch in driver.py.
    double jump_limit_ = infinity;
    double rest_limit_ = infinity;  // of the step that leaves a rest at a breakpoint
    int jump_tries_ = 0;
    bool on_jump_ = false;
    bool inaccurate_ = false;  // the first stage after a jump: Python has to look at it
    bool examines_;
    double singular_tolerance_;
    const Collocation& collocation_;
    const bool one_freedom_;  // the closed configurations are curves, which may be followed
    bool first_ = true;       // no step was made
    bool known_ = false;      // the passage ahead has been examined
    bool quiet_ = false;      // the last step was
    // sigma below which the motion is examined again, where no passage was found so far.
    double examine_below_ = infinity;
    // The critical configuration that was examined last, if steps are to pass beside it.
    std::optional<CriticalConfiguration> avoided_;
    bool dead_end_ = false;  // drives lead to a dead point in a layer
    std::optional<ExaminedPassage> unresolved_;  // by the step that is made
    double curve_limit_ = infinity;  // of a step that changed the curve
    // Steps along a curve that are still to be made, the next one last, and their ends.
    std::vector<std::pair<StepResult, double>> prepared_;
    std::optional<MotionAlongCurve> passage_;  // one that is under way
};

}  // namespace srm
