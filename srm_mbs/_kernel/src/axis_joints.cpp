#include "axis_joints.hpp"

#include <algorithm>
#include <cmath>
#include <type_traits>

#include "workspace.hpp"

namespace pinocchio_model {

namespace {

using srm::cross;
using srm::dot;
using srm::from_world;
using srm::to_world;
using srm::vec;
using Joints = pinocchio::JointCollectionDefault;
using Kind = AxisJoint::Kind;

// Coordinates up to which Pinocchio's own steps make the pass: the reference's terms are then met to
// the last digits, and all that they read and write, 2 kB for each joint, stays in the caches.
constexpr int few = 64;

// Kind and axis of a joint; false for other joints.
struct FindAxis : boost::static_visitor<bool> {
    explicit FindAxis(AxisJoint& out) : out(out) {}

    template <typename Joint>
    bool operator()(const Joint& joint) const {
        if constexpr (std::is_same_v<Joint, Joints::JointModelRevoluteUnaligned>) {
            return take(Kind::revolute, joint.axis);
        } else if constexpr (std::is_same_v<Joint, Joints::JointModelRevoluteUnboundedUnaligned>) {
            return take(Kind::unbounded, joint.axis);
        } else if constexpr (std::is_same_v<Joint, Joints::JointModelPrismaticUnaligned>) {
            return take(Kind::prismatic, joint.axis);
        } else {
            return along<Joint, Joints::JointModelRX, Joints::JointModelRY, Joints::JointModelRZ>(
                       Kind::revolute) ||
                   along<Joint, Joints::JointModelRUBX, Joints::JointModelRUBY,
                         Joints::JointModelRUBZ>(Kind::unbounded) ||
                   along<Joint, Joints::JointModelPX, Joints::JointModelPY, Joints::JointModelPZ>(
                       Kind::prismatic);
        }
    }

    template <typename Joint, typename X, typename Y, typename Z>
    bool along(Kind kind) const {
        const int k = std::is_same_v<Joint, X> ? 0 : std::is_same_v<Joint, Y> ? 1
                                                 : std::is_same_v<Joint, Z>   ? 2
                                                                              : -1;
        return k >= 0 && take(kind, Eigen::Vector3d::Unit(k));
    }

    bool take(Kind kind, const Eigen::Vector3d& axis) const {
        out.kind = kind;
        out.axis = vec(axis.data());
        out.along = -1;
        for (int k = 0; k < 3; ++k)
            if (std::abs(axis[k]) == 1.0) out.along = k;
        return true;
    }

    AxisJoint& out;
};

// J a for moments J.
Vec times(const double* J, const Vec& a) {
    return {J[0] * a.x + J[1] * a.y + J[2] * a.z, J[1] * a.x + J[3] * a.y + J[4] * a.z,
            J[2] * a.x + J[4] * a.y + J[5] * a.z};
}

// R J R^T; R column by column.
void turn(const double* R, const double* J, double* out) {
    const Vec x = vec(R), y = vec(R + 3), z = vec(R + 6);
    const Vec a = J[0] * x + J[1] * y + J[2] * z;
    const Vec b = J[1] * x + J[3] * y + J[4] * z;
    const Vec c = J[2] * x + J[4] * y + J[5] * z;
    out[0] = a.x * x.x + b.x * y.x + c.x * z.x;
    out[1] = a.x * x.y + b.x * y.y + c.x * z.y;
    out[2] = a.x * x.z + b.x * y.z + c.x * z.z;
    out[3] = a.y * x.y + b.y * y.y + c.y * z.y;
    out[4] = a.y * x.z + b.y * y.z + c.y * z.z;
    out[5] = a.z * x.z + b.z * y.z + c.z * z.z;
}

void put(double* out, const Vec& a) {
    out[0] = a.x;
    out[1] = a.y;
    out[2] = a.z;
}

// R turned about an axis, `world` in the world, by an angle.
void turn_about(const AxisJoint& joint, const Vec& world, double cosine, double sine, double* R) {
    if (joint.along >= 0) {
        const int k = joint.along;
        double *const a = R + 3 * ((k + 1) % 3), *const b = R + 3 * ((k + 2) % 3);
        if ((k == 0 ? joint.axis.x : k == 1 ? joint.axis.y : joint.axis.z) < 0.0) sine = -sine;
        const Vec first = vec(a), second = vec(b);
        put(a, cosine * first + sine * second);
        put(b, cosine * second - sine * first);
        return;
    }
    const double parts[3] = {joint.axis.x, joint.axis.y, joint.axis.z};
    for (int m = 0; m < 3; ++m) {
        const Vec column = vec(R + 3 * m);
        put(R + 3 * m, cosine * column + sine * cross(world, column) +
                           ((1.0 - cosine) * parts[m]) * world);
    }
}

// The axes of a body before its joint moves.
void place(const AxisJoint& joint, const double* parent, double* R) {
    if (!joint.turned) {
        std::copy(parent, parent + 9, R);
        return;
    }
    for (int m = 0; m < 9; m += 3) put(R + m, to_world(parent, vec(joint.rotation + m)));
}

// Placement, velocity and acceleration of a body, and the force that it needs.
void forward(const AxisJoint& joint, const AxisBody& parent, const double* q, const double* v,
             pinocchio::Data& data, int i, AxisBody& body) {
    auto& at = data.oMi[i];
    const auto& before = data.oMi[joint.parent];
    double *const R = at.rotation().data(), *const S = data.J.data() + 6 * joint.in_v;
    place(joint, before.rotation().data(), R);
    const Vec axis = body.axis = to_world(R, joint.axis);
    const double rate = v[joint.in_v];
    Vec r = to_world(before.rotation().data(), joint.at);
    const bool slides = joint.kind == Kind::prismatic;
    if (slides) r = r + q[joint.in_q] * axis;
    const Vec x = vec(before.translation().data()) + r;
    body.from_parent = r;
    put(at.translation().data(), x);
    Vec u = parent.velocity + cross(parent.spin, r), w = parent.spin;
    Vec b = parent.bias + cross(parent.spin_bias, r), turning = parent.spin_bias;
    const Vec own = rate * axis;
    if (slides) {
        put(S, axis);
        put(S + 3, Vec{});
        u = u + own;
        b = b + cross(w, own);
    } else {
        double cosine, sine;
        if (joint.kind == Kind::revolute) {
            cosine = std::cos(q[joint.in_q]);
            sine = std::sin(q[joint.in_q]);
        } else {
            cosine = q[joint.in_q];
            sine = q[joint.in_q + 1];
        }
        turn_about(joint, axis, cosine, sine, R);
        put(S, cross(x, axis));
        put(S + 3, axis);
        turning = turning + cross(w, own);
        b = b + cross(u, own);
        w = w + own;
    }
    body.velocity = u;
    body.spin = w;
    body.bias = b;
    body.spin_bias = turning;
    double *const seen = data.v[i].toVector().data(), *const bias = data.a_gf[i].toVector().data();
    put(seen, from_world(R, u));
    put(seen + 3, from_world(R, w));
    put(bias, from_world(R, b));
    put(bias + 3, from_world(R, turning));
    const Vec c = body.centre = to_world(R, joint.centre);
    turn(R, joint.moments, body.moments);
    body.mass = joint.mass;
    body.force = joint.mass * (b + cross(turning, c) + cross(w, u + cross(w, c)));
    body.moment = times(body.moments, turning) + cross(w, times(body.moments, w)) +
                  cross(c, body.force);
}

// Adds what a body is and needs to what carries it.
void carry(const AxisBody& body, AxisBody& parent) {
    const Vec r = body.from_parent, d = r + body.centre - parent.centre;
    parent.force = parent.force + body.force;
    parent.moment = parent.moment + body.moment + cross(r, body.force);
    const double mass = parent.mass + body.mass, share = mass > 0.0 ? body.mass / mass : 0.0;
    const Vec s = (share * parent.mass) * d;
    const double along = dot(s, d);
    double* const J = parent.moments;
    const double* const own = body.moments;
    J[0] += own[0] + along - s.x * d.x;
    J[1] += own[1] - s.x * d.y;
    J[2] += own[2] - s.x * d.z;
    J[3] += own[3] + along - s.y * d.y;
    J[4] += own[4] - s.y * d.z;
    J[5] += own[5] + along - s.z * d.z;
    parent.mass = mass;
    parent.centre = parent.centre + share * d;
}

}  // namespace

std::vector<AxisJoint> axis_joints(const pinocchio::Model& model) {
    if (model.nv <= few) return {};
    std::vector<AxisJoint> out(1);
    for (std::size_t i = 1; i < model.joints.size(); ++i) {
        AxisJoint& joint = out.emplace_back();
        if (!boost::apply_visitor(FindAxis(joint), model.joints[i].toVariant())) return {};
        joint.parent = static_cast<int>(model.parents[i]);
        joint.in_q = model.idx_qs[i];
        joint.in_v = model.idx_vs[i];
        const auto& placement = model.jointPlacements[i];
        joint.turned = placement.rotation() != Eigen::Matrix3d::Identity();
        Eigen::Map<Eigen::Matrix3d>(joint.rotation) = placement.rotation();
        joint.at = vec(placement.translation().data());
        const auto& inertia = model.inertias[i];
        joint.mass = inertia.mass();
        joint.centre = vec(inertia.lever().data());
        int n = 0;
        for (int a = 0; a < 3; ++a)
            for (int b = a; b < 3; ++b) joint.moments[n++] = inertia.inertia()(a, b);
    }
    return out;
}

void compute_axis_terms(Workspace& work) {
    const pinocchio::Model& model = work.model;
    pinocchio::Data& data = work.data;
    const double *const q = work.q.data(), *const v = work.v.data();
    const AxisJoint* const joints = work.axis_joints.data();
    AxisBody* const bodies = work.axis_bodies.data();
    const int count = model.njoints;
    data.v[0].setZero();
    data.a_gf[0] = -model.gravity;
    bodies[0] = {};
    bodies[0].bias = vec(data.a_gf[0].toVector().data());
    bodies[0].spin_bias = vec(data.a_gf[0].toVector().data() + 3);
    for (int i = 1; i < count; ++i)
        forward(joints[i], bodies[joints[i].parent], q, v, data, i, bodies[i]);
    for (int i = count - 1; i > 0; --i) {
        const AxisJoint& joint = joints[i];
        const AxisBody& body = bodies[i];
        const bool slides = joint.kind == Kind::prismatic;
        data.nle[joint.in_v] = dot(body.axis, slides ? body.force : body.moment);
        // The force for a unit of acceleration, about the origin of the joint, then of its ancestors.
        const Vec f = body.mass * (slides ? body.axis : cross(body.axis, body.centre));
        Vec n = cross(body.centre, f);
        if (!slides) n = n + times(body.moments, body.axis);
        double* const column = data.M.data() + static_cast<std::ptrdiff_t>(joint.in_v) * model.nv;
        column[joint.in_v] = dot(body.axis, slides ? f : n) + model.armature[joint.in_v];
        for (int j = i; joints[j].parent > 0;) {
            n = n + cross(bodies[j].from_parent, f);
            j = joints[j].parent;
            column[joints[j].in_v] =
                dot(bodies[j].axis, joints[j].kind == Kind::prismatic ? f : n);
        }
        if (joint.parent > 0) carry(body, bodies[joint.parent]);
    }
}

}  // namespace pinocchio_model
