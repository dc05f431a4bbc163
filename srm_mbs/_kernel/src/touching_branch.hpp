// The motion next to a singular configuration where branches touch: methods/touching_branches.py.
#pragma once

#include <vector>

#include "constants.hpp"
#include "system.hpp"

namespace srm {

// A stage on its branch: its state (nx,), tangent rate (2 nv,) and multiplier (nv,), what was
// subtracted from the stage (2 nv,), and the direction of the branch there (nv,), or its frame; where
// the system tracks them, and branches cross, the laws of forces (m,).
struct StageOnBranch {
    std::vector<double> state, rate, multiplier, moved, away, laws;
};

class TouchingBranch {
public:
    TouchingBranch(System& system, const Constants& constants);

    // The frame (f + 1, nv) of a branch with the tangents (f, nv) and slopes (f,) of sigma.
    static void frame_at(System& system, const Constants& constants, double t, const double* state,
                         const double* tangents, const std::vector<double>& slopes,
                         std::vector<double>& frame);
    // Finds the places of the nodes for a step from `state` at t with the `frame` there; whether
    // there are any.
    bool prepare(double t, const double* state, const std::vector<double>& frame);
    // Solves the stage `state` at t; whether it could be solved.
    bool solve(double t, const double* state, StageOnBranch& stage);

private:
    using Vector = std::vector<double>;
    // Tangents (f, nv), and the rates (f, d) of the drives along them.
    struct Node {
        Vector off, motion, tangents, driven, residuals;
    };

    bool find(double t, double x, Node& node);
    bool follow(double t, const double* beside);
    bool settle(double t, Vector& z, Vector& on);
    void mean(const Vector& weights, Vector& tangents, Vector& driven) const;
    void curvature(double t, const Node& node, const Vector& s, double weight, Vector& bend,
                   Vector& drift);
    bool share(const Vector& tangents, const Vector& driven, const double* momentum,
               const Vector& targets, Vector& out) const;
    Vector along(const double* motion) const;
    void place(double x, const Vector& off, Vector& out) const;
    void move(const double* motion, const double* v, Vector& out);
    void difference(const double* from, const double* to, Vector& out);

    System& system_;
    const Constants& constants_;
    const int nv_, nx_;
    int f_ = 0;                              // freedom of the branch
    Vector start_, tangents_, along_, bend_;  // (nx,), (f, nv), (f, nv), (nv,)
    Vector places_, beside_;                 // (k,), (f - 1,)
    std::vector<Node> nodes_;                // the first ones on both sides first
    Vector step_, none_, point_;
};

}  // namespace srm
