// Reactions of closures and joints: dynamics/constraints/reactions.py.
#include <algorithm>
#include <cmath>
#include <vector>

#include <Eigen/QR>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/rnea.hpp>

#include "system.hpp"
#include "workspace.hpp"

namespace srm {

namespace {

using pinocchio_model::Argument;

// A frame of a closure: the axes of its body, and its origin from the base of its tree.
struct Side {
    Side(const pinocchio::Data& data, int joint, const Point& inside)
        : rotation(data.oMi[joint].rotation().data()),
          at(vec(data.oMi[joint].translation().data()) + to_world(rotation, vec(inside.data()))) {}
    const double* rotation;
    Vec at;
};

void put(const Vec& force, const Vec& moment, double* out) {
    const double values[] = {force.x, force.y, force.z, moment.x, moment.y, moment.z};
    std::copy(values, values + 6, out);
}

// The wrench (6,) on b at b's origin for the multipliers of unscaled rows.
void wrench_on_b(const ClosureRows& closure, const pinocchio_model::Workspace& work,
                 const double* lam, double* out) {
    const Side a(work.data, closure.joint_a, closure.at_a);
    const Side b(work.data, closure.joint_b, closure.at_b);
    const Vec gap = vec(work.between(closure.joint_a, Eigen::Vector3d(&a.at.x), closure.joint_b,
                                     Eigen::Vector3d(&b.at.x))
                            .data());
    const double* own = lam + closure.first_row;
    Vec force{}, moment{};
    for (std::size_t k = 0; k < closure.directions.size(); k += 3)
        force = force + *own++ * to_world(b.rotation, vec(&closure.directions[k]));
    // The force of a distance goes through both origins.
    moment = cross(gap, force);
    for (std::size_t k = 0; k < closure.distances.size(); k += 2)
        force = force + (*own++ / std::sqrt(dot(gap, gap))) * gap;
    for (std::size_t k = 0; k < closure.alignments.size(); k += 6)
        moment = moment + *own++ * cross(to_world(a.rotation, vec(&closure.alignments[k])),
                                         to_world(b.rotation, vec(&closure.alignments[k + 3])));
    put(force, moment, out);
}

}  // namespace

int System::joint_count() const { return work_->model.njoints; }

// The least-norm solution of W lam = L^T yhat, W = L^-1 G^T with the rows scaled, down to the rank of
// the stage: with W Pi = Q R and R^T = Z S, lam = Pi Z S^-T Q^T L^T yhat.
void System::row_multipliers(const double* generalised, const std::vector<double>& G,
                             const double* scale, int rows, double* out) {
    using Matrix = Eigen::MatrixXd;
    Matrix W(nv, rows);
    for (int row = 0; row < rows; ++row) {
        for (int i = 0; i < nv; ++i) W(i, row) = G[row * (nv + 1) + i] / scale[row];
        projection_->whiten_force(&W(0, row));
    }
    Eigen::VectorXd x = Eigen::Map<const Eigen::VectorXd>(generalised, nv);
    projection_->whiten_velocity(x.data());
    const int used = std::min(rank(), std::min(nv, rows));
    const Eigen::ColPivHouseholderQR<Matrix> factors(W);
    x.applyOnTheLeft(factors.householderQ().adjoint());
    Eigen::VectorXd y = Eigen::VectorXd::Zero(rows);
    if (used == rows) {
        y = x.head(used);
        factors.matrixR().topLeftCorner(used, used).triangularView<Eigen::Upper>().solveInPlace(y);
    } else {
        const Matrix R = factors.matrixR().topRows(used).triangularView<Eigen::Upper>();
        const Eigen::HouseholderQR<Matrix> others(R.transpose());
        Eigen::VectorXd z = x.head(used);
        others.matrixQR().topRows(used).triangularView<Eigen::Upper>().transpose().solveInPlace(z);
        y.head(used) = z;
        y.applyOnTheLeft(others.householderQ());
    }
    Eigen::Map<Eigen::VectorXd> lam(out, rows);
    lam = factors.colsPermutation() * y;
    for (int row = 0; row < rows; ++row) out[row] /= scale[row];
}

// Independent rows have one solution, which the factorisation of the stage has: lam = Pi R^-1 Q^T
// L^T yhat, over the scales.
bool System::kept_multipliers(const double* generalised, const double* scale,
                              const std::vector<int>& kept, double* out) {
    if (rank() != data_.rows || !data_.eliminations.empty()) return false;
    std::copy(generalised, generalised + nv, white_.begin());
    projection_->whiten_velocity(white_.data());
    std::vector<double> own(data_.rows);
    projection_->multiplier(white_.data(), own.data());
    for (std::size_t k = 0; k < kept.size(); ++k) out[kept[k]] = own[k] / scale[kept[k]];
    return true;
}

void System::reactions(double t, const double* state, System& all, const double* scale,
                       const std::vector<int>& kept, double* multipliers, double* on_b,
                       double* joints) {
    auto& w = *work_;
    const int rows = all.data_.rows, count = w.model.njoints;
    std::vector<double> rate(2 * nv), generalised(nv);
    this->rate(rate.data());
    std::fill(multipliers, multipliers + rows, 0.0);
    if (closed_ && rows) {
        multiplier(generalised.data());
        if (!kept_multipliers(generalised.data(), scale, kept, multipliers)) {
            // The last column is the derivative by time.
            std::vector<double> G(static_cast<std::size_t>(rows) * (nv + 1), 0.0);
            all.write_rows(t, state, G.data(), nv + 1);
            row_multipliers(generalised.data(), G, scale, rows, multipliers);
        }
    }
    const double* const q = state;
    const double* const v = state + nq;
    w.place(q);
    std::copy(v, v + nv, w.v.data());
    std::copy(rate.begin() + nv, rate.end(), w.tau.data());
    pinocchio::rnea(w.model, w.data, Argument(w.q), Argument(w.v), Argument(w.tau));
    for (int j = 0; j < count; ++j) {
        const auto& force = w.data.f[j].toVector();
        std::copy(force.data(), force.data() + 6, joints + 6 * j);
    }
    move_bodies(state);
    std::vector<double> loads(6 * static_cast<std::size_t>(count), 0.0);
    if (on_several_) {
        std::vector<BushingStep> none;
        pinocchio::computeJointJacobians(w.model, w.data);
        add_forces(data_.forces, data_.coincident, w, t, q, v, none, generalised.data(), nullptr,
                   loads.data());
    }
    const auto add = [&](int joint, double sign, const Vec& force, const Vec& moment) {
        const double values[] = {force.x, force.y, force.z, moment.x, moment.y, moment.z};
        for (int i = 0; i < 6; ++i) loads[6 * joint + i] += sign * values[i];
    };
    for (const ClosureRows& closure : all.data_.closures) {
        wrench_on_b(closure, w, multipliers, on_b);
        const Vec force = vec(on_b), at = Side(w.data, closure.joint_b, closure.at_b).at;
        const Vec seen = at + vec(w.base_apart(closure.joint_b, closure.joint_a).data());
        add(closure.joint_b, 1.0, force, vec(on_b + 3) + cross(at, force));
        add(closure.joint_a, -1.0, force, vec(on_b + 3) + cross(seen, force));
        on_b += 6;
    }
    for (int j = count - 1; j > 0; --j) {
        const int parent = static_cast<int>(w.model.parents[j]);
        const Vec force = vec(&loads[6 * j]), apart = vec(w.base_apart(j, parent).data());
        add(parent, 1.0, force, vec(&loads[6 * j + 3]) + cross(apart, force));
    }
    for (int j = 0; j < count; ++j) {
        double* const out = joints + 6 * j;
        const double* const carried = &loads[6 * j];
        const double* const R = w.data.oMi[j].rotation().data();
        const Vec at = vec(w.data.oMi[j].translation().data());
        const Vec force = vec(carried), moment = vec(carried + 3) - cross(at, force);
        put(to_world(R, vec(out)) - force, to_world(R, vec(out + 3)) - moment, out);
    }
}

}  // namespace srm
