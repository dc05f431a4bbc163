// Consistent states next to closed guesses, where no search is needed: assembly/regular_start.py.
#pragma once

#include <cstddef>
#include <vector>

#include "struct_fields.hpp"
#include "system.hpp"

namespace srm {

#define SRM_START_RULES(field)                                                              \
    field(double, closed)        /* norm of the errors, in units, of a guess that is closed */ \
    field(double, exact)         /* largest error, in units, that no step makes smaller */  \
    field(int, evaluations)      /* of Newton's iteration, at most */                       \
    field(double, clearly_more)  /* mean square of the norm of a row that is no rounding */ \
    field(double, rounding_row)  /* norm of a row, over uncancelled terms, that is */       \
    field(double, zero)          /* norm of a normalised row that is not in use */          \
    field(double, regular)       /* singular value that the others are above */             \
    field(double, at_rest)       /* part of the given rates that is rounding of zero */     \
    field(double, rate_error)    /* largest error of rates, in units per second, */         \
    field(double, position_error) /* that of positions, which one over the singular value is */ \
    field(double, largest_rate_error) /* and the largest of these */                        \
    field(double, size_rounding) /* size over distance, or over gyration, that is rounding */

struct StartRules {
    SRM_FIELDS(SRM_START_RULES)
};

struct StartRequest {
    const double* q;                // (nq,), the guess
    const double* v;                // (nv,), the rates
    std::vector<int> free_q, free_v;  // coordinates and rates that are not held
    std::vector<int> turning;       // coordinates that are angles
    const double* spreads;          // (count, nv), in units, to open configurations
    std::size_t count;
};

// The state next to a guess, the diagonal of the scene at the guess (0: all at one point),
// System::least_inertia() in this state, and the gyrations.
struct RegularStart {
    std::vector<double> q, v;
    double diagonal = 0.0, least_inertia = 0.0;
    Gyrations gyrations{};
};

// False where the guess is open, where rows in use depend on each other or nearly do, and where no
// motion has the rates that are held.  The system has all rows, unscaled, and no drives.
bool find_regular_start(System& system, const StartRules& rules, const StartRequest& request,
                        RegularStart& out);

}  // namespace srm
