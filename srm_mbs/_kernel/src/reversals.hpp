// Where a joint with friction turns back: integration/reversals.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <utility>

#include "constants.hpp"
#include "limits.hpp"

namespace srm {

// Time (s) by which a rate that changes from `before` to `after` in h comes too far over the layer
// of the friction `speed`: the function late_past_layer there.  `stages`: the least and the largest
// rate at the stages.
inline double late_past_layer(double h, double before, double after,
                              std::pair<double, double> stages, double speed, double tolerance,
                              const Constants& constants) {
    constexpr double none = -infinity;
    const double layer = constants.friction_layer * speed;
    const double far = constants.layer_landing * layer, target = 0.5 * (layer + far);
    const double size = std::abs(before);
    const bool leaves = size < layer || (size <= far && before * after < 0.0);
    const double side = std::copysign(1.0, leaves ? after : before);
    const double start = side * before, end = side * after;
    const bool unresolved =
        std::abs(end - start) > std::max(constants.layer_unresolved * layer, tolerance);
    if (!leaves && !(start > far && end < start)) return none;
    if (leaves) {
        if (layer <= end && end <= far) return 0.0;
        return end > far && unresolved ? h * (end - target) / (end - start) : none;
    }
    const double near = constants.layer_approached * start;
    if (layer <= end && end <= std::max(far, 2.0 * near)) {
        const double lowest = side > 0.0 ? stages.first : -stages.second;
        const bool over = std::max(far, end) < 0.5 * near && lowest < layer;
        return over ? h * (near - end) / (start - end) : 0.0;
    }
    return end > far || unresolved ? h * (target - end) / (start - end) : none;
}

}  // namespace srm
