#include "history.hpp"

#include <algorithm>
#include <cmath>

namespace srm {

void History::empty() {
    size = 0;
    times.clear();
    values.clear();
    known_until = -std::numeric_limits<double>::infinity();
    known_below = 0.0;
    normals.clear();
    normal_count = 0;
}

void History::extend(double t, const double* value, const std::vector<double>& new_normals,
                     int new_count) {
    int kept = 0;
    while (kept < size && times[kept] < t) ++kept;
    times.resize(kept);
    values.resize(static_cast<std::size_t>(kept) * nv);
    times.push_back(t);
    values.insert(values.end(), value, value + nv);
    const int extra = kept + 1 - points;
    if (extra > 0) {
        times.erase(times.begin(), times.begin() + extra);
        values.erase(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(extra) * nv);
    }
    size = static_cast<int>(times.size());
    known_until = -std::numeric_limits<double>::infinity();
    known_below = 0.0;
    normals = new_normals;
    normal_count = new_count;
}

int History::first_around(double t) const {
    const auto at = std::lower_bound(times.begin(), times.begin() + size, t);
    const int first = static_cast<int>(at - times.begin()) - window / 2;
    return std::max(0, std::min(first, size - window));
}

void History::interpolate(int first, int count, double t, double* out) const {
    std::fill(out, out + nv, 0.0);
    for (int i = first; i < first + count; ++i) {
        double weight = 1.0;
        for (int j = first; j < first + count; ++j)
            if (i != j) weight *= (t - times[j]) / (times[i] - times[j]);
        const double* value = &values[static_cast<std::size_t>(i) * nv];
        for (int k = 0; k < nv; ++k) out[k] += weight * value[k];
    }
}

void History::predict(double t, double* out) const {
    const int first = first_around(t);
    interpolate(first, std::min(window, size - first), t, out);
}

bool History::predict_near(double t, double* out) const {
    const double span = times[size - 1] - times[0];
    if (span > 0.0 && t > std::max(times[size - 1] + stale * span, known_until)) return false;
    predict(t, out);
    return true;
}

void History::uncertainty(double t, double* out) const {
    const int first = first_around(t), count = std::min(window, size - first);
    if (count < 2) {
        std::fill(out, out + nv, 0.0);
        return;
    }
    std::vector<double> whole(nv);
    interpolate(first, count, t, whole.data());
    interpolate(first + 1, count - 1, t, out);
    for (int k = 0; k < nv; ++k) out[k] = std::abs(whole[k] - out[k]);
}

}  // namespace srm
