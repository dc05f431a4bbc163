// Mass matrix, nonlinear effects and the kinematics that both leave, in one pass over the tree.
#pragma once

namespace pinocchio_model {

struct Workspace;

// Pinocchio's crba (WORLD) and nonLinearEffects at q and v of the workspace: the same statements,
// joint by joint, with what the two have in common (the joint's own terms, placements) made once.
// Leaves M, nle, J, oMi, v, a_gf as they do; Ag is left about the world's origin.
void compute_terms(Workspace& work);

}  // namespace pinocchio_model
