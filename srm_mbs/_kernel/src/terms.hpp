// Mass matrix, nonlinear effects and the kinematics that both leave, in one pass over the tree.
#pragma once

#include <pinocchio/multibody.hpp>

namespace pinocchio_model {

struct Workspace;

// Whether compute_terms can make one pass over the tree: whether its joints are of the usual kinds.
// Code for every kind that Pinocchio knows would take twice the time and memory to compile.
bool has_usual_joints(const pinocchio::Model& model);

// Pinocchio's crba (WORLD) and nonLinearEffects at q and v of the workspace: the same statements,
// joint by joint, with what the two have in common (the joint's own terms, placements) made once.
// Leaves M, nle, J, oMi, v, a_gf as they do; Ag is left about the world's origin.  Calls the two
// algorithms themselves where there are other joints.
void compute_terms(Workspace& work);

}  // namespace pinocchio_model
