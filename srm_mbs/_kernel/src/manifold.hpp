// Configurations with closed loops, for the load-time analysis: dynamics/constraints/structure.py.
#pragma once

#include <vector>

#include "algebra.hpp"
#include "struct_fields.hpp"
#include "system.hpp"

namespace srm {

// How Newton's iteration onto the closures ends: newton() of dynamics/constraints/newton.py.
#define SRM_CLOSING_LIMITS(field)                                                        \
    field(int, evaluations)   /* of g, at most */                                         \
    field(double, tolerance)  /* largest error, over its unit, that is closed */          \
    field(double, rounding)   /* the same, of an iteration that gains nothing any more */ \
    field(double, cut)        /* pivots over the longest row that are zero */

struct ClosingLimits {
    SRM_FIELDS(SRM_CLOSING_LIMITS)
};

// Newton's iteration from q (nq,), which it changes, onto the first rows of the system, as many as
// `algebra` has, without motions of drives and not monotone.  Errors are over row_unit (rows,),
// steps the shortest ones in units (nv,).  The largest error there, over its unit.
double close_loops(System& system, Algebra& algebra, const double* row_unit, const double* units,
                   const ClosingLimits& limits, std::vector<double>& q);

#define SRM_SCALED_ROWS(field)                                                             \
    field(std::vector<double>, scale)     /* (rows,), which rows are divided by */         \
    field(std::vector<double>, row_unit)  /* (closed rows,), units of errors of loops */   \
    field(std::vector<double>, unit)      /* (nv,), units of the coordinates */            \
    field(double, length)                 /* unit of length (m) */                         \
    field(std::vector<int>, trees)        /* first coordinates of the trees, and nv */     \
    field(std::vector<int>, eliminated)   /* rows that leave shares of others, in order */ \
    field(std::vector<int>, others)                                                        \
    field(std::vector<double>, shares)                                                     \
    field(double, null_pivot)             /* pivots below it leave their direction free */ \
    field(double, closed)                 /* error, over its unit, of closed loops */      \
    field(int, halvings)                  /* of a step whose end does not close */         \
    field(ClosingLimits, closing)

struct ScaledRows {
    SRM_FIELDS(SRM_SCALED_ROWS)

    void check() const;
};

// What a walk found: closed configurations (n, nq), the pivots of all rows (n, k) and of those of
// the loops (n, l) there, falling, and the largest norms (rows,) of rows.
struct WalkSamples {
    std::vector<double> configurations, pivots, of_loops, largest;
    std::size_t count = 0;
};

// The rows of a system without algebra of its own, scaled, in the mass metric.
class ScaledSampler {
public:
    // all, loops: the algebra of all rows and of those of the loops in the mass metric, one and
    // the same without drives; in_units: of those of the loops in units.
    ScaledSampler(System& system, const ScaledRows& rows, Algebra& all, Algebra& loops,
                  Algebra& in_units);

    // A walk from the closed configuration q (nq,), a sample too if it is asked for.  Directions
    // (steps, nv) are random, and become isotropic in the mass metric; reaches (steps,) are in
    // units.  The first step goes along `first` (nv,) unless it is null.
    void walk(std::vector<double> q, bool sample_start, int steps, const double* directions,
              const double* reaches, const double* first, WalkSamples& out);
    // Sums over n configurations, `spreads` (n, nv) away from q (nq,): the squares (rows,) of the
    // norms of rows and, if no terms in rows cancelled, of one along a direction and of one of an
    // alignment (2,).
    void open_norms(const std::vector<double>& q, std::size_t n, const double* spreads,
                    double* squares, double* uncancelled);

private:
    void factorise(const double* q);
    void write(Algebra& algebra, int rows);
    void sample(const std::vector<double>& q, WalkSamples& out) const;
    void make_isotropic(double* x) const;
    bool step(const double* q, const double* direction, double reach, std::vector<double>& moved);

    System& system_;
    const ScaledRows& rows_;
    Algebra &all_, &loops_, &in_units_;
    std::vector<double> G_;  // (rows, nv)
};

}  // namespace srm
