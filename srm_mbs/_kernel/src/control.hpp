// Step size, placement and branch guard: control/step_size.py, control/placement.py,
// control/branch_guard.py and SlopeOfSigma of control/prescribed_times.py.
#pragma once

#include <algorithm>
#include <memory>
#include <vector>

#include "limits.hpp"
#include "step.hpp"
#include "struct_fields.hpp"

namespace srm {

enum class StepDecision { accepted = 0, rejected = 1, replaced = 2 };

struct Proposal {
    double h, t_new;
    bool placed = false;
    bool arriving = false;  // to be proposed again, after Python has prepared for the end
};

#define SRM_CONTROL_STATE(field)                                                            \
    /* Step-size control: next step (s), last error ratio. */                               \
    field(double, h)                                                                        \
    field(double, xi_old)                                                                   \
    field(bool, just_rejected)                                                              \
    /* Fixed steps: number of the next grid point. */                                       \
    field(long, index)                                                                      \
    /* Placement: |d sigma / dt| (1/s), predicted zero of sigma (s) or NaN, step that replaces \
       the last one (s) or 0, its tries, state of the arrival. */                           \
    field(double, slope)                                                                    \
    field(double, zero)                                                                     \
    field(double, zero_error) /* of sigma there */                                          \
    field(double, expected) /* the zero that is examined (s), or NaN */                     \
    field(double, redo)                                                                     \
    field(int, redone)                                                                      \
    field(int, arrival)                                                                     \
    /* Whether the motion turns back or is slow, and whether its branch was lost. */        \
    field(bool, turning)                                                                    \
    field(bool, lost_branch)                                                                \
    /* Branch guard: longest step (s), tries. */                                            \
    field(double, limit)                                                                    \
    field(int, tries)

// The values that a control carries from step to step.
struct ControlState {
    SRM_FIELDS(SRM_CONTROL_STATE)
};

class Control {
public:
    virtual ~Control() = default;
    virtual void resume(const ControlState& state) = 0;
    virtual void save(ControlState& state) const = 0;
    // Counts fixed steps of length `step` from t0.
    virtual void start_grid(double t0, double step) = 0;
    virtual Proposal propose(double t, double limit, IntegratorState& memory) = 0;
    // `result` is null if a stage could not be evaluated.
    virtual StepDecision decide(const Proposal& proposal, const StepResult* result) = 0;
    // A step ends on `end`: a breakpoint, or the end of the run.
    virtual void set_target_time(double end) = 0;
    // The run is at t by steps that no control proposed.
    virtual void moved(double t) = 0;
    // When sigma is expected to vanish; NaN if that is not to be seen.
    virtual double next_zero() const { return not_a_number; }
    bool adaptive = true;
    long placed = 0, replaced = 0;
};

class PIControl : public Control {
public:
    // stiff_order: that of the steps where the problem is stiff.
    PIControl(double t_end, double first_step, int order, int stiff_order,
              const Constants& constants)
        : t_end_(t_end),
          h_(first_step),
          orders_{order, stiff_order},
          order_(order),
          constants_(constants) {}
    Proposal propose(double t, double limit, IntegratorState& memory) override;
    StepDecision decide(const Proposal& proposal, const StepResult* result) override;
    void set_target_time(double end) override { t_end_ = end; }
    void moved(double) override {}
    void start_grid(double, double) override {}
    void resume(const ControlState& s) override {
        h_ = s.h;
        xi_old_ = s.xi_old;
        just_rejected_ = s.just_rejected;
    }
    void save(ControlState& s) const override {
        s.h = h_;
        s.xi_old = xi_old_;
        s.just_rejected = just_rejected_;
    }

private:
    double t_end_, h_;
    int orders_[2], order_;
    const Constants& constants_;
    double xi_old_ = 1.0;
    bool just_rejected_ = false;
};

class FixedStep : public Control {
public:
    FixedStep(double t0, double t_end, double step, const Constants& constants)
        : t0_(t0), t_end_(t_end), step_(step), constants_(constants) {
        adaptive = false;
    }
    Proposal propose(double t, double limit, IntegratorState& memory) override;
    StepDecision decide(const Proposal& proposal, const StepResult* result) override;
    void moved(double t) override {
        while (t >= t0_ + static_cast<double>(index_) * step_ - sliver()) ++index_;
    }
    void set_target_time(double end) override { t_end_ = end; }
    void start_grid(double t0, double step) override {
        t0_ = t0;
        step_ = step;
        index_ = 1;
    }
    void resume(const ControlState& s) override { index_ = s.index; }
    void save(ControlState& s) const override { s.index = index_; }

private:
    double sliver() const { return std::max(1e-9, 1e-14 * static_cast<double>(index_)) * step_; }

    double t0_, t_end_, step_;
    const Constants& constants_;
    long index_ = 1;
};

// Intervals between the abscissae, in which a zero of sigma does no harm.
class Gaps {
public:
    Gaps(const ButcherTableau& scheme, double clearance);
    double longest_step(double distance, double h) const;
    bool ends_on(double distance, double h) const;
    double step_over(double distance) const;

private:
    double centre_, clearance_, first_;
    std::vector<double> wide_centres_, wide_ends_;  // ascending
};

// A control that limits the steps of another one.
class ControlWrapper : public Control {
public:
    explicit ControlWrapper(std::unique_ptr<Control> inner) : inner_(std::move(inner)) {
        adaptive = inner_->adaptive;
    }
    void set_target_time(double end) override { inner_->set_target_time(end); }
    void moved(double t) override { inner_->moved(t); }
    double next_zero() const override { return inner_->next_zero(); }
    void start_grid(double t0, double step) override { inner_->start_grid(t0, step); }

protected:
    std::unique_ptr<Control> inner_;
};

// Where the stages of a scheme lie in a step.
struct StagePlaces {
    StagePlaces(const ButcherTableau& scheme, double clearance, double slope_from);

    Gaps gaps;
    std::vector<double> abscissae;
    int middle;         // stage next to the middle of the step
    double slope_from;  // least abscissa by which sigma has a slope
};

// `stiff`: the scheme where the problem is stiff.
class SingularityPlacement : public ControlWrapper {
public:
    SingularityPlacement(std::unique_ptr<Control> inner, const ButcherTableau& scheme,
                         const ButcherTableau& stiff, double t_end, const Constants& constants,
                         bool arrivals, bool scatters);
    Proposal propose(double t, double limit, IntegratorState& memory) override;
    StepDecision decide(const Proposal& proposal, const StepResult* result) override;
    void set_target_time(double end) override {
        t_end_ = end;
        arrival_ = first_arrival_;
        inner_->set_target_time(end);
    }
    double next_zero() const override { return expected_; }
    void moved(double t) override {
        inner_->moved(t);
        zero_ = expected_ = not_a_number;
        redo_ = 0.0;
        redone_ = 0;
    }
    void resume(const ControlState& s) override {
        inner_->resume(s);
        arrival_ = static_cast<Arrival>(s.arrival);
        slope_ = s.slope;
        zero_ = s.zero;
        zero_error_ = s.zero_error;
        expected_ = s.expected;
        redo_ = s.redo;
        redone_ = s.redone;
        turning_ = s.turning;
        lost_branch_ = s.lost_branch;
    }
    void save(ControlState& s) const override {
        inner_->save(s);
        s.arrival = static_cast<int>(arrival_);
        s.slope = slope_;
        s.zero = zero_;
        s.zero_error = zero_error_;
        s.expected = expected_;
        s.redo = redo_;
        s.redone = redone_;
        s.turning = turning_;
        s.lost_branch = lost_branch_;
    }

private:
    double placed_step(double distance, double h, double t) const;
    double better_step(double h, const std::vector<double>& sigmas, double slope, bool last) const;
    bool arrives(double t, const Proposal& proposal) const;
    bool lingers(const Proposal& proposal, const IntegratorState& memory) const;

    // Whether the end next to a singular configuration matters: not, or not any more; if one is
    // found; it was, and stages are solved by nodes of the branch.
    enum class Arrival { none = 0, watched = 1, due = 2 };

    const Constants& constants_;
    double t_end_;
    Arrival first_arrival_, arrival_;
    // The multipliers up to the end are known; those next to the singular configuration are solved
    // by nodes of the branch.
    bool known_ = false, lingering_ = false;
    bool turning_ = false, lost_branch_ = false;
    StagePlaces members_[2];
    const StagePlaces* places_ = &members_[0];
    double slope_ = 0.0, zero_, zero_error_ = 0.0, redo_ = 0.0;
    double expected_ = not_a_number;
    int redone_ = 0;
};

// Measures |d sigma / dt|, and places nothing.
class SlopeOfSigma : public ControlWrapper {
public:
    SlopeOfSigma(std::unique_ptr<Control> inner, const ButcherTableau& scheme,
                 const ButcherTableau& stiff);
    Proposal propose(double t, double limit, IntegratorState& memory) override;
    StepDecision decide(const Proposal& proposal, const StepResult* result) override;
    void resume(const ControlState& s) override {
        inner_->resume(s);
        slope_ = s.slope;
    }
    void save(ControlState& s) const override {
        inner_->save(s);
        s.slope = slope_;
    }

private:
    std::vector<double> members_[2];
    const std::vector<double>* abscissae_ = &members_[0];
    double slope_ = 0.0;
};

// Halves steps that may have changed the branch.
class BranchGuard : public ControlWrapper {
public:
    BranchGuard(std::unique_ptr<Control> inner, const System& system, const Constants& constants);
    Proposal propose(double t, double limit, IntegratorState& memory) override;
    StepDecision decide(const Proposal& proposal, const StepResult* result) override;
    void moved(double t) override {
        inner_->moved(t);
        limit_ = infinity;
        tries_ = 0;
    }
    void resume(const ControlState& s) override {
        inner_->resume(s);
        limit_ = s.limit;
        tries_ = s.tries;
    }
    void save(ControlState& s) const override {
        inner_->save(s);
        s.limit = limit_;
        s.tries = tries_;
    }
    std::vector<double> suspect_times;  // ends (s) of steps that were accepted although suspect

private:
    bool velocity_jumps(const StepResult& result) const;

    const System& system_;
    const Constants& constants_;
    double limit_ = infinity;
    int tries_ = 0;
    mutable std::vector<double> work_;
};

// sigma = start + a x + b x^2 over a step.
struct Parabola {
    // Through (c, middle) and (1, end); the line through (1, end) if c is next to an end of the step.
    Parabola(double c, double start, double middle, double end);
    double operator()(double x) const { return start + x * (a + x * b); }

    double start, a, b;
};

// Error of the parabola through sigma at the start, the stage `middle` and the end of a step at
// `ahead` steps from its start, if its largest misfit at the stages is that of a cubic term.
double error_of_parabola(const std::vector<double>& abscissae, int middle,
                         const std::vector<double>& sigmas, double ahead);
// The zero of sigma in (0, 1 + a little] of a step; NaN without one.
double zero_within(const std::vector<double>& abscissae, const std::vector<double>& sigmas);
// The next zero of sigma, in steps from the start of the last one; NaN if it is further than
// `horizon`.
double zero_ahead(double c, double start, double middle, double end, double horizon);
// The extreme value of the parabola through sigma at the start, the stage `middle` and the end of a
// step, with its sign changed where the step passes a zero; infinite if its misfit at the stages is
// larger than the part `allowed` of the change of sigma.
double extreme_sigma(const std::vector<double>& abscissae, int middle,
                     const std::vector<double>& sigmas, double allowed);

}  // namespace srm
