#include "run_samples.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace srm {

namespace {

// Marks the k steps with the largest values (n,), of equal ones the later.
void choose_largest(const double* values, long n, long k, std::vector<char>& chosen) {
    if (k >= n) return std::fill(chosen.begin(), chosen.end(), 1);
    std::vector<double> parted(values, values + n);
    std::nth_element(parted.begin(), parted.begin() + (n - k), parted.end());
    const double least = parted[n - k];
    k -= std::count_if(parted.begin() + (n - k), parted.end(), [&](double x) { return x > least; });
    for (long i = n; i-- > 0;)
        if (values[i] > least || (values[i] == least && k-- > 0)) chosen[i] = 1;
}

// Ends of whole steps, as their numbers.
std::vector<long> sampled_ends(const StepArrays& steps, const SampleRules& rules,
                               const std::vector<double>& unit) {
    const long n = steps.count, length = (n + rules.most_ends - 1) / rules.most_ends;
    const std::size_t width = steps.corrected ? unit.size() : 0;
    std::vector<double> per_unit;
    for (const double one : unit) per_unit.push_back(1.0 / one);
    std::vector<long> out{0};
    for (long first = 0; first < n; first += length) {
        const long after = std::min(first + length, n);
        long chosen = first;
        double largest = -1.0;
        for (long step = first; step < after && length > 1; ++step) {
            const double* const correction = steps.corrections + step * width;
            double size = 0.0;
            for (std::size_t i = 0; i < width; ++i)
                size = std::max(size, std::abs(correction[i]) * per_unit[i]);
            if (size > largest) largest = size, chosen = step;
        }
        for (long step = first; step < after; ++step)
            if (step == chosen || step + 1 == n || steps.in_zone[step]) out.push_back(step + 1);
    }
    return out;
}

std::vector<double> times_between(const StepArrays& steps, const SampleRules& rules, bool stages) {
    const long n = steps.count;
    const double* const times = steps.times;
    std::vector<double> out;
    if (!stages) {
        const double apart = (steps.end - times[0]) / (rules.even_times - 1);
        for (int i = 0; i + 1 < rules.even_times; ++i) out.push_back(i * apart + times[0]);
        out.push_back(steps.end);
        return out;
    }
    const auto count = [&](int kind) {
        const long part = std::max<long>(rules.fewest[kind], n / rules.one_of[kind]);
        return std::min<long>(part, rules.most[kind]);
    };
    std::vector<char> chosen(n, 0);
    std::vector<double> lengths(n);
    for (long i = 0; i < n; ++i) lengths[i] = times[i + 1] - times[i];
    choose_largest(steps.error_ratios, n, count(0), chosen);
    choose_largest(lengths.data(), n, count(1), chosen);
    const long apart = (n + count(2) - 1) / count(2);
    for (long i = 0; i < n; i += apart) chosen[i] = 1;
    for (long i = 0; i < n; ++i) {
        if (!chosen[i]) continue;
        for (const double fraction : rules.read_at) {
            const double t = times[i] + fraction * lengths[i];
            if (t <= steps.end) out.push_back(t);
        }
    }
    return out;
}

}  // namespace

void SampleRules::check() const {
    expect_within("most_ends", most_ends, 1, std::numeric_limits<int>::max());
    expect_within("even_times", even_times, 2, std::numeric_limits<int>::max());
    for (const auto* each : {&fewest, &one_of, &most}) {
        expect_size("fewest, one_of or most", each->size(), 3);
        expect_within("fewest, one_of or most", *each, 1, std::numeric_limits<int>::max());
    }
}

SampleTimes sample_times(const StepArrays& steps, const SampleRules& rules,
                         const std::vector<double>& unit, bool stages) {
    std::vector<long> ends = sampled_ends(steps, rules, unit);
    const bool cut = steps.end < steps.times[steps.count];
    if (cut) ends.pop_back();
    const std::vector<double> between = times_between(steps, rules, stages);
    SampleTimes out;
    auto end = ends.begin();
    const auto take_ends = [&](double until) {
        for (; end != ends.end() && steps.times[*end] <= until; ++end) {
            out.ends.push_back(static_cast<long>(out.t.size()));
            out.t.push_back(steps.times[*end]);
        }
    };
    for (const double t : between) {
        take_ends(t);
        if (t != out.t.back()) out.t.push_back(t);  // the start of the run is an end
    }
    take_ends(steps.end);
    out.whole = out.t.size();
    if (cut) {
        out.ends.push_back(static_cast<long>(out.whole));
        out.t.push_back(steps.end);
    }
    return out;
}

}  // namespace srm
