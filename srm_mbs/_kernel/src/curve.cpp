#include "curve.hpp"

#include <algorithm>
#include <cmath>

namespace srm {

void Curve::check() const {
    const std::size_t count = breaks.size();
    if (count == 0) throw std::invalid_argument("breaks is empty");
    expect_size("pieces", pieces.size(), pieces.size() / count * count);
    expect_size("sines", sines.size(), sines.size() / 3 * 3);
}

void Curve::at(double t, double out[3]) const {
    const auto after = std::upper_bound(breaks.begin(), breaks.end(), t) - breaks.begin();
    const std::size_t i = after > 0 ? static_cast<std::size_t>(after - 1) : 0;
    const std::size_t width = pieces.size() / breaks.size();
    const double x = t - breaks[i];
    double value = 0.0, rate = 0.0, half = 0.0;
    for (std::size_t j = width; j-- > 0;) {
        half = half * x + rate;
        rate = rate * x + value;
        value = value * x + pieces[i * width + j];
    }
    double bend = 2.0 * half;
    for (std::size_t k = 0; k < sines.size(); k += 3) {
        const double amplitude = sines[k], omega = sines[k + 1];
        const double angle = omega * t + sines[k + 2];
        value += amplitude * std::sin(angle);
        rate += amplitude * omega * std::cos(angle);
        bend -= amplitude * omega * omega * std::sin(angle);
    }
    out[0] = value;
    out[1] = rate;
    out[2] = bend;
}

}  // namespace srm
