#include "sigma_dips.hpp"

#include <algorithm>
#include <cmath>

#include "limits.hpp"
#include "linear.hpp"

namespace srm {

namespace {

// The largest of each value and its neighbours, as far as there are any.  Two windows make one of
// the double width, up to the last power of 2; then two overlap.
std::vector<double> largest_around(const std::vector<double>& values, int before, int after) {
    const std::size_t n = values.size(), width = before + after + 1;
    std::vector<double> out(n + width - 1, -infinity);
    std::copy(values.begin(), values.end(), out.begin() + before);
    const auto join = [&](std::size_t count, std::size_t shift) {
        const double* const from = out.data() + shift;
        for (std::size_t i = 0; i < count; ++i) out[i] = out[i] > from[i] ? out[i] : from[i];
    };
    std::size_t size = 1, left = out.size();
    for (; 2 * size <= width; size *= 2) join(left -= size, size);
    join(n, width - size);
    out.resize(n);
    return out;
}

// Whether no interval between samples can be marked: in each step the lowest sigma, less the change
// that the steepest slope of the steps around allows in its longest interval, bounds all of them.
bool stays_away(const DipSearch& search, const double* times, const double* sigmas, long steps,
                long width) {
    const std::size_t stages = search.columns.size();
    std::vector<double> lengths(stages);
    for (std::size_t j = 0; j < stages; ++j)
        lengths[j] = search.abscissae[j] - (j ? search.abscissae[j - 1] : 0.0);
    const double longest = *std::max_element(lengths.begin(), lengths.end());
    for (double& length : lengths) length = 1.0 / length;
    std::vector<double> slopes(steps), lowest(steps);
    double largest = sigmas[0], before = sigmas[0];
    for (long i = 0; i < steps; ++i) {
        double low = before, slope = 0.0;
        for (std::size_t j = 0; j < stages; ++j) {
            const double value = sigmas[i * width + search.columns[j]];
            slope = std::max(slope, std::abs(value - before) * lengths[j]);
            low = std::min(low, value);
            largest = std::max(largest, value);
            before = value;
        }
        if (!(low >= search.lingering)) return false;
        lowest[i] = low;
        slopes[i] = slope / (times[i + 1] - times[i]);
    }
    const int reach = (search.around + static_cast<int>(stages) - 1) / static_cast<int>(stages);
    slopes = largest_around(slopes, reach, reach);
    for (long i = 0; i < steps; ++i) {
        const double change = longest * (times[i + 1] - times[i]) * slopes[i];
        if (!(lowest[i] - 0.5 * search.slope_margin * change >= search.vanishing * largest))
            return false;
    }
    return true;
}

}  // namespace

void DipSearch::check() const {
    if (columns.empty()) throw std::invalid_argument("there are no columns");
    expect_size("abscissae", abscissae.size(), columns.size());
    expect_within("around", around, 1, 1000);
}

SigmaDips recorded_dips(const DipSearch& search, const double* times, const double* sigmas,
                        long steps, long width, double end) {
    SigmaDips found;
    if (stays_away(search, times, sigmas, steps, width)) return found;
    const std::size_t stages = search.columns.size();
    std::vector<double>& t = found.t;
    std::vector<double> sigma;
    t.reserve(steps * stages + 1);
    sigma.reserve(steps * stages + 1);
    const auto add_sample = [&](double time, double value) {
        if (time > end) return;
        t.push_back(time);
        sigma.push_back(value);
    };
    add_sample(times[0], sigmas[0]);
    for (long i = 0; i < steps; ++i) {
        const double h = times[i + 1] - times[i];
        for (std::size_t j = 0; j < stages; ++j)
            add_sample(times[i] + search.abscissae[j] * h, sigmas[i * width + search.columns[j]]);
    }
    const std::size_t n = t.size();
    if (n < 3 || !finite(sigma.data(), static_cast<int>(n))) return found;
    // Between neighbouring samples: the lowest sigma that the slopes around allow.
    std::vector<double> lowest(n - 1);
    for (std::size_t i = 0; i + 1 < n; ++i)
        lowest[i] = std::abs(sigma[i + 1] - sigma[i]) / (t[i + 1] - t[i]);
    lowest = largest_around(lowest, search.around, search.around);
    const std::vector<double> size = largest_around(sigma, search.around, search.around + 1);
    std::vector<char> marked(n - 1);
    bool any = false;
    for (std::size_t i = 0; i + 1 < n; ++i) {
        lowest[i] = 0.5 * (sigma[i] + sigma[i + 1] -
                           search.slope_margin * lowest[i] * (t[i + 1] - t[i]));
        marked[i] = lowest[i] < search.vanishing * size[i] ||
                    std::min(sigma[i], sigma[i + 1]) < search.lingering;
        any |= marked[i];
    }
    if (!any) return found;
    const auto in_window = [&](std::size_t i) {  // marked itself, or next to one that is
        return i + 1 < n && (marked[i] || (i > 0 && marked[i - 1]) || (i + 2 < n && marked[i + 1]));
    };
    for (std::size_t begin = 0; begin + 1 < n; ++begin) {
        if (!in_window(begin)) continue;
        std::size_t last = begin;  // the last sample of the window
        while (in_window(last)) ++last;
        const auto top = std::max_element(sigma.begin() + begin, sigma.begin() + last + 1);
        const double level = std::max(search.departed * *top, search.least_departed);
        for (std::size_t k = begin; k <= last; ++k) {
            if (!((k == begin || sigma[k] <= sigma[k - 1]) && (k == last || sigma[k] < sigma[k + 1])))
                continue;
            std::size_t left = k > begin ? k - 1 : k, right = k < last ? k + 1 : k;
            while (left > begin && sigma[left] < level) --left;
            while (right < last && sigma[right] < level) ++right;
            const double floor = std::min(k > begin ? lowest[k - 1] : infinity,
                                          k < last ? lowest[k] : infinity);
            if (!(floor < search.depth * std::min(sigma[left], sigma[right]))) continue;
            const std::vector<int> dip{static_cast<int>(left), static_cast<int>(k),
                                       static_cast<int>(right)};
            // Of small minima between the same sides, the smallest.
            if (!found.dips.empty() && found.dips.back()[0] == dip[0]) {
                if (sigma[k] < sigma[found.dips.back()[1]]) found.dips.back() = dip;
                continue;
            }
            found.dips.push_back(dip);
            found.tops.push_back(static_cast<int>(top - sigma.begin()));
        }
        begin = last;
    }
    return found;
}

}  // namespace srm
