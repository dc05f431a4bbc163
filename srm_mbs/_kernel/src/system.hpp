// A mechanism as a system: dynamics/multibody.py and dynamics/constraints/rows.py.
//
//     q' = v,   M(q) v' = f(q, v, t) - G^T lam,   g(q) = s(t),
//
// s the motion of the drives, 0 in the rows of the closures.
//
// A state is (q, v), a tangent (dq, dv).  The system answers for the terms of the stage that it
// evaluated last.
#pragma once

#include <array>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "charts.hpp"
#include "curve.hpp"
#include "forces.hpp"
#include "generated.hpp"
#include "generated_projection.hpp"
#include "history.hpp"
#include "limits.hpp"
#include "projection.hpp"
#include "struct_fields.hpp"
#include "vectors.hpp"

namespace srm {

using Point = std::array<double, 3>;

#define SRM_CLOSURE_ROWS(field)                                                              \
    field(int, joint_a)                                                                      \
    field(int, joint_b)                                                                      \
    field(int, first_row)                                                                    \
    field(Point, at_a)                     /* origin of the anchor, in the axes of joint a */ \
    field(Point, at_b)                                                                       \
    /* The rows: k along directions, l distances, m alignments; in the axes of the joints. */ \
    field(std::vector<double>, directions) /* (k, 3) */                                      \
    field(std::vector<double>, distances)  /* (l, 2): length, factor of the row */           \
    field(std::vector<double>, alignments) /* (m, 6): u in a, n in b */                      \
    field(std::vector<int>, columns)       /* velocity components that move a against b, */  \
    field(std::vector<double>, signs)      /* +1 where they move a, -1 where b */

// Kept, scaled rows of one closure.
struct ClosureRows {
    SRM_FIELDS(SRM_CLOSURE_ROWS)

    std::size_t count() const {
        return directions.size() / 3 + distances.size() / 2 + alignments.size() / 6;
    }
    void check() const;
};

#define SRM_JOINT_ROW(field)                 \
    field(int, row)                          \
    field(std::vector<double>, coefficients) \
    field(std::vector<int>, in_q)            \
    field(std::vector<int>, in_v)            \
    field(double, offset)                    \
    field(std::vector<double>, arguments)    \
    field(std::vector<double>, powers)

// A kept, scaled row of joint coordinates: sum c_i q_i - offset - sum a_k y^k, y = sum b_i q_i,
// with a_2, a_3, ... the powers; a linear row has neither arguments b_i nor powers.
struct JointRow {
    SRM_FIELDS(SRM_JOINT_ROW)

    void check() const;
};

#define SRM_ELIMINATION(field) \
    field(int, row)            \
    field(int, other)          \
    field(double, factor)      \
    field(std::vector<int>, columns)

// The row `row` minus factor times the row `other`, in these columns of G.
struct Elimination {
    SRM_FIELDS(SRM_ELIMINATION)
};

#define SRM_DRIVEN_ROW(field)                                     \
    field(int, row)                                               \
    field(double, factor) /* the inverse of the row scale */      \
    field(int, in_q)      /* of a joint coordinate, else -1 */    \
    field(int, in_v)                                              \
    field(bool, wraps)    /* a joint that stores (cos, sin) */    \
    field(Curve, curve)

// A driven row: that of a closure, or of a joint coordinate.
struct DrivenRow {
    SRM_FIELDS(SRM_DRIVEN_ROW)
};

// (t, q, v) -> generalised forces (nv,), added to tau.
using Controller = std::function<void(double, const double*, const double*, double*)>;

#define SRM_SYSTEM_DATA(field)                                                                   \
    field(std::vector<ClosureRows>, closures)                                                    \
    field(std::vector<JointRow>, joint_rows)                                                     \
    field(std::vector<Elimination>, eliminations)                                                \
    field(std::vector<DrivenRow>, drives)       /* in the order of their rows, the last ones */  \
    field(int, rows)                                                                             \
    field(int, structural_rank)                                                                  \
    field(double, sigma_ref)                                                                     \
    field(std::string, algebra)                 /* "auto", "dense" or "sparse" */                \
    field(std::vector<int>, order)              /* of the rows along the graph, or empty */      \
    field(double, pivot_share)                                                                   \
    field(int, pivot_window)                                                                     \
    field(std::vector<double>, residual_scale)  /* (rows,) */                                    \
    field(std::vector<double>, unit)            /* (nv,) */                                      \
    field(std::vector<int>, position_of)        /* (nv,), index in q; -1 on groups */            \
    field(std::vector<double>, damping)         /* (nv,) or empty */                             \
    field(std::vector<double>, friction)        /* (nv,) or empty */                             \
    field(double, friction_speed)                                                                \
    field(std::vector<ForceElement>, forces)                                                     \
    field(double, coincident)                   /* relative distance of points that count as one */ \
    /* Distance of a bushing from half a turn (rad) that is rounding, and that is located. */    \
    field(std::vector<double>, half_turn)                                                        \
    field(std::vector<GroupJoint>, groups)                                                       \
    field(std::vector<double>, series)          /* of dexp^-1 */                                 \
    field(std::vector<int>, wrapped_angles)     /* velocity indices of (cos, sin) joints */      \
    field(double, largest_rotation)             /* of a chart (rad) */                           \
    field(double, farthest_node)                /* rotation (rad) between nodes, at most */      \
    field(double, rotation_per_step)            /* (rad), at most */

struct SystemData {
    SRM_FIELDS(SRM_SYSTEM_DATA)

    void check() const;
};

// Coordinates of the closures, time the last one with drives.
struct ColumnGroups {
    std::vector<std::vector<int>> neighbours;  // of each, those with which it has a row in common
    std::vector<std::vector<int>> groups;      // of coordinates without a common neighbour
};

enum class RowKind { along, turning, of_joints };

// The least radius of gyration of a body, over the largest distance of its joints, anchors and centre
// of mass from its origin, and the largest over the diagonal of the scene.  0 and infinite where a
// body has moments of inertia and no mass.
struct Gyrations {
    double least, largest;
};

// Rows of one closure and one kind.
struct RowBlock {
    int first, count;
    RowKind kind;
    double unit;
};

// Force elements whose powers are separate, each a list of its own.
struct SeparateElements {
    std::vector<std::vector<ForceElement>> each;
    std::vector<std::vector<int>> acted_on;  // velocity indices; none if it acts on bodies
    // The joints that move the bodies on which they act, ascending, and the velocity indices of all
    // coordinates on which their powers depend.
    std::vector<int> joints, coordinates;
};

// Steps with rates, and those stages of each that are asked for.
struct StageArrays {
    const double *times, *states;      // ends of the steps: (n + 1,), (n + 1, nx)
    const double* rates;               // (n, width, 2 nv)
    const double *A, *c;               // (stages, rows), (stages,)
    std::size_t width, rows, stages;
};

class System {
public:
    System(const void* model, SystemData data, Controller controller);
    ~System();

    // The zone of a stage: Zone in dynamics/system.py.  threshold < 0: none.
    struct ZoneView {
        double threshold = -1.0;
        const MultiplierHistory* history = nullptr;
        bool predicts = true;  // false: hold the normals of the last node
    };

    void evaluate(double t, const double* state, const ZoneView& zone);
    // The pass over the tree that an evaluation begins with, alone: to measure it.
    void tree_terms(const double* state);
    // From now on evaluations take their terms from generated code, which outlives its use; null:
    // from the pass over the tree.
    void use_code(const GeneratedTerms* code);
    // Evaluates at times within [first, last] only: on one side of a breakpoint.
    void between(double first, double last) {
        first_ = first;
        last_ = last;
        end_step();
    }
    // Forces that jump somewhere go on smoothly in a step from a state at t up to its end.
    void begin_step(double t, const double* state);
    void end_step() { bushings_.clear(); }
    // Time by which a step to a state at t passed a jump: past_jump in dynamics/system.py.
    double past_jump(double t, const double* state);
    // From t on a constant force (nv,) acts in addition to all others.  With `keep` the forces held
    // before still act at earlier times.
    void hold(double t, const double* force, bool keep);
    // Takes the numbers of another model with the same bodies and joints, and the origins of the
    // anchors a and b of each closure in the axes of their joints.
    void move(const void* model, const std::vector<Point>& origins);
    // Resets the system for a run from another start, on which these values depend.
    void renew(std::vector<double> unit, std::vector<double> residual_scale,
               std::vector<double> damping, std::vector<double> friction, double friction_speed);
    // Resets the system for another run from a start that these do not depend on.
    void restart();
    // Whether `force` (nv,) is the force held last.
    bool holds(const double* force) const;

    // Terms of the stage evaluated last.
    bool constrained() const { return closed_; }
    // Whether sigma jumps when other pivots are taken.
    bool sigma_scatters() const { return !data_.order.empty(); }
    bool sparse() const { return closed_ && projection_->sparse(); }
    double sigma() const;
    int rank() const;
    bool rank_deficient() const;
    bool held() const;
    void rate(double* out);              // (2 nv,)
    void multiplier(double* out);        // (nv,)
    void correction(double* out);        // (2 nv,)
    double closure_residual() const;     // the largest, in row units
    void free_acceleration(double* out);                      // M^-1 f (nv,)
    void normal_part(const double* w, double* out) const;     // P w (nv,)
    void multiplier_of(const double* a, double* out);         // E (G a + Gdot v - s'') (nv,)
    // E g (nv,), without `allowed` of the rows of the drives, and g - s of these.
    void closing(const std::vector<double>& allowed, double* out);
    // With the terms of the stage lost: changes (nv,) of the velocities at q by an impulse n (nv,),
    // M^-1 n without the closures and (1 - P) M^-1 n with their impulses.
    void impulse_response(const double* q, const double* n, double* along, double* free);
    void driven_residuals(std::vector<double>& out) const;
    // M-orthonormal velocities (k, nv) that satisfy the closures, whatever the drives; their number.
    // `rates` (k, drives), if asked for: those of the drives along them.
    int branch_tangents(std::vector<double>& out, std::vector<double>* rates = nullptr) const;
    // M-orthonormal normals (k, nv) of the weakest rows in use; empty with drives.
    void normals(std::vector<double>& out) const;

    // The manifold.
    void retract(const double* state, const double* delta, double* out);
    // The same of the velocity coordinates `moving` alone, all of each joint; others may move by 0.
    void retract_some(const double* state, const double* delta, const std::vector<int>& moving,
                      double* out);
    // Whether joints have angles of which only cosine and sine are known.
    bool wraps() const { return !data_.wrapped_angles.empty(); }
    // Such angles take the turn nearest to the motion near (nv,), which others do not need.
    void difference(const double* start, const double* end, const double* near, double* out);
    bool reachable(const double* start, const double* end) const;
    void chart_rate(const double* delta, const double* rate, double* out) const;
    // Motions in the coordinates of states (nx,), which need no chart: their rates, from the tangent
    // rates (2 nv,) at a state; errors `allowed` (2 nv,) of motions and rates; and coordinates that
    // were interpolated, moved back onto the manifold.
    void coordinate_rates(const double* state, const double* rate, double* out) const;
    void coordinate_errors(const double* allowed, double* out) const;
    void normalise(double* state) const;
    double position_norm(const double* positions) const;  // largest of dq (nv,), in units
    void state_scale(const double* state, double* out) const;
    double step_limit(const double* state) const;
    // The largest residual of all rows at a state, in row units.
    double closure_residual_at(double t, const double* state);

    // All rows at q and t, without velocities: g (rows,), and by rows G (rows, width) with the
    // derivative by t, where drives are, as its last column.
    void closures_at(double t, const double* q, double* g, double* G, int width);
    // The entries of these rows that may differ from zero, into G.
    void write_rows(double t, const double* q, double* G, int width);
    // The same rows, without those of drives, of a system without algebra of its own, and M (nv, nv)
    // and the Jacobian J (6, nv) of the joints in the world, column by column (manifold.cpp).
    void rows_and_mass(const double* q, double* G);
    const double* mass_matrix() const;
    std::vector<double> world_jacobian() const;
    // Where the placements were evaluated last, the diagonal of the bounding box of joints, centres of
    // mass and anchors; 0 if it is `rounding` over the distance or the gyration (regular_start.cpp).
    double scene_diagonal(double rounding) const;
    // The least inertia that a joint moves at q, over the composite inertia: a pivot of M with a unit
    // diagonal, tips first; 0 if M is not positive definite.
    double least_inertia(const double* q);
    Gyrations gyrations(double diagonal) const;
    // The rows that have a usual norm in common, with their units for those of length and of the
    // coordinates (nv,).
    void row_blocks(double length, const double* unit, std::vector<RowBlock>& out) const;
    // The coordinates that their differences may move together.
    const ColumnGroups& column_groups();
    int rows() const { return data_.rows; }
    // With all terms of other states lost, up to stage_powers(): g - s and G v - s' (rows,).
    void closure_errors(double t, const double* state, double* g, double* rates);
    // The kinetic and the potential energy, of gravity and of springs.  there: whether the bodies are
    // at this state already, from closure_errors().
    std::array<double, 2> energies(const double* state, bool there = false);
    // Of n states the powers (n, elements) of each element at the rates of the state or, if it is
    // `resting`, those of its force at rest; the same (chosen, stages, elements) at stages of the
    // `chosen` steps.
    void powers(const double* t, const double* states, std::size_t n,
                const SeparateElements& elements, bool resting, double* out);
    void stage_powers(const std::vector<long>& chosen, const StageArrays& steps,
                      const SeparateElements& elements, double* out);
    SeparateElements separate(const std::vector<ForceElement>& elements) const;
    // Of the stage evaluated last, in the order of the drives, the forces on their coordinates; false
    // where rows depend on each other, which leaves the forces open.
    bool drive_forces(double* out);
    // The forces within the mechanism at the stage of `state` at t, evaluated last; `all`, a system of
    // the same model, has all rows, whose scales are `scale` (rows,).  Multipliers (rows,) of all
    // rows; of its closures the wrenches (closures, 6) on b at b's origin; and of the joints those
    // (njoints, 6) of the parent on the child at the joint's origin: force, moment, in world axes.
    // Placements and velocities of the stage are the same afterwards, its other terms are lost.
    // The rows that this system has are `kept` of these, in their order.
    void reactions(double t, const double* state, System& all, const double* scale,
                   const std::vector<int>& kept, double* multipliers, double* on_b,
                   double* joints);
    std::size_t closure_count() const { return data_.closures.size(); }
    int joint_count() const;
    // Of the stage evaluated last: M x (nv,), all forces but those of closures (nv,), those among
    // them but those of inertia (nv,), and Gdot v - s'' (rows,).
    void mass_times(const double* x, double* out) const;
    void working_forces(double* all, double* working);
    const std::vector<double>& bias() const { return bias_; }
    // Whether moves commute: no ball, planar or free joints.
    bool commutes() const { return data_.groups.empty(); }
    int structural_rank() const { return data_.structural_rank; }
    bool driven() const { return !data_.drives.empty(); }
    std::size_t drive_count() const { return data_.drives.size(); }
    // The laws of forces in linearly implicit steps: their number; their values, which evaluations
    // find while they are tracked; what acts in their place, or, if null, they themselves.  More
    // laws than degrees of freedom are one: what closures leave of their generalised forces.
    int resolve_laws();
    void track_laws(bool tracked) {
        tracks_laws_ = tracked;
        laws_.applied = nullptr;
    }
    void apply_laws(const double* values) { laws_.applied = values; }
    const std::vector<double>& law_values() const { return laws_.values; }
    // Of joined laws that are tracked, their generalised forces (nv,) at the stage evaluated last;
    // null of others.
    const std::vector<double>* joined_laws() const {
        return tracks_laws_ && !joined_.empty() ? &joined_ : nullptr;
    }
    // M^-1 f (nv,).
    void acceleration_by(const double* f, double* out) const;
    // Derivatives (nv, count) of the accelerations by the laws that act, at the stage evaluated last.
    void law_accelerations(double* out);
    // Number of the law of a coordinate, or -1.
    int law_of_coordinate(int i) const { return laws_.of_coordinate(i); }
    // At the stage evaluated last, with the accelerations a (nv,): their derivatives (nv, nv), column
    // by column, by the forces, and by the chart coordinates while the forces are held.  False if
    // only differences give them.  Other terms of the stage are lost.
    bool derivatives(const double* state, const double* a, double* by_forces, double* by_q,
                     double* by_v);
    // The same by generated code, at the stage evaluated last, with the accelerations a (nv,) and
    // with laws applied if there are any: their derivatives by the chart coordinates while the laws
    // are held and by the laws (nv, count), and those of the laws (count, 2 nv).  Functions of the
    // user are differentiated with these steps (2 nv,).  False where no code was generated, and
    // where rows depend on each other.
    bool linearise(double t, const double* state, const double* a,
                   const std::vector<double>& steps, double* by_q, double* by_v, double* by_laws,
                   double* of_laws);
    // All forces (nv,) but those of inertia, gravity and closures, and the values of the laws.
    void applied_forces(double t, const double* state, double* out);
    // Whether the laws, each of its own coordinate, are all that makes them depend on the state.
    bool separate_forces() const { return !controller_ && !on_several_; }
    // The rates on which friction acts, and the speed over which it changes its sign.
    const std::vector<FrictionSum>& friction_sums() const { return friction_sums_; }
    double friction_speed() const { return data_.friction_speed; }
    // Error of a rate with friction, which is `rate`, from which the friction is another.
    double friction_tolerance(double rate) const;
    // Whether rates may depend on time itself: held forces do not.
    bool time_dependent() const;
    const std::vector<GroupJoint>& groups() const { return data_.groups; }
    double unit(int j) const { return data_.unit[j]; }
    double residual_scale(int row) const { return data_.residual_scale[row]; }

    int nq, nv;
    long evaluations = 0;
    long factorisations() const { return closed_ ? projection_->factorisations : 0; }

private:
    Pattern pattern() const;
    void move_bodies(const double* state);
    // Multipliers of the stage evaluated last, in the `kept` of all rows; false where rows depend
    // on each other, or leave shares of others.
    bool kept_multipliers(const double* generalised, const double* scale,
                          const std::vector<int>& kept, double* out);
    // Those (rows,) of generalised forces of the closures (nv,), of rows G (rows, nv + 1).
    void row_multipliers(const double* generalised, const std::vector<double>& G,
                         const double* scale, int rows, double* out);
    // Row `row` of G (nv,), cleared; and after it was written.
    double* column(int row);
    double* filled(int row);
    void update_closures(const double* q, bool with_bias);
    // Index in q of the cosine of a wrapped angle; the sine follows.
    int cosine_of(std::size_t angle) const;
    void update_powers(const JointRow& joints, const double* q, bool with_bias);
    void update_positions(const ClosureRows& closure, bool with_bias, double* rates);
    void update_alignments(const ClosureRows& closure, bool with_bias, double* rates);
    void update_joints(const JointRow& joints, const double* q, bool with_bias);
    void fill(const ClosureRows& closure, int row, const Vec& force, const Vec& on_a,
              const Vec& on_b);
    void update_drives(double t, bool with_bias);
    void completed(const double* white, double* out) const;
    const double* held_force(double t) const;

    void find_friction();
    void evaluate_open(double t, const double* state, ForceLaws* laws);
    void passive_forces();
    void coordinate_forces(double t, const double* state);
    void joined_forces(double t, const double* q);
    void joined_values();
    void factorise_mass();
    void generated_terms(double t, const double* state, ForceLaws* laws);
    bool generated_rows(const double* q, double* G, int width);
    void acceleration_of(double* r, const double* c);
    double passive_force(int i) const;
    double passive_slope(int i) const;
    void generated_derivatives(const double* state, const double* a, const double* lam,
                               const double* applied);
    void joined_laws_by_state(const double* state, const double* a, double* out);
    void controller_by_state(double t, const double* state, const std::vector<double>& steps);

    double first_ = -infinity;  // times (s) within which it evaluates
    double last_ = infinity;
    const GeneratedTerms* code_ = nullptr;
    std::unique_ptr<Projection> other_projection_;  // that with generated algebra, or without it
    GeneratedProjection* by_code_ = nullptr;        // the one in use, if its algebra is generated
    std::vector<double> law_values_;  // of the forces' curves, for generated code
    std::vector<double*> columns_of_rows_;
    std::vector<double*> bushing_bodies_;  // the memory of their kinematics
    std::vector<double> held_values_, own_laws_;
    std::vector<double> unused_;  // what code computes beside the rows of closures
    // Of generated derivatives, column by column: residuals by (q, v, laws), rows and laws by (q, v),
    // laws of coordinates by their own.
    std::vector<double> turns_, multipliers_, Dr_, Dc_, Dl_, Dq_, Dv_;
    std::vector<FrictionSum> friction_sums_;
    ForceLaws laws_;
    // Elements with laws, and the others, where the laws are joined.
    std::vector<ForceElement> lawful_, lawless_;
    std::vector<double> joined_;  // (nv,), generalised forces of joined laws; empty: they are not
    bool joined_act_ = false;     // these themselves, at the stage that code evaluated last
    std::vector<double> factors_;  // (nv, nv), of M of an open tree
    std::vector<int> pivots_;
    bool tracks_laws_ = false;
    ColumnGroups columns_;  // when first asked for
    std::vector<double> held_from_, held_;  // times (s), and forces (k, nv)
    SystemData data_;
    Controller controller_;
    std::unique_ptr<pinocchio_model::Workspace> work_;
    std::unique_ptr<Projection> projection_;
    std::vector<double> G_;  // (rows, nv), of a system without algebra of its closures
    bool closed_, flat_, on_several_, predicted_ = false;
    std::vector<BushingStep> bushings_;  // in the step that is made
    std::vector<double> g_, bias_, pushed_, f_, v_, rate_, prediction_, white_, acted_;
};

}  // namespace srm
