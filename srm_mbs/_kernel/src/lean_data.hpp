// A pinocchio::Data without the arrays that nothing here uses.
#pragma once

#include <pinocchio/multibody.hpp>

namespace pinocchio_model {

// Makes `data` fit for kinematics, Jacobians, crba, nonLinearEffects, aba and energies of `model`,
// as Pinocchio's constructor does, but for second derivatives (4 nv^3 numbers, 8 GB for 640
// joints), derivatives and regressors (some 20 nv^2 numbers), which stay empty.
void prepare(pinocchio::Data& data, const pinocchio::Model& model);

}  // namespace pinocchio_model
