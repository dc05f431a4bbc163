// The smallest singular value of the normalised, separated rows along a motion:
// dynamics/constraints/geometry.py.
#pragma once

#include <vector>

#include "algebra.hpp"
#include "struct_fields.hpp"
#include "system.hpp"

namespace srm {

#define SRM_SEPARATED_ROWS(field)                                                             \
    field(std::vector<std::vector<int>>, supports) /* of all rows, where they may not vanish */ \
    field(std::vector<double>, factors)            /* (rows, n), of entries of G */             \
    field(std::vector<int>, share_rows)            /* shares of row `other` leave row `row` */  \
    field(std::vector<int>, share_others)                                                       \
    field(std::vector<double>, shares)                                                          \
    field(std::vector<double>, left)               /* (rows,), norms are divided by it */       \
    field(std::vector<int>, active)                /* the rows of the algebra */                \
    field(double, inert)                           /* norm up to which a row is zero */

struct SeparatedRows {
    SRM_FIELDS(SRM_SEPARATED_ROWS)

    void check() const;
    // The rows G (rows, n), zero at first, of `system` at q and t.
    void write(System& system, double t, const double* q, std::vector<double>& G) const;
    // The smallest singular value of the active rows of `system` at q and t, with `algebra` for
    // these; NaN where other rows are not zero.  G as for write(), left_vector as of
    // Algebra::weakest().
    double smallest(System& system, Algebra& algebra, double t, const double* q,
                    std::vector<double>& G, std::vector<double>* left_vector = nullptr) const;
};

}  // namespace srm
