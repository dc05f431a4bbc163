// A law over time: model/laws.py.
//
//     s(t) = sum_j c_ij (t - b_i)^j  on [b_i, b_{i+1})  +  sum_k A_k sin(w_k t + phi_k).
#pragma once

#include <vector>

#include "struct_fields.hpp"

namespace srm {

#define SRM_CURVE(field)                                                                      \
    field(std::vector<double>, breaks) /* ascending; the first piece also holds before */     \
    field(std::vector<double>, pieces) /* (breaks, width), rising powers */                   \
    field(std::vector<double>, sines)  /* (k, 3): amplitude, angular frequency, phase */

struct Curve {
    SRM_FIELDS(SRM_CURVE)

    // s, s' and s'' at t.
    void at(double t, double out[3]) const;
    void check() const;
};

}  // namespace srm
