// A pinocchio::Data without the arrays that the kernel does not use.
#pragma once

#include <pinocchio/multibody.hpp>

namespace pinocchio_model {

// Allocates `data` for kinematics, Jacobians, crba, nonLinearEffects, aba and energies of `model`,
// as Pinocchio's constructor does.  Second derivatives (4 nv^3 numbers, 8 GB for 640 joints),
// derivatives and regressors (some 20 nv^2 numbers) stay empty, and without local_crba what crba
// uses by the local convention alone (6 nv^2 numbers).
void prepare(pinocchio::Data& data, const pinocchio::Model& model, bool local_crba);

}  // namespace pinocchio_model
