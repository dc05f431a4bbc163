// The motion next to a singular configuration where branches touch: methods/touching_branches.py.
#pragma once

#include <vector>

#include "constants.hpp"
#include "system.hpp"

namespace srm {

// A stage on its branch: its state (nx,), tangent rate (2 nv,) and multiplier (nv,), what was
// subtracted from the stage (2 nv,), and the direction of the branch there (nv,).
struct StageOnBranch {
    std::vector<double> state, rate, multiplier, moved, away;
};

class TouchingBranch {
public:
    TouchingBranch(System& system, const Constants& constants);

    // Finds the nodes for a step from `state` at t with the tangent `rate`, in the direction w;
    // whether there are any.
    bool prepare(double t, const double* state, const double* rate, const std::vector<double>& w);
    // Solves the stage `state` at t; whether it could be solved.
    bool solve(double t, const double* state, StageOnBranch& stage);

private:
    bool close(double t, const double* state, double x, std::vector<double>& off, double* node);
    void place(const double* state, double x, const std::vector<double>& off, double* out);
    void see(const double* state, std::vector<double>& places);
    void weigh(const std::vector<double>& places, int count);

    System& system_;
    const Constants& constants_;
    const int nv_, nx_;
    std::vector<double> along_, w_, bend_;         // (nv,)
    std::vector<double> nodes_;                    // (k, nx), the first ones on both sides first
    std::vector<double> motions_;                  // (k, nv), to the nodes
    std::vector<double> value_, first_, second_;   // (k,), weights at 0
    std::vector<double> step_, none_, point_;
};

}  // namespace srm
