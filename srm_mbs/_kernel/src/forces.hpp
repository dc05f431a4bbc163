// Twin of srm_mbs/dynamics/forces.py: generalised forces of the force elements.
#pragma once

#include <string>
#include <vector>

#include "curve.hpp"

namespace pinocchio_model {
struct Workspace;
}

namespace srm {

enum class ForceKind { spring_damper, joint_torque, torsion_spring, wrench, bushing, limit_spring };

// An anchor: a frame on a body.
struct Held {
    int joint = 0;
    double placement[12];  // rotation row-major, translation
};

// One element; which numbers count depends on its kind.
struct ForceElement {
    ForceKind kind;
    Held a, b;                    // a is the only anchor of a wrench
    std::vector<int> columns;     // velocity components that move a against b
    std::vector<double> signs;
    double stiffness = 0.0, damping = 0.0, rest = 0.0;
    int in_q = 0, in_v = 0;
    bool turns = false;           // a wrench in the axes of its link
    // torque; force and moment; stiffness (6) and damping (6); lower and upper limit, and depth
    std::vector<double> numbers;
    std::vector<Curve> curves;    // laws of the numbers: none, one for all, or one for each
};

// Adds the generalised forces at t, q, v to tau (nv,); placements, velocities and the world Jacobian
// must be at hand.  Throws EvaluationError.
void add_forces(const std::vector<ForceElement>& elements, double coincident,
                const pinocchio_model::Workspace& work, double t, const double* q,
                const double* v, double* tau);

}  // namespace srm
