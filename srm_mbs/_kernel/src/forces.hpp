// Generalised forces of the force elements: dynamics/forces.py.
#pragma once

#include <array>
#include <vector>

#include "curve.hpp"
#include "struct_fields.hpp"

namespace pinocchio_model {
struct Workspace;
}

namespace srm {

// Numbered as by the `constants` of the elements in Python.
enum class ForceKind {
    spring_damper,
    joint_torque,
    torsion_spring,
    wrench,
    bushing,
    limit_spring,
    coupling_spring,
};
inline constexpr ForceKind last_force_kind = ForceKind::coupling_spring;

using Placement = std::array<double, 12>;  // rotation row by row, translation

#define SRM_ANCHOR(field)                                   \
    field(int, joint)                                       \
    field(Placement, placement) /* in the axes of the joint */

// A frame on a body.
struct Anchor {
    SRM_FIELDS(SRM_ANCHOR)
};

#define SRM_FORCE_ELEMENT(field)                                                           \
    field(ForceKind, kind)                                                                 \
    field(Anchor, a)                 /* the only anchor of a wrench */                     \
    field(Anchor, b)                                                                       \
    field(std::vector<int>, columns) /* velocity components that move a against b, */      \
    field(std::vector<double>, signs) /* +1 where they move a, -1 where b; or coefficients */ \
    field(std::vector<int>, positions) /* of a coupling spring: indices in q of the columns */ \
    field(double, stiffness)                                                               \
    field(double, damping)                                                                 \
    field(double, rest)              /* length, angle or sum */                                 \
    field(int, in_q)                 /* first index of the joint in q, and in v */         \
    field(int, in_v)                                                                       \
    field(bool, in_link_axes)        /* of a wrench: else world axes */                    \
    /* Torque; force and moment; stiffness (6) and damping (6); lower and upper limit, depth; of   \
       springs nothing, or slack, of a coupling spring with friction and its speed. */         \
    field(std::vector<double>, numbers)                                                    \
    field(std::vector<Curve>, curves) /* laws of the numbers: none, one for all or one for each */

// One element; the fields that count depend on its kind, the others are zero or empty.
struct ForceElement {
    SRM_FIELDS(SRM_FORCE_ELEMENT)

    void check() const;
};

// Throws std::invalid_argument for coordinates and joints that a model with so many does not have.
void check_indices(const ForceElement& element, long nq, long nv, long joints);

// Whether an element acts at points of links or on several joints, not on the coordinate of one.
bool acts_on_several(const ForceElement& element);

// Slack and friction of a spring.
double slack(const ForceElement& element);
double friction(const ForceElement& element);

// A rate on which friction acts: a sum of velocity components, which are of joints or of a coupling
// spring.
struct FrictionSum {
    std::vector<int> columns;
    std::vector<double> coefficients;

    double of(const double* v) const;
};

// Whether an element is a bushing that has a moment.
bool turns(const ForceElement& element);

// The rotation vector of a bushing over a step: BushingStep in dynamics/forces.py.
class BushingStep {
public:
    // The workspace holds placements and velocities at the start, t; `limits` as in SystemData.
    BushingStep(const ForceElement& element, const std::vector<double>& limits,
                const pinocchio_model::Workspace& work, double t);

    // Replaces a rotation vector by that of the opposite axis, if that is closer to the start;
    // whether it is.
    bool nearest(double* turn);
    double past_half_turn(const pinocchio_model::Workspace& work, double t);

private:
    double past_half_turn(const pinocchio_model::Workspace& work, double t, const double* turn,
                          double roundings) const;

    const ForceElement* element_;
    double rounding_, located_;
    std::array<double, 3> start_;
    bool passed_ = false;
};

// The laws of forces that damp or store energy: one for the coordinate of a joint, and those of the
// elements between bodies, each along a direction of its own.
class ForceLaws {
public:
    // `passive` (nv,): whether damping or friction acts on a coordinate.
    void resolve(const std::vector<ForceElement>& elements, const std::vector<bool>& passive);
    int count() const { return static_cast<int>(values.size()); }
    // Makes them one law: the forces along the coordinates (nv,) of all of them.
    void join(int nv) { values.assign(nv, 0.0); }
    // The value that acts as number `law`, which is `value` by itself.
    double acting(int law, double value) {
        values[law] = value;
        return applied ? applied[law] : value;
    }
    // Number of the law of a coordinate, or -1; first one of an element, with the numbers (6) of
    // those of a bushing.
    int of_coordinate(int i) const { return of_coordinate_[i]; }
    // Number of the first law of an element between links.
    int first_of_elements() const { return first_of_elements_; }
    int of_element(std::size_t e, int component) const { return of_element_[6 * e + component]; }

    std::vector<double> values;       // at the evaluation made last
    const double* applied = nullptr;  // in their place; null: themselves

private:
    std::vector<int> of_coordinate_, of_element_;
    int first_of_elements_ = 0;
};

// Adds the generalised forces at t, q, v to tau (nv,).  The workspace holds the placements, the
// velocities and the world Jacobian there.  With `laws`, their values are found, and of the forces
// along coordinates the rest is added only if none are applied.  `step`: the bushings that have a
// moment in the step of the stage, in their order, or none.  The wrenches of elements between links,
// about the bases of their trees, are also added to `on_bodies` (njoints, 6) unless it is null; they
// need no tau.  Throws EvaluationError.
void add_forces(const std::vector<ForceElement>& elements, double coincident,
                const pinocchio_model::Workspace& work, double t, const double* q,
                const double* v, std::vector<BushingStep>& step, double* tau, ForceLaws* laws,
                double* on_bodies = nullptr);
// The same of the bushings alone.
void add_bushings(const std::vector<ForceElement>& elements,
                  const pinocchio_model::Workspace& work, std::vector<BushingStep>& step,
                  double* tau, ForceLaws* laws);
// Of each bushing its rotation vector phi, c of Jlog(phi) = 1 + [phi] / 2 + c [phi]^2, and the
// derivative of c by |phi|^2 (5 per bushing); the workspace holds the placements.
void bushing_turns(const std::vector<ForceElement>& elements,
                   const pinocchio_model::Workspace& work, std::vector<BushingStep>& step,
                   double* out);

// Power (W) of a spring-damper at the placements and velocities that the workspace holds.  Throws
// EvaluationError.
double spring_damper_power(const ForceElement& element, double coincident,
                           const pinocchio_model::Workspace& work);

// Potential energy (J) of those that have one; the workspace holds the placements.
double potential_energy(const std::vector<ForceElement>& elements,
                        const pinocchio_model::Workspace& work, const double* q);

}  // namespace srm
