// Pinocchio's model and data, and Eigen vectors of the kind that its compiled algorithms take.
#pragma once

#include <pinocchio/multibody.hpp>

#include "lean_data.hpp"
#include "terms.hpp"

namespace pinocchio_model {

// The argument type of the crba and aba in Pinocchio's library.  For other vector types the
// compiler would instantiate them again, for every kind of joint, in ten times the time and memory.
using Argument = Eigen::Ref<const Eigen::VectorXd>;

// A tree is what hangs on one joint of the ground.  Placements of bodies in the data, columns of its
// Jacobian and whatever is computed from them refer to the base of each tree, the place of that
// joint on the ground: rounding then follows the size of a tree, not its distance from the origin of
// the world, and where closures are singular rounding is what errors are made of.
struct Workspace {
    explicit Workspace(const pinocchio::Model& given)
        : model(given), q(given.nq), q2(given.nq), v(given.nv), tau(given.nv),
          one_pass(has_usual_joints(given)), bases_(given.njoints) {
        prepare(data, model, false);
        find_bases();
    }

    // Takes the numbers of another model with the same bodies and joints.
    void take(const pinocchio::Model& other) {
        model.joints = other.joints;
        model.jointPlacements = other.jointPlacements;
        model.inertias = other.inertias;
        model.armature = other.armature;
        model.gravity = other.gravity;
        find_bases();
    }

    // The base of the tree of a joint, in the world; of the ground the origin of the world.
    const Eigen::Vector3d& base(int joint) const { return bases_[joint]; }
    // That of joint a seen from that of b.
    Eigen::Vector3d base_apart(int a, int b) const { return bases_[a] - bases_[b]; }
    // From a point of b to one of a, each from its base, the ground's from the origin of the world.
    Eigen::Vector3d between(int a, const Eigen::Vector3d& at_a, int b,
                            const Eigen::Vector3d& at_b) const {
        if (b == 0) return at_a - (at_b - bases_[a]);
        return (at_a + base_apart(a, b)) - at_b;
    }
    // A point of a body, in the world.
    Eigen::Vector3d in_world(int joint, const Eigen::Vector3d& inside) const {
        return data.oMi[joint].act(inside) + bases_[joint];
    }
    // The Jacobian about the origin of the world.
    pinocchio::Data::Matrix6x world_jacobian() const {
        pinocchio::Data::Matrix6x out = data.J;
        for (int i = 1; i < model.njoints; ++i)
            for (int j = model.idx_vs[i]; j < model.idx_vs[i] + model.nvs[i]; ++j)
                out.col(j).head<3>() += bases_[i].cross(out.col(j).tail<3>());
        return out;
    }

    pinocchio::Model model;  // with the joints of the ground at its origin
    pinocchio::Data data;
    Eigen::VectorXd q, q2, v, tau;
    const bool one_pass;

private:
    void find_bases() {
        bases_[0].setZero();
        // Of gravity that turns, places count.
        const bool straight = model.gravity.angular().isZero(0.0);
        for (int i = 1; i < model.njoints; ++i) {
            const auto parent = model.parents[i];
            bases_[i] = bases_[parent];
            if (parent == 0 && straight) {
                bases_[i] = model.jointPlacements[i].translation();
                model.jointPlacements[i].translation().setZero();
            }
        }
    }
    std::vector<Eigen::Vector3d> bases_;
};

// A placement from its rotation, row by row, and its translation.
inline pinocchio::SE3 placement(const double* in) {
    pinocchio::SE3 out;
    out.rotation() = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(in);
    out.translation() = Eigen::Map<const Eigen::Vector3d>(in + 9);
    return out;
}

}  // namespace pinocchio_model
