// Twin of srm_mbs/model/laws.py: a law over time.
//
//     s(t) = sum_j c_ij (t - b_i)^j  on [b_i, b_{i+1})  +  sum_k A_k sin(w_k t + phi_k).
#pragma once

#include <vector>

namespace srm {

struct Curve {
    std::vector<double> breaks;  // ascending; the first piece also holds before its start
    std::vector<double> pieces;  // (breaks, width), rising powers
    std::vector<double> sines;   // (k, 3): amplitude, angular frequency, phase

    // s, s' and s'' at t.
    void at(double t, double out[3]) const;
};

}  // namespace srm
