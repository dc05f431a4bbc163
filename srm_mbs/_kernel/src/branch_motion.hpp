// The motion next to a singular configuration with a known multiplier: BranchMotion in
// integration/singular_endpoints.py.
#pragma once

#include <vector>

#include "step.hpp"

namespace srm {

#define SRM_BRANCH_CURVE(field)                                                             \
    field(std::vector<double>, q)          /* (nq,), where the parameter is zero */         \
    field(double, t)                       /* the same, of drives (s) */                    \
    field(std::vector<double>, unit)       /* (n,), n = nv, with drives nv + 1: time last */ \
    field(std::vector<double>, along)      /* (n,): the parameter of a motion in units */   \
    field(std::vector<double>, nodes)      /* (k,), parameters */                           \
    field(std::vector<double>, normal)     /* (k, nv, n): [P, -E s'] there, in units */     \
    field(std::vector<double>, velocities) /* (k, nv): velocities of the branch there */    \
    field(std::vector<double>, quadratic)  /* (k, nv): E (Gdot v - s'') for them */         \
    field(double, first)                                                                    \
    field(double, last)                    /* range of the parameter */

// The constraint algebra along a branch of one degree of freedom: BranchCurve in
// dynamics/singularities/branch_limit.py.
struct BranchCurve {
    SRM_FIELDS(SRM_BRANCH_CURVE)

    void check() const;
};

struct BranchPoint {
    std::vector<double> state, rate, multiplier;
    double sigma = 0.0;
};

class BranchMotion {
public:
    BranchMotion(System& system, const ButcherTableau& scheme, const Constants& constants,
                 const ErrorNorm& norm);

    // Moves `point` along the known multiplier from t to t_new.
    void advance(double t, double t_new, const MultiplierHistory& known, BranchPoint& point);
    // Solves for the multiplier at `point`, which is moved onto the closures; false if that needs a
    // curve that is not there.
    bool solve(double t, double direct, const BranchCurve* curve, BranchPoint& point);

private:
    bool on_curve(double t, const BranchCurve& curve, BranchPoint& point);
    void correct(double t, double threshold, BranchPoint& point);
    void normal_part(const double* normal, int n, const double* rates, double* out) const;

    System& system_;
    SplitStep step_;
    std::vector<double> delta_;
};

}  // namespace srm
