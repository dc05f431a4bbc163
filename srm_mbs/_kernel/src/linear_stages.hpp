// The linear systems of the stages of a linearly implicit step: methods/linear_split_step.py.
#pragma once

#include <functional>
#include <vector>

#include "constants.hpp"
#include "system.hpp"
#include "touching_branch.hpp"

namespace srm {

// With J = [B I; C D], the derivatives of the chart rates (u', v') by the chart coordinates, and
// k = h gamma, the equations (1 - k J) (x, y) = (a, b) are
//
//     x = S (a + k y),   (1 - k D - k^2 C S) y = b + k C S a,   S = (1 - k B)^-1,
//
// S the identity but for ball, free and planar joints: nv equations, not 2 nv.  Next to a singular
// configuration, where stages are evaluated on their branch, J has no such blocks.
class LinearStages {
public:
    // How stages are evaluated: with this zone, on their branch, and where the motion lingers by
    // nodes of it, a stage (nx,) at t (s), or null where there are none.
    struct Places {
        System::ZoneView zone;
        bool on_branch = false;
        std::function<const StageOnBranch*(double, const double*)> by_nodes;
    };

    LinearStages(System& system, double gamma, std::vector<double> unit,
                 const Constants& constants);

    // Linearises the system at the start of a step, unless that was done for the step before, and
    // factorises for the step h.  `rate`, `state_scale` (n,), `laws` (m,), or empty: as they are in
    // the memory.
    void prepare(double t, double h, const double* state, const std::vector<double>& rate,
                 const std::vector<double>& state_scale, const std::vector<double>& laws,
                 const Places& places);
    // For a stage with the chart rates x (n,), evaluated with the laws `applied` (m,), where they
    // are `laws`: x = (1 - h gamma J)^-1 (x + (0, W (laws - applied))), and the rates of the laws.
    void solve(double* x, const double* laws, const double* applied, double* law_rates);
    const std::vector<double>& rate() const { return rate_; }        // (n,), at the start
    const std::vector<double>& by_time() const { return by_time_; }  // (n,), its derivative
    const std::vector<double>& applied() const { return applied_; }  // (m,), at the start
    const std::vector<double>& laws() const { return laws_; }        // (m,), what they are there
    int count() const { return count_; }                             // m
    // Linearises the system at any regular state, with laws that act as they are.
    void linearise_anew(double t, double h, const double* state,
                        const std::vector<double>& state_scale) {
        known_ = false;
        linearise(t, h, state, state_scale, {}, {});
    }
    // J (n, n), column by column, at the start; the laws by the chart coordinates (m, n), and the
    // accelerations by the laws (nv, m), alike.
    void jacobian(double* out) const;
    const std::vector<double>& laws_by_coordinates() const { return L_; }
    const std::vector<double>& by_laws() const { return W_; }
    // Estimate of h |lambda|, lambda the largest eigenvalue of J.
    double stiffness(double h);
    // Evaluations of a step, over those of its `stages`: methods/stiffness.py.
    double cost(int stages) const { return 1.0 + static_cast<double>(differences_) / stages; }

private:
    void linearise(double t, double h, const double* state,
                   const std::vector<double>& state_scale, const std::vector<double>& laws,
                   const Places& places);
    bool rate_at(double t, const double* state, const Places& places, std::vector<double>& out);
    void by_differences(double t, const double* state, const std::vector<double>& steps,
                        const Places& places);
    void chart_by_coordinates(const std::vector<double>& steps);
    void by_forces(double t, const double* state, const std::vector<double>& steps);
    void along_branch(double t, const double* state, const std::vector<double>& steps, bool solved,
                      const Places& places);
    void widen(const std::vector<double>& state_scale, std::vector<double>& steps) const;
    void by_applied_laws(double t, const double* state, const Places& places);
    void factorise(double k);
    void multiply(const std::vector<double>& x, std::vector<double>& out) const;  // J x

    System& system_;
    const int nv_, n_, count_;
    const double gamma_;
    const std::vector<double> unit_;
    const Constants& constants_;
    bool known_ = false, on_branch_ = false, lingers_ = false, whole_ = false;  // whole_: J is J_
    int differences_ = 0;  // evaluations that regular rates were differentiated by
    double known_time_ = 0.0, k_ = 0.0;
    std::vector<double> known_state_, known_rate_, known_laws_;
    std::vector<double> rate_, by_time_, applied_, laws_, laws_there_;
    std::vector<double> A_, B_, C_, D_;   // (nv, nv), column by column; A: accelerations by forces
    std::vector<double> L_;               // (m, n), of the laws by the chart coordinates
    std::vector<double> W_;               // (nv, m), of the accelerations by the laws
    std::vector<double> S_;               // (nv, nv), the blocks of joints that need a chart
    std::vector<double> CS_, factors_;    // (nv, nv)
    std::vector<double> J_;               // (n, n), column by column, on the branch
    std::vector<int> pivots_;
    std::vector<double> x_, delta_, probe_, other_, work_;
};

}  // namespace srm
