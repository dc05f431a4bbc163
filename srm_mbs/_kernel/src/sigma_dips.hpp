// Minima of the recorded sigma that may be passages: recorded_dips() in
// integration/singular_passages.py.
#pragma once

#include <array>
#include <vector>

#include "struct_fields.hpp"

namespace srm {

#define SRM_DIP_SEARCH(field)                                                             \
    field(std::vector<int>, columns)      /* of the stages, in order of time */           \
    field(std::vector<double>, abscissae) /* theirs */                                    \
    field(int, around)                    /* samples around with which each is compared */ \
    field(double, slope_margin)                                                           \
    field(double, vanishing)                                                              \
    field(double, lingering)                                                              \
    field(double, departed)                                                               \
    field(double, least_departed)                                                         \
    field(double, depth)

struct DipSearch {
    SRM_FIELDS(SRM_DIP_SEARCH)

    void check() const;
};

struct SigmaDips {
    std::vector<std::array<long, 3>> dips;  // the minimum between those on both sides where it is left
    std::vector<long> tops;                 // the largest sample of the window of each
};

// times (steps + 1,), sigmas (steps, width).  Samples: the start, then the columns of each step, up
// to `end`.
SigmaDips recorded_dips(const DipSearch& search, const double* times, const double* sigmas,
                        long steps, long width, double end);

}  // namespace srm
