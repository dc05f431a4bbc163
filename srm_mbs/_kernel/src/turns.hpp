// Where a motion turns back next to a singular configuration: recorded_turns() of
// integration/singular_passages.py.
#pragma once

#include <array>
#include <vector>

#include "constants.hpp"
#include "dense.hpp"
#include "separated_rows.hpp"
#include "sigma_dips.hpp"
#include "struct_fields.hpp"

namespace srm {

#define SRM_TURN_SEARCH(field)                                                               \
    field(std::vector<double>, unit) /* (nv,) of the coordinates */                          \
    field(std::vector<int>, columns) /* of these, the ones that rows depend on */            \
    field(int, rank)                 /* structural, of the rows */                           \
    field(int, newton_steps)         /* to where the rates vanish */                         \
    field(double, resting)           /* rate there, over its change in the step */           \
    field(double, together)          /* the next singular value, over the smallest */        \
    field(double, touching)          /* the smallest, over the largest value of the window */ \
    field(double, untouched)         /* the same, over the largest sigma of the window */    \
    field(double, reading_part)      /* error of reading the turn, over sigma next to it */  \
    field(double, least_reading)     /* that error below which it is not tried */            \
    field(double, reading_margin)    /* the smallest value over that error, if it is sure */ \
    field(double, time_unit)         /* (s), with drives */                                  \
    field(double, reach)             /* of the search for a critical configuration */

struct TurnSearch {
    SRM_FIELDS(SRM_TURN_SEARCH)

    void check() const { expect_within("rank", rank, 1, 1 << 20); }
};

struct Turn {
    std::array<double, 3> times;   // the end of a step, the turn, and the other end (s)
    std::array<double, 3> values;  // the smallest singular value there, positive at the turn
    long top;
};

struct Turns {
    std::vector<char> found;   // whether each dip is certainly at a turn
    std::vector<Turn> beyond;  // those beyond the singular configuration
};

// rows, all_rows: as of SeparatedRows::write.  dense, of steps of the tableau that `dips` is for, is
// read with `system`.  tolerance: residual of a critical configuration, in row units, up to which it
// counts as singular.
Turns recorded_turns(const TurnSearch& search, const SeparatedRows& rows, System& all_rows,
                     const DipSearch& dips, const SigmaDips& recorded, DenseOutput& dense,
                     System& system, double tolerance, const Constants& constants);

}  // namespace srm
