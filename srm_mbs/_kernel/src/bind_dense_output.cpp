// Python classes of dense output.
#include <algorithm>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "binding.hpp"
#include "dense.hpp"
#include "run_samples.hpp"
#include "sigma_dips.hpp"
#include "turns.hpp"

namespace srm {

namespace {

using Indices = nb::ndarray<const long, nb::c_contig, nb::device::cpu>;

#define SRM_PY_STEPS(field)                                                           \
    field(Array, times)             /* (k + 1,) */                                    \
    field(Array, states)            /* (k + 1, nx) */                                 \
    field(Array, rates)             /* (k, rates per step, n) */                      \
    field(Array, corrections)       /* (k, n), or (k, 0) without closures */          \
    field(Array, sigmas)            /* (k, stages + 1) */                             \
    field(Array, error_ratios)      /* (k,) */                                        \
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
        expect("error_ratios", error_ratios, {k});
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
        out.error_ratios = error_ratios.data();
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
    out.error_ratios = r.error_ratios.data();
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

    nb::object states(nb::handle owner, const Array& t) {
        System& system = system_in(owner);
        const std::size_t k = t.size();
        std::vector<double> out(k * nx);
        // With the interpreter's lock held: threads may read one solution, and share its workspace.
        dense.states(system, t.data(), static_cast<long>(k), out.data());
        return owned_array(std::move(out), {k, nx});
    }

    // RunSamples of run_samples.py.
    nb::tuple samples(nb::handle owner, const SampleRules& rules, nb::handle unit) {
        System& system = system_in(owner);
        const std::vector<double> units = numbers(unit, 2 * system.nv, "unit");
        SampleTimes found = sample_times(dense.steps(), rules, units, dense.takes_stages());
        const std::size_t k = found.t.size();
        std::vector<double> out(k * nx);
        dense.states(system, found.t.data(), static_cast<long>(k), out.data());
        return nb::make_tuple(owned_array(std::move(found.t)),
                              owned_array(std::move(out), {k, nx}), found.ends, found.whole);
    }

    // Works (k, elements) of `elements` from the start to the ends t (k,) of steps, ascending, by the
    // stages with these rows of A (stages, s), c and weights b; None where t has other times, or a
    // step has no stages on the motion.  owner: a system of all rows.
    nb::object works(nb::handle owner, const Array& t, const std::vector<ForceElement>& elements,
                     const Array& A, const Array& b, const Array& c) {
        System& system = system_in(owner);
        const StepArrays& all = dense.steps();
        const std::size_t stages = c.size(), m = elements.size(), width = all.width;
        if (!stages || b.size() != stages || A.size() % stages || A.size() / stages > width)
            throw nb::value_error("A, b or c has another shape");
        const StageArrays arrays{all.times, all.states, all.rates, A.data(),
                                 c.data(),  width,      A.size() / stages, stages};
        const std::size_t n = t.size();
        std::vector<long> steps;
        for (long step = 0; step < all.count && n && all.times[step] < t.data()[n - 1]; ++step) {
            if (!dense.has_stages(step)) return nb::none();
            steps.push_back(step);
        }
        std::vector<double> work(m, 0.0), powers(steps.size() * stages * m), out;
        system.stage_powers(steps, arrays, system.separate(elements), powers.data());
        const double* power = powers.data();
        for (std::size_t step = 0, end = 0; end < n; ++step, power += stages * m) {
            if (all.times[step] == t.data()[end]) {
                out.insert(out.end(), work.begin(), work.end());
                ++end;
            }
            if (step == steps.size()) {
                if (end < n) return nb::none();
                break;
            }
            const double h = all.times[step + 1] - all.times[step];
            for (std::size_t e = 0; e < m; ++e) {
                double mean = 0.0;
                for (std::size_t i = 0; i < stages; ++i) mean += b.data()[i] * power[i * m + e];
                work[e] += h * mean;
            }
        }
        return owned_array(std::move(out), {n, m});
    }

    nb::object between_ends(nb::handle owner, const Array& t, const Array& allowed) {
        System& system = system_in(owner);
        const std::size_t k = t.size();
        const double* within = vector_of(allowed, 2 * system.nv, "allowed");
        std::vector<double> out(k * nx);
        EndReadings known;
        dense.between_ends(system, t.data(), static_cast<long>(k), within, known, out.data());
        return owned_array(std::move(out), {k, nx});
    }

    // Of the dips (n, 3) and tops (n,) of dips_of(): numbers of those at no turn, and the turns
    // beyond singular configurations.  tolerance: as of recorded_turns().
    nb::tuple turns(nb::handle owner, nb::handle rows_owner, const SeparatedRows& rows,
                    const TurnSearch& search, const DipSearch& dips, const Indices& samples,
                    const Indices& tops, double tolerance, const Constants& constants) {
        System &system = system_in(owner), &all_rows = system_in(rows_owner);
        const std::size_t n = tops.size(), count = rows.supports.size();
        if (samples.ndim() != 2 || samples.shape(0) != n || samples.shape(1) != 3)
            throw nb::value_error("dips and tops have other shapes");
        expect_size("rows", count, static_cast<std::size_t>(all_rows.rows()));
        const int width = system.nv + (system.driven() ? 1 : 0);
        expect_size("factors", rows.factors.size(), count * width);
        expect_size("unit", search.unit.size(), static_cast<std::size_t>(system.nv));
        expect_within("columns", search.columns, 0, system.nv - 1);
        expect_within("rank", search.rank, 1, std::min<long>(width, static_cast<long>(count)));
        expect_within("columns", dips.columns, 0, dense.sigma_width() - 1);
        const long last = dense.steps().count * static_cast<long>(dips.columns.size());
        SigmaDips recorded;
        for (std::size_t i = 0; i < n; ++i) {
            const long* dip = samples.data() + 3 * i;
            for (const long sample : {dip[0], dip[1], dip[2], tops.data()[i]})
                expect_within("dips", sample, 0, last);
            if (dip[2] < 1) throw nb::value_error("a dip ends at the start of the run");
            recorded.dips.push_back({dip[0], dip[1], dip[2]});
            recorded.tops.push_back(tops.data()[i]);
        }
        const Turns found = recorded_turns(search, rows, all_rows, dips, recorded, dense, system,
                                           tolerance, constants);
        nb::list beyond;
        for (const Turn& turn : found.beyond)
            beyond.append(nb::make_tuple(turn.times, turn.values, turn.top));
        std::vector<long> others;
        for (std::size_t i = 0; i < n; ++i)
            if (!found.found[i]) others.push_back(static_cast<long>(i));
        return nb::make_tuple(owned_array(std::move(others)), beyond);
    }
};

// The dips (n, 3) and their tops (n,); None if there are none.
nb::object dips_of(const DipSearch& search, const double* times, const double* sigmas, long steps,
                   std::size_t width, double end) {
    expect_within("columns", search.columns, 0, static_cast<long>(width) - 1);
    SigmaDips found =
        recorded_dips(search, times, sigmas, steps, static_cast<long>(width), end);
    const std::size_t n = found.dips.size();
    if (n == 0) return nb::none();
    std::vector<long> dips;
    dips.reserve(3 * n);
    for (const auto& dip : found.dips) dips.insert(dips.end(), dip.begin(), dip.end());
    return nb::make_tuple(owned_array(std::move(dips), {n, 3}), owned_array(std::move(found.tops)));
}

nb::object py_recorded_dips(const DipSearch& search, const Array& times, const Array& sigmas,
                            double end) {
    if (sigmas.ndim() != 2 || sigmas.shape(0) < 1 || times.ndim() != 1 ||
        times.size() != sigmas.shape(0) + 1)
        throw nb::value_error("times and sigmas have other shapes");
    return dips_of(search, times.data(), sigmas.data(), static_cast<long>(sigmas.shape(0)),
                   sigmas.shape(1), end);
}

// Those of the plain records of a run without stiff steps.  `stop` as for arrays().
nb::object dips_of_records(const DipSearch& search, const PyRecords& records,
                           std::optional<double> stop) {
    const StepArrays steps = arrays(records, stop);
    return dips_of(search, steps.times, steps.sigmas, steps.count, records.stages, steps.end);
}

// Of each step with sigma (n, abscissae) 1 if its stages lie close to a singular configuration, else
// 0.
nb::object py_close_to_singular(const std::vector<double>& abscissae, const Array& sigmas,
                                const DenseConstants& constants) {
    if (sigmas.ndim() != 2 || sigmas.shape(1) != abscissae.size())
        throw nb::value_error("sigmas has another shape");
    std::vector<double> out(sigmas.shape(0));
    for (std::size_t i = 0; i < out.size(); ++i)
        out[i] = close_to_singular(abscissae, sigmas.data() + i * abscissae.size(),
                                   constants.close, constants.branch_below);
    return owned_array(std::move(out));
}

}  // namespace

void bind_dense_output(nb::module_& m) {
    m.def("recorded_dips", &py_recorded_dips);
    m.def("dips_of_records", &dips_of_records, nb::arg("search"), nb::arg("records"),
          nb::arg("stop").none());
    m.def("close_to_singular", &py_close_to_singular);
    bind_struct<PySteps>(m, "StepArrays");
    nb::class_<PyDense>(m, "DenseOutput")
        .def(nb::init<int, int, const std::vector<SchemeDense>&, const DenseConstants&,
                      const PySteps&>(),
             nb::arg("nq"), nb::arg("nv"), nb::arg("schemes"), nb::arg("constants"),
             nb::arg("steps"))
        .def(nb::init<const std::vector<SchemeDense>&, const DenseConstants&, nb::object,
                      std::optional<double>>(),
             nb::arg("schemes"), nb::arg("constants"), nb::arg("records"), nb::arg("stop").none())
        .def("states", &PyDense::states)
        .def("samples", &PyDense::samples)
        .def("works", &PyDense::works)
        .def("between_ends", &PyDense::between_ends)
        .def("turns", &PyDense::turns);
}

}  // namespace srm
