// States between the ends of steps without evaluations: DenseOutput.between_ends.
#include <algorithm>
#include <cmath>
#include <limits>

#include "dense.hpp"
#include "linear.hpp"

namespace srm {

namespace {

// Part of the allowed error up to which the extrapolated one is accepted: of runs of the bundled
// mechanisms the error is then below the allowed one.
constexpr double extrapolated_part = 0.25;

}  // namespace

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
    ends.count = 0;
    const Nodes nodes = nodes_away(system, step, constants_.nodes[2]);
    const int count = nodes.count;
    if (count < constants_.nodes[2]) return;
    ends.count = count;
    ends.places.resize(static_cast<std::size_t>(count) * n_);
    ends.rates.resize(static_cast<std::size_t>(count) * n_);
    const double* const times = steps_.times;
    const double h = times[step + 1] - times[step];
    const long last = smooth_interval(step).second;
    const int nv = n_ / 2;
    double points[most_nodes];
    std::vector<double> near(nv), more(nv);
    // Outwards on either side, so that the motion to each end goes on from that to the last.
    const auto take = [&](int i, long from) {
        const long node = nodes.at[i];
        double* const place = &ends.places[static_cast<std::size_t>(i) * n_];
        double* const rate = &ends.rates[static_cast<std::size_t>(i) * n_];
        points[i] = (times[node] - times[step]) / h;
        if (system.wraps()) {
            motion(from, node, more.data());
            for (int k = 0; k < nv; ++k) near[k] += more[k];
        }
        system.difference(steps_.states + step * nx_, steps_.states + node * nx_, near.data(), place);
        system.chart_rate(place, rate_at(node, last), rate);
        for (int k = 0; k < n_; ++k) rate[k] *= h;
        return node;
    };
    const int after = static_cast<int>(std::upper_bound(nodes.at, nodes.at + count, step) - nodes.at);
    long from = step;
    for (int i = after; i-- > 0;) from = take(i, from);
    std::fill(near.begin(), near.end(), 0.0);
    from = step;
    for (int i = after; i < count; ++i) from = take(i, from);
    // The fewer nodes are those nearest to the middle of the step.
    int order[most_nodes];
    for (int i = 0; i < count; ++i) order[i] = i;
    std::stable_sort(order, order + count, [&](int a, int b) {
        return std::abs(points[a] - 0.5) < std::abs(points[b] - 0.5);
    });
    for (int less = 0; less < 3; ++less) {
        Basis& basis = ends.bases[less];
        basis.count = count - less;
        for (int i = 0; i < basis.count; ++i) {
            basis.at[i] = order[i];
            basis.points[i] = points[order[i]];
        }
        for (int i = 0; i < basis.count; ++i) {
            double product = 1.0, slope = 0.0;
            for (int j = 0; j < basis.count; ++j) {
                if (j == i) continue;
                const double apart = basis.points[i] - basis.points[j];
                product *= apart;
                slope += 1.0 / apart;
            }
            basis.weights[i] = 1.0 / product;
            basis.slopes[i] = slope;
        }
    }
}

// Hermite's polynomial through all of the ends; false if its error may exceed what is allowed.  The
// differences to those through fewer ends fall by a factor with each end that is taken, and the
// error is taken to be smaller than the last of them by that factor.
bool DenseOutput::through_ends(System& system, const EndNodes& ends, double theta,
                               const double* allowed, double* out) {
    if (!ends.count) return false;
    double of_places[3][most_nodes] = {}, of_rates[3][most_nodes] = {};
    for (int less = 0; less < 3; ++less) {
        const Basis& basis = ends.bases[less];
        double before[most_nodes + 1], after = 1.0;  // products of theta - x_j
        before[0] = 1.0;
        for (int i = 0; i < basis.count; ++i) before[i + 1] = before[i] * (theta - basis.points[i]);
        for (int i = basis.count; i-- > 0;) {
            const double away = theta - basis.points[i];
            const double value = basis.weights[i] * before[i] * after, square = value * value;
            after *= away;
            of_places[less][basis.at[i]] = (1.0 - 2.0 * away * basis.slopes[i]) * square;
            of_rates[less][basis.at[i]] = away * square;
        }
    }
    // The largest difference, over what is allowed, to the polynomial through one end less.
    const auto change = [&](int less) {
        double* const difference = x_.data();
        std::fill(difference, difference + n_, 0.0);
        for (int i = 0; i < ends.count; ++i) {
            const std::size_t own = static_cast<std::size_t>(i) * n_;
            add(of_places[less][i] - of_places[less + 1][i], &ends.places[own], difference, n_);
            add(of_rates[less][i] - of_rates[less + 1][i], &ends.rates[own], difference, n_);
        }
        double largest = 0.0;
        for (int i = 0; i < n_; ++i) {
            const double part = std::abs(difference[i]) / allowed[i];
            if (!std::isfinite(part)) return std::numeric_limits<double>::infinity();
            largest = std::max(largest, part);
        }
        return largest;
    };
    const double last = change(0);
    if (!(last <= 1.0)) {
        const double before = change(1);
        if (!(last < before && last * last <= extrapolated_part * before)) return false;
    }
    std::fill(delta_.begin(), delta_.end(), 0.0);
    for (int i = 0; i < ends.count; ++i) {
        const std::size_t own = static_cast<std::size_t>(i) * n_;
        add(of_places[0][i], &ends.places[own], delta_.data(), n_);
        add(of_rates[0][i], &ends.rates[own], delta_.data(), n_);
    }
    system.retract(steps_.states + ends.step * nx_, delta_.data(), out);
    return true;
}

}  // namespace srm
