// Twin of srm_mbs/integration/control/step_size.py, placement.py, singular_times.py (SlopeOfSigma) and
// guard.py: how long the next step is, and whether the last one stands.
#pragma once

#include <algorithm>
#include <limits>
#include <memory>
#include <vector>

#include "step.hpp"

namespace srm {

enum class Verdict { accepted = 0, rejected = 1, replaced = 2 };

struct Proposal {
    double h, t_new;
    bool placed = false;
    bool arriving = false;  // to be proposed again, after Python has prepared for the end
};

// The constants of srm_mbs/stepping, passed in from Python.
struct ControlConstants {
    double safety, min_factor, max_factor, proportional, integral, xi_old_floor, xi_floor,
        failed_evaluation;                                  // stepsize.py
    double sigma_change, too_close, clearance, ahead;       // placement.py, kinks.py
    int max_redone;
    double beside, arrival_change;
    double turned;                                          // turning.py
    int guard_max_redone;
};

// What a control remembers from step to step, for comparison with the reference.
struct ControlState {
    double h = 0.0, xi_old = 1.0;
    bool just_rejected = false;
    long index = 1;
    double slope = 0.0, zero = std::numeric_limits<double>::quiet_NaN(), redo = 0.0;
    int redone = 0;
    double limit = std::numeric_limits<double>::infinity();
    int tries = 0;
    int arrival = 0;
};

class Control {
public:
    virtual ~Control() = default;
    virtual void resume(const ControlState& state) = 0;
    // What `resume` goes on from.
    virtual void save(ControlState& state) const = 0;
    // A grid of fixed steps starts anew.
    virtual void grid(double, double) {}
    virtual Proposal propose(double t, double limit, Memory& memory) = 0;
    // `result` is null if a stage could not be evaluated.
    virtual Verdict judge(const Proposal& proposal, const StepResult* result) = 0;
    // A step ends on `end`: a breakpoint, or the end of the run.
    virtual void aim(double end) = 0;
    bool adaptive = true;
    long placed = 0, replaced = 0;
};

class PIControl : public Control {
public:
    PIControl(double t_end, double first_step, int order, const ControlConstants& constants)
        : t_end_(t_end), h_(first_step), order_(order), constants_(constants) {}
    Proposal propose(double t, double limit, Memory& memory) override;
    Verdict judge(const Proposal& proposal, const StepResult* result) override;
    void aim(double end) override { t_end_ = end; }
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
    int order_;
    ControlConstants constants_;
    double xi_old_ = 1.0;
    bool just_rejected_ = false;
};

class FixedStep : public Control {
public:
    FixedStep(double t0, double t_end, double step) : t0_(t0), t_end_(t_end), step_(step) {
        adaptive = false;
    }
    Proposal propose(double t, double limit, Memory& memory) override;
    Verdict judge(const Proposal& proposal, const StepResult* result) override;
    void aim(double end) override { t_end_ = end; }
    void grid(double t0, double step) override {
        t0_ = t0;
        step_ = step;
        index_ = 1;
    }
    void resume(const ControlState& s) override { index_ = s.index; }
    void save(ControlState& s) const override { s.index = index_; }

private:
    double sliver() const { return std::max(1e-9, 1e-14 * static_cast<double>(index_)) * step_; }

    double t0_, t_end_, step_;
    long index_ = 1;
};

// Where, as a fraction of the step, a zero of sigma does no harm.
class Gaps {
public:
    Gaps(const Scheme& scheme, double clearance);
    double longest_step(double distance, double h) const;
    bool ends_on(double distance, double h) const;
    double step_over(double distance) const;

private:
    double centre_, clearance_, first_;
    std::vector<double> wide_centres_, wide_ends_;  // ascending
};

class SingularityPlacement : public Control {
public:
    SingularityPlacement(std::unique_ptr<Control> inner, const Scheme& scheme, double t_end,
                         const ControlConstants& constants, bool arrivals);
    Proposal propose(double t, double limit, Memory& memory) override;
    Verdict judge(const Proposal& proposal, const StepResult* result) override;
    void aim(double end) override {
        t_end_ = end;
        arrival_ = watched_;
        inner_->aim(end);
    }
    void resume(const ControlState& s) override {
        inner_->resume(s);
        arrival_ = static_cast<Arrival>(s.arrival);
        slope_ = s.slope;
        zero_ = s.zero;
        redo_ = s.redo;
        redone_ = s.redone;
    }
    void save(ControlState& s) const override {
        inner_->save(s);
        s.arrival = static_cast<int>(arrival_);
        s.slope = slope_;
        s.zero = zero_;
        s.redo = redo_;
        s.redone = redone_;
    }
    void grid(double t0, double step) override { inner_->grid(t0, step); }

private:
    double placed_step(double distance, double h, double t) const;
    double better_step(double h, const std::vector<double>& sigmas, double slope, bool last) const;
    bool arrives(double t, const Proposal& proposal) const;

    // What is known of an end beside a singular configuration.
    enum class Arrival { none = 0, watched = 1, due = 2 };

    std::unique_ptr<Control> inner_;
    ControlConstants constants_;
    double t_end_;
    Arrival watched_, arrival_;
    bool known_ = false;
    Gaps gaps_;
    std::vector<double> abscissae_;
    int middle_;
    double slope_ = 0.0, zero_, redo_ = 0.0;
    int redone_ = 0;
};

// Only the slope of sigma.
class SlopeOfSigma : public Control {
public:
    SlopeOfSigma(std::unique_ptr<Control> inner, const Scheme& scheme);
    Proposal propose(double t, double limit, Memory& memory) override;
    Verdict judge(const Proposal& proposal, const StepResult* result) override;
    void aim(double end) override { inner_->aim(end); }
    void resume(const ControlState& s) override {
        inner_->resume(s);
        slope_ = s.slope;
    }
    void save(ControlState& s) const override {
        inner_->save(s);
        s.slope = slope_;
    }
    void grid(double t0, double step) override { inner_->grid(t0, step); }

private:
    std::unique_ptr<Control> inner_;
    std::vector<double> abscissae_;
    double slope_ = 0.0;
};

class BranchGuard : public Control {
public:
    BranchGuard(std::unique_ptr<Control> inner, const System& system,
                const ControlConstants& constants);
    Proposal propose(double t, double limit, Memory& memory) override;
    Verdict judge(const Proposal& proposal, const StepResult* result) override;
    void aim(double end) override { inner_->aim(end); }
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
    void grid(double t0, double step) override { inner_->grid(t0, step); }
    std::vector<double> suspects;

private:
    bool turned(const StepResult& result) const;

    std::unique_ptr<Control> inner_;
    const System& system_;
    ControlConstants constants_;
    double limit_ = std::numeric_limits<double>::infinity();
    int tries_ = 0;
    mutable std::vector<double> work_;
};

// Where in (0, 1 + a little] a step passes a zero of sigma; NaN if it does not.
double zero_within(const std::vector<double>& abscissae, const std::vector<double>& sigmas);
// Where sigma will vanish, in steps from the start of the last one; NaN if not soon.
double zero_ahead(double c, double start, double middle, double end, double ahead);

}  // namespace srm
