// Python classes of runs, their events and their records.
#include <algorithm>
#include <cmath>
#include <map>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "binding.hpp"
#include "dense.hpp"
#include "errors.hpp"
#include "event_search.hpp"
#include "interpreter.hpp"
#include "limits.hpp"
#include "linear.hpp"

namespace srm {

namespace {

bool any(const std::vector<double>& flags) {
    return std::any_of(flags.begin(), flags.end(), [](double flag) { return flag != 0.0; });
}

// A view of `values`, which `owner` keeps alive.
template <typename Values>
nb::object view(const Values& values, std::initializer_list<std::size_t> shape, nb::handle owner) {
    return nb::cast(nb::ndarray<nb::numpy, double>(const_cast<double*>(values.data()), shape.size(),
                                                   shape.begin(), owner));
}

// Dense output of one step, from copies of its numbers; without neighbours and zone.
struct PyStepDense {
    System& system;
    std::vector<double> times, states, rates, corrections, sigmas, end_rate;
    DenseOutput dense;
    std::size_t nx;

    PyStepDense(System& system_, const StepResult& r, double t_new, std::vector<double> start,
                const SchemeDense& scheme, const DenseConstants& constants)
        : system(system_),
          times{r.t, t_new},
          states(std::move(start)),
          rates(r.rates),
          corrections(r.correction),
          sigmas(r.sigmas),
          end_rate(r.end_rate),
          dense(system.nq, system.nv, {scheme}, constants, arrays(r)),
          nx(r.state.size()) {}

    nb::object at(const Array& t) {
        const std::size_t k = t.size();
        std::vector<double> out(k * nx);
        dense.states(system, t.data(), static_cast<long>(k), out.data());
        return owned_array(std::move(out), {k, nx});
    }

private:
    StepArrays arrays(const StepResult& r) {
        states.insert(states.end(), r.state.begin(), r.state.end());
        StepArrays out;
        out.count = 1;
        out.end = times[1];
        out.width = static_cast<int>(r.sigmas.size());
        out.corrected = !corrections.empty();
        out.times = times.data();
        out.states = states.data();
        out.rates = rates.data();
        out.corrections = corrections.data();
        out.sigmas = sigmas.data();
        out.end_rate = end_rate.data();
        out.in_zone.assign(1, 0);
        out.stiff.assign(1, 0);
        return out;
    }
};

// Arrays (size,) for functions of the user, which may keep them and write to them: the next row of a
// block, because an array of its own costs ten times as much.  With the interpreter's lock held.
class ArgumentRows {
public:
    // Those of all callers; never deleted, because the interpreter may end first.
    static ArgumentRows& of(int size) {
        static auto& all = *new std::map<int, ArgumentRows>;
        return all.try_emplace(size, size).first->second;
    }

    explicit ArgumentRows(int size) : size_(static_cast<std::size_t>(size)), taken_(many) {}

    nb::object next(const double* numbers) {
        if (taken_ == many) {
            std::vector<double> values(many * size_);
            double* const first = values.data();
            nb::object block = owned_array(std::move(values), {many, size_});
            // Now, because that may collect garbage, whose finalizers may come here.
            first_ = first;
            block_ = std::move(block);
            taken_ = 0;
        }
        std::copy_n(numbers, size_, first_ + taken_ * size_);
        return nb::steal(PySequence_GetItem(block_.ptr(), static_cast<Py_ssize_t>(taken_++)));
    }

private:
    static constexpr std::size_t many = 64;
    std::size_t size_, taken_;
    double* first_ = nullptr;
    nb::object block_;
};

// An EventFunction of a mechanism, which `event` is, and its owner keeps alive.
class CalledEvent {
public:
    CalledEvent(nb::handle event, int nq, int nv)
        : event_(event), function_(event.attr("function").attr("function")),
          q_(ArgumentRows::of(nq)), v_(ArgumentRows::of(nv)), nq_(nq) {}

    // The value at t and a state (nx,); raises what EventFunction raises.
    double value(double t, const double* state) {
        const nb::object time = nb::float_(t), q = q_.next(state), v = v_.next(state + nq_);
        PyObject* const arguments[] = {nullptr, time.ptr(), q.ptr(), v.ptr()};
        const nb::object found = nb::steal(PyObject_Vectorcall(
            function_.ptr(), arguments + 1, 3 | PY_VECTORCALL_ARGUMENTS_OFFSET, nullptr));
        if (!found.is_valid()) {
            nb::python_error error;
            if (!error.matches(PyExc_Exception)) throw error;
            // None where no line of Python ran, as with a wrong number of arguments.
            if (error.traceback().is_valid())
                PyException_SetTraceback(error.value().ptr(), error.traceback().ptr());
            event_.attr("fail")(error.value(), t);
            throw error;
        }
        if (PyFloat_Check(found.ptr())) {
            const double value = PyFloat_AS_DOUBLE(found.ptr());
            if (std::isfinite(value)) return value;
        }
        return nb::cast<double>(event_.attr("number")(found, t));
    }

private:
    nb::handle event_, function_;
    ArgumentRows &q_, &v_;
    int nq_;
};

// Values of an event at several times and states (k, nx).
std::vector<double> event_values(nb::handle event, int nq, const std::vector<double>& times,
                                 const Array& states) {
    const std::size_t k = times.size(), nx = states.ndim() == 2 ? states.shape(1) : 0;
    if (states.ndim() != 2 || states.shape(0) != k || static_cast<int>(nx) < nq)
        throw nb::value_error("times and states do not fit");
    CalledEvent called(event, nq, static_cast<int>(nx) - nq);
    std::vector<double> out(k);
    for (std::size_t i = 0; i < k; ++i) out[i] = called.value(times[i], states.data() + i * nx);
    return out;
}

// Finds the events of a mechanism: EventWatch of events.py.
struct PyEventWatch final : EventSearch::Functions {
    nb::object events, read_nodes;  // kept alive
    std::vector<CalledEvent> called;
    std::size_t nx;
    EventSearch search;

    // events: a tuple of EventFunctions.  read_nodes: (dense, times) -> states at the times at which
    // a step is examined, by the dense output of the reference.
    PyEventWatch(nb::object events_, nb::object read_nodes_, int nq, int nv, nb::handle fractions,
                 const EventConstants& constants)
        : events(std::move(events_)),
          read_nodes(std::move(read_nodes_)),
          nx(static_cast<std::size_t>(nq + nv)),
          search(watched(events), to_vector(fractions), constants, nx) {
        for (const nb::handle event : events) called.emplace_back(event, nq, nv);
    }

    static std::vector<WatchedEvent> watched(const nb::object& events) {
        std::vector<WatchedEvent> out;
        for (const nb::handle event : events) {
            const nb::object tolerance = event.attr("start_tolerance");
            const auto number = [&](const char* name) { return nb::cast<double>(event.attr(name)); };
            const auto flag = [&](const char* name) { return nb::cast<bool>(event.attr(name)); };
            out.push_back({number("occurrences"), number("direction"), number("floor"),
                           tolerance.is_none() ? not_a_number : nb::cast<double>(tolerance),
                           flag("acts"), flag("departs"), !event.attr("rests").is_none()});
        }
        return out;
    }

    double value(std::size_t event, double t, const double* state) override {
        return called[event].value(t, state);
    }

    double rounding(std::size_t event, double t, const double* state) override {
        return nb::cast<double>(
            events[event].attr("rests")(t, owned_array(std::vector<double>(state, state + nx))));
    }

    void begin(double t, nb::handle state) {
        search.begin(t, numbers(state, static_cast<int>(nx), "state").data(), *this);
    }

    // The step from t to t_new, which ends with `end`.  Its dense output is `compiled`, if there is
    // one and it can be evaluated, or `reference`.  (time, event, count) of the occurrence that ends
    // the run, and its state, or None.
    nb::object after_step(double t, double t_new, nb::handle end, PyStepDense* compiled,
                          nb::object reference) {
        const auto states_by = [&](auto&& by_reference) {
            return [&, by_reference](const double* times, std::size_t k, double* out) {
                if (compiled) try {
                    compiled->dense.states(compiled->system, times, static_cast<long>(k), out);
                    return;
                } catch (const EvaluationError&) {
                    // The reference raises the error that says why.
                }
                const nb::object at = owned_array(std::vector<double>(times, times + k));
                const auto found = nb::cast<Array>(by_reference(at));
                if (found.size() != k * nx) throw nb::value_error("states has another shape");
                std::copy_n(found.data(), k * nx, out);
            };
        };
        const auto stop = search.after_step(
            t, t_new, numbers(end, static_cast<int>(nx), "end").data(),
            states_by([&](const nb::object& at) { return read_nodes(reference, at); }),
            states_by([&](const nb::object& at) { return reference(at); }), *this);
        if (!stop) return nb::none();
        const std::vector<double>& states = search.states[stop->event];
        return nb::make_tuple(stop->time, stop->event, stop->count,
                              owned_array(std::vector<double>(states.end() - nx, states.end())));
    }

    // Times (k,) and states (k, nx) of the occurrences, for each event; those without any are given.
    nb::tuple found(const nb::object& no_times, const nb::object& no_states) const {
        nb::list times, states;
        for (std::size_t i = 0; i < called.size(); ++i) {
            const std::size_t k = search.times[i].size();
            times.append(k ? owned_array(search.times[i]) : no_times);
            states.append(k ? owned_array(search.states[i], {k, nx}) : no_states);
        }
        return nb::make_tuple(times, states);
    }
};

struct PyRun {
    nb::object system;  // kept alive
    System& s;
    std::unique_ptr<Run> run;
    const BranchGuard* guard = nullptr;

    // stiff: the scheme where the problem is stiff, if it is another.  first_step: of step-size
    // control (s); 0: what the start allows.
    PyRun(nb::object system_, const ButcherTableau& scheme, const ButcherTableau* stiff,
          const Constants& constants, const ErrorNorm& norm, const IntegratorState& memory,
          const Array& state, const SmoothIntervals& intervals, const RunOptions& options,
          double t0, double first_step)
        : system(std::move(system_)), s(system_in(system)) {
        expect_size("ErrorNorm.atol", norm.atol.size(), 2 * static_cast<std::size_t>(s.nv));
        check(memory);
        std::vector<double> start = checked_state(state);
        auto control = make_control(scheme, stiff ? *stiff : scheme, constants, norm, memory,
                                    start, intervals, options, t0, first_step);
        if (stiff && stiff->stages() != scheme.stages())
            throw nb::value_error("the schemes have other numbers of stages");
        run = std::make_unique<Run>(s, SplitStep(s, scheme, constants, norm), stiff,
                                    std::move(control), memory, std::move(start), intervals,
                                    options, t0);
    }

    std::unique_ptr<Control> make_control(const ButcherTableau& scheme,
                                          const ButcherTableau& stiff, const Constants& constants,
                                          const ErrorNorm& norm, const IntegratorState& memory,
                                          const std::vector<double>& start,
                                          const SmoothIntervals& intervals,
                                          const RunOptions& options, double t0,
                                          double first_step) {
        const double t_end = intervals.ends.back();
        std::unique_ptr<Control> control;
        if (options.step > 0.0) {
            control = std::make_unique<FixedStep>(t0, t_end, options.step, constants);
        } else {
            double first = first_step;
            if (!(first > 0.0))
                first = initial_step(s, norm, t0, start.data(), memory.rate.data(),
                                     memory.state_scale.data(), t_end - t0,
                                     scheme.controller_order, constants,
                                     intervals.ends.front() - t0);
            control = std::make_unique<PIControl>(t_end, first, scheme.controller_order,
                                                  stiff.controller_order, constants);
        }
        if (!s.constrained()) return control;
        if (options.placement != "automatic")
            return std::make_unique<SlopeOfSigma>(std::move(control), scheme, stiff);
        control = std::make_unique<SingularityPlacement>(std::move(control), scheme, stiff, t_end,
                                                         constants, options.arrivals,
                                                         s.sigma_scatters());
        auto outer = std::make_unique<BranchGuard>(std::move(control), s, constants);
        guard = outer.get();
        return outer;
    }

    void check(const IntegratorState& memory) const {
        expect_size("IntegratorState.rate", memory.rate.size(), 2 * static_cast<std::size_t>(s.nv));
        if (memory.history && !s.constrained())
            throw nb::value_error("IntegratorState.history is for mechanisms with closures");
    }

    std::vector<double> checked_state(const Array& state) const {
        vector_of(state, s.nq + s.nv, "state");
        return to_vector(state);
    }

    int advance(long steps, double seconds) {
        const WithoutLock released;
        return static_cast<int>(run->advance(steps, seconds));
    }

    // One attempt from another state: (stop, decision), decision -1 if none was made.
    nb::tuple attempt_from(double t, const Array& state, const IntegratorState& memory,
                           const ControlState& control) {
        check(memory);
        run->resume(t, checked_state(state), memory, control);
        StepDecision decision = static_cast<StepDecision>(-1);
        const Stop stop = run->attempt(decision);
        return nb::make_tuple(static_cast<int>(stop), static_cast<int>(decision));
    }

    // Goes on to `end`; `force` (nv,) acts from here, or, if None, the force held before.  See
    // Run::go_on.
    int go_on(double end, double first, double last, nb::handle force, bool forces_jump,
              double grid, double seconds) {
        if (!force.is_none()) {
            const Array array = nb::cast<Array>(force);
            if (static_cast<int>(array.size()) != s.nv || array.ndim() != 1 ||
                !finite(array.data(), s.nv))
                throw nb::value_error("not nv finite forces");
            if (!s.holds(array.data())) {
                s.hold(run->t(), array.data(), false);
                forces_jump = true;
            }
        }
        const WithoutLock released;
        return static_cast<int>(run->go_on(end, first, last, forces_jump, grid, seconds));
    }

    void restore(const RunSnapshot& snapshot) {
        check(snapshot.memory);
        expect_size("RunSnapshot.state", snapshot.state.size(), run->state.size());
        run->restore(snapshot);
    }

    void remember(const IntegratorState& memory) {
        check(memory);
        run->memory = memory;
    }

    // See Run::end_at().
    bool end_at(double t, const Array& state, double end, double time_unit, double reach) {
        return run->end_at(t, checked_state(state), end, time_unit, reach);
    }

    // Passages next to critical configurations: (time, residual, avoided, resolved).
    nb::list examined() const {
        nb::list out;
        for (const ExaminedPassage& one : run->examined)
            out.append(nb::make_tuple(one.time, one.residual, one.avoided, one.resolved));
        return out;
    }

    // Accepted, rejected and zone steps since the start.
    nb::tuple totals() const {
        long rejected = run->rejected_before;
        for (const Attempt& a : run->attempts) rejected += a.decision == StepDecision::rejected;
        return nb::make_tuple(run->steps_before + run->records.count(), rejected,
                              run->zones_before + static_cast<long>(run->records.zones.size()));
    }

    // Dense output of the step made last, which began at `start` and used no zone.
    PyStepDense* step_dense(const Array& start, const SchemeDense& scheme,
                            const DenseConstants& constants) const {
        return new PyStepDense(s, run->last(), run->t(), checked_state(start), scheme, constants);
    }

    // The records since the start `state` at `t0`; the run has none any more.
    PyRecords take_records(double t0, const Array& state) {
        const std::vector<double> start = checked_state(state);
        PyRecords out;
        out.records = std::move(run->records);
        run->records.clear();
        out.records.times.insert(out.records.times.begin(), t0);
        out.records.states.insert(out.records.states.begin(), start.begin(), start.end());
        out.end_rate = run->end_rate;
        out.nx = start.size();
        out.n = 2 * static_cast<std::size_t>(s.nv);
        out.stages = static_cast<std::size_t>(run->step.scheme.stages()) + 1;
        out.corrected = s.constrained() ? out.n : 0;
        return out;
    }

    // The history of the zone of the step made last; None without one.
    std::optional<MultiplierHistory> last_history() const {
        if (!run->last().in_zone) return {};
        // Of an accepted step it is in the records; that of another one is still the memory's.
        const auto& zones = run->records.zones;
        const bool recorded = !zones.empty() && zones.back().step == run->records.count() - 1;
        return recorded ? zones.back().history : run->memory.history;
    }

    nb::list attempts() const {
        nb::list out;
        for (const Attempt& a : run->attempts)
            out.append(nb::make_tuple(a.t, a.h, a.error_ratio, static_cast<int>(a.decision)));
        return out;
    }

    std::vector<double> suspect_times() const {
        return guard ? guard->suspect_times : std::vector<double>{};
    }
};

}  // namespace

void bind_run(nb::module_& m) {
    nb::class_<StepResult>(m, "StepResult")
        .def_ro("t", &StepResult::t)
        .def_ro("h", &StepResult::h)
        .def_ro("error_ratio", &StepResult::error_ratio)
        .def_ro("residual", &StepResult::residual)
        .def_ro("rank", &StepResult::rank)
        .def_ro("quiet", &StepResult::quiet)
        .def_ro("held", &StepResult::held)
        .def_ro("stiff", &StepResult::stiff)
        .def_ro("in_zone", &StepResult::in_zone)
        .def_ro("critical", &StepResult::critical)
        .def_ro("zone_threshold", &StepResult::zone_threshold)
        .def_prop_ro("state", [](const StepResult& r) { return owned_array(r.state); })
        .def_prop_ro("rates", [](const StepResult& r) {
            return owned_array(r.rates, {r.sigmas.size(), r.end_rate.size()});
        })
        .def_prop_ro("end_rate", [](const StepResult& r) { return owned_array(r.end_rate); })
        .def_prop_ro("correction", [](const StepResult& r) { return owned_array(r.correction); })
        .def_prop_ro("state_scale", [](const StepResult& r) { return owned_array(r.state_scale); })
        .def_prop_ro("sigmas", [](const StepResult& r) { return owned_array(r.sigmas); });

    nb::class_<ZoneRecord>(m, "ZoneRecord")
        .def_ro("step", &ZoneRecord::step)
        .def_ro("threshold", &ZoneRecord::threshold)
        .def_ro("history", &ZoneRecord::history);

    // Arrays of (steps + 1), (steps,) or (breaks,) rows.
    nb::class_<PyRecords> records(m, "StepRecords");
    const auto array = [&records](const char* name, auto values, auto columns) {
        records.def_prop_ro(name, [values, columns](nb::handle self) {
            const PyRecords& r = *nb::inst_ptr<PyRecords>(self);
            return columns(r, r.records.*values, self);
        });
    };
    const auto flat = [](const PyRecords&, const auto& values, nb::handle self) {
        return view(values, {values.size()}, self);
    };
    // Of `size` columns each, also without rows.
    const auto matrix = [](auto size, bool start) {
        return [size, start](const PyRecords& r, const std::vector<double>& values,
                             nb::handle self) {
            return view(values, {r.records.ranks.size() + start, r.*size}, self);
        };
    };
    array("times", &StepRecords::times, flat);
    array("states", &StepRecords::states, matrix(&PyRecords::nx, true));
    array("rates", &StepRecords::rates,
          [](const PyRecords& r, const auto& values, nb::handle self) {
              return view(values, {r.records.ranks.size(), r.stages, r.n}, self);
          });
    array("corrections", &StepRecords::corrections, matrix(&PyRecords::corrected, false));
    array("sigmas", &StepRecords::sigmas, matrix(&PyRecords::stages, false));
    array("breaks", &StepRecords::breaks, flat);
    array("break_rates", &StepRecords::break_rates,
          [](const PyRecords& r, const std::vector<double>& values, nb::handle self) {
              return view(values, {r.records.breaks.size(), r.n}, self);
          });
    // Rows: ranks, error ratios, placements, held, stiff.
    records.def_prop_ro("numbers", [](const PyRecords& self) {
        const StepRecords& r = self.records;
        std::vector<double> out;
        for (const auto* values : {&r.ranks, &r.error_ratios, &r.placements, &r.held, &r.stiff})
            out.insert(out.end(), values->begin(), values->end());
        return owned_array(std::move(out), {5, r.ranks.size()});
    });
    records
        .def_prop_ro("span",
                     [](const PyRecords& r) {
                         return nb::make_tuple(r.records.times.front(), r.records.times.back());
                     })
        // StepSummary of driver.py.
        .def_prop_ro("steps", [](const PyRecords& r) { return r.records.ranks.size(); })
        .def_prop_ro("zone_steps", [](const PyRecords& r) { return r.records.zones.size(); })
        .def_prop_ro("least_sigma",
                     [](const PyRecords& r) {
                         double least = infinity;
                         for (double sigma : r.records.sigmas)
                             if (sigma < least) least = sigma;
                         return least;
                     })
        .def_prop_ro("held", [](const PyRecords& r) { return any(r.records.held); })
        .def_prop_ro("stiff", [](const PyRecords& r) { return any(r.records.stiff); })
        .def_prop_ro("break_count", [](const PyRecords& r) { return r.records.breaks.size(); })
        // Whether dense output needs no more than the records: there are steps, but no breakpoint
        // and no zone, and no step past a critical configuration.
        .def_prop_ro("plain",
                     [](const PyRecords& r) {
                         const StepRecords& s = r.records;
                         const auto& placed = s.placements;
                         return !s.ranks.empty() && s.breaks.empty() && s.zones.empty() &&
                                std::count(placed.begin(), placed.end(), s.critical) == 0;
                     })
        .def_prop_ro("end_rate", [](const PyRecords& r) { return owned_array(r.end_rate); })
        .def_prop_ro("zones", [](const PyRecords& r) { return r.records.zones; });

    nb::class_<PyStepDense>(m, "StepDense").def("__call__", &PyStepDense::at);

    m.def("event_values", &event_values);
    nb::class_<PyEventWatch>(
        m, "EventWatch",
        nb::type_slots(
            collected<PyEventWatch, &PyEventWatch::events, &PyEventWatch::read_nodes>()))
        .def(nb::init<nb::object, nb::object, int, int, nb::handle, const EventConstants&>(),
             nb::arg("events"), nb::arg("read_nodes"), nb::arg("nq"), nb::arg("nv"),
             nb::arg("fractions"), nb::arg("constants"))
        .def("begin", &PyEventWatch::begin)
        .def("after_step", &PyEventWatch::after_step, nb::arg("t"), nb::arg("t_new"),
             nb::arg("end"), nb::arg("compiled").none(), nb::arg("reference"))
        .def("found", &PyEventWatch::found);

    nb::class_<PyRun>(m, "Run", nb::type_slots(collected<PyRun, &PyRun::system>()))
        .def(nb::init<nb::object, const ButcherTableau&, const ButcherTableau*, const Constants&,
                      const ErrorNorm&, const IntegratorState&, const Array&,
                      const SmoothIntervals&, const RunOptions&, double, double>(),
             nb::arg("system"), nb::arg("scheme"), nb::arg("stiff").none(), nb::arg("constants"),
             nb::arg("norm"), nb::arg("memory"), nb::arg("state"), nb::arg("intervals"),
             nb::arg("options"), nb::arg("t0"), nb::arg("first_step"), nb::keep_alive<1, 3>(),
             nb::keep_alive<1, 4>(), nb::keep_alive<1, 5>(), nb::keep_alive<1, 6>(),
             nb::keep_alive<1, 10>())
        .def("advance", &PyRun::advance, nb::arg("steps"), nb::arg("seconds"))
        .def("attempt_from", &PyRun::attempt_from)
        .def("go_on", &PyRun::go_on, nb::arg("end"), nb::arg("first"), nb::arg("last"),
             nb::arg("force").none(), nb::arg("forces_jump"), nb::arg("grid"), nb::arg("seconds"))
        .def("end_at", &PyRun::end_at)
        .def("enter", [](PyRun& r) { return r.run->enter(); })
        .def("snapshot", [](const PyRun& r) { return r.run->snapshot(); })
        .def("restore", &PyRun::restore)
        .def("memory", [](const PyRun& r) { return r.run->memory; })
        .def("remember", &PyRun::remember)
        .def("last", [](PyRun& r) -> StepResult& { return r.run->last(); },
             nb::rv_policy::reference_internal)
        .def("last_history", &PyRun::last_history)
        .def("step_dense", &PyRun::step_dense, nb::rv_policy::take_ownership,
             nb::keep_alive<0, 1>())
        .def("attempts", &PyRun::attempts)
        .def("examined", &PyRun::examined)
        .def("suspect_times", &PyRun::suspect_times)
        .def("totals", &PyRun::totals)
        .def("take_records", &PyRun::take_records)
        .def_prop_ro("watched_time", [](const PyRun& r) { return r.run->watched_time(); })
        .def_prop_ro("t", [](const PyRun& r) { return r.run->t(); })
        .def_prop_ro("h", [](const PyRun& r) { return r.run->last_h(); })
        .def_prop_ro("state", [](const PyRun& r) { return owned_array(r.run->state); })
        .def_prop_ro("count", [](const PyRun& r) { return r.run->records.count(); })
        .def_prop_ro("at_breakpoint", [](const PyRun& r) { return r.run->at_breakpoint(); })
        .def_prop_ro("interval", [](const PyRun& r) { return r.run->interval(); })
        .def_prop_ro("evaluation_failed", [](const PyRun& r) { return r.run->evaluation_failed; })
        .def_prop_ro("placed", [](const PyRun& r) { return r.run->control->placed; })
        .def_prop_ro("replaced", [](const PyRun& r) { return r.run->control->replaced; });
}

}  // namespace srm
