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

// The recorded sigmas of the steps of a run.
class Recorded {
public:
    Recorded(const DipSearch& search, const double* times, const double* sigmas, long steps,
             long width)
        : search_(search), times_(times), sigmas_(sigmas), steps_(steps), width_(width) {
        for (std::size_t j = 0; j < search.columns.size(); ++j)
            lengths_.push_back(search.abscissae[j] - (j ? search.abscissae[j - 1] : 0.0));
        for (const double length : lengths_) inverse_.push_back(1.0 / length);
    }

    // Of each step whether sigma may come close to zero in one of its intervals: unless its lowest
    // sigma, less the change that the steepest slope of the steps around allows in the longest
    // interval, is far from that.  False if none may.
    bool bound() {
        const std::size_t stages = lengths_.size();
        std::vector<double> slopes(steps_), lowest(steps_);
        double largest = sigmas_[0], before = sigmas_[0];
        const int* const columns = search_.columns.data();
        const double *const inverse = inverse_.data(), *own = sigmas_;
        for (long i = 0; i < steps_; ++i, own += width_) {
            double low = before, high = before, slope = 0.0;
            for (std::size_t j = 0; j < stages; ++j) {
                const double value = own[columns[j]];
                slope = std::max(slope, std::abs(value - before) * inverse[j]);
                low = std::min(low, value);
                high = std::max(high, value);
                before = value;
            }
            largest = std::max(largest, high);
            lowest[i] = low;
            slopes[i] = slope / length(i);
        }
        const int reach = (search_.around + static_cast<int>(stages) - 1) / static_cast<int>(stages);
        slopes_ = largest_around(slopes, reach, reach);
        level_ = search_.vanishing * largest;
        const double longest = *std::max_element(lengths_.begin(), lengths_.end());
        near_.resize(steps_);
        bool any = false;
        for (long i = 0; i < steps_; ++i) {
            const double change = longest * length(i) * slopes_[i];
            near_[i] = !(lowest[i] >= search_.lingering &&
                         lowest[i] - 0.5 * search_.slope_margin * change >= level_);
            any |= near_[i];
        }
        return any;
    }

    // The sigmas as one vector of samples, up to `end` (s).
    const std::vector<double>& take_samples(double end) {
        sigma_.resize(steps_ * lengths_.size() + 1);
        sigma_[0] = sigmas_[0];
        double* next = &sigma_[1];
        for (long i = 0; i < steps_; ++i)
            for (const int column : search_.columns) *next++ = sigmas_[i * width_ + column];
        while (!sigma_.empty() && time(sigma_.size() - 1) > end) sigma_.pop_back();
        return sigma_;
    }

    // Between which neighbouring samples sigma may have come close to zero.
    std::vector<char> marked() const {
        const std::size_t intervals = sigma_.size() - 1, stages = lengths_.size();
        std::vector<char> out(intervals);
        for (long step = 0; step < steps_; ++step) {
            if (!near_[step]) continue;
            const std::size_t last = std::min((step + 1) * stages, intervals);
            for (std::size_t i = step * stages; i < last; ++i)
                out[i] = std::min(sigma_[i], sigma_[i + 1]) < search_.lingering ||
                         (lowest(i, slopes_[step]) < level_ &&
                          lowest(i) < search_.vanishing * largest_beside(i));
        }
        return out;
    }

    // The lowest sigma between samples i and i + 1 that the slopes around them allow.
    double lowest(std::size_t i) const {
        const std::size_t around = search_.around, last = std::min(i + around, sigma_.size() - 2);
        double steepest = 0.0;
        for (std::size_t k = i > around ? i - around : 0; k <= last;) {
            const std::size_t step = k / lengths_.size();
            const std::size_t next = std::min((step + 1) * lengths_.size(), last + 1);
            double slope = 0.0;
            for (std::size_t j = k % lengths_.size(); k < next; ++j, ++k)
                slope = std::max(slope, std::abs(sigma_[k + 1] - sigma_[k]) * inverse_[j]);
            steepest = std::max(steepest, slope / length(static_cast<long>(step)));
        }
        return lowest(i, steepest);
    }

private:
    double length(long step) const { return times_[step + 1] - times_[step]; }
    double time(std::size_t i) const {
        if (i == 0) return times_[0];
        const std::size_t step = (i - 1) / lengths_.size();
        const double part = search_.abscissae[(i - 1) % lengths_.size()];
        return times_[step] + part * length(static_cast<long>(step));
    }
    double lowest(std::size_t i, double steepest) const {
        const long step = static_cast<long>(i / lengths_.size());
        const double interval = lengths_[i % lengths_.size()] * length(step);
        return 0.5 * (sigma_[i] + sigma_[i + 1] - search_.slope_margin * steepest * interval);
    }
    double largest_beside(std::size_t i) const {
        const std::size_t around = search_.around;
        const std::size_t last = std::min(i + around + 1, sigma_.size() - 1);
        const auto first = sigma_.begin() + (i > around ? i - around : 0);
        return *std::max_element(first, sigma_.begin() + last + 1);
    }

    const DipSearch& search_;
    const double *times_, *sigmas_;
    const long steps_, width_;
    std::vector<double> lengths_, inverse_;  // of the intervals, over the step
    std::vector<double> slopes_;             // (steps,), the steepest around each step
    std::vector<char> near_;                 // (steps,)
    double level_ = 0.0;                     // sigma that vanishes beside the largest of all
    std::vector<double> sigma_;
};

}  // namespace

void DipSearch::check() const {
    if (columns.empty()) throw std::invalid_argument("there are no columns");
    expect_size("abscissae", abscissae.size(), columns.size());
    expect_within("around", around, 1, 1000);
}

SigmaDips recorded_dips(const DipSearch& search, const double* times, const double* sigmas,
                        long steps, long width, double end) {
    SigmaDips found;
    Recorded recorded(search, times, sigmas, steps, width);
    if (!recorded.bound()) return found;
    const std::vector<double>& sigma = recorded.take_samples(end);
    const std::size_t n = sigma.size();
    if (n < 3 || !finite(sigma.data(), static_cast<int>(n))) return found;
    const std::vector<char> marked = recorded.marked();
    const auto in_window = [&](std::size_t i) {  // marked itself, or next to one that is
        return i + 1 < n && (marked[i] || (i > 0 && marked[i - 1]) || (i + 2 < n && marked[i + 1]));
    };
    for (auto next = marked.begin();
         (next = std::find(next, marked.end(), 1)) != marked.end();) {
        std::size_t last = next - marked.begin();
        const std::size_t begin = last > 0 ? last - 1 : 0;
        while (in_window(last)) ++last;  // the last sample of the window
        next = marked.begin() + std::min(last, n - 1);
        const auto top = std::max_element(sigma.begin() + begin, sigma.begin() + last + 1);
        const double level = std::max(search.departed * *top, search.least_departed);
        for (std::size_t k = begin; k <= last; ++k) {
            if (!((k == begin || sigma[k] <= sigma[k - 1]) && (k == last || sigma[k] < sigma[k + 1])))
                continue;
            std::size_t left = k > begin ? k - 1 : k, right = k < last ? k + 1 : k;
            while (left > begin && sigma[left] < level) --left;
            while (right < last && sigma[right] < level) ++right;
            const double floor = std::min(k > begin ? recorded.lowest(k - 1) : infinity,
                                          k < last ? recorded.lowest(k) : infinity);
            if (!(floor < search.depth * std::min(sigma[left], sigma[right]))) continue;
            const std::array<long, 3> dip{static_cast<long>(left), static_cast<long>(k),
                                          static_cast<long>(right)};
            // Of small minima between the same sides, the smallest.
            if (!found.dips.empty() && found.dips.back()[0] == dip[0]) {
                if (sigma[k] < sigma[found.dips.back()[1]]) found.dips.back() = dip;
                continue;
            }
            found.dips.push_back(dip);
            found.tops.push_back(top - sigma.begin());
        }
    }
    return found;
}

}  // namespace srm
