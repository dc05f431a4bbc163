// Mass matrix, nonlinear effects and the kinematics of both, in one pass over the tree.
#pragma once

#include <vector>

#include <pinocchio/multibody.hpp>

namespace pinocchio_model {

struct Workspace;

// Whether compute_terms can make one pass over the tree: its joints are of the usual kinds.  Code
// for every kind that Pinocchio knows would take twice the time and memory to compile.
bool has_usual_joints(const pinocchio::Model& model);

// Pinocchio's crba (WORLD) and nonLinearEffects at q and v of the workspace in one pass: the same
// statements, joint by joint; common terms (those of the joint, placements) are computed once.
// Computes M, nle, J, oMi, v, a_gf as the two algorithms do; J, oMi and Ag refer to the bases of the
// trees.
// With other joints it calls the two algorithms.
void compute_terms(Workspace& work);

// Pinocchio's computeJointJacobians at q of the workspace, by the same statements.
void place_bodies(Workspace& work);

// Pinocchio's forwardKinematics at q and v of the workspace, by the same statements: of all bodies or,
// which costs less, of those of `joints` alone, ascending and with the parents of each.
void move_bodies(Workspace& work, const std::vector<int>* joints = nullptr);

}  // namespace pinocchio_model
