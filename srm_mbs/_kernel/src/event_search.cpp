#include "event_search.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "limits.hpp"

namespace srm {

namespace {

constexpr double epsilon = std::numeric_limits<double>::epsilon();

double sign_above(double value, double floor) {
    return std::abs(value) <= floor ? 0.0 : std::copysign(1.0, value);
}

// The zero by inverse interpolation of the last two or three of `count` (time, value); NaN if values
// are equal.
template <class Node>
double interpolated_zero(const Node* points, int count) {
    const auto [b, fb] = points[count - 2];
    const auto [c, fc] = points[count - 1];
    if (fb == fc) return not_a_number;
    const double secant = c - fc * (c - b) / (fc - fb);
    if (count == 2) return secant;
    const auto [a, fa] = points[0];
    if (fa == fb || fa == fc) return not_a_number;
    const double other = b - fb * (b - a) / (fb - fa);
    return secant - fc * (secant - other) / (fc - fa);
}

}  // namespace

EventSearch::EventSearch(std::vector<WatchedEvent> events, std::vector<double> fractions,
                         const EventConstants& constants, std::size_t nx)
    : times(events.size()),
      states(events.size()),
      events_(std::move(events)),
      fractions_(std::move(fractions)),
      constants_(constants),
      nx_(nx),
      values_(events_.size()),
      signs_(events_.size()),
      inside_(fractions_.size() + 1),
      x_(inside_.size() * nx),
      at_(nx) {}

double EventSearch::same_time(double t, double t_new) const {
    return std::max(constants_.same_time_step * (t_new - t),
                    constants_.same_time_rounding * std::max(std::abs(t), std::abs(t_new)));
}

double EventSearch::floor_at(std::size_t i, double t, const double* state,
                             Functions& functions) const {
    const WatchedEvent& event = events_[i];
    return event.rests ? std::max(event.floor, functions.rounding(i, t, state)) : event.floor;
}

double EventSearch::value_at(const Step& step, std::size_t i, double t) {
    step.dense(&t, 1, at_.data());
    return step.functions.value(i, t, at_.data());
}

void EventSearch::begin(double t, const double* state, Functions& functions) {
    start_ = t;
    for (std::size_t i = 0; i < events_.size(); ++i) values_[i] = functions.value(i, t, state);
    for (std::size_t i = 0; i < events_.size(); ++i)
        signs_[i] = events_[i].departs
                        ? 0.0 : sign_above(values_[i], floor_at(i, t, state, functions));
}

std::optional<EventSearch::Stop> EventSearch::after_step(double t, double t_new, const double* end,
                                                         const States& nodes, const States& dense,
                                                         Functions& functions) {
    const Step step{dense, functions};
    const std::size_t inside = fractions_.size();
    for (std::size_t k = 0; k < inside; ++k) inside_[k] = t + fractions_[k] * (t_new - t);
    inside_[inside] = t_new;
    nodes(inside_.data(), inside, x_.data());
    std::copy_n(end, nx_, x_.data() + inside * nx_);
    found_.clear();
    for (std::size_t i = 0; i < events_.size(); ++i) {
        nodes_.assign(1, {t, values_[i]});
        for (std::size_t k = 0; k <= inside; ++k)
            nodes_.push_back({inside_[k], functions.value(i, inside_[k], x_.data() + k * nx_)});
        std::optional<Node> early;
        if (events_[i].departs && t == start_ && events_[i].counts(nodes_[1].value > 0.0))
            early = departing(step, i);
        const double last = nodes_.back().value;
        add_vertices(step, i);
        if (early) {
            nodes_[0] = *early;
            nodes_.erase(std::remove_if(nodes_.begin() + 1, nodes_.end(),
                                        [&](const Node& node) { return node.t <= early->t; }),
                         nodes_.end());
        }
        add_zeros(step, i, floor_at(i, t_new, end, functions));
        values_[i] = last;
    }
    if (found_.empty()) return {};
    std::sort(found_.begin(), found_.end());
    return record(dense, same_time(t, t_new));
}

// A node between the first two where the value still has the sign with which it departs, if it
// returns to zero that soon.
std::optional<EventSearch::Node> EventSearch::departing(const Step& step, std::size_t i) {
    const double t = nodes_[0].t, after = nodes_[1].t, value = nodes_[1].value;
    const std::size_t halvings = constants_.max_halvings;
    std::vector<double> at(halvings), x(halvings * nx_);
    for (std::size_t k = 0; k < halvings; ++k)
        at[k] = t + (after - t) * std::ldexp(1.0, -static_cast<int>(k + 1));
    step.dense(at.data(), halvings, x.data());
    for (std::size_t k = 0; k < halvings; ++k) {
        const double now = step.functions.value(i, at[k], x.data() + k * nx_);
        if (now * value < 0.0) {
            signs_[i] = std::copysign(1.0, now);
            return Node{at[k], now};
        }
    }
    return {};
}

// Adds the vertices of parabolas through three nodes, equally spaced, that come near zero.
void EventSearch::add_vertices(const Step& step, std::size_t i) {
    const std::size_t count = nodes_.size();
    for (std::size_t k = 0; k + 2 < count; ++k) {
        double a = nodes_[k].value, b = nodes_[k + 1].value, c = nodes_[k + 2].value;
        if (b < 0.0) a = -a, b = -b, c = -c;
        const double curvature = 0.5 * (a + c) - b;
        if (!(a > 0.0 && b > 0.0 && c > 0.0 && curvature > 0.0)) continue;
        const double vertex = -0.25 * (c - a) / curvature;
        const double lowest = b - curvature * (vertex * vertex);
        if (std::abs(vertex) < 1.0 && vertex != 0.0 &&
            lowest < constants_.vertex_value * std::min({a, b, c})) {
            const double t = nodes_[k + 1].t, at = t + vertex * (nodes_[k + 2].t - t);
            nodes_.push_back({at, value_at(step, i, at)});
        }
    }
    if (nodes_.size() > count)
        std::sort(nodes_.begin(), nodes_.end(), [](const Node& a, const Node& b) {
            return std::make_pair(a.t, a.value) < std::make_pair(b.t, b.value);
        });
}

// Adds the times at which event i occurs, given its values at the nodes; those up to `floor` are
// zero.
void EventSearch::add_zeros(const Step& step, std::size_t i, double floor) {
    const WatchedEvent& event = events_[i];
    double earliest = -infinity;
    if (nodes_[0].t == start_ && !event.departs)
        earliest = start_ + (std::isnan(event.start_tolerance) ? same_time(start_, nodes_.back().t)
                                                               : event.start_tolerance);
    double before = signs_[i];
    signs_[i] = sign_above(nodes_.back().value, floor);
    for (std::size_t k = 1; k < nodes_.size(); ++k) {
        const Node left = nodes_[k - 1], right = nodes_[k];
        const double now = sign_above(right.value, floor);
        if (now != before && before != 0.0) {
            const double zero = now == 0.0 ? right.t : zero_between(step, i, left, right);
            if (zero > earliest && event.counts(before < 0.0)) found_.push_back({zero, i});
        } else if (now != before && event.rests && event.counts(now > 0.0)) {
            found_.push_back({end_of_rest(step, i, left.t, right.t, floor), i});
        }
        before = now;
    }
}

// The time between `rests` and `left` at which the value leaves zero.
double EventSearch::end_of_rest(const Step& step, std::size_t i, double rests, double left,
                                double floor) {
    for (int k = 0; k < constants_.max_bisections; ++k) {
        const double middle = 0.5 * (rests + left);
        (std::abs(value_at(step, i, middle)) <= floor ? rests : left) = middle;
    }
    return left;
}

// The zero between two values of opposite sign, to round-off, by Brent's method; it ends where the
// next step must be below rounding because the last ones shrank so fast.
double EventSearch::zero_between(const Step& step, std::size_t i, Node left, Node right) {
    double a = left.t, b = right.t, at = b, steps[2] = {infinity, infinity};
    const bool rising = right.value > 0.0;
    const double length = b - a;
    const double precision = epsilon * (length + std::max(std::abs(a), std::abs(b)));
    Node points[3] = {left, right};
    int count = 2;
    for (int k = 0; k < constants_.max_root_steps; ++k) {
        double next = interpolated_zero(points, count);
        double length_of_step = std::abs(next - at);
        bool interpolated = a < next && next < b;
        if (length_of_step <= precision && !interpolated) {
            // Rounding places it on an end of the bracket, which is the zero up to rounding.
            next = std::min(std::max(next, a), b);
            interpolated = true;
        } else {
            interpolated = interpolated && length_of_step < 0.5 * steps[0];
        }
        if (!interpolated) {
            next = 0.5 * (a + b);
            length_of_step = std::abs(next - at);
        }
        const bool fast = length_of_step < constants_.converged_step * length &&
                          length_of_step < constants_.fast_convergence * steps[1];
        const bool last =
            b - a <= precision || (interpolated && (length_of_step <= precision || fast));
        const double value = value_at(step, i, next);
        at = next;
        if (value == 0.0) return next;
        if (last) {
            // Of the times beside it the nearest.
            const Node two[2] = {points[count - 1], {next, value}};
            double beside[3];
            std::size_t n = 0;
            for (double x : {interpolated_zero(two, 2), std::nextafter(next, a),
                             std::nextafter(next, b)})
                if (x != next && a <= x && x <= b) beside[n++] = x;
            std::vector<double> states(n * nx_);
            step.dense(beside, n, states.data());
            double best = std::abs(value);
            for (std::size_t j = 0; j < n; ++j) {
                const double found =
                    std::abs(step.functions.value(i, beside[j], states.data() + j * nx_));
                if (found < best) best = found, next = beside[j];
            }
            return next;
        }
        ((value > 0.0) == rising ? b : a) = next;
        if (count == 3) points[0] = points[1], points[1] = points[2], count = 2;
        points[count++] = {next, value};
        steps[0] = steps[1];
        steps[1] = length_of_step;
    }
    return 0.5 * (a + b);
}

std::optional<EventSearch::Stop> EventSearch::record(const States& dense, double close) {
    std::optional<Stop> stop;
    for (auto [time, i] : found_) {
        if (stop && time > stop->time + close) break;
        if (stop) {
            time = stop->time;  // of the same state, which is in at_
        } else {
            dense(&time, 1, at_.data());
        }
        times[i].push_back(time);
        states[i].insert(states[i].end(), at_.begin(), at_.end());
        const std::size_t count = times[i].size();
        const WatchedEvent& event = events_[i];
        if (!stop && (event.acts || static_cast<double>(count) >= event.occurrences))
            stop = Stop{time, i, count};
    }
    return stop;
}

}  // namespace srm
