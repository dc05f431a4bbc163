// Python classes of motions next to singular configurations.
#include <utility>
#include <vector>

#include "binding.hpp"
#include "branch_motion.hpp"
#include "branch_nodes.hpp"

namespace srm {

namespace {

struct PyBranchNodes {
    nb::object owner;  // kept alive
    System& system;
    BranchNodes nodes;

    PyBranchNodes(nb::object owner_, const Constants& constants, double singular)
        : owner(std::move(owner_)),
          system(system_in(owner)),
          nodes(system, constants, singular) {}

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
          system(system_in(owner)),
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

}  // namespace

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
        .def(nb::init<nb::object, const Constants&, double>(), nb::keep_alive<1, 3>())
        .def("solve", &PyBranchNodes::solve, nb::arg("t"), nb::arg("state"), nb::arg("away"));
    nb::class_<PyBranchMotion>(
        m, "BranchMotion", nb::type_slots(collected<PyBranchMotion, &PyBranchMotion::owner>()))
        .def(nb::init<nb::object, const ButcherTableau&, const Constants&, const ErrorNorm&>(),
             nb::keep_alive<1, 3>(), nb::keep_alive<1, 4>(), nb::keep_alive<1, 5>())
        .def("nodes", &PyBranchMotion::nodes, nb::arg("times"), nb::arg("values"),
             nb::arg("points"), nb::arg("extrapolated"), nb::arg("direct"),
             nb::arg("curve").none());
}

}  // namespace srm
