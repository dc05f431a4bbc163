// The Python module: structs that Python fills, systems, runs, dense output.
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "algebra.hpp"
#include "branch_motion.hpp"
#include "branch_nodes.hpp"
#include "constants.hpp"
#include "dense.hpp"
#include "errors.hpp"
#include "event_search.hpp"
#include "interpreter.hpp"
#include "linear.hpp"
#include "manifold.hpp"
#include "model.hpp"
#include "regular_start.hpp"
#include "run.hpp"
#include "separated_rows.hpp"
#include "sigma_dips.hpp"
#include "struct_binding.hpp"

using namespace srm;

namespace {

// ---- Support ------------------------------------------------------------------------------------

// The vector `array`, which has `size` numbers.
const double* vector_of(const Array& array, int size, const char* name) {
    if (array.ndim() != 1 || static_cast<int>(array.size()) != size)
        throw nb::value_error((std::string(name) + " has not the shape (" + std::to_string(size) +
                               ",)").c_str());
    return array.data();
}

// The `size` numbers of `array`.
std::vector<double> numbers(nb::handle array, int size, const char* name) {
    std::vector<double> out = to_vector(array);
    if (static_cast<int>(out.size()) != size)
        throw nb::value_error((std::string(name) + " has not " + std::to_string(size) +
                               " numbers").c_str());
    return out;
}

std::vector<double> optional_vector(nb::handle object) {
    return object.is_none() ? std::vector<double>{} : to_vector(object);
}

// Raises `largest` to a larger value, and to NaN, than which nothing is larger.
void take_largest(double value, double& largest) {
    if (value > largest || std::isnan(value)) largest = value;
}

// The largest norm (m,) in any row of `width` numbers of each of the groups order[starts[i]], ...,
// order[starts[i + 1] - 1] of its entries.
class LargestNorms {
public:
    LargestNorms(const std::vector<int>& order, const std::vector<int>& starts, std::size_t width)
        : order_(order), starts_(starts), squares_(starts.size()) {
        expect_within("order", order, 0, static_cast<long>(width) - 1);
        expect_within("starts", starts, 0, static_cast<long>(order.size()) - 1);
    }

    void take(const double* row) {
        for (std::size_t g = 0; g < starts_.size(); ++g) {
            const std::size_t end = g + 1 < starts_.size() ? starts_[g + 1] : order_.size();
            double square = 0.0;
            for (std::size_t k = starts_[g]; k < end; ++k) square += row[order_[k]] * row[order_[k]];
            take_largest(square, squares_[g]);
        }
    }

    std::vector<double> norms() const {
        std::vector<double> out;
        for (const double square : squares_) out.push_back(std::sqrt(square));
        return out;
    }

private:
    const std::vector<int>&order_, &starts_;
    std::vector<double> squares_;
};

// LargestNorms of the rows of x (n, width).
std::vector<double> largest_norms(const Array& x, const std::vector<int>& order,
                                  const std::vector<int>& starts) {
    if (x.ndim() != 2) throw nb::value_error("x has another shape");
    LargestNorms norms(order, starts, x.shape(1));
    for (std::size_t i = 0; i < x.shape(0); ++i) norms.take(x.data() + i * x.shape(1));
    return norms.norms();
}

// A view of `values`, which `owner` keeps alive.
template <typename Values>
nb::object view(const Values& values, std::initializer_list<std::size_t> shape, nb::handle owner) {
    return nb::cast(nb::ndarray<nb::numpy, double>(const_cast<double*>(values.data()), shape.size(),
                                                   shape.begin(), owner));
}

// Type slots that show the garbage collector the objects that a T keeps alive: a controller may
// refer back to a solution.
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

const void* pinocchio_model_in(nb::handle model) {
    const void* found = model_in(model.ptr());
    if (!found) throw nb::type_error("not a pinocchio.Model");
    return found;
}

// ---- Structs ------------------------------------------------------------------------------------

void bind_structs(nb::module_& m) {
    bind_struct<Constants>(m, "Constants");
    bind_struct<ButcherTableau>(m, "ButcherTableau");
    bind_struct<ErrorNorm>(m, "ErrorNorm");
    bind_struct<MultiplierHistory>(m, "MultiplierHistory");
    bind_struct<IntegratorState>(m, "IntegratorState");
    bind_struct<ControlState>(m, "ControlState");
    bind_struct<SmoothIntervals>(m, "SmoothIntervals");
    bind_struct<Collocation>(m, "Collocation");
    bind_struct<RunOptions>(m, "RunOptions");
    nb::class_<MotionAlongCurve>(m, "MotionAlongCurve");
    bind_struct<RunSnapshot>(m, "RunSnapshot");
    bind_struct<Curve>(m, "Curve");
    bind_struct<Anchor>(m, "Anchor");
    bind_struct<ForceElement>(m, "ForceElement");
    bind_struct<GroupJoint>(m, "GroupJoint");
    bind_struct<ClosureRows>(m, "ClosureRows");
    bind_struct<JointRow>(m, "JointRow");
    bind_struct<Elimination>(m, "Elimination");
    bind_struct<DrivenRow>(m, "DrivenRow");
    bind_struct<SystemData>(m, "SystemData");
    bind_struct<SeparatedRows>(m, "SeparatedRows");
    bind_struct<ClosingLimits>(m, "ClosingLimits");
    bind_struct<ScaledRows>(m, "ScaledRows");
    bind_struct<StartRules>(m, "StartRules");
    bind_struct<Extension>(m, "Extension");
    bind_struct<SchemeDense>(m, "SchemeDense");
    bind_struct<DenseConstants>(m, "DenseConstants");
    bind_struct<DipSearch>(m, "DipSearch");
    bind_struct<EventConstants>(m, "EventConstants");
    bind_struct<BranchCurve>(m, "BranchCurve");
}

// ---- System -------------------------------------------------------------------------------------

struct PySystem {
    nb::object model, controller, code;  // kept alive
    std::unique_ptr<System> system;

    PySystem(nb::object model_, const SystemData& data, nb::object controller_)
        : model(std::move(model_)), controller(std::move(controller_)) {
        const void* found = pinocchio_model_in(model);
        Controller act;
        if (!controller.is_none())
            act = [this](double t, const double* q, const double* v, double* tau) {
                call_controller(t, q, v, tau);
            };
        system = std::make_unique<System>(found, data, std::move(act));
    }

    void call_controller(double t, const double* q, const double* v, double* tau) const {
        const WithLock held;
        const int nq = system->nq, nv = system->nv;
        const nb::object out = controller(t, owned_array(std::vector<double>(q, q + nq)),
                                          owned_array(std::vector<double>(v, v + nv)));
        const Array forces = nb::cast<Array>(out);
        std::copy_n(vector_of(forces, nv, "the controller's force"), nv, tau);
    }

    int state_size() const { return system->nq + system->nv; }

    // The terms of one stage, for comparison with the reference.
    nb::dict terms(double t, const Array& state, double threshold) {
        System::ZoneView zone;
        zone.threshold = threshold;
        system->evaluate(t, vector_of(state, state_size(), "state"), zone);
        const int nv = system->nv;
        std::vector<double> rate(2 * nv), correction(2 * nv), multiplier(nv);
        system->rate(rate.data());
        system->correction(correction.data());
        system->multiplier(multiplier.data());
        nb::dict out;
        out["rate"] = owned_array(std::move(rate));
        out["correction"] = owned_array(std::move(correction));
        out["multiplier"] = owned_array(std::move(multiplier));
        out["sigma"] = system->sigma();
        out["rank"] = system->rank();
        out["rank_deficient"] = system->rank_deficient();
        out["constraint_residual"] = system->closure_residual();
        return out;
    }

    // What a run from `state` at t begins with; its first stage is evaluated directly.
    IntegratorState first_stage(double t, const Array& state, bool stiff) {
        IntegratorState out = srm::first_stage(*system, t, vector_of(state, state_size(), "state"));
        out.stiff = stiff;
        return out;
    }

    // Evaluates the stage `repeats` times, to measure one evaluation in the loop.
    void repeat(double t, const Array& state, long repeats) {
        std::vector<double> rate(2 * system->nv);
        const double* x = vector_of(state, state_size(), "state");
        const WithoutLock released;
        for (long i = 0; i < repeats; ++i) {
            system->evaluate(t, x, System::ZoneView{});
            system->rate(rate.data());
        }
    }

    // The same of its pass over the tree, which is Pinocchio's part.
    void repeat_tree(const Array& state, long repeats) {
        const double* x = vector_of(state, state_size(), "state");
        const WithoutLock released;
        for (long i = 0; i < repeats; ++i) system->tree_terms(x);
    }

    // Runs `work` on n states: without the interpreter's lock if there are many of them, so that no
    // other thread may use the system meanwhile.
    template <class Work>
    void on_states(std::size_t n, Work&& work) const {
        constexpr std::size_t many = 16;
        if (n < many || !controller.is_none()) return work();
        const WithoutLock released;
        work();
    }

    // Quantities of n states.  count_of: their number, from times t (n,) and rows of `width` numbers.
    static std::size_t count_of(const Array& t, const Array& rows, int width) {
        const std::size_t n = t.size();
        if (t.ndim() != 1 || rows.size() != n * static_cast<std::size_t>(width))
            throw nb::value_error("times and states do not fit");
        return n;
    }

    // g - s and G v - s' (n, rows); with_energies: and kinetic and potential energy (n, 2).
    nb::tuple closure_errors(const Array& t, const Array& states, bool with_energies) {
        const std::size_t n = count_of(t, states, state_size()), nx = state_size();
        const auto rows = static_cast<std::size_t>(system->rows());
        std::vector<double> g(n * rows), rates(n * rows), energies(with_energies ? 2 * n : 0);
        const double *times = t.data(), *x = states.data();
        on_states(n, [&] {
            for (std::size_t i = 0; i < n; ++i) {
                const double* const state = x + i * nx;
                system->closure_errors(times[i], state, g.data() + i * rows,
                                       rates.data() + i * rows);
                if (!with_energies) continue;
                const auto found = system->energies(state, true);
                std::copy(found.begin(), found.end(), energies.begin() + 2 * i);
            }
        });
        const nb::object errors = owned_array(std::move(g), {n, rows});
        const nb::object of_rates = owned_array(std::move(rates), {n, rows});
        if (!with_energies) return nb::make_tuple(errors, of_rates);
        return nb::make_tuple(errors, of_rates, owned_array(std::move(energies), {n, 2}));
    }

    // The largest |g - s| and |G v - s'| at q (nq,) and v (nv,), over the units (rows,) of the rows;
    // NaN if one is.
    nb::tuple largest_errors(double t, const Array& q, const Array& v, const Array& unit) {
        const int rows = system->rows();
        const double* over = vector_of(unit, rows, "unit");
        const double *from = vector_of(q, system->nq, "q"), *rate = vector_of(v, system->nv, "v");
        std::vector<double> state(from, from + system->nq), g(rows), rates(rows);
        state.insert(state.end(), rate, rate + system->nv);
        system->closure_errors(t, state.data(), g.data(), rates.data());
        const auto largest = [&](const std::vector<double>& errors) {
            double out = 0.0;
            for (int i = 0; i < rows; ++i) take_largest(std::abs(errors[i]) / over[i], out);
            return out;
        };
        return nb::make_tuple(largest(g), largest(rates));
    }

    // G (n, rows, nv) at the configurations q (n, nq), with drives and -s' as its last column
    // (n, rows, nv + 1).
    nb::object jacobians(const Array& t, const Array& q) {
        const std::size_t n = count_of(t, q, system->nq);
        const auto rows = static_cast<std::size_t>(system->rows());
        const int width = system->nv + (system->driven() ? 1 : 0);
        const std::size_t size = rows * static_cast<std::size_t>(width);
        std::vector<double> G(n * size), g(rows);
        const double *times = t.data(), *from = q.data();
        on_states(n, [&] {
            for (std::size_t i = 0; i < n; ++i)
                system->closures_at(times[i], from + i * system->nq, g.data(), G.data() + i * size,
                                    width);
        });
        return owned_array(std::move(G), {n, rows, static_cast<std::size_t>(width)});
    }

    // g (rows,) and G (rows, width), as of jacobians(), at one configuration q (nq,).
    nb::tuple rows_at(double t, const Array& q) {
        const auto rows = static_cast<std::size_t>(system->rows());
        const std::size_t width = system->nv + (system->driven() ? 1 : 0);
        std::vector<double> G(rows * width), g(rows);
        system->closures_at(t, vector_of(q, system->nq, "q"), g.data(), G.data(),
                            static_cast<int>(width));
        return nb::make_tuple(owned_array(std::move(g)), owned_array(std::move(G), {rows, width}));
    }

    // This call and those up to open_norms() need a system that no other thread uses meanwhile.

    // close_loops() from q (nq,): the last configuration, and the largest error there.
    nb::tuple close(Algebra& algebra, const Array& row_unit, const Array& units, const Array& q,
                    const ClosingLimits& limits) {
        const int rows = algebra.rows();
        if (system->driven() || rows > system->rows() || algebra.columns() != system->nv)
            throw nb::value_error("the rows are not those of the algebra");
        const double* const over = vector_of(row_unit, rows, "row_unit");
        const double* const unit = vector_of(units, system->nv, "units");
        vector_of(q, system->nq, "q");
        std::vector<double> at = to_vector(q);
        double error;
        {
            // Of few rows this takes less time than another thread needs to take the lock.
            constexpr int few = 16;
            std::optional<WithoutLock> released;
            if (rows > few) released.emplace();
            error = close_loops(*system, algebra, over, unit, limits, at);
        }
        return nb::make_tuple(owned_array(std::move(at)), error);
    }

    // find_regular_start(): q (nq,), v (nv,), the diagonal, the least inertia, and the least and the
    // largest gyration; None where it finds none.
    nb::object regular_start(const StartRules& rules, const Array& q, const Array& v,
                             std::vector<int> free_q, std::vector<int> free_v,
                             std::vector<int> turning, const Array& spreads) {
        const long nv = system->nv;
        if (system->driven() || system->constrained() || spreads.ndim() != 2 ||
            static_cast<long>(spreads.shape(1)) != nv)
            throw nb::value_error("the rows are not unscaled, or spreads not rows of nv numbers");
        for (const auto* each : {&free_q, &free_v, &turning})
            expect_within("a coordinate", *each, 0, nv - 1);
        const StartRequest request{vector_of(q, system->nq, "q"), vector_of(v, system->nv, "v"),
                                   std::move(free_q), std::move(free_v), std::move(turning),
                                   spreads.data(), spreads.shape(0)};
        RegularStart found;
        bool is_found;
        {
            const WithoutLock released;
            is_found = find_regular_start(*system, rules, request, found);
        }
        if (!is_found) return nb::none();
        return nb::make_tuple(owned_array(std::move(found.q)), owned_array(std::move(found.v)),
                              found.diagonal, found.least_inertia, found.gyrations.least,
                              found.gyrations.largest);
    }

    // ScaledSampler::walk() of as many steps as there are reaches; its samples.
    nb::tuple walk(const ScaledRows& rows, Algebra& all, Algebra& loops, Algebra& in_units,
                   const Array& q, bool sample_start, const Array& directions,
                   const Array& reaches, std::optional<Array> first) {
        ScaledSampler sampler(*system, rows, all, loops, in_units);
        vector_of(q, system->nq, "q");
        const std::size_t steps = count_of(reaches, directions, system->nv);
        const double* along = first ? vector_of(*first, system->nv, "first") : nullptr;
        WalkSamples found;
        std::vector<double> start = to_vector(q);
        {
            const WithoutLock released;
            sampler.walk(std::move(start), sample_start, static_cast<int>(steps),
                         directions.data(), reaches.data(), along, found);
        }
        const std::size_t n = found.count;
        const auto each = [&](const Algebra& algebra) {
            return static_cast<std::size_t>(std::min(algebra.rows(), algebra.columns()));
        };
        return nb::make_tuple(
            owned_array(std::move(found.configurations), {n, static_cast<std::size_t>(system->nq)}),
            owned_array(std::move(found.pivots), {n, each(all)}),
            owned_array(std::move(found.of_loops), {n, each(loops)}),
            owned_array(std::move(found.largest)));
    }

    // ScaledSampler::open_norms() at `spreads` (n, nv) from q (nq,).
    nb::tuple open_norms(const ScaledRows& rows, Algebra& all, Algebra& loops, Algebra& in_units,
                         const Array& q, const Array& spreads) {
        ScaledSampler sampler(*system, rows, all, loops, in_units);
        vector_of(q, system->nq, "q");
        const std::size_t nv = system->nv;
        if (spreads.ndim() != 2 || spreads.shape(1) != nv)
            throw nb::value_error("spreads are not rows of nv numbers");
        std::vector<double> squares(system->rows()), uncancelled(2);
        const std::vector<double> start = to_vector(q);
        {
            const WithoutLock released;
            sampler.open_norms(start, spreads.shape(0), spreads.data(), squares.data(),
                               uncancelled.data());
        }
        return nb::make_tuple(owned_array(std::move(squares)), owned_array(std::move(uncancelled)));
    }

    // Forces (n, drives) of the drives, NaN where rows depend on each other.
    nb::object drive_forces(const Array& t, const Array& states) {
        const std::size_t n = count_of(t, states, state_size()), nx = state_size();
        const std::size_t m = system->drive_count();
        std::vector<double> out(n * m);
        const double *times = t.data(), *x = states.data();
        on_states(n, [&] {
            for (std::size_t i = 0; i < n; ++i) {
                system->evaluate(times[i], x + i * nx, System::ZoneView{});
                if (!system->drive_forces(out.data() + i * m))
                    std::fill_n(out.begin() + i * m, m, std::numeric_limits<double>::quiet_NaN());
            }
        });
        return owned_array(std::move(out), {n, m});
    }

    // Of n states: multipliers (n, rows), wrenches (n, closures, 6) and (n, joints, 6); see
    // System::reactions.
    nb::tuple reactions(PySystem& all, const Array& scale, const std::vector<int>& kept,
                        const Array& t, const Array& states) {
        const std::size_t n = count_of(t, states, state_size()), nx = state_size();
        const auto rows = static_cast<std::size_t>(all.system->rows());
        if (all.system.get() == system.get() || all.state_size() != state_size() ||
            all.system->joint_count() != system->joint_count() || scale.size() != rows)
            throw nb::value_error("the rows are not those of the mechanism");
        if (system->constrained()) {
            expect_size("kept", kept.size(), static_cast<std::size_t>(system->rows()));
            expect_within("kept", kept, 0, static_cast<long>(rows) - 1);
        }
        const std::size_t closures = all.system->closure_count(), joints = system->joint_count();
        std::vector<double> lam(n * rows), on_b(6 * n * closures), on_child(6 * n * joints);
        const double *times = t.data(), *x = states.data(), *scales = scale.data();
        const auto find = [&] {
            for (std::size_t i = 0; i < n; ++i) {
                system->evaluate(times[i], x + i * nx, System::ZoneView{});
                system->reactions(times[i], x + i * nx, *all.system, scales, kept,
                                  lam.data() + i * rows, on_b.data() + 6 * i * closures,
                                  on_child.data() + 6 * i * joints);
            }
        };
        on_states(n, find);
        return nb::make_tuple(owned_array(std::move(lam), {n, rows}),
                              owned_array(std::move(on_b), {n, closures, 6}),
                              owned_array(std::move(on_child), {n, joints, 6}));
    }

    // Accelerations (n, nv) of n states.
    nb::object accelerations(const Array& t, const Array& states) {
        const std::size_t n = count_of(t, states, state_size()), nx = state_size();
        const auto nv = static_cast<std::size_t>(system->nv);
        std::vector<double> out(n * nv), rate(2 * nv);
        const double *times = t.data(), *x = states.data();
        on_states(n, [&] {
            for (std::size_t i = 0; i < n; ++i) {
                system->evaluate(times[i], x + i * nx, System::ZoneView{});
                system->rate(rate.data());
                std::copy_n(rate.begin() + nv, nv, out.begin() + i * nv);
            }
        });
        return owned_array(std::move(out), {n, nv});
    }

    // The smallest singular value (n,) of the separated rows; see SeparatedRows::smallest.
    nb::object smallest_values(const SeparatedRows& rows, Algebra& algebra, const Array& t,
                               const Array& q) {
        const std::size_t n = count_of(t, q, system->nq), all = system->rows();
        const std::size_t width = system->nv + (system->driven() ? 1 : 0);
        if (rows.supports.size() != all || rows.factors.size() != all * width ||
            static_cast<int>(rows.active.size()) != algebra.rows() ||
            static_cast<int>(width) != algebra.columns())
            throw nb::value_error("the rows are not those of the system and of the algebra");
        std::vector<double> out(n), G(all * width);
        // With the interpreter's lock: threads may share the algebra.
        for (std::size_t i = 0; i < n; ++i)
            out[i] = rows.smallest(*system, algebra, t.data()[i], q.data() + i * system->nq, G);
        return owned_array(std::move(out));
    }

    // Of the motions and changes of the rates between each two states, from (n, nx), or (1, nx) for
    // all of them, and to (n, nx): the largest entry of either over its unit (n, 2), and the largest
    // norms of groups of entries (LargestNorms).  The coordinates `turned` (k,) move by `angles`
    // (n, k).
    nb::tuple largest_differences(const Array& from, const Array& to, const Array& unit,
                                  const std::vector<int>& order, const std::vector<int>& starts,
                                  const std::vector<int>& turned, const Array& angles) {
        const std::size_t nx = state_size(), n = to.size() / nx, own = from.size() / nx;
        const auto width = 2 * static_cast<std::size_t>(system->nv), k = turned.size();
        if (from.ndim() != 2 || from.shape(1) != nx || to.ndim() != 2 || to.shape(1) != nx ||
            (own != n && own != 1) || unit.size() != width || angles.size() != n * k)
            throw nb::value_error("states, unit or angles has another shape");
        expect_within("turned", turned, 0, system->nv - 1);
        LargestNorms norms(order, starts, width);
        std::vector<double> size(2 * n), row(width), none(system->nv, 0.0);
        for (std::size_t i = 0; i < n; ++i) {
            system->difference(from.data() + (own == n ? i : 0) * nx, to.data() + i * nx,
                               none.data(), row.data());
            for (std::size_t j = 0; j < k; ++j) row[turned[j]] = angles.data()[i * k + j];
            for (std::size_t j = 0; j < width; ++j)
                take_largest(std::abs(row[j] / unit.data()[j]), size[2 * i + (2 * j >= width)]);
            norms.take(row.data());
        }
        return nb::make_tuple(owned_array(std::move(size), {n, 2}), norms.norms());
    }

    // Each of the states (n, nx) moved by one of the motions (n, 2 nv), in its own chart.
    nb::object moved(const Array& states, const Array& motions) {
        const std::size_t nx = state_size(), n = states.size() / nx;
        const auto width = 2 * static_cast<std::size_t>(system->nv);
        if (states.ndim() != 2 || states.shape(1) != nx || motions.size() != n * width)
            throw nb::value_error("states or motions has another shape");
        std::vector<double> out(n * nx);
        for (std::size_t i = 0; i < n; ++i)
            system->retract(states.data() + i * nx, motions.data() + i * width, &out[i * nx]);
        return owned_array(std::move(out), {n, nx});
    }

    // Kinetic and potential energy (n, 2).
    nb::object energies(const Array& states) {
        const std::size_t nx = state_size();
        if (states.ndim() != 2 || states.shape(1) != nx)
            throw nb::value_error("states has another shape");
        const std::size_t n = states.shape(0);
        std::vector<double> out(2 * n);
        const double* const x = states.data();
        on_states(n, [&] {
            for (std::size_t i = 0; i < n; ++i) {
                const auto found = system->energies(x + i * nx);
                std::copy(found.begin(), found.end(), out.begin() + 2 * i);
            }
        });
        return owned_array(std::move(out), {n, 2});
    }

    // Powers (n, elements) of each of `elements` by itself, or of its force at rest.
    nb::object powers(const Array& t, const Array& states,
                      const std::vector<ForceElement>& elements, bool resting) {
        const std::size_t n = count_of(t, states, state_size()), m = elements.size();
        std::vector<double> out(n * m);
        const SeparateElements each = system->separate(elements);
        const double *times = t.data(), *x = states.data();
        on_states(n, [&] { system->powers(times, x, n, each, resting, out.data()); });
        return owned_array(std::move(out), {n, m});
    }

    // Powers (steps, k, elements) of each of `elements` at the k stages with these rows of A (k, s)
    // and c (k,) of the `chosen` steps of those with ends at the times (n + 1,), states there
    // (n + 1, nx) and rates (n, s or more, 2 nv).
    nb::object stage_powers(const std::vector<long>& chosen, const Array& times,
                            const Array& states, const Array& rates, const Array& A,
                            const Array& c, const std::vector<ForceElement>& elements) {
        const std::size_t nx = state_size(), n = 2 * static_cast<std::size_t>(system->nv);
        const std::size_t stages = c.size(), m = elements.size();
        const std::size_t ends = count_of(times, states, static_cast<int>(nx));
        if (rates.ndim() != 3 || rates.shape(0) + 1 != ends || rates.shape(2) != n || !stages ||
            A.size() % stages != 0 || A.size() / stages > rates.shape(1))
            throw nb::value_error("rates or A has another shape");
        for (const long step : chosen)
            expect_within("chosen", step, 0, static_cast<long>(ends) - 2);
        std::vector<double> out(chosen.size() * stages * m);
        system->stage_powers(chosen,
                             {times.data(), states.data(), rates.data(), A.data(), c.data(),
                              rates.shape(1), A.size() / stages, stages},
                             system->separate(elements), out.data());
        return owned_array(std::move(out), {chosen.size(), stages, m});
    }

    // Takes terms from a GeneratedTerms from now on; None: from the pass over the tree.
    void use_code(nb::object generated) {
        system->use_code(generated.is_none() ? nullptr : &nb::cast<const GeneratedTerms&>(generated));
        code = std::move(generated);
    }

    // The system linearised at a regular state, so many times: J (n, n), the laws by the chart
    // coordinates (m, n) and the accelerations by the laws (nv, m), each column by column.
    nb::object linearisation(const Constants& constants, double t, double h, const Array& state,
                             const std::vector<double>& unit,
                             const std::vector<double>& state_scale, int repeats) {
        const auto x = vector_of(state, state_size(), "state");
        const std::size_t n = 2 * static_cast<std::size_t>(system->nv);
        expect_size("unit", unit.size(), n);
        expect_size("state_scale", state_scale.size(), n);
        LinearStages stages(*system, 1.0, unit, constants);
        system->track_laws(true);
        try {
            for (int i = 0; i < repeats; ++i) stages.linearise_anew(t, h, x, state_scale);
        } catch (...) {
            system->track_laws(false);
            throw;
        }
        system->track_laws(false);
        std::vector<double> J(n * n);
        stages.jacobian(J.data());
        return nb::make_tuple(owned_array(std::move(J)),
                              owned_array(std::vector<double>(stages.laws_by_coordinates())),
                              owned_array(std::vector<double>(stages.by_laws())));
    }

    // Changes of the velocities by an impulse n (nv,): System::impulse_response().
    nb::tuple impulse_response(nb::handle q, nb::handle n) {
        if (!system->constrained()) throw nb::value_error("there are no closures");
        std::vector<double> along(system->nv), free(system->nv);
        system->impulse_response(numbers(q, system->nq, "q").data(),
                                 numbers(n, system->nv, "n").data(), along.data(), free.data());
        return nb::make_tuple(owned_array(std::move(along)), owned_array(std::move(free)));
    }

    // The state and, for each row of `changes` (k, w), the state that changed by these shares of its
    // numbers and of `scale` (2 nv,): (1 + k, nx).
    nb::object changed_states(nb::handle state, nb::handle scale, const Array& changes) {
        const std::size_t nx = state_size(), n = 2 * static_cast<std::size_t>(system->nv);
        const std::vector<double> x = numbers(state, state_size(), "state");
        const std::vector<double> unit = numbers(scale, static_cast<int>(n), "scale");
        if (changes.ndim() != 2 || changes.shape(1) < std::max(nx, n))
            throw nb::value_error("changes has another shape");
        const std::size_t k = changes.shape(0);
        std::vector<double> out(x), moved(nx), motion(n);
        out.resize((1 + k) * nx);
        for (std::size_t i = 0; i < k; ++i) {
            const double* shares = changes.data() + i * changes.shape(1);
            for (std::size_t j = 0; j < nx; ++j) moved[j] = x[j] * (1.0 + shares[j]);
            for (std::size_t j = 0; j < n; ++j) motion[j] = unit[j] * shares[j];
            system->retract(moved.data(), motion.data(), &out[(1 + i) * nx]);
        }
        return owned_array(std::move(out), {1 + k, nx});
    }

    // The states (2, nx) after d and 2 d (s) of the motion from `state`; without acceleration where
    // it cannot be evaluated, or sigma is not above `least_sigma`.
    nb::object states_ahead(double t, nb::handle state, double d, double least_sigma) {
        const std::size_t nx = state_size(), nv = system->nv;
        const std::vector<double> x = numbers(state, state_size(), "state");
        const double* v = x.data() + system->nq;
        std::vector<double> rate(2 * nv), motion(2 * nv), out(2 * nx);
        try {
            system->evaluate(t, x.data(), System::ZoneView{});
            if (system->sigma() > least_sigma) system->rate(rate.data());
        } catch (const EvaluationError&) {
        }
        for (std::size_t k = 0; k < 2; ++k, d *= 2.0) {
            for (std::size_t j = 0; j < nv; ++j) {
                const double a = rate[nv + j];
                motion[j] = d * v[j] + 0.5 * d * d * a;
                motion[nv + j] = d * a;
            }
            system->retract(x.data(), motion.data(), &out[k * nx]);
        }
        return owned_array(std::move(out), {2, nx});
    }

    void hold(double t, const Array& force, bool keep) {
        system->hold(t, vector_of(force, system->nv, "force"), keep);
    }

    void move(nb::object to, const std::vector<Point>& origins) {
        system->move(pinocchio_model_in(to), origins);
        model = std::move(to);
    }

    void renew(nb::handle unit, nb::handle residual_scale, nb::handle damping, nb::handle friction,
               double friction_speed) {
        system->renew(optional_vector(unit), optional_vector(residual_scale),
                      optional_vector(damping), optional_vector(friction), friction_speed);
    }
};

void bind_system(nb::module_& m) {
    nb::class_<GeneratedTerms>(m, "GeneratedTerms")
        .def("__init__",
             [](GeneratedTerms* self, const std::string& path, const Array& parameters) {
                 new (self) GeneratedTerms(path, to_vector(parameters));
             },
             nb::arg("path"), nb::arg("parameters"))
        .def("with_parameters",
             [](const GeneratedTerms& self, const Array& parameters) {
                 return GeneratedTerms(self, to_vector(parameters));
             })
        .def_prop_ro("linearises", &GeneratedTerms::linearises);
    nb::class_<PySystem>(
        m, "System",
        nb::type_slots(collected<PySystem, &PySystem::model, &PySystem::controller,
                                             &PySystem::code>()))
        .def(nb::init<nb::object, const SystemData&, nb::object>(), nb::arg("model"),
             nb::arg("data"), nb::arg("controller").none())
        .def("terms", &PySystem::terms, nb::arg("t"), nb::arg("state"), nb::arg("threshold") = -1.0)
        .def("first_stage", &PySystem::first_stage)
        .def("repeat", &PySystem::repeat)
        .def("repeat_tree", &PySystem::repeat_tree)
        .def("between",
             [](PySystem& s, double first, double last) { s.system->between(first, last); })
        .def("begin_step",
             [](PySystem& s, double t, const Array& state) {
                 s.system->begin_step(t, vector_of(state, s.state_size(), "state"));
             })
        .def("closure_errors", &PySystem::closure_errors, nb::arg("t"), nb::arg("states"),
             nb::arg("with_energies") = false)
        .def("largest_errors", &PySystem::largest_errors, nb::arg("t"), nb::arg("q"), nb::arg("v"),
             nb::arg("unit"))
        .def("jacobians", &PySystem::jacobians)
        .def("rows_at", &PySystem::rows_at)
        .def("close", &PySystem::close, nb::arg("algebra"), nb::arg("row_unit"), nb::arg("units"),
             nb::arg("q"), nb::arg("limits"))
        .def("regular_start", &PySystem::regular_start, nb::arg("rules"), nb::arg("q"),
             nb::arg("v"), nb::arg("free_q"), nb::arg("free_v"), nb::arg("turning"),
             nb::arg("spreads"))
        .def("walk", &PySystem::walk, nb::arg("rows"), nb::arg("all"), nb::arg("loops"),
             nb::arg("in_units"), nb::arg("q"), nb::arg("sample_start"), nb::arg("directions"),
             nb::arg("reaches"), nb::arg("first").none())
        .def("open_norms", &PySystem::open_norms, nb::arg("rows"), nb::arg("all"),
             nb::arg("loops"), nb::arg("in_units"), nb::arg("q"), nb::arg("spreads"))
        .def("drive_forces", &PySystem::drive_forces)
        .def("reactions", &PySystem::reactions, nb::arg("all"), nb::arg("scale"),
             nb::arg("kept"), nb::arg("t"), nb::arg("states"))
        .def("accelerations", &PySystem::accelerations, nb::arg("t"), nb::arg("states"))
        .def("smallest_values", &PySystem::smallest_values)
        .def("largest_differences", &PySystem::largest_differences, nb::arg("from"), nb::arg("to"),
             nb::arg("unit"), nb::arg("order"), nb::arg("starts"), nb::arg("turned"),
             nb::arg("angles"))
        .def("moved", &PySystem::moved, nb::arg("states"), nb::arg("motions"))
        .def("energies", &PySystem::energies)
        .def("stage_powers", &PySystem::stage_powers, nb::arg("chosen"), nb::arg("times"),
             nb::arg("states"), nb::arg("rates"), nb::arg("A"), nb::arg("c"), nb::arg("elements"))
        .def("powers", &PySystem::powers, nb::arg("t"), nb::arg("states"), nb::arg("elements"),
             nb::arg("resting"))
        .def("linearisation", &PySystem::linearisation, nb::arg("constants"), nb::arg("t"),
             nb::arg("h"), nb::arg("state"), nb::arg("unit"), nb::arg("state_scale"),
             nb::arg("repeats") = 1)
        .def("impulse_response", &PySystem::impulse_response)
        .def("changed_states", &PySystem::changed_states)
        .def("states_ahead", &PySystem::states_ahead)
        .def("hold", &PySystem::hold)
        .def("use_code", &PySystem::use_code, nb::arg("code").none())
        .def("move", &PySystem::move, nb::arg("model"), nb::arg("origins"))
        .def("renew", &PySystem::renew, nb::arg("unit"), nb::arg("residual_scale"),
             nb::arg("damping").none(), nb::arg("friction").none(), nb::arg("friction_speed"))
        .def("restart", [](PySystem& s) { s.system->restart(); })
        .def_prop_ro("sparse", [](const PySystem& s) { return s.system->sparse(); })
        .def_prop_ro("evaluations", [](const PySystem& s) { return s.system->evaluations; })
        .def_prop_ro("factorisations",
                     [](const PySystem& s) { return s.system->factorisations(); });
}

// ---- Branch motion ------------------------------------------------------------------------------

struct PyBranchNodes {
    nb::object owner;  // kept alive
    System& system;
    BranchNodes nodes;

    PyBranchNodes(nb::object owner_, const Constants& constants)
        : owner(std::move(owner_)),
          system(*nb::cast<PySystem&>(owner).system),
          nodes(system, constants) {}

    // (state, rate, multiplier, moved, away) of a stage (nx,) along the direction `away` (nv,), or
    // None.
    nb::object solve(double t, const Array& state, const Array& away) {
        expect_size("state", state.size(), static_cast<std::size_t>(system.nq + system.nv));
        expect_size("away", away.size(), static_cast<std::size_t>(system.nv));
        const std::vector<double> direction = to_vector(away);
        system.evaluate(t, state.data(), System::ZoneView{});
        if (!nodes.solve(t, state.data(), direction)) return nb::none();
        return nb::make_tuple(owned_array(nodes.state), owned_array(nodes.rate),
                              owned_array(nodes.multiplier), owned_array(nodes.moved),
                              owned_array(nodes.away));
    }
};

struct PyBranchMotion {
    nb::object owner;  // kept alive
    System& system;
    BranchMotion motion;

    PyBranchMotion(nb::object owner_, const ButcherTableau& scheme, const Constants& constants,
                   const ErrorNorm& norm)
        : owner(std::move(owner_)),
          system(*nb::cast<PySystem&>(owner).system),
          motion(system, scheme, constants, norm) {}

    // The points after the first of `points`, which are solved, as far as they can be: (points,
    // state), state that of the point that needs a curve, or None.  `values` (k, nv) are the
    // multipliers at `times` (k,); with `extrapolated` > 0 those of as many solved points.
    nb::tuple nodes(const Array& times, const Array& values, std::vector<BranchPoint> points,
                    int extrapolated, double direct, nb::handle curve_or_none) {
        const BranchCurve* curve =
            curve_or_none.is_none() ? nullptr : &nb::cast<const BranchCurve&>(curve_or_none);
        const std::size_t nv = static_cast<std::size_t>(system.nv);
        if (points.empty() || times.ndim() != 1 || values.size() != times.size() * nv)
            throw nb::value_error("times, values and points do not fit");
        const double* t = times.data();
        MultiplierHistory known;
        known.nv = system.nv;
        known.times.assign(t, t + times.size());
        known.values.assign(values.data(), values.data() + values.size());
        nb::object left = nb::none();
        while (points.size() < times.size()) {
            const std::size_t last = points.size() - 1;
            if (extrapolated > 0) {
                const std::size_t first =
                    points.size() > static_cast<std::size_t>(extrapolated)
                        ? points.size() - static_cast<std::size_t>(extrapolated) : 0;
                known.times.assign(t + first, t + points.size());
                known.values.clear();
                for (std::size_t i = first; i < points.size(); ++i)
                    known.values.insert(known.values.end(), points[i].multiplier.begin(),
                                        points[i].multiplier.end());
            }
            BranchPoint point = points.back();
            motion.advance(t[last], t[last + 1], known, point);
            const std::vector<double> before = point.state;
            if (!motion.solve(t[last + 1], direct, curve, point)) {
                left = owned_array(before);
                break;
            }
            points.push_back(std::move(point));
        }
        return nb::make_tuple(std::move(points), left);
    }
};

void bind_branch_motion(nb::module_& m) {
    nb::class_<BranchPoint>(m, "BranchPoint")
        .def("__init__",
             [](BranchPoint* self, const Array& state, const Array& rate, const Array& multiplier,
                double sigma) {
                 new (self) BranchPoint{to_vector(state), to_vector(rate), to_vector(multiplier),
                                        sigma};
             })
        .def_prop_ro("state", [](const BranchPoint& p) { return owned_array(p.state); })
        .def_prop_ro("rate", [](const BranchPoint& p) { return owned_array(p.rate); })
        .def_prop_ro("multiplier", [](const BranchPoint& p) { return owned_array(p.multiplier); })
        .def_ro("sigma", &BranchPoint::sigma);
    nb::class_<PyBranchNodes>(
        m, "BranchNodes", nb::type_slots(collected<PyBranchNodes, &PyBranchNodes::owner>()))
        .def(nb::init<nb::object, const Constants&>(), nb::keep_alive<1, 3>())
        .def("solve", &PyBranchNodes::solve, nb::arg("t"), nb::arg("state"), nb::arg("away"));
    nb::class_<PyBranchMotion>(
        m, "BranchMotion", nb::type_slots(collected<PyBranchMotion, &PyBranchMotion::owner>()))
        .def(nb::init<nb::object, const ButcherTableau&, const Constants&, const ErrorNorm&>(),
             nb::keep_alive<1, 3>(), nb::keep_alive<1, 4>(), nb::keep_alive<1, 5>())
        .def("nodes", &PyBranchMotion::nodes, nb::arg("times"), nb::arg("values"),
             nb::arg("points"), nb::arg("extrapolated"), nb::arg("direct"),
             nb::arg("curve").none());
}

// ---- Run ----------------------------------------------------------------------------------------

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
                           tolerance.is_none() ? std::numeric_limits<double>::quiet_NaN()
                                               : nb::cast<double>(tolerance),
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

// The records of a run, and the shapes of their arrays.
struct PyRecords {
    StepRecords records;
    std::vector<double> end_rate;
    std::size_t nx, n, stages, corrected;  // stages: those of a step and its end
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
        : system(std::move(system_)), s(*nb::cast<PySystem&>(system).system) {
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
                                     scheme.controller_order, constants);
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
        // Numbers of steps and of those with a zone, the least sigma, whether a stage kept the
        // normals of the last node, and whether the problem was found to be stiff.
        .def_prop_ro("summary",
                     [](const PyRecords& r) {
                         const StepRecords& s = r.records;
                         const auto any = [](const std::vector<double>& flags) {
                             return std::any_of(flags.begin(), flags.end(),
                                                [](double flag) { return flag != 0.0; });
                         };
                         double least = std::numeric_limits<double>::infinity();
                         for (double sigma : s.sigmas)
                             if (sigma < least) least = sigma;
                         return nb::make_tuple(s.ranks.size(), s.zones.size(), least, any(s.held),
                                               any(s.stiff));
                     })
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

// ---- Dense output -------------------------------------------------------------------------------

#define SRM_PY_STEPS(field)                                                           \
    field(Array, times)             /* (k + 1,) */                                    \
    field(Array, states)            /* (k + 1, nx) */                                 \
    field(Array, rates)             /* (k, rates per step, n) */                      \
    field(Array, corrections)       /* (k, n), or (k, 0) without closures */          \
    field(Array, sigmas)            /* (k, stages + 1) */                             \
    field(Array, stiff)             /* (k,), not 0: of the scheme for stiff problems */ \
    field(Array, end_rate)          /* (n,) */                                        \
    field(Array, break_rates)       /* (breaks, n) */                                 \
    field(std::vector<long>, breaks)                                                  \
    field(std::vector<long>, zones) /* numbers of the steps with a zone */            \
    field(Array, layers)            /* (k, 2) */                                      \
    field(double, end)              /* of the run (s) */

// The accepted steps of a run, in NumPy arrays that are not copied.
struct PySteps {
    SRM_FIELDS(SRM_PY_STEPS)

    StepArrays arrays(int nq, int nv, std::size_t abscissae) const {
        const std::size_t k = rates.shape(0), n = 2 * static_cast<std::size_t>(nv);
        const bool corrected = corrections.ndim() == 2 && corrections.shape(1) > 0;
        expect("times", times, {k + 1});
        expect("states", states, {k + 1, static_cast<std::size_t>(nq + nv)});
        expect("rates", rates, {k, rates.ndim() == 3 ? rates.shape(1) : 0, n});
        expect("corrections", corrections, {k, corrected ? n : 0});
        expect("sigmas", sigmas, {k, abscissae});
        expect("stiff", stiff, {k});
        expect("end_rate", end_rate, {n});
        expect("break_rates", break_rates, {breaks.size(), n});
        StepArrays out;
        out.count = static_cast<long>(k);
        out.end = end;
        out.width = static_cast<int>(rates.shape(1));
        out.corrected = corrected;
        out.times = times.data();
        out.states = states.data();
        out.rates = rates.data();
        out.corrections = corrections.data();
        out.sigmas = sigmas.data();
        out.end_rate = end_rate.data();
        out.breaks = breaks;
        out.break_rates = break_rates.data();
        expect("layers", layers, {k, 2});
        out.layers = layers.data();
        out.stiff.resize(k);
        for (std::size_t i = 0; i < k; ++i) out.stiff[i] = stiff.data()[i] != 0.0;
        out.in_zone.assign(k, 0);
        for (long step : zones) {
            if (step < 0 || step >= out.count)
                throw nb::value_error("StepArrays.zones has a step that is not there");
            out.in_zone[static_cast<std::size_t>(step)] = 1;
        }
        return out;
    }

    static void expect(const char* field, const Array& array,
                       std::initializer_list<std::size_t> shape) {
        bool same = array.ndim() == shape.size();
        for (std::size_t i = 0; same && i < shape.size(); ++i)
            same = array.shape(i) == shape.begin()[i];
        if (same) return;
        const std::string place = std::string("StepArrays.") + field;
        throw nb::value_error((place + " has another shape").c_str());
    }
};

// The steps of plain `records`, in the memory of these, of a run that ended with the last of them or
// at `stop` (s) in it: without breakpoints, zones and layers.
StepArrays arrays(const PyRecords& records, std::optional<double> stop) {
    const StepRecords& r = records.records;
    StepArrays out;
    out.count = static_cast<long>(r.ranks.size());
    out.end = stop.value_or(r.times.back());
    out.width = static_cast<int>(records.stages);
    out.corrected = records.corrected > 0;
    out.times = r.times.data();
    out.states = r.states.data();
    out.rates = r.rates.data();
    out.corrections = r.corrections.data();
    out.sigmas = r.sigmas.data();
    out.end_rate = records.end_rate.data();
    out.stiff.assign(r.stiff.begin(), r.stiff.end());
    out.in_zone.assign(r.ranks.size(), 0);
    return out;
}

struct PyDense {
    nb::object records;  // kept alive, as the arrays of `steps`
    std::optional<PySteps> steps;
    DenseOutput dense;
    std::size_t nx;

    PyDense(int nq, int nv, const std::vector<SchemeDense>& schemes,
            const DenseConstants& constants, const PySteps& steps_)
        : steps(steps_),
          dense(nq, nv, schemes, constants,
                steps->arrays(nq, nv, schemes.empty() ? 0 : schemes[0].abscissae.size())),
          nx(static_cast<std::size_t>(nq + nv)) {}

    PyDense(const std::vector<SchemeDense>& schemes, const DenseConstants& constants,
            nb::object records_, std::optional<double> stop)
        : PyDense(schemes, constants, nb::cast<const PyRecords&>(records_), stop) {
        records = std::move(records_);
    }

    PyDense(const std::vector<SchemeDense>& schemes, const DenseConstants& constants,
            const PyRecords& from, std::optional<double> stop)
        : dense(static_cast<int>(from.nx - from.n / 2), static_cast<int>(from.n / 2), schemes,
                constants, arrays(from, stop)),
          nx(from.nx) {
        const std::size_t stages = schemes[0].abscissae.size();
        if (stages != from.stages) throw nb::value_error("the records have another number of stages");
    }

    nb::object states(PySystem& owner, const Array& t) {
        const std::size_t k = t.size();
        std::vector<double> out(k * nx);
        // With the interpreter's lock held: threads may read one solution, and share its workspace.
        dense.states(*owner.system, t.data(), static_cast<long>(k), out.data());
        return owned_array(std::move(out), {k, nx});
    }

    nb::object between_ends(PySystem& owner, const Array& t, const Array& allowed) {
        const std::size_t k = t.size();
        const double* within = vector_of(allowed, 2 * owner.system->nv, "allowed");
        std::vector<double> out(k * nx);
        dense.between_ends(*owner.system, t.data(), static_cast<long>(k), within, out.data());
        return owned_array(std::move(out), {k, nx});
    }
};

// Times (k,) of the samples of sigma, the dips and their tops; None if there are no dips.
nb::object py_recorded_dips(const DipSearch& search, const Array& times, const Array& sigmas,
                            double end) {
    if (sigmas.ndim() != 2 || sigmas.shape(0) < 1 || times.ndim() != 1 ||
        times.size() != sigmas.shape(0) + 1)
        throw nb::value_error("times and sigmas have other shapes");
    const long width = static_cast<long>(sigmas.shape(1));
    expect_within("columns", search.columns, 0, width - 1);
    SigmaDips found = recorded_dips(search, times.data(), sigmas.data(),
                                    static_cast<long>(sigmas.shape(0)), width, end);
    if (found.dips.empty()) return nb::none();
    return nb::make_tuple(owned_array(std::move(found.t)), found.dips, found.tops);
}

// Whether the plain records of a run have no dips; false for stiff steps.  `stop` as for arrays().
bool without_dips(const DipSearch& search, const PyRecords& records, std::optional<double> stop) {
    const StepArrays steps = arrays(records, stop);
    if (std::count(steps.stiff.begin(), steps.stiff.end(), 0) != steps.count) return false;
    const long width = static_cast<long>(records.stages);
    expect_within("columns", search.columns, 0, width - 1);
    return recorded_dips(search, steps.times, steps.sigmas, steps.count, width, steps.end)
        .dips.empty();
}

// Of each step with sigma (n, abscissae) whether its stages lie close to a singular configuration.
std::vector<bool> py_close_to_singular(const std::vector<double>& abscissae, const Array& sigmas,
                                       const DenseConstants& constants) {
    if (sigmas.ndim() != 2 || sigmas.shape(1) != abscissae.size())
        throw nb::value_error("sigmas has another shape");
    std::vector<bool> out(sigmas.shape(0));
    for (std::size_t i = 0; i < out.size(); ++i)
        out[i] = close_to_singular(abscissae, sigmas.data() + i * abscissae.size(),
                                   constants.close, constants.branch_below);
    return out;
}

void bind_dense_output(nb::module_& m) {
    m.def("recorded_dips", &py_recorded_dips);
    m.def("without_dips", &without_dips, nb::arg("search"), nb::arg("records"),
          nb::arg("stop").none());
    m.def("close_to_singular", &py_close_to_singular);
    bind_struct<PySteps>(m, "StepArrays");
    m.def("largest_norms", &largest_norms, nb::arg("x"), nb::arg("order"), nb::arg("starts"));
    nb::class_<PyDense>(m, "DenseOutput")
        .def(nb::init<int, int, const std::vector<SchemeDense>&, const DenseConstants&,
                      const PySteps&>(),
             nb::arg("nq"), nb::arg("nv"), nb::arg("schemes"), nb::arg("constants"),
             nb::arg("steps"))
        .def(nb::init<const std::vector<SchemeDense>&, const DenseConstants&, nb::object,
                      std::optional<double>>(),
             nb::arg("schemes"), nb::arg("constants"), nb::arg("records"), nb::arg("stop").none())
        .def("states", &PyDense::states)
        .def("between_ends", &PyDense::between_ends);
}

}  // namespace

NB_MODULE(_core, m) {
    // Results that live until the interpreter ends are no leak.
    nb::set_leak_warnings(false);
    m.doc() = "Compiled kernel of srm_mbs; srm_mbs.integration.kernel is its interface.";
    nb::register_exception_translator([](const std::exception_ptr& p, void*) {
        try {
            std::rethrow_exception(p);
        } catch (const EvaluationError&) {
            PyErr_SetString(PyExc_ArithmeticError, "the stage cannot be evaluated");
        }
    });
    m.def("lean_data",
          [](nb::object model) { return nb::steal(lean_data(pinocchio_model_in(model))); });
    m.def("tree_numbers", [](nb::handle model) {
        std::vector<double> placements, bodies;
        tree_numbers(pinocchio_model_in(model), placements, bodies);
        const std::size_t n = placements.size() / 12;
        return nb::make_tuple(owned_array(std::move(placements), {n, 12}),
                              owned_array(std::move(bodies), {n, 10}));
    });
    sleep_at_exit();
    m.def("enter_python", &enter_python);
    m.def("leave_python", &leave_python);
    bind_structs(m);
    bind_algebra(m);
    bind_system(m);
    bind_branch_motion(m);
    bind_run(m);
    bind_dense_output(m);
}
