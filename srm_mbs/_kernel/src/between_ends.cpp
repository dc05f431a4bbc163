// States between the ends of steps without evaluations: DenseOutput.between_ends.
#include <algorithm>
#include <cmath>

#include "dense.hpp"
#include "linear.hpp"

namespace srm {

void DenseOutput::between_ends(System& system, const double* t, long k, const double* allowed,
                               double* out) {
    EndNodes ends;
    for (long i = 0; i < k; ++i, out += nx_) {
        const long step = step_at(t[i]);
        const double theta = (t[i] - steps_.times[step]) /
                             (steps_.times[step + 1] - steps_.times[step]);
        if (ends.step != step) take_ends(system, step, ends);
        if (!through_ends(system, ends, theta, allowed, out)) states(system, t + i, 1, out);
    }
}

// Places and rates at the ends around a step, in its chart; none where there are not enough.
void DenseOutput::take_ends(System& system, long step, EndNodes& ends) const {
    ends.step = step;
    const Nodes nodes = nodes_away(system, step, constants_.nodes[2]);
    const int count = nodes.count;
    ends.points.clear();
    if (count < constants_.nodes[2]) return;
    ends.places.resize(static_cast<std::size_t>(count) * n_);
    ends.rates.resize(static_cast<std::size_t>(count) * n_);
    const double* const times = steps_.times;
    const double h = times[step + 1] - times[step];
    const long last = smooth_interval(step).second;
    std::vector<double> near(n_ / 2);
    for (int i = 0; i < count; ++i) {
        const long node = nodes.at[i];
        double* const place = &ends.places[i * n_];
        ends.points.push_back((times[node] - times[step]) / h);
        if (system.wraps()) motion(step, node, near.data());
        system.difference(steps_.states + step * nx_, steps_.states + node * nx_, near.data(), place);
        system.chart_rate(place, rate_at(node, last), &ends.rates[i * n_]);
    }
    // The fewer nodes are those nearest to the middle of the step.
    std::vector<int> order(count);
    for (int i = 0; i < count; ++i) order[i] = i;
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) {
        return std::abs(ends.points[a] - 0.5) < std::abs(ends.points[b] - 0.5);
    });
    ends.nearest.assign(order.begin(), order.begin() + constants_.nodes[1]);
}

// Hermite's polynomials through all of the ends and through the nearest of them; false if they
// differ by more than is allowed.
bool DenseOutput::through_ends(System& system, const EndNodes& ends, double theta,
                               const double* allowed, double* out) {
    if (ends.points.empty()) return false;
    const int count = static_cast<int>(ends.points.size());
    const double h = steps_.times[ends.step + 1] - steps_.times[ends.step];
    std::vector<int> all(count);
    for (int i = 0; i < count; ++i) all[i] = i;
    std::vector<double> fewer(n_, 0.0);
    std::fill(delta_.begin(), delta_.end(), 0.0);
    const auto sum = [&](const std::vector<int>& own, double* out) {
        for (const int i : own) {
            const double x = ends.points[i];
            double basis = 1.0, slope = 0.0;
            for (const int j : own) {
                if (j == i) continue;
                basis *= (theta - ends.points[j]) / (x - ends.points[j]);
                slope += 1.0 / (x - ends.points[j]);
            }
            const double square = basis * basis;
            add((1.0 - 2.0 * (theta - x) * slope) * square, &ends.places[i * n_], out, n_);
            add(h * (theta - x) * square, &ends.rates[i * n_], out, n_);
        }
    };
    sum(all, delta_.data());
    sum(ends.nearest, fewer.data());
    for (int i = 0; i < n_; ++i)
        if (!(std::abs(delta_[i] - fewer[i]) <= allowed[i])) return false;
    system.retract(steps_.states + ends.step * nx_, delta_.data(), out);
    return true;
}

}  // namespace srm
