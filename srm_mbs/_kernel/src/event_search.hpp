// Zeros of functions of time and state within a step: events.py.
#pragma once

#include <cstddef>
#include <functional>
#include <optional>
#include <utility>
#include <vector>

#include "struct_fields.hpp"

namespace srm {

#define SRM_EVENT_CONSTANTS(field)                                                          \
    field(double, same_time_step)     /* times closer than this part of the step are one */ \
    field(double, same_time_rounding) /* the same, over the time itself */                  \
    field(int, max_halvings)          /* of the first part of a step, for departing events */ \
    field(int, max_bisections)        /* for the end of a rest */                           \
    field(int, max_root_steps)                                                              \
    field(double, converged_step)     /* of that search, over its first bracket */          \
    field(double, fast_convergence)   /* the same, over the step before */                  \
    field(double, vertex_value)       /* of a parabola, over the least of its three values */

struct EventConstants {
    SRM_FIELDS(SRM_EVENT_CONSTANTS)
};

// What a run needs to know of an event: EventFunction of events.py.
struct WatchedEvent {
    double occurrences, direction, floor, start_tolerance;  // start_tolerance: NaN for none
    bool acts, departs, rests;

    bool counts(bool rising) const { return direction == 0.0 || (direction > 0.0) == rising; }
};

// Finds events step by step: EventWatch.
class EventSearch {
public:
    // The functions of the events, by number, and the states (k, nx) of a step at k times.
    struct Functions {
        virtual ~Functions() = default;
        virtual double value(std::size_t event, double t, const double* state) = 0;
        virtual double rounding(std::size_t event, double t, const double* state) = 0;
    };
    using States = std::function<void(const double* t, std::size_t k, double* out)>;
    struct Stop {
        double time;
        std::size_t event, count;  // number of its occurrence
    };

    EventSearch(std::vector<WatchedEvent> events, std::vector<double> fractions,
                const EventConstants& constants, std::size_t nx);

    void begin(double t, const double* state, Functions& functions);
    // The step from t to t_new, which ends with the state `end`; `nodes` reads the states inside at
    // which it is examined, `dense` others.
    std::optional<Stop> after_step(double t, double t_new, const double* end, const States& nodes,
                                   const States& dense, Functions& functions);

    // Times (k,) and states (k, nx) of the occurrences of each event.
    std::vector<std::vector<double>> times, states;

private:
    struct Node {
        double t, value;
    };
    struct Step {
        const States& dense;
        Functions& functions;
    };
    double same_time(double t, double t_new) const;
    double floor_at(std::size_t i, double t, const double* state, Functions& functions) const;
    double value_at(const Step& step, std::size_t i, double t);
    std::optional<Node> departing(const Step& step, std::size_t i);
    void add_vertices(const Step& step, std::size_t i);
    void add_zeros(const Step& step, std::size_t i, double floor);
    double end_of_rest(const Step& step, std::size_t i, double rests, double left, double floor);
    double zero_between(const Step& step, std::size_t i, Node left, Node right);
    std::optional<Stop> record(const States& dense, double close);

    const std::vector<WatchedEvent> events_;
    const std::vector<double> fractions_;
    const EventConstants constants_;
    const std::size_t nx_;
    double start_ = 0.0;
    std::vector<double> values_, signs_;  // signs last seen; 0 after a value that was exactly zero
    std::vector<double> inside_, x_, at_;  // times and states of a step, and of a search in it
    std::vector<Node> nodes_;
    std::vector<std::pair<double, std::size_t>> found_;
};

}  // namespace srm
