// Where a joint with friction turns back: integration/reversals.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "constants.hpp"

namespace srm {

// Time (s) by which a rate that changes from `before` to `after` in h comes too far over the layer
// of the friction `speed`: the function late_past_layer there.
inline double late_past_layer(double h, double before, double after, double speed,
                              double tolerance, const Constants& constants) {
    constexpr double none = -std::numeric_limits<double>::infinity();
    const double layer = constants.friction_layer * speed;
    const double far = constants.layer_landing * layer, target = 0.5 * (layer + far);
    const double size = std::abs(before);
    const bool leaves = size < layer || (size <= far && before * after < 0.0);
    const double side = std::copysign(1.0, leaves ? after : before);
    const double start = side * before, end = side * after;
    const bool unresolved =
        std::abs(end - start) > std::max(constants.layer_unresolved * layer, tolerance);
    if (!leaves && !(start > far && end < start)) return none;
    if (layer <= end && end <= far) return 0.0;
    if (leaves) return end > far && unresolved ? h * (end - target) / (end - start) : none;
    return end > far || unresolved ? h * (target - end) / (start - end) : none;
}

}  // namespace srm
