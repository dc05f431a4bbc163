// States between the ends of steps without evaluations: DenseOutput.between_ends.
#include <algorithm>
#include <cmath>

#include "dense.hpp"
#include "linear.hpp"

namespace srm {

namespace {

// Ends around a step through which polynomials lead.  In steps of the loosest reruns of the bundled
// mechanisms fewer are less often accurate enough, which costs evaluations.
constexpr int most_ends = 16;

}  // namespace

void DenseOutput::between_ends(System& system, const double* t, long k, const double* allowed,
                               double* out) {
    EndNodes ends;
    std::vector<double> of_coordinates(nx_);
    system.coordinate_errors(allowed, of_coordinates.data());
    for (long i = 0; i < k; ++i, out += nx_) {
        const long step = step_at(t[i]);
        const double theta = (t[i] - steps_.times[step]) /
                             (steps_.times[step + 1] - steps_.times[step]);
        if (ends.step != step) take_ends(system, step, ends);
        if (!through_ends(system, ends, theta, of_coordinates.data(), out))
            states(system, t + i, 1, out);
    }
}

// Places and rates at the ends around a step; none where there are not enough.
void DenseOutput::take_ends(const System& system, long step, EndNodes& ends) const {
    ends.step = step;
    ends.count = 0;
    const Nodes nodes = nodes_away(nullptr, step, most_ends);
    const int count = nodes.count;
    if (count < constants_.nodes[2]) return;
    ends.count = count;
    ends.places.resize(static_cast<std::size_t>(count) * nx_);
    ends.rates.resize(static_cast<std::size_t>(count) * nx_);
    const double *const times = steps_.times, *const start = steps_.states + step * nx_;
    const double h = times[step + 1] - times[step];
    const long last = smooth_interval(step).second;
    double points[most_nodes];
    for (int i = 0; i < count; ++i) {
        const long node = nodes.at[i];
        const double* const state = steps_.states + node * nx_;
        double* const place = &ends.places[static_cast<std::size_t>(i) * nx_];
        double* const rate = &ends.rates[static_cast<std::size_t>(i) * nx_];
        points[i] = (times[node] - times[step]) / h;
        system.coordinate_rates(state, rate_at(node, last), rate);
        for (int k = 0; k < nx_; ++k) {
            place[k] = state[k] - start[k];
            rate[k] *= h;
        }
    }
    // The fewer nodes are those nearest to the middle of the step.
    int order[most_nodes];
    for (int i = 0; i < count; ++i) order[i] = i;
    std::stable_sort(order, order + count, [&](int a, int b) {
        return std::abs(points[a] - 0.5) < std::abs(points[b] - 0.5);
    });
    Basis& whole = ends.bases[0];
    whole.count = count;
    double products[most_nodes];
    for (int i = 0; i < count; ++i) {
        whole.at[i] = order[i];
        whole.points[i] = points[order[i]];
        products[i] = 1.0;
        whole.slopes[i] = 0.0;
        for (int j = 0; j < i; ++j) {
            const double apart = whole.points[i] - whole.points[j], inverse = 1.0 / apart;
            products[i] *= apart;
            products[j] *= -apart;
            whole.slopes[i] += inverse;
            whole.slopes[j] -= inverse;
        }
    }
    Basis& less = ends.bases[1] = whole;
    less.count = count - 1;
    for (int i = 0; i < count; ++i) {
        const double apart = whole.points[i] - whole.points[count - 1];
        whole.weights[i] = 1.0 / products[i];
        if (i == less.count) break;
        less.weights[i] = whole.weights[i] * apart;
        less.slopes[i] -= 1.0 / apart;
    }
}

// Hermite's polynomial through all of the ends; false if that through one less differs by more than
// what is allowed.
bool DenseOutput::through_ends(const System& system, const EndNodes& ends, double theta,
                               const double* allowed, double* out) {
    if (!ends.count) return false;
    double of_places[2][most_nodes] = {}, of_rates[2][most_nodes] = {};
    for (int less = 0; less < 2; ++less) {
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
    std::copy_n(steps_.states + ends.step * nx_, nx_, out);
    double* const difference = x_.data();
    std::fill(difference, difference + nx_, 0.0);
    for (int i = 0; i < ends.count; ++i) {
        const double* const place = &ends.places[static_cast<std::size_t>(i) * nx_];
        const double* const rate = &ends.rates[static_cast<std::size_t>(i) * nx_];
        const double of_place = of_places[0][i], of_rate = of_rates[0][i];
        const double more_place = of_place - of_places[1][i], more_rate = of_rate - of_rates[1][i];
        for (int k = 0; k < nx_; ++k) {
            out[k] += of_place * place[k] + of_rate * rate[k];
            difference[k] += more_place * place[k] + more_rate * rate[k];
        }
    }
    for (int k = 0; k < nx_; ++k)
        if (!(std::abs(difference[k]) <= allowed[k])) return false;
    system.normalise(out);
    return true;
}

}  // namespace srm
