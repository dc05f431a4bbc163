// Pinocchio's model and data, and Eigen vectors of the kind that its compiled algorithms take.
#pragma once

#include <algorithm>
#include <string>
#include <vector>

#include <pinocchio/multibody.hpp>

#include "lean_data.hpp"
#include "terms.hpp"

namespace pinocchio_model {

// The argument type of the crba and aba in Pinocchio's library.  For other vector types the
// compiler would instantiate them again, for every kind of joint, in ten times the time and memory.
using Argument = Eigen::Ref<const Eigen::VectorXd>;

// A tree is what hangs on one joint of the ground.  Placements of bodies in the data, columns of its
// Jacobian and whatever is computed from them refer to the base of each tree, the place of that
// joint on the ground or, if it is free or planar, of the body that it carries: rounding then follows
// the size of a tree, not its distance from the origin of the world, and where closures are singular
// rounding is what errors are made of.
struct Workspace {
    explicit Workspace(const pinocchio::Model& given)
        : model(given), q(given.nq), q2(given.nq), v(given.nv), tau(given.nv),
          one_pass(has_usual_joints(given)), tree_(given.njoints) {
        prepare(data, model, false);
        bases_.emplace_back(Eigen::Vector3d::Zero());
        for (int i = 1; i < model.njoints; ++i) {
            const auto parent = model.parents[i];
            tree_[i] = parent ? tree_[parent] : static_cast<int>(bases_.size());
            if (parent == 0) bases_.emplace_back(Eigen::Vector3d::Zero());
        }
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

    // Takes a configuration (nq,) for the algorithms, with the moving bases there.
    void place(const double* from) {
        std::copy(from, from + model.nq, q.data());
        for (const MovingBase& root : moving_) {
            double* const at = q.data() + model.idx_qs[root.joint];
            Eigen::Vector3d moved = Eigen::Vector3d::Zero();
            std::copy_n(at, root.size, moved.data());
            std::fill_n(at, root.size, 0.0);
            bases_[tree_[root.joint]] =
                root.at_rest + model.jointPlacements[root.joint].rotation() * moved;
        }
    }

    // The base of the tree of a joint, in the world; of the ground the origin of the world.
    const Eigen::Vector3d& base(int joint) const { return bases_[tree_[joint]]; }
    // That of joint a seen from that of b.
    Eigen::Vector3d base_apart(int a, int b) const { return base(a) - base(b); }
    // From a point of b to one of a, each from its base, the ground's from the origin of the world.
    Eigen::Vector3d between(int a, const Eigen::Vector3d& at_a, int b,
                            const Eigen::Vector3d& at_b) const {
        if (b == 0) return at_a - (at_b - base(a));
        return (at_a + base_apart(a, b)) - at_b;
    }
    // A point of a body, in the world.
    Eigen::Vector3d in_world(int joint, const Eigen::Vector3d& inside) const {
        return data.oMi[joint].act(inside) + base(joint);
    }
    // The Jacobian about the origin of the world.
    pinocchio::Data::Matrix6x world_jacobian() const {
        pinocchio::Data::Matrix6x out = data.J;
        for (int i = 1; i < model.njoints; ++i)
            for (int j = model.idx_vs[i]; j < model.idx_vs[i] + model.nvs[i]; ++j)
                out.col(j).head<3>() += base(i).cross(out.col(j).tail<3>());
        return out;
    }

    pinocchio::Model model;  // with the joints of the ground at its origin
    pinocchio::Data data;
    Eigen::VectorXd q, q2, v, tau;
    const bool one_pass;

private:
    // A free or planar joint on the ground, with so many coordinates of its place, and that of the
    // joint itself.
    struct MovingBase {
        int joint, size;
        Eigen::Vector3d at_rest;
    };

    void find_bases() {
        moving_.clear();
        for (Eigen::Vector3d& base : bases_) base.setZero();
        if (!model.gravity.angular().isZero(0.0)) return;  // places count
        for (int i = 1; i < model.njoints; ++i) {
            if (model.parents[i] != 0) continue;
            Eigen::Vector3d& at = model.jointPlacements[i].translation();
            const std::string kind = model.joints[i].shortname();
            if (kind == "JointModelFreeFlyer") moving_.push_back({i, 3, at});
            if (kind == "JointModelPlanar") moving_.push_back({i, 2, at});
            bases_[tree_[i]] = at;
            at.setZero();
        }
    }

    std::vector<int> tree_;               // of each joint, that of the ground first
    std::vector<Eigen::Vector3d> bases_;  // of each tree
    std::vector<MovingBase> moving_;
};

// A placement from its rotation, row by row, and its translation.
inline pinocchio::SE3 placement(const double* in) {
    pinocchio::SE3 out;
    out.rotation() = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(in);
    out.translation() = Eigen::Map<const Eigen::Vector3d>(in + 9);
    return out;
}

}  // namespace pinocchio_model
