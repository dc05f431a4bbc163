// Bindings: data in from Python, runs, arrays out.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "algebra.hpp"
#include "dense.hpp"
#include "errors.hpp"
#include "linear.hpp"
#include "model.hpp"
#include "run.hpp"

namespace nb = nanobind;
using namespace srm;

namespace {

using Array = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

std::vector<double> vector_of(const Array& array) {
    return std::vector<double>(array.data(), array.data() + array.size());
}

std::vector<double> vector_of(nb::handle object) {
    return object.is_none() ? std::vector<double>{} : vector_of(nb::cast<Array>(object));
}

// A NumPy array that owns `values`.
nb::object owned(std::vector<double> values, std::initializer_list<std::size_t> shape) {
    auto* kept = new std::vector<double>(std::move(values));
    nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<double>*>(p); });
    return nb::cast(nb::ndarray<nb::numpy, double>(kept->data(), shape.size(), shape.begin(), owner));
}

double number(const nb::dict& d, const char* key) { return nb::cast<double>(d[key]); }
int whole(const nb::dict& d, const char* key) { return nb::cast<int>(d[key]); }

Scheme scheme_of(const nb::dict& d) {
    Scheme out;
    out.A = vector_of(d["A"]);
    out.b = vector_of(d["b"]);
    out.c = vector_of(d["c"]);
    out.error = vector_of(d["error"]);
    out.stages = static_cast<int>(out.b.size());
    out.controller_order = whole(d, "controller_order");
    out.gap_centres = vector_of(d["gap_centres"]);
    out.gap_half_widths = vector_of(d["gap_half_widths"]);
    return out;
}

StepConstants step_constants_of(const nb::dict& d) {
    return {number(d, "watched"),      number(d, "near"),
            number(d, "far"),          number(d, "ambiguous"),
            number(d, "held"),         number(d, "rounding"),
            number(d, "usual"),        number(d, "crosses"),
            number(d, "lead"),         number(d, "most_floor"),
            number(d, "zone_largest"), number(d, "count_uncertainty_above"),
            number(d, "hit"),          whole(d, "projections"),
            whole(d, "fewest"),        whole(d, "gap_every")};
}

ControlConstants control_constants_of(const nb::dict& d) {
    return {number(d, "safety"),       number(d, "min_factor"),   number(d, "max_factor"),
            number(d, "proportional"), number(d, "integral"),     number(d, "xi_old_floor"),
            number(d, "xi_floor"),     number(d, "failed_evaluation"),
            number(d, "sigma_change"), number(d, "too_close"),    number(d, "clearance"),
            number(d, "ahead"),        whole(d, "max_redone"),    number(d, "beside"),
            number(d, "arrival_change"), number(d, "turned"),
            whole(d, "guard_max_redone")};
}

LoopConstants loop_constants_of(const nb::dict& d) {
    return {number(d, "smallest_step"), number(d, "standstill"), number(d, "large_correction"),
            number(d, "open"),          number(d, "lost"),       whole(d, "watched_steps"),
            number(d, "look"),          number(d, "closer"),        number(d, "allowed")};
}

ErrorNorm norm_of(const nb::dict& d) {
    ErrorNorm out;
    out.atol = vector_of(d["atol"]);
    out.one = vector_of(d["one"]);
    out.rtol = number(d, "rtol");
    out.negligible = number(d, "negligible");
    return out;
}

History history_of(const nb::dict& d, int nv) {
    History out;
    out.nv = nv;
    out.times = vector_of(d["times"]);
    out.values = vector_of(d["values"]);
    out.size = static_cast<int>(out.times.size());
    out.known_until = number(d, "known_until");
    out.known_below = number(d, "known_below");
    out.normals = vector_of(d["normals"]);
    out.normal_count = static_cast<int>(out.normals.size()) / nv;
    return out;
}

nb::dict dict_of(const History& h) {
    nb::dict out;
    const auto k = static_cast<std::size_t>(h.size), nv = static_cast<std::size_t>(h.nv);
    out["times"] = owned(h.times, {k});
    out["values"] = owned(h.values, {k, nv});
    out["known_until"] = h.known_until;
    out["known_below"] = h.known_below;
    // Column by column in both worlds: (k, nv) rows here are the columns there.
    out["normals"] = h.normal_count == 0
                         ? nb::none()
                         : owned(h.normals, {static_cast<std::size_t>(h.normal_count), nv});
    return out;
}

Memory memory_of(const nb::dict& d, int nv) {
    Memory out;
    out.rate = vector_of(d["rate"]);
    out.magnitude = vector_of(d["magnitude"]);
    out.sigma = number(d, "sigma");
    out.sigma_slope = number(d, "sigma_slope");
    out.steps = nb::cast<long>(d["steps"]);
    out.has_history = !d["history"].is_none();
    if (out.has_history) out.history = history_of(nb::cast<nb::dict>(d["history"]), nv);
    return out;
}

nb::dict dict_of(const Memory& m) {
    nb::dict out;
    out["rate"] = owned(m.rate, {m.rate.size()});
    out["magnitude"] = owned(m.magnitude, {m.magnitude.size()});
    out["sigma"] = m.sigma;
    out["sigma_slope"] = m.sigma_slope;
    out["steps"] = m.steps;
    out["history"] = m.has_history ? nb::object(dict_of(m.history)) : nb::none();
    return out;
}

ControlState control_of(const nb::dict& d) {
    ControlState c;
    c.h = number(d, "h");
    c.xi_old = number(d, "xi_old");
    c.just_rejected = nb::cast<bool>(d["just_rejected"]);
    c.index = nb::cast<long>(d["index"]);
    c.slope = number(d, "slope");
    c.zero = number(d, "zero");
    c.redo = number(d, "redo");
    c.redone = whole(d, "redone");
    c.limit = number(d, "limit");
    c.tries = whole(d, "tries");
    c.arrival = whole(d, "arrival");
    return c;
}

nb::dict dict_of(const ControlState& c) {
    nb::dict out;
    out["h"] = c.h;
    out["xi_old"] = c.xi_old;
    out["just_rejected"] = c.just_rejected;
    out["index"] = c.index;
    out["slope"] = c.slope;
    out["zero"] = c.zero;
    out["redo"] = c.redo;
    out["redone"] = c.redone;
    out["limit"] = c.limit;
    out["tries"] = c.tries;
    out["arrival"] = c.arrival;
    return out;
}

// The velocity components that move one body against another.
void take_support(const nb::dict& d, std::vector<int>& columns, std::vector<double>& signs) {
    const std::vector<double> support = vector_of(d["support"]);
    for (std::size_t j = 0; j < support.size(); ++j) {
        if (support[j] == 0.0) continue;
        columns.push_back(static_cast<int>(j));
        signs.push_back(support[j]);
    }
}

Held held_of(nb::handle item) {
    const auto pair = nb::cast<nb::tuple>(item);
    Held out;
    out.joint = nb::cast<int>(pair[0]);
    const std::vector<double> placement = vector_of(pair[1]);
    std::copy_n(placement.begin(), 12, out.placement);
    return out;
}

Curve curve_of(const nb::dict& d) {
    return {vector_of(d["breaks"]), vector_of(d["pieces"]), vector_of(d["sines"])};
}

ForceElement force_of(const nb::dict& d) {
    ForceElement out;
    out.kind = static_cast<ForceKind>(whole(d, "kind"));
    if (d.contains("a")) out.a = held_of(d["a"]);
    if (d.contains("b")) out.b = held_of(d["b"]);
    if (d.contains("support")) take_support(d, out.columns, out.signs);
    if (d.contains("stiffness")) out.stiffness = number(d, "stiffness");
    if (d.contains("damping")) out.damping = number(d, "damping");
    if (d.contains("rest")) out.rest = number(d, "rest");
    if (d.contains("in_q")) out.in_q = whole(d, "in_q");
    if (d.contains("in_v")) out.in_v = whole(d, "in_v");
    if (d.contains("turns")) out.turns = nb::cast<bool>(d["turns"]);
    if (d.contains("numbers")) out.numbers = vector_of(d["numbers"]);
    if (d.contains("curves"))
        for (nb::handle curve : nb::cast<nb::list>(d["curves"]))
            out.curves.push_back(curve_of(nb::cast<nb::dict>(curve)));
    return out;
}

struct PySystem {
    nb::object model, controller;  // kept alive
    std::unique_ptr<System> system;

    PySystem(nb::object model_, const nb::dict& d, nb::object controller_)
        : model(model_), controller(controller_) {
        const void* found = model_in(model.ptr());
        if (!found) throw nb::type_error("not a pinocchio.Model");
        SystemData data;
        for (nb::handle item : nb::cast<nb::list>(d["loops"])) {
            const nb::dict loop = nb::cast<nb::dict>(item);
            LoopRows rows;
            rows.joint_a = whole(loop, "joint_a");
            rows.joint_b = whole(loop, "joint_b");
            const std::vector<double> a = vector_of(loop["at_a"]), b = vector_of(loop["at_b"]);
            std::copy_n(a.begin(), 3, rows.at_a);
            std::copy_n(b.begin(), 3, rows.at_b);
            rows.directions = vector_of(loop["directions"]);
            rows.distances = vector_of(loop["distances"]);
            rows.alignments = vector_of(loop["alignments"]);
            take_support(loop, rows.columns, rows.signs);
            rows.first_row = whole(loop, "first_row");
            data.loops.push_back(std::move(rows));
        }
        for (nb::handle item : nb::cast<nb::list>(d["joint_rows"])) {
            const nb::dict row = nb::cast<nb::dict>(item);
            data.joint_rows.push_back({whole(row, "row"), vector_of(row["coefficients"]),
                                       nb::cast<std::vector<int>>(row["in_q"]),
                                       nb::cast<std::vector<int>>(row["in_v"]),
                                       number(row, "offset")});
        }
        for (nb::handle item : nb::cast<nb::list>(d["eliminations"])) {
            const auto e = nb::cast<nb::tuple>(item);
            data.eliminations.push_back({nb::cast<int>(e[0]), nb::cast<int>(e[1]),
                                         nb::cast<double>(e[2]),
                                         nb::cast<std::vector<int>>(e[3])});
        }
        for (nb::handle item : nb::cast<nb::list>(d["drives"])) {
            const nb::dict drive = nb::cast<nb::dict>(item);
            data.drives.push_back({whole(drive, "row"), number(drive, "factor"),
                                   whole(drive, "in_q"), whole(drive, "in_v"),
                                   nb::cast<bool>(drive["wound"]),
                                   curve_of(nb::cast<nb::dict>(drive["curve"]))});
        }
        data.rows = whole(d, "rows");
        data.structural_rank = whole(d, "structural_rank");
        data.sigma_ref = number(d, "sigma_ref");
        data.algebra = nb::cast<std::string>(d["algebra"]);
        data.order = nb::cast<std::vector<int>>(d["order"]);
        data.pivot_share = number(d, "pivot_share");
        data.pivot_window = whole(d, "pivot_window");
        data.gap_scale = vector_of(d["gap_scale"]);
        data.unit = vector_of(d["unit"]);
        data.position_of = nb::cast<std::vector<int>>(d["position_of"]);
        data.damping = vector_of(d["damping"]);
        data.friction = vector_of(d["friction"]);
        data.friction_speed = number(d, "friction_speed");
        for (nb::handle item : nb::cast<nb::list>(d["forces"]))
            data.forces.push_back(force_of(nb::cast<nb::dict>(item)));
        data.coincident = number(d, "coincident");
        for (nb::handle item : nb::cast<nb::list>(d["groups"])) {
            const auto group = nb::cast<nb::tuple>(item);
            const auto name = nb::cast<std::string>(group[0]);
            data.groups.push_back({name == "so3"   ? Group::so3
                                   : name == "se3" ? Group::se3
                                                   : Group::se2,
                                   nb::cast<int>(group[1]), nb::cast<int>(group[2]),
                                   nb::cast<int>(group[3])});
        }
        data.series = vector_of(d["series"]);
        data.turning = nb::cast<std::vector<int>>(d["turning"]);
        data.largest_rotation = number(d, "largest_rotation");
        data.farthest_node = number(d, "farthest_node");
        data.rotation_per_step = number(d, "rotation_per_step");
        Controller act;
        if (!controller.is_none()) {
            const auto call = [this](double t, const double* q, const double* v, double* tau) {
                nb::gil_scoped_acquire held;
                const auto nq = static_cast<std::size_t>(system->nq);
                const auto nv = static_cast<std::size_t>(system->nv);
                nb::object out = controller(t, owned(std::vector<double>(q, q + nq), {nq}),
                                            owned(std::vector<double>(v, v + nv), {nv}));
                const Array forces = nb::cast<Array>(out);
                std::copy_n(forces.data(), nv, tau);
            };
            act = call;
        }
        system = std::make_unique<System>(found, std::move(data), std::move(act));
    }

    // The terms of one stage, for comparison with the reference.
    nb::dict terms(double t, const Array& state, double threshold) {
        System::ZoneView zone;
        zone.threshold = threshold;
        system->evaluate(t, state.data(), zone);
        const auto n = static_cast<std::size_t>(2 * system->nv);
        nb::dict out;
        std::vector<double> rate(n), correction(n), multiplier(n / 2);
        system->rate(rate.data());
        system->correction(correction.data());
        system->multiplier(multiplier.data());
        out["rate"] = owned(rate, {n});
        out["correction"] = owned(correction, {n});
        out["multiplier"] = owned(multiplier, {n / 2});
        out["sigma"] = system->sigma();
        out["rank"] = system->rank();
        out["gap"] = system->gap();
        return out;
    }

    // Length of the first step; see initial_step.
    double first_step(double t, const Array& state, const Array& rate, const Array& magnitude,
                      const Array& atol, const Array& one, double rtol, double span, int order,
                      const nb::tuple& constants) {
        ErrorNorm norm;
        norm.atol = vector_of(atol);
        norm.one = vector_of(one);
        norm.rtol = rtol;
        return initial_step(*system, norm, t, state.data(), rate.data(), magnitude.data(), span,
                            order,
                            {nb::cast<double>(constants[0]), nb::cast<double>(constants[1]),
                             nb::cast<double>(constants[2])});
    }

    // Evaluates the stage `repeats` times: the cost of one evaluation in the loop.
    void repeat(double t, const Array& state, long repeats) {
        std::vector<double> rate(2 * system->nv);
        const double* x = state.data();
        nb::gil_scoped_release released;
        for (long i = 0; i < repeats; ++i) {
            system->evaluate(t, x, System::ZoneView{});
            system->rate(rate.data());
        }
    }

    // The part of `repeat` that is Pinocchio's: the pass over the tree.
    void repeat_tree(const Array& state, long repeats) {
        const double* x = state.data();
        nb::gil_scoped_release released;
        for (long i = 0; i < repeats; ++i) system->tree_terms(x);
    }
};

struct PyRun {
    nb::object system;
    std::unique_ptr<Run> run;
    System& s;

    PyRun(PySystem& owner, nb::object system_, const nb::dict& d)
        : system(system_), s(*owner.system) {
        const Scheme scheme = scheme_of(nb::cast<nb::dict>(d["scheme"]));
        const auto constants = nb::cast<nb::dict>(d["constants"]);
        const ControlConstants control_constants = control_constants_of(constants);
        Pieces pieces{vector_of(d["ends"]), vector_of(d["first"]), vector_of(d["last"]), {}};
        for (double mark : vector_of(d["given"])) pieces.given.push_back(mark != 0.0);
        const double t0 = number(d, "t0"), t_end = pieces.ends.back();
        const double step = number(d, "step"), first_step = number(d, "first_step");
        std::unique_ptr<Control> control;
        if (step > 0.0)
            control = std::make_unique<FixedStep>(t0, t_end, step);
        else
            control = std::make_unique<PIControl>(t_end, first_step, scheme.controller_order,
                                                  control_constants);
        const auto placement = nb::cast<std::string>(d["placement"]);
        if (s.constrained() && placement == "automatic") {
            control = std::make_unique<SingularityPlacement>(std::move(control), scheme, t_end,
                                                             control_constants,
                                                             nb::cast<bool>(d["arrivals"]));
            control = std::make_unique<BranchGuard>(std::move(control), s, control_constants);
        } else if (s.constrained()) {
            control = std::make_unique<SlopeOfSigma>(std::move(control), scheme);
        }
        Regularisation eps;
        if (!d["eps"].is_none()) {
            const auto pair = nb::cast<nb::tuple>(d["eps"]);
            eps = {nb::cast<double>(pair[0]), nb::cast<double>(pair[1])};
        }
        const std::vector<double> state = vector_of(d["state"]);
        run = std::make_unique<Run>(
            s, SplitStep(s, scheme, step_constants_of(constants), norm_of(nb::cast<nb::dict>(d["norm"]))),
            std::move(control), loop_constants_of(constants),
            memory_of(nb::cast<nb::dict>(d["memory"]), s.nv), state.data(), t0, std::move(pieces),
            number(d, "max_step"), eps);
    }

    int advance(long steps, double seconds) {
        nb::gil_scoped_release released;
        return static_cast<int>(run->advance(steps, seconds));
    }

    // One attempt from where the reference stands: (stop, verdict), verdict -1 if none was made.
    nb::tuple attempt_from(double t, const Array& state, const nb::dict& memory,
                           const nb::dict& control) {
        const ControlState c = control_of(control);
        run->resume(t, state.data(), memory_of(memory, s.nv), c);
        Verdict verdict = static_cast<Verdict>(-1);
        const Stop stop = run->attempt(verdict);
        return nb::make_tuple(static_cast<int>(stop), static_cast<int>(verdict));
    }

    // Goes on to `end`; `force` (nv,) acts from here, or what acted before.  See Run::go_on.
    int go_on(double end, double first, double last, nb::handle force, bool anew, double grid,
              double seconds) {
        if (!force.is_none()) {
            const Array array = nb::cast<Array>(force);
            if (static_cast<int>(array.size()) != s.nv || array.ndim() != 1 ||
                !finite(array.data(), s.nv))
                throw nb::value_error("not nv finite forces");
            if (!s.holds(array.data())) {
                s.hold(run->t(), array.data(), false);
                anew = true;
            }
        }
        nb::gil_scoped_release released;
        return static_cast<int>(run->go_on(end, first, last, anew, grid, seconds));
    }

    // Everything that the next step depends on.
    nb::dict snapshot() {
        nb::dict out;
        ControlState control;
        run->control->save(control);
        out["t"] = run->t();
        out["state"] = owned(run->state, {run->state.size()});
        out["memory"] = dict_of(run->memory);
        out["control"] = dict_of(control);
        out["seen"] = run->seen();
        out["near"] = run->near();
        return out;
    }

    void restore(const nb::dict& d) {
        const Array state = nb::cast<Array>(d["state"]);
        run->resume(number(d, "t"), state.data(), memory_of(nb::cast<nb::dict>(d["memory"]), s.nv),
                    control_of(nb::cast<nb::dict>(d["control"])));
        run->adopt(number(d, "seen"), number(d, "near"));
    }

    // Accepted, rejected and zone steps since the start.
    nb::tuple totals() {
        long rejected = run->rejected_before;
        for (const Attempt& a : run->attempts)
            rejected += a.verdict == static_cast<int>(Verdict::rejected);
        return nb::make_tuple(run->steps_before + run->count(), rejected,
                              run->zones_before + static_cast<long>(run->zones.size()));
    }

    // The records since the start `state` at `t0`, which are handed over.
    nb::dict arrays(double t0, const Array& state) {
        Run& r = *run;
        const auto count = static_cast<std::size_t>(r.count());
        const auto n = static_cast<std::size_t>(2 * s.nv), nx = static_cast<std::size_t>(s.nq + s.nv);
        const auto width = static_cast<std::size_t>(r.step.scheme.stages + 1);
        nb::dict out;
        r.times.insert(r.times.begin(), t0);
        r.states.insert(r.states.begin(), state.data(), state.data() + nx);
        out["times"] = owned(std::move(r.times), {count + 1});
        out["states"] = owned(std::move(r.states), {count + 1, nx});
        out["rates"] = owned(std::move(r.rates), {count, width, n});
        out["corrections"] = owned(std::move(r.corrections), {count, s.constrained() ? n : 0});
        out["sigmas"] = owned(std::move(r.sigmas), {count, width});
        out["ranks"] = owned(std::move(r.ranks), {count});
        out["error_ratios"] = owned(std::move(r.error_ratios), {count});
        out["placements"] = owned(std::move(r.placements), {count});
        out["held"] = owned(std::move(r.held), {count});
        out["end_rate"] = owned(r.end_rate, {n});
        const std::size_t breaks = r.breaks.size();
        out["breaks"] = owned(r.breaks, {breaks});
        out["break_rates"] = owned(r.break_rates, {breaks, n});
        nb::dict zones;
        for (const ZoneRecord& zone : r.zones)
            zones[nb::int_(zone.step)] = nb::make_tuple(zone.threshold, dict_of(zone.history));
        out["zones"] = zones;
        return out;
    }

    // The step made last, accepted or not, as the reference describes it.
    nb::dict last() {
        const StepResult& r = run->step.result;
        const auto n = static_cast<std::size_t>(2 * s.nv);
        nb::dict out;
        out["t"] = r.t;
        out["h"] = r.h;
        out["state"] = owned(r.state, {r.state.size()});
        out["rates"] = owned(r.rates, {r.sigmas.size(), n});
        out["end_rate"] = owned(r.end_rate, {n});
        out["correction"] = owned(r.correction, {r.correction.size()});
        out["error_ratio"] = r.error_ratio;
        out["sigmas"] = owned(r.sigmas, {r.sigmas.size()});
        out["rank"] = r.rank;
        out["magnitude"] = owned(r.magnitude, {n});
        out["quiet"] = r.quiet;
        out["gap"] = r.gap;
        out["held"] = r.held;
        out["zone_threshold"] = r.in_zone ? nb::cast(r.zone_threshold) : nb::none();
        // Of an accepted step; that of another one is still the memory's.
        const bool recorded = !run->zones.empty() && run->zones.back().step == run->count() - 1;
        out["history"] = !r.in_zone ? nb::none()
                                    : nb::object(dict_of(recorded ? run->zones.back().history
                                                                  : run->memory.history));
        return out;
    }

    nb::list attempts() {
        nb::list out;
        for (const Attempt& a : run->attempts)
            out.append(nb::make_tuple(a.t, a.h, a.error_ratio, a.verdict));
        return out;
    }
    nb::list suspects() {
        nb::list out;
        if (const auto* guard = dynamic_cast<const BranchGuard*>(run->control.get()))
            for (double t : guard->suspects) out.append(t);
        return out;
    }
};

struct PyDense {
    nb::object steps;  // kept alive
    std::unique_ptr<DenseOutput> dense;
    int nx;

    PyDense(int nq, int nv, const nb::dict& d) : steps(d), nx(nq + nv) {
        Extension extension;
        extension.rows = vector_of(d["rows"]);
        extension.extra_A = vector_of(d["extra_A"]);
        extension.extra_c = vector_of(d["extra_c"]);
        extension.degree = whole(d, "degree");
        extension.n_rates = whole(d, "n_rates");
        extension.n_extra = static_cast<int>(extension.extra_c.size());
        HermiteConstants hermite{nb::cast<std::vector<int>>(d["nodes"]), number(d, "spacing"),
                                 number(d, "close"), vector_of(d["probes"])};
        StepArrays arrays;
        const auto pointer = [&](const char* key) { return nb::cast<Array>(d[key]).data(); };
        arrays.times = pointer("times");
        arrays.states = pointer("states");
        arrays.rates = pointer("rates");
        arrays.corrections = pointer("corrections");
        arrays.sigmas = pointer("sigmas");
        arrays.end_rate = pointer("end_rate");
        arrays.end = number(d, "end");
        arrays.slack = number(d, "slack");
        arrays.count = nb::cast<long>(d["count"]);
        for (double i : vector_of(d["breaks"])) arrays.breaks.push_back(static_cast<long>(i));
        arrays.break_rates = pointer("break_rates");
        arrays.width = whole(d, "width");
        arrays.corrected = nb::cast<bool>(d["corrected"]);
        arrays.in_zone.assign(arrays.count, 0);
        for (long step : nb::cast<std::vector<long>>(d["zones"])) arrays.in_zone[step] = 1;
        dense = std::make_unique<DenseOutput>(nq, nv, std::move(extension), vector_of(d["abscissae"]),
                                              std::move(hermite), std::move(arrays));
    }

    nb::object states(PySystem& owner, const Array& t) {
        const auto k = t.size();
        std::vector<double> out(k * static_cast<std::size_t>(nx));
        // With the interpreter's lock held: threads may read one solution, and share its workspace.
        dense->states(*owner.system, t.data(), static_cast<long>(k), out.data());
        return owned(std::move(out), {k, static_cast<std::size_t>(nx)});
    }
};

}  // namespace

// The collector follows what the objects keep alive: a controller may lead back to a solution.
template <typename T, nb::object T::*... kept>
int traverse(PyObject* self, visitproc visit, void* arg) {
    Py_VISIT(Py_TYPE(self));
    if (!nb::inst_ready(self)) return 0;
    T* object = nb::inst_ptr<T>(self);
    for (PyObject* held : {(object->*kept).ptr()...}) Py_VISIT(held);
    return 0;
}

template <typename T, nb::object T::*... kept>
int clear(PyObject* self) {
    if (!nb::inst_ready(self)) return 0;
    T* object = nb::inst_ptr<T>(self);
    ((object->*kept).reset(), ...);
    return 0;
}

template <typename T, nb::object T::*... kept>
PyType_Slot* collected() {
    static PyType_Slot slots[] = {
        {Py_tp_traverse, reinterpret_cast<void*>(traverse<T, kept...>)},
        {Py_tp_clear, reinterpret_cast<void*>(clear<T, kept...>)},
        {0, nullptr},
    };
    return slots;
}

NB_MODULE(_core, m) {
    // Results that live until the interpreter ends are no leak.
    nb::set_leak_warnings(false);
    m.doc() = "Compiled twin of the default paths of srm_mbs; see srm_mbs.integration.kernel.backend.";
    nb::register_exception_translator([](const std::exception_ptr& p, void*) {
        try {
            std::rethrow_exception(p);
        } catch (const EvaluationError&) {
            PyErr_SetString(PyExc_ArithmeticError, "the stage cannot be evaluated");
        }
    });
    m.def("lean_data", [](nb::object model) {
        const void* found = model_in(model.ptr());
        if (!found) throw nb::type_error("not a pinocchio.Model");
        return nb::steal(lean_data(found));
    });
    bind_algebra(m);
    nb::class_<PySystem>(
        m, "System", nb::type_slots(collected<PySystem, &PySystem::model, &PySystem::controller>()))
        .def(nb::init<nb::object, const nb::dict&, nb::object>(), nb::arg("model"),
             nb::arg("data"), nb::arg("controller").none())
        .def("terms", &PySystem::terms, nb::arg("t"), nb::arg("state"), nb::arg("threshold") = -1.0)
        .def("repeat", &PySystem::repeat)
        .def("repeat_tree", &PySystem::repeat_tree)
        .def("between", [](PySystem& s, double first, double last) { s.system->between(first, last); })
        .def("hold", [](PySystem& s, double t, const Array& force, bool keep) {
            if (static_cast<int>(force.size()) != s.system->nv) throw nb::value_error("not (nv,)");
            s.system->hold(t, force.data(), keep);
        })
        .def("renew", [](PySystem& s, nb::handle unit, nb::handle gap_scale, nb::handle damping,
                         nb::handle friction) {
            s.system->renew(vector_of(unit), vector_of(gap_scale), vector_of(damping),
                            vector_of(friction));
        }, nb::arg("unit"), nb::arg("gap_scale"), nb::arg("damping").none(),
           nb::arg("friction").none())
        .def("first_step", &PySystem::first_step)
        .def_prop_ro("sparse", [](const PySystem& s) { return s.system->sparse(); })
        .def_prop_ro("evaluations", [](const PySystem& s) { return s.system->evaluations; })
        .def_prop_ro("factorisations", [](const PySystem& s) { return s.system->factorisations(); });
    nb::class_<PyRun>(m, "Run", nb::type_slots(collected<PyRun, &PyRun::system>()))
        .def("__init__",
             [](PyRun* self, nb::object system, const nb::dict& d) {
                 new (self) PyRun(nb::cast<PySystem&>(system), system, d);
             })
        .def("advance", &PyRun::advance, nb::arg("steps"), nb::arg("seconds"))
        .def("attempt_from", &PyRun::attempt_from)
        .def("arrays", &PyRun::arrays)
        .def("last", &PyRun::last)
        .def("attempts", &PyRun::attempts)
        .def("suspects", &PyRun::suspects)
        .def("go_on", &PyRun::go_on, nb::arg("end"), nb::arg("first"), nb::arg("last"),
             nb::arg("force").none(), nb::arg("anew"), nb::arg("grid"), nb::arg("seconds"))
        .def("snapshot", &PyRun::snapshot)
        .def("restore", &PyRun::restore)
        .def("totals", &PyRun::totals)
        .def("enter", [](PyRun& r) { return r.run->enter(); })
        .def("remember", [](PyRun& r, const nb::dict& memory) {
            r.run->memory = memory_of(memory, r.s.nv);
        })
        .def_prop_ro("at_breakpoint", [](PyRun& r) { return r.run->at_breakpoint(); })
        .def_prop_ro("piece", [](PyRun& r) { return r.run->piece(); })
        .def("memory", [](PyRun& r) { return dict_of(r.run->memory); })
        .def_prop_ro("t", [](PyRun& r) { return r.run->t(); })
        .def_prop_ro("h", [](PyRun& r) { return r.run->last_h(); })
        .def_prop_ro("count", [](PyRun& r) { return r.run->count(); })
        .def("time_before", [](PyRun& r, long steps) { return r.run->times[r.run->count() - steps]; })
        .def_prop_ro("trouble", [](PyRun& r) { return r.run->trouble; })
        .def_prop_ro("placed", [](PyRun& r) { return r.run->control->placed; })
        .def_prop_ro("replaced", [](PyRun& r) { return r.run->control->replaced; })
        .def_prop_ro("state", [](PyRun& r) {
            return owned(r.run->state, {r.run->state.size()});
        });
    nb::class_<PyDense>(
        m, "DenseOutput", nb::type_slots(collected<PyDense, &PyDense::steps>()))
        .def(nb::init<int, int, const nb::dict&>())
        .def("states", &PyDense::states);
}
