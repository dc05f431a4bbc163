#include "history.hpp"

#include <algorithm>
#include <cmath>

#include "limits.hpp"

namespace srm {

void MultiplierHistory::check() const {
    expect_within("nv", nv, 0, std::numeric_limits<int>::max());
    const std::size_t width = static_cast<std::size_t>(nv);
    expect_size("values", values.size(), times.size() * width);
    if (nv > 0) expect_size("normals", normals.size(), normals.size() / width * width);
    if (nv > 0) expect_size("away", away.size(), away.size() / width * width);
}

void MultiplierHistory::clear() {
    times.clear();
    values.clear();
    normals.clear();
    away.clear();
    forget_known();
}

void MultiplierHistory::forget_known() {
    known_until = -infinity;
    known_below = 0.0;
}

void MultiplierHistory::extend(double t, const double* value,
                               std::vector<double>&& new_normals,
                               const std::vector<double>& new_away) {
    int kept = 0;
    while (kept < size() && times[kept] < t) ++kept;
    times.resize(kept);
    values.resize(static_cast<std::size_t>(kept) * nv);
    times.push_back(t);
    values.insert(values.end(), value, value + nv);
    const int extra = kept + 1 - points;
    if (extra > 0) {
        times.erase(times.begin(), times.begin() + extra);
        values.erase(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(extra) * nv);
    }
    forget_known();
    normals.swap(new_normals);
    away = new_away;
}

int MultiplierHistory::first_around(double t) const {
    const auto at = std::lower_bound(times.begin(), times.end(), t);
    const int first = static_cast<int>(at - times.begin()) - window / 2;
    return std::max(0, std::min(first, size() - window));
}

void MultiplierHistory::interpolate(int first, int count, double t, double* out) const {
    std::fill(out, out + nv, 0.0);
    for (int i = first; i < first + count; ++i) {
        double weight = 1.0;
        for (int j = first; j < first + count; ++j)
            if (i != j) weight *= (t - times[j]) / (times[i] - times[j]);
        const double* value = &values[static_cast<std::size_t>(i) * nv];
        for (int k = 0; k < nv; ++k) out[k] += weight * value[k];
    }
}

void MultiplierHistory::predict(double t, double* out) const {
    const int first = first_around(t);
    interpolate(first, std::min(window, size() - first), t, out);
}

bool MultiplierHistory::predict_near(double t, double* out) const {
    const double span = times.back() - times.front();
    if (span > 0.0 && t > std::max(times.back() + stale * span, known_until)) return false;
    predict(t, out);
    return true;
}

void MultiplierHistory::uncertainty(double t, double* out) const {
    const int first = first_around(t), count = std::min(window, size() - first);
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
