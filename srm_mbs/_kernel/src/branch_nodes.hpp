// The motion next to a singular configuration, from configurations of its branch on both sides of
// it: methods/branch_nodes.py.
#pragma once

#include <vector>

#include "constants.hpp"
#include "system.hpp"
#include "touching_branch.hpp"

namespace srm {

// Results of solve() are those of StageOnBranch.
class BranchNodes : public StageOnBranch {
public:
    // `singular`: residual (row units) of the state on the branch, up to which there is that branch.
    BranchNodes(System& system, const Constants& constants, double singular);

    // A direction (nv,) of the branch that leads away from the singular configuration, as long as
    // nodes are apart, or its frame where branches touch; empty if the state (nx,) does not
    // determine it.
    void find_direction(double t, const double* state, std::vector<double>& away);
    // The direction w (nv,), which is scaled, as long as nodes are apart; false, and empty, if no
    // spacing suffices.
    bool spaced(double t, const double* state, std::vector<double>& w, std::vector<double>& away);
    // Moves the state (nx,) onto its branch, and solves for its multiplier; whether it could.
    bool solve(double t, const double* state, const std::vector<double>& away);

private:
    static constexpr int each_side = 4, count = 2 * each_side;

    bool avoided();
    bool follow(int k, double t, const double* state, const std::vector<double>& away);
    double sigma_at(double t, const double* state, const double* direction, double length);

    System& system_;
    const Constants& constants_;
    const double singular_;
    const int nv_, nx_;
    // Of the nodes (count, nv): positions, motions onto the closures, rates off the branch,
    // multipliers.
    std::vector<double> nodes_, closings_, off_, multipliers_;
    std::vector<double> point_, step_, closing_, change_, allowed_, residuals_, basis_, by_laws_;
};

}  // namespace srm
