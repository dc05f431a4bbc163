#include "forces.hpp"

#include <algorithm>
#include <cmath>

#include <pinocchio/spatial.hpp>

#include "errors.hpp"
#include "limits.hpp"
#include "workspace.hpp"

namespace srm {

namespace {

using Eigen::Vector3d;
using pinocchio::Motion;
using pinocchio::SE3;
using Vector6 = Eigen::Matrix<double, 6, 1>;

constexpr double pi = 3.14159265358979323846;

using pinocchio_model::Workspace;

// Placements in world axes are from the base of the tree of the body.
SE3 placement(const Anchor& anchor, const Workspace& work) {
    const SE3 inside = pinocchio_model::placement(anchor.placement.data());
    return anchor.joint ? work.data.oMi[anchor.joint] * inside : inside;
}

Vector3d origin(const Anchor& anchor, const Workspace& work) {
    const Eigen::Map<const Vector3d> inside(anchor.placement.data() + 9);
    return anchor.joint ? work.data.oMi[anchor.joint].act(Vector3d(inside)) : Vector3d(inside);
}

// From b to a of an element.
Vector3d between(const ForceElement& e, const Vector3d& at_a, const Vector3d& at_b,
                 const Workspace& work) {
    return work.between(e.a.joint, at_a, e.b.joint, at_b);
}

// a as b sees it.
SE3 relative_placement(const ForceElement& e, const SE3& a, const SE3& b, const Workspace& work) {
    const Eigen::Matrix3d to_b = b.rotation().transpose();
    return {to_b * a.rotation(), to_b * between(e, a.translation(), b.translation(), work)};
}

SE3 relative_placement(const ForceElement& e, const Workspace& work) {
    return relative_placement(e, placement(e.a, work), placement(e.b, work), work);
}

// Spatial velocity of the body, in world axes at the base.
Motion velocity(const Anchor& anchor, const Workspace& work) {
    return anchor.joint ? work.data.oMi[anchor.joint].act(work.data.v[anchor.joint])
                        : Motion::Zero();
}

// That of a against b, at the base of a.
Motion relative_velocity(const ForceElement& e, const Workspace& work) {
    Motion b = velocity(e.b, work);
    b.linear() += b.angular().cross(work.base_apart(e.a.joint, e.b.joint));
    return velocity(e.a, work) - b;
}

Vector3d point_velocity(const Motion& body, const Vector3d& point) {
    return body.linear() + body.angular().cross(point);
}

// What elements add to: generalised forces (nv,), and wrenches (njoints, 6) on bodies; one may be
// null.
struct Sums {
    double* tau;
    double* on_bodies;
};

// tau += (J_a - J_b)^T W for a force at `point`, from the base of a, and a moment.
void add_wrench(const ForceElement& e, const Workspace& work, const Vector3d& force,
                const Vector3d& moment, const Vector3d& point, const Sums& sums) {
    const Vector3d seen_from_b = point + work.base_apart(e.a.joint, e.b.joint);
    Vector6 on_a, on_b;
    on_a << force, moment + point.cross(force);
    on_b << force, moment + seen_from_b.cross(force);
    for (std::size_t k = 0; sums.tau && k < e.columns.size(); ++k)
        sums.tau[e.columns[k]] +=
            e.signs[k] * work.data.J.col(e.columns[k]).dot(e.signs[k] > 0.0 ? on_a : on_b);
    if (!sums.on_bodies) return;
    Eigen::Map<Vector6>(sums.on_bodies + 6 * e.a.joint) += on_a;
    if (e.kind != ForceKind::wrench)
        Eigen::Map<Vector6>(sums.on_bodies + 6 * e.b.joint) -= on_b;
}

// Stretch of a spring beyond its rest length, without force up to its slack from there.
double stretched(const ForceElement& e, double beyond) {
    return beyond - std::min(std::max(beyond, 0.0), slack(e));
}

// The points of a spring-damper, and its force on that of a.
struct SpringDamper {
    Vector3d at_a, at_b, apart, force;
    double length;

    SpringDamper(const ForceElement& e, double coincident, const Workspace& work)
        : at_a(origin(e.a, work)),
          at_b(origin(e.b, work)),
          apart(between(e, at_a, at_b, work)),
          force(-e.stiffness * apart),
          length(apart.norm()) {
        if (length < coincident * e.rest) throw EvaluationError{Failure::coincident};
        // k (l - l0) apart/l, without dividing where l = l0 = 0.
        if (slack(e) != 0.0)
            force *= stretched(e, length - e.rest) / (length != 0.0 ? length : 1.0);
        else if (e.rest != 0.0)
            force *= 1.0 - e.rest / length;
    }

    // Of the point of a against that of b.
    Vector3d rate(const ForceElement& e, const Workspace& work) const {
        return point_velocity(velocity(e.a, work), at_a) -
               point_velocity(velocity(e.b, work), at_b);
    }

    void damp(const ForceElement& e, const Vector3d& rate) {
        // Points that meet move along the line that joins them.
        const Vector3d along =
            length != 0.0 ? Vector3d(apart * ((apart / length).dot(rate) / length)) : rate;
        force -= e.damping * along;
    }
};

void spring_damper(const ForceElement& e, double coincident, const Workspace& work,
                   const Sums& sums, ForceLaws* laws, int law) {
    SpringDamper found(e, coincident, work);
    if (e.damping != 0.0) found.damp(e, found.rate(e, work));
    if (laws && law >= 0) {
        const Vector3d line = found.apart / (found.length != 0.0 ? found.length : 1.0);
        const double own = found.force.dot(line), acting = laws->acting(law, own);
        if (acting != own) found.force = acting * line;
    }
    add_wrench(e, work, found.force, Vector3d::Zero(), found.at_a, sums);
}

// Number k of an element whose numbers may follow laws.
double over_time(const ForceElement& e, std::size_t k, double t) {
    if (e.curves.empty()) return e.numbers[k];
    double s[3];
    e.curves[e.curves.size() == 1 ? 0 : k].at(t, s);
    return e.numbers[k] * s[0];
}

// The force on its coordinate.
double torsion_spring(const ForceElement& e, double position, double rate) {
    return -(e.stiffness * (position - e.rest) + e.damping * rate);
}

double beyond_limits(const ForceElement& e, double position) {
    return std::max(position - e.numbers[1], 0.0) + std::min(position - e.numbers[0], 0.0);
}

double limit_spring(const ForceElement& e, double position, double rate) {
    const double beyond = beyond_limits(e, position), depth = e.numbers[2];
    if (beyond == 0.0) return 0.0;
    const double x = std::min(std::abs(beyond) / depth, 1.0);
    const double contact = x * x * x * (10.0 + x * (6.0 * x - 15.0));
    return -(contact * (e.stiffness * beyond + e.damping * rate));
}

// The force on a sum of coordinates.
void coupling_spring(const ForceElement& e, const double* q, const double* v, double* tau,
                     ForceLaws* laws, int law) {
    double sum = 0.0, rate = 0.0;
    for (std::size_t k = 0; k < e.columns.size(); ++k) {
        sum += e.signs[k] * q[e.positions[k]];
        rate += e.signs[k] * v[e.columns[k]];
    }
    double force = -(e.stiffness * stretched(e, sum - e.rest) + e.damping * rate);
    if (friction(e) != 0.0) force -= friction(e) * std::tanh(rate / e.numbers[2]);
    if (laws) force = laws->acting(law, force);
    for (std::size_t k = 0; k < e.columns.size(); ++k) tau[e.columns[k]] += e.signs[k] * force;
}

void wrench(const ForceElement& e, double t, const Workspace& work, const Sums& sums) {
    const SE3 at = placement(e.a, work);
    Vector3d force(over_time(e, 0, t), over_time(e, 1, t), over_time(e, 2, t));
    Vector3d moment(over_time(e, 3, t), over_time(e, 4, t), over_time(e, 5, t));
    if (e.in_link_axes) {
        force = at.rotation() * force;
        moment = at.rotation() * moment;
    }
    add_wrench(e, work, force, moment, at.translation(), sums);
}

// The rotation vector of the same rotation about the opposite axis.
Vector3d other_way(const Vector3d& turn) {
    const double angle = turn.norm();
    return angle == 0.0 ? turn : Vector3d(turn * (1.0 - 2.0 * pi / angle));
}

// Rotation vector of a's axes relative to b's, up to half a turn.
Vector3d rotation_vector(const ForceElement& e, const Workspace& work) {
    return pinocchio::log3(relative_placement(e, work).rotation());
}

void bushing(const ForceElement& e, const Workspace& work, BushingStep* step,
             const Sums& sums, ForceLaws* laws, std::size_t number) {
    const SE3 Ta = placement(e.a, work), Tb = placement(e.b, work);
    const SE3 relative = relative_placement(e, Ta, Tb, work);
    Vector3d turn = pinocchio::log3(relative.rotation());
    // dphi/dt is Jlog3 w for w in a's axes, and L^T w in b's: Jlog3 R^T = Jlog3^T.
    Eigen::Matrix3d L;
    if (step && step->nearest(turn.data()))
        pinocchio::Jlog3(turn.norm(), turn, L);
    else
        pinocchio::Jlog3(relative.rotation(), L);
    const Eigen::Map<const Vector3d> k_shift(&e.numbers[0]), k_turn(&e.numbers[3]);
    Vector3d force = k_shift.cwiseProduct(relative.translation());
    Vector3d moment = k_turn.cwiseProduct(turn);
    const Eigen::Map<const Vector3d> d_shift(&e.numbers[6]), d_turn(&e.numbers[9]);
    if (!d_shift.isZero(0.0) || !d_turn.isZero(0.0)) {
        // b's axes and origin move along: what is left is the motion seen from b.
        const Motion W = relative_velocity(e, work);
        const Vector3d rate =
            Tb.rotation().transpose() * point_velocity(W, Ta.translation());
        const Vector3d spin = L.transpose() * (Tb.rotation().transpose() * W.angular());
        force += d_shift.cwiseProduct(rate);
        moment += d_turn.cwiseProduct(spin);
    }
    for (int i = 0; laws && i < 6; ++i) {
        double& value = i < 3 ? force[i] : moment[i - 3];
        const int law = laws->of_element(number, i);
        if (law >= 0) value = laws->acting(law, value);
    }
    const Vector3d world_force = Tb.rotation() * force;
    const Vector3d world_moment = Tb.rotation() * (L * moment);
    add_wrench(e, work, -world_force, -world_moment, Ta.translation(), sums);
}

// The integral of k d S(d / depth).
double limit_spring_energy(const ForceElement& e, double position) {
    const double beyond = std::abs(beyond_limits(e, position)), depth = e.numbers[2];
    const double x = std::min(beyond / depth, 1.0);
    const double inside =
        depth * depth * std::pow(x, 5) * (2.0 + x * (6.0 / 7.0 * x - 2.5));
    return e.stiffness * (inside + 0.5 * std::max(beyond * beyond - depth * depth, 0.0));
}

double bushing_energy(const ForceElement& e, const Workspace& work) {
    const SE3 relative = relative_placement(e, work);
    const Vector3d shift = relative.translation(), turn = pinocchio::log3(relative.rotation());
    double out = 0.0;
    for (int i = 0; i < 3; ++i)
        out += e.numbers[i] * shift[i] * shift[i] + e.numbers[3 + i] * turn[i] * turn[i];
    return 0.5 * out;
}

double coupling_stretch(const ForceElement& e, const double* q) {
    double out = -e.rest;
    for (std::size_t k = 0; k < e.columns.size(); ++k) out += e.signs[k] * q[e.positions[k]];
    return out;
}

double linear_energy(double stiffness, double stretch) {
    return 0.5 * stiffness * stretch * stretch;
}

double energy(const ForceElement& e, const Workspace& work, const double* q) {
    switch (e.kind) {
        case ForceKind::spring_damper:
            return linear_energy(
                e.stiffness,
                stretched(e, between(e, origin(e.a, work), origin(e.b, work), work).norm() -
                                 e.rest));
        case ForceKind::torsion_spring:
            return linear_energy(e.stiffness, q[e.in_q] - e.rest);
        case ForceKind::bushing:
            return bushing_energy(e, work);
        case ForceKind::limit_spring:
            return limit_spring_energy(e, q[e.in_q]);
        case ForceKind::coupling_spring:
            return linear_energy(e.stiffness, stretched(e, coupling_stretch(e, q)));
        case ForceKind::joint_torque:
        case ForceKind::wrench:
            break;
    }
    return 0.0;
}

}  // namespace

void ForceElement::check() const {
    expect_within("kind", static_cast<int>(kind), 0, static_cast<int>(last_force_kind));
    expect_size("signs", signs.size(), columns.size());
    if (kind == ForceKind::wrench) expect_size("numbers", numbers.size(), 6);
    if (kind == ForceKind::bushing) expect_size("numbers", numbers.size(), 12);
    if (kind == ForceKind::limit_spring) expect_size("numbers", numbers.size(), 3);
    if (kind == ForceKind::coupling_spring) {
        expect_size("positions", positions.size(), columns.size());
        if (!numbers.empty()) expect_size("numbers", numbers.size(), 3);
    }
    if (kind == ForceKind::spring_damper && !numbers.empty())
        expect_size("numbers", numbers.size(), 1);
    if (curves.size() > 1) expect_size("curves", curves.size(), numbers.size());
}

void check_indices(const ForceElement& e, long nq, long nv, long joints) {
    for (const Anchor* anchor : {&e.a, &e.b})
        expect_within("Anchor.joint", anchor->joint, 0, joints - 1);
    expect_within("ForceElement.columns", e.columns, 0, nv - 1);
    expect_within("ForceElement.positions", e.positions, 0, nq - 1);
    const bool torque = e.kind == ForceKind::joint_torque;
    const bool on_joint =
        torque || e.kind == ForceKind::torsion_spring || e.kind == ForceKind::limit_spring;
    if (!on_joint) return;
    expect_within("ForceElement.in_v", e.in_v, 0,
                  nv - (torque ? static_cast<long>(e.numbers.size()) : 1));
    if (!torque) expect_within("ForceElement.in_q", e.in_q, 0, nq - 1);
}

bool acts_on_several(const ForceElement& e) {
    return e.kind == ForceKind::spring_damper || e.kind == ForceKind::wrench ||
           e.kind == ForceKind::bushing || e.kind == ForceKind::coupling_spring;
}

double slack(const ForceElement& e) { return e.numbers.empty() ? 0.0 : e.numbers[0]; }

double friction(const ForceElement& e) { return e.numbers.empty() ? 0.0 : e.numbers[1]; }

double FrictionSum::of(const double* v) const {
    double out = 0.0;
    for (std::size_t k = 0; k < columns.size(); ++k) out += coefficients[k] * v[columns[k]];
    return out;
}

bool turns(const ForceElement& e) {
    if (e.kind != ForceKind::bushing) return false;
    const auto acts = [&](int first) {
        return std::any_of(&e.numbers[first], &e.numbers[first] + 3,
                           [](double x) { return x != 0.0; });
    };
    return acts(3) || acts(9);
}

BushingStep::BushingStep(const ForceElement& element, const std::vector<double>& limits,
                         const Workspace& work, double t)
    : element_(&element), rounding_(limits[0]), located_(limits[1]) {
    Vector3d turn = rotation_vector(element, work);
    // At half a turn, the one that gets smaller; a step that ends there measured the same, but for
    // rounding.
    if (past_half_turn(work, t, turn.data(), 2.0) == 0.0) turn = other_way(turn);
    Eigen::Map<Vector3d>(start_.data()) = turn;
}

bool BushingStep::nearest(double* turn) {
    Eigen::Map<Vector3d> here(turn);
    const Eigen::Map<const Vector3d> start(start_.data());
    const Vector3d other = other_way(here);
    if (!((other - start).squaredNorm() < (here - start).squaredNorm())) return false;
    passed_ |= other.norm() > pi + located_;
    here = other;
    return true;
}

double BushingStep::past_half_turn(const Workspace& work, double t) {
    const bool passed = passed_;
    Vector3d turn = rotation_vector(*element_, work);
    nearest(turn.data());
    const double late = past_half_turn(work, t, turn.data(), 1.0);
    return passed && late == -infinity ? infinity : late;
}

// By the rate of the angle; 0 within so many `roundings`.
double BushingStep::past_half_turn(const Workspace& work, double t,
                                   const double* vector, double roundings) const {
    const Eigen::Map<const Vector3d> turn(vector);
    const double angle = turn.norm();
    if (angle < 0.5 * pi) return -infinity;
    const Vector3d spin =
        velocity(element_->a, work).angular() - velocity(element_->b, work).angular();
    const double beyond = angle - pi;
    const double speed =
        turn.dot(placement(element_->b, work).rotation().transpose() * spin) / angle;
    if (!(speed > 0.0)) return std::copysign(infinity, beyond - rounding_);
    const double spacing = std::nextafter(std::abs(t), infinity) - std::abs(t);
    const double slack = roundings * (rounding_ + speed * 4.0 * spacing);
    return std::abs(beyond) <= slack ? 0.0 : beyond / speed;
}

void ForceLaws::resolve(const std::vector<ForceElement>& elements,
                        const std::vector<bool>& passive) {
    int count = 0;
    of_coordinate_.assign(passive.size(), -1);
    of_element_.assign(6 * elements.size(), -1);
    std::vector<bool> acted(passive);
    for (const ForceElement& e : elements)
        if (e.kind == ForceKind::torsion_spring || e.kind == ForceKind::limit_spring)
            acted[e.in_v] = true;
    for (std::size_t i = 0; i < acted.size(); ++i)
        if (acted[i]) of_coordinate_[i] = count++;
    first_of_elements_ = count;
    for (std::size_t k = 0; k < elements.size(); ++k) {
        const ForceElement& e = elements[k];
        if ((e.kind == ForceKind::spring_damper && (e.rest > 0.0 || slack(e) > 0.0)) ||
            e.kind == ForceKind::coupling_spring)
            of_element_[6 * k] = count++;
        for (int i = 0; e.kind == ForceKind::bushing && i < 6; ++i)
            if (e.numbers[i] > 0.0 || e.numbers[6 + i] > 0.0) of_element_[6 * k + i] = count++;
    }
    values.assign(count, 0.0);
    applied = nullptr;
}

void add_forces(const std::vector<ForceElement>& elements, double coincident,
                const Workspace& work, double t, const double* q,
                const double* v, std::vector<BushingStep>& step, double* tau, ForceLaws* laws,
                double* on_bodies) {
    auto next = step.begin();
    const Sums sums{tau, on_bodies};
    const auto on_joint = [&](const ForceElement& e, double force) {
        if (laws) laws->values[laws->of_coordinate(e.in_v)] += force;
        if (!laws || !laws->applied) tau[e.in_v] += force;
    };
    for (std::size_t number = 0; number < elements.size(); ++number) {
        const ForceElement& e = elements[number];
        switch (e.kind) {
            case ForceKind::spring_damper:
                spring_damper(e, coincident, work, sums, laws,
                              laws ? laws->of_element(number, 0) : -1);
                break;
            case ForceKind::joint_torque:
                for (std::size_t k = 0; k < e.numbers.size(); ++k)
                    tau[e.in_v + static_cast<int>(k)] += over_time(e, k, t);
                break;
            case ForceKind::torsion_spring:
                on_joint(e, torsion_spring(e, q[e.in_q], v[e.in_v]));
                break;
            case ForceKind::wrench:
                wrench(e, t, work, sums);
                break;
            case ForceKind::bushing:
                bushing(e, work, turns(e) && next != step.end() ? &*next++ : nullptr, sums,
                        laws, number);
                break;
            case ForceKind::limit_spring:
                on_joint(e, limit_spring(e, q[e.in_q], v[e.in_v]));
                break;
            case ForceKind::coupling_spring:
                coupling_spring(e, q, v, tau, laws, laws ? laws->of_element(number, 0) : -1);
                break;
        }
    }
}

void add_bushings(const std::vector<ForceElement>& elements,
                  const Workspace& work, std::vector<BushingStep>& step,
                  double* tau, ForceLaws* laws) {
    auto next = step.begin();
    for (std::size_t number = 0; number < elements.size(); ++number) {
        const ForceElement& e = elements[number];
        if (e.kind == ForceKind::bushing)
            bushing(e, work, turns(e) && next != step.end() ? &*next++ : nullptr,
                    Sums{tau, nullptr}, laws, number);
    }
}

namespace {

// c = (1 - (x / 2) cot(x / 2)) / x^2 and its derivative by x^2, at x^2 = square.
std::array<double, 2> log_coefficient(double square) {
    if (square < 1e-2) {  // the series in the Bernoulli numbers: the next term is 1e-16 of the first
        constexpr double terms[] = {1.0 / 12.0, 1.0 / 720.0, 1.0 / 30240.0, 1.0 / 1209600.0,
                                    1.0 / 47900160.0, 691.0 / 1307674368000.0};
        double value = 0.0, slope = 0.0;
        for (int i = 5; i >= 0; --i) {
            slope = slope * square + value;
            value = value * square + terms[i];
        }
        return {value, slope};
    }
    const double half = 0.5 * std::sqrt(square), s = std::sin(half), along = half / std::tan(half);
    const double value = (1.0 - along) / square;
    // d along / d square = (along / square - 1 / (4 s^2)) / 2
    return {value, -value / square - 0.5 * (along / square - 0.25 / (s * s)) / square};
}

}  // namespace

void bushing_turns(const std::vector<ForceElement>& elements,
                   const Workspace& work, std::vector<BushingStep>& step,
                   double* out) {
    auto next = step.begin();
    for (const ForceElement& e : elements) {
        if (e.kind != ForceKind::bushing) continue;
        Vector3d turn = rotation_vector(e, work);
        if (turns(e) && next != step.end()) (next++)->nearest(turn.data());
        std::copy_n(turn.data(), 3, out);
        const auto coefficient = log_coefficient(turn.squaredNorm());
        std::copy_n(coefficient.data(), 2, out + 3);
        out += 5;
    }
}

double spring_damper_power(const ForceElement& e, double coincident,
                           const Workspace& work) {
    if (e.stiffness == 0.0) {  // a damper alone: its force is along the line that joins the points
        const pinocchio::Data& data = work.data;
        const Vector3d apart = between(e, origin(e.a, work), origin(e.b, work), work);
        const double square = apart.squaredNorm(), closest = coincident * e.rest;
        if (square < closest * closest) throw EvaluationError{Failure::coincident};
        Vector3d rate = Vector3d::Zero();
        const auto add_rate = [&](const Anchor& anchor, double sign) {  // in axes of the body
            if (!anchor.joint) return;
            const Eigen::Map<const Vector3d> inside(anchor.placement.data() + 9);
            const Vector3d own = point_velocity(data.v[anchor.joint], inside);
            rate += sign * (data.oMi[anchor.joint].rotation() * own);
        };
        add_rate(e.a, 1.0);
        add_rate(e.b, -1.0);
        const double along = apart.dot(rate);
        return -e.damping * (square != 0.0 ? along * along / square : rate.squaredNorm());
    }
    SpringDamper found(e, coincident, work);
    const Vector3d rate = found.rate(e, work);
    if (e.damping != 0.0) found.damp(e, rate);
    return found.force.dot(rate);
}

double potential_energy(const std::vector<ForceElement>& elements,
                        const Workspace& work, const double* q) {
    double out = 0.0;
    for (const ForceElement& e : elements) out += energy(e, work, q);
    return out;
}

}  // namespace srm
