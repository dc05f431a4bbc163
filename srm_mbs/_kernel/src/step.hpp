// Twin of srm_mbs/integration/methods/split_step.py, branch.py and zone.py: one step of the split PSRM.
#pragma once

#include <vector>

#include "history.hpp"
#include "system.hpp"

namespace srm {

struct Scheme {
    int stages = 0;
    std::vector<double> A, b, c;  // (s, s) row-major, (s,), (s,)
    std::vector<double> error;    // (s + 1,), empty without an embedded pair
    int controller_order = 1;
    std::vector<double> gap_centres, gap_half_widths;  // the widest first
};

// The constants of srm_mbs/methods, passed in from Python.
struct StepConstants {
    double watched, near, far, ambiguous, held, rounding, usual, crosses, lead, most_floor,
        zone_largest, count_uncertainty_above, hit;
    int projections, fewest, gap_every;
};

struct ErrorNorm {
    std::vector<double> atol, one;  // (n,)
    double rtol = 0.0, negligible = 0.0;

    double weight(int i, double magnitude) const { return atol[i] + rtol * magnitude; }
    static double ratio(const double* error, const double* weights, int n);
};

// Twin of srm_mbs/integration/control/step_size.py, initial_step, and its constants.
struct FirstStepConstants {
    double overflow, probe, longest;
};
double initial_step(System& system, const ErrorNorm& norm, double t, const double* state,
                    const double* rate, const double* magnitude, double span, int order,
                    const FirstStepConstants& constants);

struct Memory {
    std::vector<double> rate, magnitude;  // (n,)
    double sigma = 0.0, sigma_slope = 0.0;
    long steps = 0;
    bool has_history = false;
    History history;
};

struct StepResult {
    double t = 0.0, h = 0.0;
    std::vector<double> state, rates, end_rate, correction, magnitude, sigmas, multiplier, normals;
    int normal_count = 0;
    double error_ratio = 0.0, gap = 0.0;
    int rank = 0;
    bool in_zone = false, has_multiplier = false, has_normals = false, quiet = false, held = false;
    double zone_threshold = 0.0;
};

// Makes steps; owns everything a step works on, so that none allocates.
class SplitStep {
public:
    SplitStep(System& system, Scheme scheme, StepConstants constants, ErrorNorm norm);

    // One step from `state`; see srm_mbs/integration/methods/base.py.  Throws EvaluationError.
    const StepResult& make(double t, double h, const double* state, const Memory& memory,
                           double theta);
    // Moves `memory` to the end of the step made last.
    void accept(Memory& memory);

    StepResult result;
    const Scheme scheme;
    const ErrorNorm norm;
    const StepConstants constants;

private:
    struct Branch {
        bool near = false, projected = false;
        double excused = 0.0;
        System::ZoneView zone;
    };
    void prepare_branch(const Memory& memory, double end, double sigma_change);
    bool onto_branch(double t, double c, const Memory& memory, double sigma_change);
    void turning(const double* error, double sigma, double change, double* out) const;
    void rounding(double sigma, double change, bool projected, double* out) const;
    double known_from(const Memory& memory, double sigma_change, double allowed) const;
    double uncertainty(const History& history, double end);
    bool lingers(const Memory& memory, double threshold) const;
    void add_floor(const Memory& memory, double sigma_change);
    void widen(double sigma_change);

    System& system_;
    const int nv_, n_, nx_;
    double h_ = 0.0;
    Branch branch_;
    std::vector<double> x_, delta_, rate_, weights_, error_, moved_, uncertainty_;
    mutable std::vector<double> scratch_, noise_;
    std::vector<int> weak_stages_;
};

}  // namespace srm
