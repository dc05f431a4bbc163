// The state at any time of a run: dense_output.py.
#pragma once

#include <limits>
#include <memory>
#include <unordered_map>
#include <utility>
#include <vector>

#include "struct_fields.hpp"
#include "system.hpp"

namespace srm {

#define SRM_EXTENSION(field)                                                             \
    field(int, n_rates)                    /* rates of the step and of the extra stages */ \
    field(std::vector<double>, rows)       /* (degree, n_rates), nested form */          \
    field(std::vector<double>, extra_A)    /* (extra stages, n_rates) */                 \
    field(std::vector<double>, extra_c)

// The continuous extension of a tableau: methods/butcher.py.
struct Extension {
    SRM_FIELDS(SRM_EXTENSION)

    int degree() const { return static_cast<int>(rows.size()) / n_rates; }
    int extra_stages() const { return static_cast<int>(extra_c.size()); }
    void weights(double theta, double* out) const;
    void check() const;
};

#define SRM_DENSE_CONSTANTS(field)                                                            \
    field(std::vector<int>, nodes)     /* ends of steps of the three polynomials */           \
    field(double, spacing)             /* smallest distance of nodes, over the step */        \
    field(int, away_reach)             /* steps to look for nodes away from branch_below */   \
    field(int, least_away)             /* fewest of these that are used alone */              \
    field(double, close)               /* sigma next to a singularity, over its change per step */ \
    field(double, branch_below)        /* the same, of lingering motions, as it is */              \
    field(std::vector<double>, probes) /* fractions at which polynomials are compared */      \
    field(double, slack)               /* relative time that may be read beyond the ends */

struct DenseConstants {
    SRM_FIELDS(SRM_DENSE_CONSTANTS)

    void check() const;
};

// Whether stages of a step, with sigma (abscissae,), lie close to a singular configuration:
// close_to_singular() of dense_output.py.
bool close_to_singular(const std::vector<double>& abscissae, const double* sigmas, double close,
                       double branch_below);

// The accepted steps, as arrays that the caller keeps alive.
struct StepArrays {
    long count = 0;
    double end = 0.0;        // of the run (s)
    int width = 0;           // rates per step
    bool corrected = false;
    const double *times, *states, *rates, *corrections, *sigmas, *error_ratios, *end_rate;
    std::vector<char> in_zone;  // (count,)
    const double* layers = nullptr;  // (count, 2), time and width (s) of the layer; width 0: none
    std::vector<char> stiff;    // (count,), of the scheme for stiff problems, if there is one
    std::vector<long> breaks;   // numbers of the steps that end on breakpoints, from 1
    const double* break_rates = nullptr;  // (breaks, n), tangent rates before them
};

#define SRM_SCHEME_DENSE(field)            \
    field(std::vector<double>, abscissae) \
    field(Extension, extension)

// The dense output of a scheme.
struct SchemeDense {
    SRM_FIELDS(SRM_SCHEME_DENSE)
};

constexpr int most_nodes = 16;  // of a polynomial of the dense output

// Rates of the coordinates at the ends of steps (steps + 1, nx), as far as they are known, in
// the smooth interval that ends at `last`.
struct EndRates {
    long last = -1;
    std::vector<char> known;
    std::unique_ptr<double[]> rates;  // written where they are known
};
// Ends around a step in order of their distance, 0 if there are not enough; of the first `count`
// of them, in use, the states and the rates of their coordinates, and of Hermite's polynomial
// through these but the furthest the products of distances of each from the others, whose
// inverses are the weights of Lagrange's basis, and its slope there.
struct EndNodes {
    long step = -1;
    int all = 0, count = 0;
    long nodes[most_nodes];
    const double *states[most_nodes], *rates[most_nodes];
    double points[most_nodes], products[most_nodes], slopes[most_nodes];
};
// What DenseOutput::between_ends keeps between its calls.
struct EndReadings {
    EndNodes nodes;
    EndRates rates;
    std::vector<double> allowed;  // (nx,), of the coordinates
};

class DenseOutput {
public:
    // schemes: that of the run and, where it has one, that for stiff problems.
    DenseOutput(int nq, int nv, const std::vector<SchemeDense>& schemes, DenseConstants constants,
                StepArrays steps);
    // States (k, nx) at the times t (k,); `system` is any workspace of the mechanism.  Throws
    // std::out_of_range for times outside the run.
    void states(System& system, const double* t, long k, double* out);
    // The same by polynomials through ends of steps, without an evaluation, where two of them agree
    // within `allowed` (n,).  `known`: of readings before.
    void between_ends(System& system, const double* t, long k, const double* allowed,
                      EndReadings& known, double* out);

    const StepArrays& steps() const { return steps_; }
    // Numbers of sigma in each step.
    long sigma_width() const { return static_cast<long>(schemes_[0].abscissae.size()); }
    // StepData.with_stages for one step of an explicit scheme.
    bool has_stages(long step) const;
    // Whether a step takes further stages to be read.
    bool takes_stages() const { return schemes_[0].extension.extra_stages() > 0; }

private:
    long step_at(double t) const;
    const double* coordinate_rate(const System& system, long node, long last,
                                  EndRates& rates) const;
    void take_ends(long step, EndNodes& ends) const;
    void use_ends(const System& system, int count, EndRates& rates, EndNodes& ends) const;
    bool near_ends(const System& system, double theta, const double* allowed, EndRates& rates,
                   EndNodes& ends, double* out);
    bool through_ends(const System& system, const EndNodes& ends, double theta,
                      const double* allowed, double* out);
    struct Nodes {
        int count = 0;
        long at[most_nodes];  // ends of steps, ascending
    };
    struct Polynomial {
        std::vector<double> points, coefficients;  // (k,), (k, n): Newton form
        bool in_layer = false;  // a polynomial in the variable of the layer
    };
    std::pair<long, long> smooth_interval(long step) const;
    const double* rate_at(long node, long last) const;
    bool close_to_singular(long step) const;
    const std::vector<double>& extra_rates(System& system, long step, double h);
    void extended(System& system, long step, double theta, double* out);
    const Polynomial& best_polynomial(System& system, long step);
    // charts: the mechanism, if the nodes are to lie in the chart of the step.
    Nodes nodes(const System* charts, long step, int count, double least_sigma = 0.0,
                long reach = std::numeric_limits<long>::max()) const;
    void motion(long step, long node, double* out) const;
    Nodes nodes_away(const System* charts, long step, int count) const;
    void hermite(System& system, long step, const Nodes* sets, int set_count, bool in_layer,
                 Polynomial* out);
    double variable(long step, double theta, bool in_layer, double* growth = nullptr) const;
    void value(const Polynomial& polynomial, double theta, double* out) const;

    struct Scheme {
        std::vector<double> abscissae;
        Extension extension;
        // Weights of the rates over a whole step, as far as the steps have them: those of extra
        // stages are zero.
        std::vector<double> whole;
    };
    const Scheme& scheme_of(long step) const {
        return schemes_[steps_.stiff[step] ? schemes_.size() - 1 : 0];
    }

    std::vector<Scheme> schemes_;
    DenseConstants constants_;
    StepArrays steps_;
    const int n_, nx_;
    // Of the steps that needed them, which of long runs are few.
    std::unordered_map<long, std::vector<double>> extra_;
    std::unordered_map<long, Polynomial> polynomials_;
    enum class Place : char { unknown, regular, near_singular };
    std::vector<Place> places_;
    std::vector<double> delta_, x_, weights_, near_, rate_, points_, slopes_, differences_;
    Polynomial tried_[3];
};

}  // namespace srm
