// Pinocchio's model and data, and Eigen vectors of the kind that its compiled algorithms take.
#pragma once

#include <pinocchio/multibody.hpp>

#include "lean_data.hpp"
#include "terms.hpp"

namespace pinocchio_model {

// The argument type of the crba and aba in Pinocchio's library.  For other vector types the
// compiler would instantiate them again, for every kind of joint, in ten times the time and memory.
using Argument = Eigen::Ref<const Eigen::VectorXd>;

struct Workspace {
    explicit Workspace(const pinocchio::Model& model)
        : model(&model), q(model.nq), q2(model.nq), v(model.nv), tau(model.nv),
          one_pass(has_usual_joints(model)) {
        prepare(data, model, false);
    }
    const pinocchio::Model* model;
    pinocchio::Data data;
    Eigen::VectorXd q, q2, v, tau;
    const bool one_pass;
};

// A placement from its rotation, row by row, and its translation.
inline pinocchio::SE3 placement(const double* in) {
    pinocchio::SE3 out;
    out.rotation() = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(in);
    out.translation() = Eigen::Map<const Eigen::Vector3d>(in + 9);
    return out;
}

}  // namespace pinocchio_model
