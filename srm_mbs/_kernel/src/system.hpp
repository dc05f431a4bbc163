// Twin of srm_mbs/dynamics/multibody.py and loops.py: a mechanism as a system.
//
//     q' = v,   M(q) v' = f(q, v, t) - G^T lam,   g(q) = s(t),
//
// s the motion of the drives, 0 in the rows of the loops.
//
// A state is (q, v), a tangent (dq, dv).  The terms of the stage evaluated last are answered by
// the system itself, each at its own cost.
#pragma once

#include <functional>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "charts.hpp"
#include "curve.hpp"
#include "forces.hpp"
#include "history.hpp"
#include "projection.hpp"
#include "vectors.hpp"

namespace srm {

// Kept, scaled rows of one closure.
struct LoopRows {
    int joint_a, joint_b;
    double at_a[3], at_b[3];              // the anchors' origins, like all in the axes of the joints
    std::vector<double> directions;       // (k, 3)
    std::vector<double> distances;        // (l, 2): length, factor of the row
    std::vector<double> alignments;       // (l, 6): u in a, n in b
    std::vector<int> columns;             // velocity components that move a against b
    std::vector<double> signs;            // +1 where they move a, -1 where b
    int first_row;
};

// A kept, scaled joint row: sum c_i q_i - offset.
struct JointRow {
    int row;
    std::vector<double> coefficients;
    std::vector<int> in_q, in_v;
    double offset;
};

// factor times the row other is taken off the row row, in their columns of G.
struct Elimination {
    int row, other;
    double factor;
    std::vector<int> columns;
};

// A driven row: that of a closure among the loops, or of a joint coordinate.
struct DrivenRow {
    int row;
    double factor;              // the inverse of the row scale
    int in_q = -1, in_v = -1;   // of a joint, else -1
    bool wound = false;         // a joint that stores (cos, sin)
    Curve curve;
};

// (t, q, v) -> generalised forces (nv,), added to tau.
using Controller = std::function<void(double, const double*, const double*, double*)>;

struct SystemData {
    std::vector<LoopRows> loops;
    std::vector<JointRow> joint_rows;
    std::vector<Elimination> eliminations;
    std::vector<DrivenRow> drives;      // in the order of their rows, which are the last
    int rows = 0, structural_rank = 0;
    double sigma_ref = 1.0;
    std::string algebra = "auto";       // "auto", "dense" or "sparse"
    std::vector<int> order;             // of the rows along the graph of the loops, or empty
    double pivot_share = 1.0;
    int pivot_window = 1;
    std::vector<double> gap_scale;      // (rows,)
    std::vector<double> unit;           // (nv,)
    std::vector<int> position_of;       // (nv,), -1 on groups
    std::vector<double> damping;        // (nv,) or empty
    std::vector<double> friction;       // (nv,) or empty
    double friction_speed = 1.0;
    std::vector<ForceElement> forces;
    double coincident = 0.0;
    std::vector<GroupJoint> groups;
    std::vector<double> series;         // of dexp^-1
    std::vector<int> turning;           // velocity indices of (cos, sin) joints
    double largest_rotation = 0.0, farthest_node = 0.0, rotation_per_step = 0.0;
};

class System {
public:
    System(const void* model, SystemData data, Controller controller);
    ~System();

    // The zone of a stage; see srm_mbs/dynamics/system.py.  threshold < 0: none.
    struct ZoneView {
        double threshold = -1.0;
        const History* history = nullptr;
        bool predicts = true;  // false: hold the normals
        const std::vector<double>* normals = nullptr;
        int normal_count = 0;
    };

    void evaluate(double t, const double* state, const ZoneView& zone);
    // The pass over the tree that an evaluation begins with, alone: to measure it.
    void tree_terms(const double* state);
    // Evaluates at times within [first, last] only: on one side of a breakpoint.
    void between(double first, double last) {
        first_ = first;
        last_ = last;
    }
    // From t on a constant force (nv,) acts, beside all others; with `keep` those before stay in
    // force at earlier times.
    void hold(double t, const double* force, bool keep);
    // As if it were new, at another start: what depends on that.
    void renew(std::vector<double> unit, std::vector<double> gap_scale,
               std::vector<double> damping, std::vector<double> friction);
    // Whether `force` (nv,) is what acts now.
    bool holds(const double* force) const;

    // Terms of the stage evaluated last.
    bool constrained() const { return closed_; }
    bool sparse() const { return closed_ && projection_->sparse(); }
    double sigma() const;
    int rank() const;
    bool weak() const;
    bool held() const;
    void rate(double* out);              // (2 nv,)
    void multiplier(double* out);        // (nv,)
    void correction(double* out);        // (2 nv,)
    double gap() const;
    void normals(std::vector<double>& out, int& count) const;

    // The manifold.
    void retract(const double* state, const double* delta, double* out);
    // Angles that count no turns take the one nearest to the motion near (nv,).
    void difference(const double* start, const double* end, const double* near, double* out);
    bool reachable(const double* start, const double* end) const;
    void chart_rate(const double* delta, const double* rate, double* out) const;
    double size(const double* positions) const;  // of dq (nv,), in units
    void magnitudes(const double* state, double* out) const;
    double step_limit(const double* state) const;
    double closure_gap(double t, const double* state);

    int nq, nv;
    long evaluations = 0;
    long factorisations() const { return closed_ ? projection_->factorisations : 0; }

private:
    Pattern pattern() const;
    void update_loops(const double* q, bool with_bias);
    void update_positions(const LoopRows& loop, bool with_bias);
    void update_alignments(const LoopRows& loop, bool with_bias);
    void fill(const LoopRows& loop, int row, const Vec& force, const Vec& moment);
    void update_drives(double t, bool with_bias);
    void completed(const double* white, double* out) const;
    const double* held_force(double t) const;

    double first_ = -std::numeric_limits<double>::infinity();
    double last_ = std::numeric_limits<double>::infinity();
    std::vector<double> held_from_, held_;  // times, and forces (k, nv)
    SystemData data_;
    Controller controller_;
    std::unique_ptr<pinocchio_model::Workspace> work_;
    std::unique_ptr<Projection> projection_;
    bool closed_, flat_, predicted_ = false;
    std::vector<double> g_, bias_, pushed_, f_, v_, rate_, prediction_, white_, acted_;
};

}  // namespace srm
