// One step of the split PSRM: methods/split_step.py and methods/near_singular.py.
#pragma once

#include <memory>
#include <optional>
#include <vector>

#include "branch_nodes.hpp"
#include "constants.hpp"
#include "history.hpp"
#include "linear_stages.hpp"
#include "struct_fields.hpp"
#include "system.hpp"

namespace srm {

#define SRM_BUTCHER_TABLEAU(field)                                                    \
    field(std::vector<double>, A)               /* (s, s), row by row */              \
    field(std::vector<double>, b)               /* (s,) */                            \
    field(std::vector<double>, c)               /* (s,) */                            \
    field(std::vector<double>, error)           /* (s + 1,); empty: no embedded pair */ \
    field(int, controller_order)                                                      \
    field(std::vector<double>, implicit)        /* (s, s); empty: an explicit scheme */ \
    field(int, lead)                            /* last stage with the rate at the start */ \
    field(double, stable_to)                    /* h |lambda|; 0: not tested */        \
    /* Intervals between the abscissae, the widest first. */                          \
    field(std::vector<double>, gap_centres)                                           \
    field(std::vector<double>, gap_half_widths)

struct ButcherTableau {
    SRM_FIELDS(SRM_BUTCHER_TABLEAU)

    int stages() const { return static_cast<int>(b.size()); }
    void check() const;
};

#define SRM_ERROR_NORM(field)                                                     \
    field(std::vector<double>, atol) /* (n,) */                                   \
    field(std::vector<double>, one)  /* (n,), a unit of each component */         \
    field(std::vector<double>, unit) /* (n,), its usual size */                   \
    field(double, rtol)                                                           \
    field(double, negligible)        /* part of the tolerance; 0: fixed steps */   \
    field(double, singular)          /* residual (row units) that branches may have */

// xi = sqrt(mean_i (e_i / (atol_i + rtol |x_i|))^2)
struct ErrorNorm {
    SRM_FIELDS(SRM_ERROR_NORM)

    double weight(int i, double state_scale) const { return atol[i] + rtol * state_scale; }
    static double ratio(const double* error, const double* weights, int n);
    void check() const;
};

// Length (s) of the first step: initial_step in control/step_size.py.
double initial_step(System& system, const ErrorNorm& norm, double t, const double* state,
                    const double* rate, const double* state_scale, double span, int order,
                    const Constants& constants, double smooth);

#define SRM_INTEGRATOR_STATE(field)                                                       \
    field(std::vector<double>, rate)        /* (n,), tangent rate: the next first stage */ \
    field(std::vector<double>, state_scale) /* (n,), |x| of the error weights */          \
    field(double, sigma)                                                                  \
    field(double, sigma_slope)              /* |d sigma / dt| of the last steps (1/s) */  \
    field(bool, lingering)                  /* turns, or is slow, at small sigma */        \
    field(long, steps)                                                                    \
    field(bool, stiff)                      /* the problem was found to be stiff */       \
    field(int, stiff_steps)                 /* that speak for a change of that, */        \
    field(std::vector<double>, laws)        /* (m,), of forces, in linearly implicit steps */ \
    field(int, other_steps)                 /* and those after the last of them that do not */ \
    field(int, needed_steps)                /* of them, after which a problem is stiff */ \
    field(double, saved_steps)              /* by implicit steps, since it is */          \
    field(std::optional<MultiplierHistory>, history) /* none without closures */

// The values that a method carries from one accepted step to the next.
struct IntegratorState {
    SRM_FIELDS(SRM_INTEGRATOR_STATE)

    void check() const;
};

// The memory at the start of a run, from a direct evaluation of `state` at t: start in
// split_step.py.
IntegratorState first_stage(System& system, double t, const double* state);

struct StepResult {
    double t = 0.0, h = 0.0;
    std::vector<double> state;        // (nx,), at the end, corrected
    std::vector<double> rates;        // (s + 1, n), chart rates of the stages and the end
    std::vector<double> end_rate;     // (n,), tangent rate at the corrected end
    std::vector<double> correction;   // (n,), subtracted from the uncorrected end
    std::vector<double> state_scale;  // (n,)
    std::vector<double> sigmas;       // (s + 1,)
    std::vector<double> multiplier;   // (nv,), at the end
    std::vector<double> normals;      // (k, nv), at the end; empty: none
    std::vector<double> away;         // (nv,), at an end that branch nodes solved; else empty
    double error_ratio = 0.0;
    double residual = 0.0;  // largest of all closure rows before the correction; 0: not evaluated
    int rank = 0;           // smallest of all stages
    bool has_multiplier = false;
    bool in_zone = false;  // a stage was in the zone
    bool quiet = false;    // the whole step is far from singular configurations
    bool held = false;     // a stage kept the normals of the last node
    bool stiff = false;        // the problem had been found to be stiff before the step
    bool lost_branch = false;  // nodes of the branch were wanted and not found
    bool critical = false;     // along the curve past a critical configuration
    double zone_threshold = 0.0;
};

// Makes steps; owns the memory that a step works in, so that none allocates.
class SplitStep {
public:
    // The structs are not copied: their owner outlives the steps.
    SplitStep(System& system, const ButcherTableau& scheme, const Constants& constants,
              const ErrorNorm& norm);

    // One step from `state`, of whose end correction the fraction theta is applied.  Throws
    // EvaluationError.
    const StepResult& make(double t, double h, const double* state, const IntegratorState& memory,
                           double theta);
    // Moves `memory` to the end of the step made last.
    void accept(IntegratorState& memory);

    StepResult result;
    const ButcherTableau& scheme;
    const ErrorNorm& norm;
    const Constants& constants;

private:
    // How the stages of the step are evaluated next to a singular configuration.
    struct Branch {
        bool near = false;             // stages are projected onto their branch
        bool projected = false;        // one of them was moved
        double inaccurate_below = 0.0; // sigma below which direct solves exceed the tolerance
        System::ZoneView zone;
    };
    void prepare_branch(const IntegratorState& memory, double end, double sigma_change);
    bool solve_on_branch(double t, double start, const double* state,
                         const IntegratorState& memory);
    bool project_stage(double t, double c, const IntegratorState& memory, double sigma_change);
    void linear_rate(int j, const std::vector<double>& laws);
    void apply_laws(int j);
    double stiffness() const;
    void add_reversal_errors(const IntegratorState& memory);
    bool chatters(const IntegratorState& memory) const;
    void count_stiffness(IntegratorState& memory);
    void evaluate_stages(double t, const double* state, const IntegratorState& memory,
                         double sigma_change);
    void finish(double theta, bool constrained);
    void estimate_error(const IntegratorState& memory, double sigma_change);
    void rate_error(const double* error, double sigma, double change, double* out) const;
    void rounding_error(double sigma, double change, bool projected, double* out) const;
    double direct_from(const IntegratorState& memory, double sigma_change, double allowed) const;
    double prediction_error(const MultiplierHistory& history, double end);
    bool holding_suffices(const IntegratorState& memory, double threshold) const;
    void add_floor(const IntegratorState& memory, double sigma_change);
    void add_rounding(double sigma_change);

    System& system_;
    const int nv_, n_, nx_;
    double h_ = 0.0;
    bool monitored_ = false;  // the step starts next to a singular configuration
    bool moved_end_ = false;  // the end stage was moved by `moved_`
    // The motion lingers, its stages next to the singular configuration are solved by nodes of the
    // branch; one of them was; the end was.
    bool lingers_ = false, noded_ = false, noded_end_ = false;
    bool touches_ = false;  // branches touch there
    // Made by the first step that lingers.
    std::optional<BranchNodes> nodes_;
    std::optional<TouchingBranch> touching_;
    // Of a linearly implicit scheme; with the weights (s, s) of the rates in its linear terms, over
    // gamma, and the sums of its rows (s,).
    std::unique_ptr<LinearStages> linear_;
    std::vector<double> linear_weights_, time_shares_;
    std::vector<double> law_rates_, applied_, law_shares_;  // (s, m); (m,) of a stage
    std::vector<double> apart_;  // (n,), the arguments of the last two stages, one from the other
    std::vector<double> away_;
    Branch branch_;
    std::vector<double> x_, delta_, rate_, weights_, error_, moved_, uncertainty_;
    mutable std::vector<double> scratch_, noise_;
    std::vector<int> deficient_stages_;  // stages with fewer rows than the structural rank
};

}  // namespace srm
