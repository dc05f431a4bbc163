#include "system.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/joint-configuration.hpp>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/algorithm/rnea-derivatives.hpp>
#include <pinocchio/algorithm/rnea.hpp>

#include "errors.hpp"
#include "limits.hpp"
#include "linear.hpp"
#include "terms.hpp"
#include "workspace.hpp"

namespace srm {

using pinocchio_model::Argument;

namespace {

constexpr double overflow = 1e100;
constexpr double friction_part = 0.01;  // FRICTION_PART of dynamics/multibody.py
// Coordinates of an open mechanism up to which its mass matrix is factorised in stiff steps.
constexpr int one_pass_size = 12;
constexpr double two_pi = 6.283185307179586;

// The placement of a joint, from the base of its tree; its velocity and bias acceleration (with
// -gravity), in its own axes.
struct Body {
    Body(const pinocchio::Data& data, int joint)
        : rotation(data.oMi[joint].rotation().data()),
          origin_(data.oMi[joint].translation().data()),
          velocity_(data.v[joint].toVector().data()),
          bias_(data.a_gf[joint].toVector().data()) {}
    Vec origin() const { return vec(origin_); }
    Vec velocity() const { return vec(velocity_); }
    Vec spin() const { return vec(velocity_ + 3); }
    Vec bias() const { return vec(bias_); }
    Vec spin_bias() const { return vec(bias_ + 3); }
    const double* const rotation;

private:
    const double *const origin_, *const velocity_, *const bias_;
};

// The motion from one configuration of a ball, free or planar joint to another, and the configuration
// after a motion, as Pinocchio's algorithms for all joints have them; the arrays hold the joint's
// components.
template <typename Operation>
void joint_difference(const double* from, const double* to, double* out) {
    using Place = Eigen::Map<const Eigen::Matrix<double, Operation::NQ, 1>>;
    Eigen::Matrix<double, Operation::NV, 1> moved;
    Operation().difference(Place(from), Place(to), moved);
    std::copy_n(moved.data(), moved.size(), out);
}

template <typename Operation>
void joint_integrate(const double* from, const double* motion, double* out) {
    Eigen::Matrix<double, Operation::NQ, 1> place;
    Operation().integrate(Eigen::Map<const Eigen::Matrix<double, Operation::NQ, 1>>(from),
                          Eigen::Map<const Eigen::Matrix<double, Operation::NV, 1>>(motion), place);
    std::copy_n(place.data(), place.size(), out);
}

using Ball = pinocchio::SpecialOrthogonalOperationTpl<3, double>;
using Free = pinocchio::SpecialEuclideanOperationTpl<3, double>;
using Planar = pinocchio::SpecialEuclideanOperationTpl<2, double>;

void joint_difference(Group group, const double* from, const double* to, double* out) {
    if (group == Group::so3) joint_difference<Ball>(from, to, out);
    else if (group == Group::se3) joint_difference<Free>(from, to, out);
    else joint_difference<Planar>(from, to, out);
}

void joint_integrate(Group group, const double* from, const double* motion, double* out) {
    if (group == Group::so3) return joint_integrate<Ball>(from, motion, out);
    if (group == Group::se3) return joint_integrate<Free>(from, motion, out);
    double translation[2];
    planar_translation(from, motion, translation);  // from and out may be the same array
    joint_integrate<Planar>(from, motion, out);
    std::copy_n(translation, 2, out);
}

// Whether all coordinates are those of vectors or of groups: none of wrapped angles, and none of
// systems of rows alone, which do not know their joints.
bool vectors_and_groups(const SystemData& data) {
    auto others = std::count(data.position_of.begin(), data.position_of.end(), -1);
    for (const GroupJoint& joint : data.groups) others -= joint.size;
    return others == 0;
}

double distance(const double* x, int n) {
    double sum = 0.0;
    for (int i = 0; i < n; ++i) sum += std::abs(x[i]);
    return sum;
}

}  // namespace

void ClosureRows::check() const {
    expect_size("directions", directions.size(), directions.size() / 3 * 3);
    expect_size("distances", distances.size(), distances.size() / 2 * 2);
    expect_size("alignments", alignments.size(), alignments.size() / 6 * 6);
    expect_size("signs", signs.size(), columns.size());
}

void JointRow::check() const {
    expect_size("in_q", in_q.size(), coefficients.size());
    expect_size("in_v", in_v.size(), coefficients.size());
    if (!powers.empty()) expect_size("arguments", arguments.size(), coefficients.size());
}

void SystemData::check() const {
    const std::size_t nv = position_of.size();
    expect_within("rows", rows, 0, std::numeric_limits<int>::max());
    expect_size("unit", unit.size(), nv);
    if (!damping.empty()) expect_size("damping", damping.size(), nv);
    if (!friction.empty()) expect_size("friction", friction.size(), nv);
    expect_size("residual_scale", residual_scale.size(), static_cast<std::size_t>(rows));
    expect_finite("residual_scale", residual_scale);
    expect_finite("unit", unit);
    if (order.empty()) return;
    expect_size("order", order.size(), static_cast<std::size_t>(rows));
    expect_within("order", order, 0, rows - 1);
    std::vector<int> sorted(order);
    std::sort(sorted.begin(), sorted.end());
    if (std::adjacent_find(sorted.begin(), sorted.end()) != sorted.end())
        throw std::invalid_argument("order has a row twice");
    expect_within("pivot_window", pivot_window, 1, std::numeric_limits<int>::max());
}

namespace {

// Refuses a model whose indices do not belong together: Pinocchio's algorithms do not look.
const pinocchio::Model& checked_model(const pinocchio::Model& model) {
    const long joints = model.njoints;
    const auto count = static_cast<std::size_t>(joints);
    if (joints < 1 || model.nq < 0 || model.nv < 0)
        throw std::invalid_argument("model has a negative size");
    const auto expect_count = [&](const char* field, std::size_t found) {
        expect_size((std::string("model.") + field).c_str(), found, count);
    };
    expect_count("joints", model.joints.size());
    expect_count("parents", model.parents.size());
    expect_count("jointPlacements", model.jointPlacements.size());
    expect_count("inertias", model.inertias.size());
    expect_count("idx_qs", model.idx_qs.size());
    expect_count("idx_vs", model.idx_vs.size());
    expect_count("nqs", model.nqs.size());
    expect_count("nvs", model.nvs.size());
    expect_size("model.armature", static_cast<std::size_t>(model.armature.size()),
                static_cast<std::size_t>(model.nv));
    for (std::size_t i = 1; i < count; ++i) {
        const auto& joint = model.joints[i];
        expect_within("model.parents", static_cast<long>(model.parents[i]), 0,
                      static_cast<long>(i) - 1);
        if (model.idx_qs[i] != joint.idx_q() || model.idx_vs[i] != joint.idx_v() ||
            model.nqs[i] != joint.nq() || model.nvs[i] != joint.nv())
            throw std::invalid_argument("model.joints has other indices than the model");
        expect_within("model.nqs", joint.nq(), 0, model.nq);
        expect_within("model.nvs", joint.nv(), 0, model.nv);
        expect_within("model.idx_qs", joint.idx_q(), 0, model.nq - joint.nq());
        expect_within("model.idx_vs", joint.idx_v(), 0, model.nv - joint.nv());
    }
    return model;
}

// Refuses rows, joints and columns that the model does not have.
void check_indices(const SystemData& data, const pinocchio::Model& model) {
    const long nq = model.nq, nv = model.nv, rows = data.rows, joints = model.njoints;
    expect_size("SystemData.position_of", data.position_of.size(), static_cast<std::size_t>(nv));
    expect_size("SystemData.half_turn", data.half_turn.size(), 2);
    expect_within("SystemData.position_of", data.position_of, -1, nq - 1);
    expect_within("SystemData.structural_rank", data.structural_rank, 0, std::min(rows, nv));
    if (!(data.sigma_ref > 0.0) || !std::isfinite(data.sigma_ref))
        throw std::invalid_argument("SystemData.sigma_ref is not positive");
    for (const ClosureRows& closure : data.closures) {
        expect_within("ClosureRows.joint_a", closure.joint_a, 0, joints - 1);
        expect_within("ClosureRows.joint_b", closure.joint_b, 0, joints - 1);
        expect_within("ClosureRows.first_row", closure.first_row, 0,
                      rows - static_cast<long>(closure.count()));
        expect_within("ClosureRows.columns", closure.columns, 0, nv - 1);
    }
    for (const JointRow& row : data.joint_rows) {
        expect_within("JointRow.row", row.row, 0, rows - 1);
        expect_within("JointRow.in_q", row.in_q, 0, nq - 1);
        expect_within("JointRow.in_v", row.in_v, 0, nv - 1);
    }
    for (const Elimination& elimination : data.eliminations) {
        expect_within("Elimination.row", elimination.row, 0, rows - 1);
        expect_within("Elimination.other", elimination.other, 0, rows - 1);
        expect_within("Elimination.columns", elimination.columns, 0, nv - 1);
    }
    for (const DrivenRow& drive : data.drives) {
        expect_within("DrivenRow.row", drive.row, 0, rows - 1);
        expect_within("DrivenRow.in_v", drive.in_v, -1, nv - 1);
        if (drive.in_v >= 0)
            expect_within("DrivenRow.in_q", drive.in_q, 0, nq - 1 - (drive.wraps ? 1 : 0));
    }
    for (const ForceElement& force : data.forces) check_indices(force, nq, nv, joints);
    for (const GroupJoint& joint : data.groups) {
        const bool free = joint.group == Group::se3;
        expect_within("GroupJoint.group", static_cast<long>(joint.group), 0, 2);
        expect_within("GroupJoint.size", joint.size, free ? 6 : 3, free ? 6 : 3);
        expect_within("GroupJoint.start", joint.start, 0, nv - joint.size);
        expect_within("GroupJoint.position", joint.position, 0, nq - joint.size - 1);
    }
    expect_within("SystemData.wrapped_angles", data.wrapped_angles, 0, nv - 1);
}

}  // namespace

System::System(const void* model, SystemData data, Controller controller)
    : data_(std::move(data)),
      controller_(std::move(controller)),
      work_(std::make_unique<pinocchio_model::Workspace>(
          checked_model(*static_cast<const pinocchio::Model*>(model)))) {
    check_indices(data_, work_->model);
    nq = work_->model.nq;
    nv = work_->model.nv;
    closed_ = data_.structural_rank > 0;
    flat_ = nq == nv;
    on_several_ = std::any_of(data_.forces.begin(), data_.forces.end(), acts_on_several);
    if (closed_)
        projection_ = make_projection(data_.structural_rank, data_.sigma_ref, pattern(),
                                      // A joint that mimics another adds entries off the tree.
                                      work_->model.mimicking_joints.empty() ? data_.algebra
                                                                            : "dense");
    else
        G_.resize(static_cast<std::size_t>(data_.rows) * nv);
    g_.resize(data_.rows);
    bias_.resize(data_.rows);
    pushed_.resize(data_.rows);
    f_.resize(nv);
    v_.resize(nv);
    rate_.resize(nv);
    prediction_.resize(nv);
    white_.resize(nv);
    acted_.resize(nv);
    find_friction();
}

void System::find_friction() {
    friction_sums_.clear();
    for (std::size_t i = 0; i < data_.friction.size(); ++i)
        if (data_.friction[i] != 0.0) friction_sums_.push_back({{static_cast<int>(i)}, {1.0}});
    for (const ForceElement& e : data_.forces)
        if (e.kind == ForceKind::coupling_spring && friction(e) != 0.0)
            friction_sums_.push_back({e.columns, e.signs});
}

System::~System() = default;

Pattern System::pattern() const {
    Pattern out;
    out.parents.assign(work_->data.parents_fromRow.begin(), work_->data.parents_fromRow.end());
    out.supports.resize(data_.rows);
    out.order = data_.order;
    out.pivot_share = data_.pivot_share;
    out.pivot_window = data_.pivot_window;
    for (const ClosureRows& closure : data_.closures)
        std::fill_n(out.supports.begin() + closure.first_row,
                    closure.count(), closure.columns);
    for (const JointRow& joints : data_.joint_rows) out.supports[joints.row] = joints.in_v;
    for (const DrivenRow& drive : data_.drives)
        if (drive.in_v >= 0) out.supports[drive.row] = {drive.in_v};
    return out;
}

double System::sigma() const {
    return closed_ ? projection_->sigma : infinity;
}
int System::rank() const { return closed_ ? projection_->rank : 0; }
bool System::rank_deficient() const { return closed_ && projection_->rank_deficient; }
bool System::held() const { return closed_ && projection_->held; }

double* System::filled(int row) {
    return closed_ ? projection_->filled(row) : &G_[static_cast<std::size_t>(row) * nv];
}

double* System::column(int row) {
    if (closed_) return projection_->column(row);
    double* const out = filled(row);
    std::fill_n(out, nv, 0.0);
    return out;
}

// All rows: g, Gdot v, and G into the columns of the projection.
void System::update_closures(const double* q, bool with_bias) {
    for (const ClosureRows& closure : data_.closures) {
        if (!closure.directions.empty() || !closure.distances.empty())
            update_positions(closure, with_bias, nullptr);
        if (!closure.alignments.empty()) update_alignments(closure, with_bias, nullptr);
    }
    for (const JointRow& joints : data_.joint_rows) update_joints(joints, q, with_bias);
    for (const Elimination& e : data_.eliminations) {
        double* const out = filled(e.row);
        const double* const other = filled(e.other);
        for (const int j : e.columns) out[j] -= e.factor * other[j];
        g_[e.row] -= e.factor * g_[e.other];
        if (with_bias) bias_[e.row] -= e.factor * bias_[e.other];
    }
}

void System::update_joints(const JointRow& joints, const double* q, bool with_bias) {
    double* const out = column(joints.row);
    double g = -joints.offset;
    for (std::size_t k = 0; k < joints.coefficients.size(); ++k) {
        out[joints.in_v[k]] = joints.coefficients[k];
        g += joints.coefficients[k] * q[joints.in_q[k]];
    }
    g_[joints.row] = g;
    bias_[joints.row] = 0.0;
    if (!joints.powers.empty()) update_powers(joints, q, with_bias);
}

// The powers of a joint row: P(y) of g, P'(y) b of G and P''(y) (b . v)^2 of Gdot v.
void System::update_powers(const JointRow& joints, const double* q, bool with_bias) {
    double y = 0.0, rate = 0.0;
    for (std::size_t k = 0; k < joints.arguments.size(); ++k) {
        y += joints.arguments[k] * q[joints.in_q[k]];
        if (with_bias) rate += joints.arguments[k] * v_[joints.in_v[k]];
    }
    double value = 0.0, slope = 0.0, half_curvature = 0.0;  // Horner's scheme
    const auto next = [&](double a) {
        half_curvature = half_curvature * y + slope;
        slope = slope * y + value;
        value = value * y + a;
    };
    std::for_each(joints.powers.rbegin(), joints.powers.rend(), next);
    next(0.0);
    next(0.0);
    g_[joints.row] -= value;
    bias_[joints.row] = -2.0 * half_curvature * rate * rate;
    double* const out = filled(joints.row);
    for (std::size_t k = 0; k < joints.arguments.size(); ++k)
        out[joints.in_v[k]] -= slope * joints.arguments[k];
}

// A row of G = (force, moment) J, with the moment on a about its base, that on b about its own.
void System::fill(const ClosureRows& closure, int row, const Vec& force, const Vec& on_a,
                  const Vec& on_b) {
    const double* J = work_->data.J.data();
    double* const out = column(row);
    for (std::size_t k = 0; k < closure.columns.size(); ++k) {
        const int j = closure.columns[k];
        const double* column = J + 6 * j;
        const Vec& moment = closure.signs[k] > 0.0 ? on_a : on_b;
        out[j] = closure.signs[k] * (dot(force, vec(column)) + dot(moment, vec(column + 3)));
    }
}

// Rows along directions and distances of points.
//
// x is the point of anchor a from its base, seen from that of b, p its offset from the point of
// anchor b in the axes of b, r and bias the first derivative of p and the second without
// accelerations of the joints.
// With `rates` (rows,), G v is written there, from the velocities of the bodies, and neither G nor
// Gdot v is computed.
void System::update_positions(const ClosureRows& closure, bool with_bias, double* rates) {
    const Body a(work_->data, closure.joint_a), b(work_->data, closure.joint_b);
    const bool ground = closure.joint_b == 0;
    const Vec at_a = vec(closure.at_a.data());
    const Vec x = to_world(a.rotation, at_a) + a.origin();
    const Vec base_a = vec(work_->base(closure.joint_a).data());
    const Vec seen_x = x + (base_a - vec(work_->base(closure.joint_b).data()));
    const Vec at_b = ground ? x : from_world(b.rotation, seen_x - b.origin());
    Vec r{}, bias{};
    if (rates) {
        r = to_world(a.rotation, a.velocity() + cross(a.spin(), at_a));
        if (!ground)
            r = from_world(b.rotation, r) - (b.velocity() + cross(b.spin(), at_b));
    } else if (with_bias) {
        const Vec speed = a.velocity() + cross(a.spin(), at_a);
        bias = a.bias() + cross(a.spin_bias(), at_a) + cross(a.spin(), speed);
        bias = to_world(a.rotation, bias);
        r = to_world(a.rotation, speed);
        if (ground) {
            bias = bias - b.bias();  // -gravity, which every body's bias has
        } else {
            const Vec seen = from_world(b.rotation, r);
            const Vec carried = b.velocity() + cross(b.spin(), at_b);
            // omega_b x (carried + 2 r), r = seen - carried
            const Vec twice = 2.0 * seen - carried;
            r = seen - carried;
            bias = from_world(b.rotation, bias) -
                   (b.bias() + cross(b.spin_bias(), at_b) + cross(b.spin(), twice));
        }
    }
    const Vec anchor_b = vec(closure.at_b.data());
    const Vec p = at_b - (ground ? anchor_b - base_a : anchor_b);
    int row = closure.first_row;
    const auto along = [&](const Vec& d, double g, double rate) {
        g_[row] = g;
        if (rates) {
            rates[row++] = dot(d, r);
            return;
        }
        const Vec e = ground ? d : to_world(b.rotation, d);
        fill(closure, row, e, cross(x, e), cross(seen_x, e));
        if (with_bias) bias_[row] = rate;
        ++row;
    };
    for (std::size_t k = 0; k < closure.directions.size(); k += 3) {
        const Vec d = vec(&closure.directions[k]);
        along(d, dot(d, p), dot(d, bias));
    }
    for (std::size_t k = 0; k < closure.distances.size(); k += 2) {
        const double length = closure.distances[k], factor = closure.distances[k + 1];
        const double apart = std::sqrt(dot(p, p));
        if (apart < data_.coincident * length) throw EvaluationError{Failure::coincident};
        const double by = factor / apart;
        const Vec d = by * p, across = cross(d, r);
        along(d, factor * (apart - length),
              dot(d, bias) + dot(across, across) / (by * (apart * apart)));
    }
}

// Rows that keep directions u of a and n of b perpendicular: g = n . m, m = u in the axes of b.
// w and bias are the angular velocity of a against b and its derivative without accelerations;
// `rates` as for update_positions().
void System::update_alignments(const ClosureRows& closure, bool with_bias, double* rates) {
    const Body a(work_->data, closure.joint_a), b(work_->data, closure.joint_b);
    const auto seen = [&](const Vec& v) { return from_world(b.rotation, to_world(a.rotation, v)); };
    Vec w{}, bias{};
    if (rates) {
        w = seen(a.spin()) - b.spin();
    } else if (with_bias) {
        const Vec carried = b.spin(), spin = seen(a.spin());
        w = spin - carried;
        bias = seen(a.spin_bias()) - b.spin_bias() - cross(carried, spin);
    }
    const std::size_t before = closure.directions.size() / 3 + closure.distances.size() / 2;
    int row = closure.first_row + static_cast<int>(before);
    for (std::size_t k = 0; k < closure.alignments.size(); k += 6, ++row) {
        const Vec m = seen(vec(&closure.alignments[k])), n = vec(&closure.alignments[k + 3]);
        g_[row] = dot(n, m);
        if (rates) {
            rates[row] = dot(n, cross(w, m));
            continue;
        }
        const Vec moment = to_world(b.rotation, cross(m, n));
        fill(closure, row, Vec{}, moment, moment);
        if (with_bias) bias_[row] = dot(n, cross(bias, m) + cross(w, cross(w, m)));
    }
}

void System::hold(double t, const double* force, bool keep) {
    if (!keep) {
        held_from_.clear();
        held_.clear();
    }
    held_from_.push_back(t);
    held_.insert(held_.end(), force, force + nv);
}

void System::move(const void* model, const std::vector<Point>& origins) {
    const auto& other = checked_model(*static_cast<const pinocchio::Model*>(model));
    if (other.njoints != work_->model.njoints || other.nq != nq || other.nv != nv)
        throw std::invalid_argument("model has other joints");
    expect_size("origins", origins.size(), 2 * data_.closures.size());
    work_->take(other);
    auto next = origins.begin();
    for (ClosureRows& closure : data_.closures) {
        closure.at_a = *next++;
        closure.at_b = *next++;
    }
}

void System::renew(std::vector<double> unit, std::vector<double> residual_scale,
                   std::vector<double> damping, std::vector<double> friction,
                   double friction_speed) {
    const auto components = static_cast<std::size_t>(nv);
    expect_size("unit", unit.size(), components);
    expect_size("residual_scale", residual_scale.size(), static_cast<std::size_t>(data_.rows));
    if (!damping.empty()) expect_size("damping", damping.size(), components);
    if (!friction.empty()) expect_size("friction", friction.size(), components);
    data_.unit = std::move(unit);
    data_.residual_scale = std::move(residual_scale);
    data_.damping = std::move(damping);
    data_.friction = std::move(friction);
    data_.friction_speed = friction_speed;
    find_friction();
    restart();
}

void System::restart() {
    track_laws(false);
    held_from_.clear();
    held_.clear();
    between(-infinity, infinity);
    evaluations = 0;
    if (closed_) projection_->factorisations = 0;
}

int System::resolve_laws() {
    std::vector<bool> passive(nv, false);
    for (const auto* factors : {&data_.damping, &data_.friction})
        for (std::size_t i = 0; i < factors->size(); ++i)
            if ((*factors)[i] != 0.0) passive[i] = true;
    laws_.resolve(data_.forces, passive);
    lawful_.clear();
    lawless_.clear();
    joined_.clear();
    if (!closed_ || laws_.count() <= nv - structural_rank()) return laws_.count();
    for (const ForceElement& e : data_.forces)
        (e.kind == ForceKind::wrench || e.kind == ForceKind::joint_torque ? lawless_ : lawful_)
            .push_back(e);
    if (lawful_.empty()) return laws_.count();
    joined_.resize(nv);
    laws_.join(nv);
    return nv;
}

// The forces of joined laws, or what acts in their place, and those of the other elements.
void System::joined_forces(double t, const double* q) {
    auto& w = *work_;
    for (int i = 0; i < nv; ++i) joined_[i] = passive_force(i);
    add_forces(lawful_, data_.coincident, w, t, q, v_.data(), bushings_, joined_.data(), nullptr);
    add_forces(lawless_, data_.coincident, w, t, q, v_.data(), bushings_, f_.data(), nullptr);
    const double* acting = laws_.applied ? laws_.applied : joined_.data();
    for (int i = 0; i < nv; ++i) f_[i] += acting[i];
}

// What closures leave of them: M (1 - P) M^-1 times the forces.
void System::joined_values() {
    std::copy(joined_.begin(), joined_.end(), white_.begin());
    projection_->whiten_force(white_.data());
    projection_->remove_normal(white_.data());
    projection_->unwhiten(white_.data());
    mass_times(white_.data(), laws_.values.data());
}

void System::factorise_mass() {
    factors_.resize(static_cast<std::size_t>(nv) * nv);
    pivots_.resize(nv);
    const auto& M = work_->data.M;  // the upper triangle
    for (int j = 0; j < nv; ++j)
        for (int i = 0; i <= j; ++i) factors_[j * nv + i] = factors_[i * nv + j] = M(i, j);
    if (!lu_factor(factors_.data(), nv, pivots_.data()))
        throw EvaluationError{Failure::acceleration};
}

void System::law_accelerations(double* out) {
    const int m = laws_.count();
    auto& w = *work_;
    const double* const applied = laws_.applied;
    std::vector<double> unit(m), none(nv), force(nv);
    const auto forces_with = [&](std::vector<double>& tau) {
        laws_.applied = unit.data();
        add_forces(data_.forces, data_.coincident, w, 0.0, w.q.data(), v_.data(), bushings_,
                   tau.data(), &laws_);
    };
    if (code_) {  // it computes the kinematics of bushings only
        pinocchio_model::move_bodies(w);
        pinocchio::computeJointJacobians(w.model, w.data);
    }
    if (!closed_ && nv > one_pass_size) {
        pinocchio::crba(w.model, w.data, Argument(w.q), pinocchio::Convention::WORLD);
        factorise_mass();
    }
    if (joined_.empty()) forces_with(none);
    for (int k = 0; k < m; ++k) {
        std::fill(force.begin(), force.end(), 0.0);
        unit[k] = 1.0;
        if (joined_.empty()) {
            forces_with(force);
            for (int i = 0; i < nv; ++i)
                force[i] += (laws_.of_coordinate(i) == k ? 1.0 : 0.0) - none[i];
        } else {
            force[k] = 1.0;
        }
        unit[k] = 0.0;
        double* const a = out + static_cast<std::ptrdiff_t>(k) * nv;
        if (closed_) {
            projection_->whiten_force(force.data());
            std::copy(force.begin(), force.end(), a);
            projection_->unwhiten(a);
            normal_part(a, force.data());
            for (int i = 0; i < nv; ++i) a[i] -= force[i];
        } else {
            std::copy(force.begin(), force.end(), a);
            lu_solve(factors_.data(), nv, pivots_.data(), a);
        }
    }
    laws_.applied = applied;
}

// The laws of coordinates, as far as they are damping and friction; applied ones act.
void System::passive_forces() {
    for (int i = 0; i < nv; ++i) {
        const int law = laws_.of_coordinate(i);
        if (law < 0) continue;
        laws_.values[law] = passive_force(i);
        if (laws_.applied) f_[i] += laws_.applied[law];
    }
}

double System::friction_tolerance(double rate) const {
    return data_.friction_speed + friction_part * std::abs(rate);
}

bool System::time_dependent() const {
    return controller_ || driven() ||
           std::any_of(data_.forces.begin(), data_.forces.end(),
                       [](const ForceElement& force) { return !force.curves.empty(); });
}

bool System::holds(const double* force) const {
    return held_.size() >= static_cast<std::size_t>(nv) &&
           std::equal(force, force + nv, held_.end() - nv);
}

const double* System::held_force(double t) const {
    if (held_from_.empty()) return nullptr;
    std::size_t k = held_from_.size() - 1;
    if (t < held_from_[k] && k > 0) {
        const auto after = std::upper_bound(held_from_.begin(), held_from_.end(), t);
        const auto later = static_cast<std::size_t>(after - held_from_.begin());
        k = later == 0 ? 0 : later - 1;
    }
    return &held_[k * nv];
}

// Evaluates the rows of driven joints, and subtracts the motion at t from all driven rows.
void System::update_drives(double t, bool with_bias) {
    const double* q = work_->q.data();
    for (const DrivenRow& drive : data_.drives) {
        const int row = drive.row;
        const bool joint = drive.in_v >= 0;
        if (joint) {
            const double angle = drive.wraps ? std::atan2(q[drive.in_q + 1], q[drive.in_q])
                                             : q[drive.in_q];
            g_[row] = drive.factor * angle;
            bias_[row] = 0.0;
            column(row)[drive.in_v] = drive.factor;
        }
        double s[3];
        drive.curve.at(t, s);
        g_[row] -= drive.factor * s[0];
        pushed_[row] = drive.factor * s[1];
        if (with_bias) bias_[row] -= drive.factor * s[2];
        if (drive.wraps)  // the nearest turn
            g_[row] = drive.factor * std::remainder(g_[row] / drive.factor, two_pi);
    }
}

void System::use_code(const GeneratedTerms* code) {
    if (code) {
        std::size_t laws = 0;
        std::vector<int> joints;
        std::size_t bushings = 0;
        for (const ForceElement& force : data_.forces) {
            laws += force.curves.size();
            if (force.kind != ForceKind::bushing) continue;
            ++bushings;
            for (const int joint : {force.a.joint, force.b.joint})
                if (joint && std::find(joints.begin(), joints.end(), joint) == joints.end())
                    joints.push_back(joint);
        }
        code->check(nq, nv, data_.rows, data_.structural_rank, static_cast<int>(laws),
                    static_cast<int>(joints.size()));
        const std::size_t held = code->held(), n = nv;
        law_values_.resize(laws);
        held_values_.resize(held);
        own_laws_.resize(nv);
        unused_.resize(n * n + 3 * n + data_.rows);
        if (code->linearises()) {
            turns_.resize(5 * bushings);
            multipliers_.resize(data_.rows);
            Dr_.resize(n * (2 * n + held));
            Dc_.resize(data_.rows * 2 * n);
            Dl_.resize(held * 2 * n);
            Dq_.resize(n);
            Dv_.resize(n);
        }
        columns_of_rows_.resize(data_.rows);
        bushing_bodies_.clear();
        for (const int joint : joints) {
            auto& at = work_->data.oMi[joint];
            bushing_bodies_.push_back(at.rotation().data());
            bushing_bodies_.push_back(at.translation().data());
            bushing_bodies_.push_back(work_->data.v[joint].toVector().data());
        }
    }
    code_ = code;
    if (!closed_) return;
    const GeneratedAlgebra* const algebra = code ? code->algebra() : nullptr;
    if ((algebra != nullptr) != (by_code_ != nullptr)) {
        // The other one waits in its place.
        if (algebra && !other_projection_)
            other_projection_ = std::make_unique<GeneratedProjection>(
                nv, data_.rows, data_.structural_rank, data_.sigma_ref, *algebra);
        std::swap(projection_, other_projection_);
        projection_->factorisations = 0;
        by_code_ = algebra ? static_cast<GeneratedProjection*>(projection_.get()) : nullptr;
    }
    if (algebra) by_code_->use(*algebra);
}

// M, the forces f and the rows of the closures, by generated code.
void System::generated_terms(double t, const double* state, ForceLaws* laws) {
    auto& w = *work_;
    std::size_t law = 0;
    double s[3];
    for (const ForceElement& force : data_.forces)
        for (const Curve& curve : force.curves) {
            curve.at(t, s);
            law_values_[law++] = s[0];
        }
    double* const* rows = columns_of_rows_.data();
    if (by_code_)
        rows = by_code_->rows_for_code();
    else
        for (int row = 0; row < data_.rows; ++row) columns_of_rows_[row] = column(row);
    const bool joined = laws && !joined_.empty();
    if (joined) {
        for (int i = 0; i < nv; ++i) joined_[i] = passive_force(i);
        laws = nullptr;
    }
    double* const lawful = joined ? joined_.data() : f_.data();
    const int first = laws ? laws->first_of_elements() : 0;
    if (laws) std::fill(own_laws_.begin(), own_laws_.end(), 0.0);
    if (!code_->evaluate(state, state + nq, law_values_.data(),
                         laws && laws->applied ? laws->applied + first : nullptr,
                         w.data.M.data(), w.data.nle.data(), f_.data(), lawful,
                         held_values_.data(), own_laws_.data(), g_.data(), bias_.data(),
                         rows, bushing_bodies_.data(), w.data.J.data()))
        throw EvaluationError{Failure::coincident};
    if (laws) {
        std::copy(held_values_.begin(), held_values_.end(), laws->values.begin() + first);
        for (int i = 0; i < nv; ++i)
            if (const int own = laws->of_coordinate(i); own >= 0) laws->values[own] += own_laws_[i];
    }
    add_bushings(data_.forces, w, bushings_, lawful, laws);
    if (joined) {
        joined_act_ = !laws_.applied;
        const double* acting = joined_act_ ? joined_.data() : laws_.applied;
        for (int i = 0; i < nv; ++i) f_[i] += acting[i];
    }
    for (int i = 0; i < nv; ++i) f_[i] -= w.data.nle[i];
}

void System::tree_terms(const double* state) {
    auto& w = *work_;
    w.place(state);
    std::copy(state + nq, state + nq + nv, w.v.data());
    if (code_)
        generated_terms(0.0, state, nullptr);
    else if (closed_)
        pinocchio_model::compute_terms(w);
    else
        pinocchio::aba(w.model, w.data, Argument(w.q), Argument(w.v), Argument(w.tau));
}

// The velocities, and the forces along coordinates but those of elements.
void System::coordinate_forces(double t, const double* state) {
    std::copy(state + nq, state + nq + nv, v_.begin());
    std::fill(f_.begin(), f_.end(), 0.0);
    const bool joined = tracks_laws_ && !joined_.empty();
    if (!data_.damping.empty() && !laws_.applied && !joined)
        for (int i = 0; i < nv; ++i) f_[i] = -data_.damping[i] * v_[i];
    if (controller_) {
        controller_(t, state, state + nq, acted_.data());
        for (int i = 0; i < nv; ++i) f_[i] += acted_[i];
    }
    if (const double* force = held_force(t))
        for (int i = 0; i < nv; ++i) f_[i] += force[i];
    if (!laws_.applied && !joined)
        for (std::size_t i = 0; i < data_.friction.size(); ++i)
            f_[i] -= data_.friction[i] * std::tanh(v_[i] / data_.friction_speed);
    if (tracks_laws_ && !joined) passive_forces();
}

void System::applied_forces(double t, const double* state, double* out) {
    auto& w = *work_;
    t = std::clamp(t, first_, last_);
    coordinate_forces(t, state);
    if (!data_.forces.empty()) {
        if (on_several_) {
            move_bodies(state);
            pinocchio::computeJointJacobians(w.model, w.data);
        }
        add_forces(data_.forces, data_.coincident, w, t, state, v_.data(), bushings_, f_.data(),
                   tracks_laws_ ? &laws_ : nullptr);
    }
    std::copy(f_.begin(), f_.end(), out);
}

// With ID the inverse dynamics, N the M-orthonormal normals of closures whose G is constant, and
// A = M^-1 - N N^T: da = A (df - dID).
bool System::derivatives(const double* state, const double* a, double* by_forces, double* by_q,
                         double* by_v) {
    using Matrix = Eigen::MatrixXd;
    auto& w = *work_;
    const auto powers = [](const JointRow& row) { return !row.powers.empty(); };
    if (!data_.closures.empty() || !joined_.empty() || rank_deficient()) return false;
    if (std::any_of(data_.joint_rows.begin(), data_.joint_rows.end(), powers)) return false;
    if (!w.model.mimicking_joints.empty() || !w.model.gravity.angular().isZero(0.0)) return false;
    Matrix M = Matrix::Zero(nv, nv), dq(M), dv(M), N;
    if (closed_) {
        N.resize(nv, rank());
        projection_->normals(N.data());
    }
    w.place(state);
    std::copy(state + nq, state + nq + nv, w.v.data());
    std::copy(a, a + nv, w.tau.data());
    pinocchio::computeRNEADerivatives(w.model, w.data, Argument(w.q), Argument(w.v),
                                      Argument(w.tau), Eigen::Ref<Matrix>(dq),
                                      Eigen::Ref<Matrix>(dv), Eigen::Ref<Matrix>(M));
    const Eigen::LLT<Matrix, Eigen::Upper> factors(M);
    if (factors.info() != Eigen::Success) throw EvaluationError{Failure::acceleration};
    Eigen::Map<Matrix> A(by_forces, nv, nv);
    A.setIdentity();
    factors.solveInPlace(A);
    if (closed_) A.noalias() -= N * N.transpose();
    Eigen::Map<Matrix>(by_q, nv, nv).noalias() = -A * dq;
    Eigen::Map<Matrix>(by_v, nv, nv).noalias() = -A * dv;
    return true;
}

// From changes r = dr of the residual forces and c = dc of the rows' accelerations to da in r:
// M da + G^T dlam = -dr, G da = -dc.
void System::acceleration_of(double* r, const double* c) {
    for (int i = 0; i < nv; ++i) r[i] = -r[i];
    if (!closed_) {
        lu_solve(factors_.data(), nv, pivots_.data(), r);
        return;
    }
    projection_->whiten_force(r);
    projection_->remove_normal(r);
    if (c) {
        projection_->normal(c, white_.data());
        for (int i = 0; i < nv; ++i) r[i] -= white_[i];
    }
    projection_->unwhiten(r);
}

// Damping and friction of a coordinate.
double System::passive_force(int i) const {
    double out = 0.0;
    if (!data_.damping.empty()) out -= data_.damping[i] * v_[i];
    if (!data_.friction.empty()) out -= data_.friction[i] * std::tanh(v_[i] / data_.friction_speed);
    return out;
}

// Its derivative by the rate.
double System::passive_slope(int i) const {
    double out = data_.damping.empty() ? 0.0 : -data_.damping[i];
    if (data_.friction.empty()) return out;
    const double share = std::tanh(v_[i] / data_.friction_speed);
    return out - data_.friction[i] / data_.friction_speed * (1.0 - share * share);
}

// Adds to Dr_ what the controller contributes.
void System::controller_by_state(double t, const double* state, const std::vector<double>& steps) {
    t = std::clamp(t, first_, last_);
    std::vector<double> x(nq + nv), delta(2 * nv), here(nv);
    controller_(t, state, state + nq, here.data());
    for (int j = 0; j < 2 * nv; ++j) {
        delta[j] = steps[j];
        retract(state, delta.data(), x.data());
        delta[j] = 0.0;
        controller_(t, x.data(), x.data() + nq, acted_.data());
        for (int i = 0; i < nv; ++i) Dr_[j * nv + i] -= (acted_[i] - here[i]) / steps[j];
    }
}

// The generated derivatives with these accelerations (nv,), multipliers (rows,) and laws of elements.
void System::generated_derivatives(const double* state, const double* a, const double* lam,
                                   const double* applied) {
    for (auto* zeroed : {&Dr_, &Dc_, &Dl_, &Dq_, &Dv_})
        std::fill(zeroed->begin(), zeroed->end(), 0.0);
    code_->linearise(state, state + nq, law_values_.data(), a, lam, applied, turns_.data(),
                     Dr_.data(), Dc_.data(), Dl_.data(), Dq_.data(), Dv_.data());
}

bool System::linearise(double t, const double* state, const double* a,
                       const std::vector<double>& steps, double* by_q, double* by_v,
                       double* by_laws, double* of_laws) {
    if (!code_ || !code_->linearises() || rank_deficient()) return false;
    const bool joined = !joined_.empty();
    if (joined && !turns_.empty()) return false;
    auto& w = *work_;
    if (closed_) {
        white_ = projection_->white_multiplier;
        projection_->multiplier(white_.data(), multipliers_.data());
    } else if (nv > one_pass_size) {
        pinocchio::crba(w.model, w.data, Argument(w.q), pinocchio::Convention::WORLD);
        factorise_mass();
    }
    bushing_turns(data_.forces, w, bushings_, turns_.data());
    if (joined) joined_laws_by_state(state, a, of_laws);
    const int first = joined ? 0 : laws_.first_of_elements();
    const std::vector<double> none(code_->held());
    const double* const applied =
        joined || !laws_.applied ? none.data() : laws_.applied + first;
    generated_derivatives(state, a, multipliers_.data(), applied);
    if (controller_) controller_by_state(t, state, steps);
    for (int j = 0; j < 2 * nv; ++j) {
        double* const column = j < nv ? by_q + j * nv : by_v + (j - nv) * nv;
        std::copy_n(&Dr_[j * nv], nv, column);
        acceleration_of(column, closed_ ? &Dc_[j * data_.rows] : nullptr);
    }
    const int m = laws_.count();
    for (int k = 0; k < m; ++k) {
        double* const column = by_laws + k * nv;
        if (joined || k < first) {
            std::fill_n(column, nv, 0.0);
        } else {
            std::copy_n(&Dr_[(2 * nv + k - first) * nv], nv, column);
            acceleration_of(column, nullptr);
        }
    }
    for (int i = 0; i < nv; ++i)
        if (const int law = joined ? i : laws_.of_coordinate(i); law >= 0) {
            by_laws[law * nv + i] = -1.0;
            acceleration_of(by_laws + law * nv, nullptr);
        }
    if (joined) return true;
    for (int j = 0; j < 2 * nv; ++j) {
        std::fill_n(of_laws + j * m, first, 0.0);
        std::copy_n(Dl_.begin() + j * (m - first), m - first, of_laws + j * m + first);
    }
    for (int i = 0; i < nv; ++i)
        if (const int law = laws_.of_coordinate(i); law >= 0) {
            of_laws[i * m + law] = Dq_[i];
            of_laws[(nv + i) * m + law] = Dv_[i] + passive_slope(i);
        }
    return true;
}

// Derivatives (nv, 2 nv) of joined laws z = M u with M u + G^T mu = F and G u = 0, F the forces of
// the laws (nv,): those of M u + G^T mu and of G u are what derivatives with a + u and lam + mu
// have in addition to those with a and lam, because they are linear in these.
void System::joined_laws_by_state(const double* state, const double* a, double* out) {
    const int rows = data_.rows, held = code_->held();
    const std::size_t n = nv, columns = 2 * n;
    std::vector<double> u(joined_), mu(rows), accelerations(a, a + nv);
    projection_->whiten_force(u.data());
    projection_->multiplier(u.data(), mu.data());
    projection_->remove_normal(u.data());
    projection_->unwhiten(u.data());
    const std::vector<double> none(held);
    // What acts from now on is z, of which the closures take up nothing.
    if (joined_act_)
        for (int i = 0; i < rows; ++i) multipliers_[i] -= mu[i];
    std::vector<double> multipliers(multipliers_);
    generated_derivatives(state, accelerations.data(), multipliers.data(), none.data());
    const std::vector<double> r(Dr_), c(Dc_);
    for (int i = 0; i < nv; ++i) accelerations[i] += u[i];
    generated_derivatives(state, accelerations.data(), multipliers.data(), none.data());
    for (std::size_t i = 0; i < columns * n; ++i) out[i] = Dr_[i] - r[i];  // dM u
    for (int i = 0; i < rows; ++i) multipliers[i] += mu[i];
    generated_derivatives(state, accelerations.data(), multipliers.data(), held_values_.data());
    std::vector<double> change(n), moved(n), rows_change(rows);
    for (std::size_t j = 0; j < columns; ++j) {
        for (std::size_t i = 0; i < n; ++i) change[i] = Dr_[j * n + i] - r[j * n + i];
        for (int e = 0; e < held; ++e)
            add(Dl_[j * held + e], &Dr_[(columns + e) * n], change.data(), nv);
        const std::size_t i = j % n;
        change[i] -= j < n ? Dq_[i] : Dv_[i] + passive_slope(static_cast<int>(i));
        for (int row = 0; row < rows; ++row)
            rows_change[row] = Dc_[j * rows + row] - c[j * rows + row];
        acceleration_of(change.data(), rows_change.data());
        mass_times(change.data(), moved.data());
        for (std::size_t k = 0; k < n; ++k) out[j * n + k] += moved[k];
    }
}

void System::evaluate(double t, const double* state, const ZoneView& zone) {
    ++evaluations;
    t = std::clamp(t, first_, last_);
    if (!(distance(state, nq + nv) < overflow)) throw EvaluationError{Failure::not_finite};
    auto& w = *work_;
    w.place(state);
    std::copy(state + nq, state + nq + nv, w.v.data());
    coordinate_forces(t, state);
    ForceLaws* const laws = tracks_laws_ ? &laws_ : nullptr;
    const bool joined = laws && !joined_.empty();
    if (!closed_) return evaluate_open(t, state, laws);
    if (code_) {
        generated_terms(t, state, laws);
    } else {
        pinocchio_model::compute_terms(w);
        for (int i = 0; i < nv; ++i) f_[i] -= w.data.nle[i];
        if (joined)
            joined_forces(t, state);
        else if (!data_.forces.empty())
            add_forces(data_.forces, data_.coincident, w, t, state, v_.data(), bushings_, f_.data(),
                       laws);
        update_closures(state, true);
    }
    update_drives(t, true);
    Projection& p = *projection_;
    p.factor(w.data.M.data(), f_.data(), bias_.data(), zone.threshold);
    if (joined) joined_values();
    predicted_ = false;
    if (!p.rank_deficient || zone.history == nullptr) return;
    predicted_ = zone.predicts && zone.history->predict_near(t, prediction_.data());
    if (predicted_) return;
    if (zone.history->normal_count() < p.structural_rank - p.rank)
        throw EvaluationError{Failure::no_branch};
    p.hold(zone.history->normals.data(), zone.history->normal_count());
}

// The accelerations without closures.
void System::evaluate_open(double t, const double* state, ForceLaws* laws) {
    auto& w = *work_;
    if (laws ? nv <= one_pass_size : code_ != nullptr) {
        if (code_) {
            generated_terms(t, state, laws);
            std::copy(f_.begin(), f_.end(), rate_.begin());
        } else {
            // The one pass over the tree that closures have costs less than three.
            pinocchio_model::compute_terms(w);
            for (int i = 0; i < nv; ++i) rate_[i] = f_[i] - w.data.nle[i];
            add_forces(data_.forces, data_.coincident, w, t, state, v_.data(), bushings_,
                       rate_.data(), laws);
        }
        factorise_mass();
        lu_solve(factors_.data(), nv, pivots_.data(), rate_.data());
    } else {
        if (!data_.forces.empty()) {
            pinocchio_model::move_bodies(w);
            pinocchio::computeJointJacobians(w.model, w.data);
            add_forces(data_.forces, data_.coincident, w, t, state, v_.data(), bushings_, f_.data(),
                       laws);
        }
        std::copy(f_.begin(), f_.end(), w.tau.data());
        pinocchio::aba(w.model, w.data, Argument(w.q), Argument(w.v), Argument(w.tau));
        std::copy(w.data.ddq.data(), w.data.ddq.data() + nv, rate_.begin());
    }
    if (!finite(rate_.data(), nv)) throw EvaluationError{Failure::acceleration};
}

// The part of a multiplier of the rows in use, in white coordinates, plus (1 - P) yhat_pred.
void System::completed(const double* white, double* out) const {
    std::copy(white, white + nv, out);
    if (!predicted_) return;
    std::vector<double> x(prediction_);
    projection_->whiten_velocity(x.data());
    projection_->remove_normal(x.data());
    for (int i = 0; i < nv; ++i) out[i] += x[i];
}

void System::rate(double* out) {
    std::copy(v_.begin(), v_.end(), out);
    if (!closed_) {
        std::copy(rate_.begin(), rate_.end(), out + nv);
        return;
    }
    const double *force = projection_->white_force.data(),
                 *multiplier = projection_->white_multiplier.data();
    if (predicted_) {
        completed(multiplier, white_.data());
        multiplier = white_.data();
    }
    for (int i = 0; i < nv; ++i) out[nv + i] = force[i] - multiplier[i];
    projection_->unwhiten(out + nv);
}

void System::multiplier(double* out) {
    if (!closed_) {
        std::fill(out, out + nv, 0.0);
        return;
    }
    completed(projection_->white_multiplier.data(), out);
    projection_->unwhiten(out);
}

bool System::drive_forces(double* out) {
    if (!closed_ || projection_->rank < data_.rows) return false;
    std::vector<double> lam(data_.rows);
    white_ = projection_->white_multiplier;
    projection_->multiplier(white_.data(), lam.data());
    for (const DrivenRow& drive : data_.drives) *out++ = -lam[drive.row] * drive.factor;
    return true;
}

void System::correction(double* out) {
    if (!closed_) {
        std::fill(out, out + 2 * nv, 0.0);
        return;
    }
    projection_->normal(g_.data(), out);
    projection_->unwhiten(out);
    projection_->white_project(v_.data(), out + nv);
    if (!data_.drives.empty()) {  // E (G v - s') = P v - E s'
        projection_->normal(pushed_.data(), white_.data());
        for (int i = 0; i < nv; ++i) out[nv + i] -= white_[i];
    }
    projection_->unwhiten(out + nv);
}

void System::free_acceleration(double* out) {
    std::copy(projection_->white_force.begin(), projection_->white_force.end(), out);
    projection_->unwhiten(out);
}

void System::acceleration_by(const double* f, double* out) const {
    std::copy_n(f, nv, out);
    projection_->whiten_force(out);
    projection_->unwhiten(out);
}

void System::impulse_response(const double* q, const double* n, double* along, double* free) {
    auto& w = *work_;
    w.place(q);
    w.v.setZero();
    pinocchio_model::compute_terms(w);
    update_closures(q, false);
    update_drives(0.0, false);
    std::fill(bias_.begin(), bias_.end(), 0.0);
    Projection& p = *projection_;
    p.factor(w.data.M.data(), n, bias_.data(), -1.0);
    free_acceleration(along);
    std::copy(p.white_force.begin(), p.white_force.end(), free);
    p.remove_normal(free);
    p.unwhiten(free);
}

void System::normal_part(const double* w, double* out) const {
    projection_->white_project(w, out);
    projection_->unwhiten(out);
}

void System::multiplier_of(const double* a, double* out) {
    projection_->white_project(a, out);
    projection_->normal(bias_.data(), white_.data());
    for (int i = 0; i < nv; ++i) out[i] += white_[i];
    projection_->unwhiten(out);
}

void System::closing(const std::vector<double>& allowed, double* out) {
    std::vector<double> g(g_);
    for (std::size_t k = 0; k < allowed.size(); ++k) g[data_.drives[k].row] -= allowed[k];
    projection_->normal(g.data(), out);
    projection_->unwhiten(out);
}

void System::driven_residuals(std::vector<double>& out) const {
    out.resize(data_.drives.size());
    for (std::size_t k = 0; k < out.size(); ++k) out[k] = g_[data_.drives[k].row];
}

int System::branch_tangents(std::vector<double>& out, std::vector<double>* rates) const {
    const std::size_t free = static_cast<std::size_t>(nv - projection_->rank);
    out.resize((free + data_.drives.size()) * nv);
    projection_->complement(out.data());
    std::size_t count = free;
    const int d = static_cast<int>(data_.drives.size());
    std::vector<double> unit(data_.rows), own_rates;
    std::vector<double>& driven = rates ? *rates : own_rates;
    driven.assign((free + d) * d, 0.0);
    for (int k = 0; k < d; ++k) {
        const DrivenRow& drive = data_.drives[k];
        double* const own = &out[count * nv];
        double* const its = &driven[count * d];
        its[k] = 1.0;
        unit[drive.row] = 1.0;
        projection_->normal(unit.data(), own);
        unit[drive.row] = 0.0;
        const double whole = norm(own, nv);
        for (int pass = 0; pass < 2; ++pass)
            for (std::size_t j = free; j < count; ++j) {
                const double part = -dot(&out[j * nv], own, nv);
                add(part, &out[j * nv], own, nv);
                add(part, &driven[j * d], its, d);
            }
        const double size = norm(own, nv);
        if (!(size > 1e-10 * whole)) {
            std::fill(its, its + d, 0.0);
            continue;
        }
        for (int i = 0; i < nv; ++i) own[i] /= size;
        for (int i = 0; i < d; ++i) its[i] /= size;
        ++count;
    }
    for (std::size_t j = 0; j < count; ++j) projection_->unwhiten(&out[j * nv]);
    return static_cast<int>(count);
}

double System::closure_residual() const {
    double out = 0.0;
    for (int i = 0; i < data_.rows; ++i)
        out = std::max(out, std::abs(g_[i] * data_.residual_scale[i]));
    return out;
}

void System::normals(std::vector<double>& out) const {
    // With drives the motion has a part along them: it cannot be held tangential.
    if (closed_ && data_.drives.empty())
        projection_->weak_normals(out);
    else
        out.clear();
}

void System::retract(const double* state, const double* delta, double* out) {
    if (flat_) {
        for (int i = 0; i < 2 * nv; ++i) out[i] = state[i] + delta[i];
        return;
    }
    // state and out may be the same array
    if (!vectors_and_groups(data_)) {
        auto& w = *work_;
        std::copy(state, state + nq, w.q.data());
        std::copy(delta, delta + nv, w.v.data());
        pinocchio::integrate(w.model, w.q, w.v, w.q2);
        for (const GroupJoint& joint : data_.groups)
            if (joint.group == Group::se2)
                planar_translation(state + joint.position, delta + joint.start,
                                   w.q2.data() + joint.position);
        std::copy(w.q2.data(), w.q2.data() + nq, out);
    } else {
        for (int i = 0; i < nv; ++i)
            if (const int k = data_.position_of[i]; k >= 0) out[k] = state[k] + delta[i];
        for (const GroupJoint& joint : data_.groups)
            joint_integrate(joint.group, state + joint.position, delta + joint.start,
                            out + joint.position);
    }
    for (int i = 0; i < nv; ++i) out[nq + i] = state[nq + i] + delta[nv + i];
}

void System::retract_some(const double* state, const double* delta,
                          const std::vector<int>& moving, double* out) {
    if (!vectors_and_groups(data_)) {
        retract(state, delta, out);
        return;
    }
    std::copy_n(state, nq + nv, out);
    for (const int i : moving) {
        if (const int k = data_.position_of[i]; k >= 0) out[k] = state[k] + delta[i];
        out[nq + i] = state[nq + i] + delta[nv + i];
    }
    for (const GroupJoint& joint : data_.groups)
        if (std::find(moving.begin(), moving.end(), joint.start) != moving.end())
            joint_integrate(joint.group, state + joint.position, delta + joint.start,
                            out + joint.position);
}

bool System::reachable(const double* start, const double* end) const {
    double moved[6];
    return std::all_of(data_.groups.begin(), data_.groups.end(), [&](GroupJoint joint) {
        joint_difference(joint.group, start + joint.position, end + joint.position, moved);
        joint.start = 0;  // the motion of this joint alone
        return joint.rotation(moved) <= data_.farthest_node;
    });
}

void System::difference(const double* start, const double* end, const double* near, double* out) {
    if (flat_) {
        for (int i = 0; i < 2 * nv; ++i) out[i] = end[i] - start[i];
        return;
    }
    for (int i = 0; i < nv; ++i) out[nv + i] = end[nq + i] - start[nq + i];
    // The logarithm loses digits at small angles, the exponential does not: one Newton step.
    if (vectors_and_groups(data_)) {
        for (int i = 0; i < nv; ++i) {
            const int k = data_.position_of[i];
            if (k < 0) continue;
            out[i] = end[k] - start[k];
            out[i] += end[k] - (start[k] + out[i]);
        }
        double there[7], step[6];
        for (const GroupJoint& joint : data_.groups) {
            double* const own = out + joint.start;
            const double *const from = start + joint.position, *const to = end + joint.position;
            joint_difference(joint.group, from, to, own);
            joint_integrate(joint.group, from, own, there);
            joint_difference(joint.group, there, to, step);
            for (int i = 0; i < joint.size; ++i) own[i] += step[i];
        }
        return;
    }
    auto& w = *work_;
    Eigen::VectorXd from = Eigen::Map<const Eigen::VectorXd>(start, nq);
    const Eigen::VectorXd to = Eigen::Map<const Eigen::VectorXd>(end, nq);
    Eigen::VectorXd step(nv);
    pinocchio::difference(w.model, from, to, step);
    std::copy(step.data(), step.data() + nv, out);
    std::vector<double> moved(nq + nv);
    retract(start, out, moved.data());
    from = Eigen::Map<const Eigen::VectorXd>(moved.data(), nq);
    pinocchio::difference(w.model, from, to, step);
    for (int i = 0; i < nv; ++i) out[i] += step[i];
    for (int i : data_.wrapped_angles)
        out[i] += two_pi * std::nearbyint((near[i] - out[i]) / two_pi);
}

void System::chart_rate(const double* delta, const double* rate, double* out) const {
    std::copy(rate, rate + 2 * nv, out);
    for (const GroupJoint& joint : data_.groups) {
        if (joint.rotation(delta) > data_.largest_rotation)
            throw EvaluationError{Failure::rotation};
        joint.dexp_inverse(delta + joint.start, rate + joint.start, data_.series,
                           out + joint.start);
    }
}

int System::cosine_of(std::size_t angle) const {
    const int i = data_.wrapped_angles[angle];
    // Each wrapped angle and each group before it has one coordinate more than velocities.
    const auto before = std::count_if(data_.groups.begin(), data_.groups.end(),
                                      [&](const GroupJoint& joint) { return joint.start < i; });
    return i + static_cast<int>(angle) + static_cast<int>(before);
}

void System::coordinate_rates(const double* state, const double* rate, double* out) const {
    for (int i = 0; i < nv; ++i) {
        if (const int k = data_.position_of[i]; k >= 0) out[k] = rate[i];
        out[nq + i] = rate[nv + i];
    }
    for (std::size_t angle = 0; angle < data_.wrapped_angles.size(); ++angle) {
        const int k = cosine_of(angle);
        const double speed = rate[data_.wrapped_angles[angle]];
        out[k] = -state[k + 1] * speed;
        out[k + 1] = state[k] * speed;
    }
    for (const GroupJoint& joint : data_.groups) {
        const double* q = state + joint.position;
        const double* v = rate + joint.start;
        double* own = out + joint.position;
        if (joint.group == Group::se2) {
            own[0] = q[2] * v[0] - q[3] * v[1];
            own[1] = q[3] * v[0] + q[2] * v[1];
            own[2] = -q[3] * v[2];
            own[3] = q[2] * v[2];
            continue;
        }
        if (joint.group == Group::se3) {
            const Eigen::Map<const Eigen::Quaterniond> turned(q + 3);
            const Eigen::Vector3d moving = turned * Eigen::Vector3d(v[0], v[1], v[2]);
            own = std::copy_n(moving.data(), 3, own);
            q += 3;
            v += 3;
        }
        const Eigen::Quaterniond half(0.0, 0.5 * v[0], 0.5 * v[1], 0.5 * v[2]);
        const Eigen::Quaterniond turning = Eigen::Quaterniond(q) * half;
        std::copy_n(turning.coeffs().data(), 4, own);
    }
}

void System::coordinate_errors(const double* allowed, double* out) const {
    for (int i = 0; i < nv; ++i)
        if (const int k = data_.position_of[i]; k >= 0) out[k] = allowed[i];
    std::copy(allowed + nv, allowed + 2 * nv, out + nq);
    for (std::size_t angle = 0; angle < data_.wrapped_angles.size(); ++angle)
        std::fill_n(out + cosine_of(angle), 2, allowed[data_.wrapped_angles[angle]]);
    for (const GroupJoint& joint : data_.groups) {
        const double* const of = allowed + joint.start;
        double* own = out + joint.position;
        const int lengths = joint.group == Group::so3 ? 0 : joint.group == Group::se3 ? 3 : 2;
        own = std::fill_n(own, lengths, lengths ? *std::min_element(of, of + lengths) : 0.0);
        // A quaternion changes by half the angle.
        const double angle = *std::min_element(of + lengths, of + joint.size);
        if (joint.group == Group::se2) std::fill_n(own, 2, angle);
        else std::fill_n(own, 4, 0.5 * angle);
    }
}

void System::normalise(double* state) const {
    const auto onto = [](double* x, int size) {
        const double by = 1.0 / norm(x, size);
        for (int i = 0; i < size; ++i) x[i] *= by;
    };
    for (std::size_t angle = 0; angle < data_.wrapped_angles.size(); ++angle)
        onto(state + cosine_of(angle), 2);
    for (const GroupJoint& joint : data_.groups) {
        double* const own = state + joint.position;
        if (joint.group == Group::se2) onto(own + 2, 2);
        else onto(own + (joint.group == Group::se3 ? 3 : 0), 4);
    }
}

double System::position_norm(const double* positions) const {
    double out = 0.0;
    for (int i = 0; i < nv; ++i) out = std::max(out, std::abs(positions[i]) / data_.unit[i]);
    return out;
}

void System::state_scale(const double* state, double* out) const {
    for (int i = 0; i < nv; ++i) {
        const int k = data_.position_of[i];
        out[i] = k < 0 ? data_.unit[i] : std::min(std::abs(state[k]), data_.unit[i]);
        out[nv + i] = std::abs(state[nq + i]);
    }
}

double System::step_limit(const double* state) const {
    double speed = 0.0;
    for (const GroupJoint& joint : data_.groups)
        speed = std::max(speed, joint.rotation(state + nq));
    return speed > 0.0 ? data_.rotation_per_step / speed : infinity;
}

void System::move_bodies(const double* state) {
    auto& w = *work_;
    w.place(state);
    std::copy(state + nq, state + nq + nv, w.v.data());
    pinocchio_model::move_bodies(w);
}

void System::begin_step(double t, const double* state) {
    bushings_.clear();
    if (std::none_of(data_.forces.begin(), data_.forces.end(), turns)) return;
    move_bodies(state);
    for (const ForceElement& e : data_.forces)
        if (turns(e)) bushings_.emplace_back(e, data_.half_turn, *work_, t);
}

double System::past_jump(double t, const double* state) {
    double out = -infinity;
    if (bushings_.empty()) return out;
    move_bodies(state);
    for (BushingStep& bushing : bushings_)
        out = std::max(out, bushing.past_half_turn(*work_, t));
    return out;
}

double System::closure_residual_at(double t, const double* state) {
    if (!closed_) return 0.0;
    auto& w = *work_;
    w.place(state);
    pinocchio::crba(w.model, w.data, Argument(w.q), pinocchio::Convention::WORLD);
    update_closures(state, false);
    update_drives(t, false);
    return closure_residual();
}

void System::mass_times(const double* x, double* out) const {
    const double* M = work_->data.M.data();  // the upper triangle
    for (int i = 0; i < nv; ++i) {
        out[i] = 0.0;
        for (int j = 0; j < nv; ++j) out[i] += M[std::max(i, j) * nv + std::min(i, j)] * x[j];
    }
}

void System::working_forces(double* all, double* working) {
    auto& w = *work_;
    std::copy(f_.begin(), f_.end(), all);
    for (int i = 0; i < nv; ++i) working[i] = f_[i] + w.data.nle[i];
    pinocchio::computeGeneralizedGravity(w.model, w.data, Argument(w.q));
    for (int i = 0; i < nv; ++i) working[i] -= w.data.g[i];
}

const ColumnGroups& System::column_groups() {
    if (!columns_.groups.empty()) return columns_;
    std::vector<std::vector<int>> of_rows(data_.rows);
    const auto extend = [&](int row, const std::vector<int>& columns) {
        of_rows[row].insert(of_rows[row].end(), columns.begin(), columns.end());
    };
    for (const ClosureRows& closure : data_.closures)
        for (std::size_t k = 0; k < closure.count(); ++k)
            extend(closure.first_row + static_cast<int>(k), closure.columns);
    for (const JointRow& joints : data_.joint_rows) extend(joints.row, joints.in_v);
    for (const Elimination& e : data_.eliminations) extend(e.row, e.columns);
    for (const DrivenRow& drive : data_.drives) {
        if (drive.in_v >= 0) extend(drive.row, {drive.in_v});
        extend(drive.row, {nv});
    }
    const int n = nv + (driven() ? 1 : 0);
    std::vector<std::vector<bool>> touches(n, std::vector<bool>(n, false));
    for (const std::vector<int>& columns : of_rows)
        for (const int j : columns)
            for (const int k : columns) touches[j][k] = true;
    columns_.neighbours.resize(n);
    std::vector<std::vector<bool>> taken;  // of each group, the coordinates next to its own
    for (int j = 0; j < n; ++j) {
        std::vector<int>& next_to = columns_.neighbours[j];
        for (int k = 0; k < n; ++k)
            if (touches[j][k]) next_to.push_back(k);
        const auto fits = [&](const std::vector<bool>& group) {
            return std::none_of(next_to.begin(), next_to.end(), [&](int k) { return group[k]; });
        };
        const auto found = std::find_if(taken.begin(), taken.end(), fits);
        const auto place = static_cast<std::size_t>(found - taken.begin());
        if (found == taken.end()) {
            taken.emplace_back(n, false);
            columns_.groups.emplace_back();
        }
        columns_.groups[place].push_back(j);
        for (const int k : next_to) taken[place][k] = true;
    }
    return columns_;
}

// The velocities of the bodies give the rates of closures without their rows of G.
void System::closure_errors(double t, const double* state, double* g, double* rates) {
    move_bodies(state);
    const double* const v = state + nq;
    for (const ClosureRows& closure : data_.closures) {
        if (!closure.directions.empty() || !closure.distances.empty())
            update_positions(closure, false, rates);
        if (!closure.alignments.empty()) update_alignments(closure, false, rates);
    }
    for (const JointRow& joints : data_.joint_rows) {
        update_joints(joints, state, false);
        const double* const G = filled(joints.row);
        rates[joints.row] = 0.0;
        for (const int j : joints.in_v) rates[joints.row] += G[j] * v[j];
    }
    for (const Elimination& e : data_.eliminations) {
        g_[e.row] -= e.factor * g_[e.other];
        rates[e.row] -= e.factor * rates[e.other];
    }
    update_drives(t, false);
    for (const DrivenRow& drive : data_.drives) {
        if (drive.in_v >= 0) rates[drive.row] = drive.factor * v[drive.in_v];
        rates[drive.row] -= pushed_[drive.row];
    }
    std::copy(g_.begin(), g_.end(), g);
}

std::array<double, 2> System::energies(const double* state, bool there) {
    auto& w = *work_;
    if (!there) move_bodies(state);
    double kinetic = 0.0, potential = potential_energy(data_.forces, w, state);
    for (int i = 1; i < w.model.njoints; ++i) {
        const auto& body = w.model.inertias[i];
        kinetic += 0.5 * body.vtiv(w.data.v[i]);
        potential -= body.mass() * w.model.gravity.linear().dot(w.in_world(i, body.lever()));
    }
    for (int i = 0; i < nv; ++i) kinetic += 0.5 * w.model.armature[i] * w.v[i] * w.v[i];
    return {kinetic, potential};
}

void System::closures_at(double t, const double* q, double* g, double* G, int width) {
    std::fill_n(G, static_cast<std::size_t>(data_.rows) * width, 0.0);
    write_rows(t, q, G, width);
    std::copy(g_.begin(), g_.end(), g);
}

void System::write_rows(double t, const double* q, double* G, int width) {
    auto& w = *work_;
    t = std::clamp(t, first_, last_);
    w.place(q);
    const auto copy = [&](int row, int j) { G[row * width + j] = filled(row)[j]; };
    if (!generated_rows(q, G, width)) {
        pinocchio_model::place_bodies(w);
        update_closures(q, false);
        for (const ClosureRows& closure : data_.closures)
            for (std::size_t k = 0; k < closure.count(); ++k)
                for (int j : closure.columns) copy(closure.first_row + static_cast<int>(k), j);
        for (const JointRow& joints : data_.joint_rows)
            for (int j : joints.in_v) copy(joints.row, j);
        for (const Elimination& e : data_.eliminations)
            for (int j : e.columns) copy(e.row, j);
    }
    update_drives(t, false);
    for (const DrivenRow& drive : data_.drives) {
        if (drive.in_v >= 0) copy(drive.row, drive.in_v);
        G[drive.row * width + nv] = -pushed_[drive.row];
    }
}

// g and the rows of all closures by generated code: with all other terms at rest they cost less than
// alone without it.  False without code, and where points coincide, which ends its evaluation.
bool System::generated_rows(const double* q, double* G, int width) {
    if (!code_) return false;
    const std::size_t n = nv;
    double *const M = unused_.data(), *const nle = M + n * n, *const forces = nle + n;
    double *const rest = forces + n, *const bias = rest + n;
    std::fill_n(rest, n, 0.0);
    for (int row = 0; row < data_.rows; ++row) columns_of_rows_[row] = G + row * width;
    return code_->evaluate(q, rest, law_values_.data(), nullptr, M, nle, forces, forces,
                           held_values_.data(), own_laws_.data(), g_.data(), bias,
                           columns_of_rows_.data(), bushing_bodies_.data(), work_->data.J.data());
}

}  // namespace srm
