// The linear systems of the stages of a linearly implicit step: methods/linear_split_step.py.
#pragma once

#include <vector>

#include "constants.hpp"
#include "system.hpp"

namespace srm {

// With J = [B I; C D], the derivatives of the chart rates (u', v') by the chart coordinates, and
// k = h gamma, the equations (1 - k J) (x, y) = (a, b) are
//
//     x = S (a + k y),   (1 - k D - k^2 C S) y = b + k C S a,   S = (1 - k B)^-1,
//
// S the identity but for ball, free and planar joints: nv equations, not 2 nv.
class LinearStages {
public:
    LinearStages(System& system, double gamma, std::vector<double> unit,
                 const Constants& constants);

    // Linearises the system at the start of a step, unless that was done for the step before, and
    // factorises for the step h.  `rate` (n,), `state_scale` (n,): as they are in the memory.
    void prepare(double t, double h, const double* state, const double* rate,
                 const double* state_scale, const System::ZoneView& zone);
    // x = (1 - h gamma J)^-1 x, for x (n,).
    void solve(double* x);
    const std::vector<double>& rate() const { return rate_; }        // (n,), at the start
    const std::vector<double>& by_time() const { return by_time_; }  // (n,), its derivative
    // Estimate of h |lambda|, lambda the largest eigenvalue of J.
    double stiffness(double h);

private:
    void linearise(double t, double h, const double* state, const double* state_scale,
                   const System::ZoneView& zone);
    void factorise(double k);
    void apply(const std::vector<double>& x, std::vector<double>& out) const;  // J x

    System& system_;
    const int nv_, n_;
    const double gamma_;
    const std::vector<double> unit_;
    const Constants constants_;
    bool known_ = false;
    double known_time_ = 0.0, k_ = 0.0;
    std::vector<double> known_state_, known_rate_;
    std::vector<double> rate_, by_time_;
    std::vector<double> B_, C_, D_;       // (nv, nv), column by column
    std::vector<double> S_;               // the same, the blocks of joints that need a chart
    std::vector<double> CS_, factors_;    // (nv, nv)
    std::vector<int> pivots_;
    std::vector<double> x_, delta_, probe_, other_, work_;
};

}  // namespace srm
