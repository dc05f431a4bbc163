// Passages of critical configurations that steps cannot make: integration/critical_passages.py.
#pragma once

#include <optional>
#include <vector>

#include "critical.hpp"
#include "system.hpp"
#include "struct_fields.hpp"

namespace srm {

#define SRM_COLLOCATION(field)                                                    \
    field(std::vector<double>, nodes)     /* (k,), Gauss nodes on [0, 1] */       \
    field(std::vector<double>, weights)   /* (k,) */                              \
    field(std::vector<double>, integrals) /* (k, k), of the basis up to the nodes */

struct Collocation {
    SRM_FIELDS(SRM_COLLOCATION)

    void check() const;
};

// A point of a motion.
struct PassagePoint {
    double t, sigma;
    std::vector<double> state;  // (nx,)
    std::vector<double> rate;   // (2 nv,)
};

// A motion past a critical configuration, along a curve of closed configurations: PlaceOnCurve.
struct MotionAlongCurve {
    CriticalConfiguration critical;
    double time_unit;
    bool exact;          // the residual counts as zero
    bool begun = false;  // the other fields are known
    int side = 0;        // of the branches
    double start = 0.0, beta = 0.0, energy = 0.0;
    bool beside = false;  // the state is only next to the curve, in a layer that counts as none
};

// The points of the motion from `state` at t past the critical configuration, along the curve of
// closed configurations, up to the time `end`; the start is the first of them.  Empty if the motion
// has no such passage.  Throws EvaluationError.  `motion` is then where it stops at `end`; it has
// not begun if it does not.
std::vector<PassagePoint> passage_along_curve(System& system, MotionAlongCurve& motion, double t,
                                              const std::vector<double>& state, double end,
                                              double rtol, const Collocation& collocation,
                                              const Constants& constants);

// The motion that starts at t in the layer of a critical configuration, to be followed up to the
// distance `reach` from it; a residual up to `tolerance` counts as zero.  layer_motion() of
// integration/critical_passages.py.
std::optional<MotionAlongCurve> motion_in_layer(System& system, double t,
                                                const std::vector<double>& state, double time_unit,
                                                double tolerance, double reach,
                                                const Constants& constants);

// StepBeside of integration/critical_passages.py.
enum class StepBeside { unknown, stays, passes, changes };

StepBeside step_beside(UnitClosures& closures, const CriticalConfiguration& critical, double t,
                       const std::vector<double>& state, double t_end,
                       const std::vector<double>& end, const Constants& constants);

// Whether drives lead a motion to a dead point in a layer: leads_to_dead_point() of
// integration/critical_passages.py.
bool leads_to_dead_point(UnitClosures& closures, const CriticalConfiguration& critical, double t,
                         const std::vector<double>& state, const Constants& constants);

}  // namespace srm
