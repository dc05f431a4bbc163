// Critical configurations: dynamics/singularities/critical.py.
#pragma once

#include <optional>
#include <vector>

#include "constants.hpp"
#include "system.hpp"

namespace srm {

// The residual (row units) of the critical configuration that a motion passes at `zero` (s), from
// the state `begin` at t with the tangent rate `rate`; none if it passes none.
std::optional<double> residual_of_passage(System& system, double t, const double* begin,
                                          const double* rate, double zero,
                                          const Constants& constants);

}  // namespace srm
