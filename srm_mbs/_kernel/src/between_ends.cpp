// States between the ends of steps without evaluations: DenseOutput.between_ends.
#include <algorithm>
#include <cmath>

#include "dense.hpp"
#include "linear.hpp"
#include "processor.hpp"

namespace srm {

namespace {

// Numbers of ends around a step through which polynomials lead: few first, and the most of them where
// those are not accurate enough.  In steps of the loosest reruns of the bundled mechanisms they often
// are not, and more than the most seldom save the evaluations that remain.
constexpr int few_ends = 8, most_ends = 16;
// Of an end of a step the state and the rates of its coordinates (nx,), and their weights in the
// polynomial, and in its difference from the one through fewer ends.
struct WeightedEnd {
    const double *state, *rate;
    double of_state, of_rate, more_state, more_rate;
};

// Adds two weighted ends, without the state at `start`, to `out` and to the difference (nx,).
SRM_FOR_PROCESSOR
void add_ends(const WeightedEnd& a, const WeightedEnd& b, const double* start, int nx,
              double* __restrict__ out, double* __restrict__ difference) {
    const double *const x = a.state, *const y = b.state, *const u = a.rate, *const w = b.rate;
    const double of_x = a.of_state, of_y = b.of_state, of_u = a.of_rate, of_w = b.of_rate;
    const double more_x = a.more_state, more_y = b.more_state;
    const double more_u = a.more_rate, more_w = b.more_rate;
    for (int k = 0; k < nx; ++k) {
        const double from_x = x[k] - start[k], from_y = y[k] - start[k];
        out[k] += of_x * from_x + of_u * u[k] + (of_y * from_y + of_w * w[k]);
        difference[k] += more_x * from_x + more_u * u[k] + (more_y * from_y + more_w * w[k]);
    }
}

}  // namespace

void DenseOutput::between_ends(System& system, const double* t, long k, const double* allowed,
                               EndReadings& known, double* out) {
    EndNodes& ends = known.nodes;
    known.allowed.resize(nx_);
    system.coordinate_errors(allowed, known.allowed.data());
    for (long i = 0; i < k; ++i, out += nx_) {
        const long step = step_at(t[i]);
        const double theta = (t[i] - steps_.times[step]) /
                             (steps_.times[step + 1] - steps_.times[step]);
        if (ends.step != step) take_ends(step, ends);
        if (!near_ends(system, theta, known.allowed.data(), known.rates, ends, out))
            states(system, t + i, 1, out);
    }
}

// The state by the fewest ends that are accurate enough; false if none are.
bool DenseOutput::near_ends(const System& system, double theta, const double* allowed,
                            EndRates& rates, EndNodes& ends, double* out) {
    if (!ends.count) use_ends(system, std::min(few_ends, ends.all), rates, ends);
    while (!through_ends(system, ends, theta, allowed, out)) {
        if (ends.count == ends.all) return false;
        use_ends(system, ends.all, rates, ends);
    }
    return true;
}

// Rates of the coordinates at an end of a step of the smooth interval that ends at `last`: each of
// the neighbouring steps needs them.
const double* DenseOutput::coordinate_rate(const System& system, long node, long last,
                                           EndRates& rates) const {
    if (nx_ == n_) return rate_at(node, last);  // rates are those of the coordinates
    if (last != rates.last) {  // of a breakpoint, the rates on the other side
        rates.last = last;
        rates.known.assign(static_cast<std::size_t>(steps_.count) + 1, 0);
        if (!rates.rates) rates.rates.reset(new double[rates.known.size() * nx_]);
    }
    double* const rate = &rates.rates[static_cast<std::size_t>(node) * nx_];
    if (!rates.known[node]) {
        system.coordinate_rates(steps_.states + node * nx_, rate_at(node, last), rate);
        rates.known[node] = 1;
    }
    return rate;
}

// The ends around a step, none of which is in use.
void DenseOutput::take_ends(long step, EndNodes& ends) const {
    ends.step = step;
    ends.all = ends.count = 0;
    const Nodes nodes = nodes_away(nullptr, step, most_ends);
    const int count = nodes.count;
    if (count < constants_.nodes[2]) return;
    ends.all = count;
    // In order of their distance from the middle of the step.
    const double *const times = steps_.times, middle = 0.5 * (times[step] + times[step + 1]);
    int after = 0;
    while (after < count && times[nodes.at[after]] <= middle) ++after;
    for (int i = 0, before = after; i < count; ++i) {
        const bool left = after == count || (before > 0 && middle - times[nodes.at[before - 1]] <=
                                                               times[nodes.at[after]] - middle);
        ends.nodes[i] = nodes.at[left ? --before : after++];
    }
}

// Takes further ends of the step into use, up to `count`.
void DenseOutput::use_ends(const System& system, int count, EndRates& rates,
                           EndNodes& ends) const {
    const double* const times = steps_.times;
    const long step = ends.step, last = smooth_interval(step).second;
    const double h = times[step + 1] - times[step];
    // The furthest one of those in use before was not yet in both polynomials.
    for (int i = std::max(ends.count - 1, 0); i < count; ++i) {
        const long node = ends.nodes[i];
        ends.states[i] = steps_.states + node * nx_;
        ends.rates[i] = coordinate_rate(system, node, last, rates);
        ends.points[i] = (times[node] - times[step]) / h;
        if (i == count - 1) break;
        double product = 1.0, slope = 0.0;
        for (int j = 0; j < i; ++j) {
            const double apart = ends.points[i] - ends.points[j], inverse = 1.0 / apart;
            product *= apart;
            ends.products[j] *= -apart;
            slope += inverse;
            ends.slopes[j] -= inverse;
        }
        ends.products[i] = product;
        ends.slopes[i] = slope;
    }
    ends.count = count;
}

// Hermite's polynomial through the ends in use; false if that through one less differs by more than
// what is allowed.
bool DenseOutput::through_ends(const System& system, const EndNodes& ends, double theta,
                               const double* allowed, double* out) {
    if (!ends.count) return false;
    const double h = steps_.times[ends.step + 1] - steps_.times[ends.step];
    const int less = ends.count - 1;
    const double furthest = ends.points[less], to_furthest = theta - furthest;
    // Products of theta - x_j, those of the ends before each and of all but the furthest.
    double before[most_nodes], after = 1.0, product = 1.0;
    for (int i = 0; i < less; ++i) {
        before[i] = product;
        product *= theta - ends.points[i];
    }
    WeightedEnd weighted[most_nodes + 1];
    const auto weigh = [&](int i, double whole, double slope, double fewer, double fewer_slope) {
        const double away = theta - ends.points[i];
        const double square = whole * whole, fewer_square = fewer * fewer;
        WeightedEnd& end = weighted[i];
        end.state = ends.states[i];
        end.rate = ends.rates[i];
        end.of_state = (1.0 - 2.0 * away * slope) * square;
        end.of_rate = h * away * square;
        end.more_state = end.of_state - (1.0 - 2.0 * away * fewer_slope) * fewer_square;
        end.more_rate = end.of_rate - h * away * fewer_square;
    };
    double product_there = 1.0, slope_there = 0.0;  // at the furthest
    for (int i = less; i-- > 0;) {
        const double apart = ends.points[i] - furthest, inverse = 1.0 / apart;
        const double fewer = before[i] * after / ends.products[i];
        after *= theta - ends.points[i];
        product_there *= -apart;
        slope_there -= inverse;
        weigh(i, fewer * to_furthest * inverse, ends.slopes[i] + inverse, fewer, ends.slopes[i]);
    }
    weigh(less, product / product_there, slope_there, 0.0, 0.0);
    if (ends.count % 2) {
        weighted[ends.count] = weighted[less];
        WeightedEnd& none = weighted[ends.count];
        none.of_state = none.of_rate = none.more_state = none.more_rate = 0.0;
    }
    const double* const start = steps_.states + ends.step * nx_;
    std::copy_n(start, nx_, out);
    std::fill_n(x_.data(), nx_, 0.0);
    for (int i = 0; i < ends.count; i += 2)
        add_ends(weighted[i], weighted[i + 1], start, nx_, out, x_.data());
    for (int k = 0; k < nx_; ++k)
        if (!(std::abs(x_[k]) <= allowed[k])) return false;
    system.normalise(out);
    return true;
}

}  // namespace srm
