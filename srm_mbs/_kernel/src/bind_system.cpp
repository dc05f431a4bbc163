// Python class of systems.
#include <algorithm>
#include <cmath>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "algebra.hpp"
#include "binding.hpp"
#include "errors.hpp"
#include "interpreter.hpp"
#include "limits.hpp"
#include "linear.hpp"
#include "manifold.hpp"
#include "regular_start.hpp"
#include "separated_rows.hpp"

namespace srm {

namespace {

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

    // See srm::motion_in_layer().
    std::optional<MotionAlongCurve> motion_in_layer(double t, const Array& state, double time_unit,
                                                    double tolerance, double reach,
                                                    const Constants& constants) {
        vector_of(state, state_size(), "state");
        return srm::motion_in_layer(*system, t, to_vector(state), time_unit, tolerance, reach,
                                    constants);
    }

    // q (nq,), t (s) and residual of srm::critical_near(), from a place q at t; None if there is none.
    nb::object critical_near(double t, const Array& q, double time_unit, double reach,
                             const Constants& constants) {
        vector_of(q, system->nq, "q");
        std::vector<double> x = to_vector(q);
        x.resize(state_size());
        UnitClosures closures(*system, time_unit);
        auto found = srm::critical_near(closures, t, x, reach, constants);
        if (!found) return nb::none();
        found->x.resize(static_cast<std::size_t>(system->nq));
        return nb::make_tuple(owned_array(std::move(found->x)), found->t, found->residual);
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

    // g - s and G v - s' (n, rows).
    nb::tuple closure_errors(const Array& t, const Array& states) {
        const std::size_t n = count_of(t, states, state_size()), nx = state_size();
        const auto rows = static_cast<std::size_t>(system->rows());
        std::vector<double> g(n * rows), rates(n * rows);
        const double *times = t.data(), *x = states.data();
        on_states(n, [&] {
            for (std::size_t i = 0; i < n; ++i)
                system->closure_errors(times[i], x + i * nx, g.data() + i * rows,
                                       rates.data() + i * rows);
        });
        return nb::make_tuple(owned_array(std::move(g), {n, rows}),
                              owned_array(std::move(rates), {n, rows}));
    }

    // Invariants of dynamics/observables.py: the largest norms (LargestNorms) of groups of g - s and
    // of G v - s' at those of the first `whole` states that are `ends` of steps, the same at the
    // others, and the energies (k, 2) at all ends.
    nb::tuple invariants(const Array& t, const Array& states, const std::vector<std::size_t>& ends,
                         std::size_t whole, const std::vector<int>& order,
                         const std::vector<int>& starts) {
        const std::size_t n = count_of(t, states, state_size()), nx = state_size();
        const auto rows = static_cast<std::size_t>(system->rows());
        if (whole > n || (!ends.empty() && ends.back() >= n) ||
            !std::is_sorted(ends.begin(), ends.end()))
            throw nb::value_error("whole or ends is not of the states");
        std::vector<double> g(rows), rates(rows), energies;
        const LargestNorms none(order, starts, rows);
        LargestNorms norms[2][2] = {{none, none}, {none, none}};
        const double *times = t.data(), *x = states.data();
        on_states(n, [&] {
            auto end = ends.begin();
            for (std::size_t i = 0; i < n; ++i) {
                const bool at_end = end != ends.end() && *end == i;
                system->closure_errors(times[i], x + i * nx, g.data(), rates.data());
                if (i < whole) {
                    norms[at_end][0].take(g.data());
                    norms[at_end][1].take(rates.data());
                }
                if (!at_end) continue;
                const auto found = system->energies(x + i * nx, true);
                energies.insert(energies.end(), found.begin(), found.end());
                ++end;
            }
        });
        const auto largest = [](const LargestNorms (&of)[2]) {
            std::vector<double> out = of[0].norms();
            for (const double norm : of[1].norms()) out.push_back(norm);
            return out;
        };
        return nb::make_tuple(largest(norms[1]), largest(norms[0]),
                              owned_array(std::move(energies), {ends.size(), 2}));
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
                    std::fill_n(out.begin() + i * m, m, not_a_number);
            }
        });
        return owned_array(std::move(out), {n, m});
    }

    // Of n states: multipliers (n, rows), wrenches (n, closures, 6) and (n, joints, 6); see
    // System::reactions.  At each state one of the `forces` (n, nv) is held from then on, if there
    // are any.
    nb::tuple reactions(PySystem& all, const Array& scale, const std::vector<int>& kept,
                        const Array& t, const Array& states, std::optional<Array> forces) {
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
        if (forces) expect_size("forces", forces->size(), n * system->nv);
        const double* const force = forces ? forces->data() : nullptr;
        const auto find = [&] {
            for (std::size_t i = 0; i < n; ++i) {
                if (force) system->hold(-infinity, force + i * system->nv, false);
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
        // From one state to the next, often close to it, the singular vector changes little.
        std::vector<double> out(n), G(all * width), left_vector;
        // With the interpreter's lock: threads may share the algebra.
        for (std::size_t i = 0; i < n; ++i)
            out[i] = rows.smallest(*system, algebra, t.data()[i], q.data() + i * system->nq, G,
                                   &left_vector);
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

}  // namespace

System& system_in(nb::handle object) {
    return *nb::cast<PySystem&>(object).system;
}

void bind_system(nb::module_& m) {
    m.def("largest_norms", &largest_norms, nb::arg("x"), nb::arg("order"), nb::arg("starts"));
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
        .def("motion_in_layer", &PySystem::motion_in_layer)
        .def("critical_near", &PySystem::critical_near)
        .def("repeat", &PySystem::repeat)
        .def("repeat_tree", &PySystem::repeat_tree)
        .def("between",
             [](PySystem& s, double first, double last) { s.system->between(first, last); })
        .def("begin_step",
             [](PySystem& s, double t, const Array& state) {
                 s.system->begin_step(t, vector_of(state, s.state_size(), "state"));
             })
        .def("closure_errors", &PySystem::closure_errors, nb::arg("t"), nb::arg("states"))
        .def("invariants", &PySystem::invariants, nb::arg("t"), nb::arg("states"), nb::arg("ends"),
             nb::arg("whole"), nb::arg("order"), nb::arg("starts"))
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
             nb::arg("kept"), nb::arg("t"), nb::arg("states"), nb::arg("forces").none())
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

}  // namespace srm
