// The Python module, and the structs that Python fills.
#include "algebra.hpp"
#include "binding.hpp"
#include "branch_motion.hpp"
#include "constants.hpp"
#include "dense.hpp"
#include "errors.hpp"
#include "event_search.hpp"
#include "interpreter.hpp"
#include "manifold.hpp"
#include "regular_start.hpp"
#include "run_samples.hpp"
#include "separated_rows.hpp"
#include "sigma_dips.hpp"
#include "turns.hpp"

using namespace srm;

namespace {

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
    bind_struct<SampleRules>(m, "SampleRules");
    bind_struct<DipSearch>(m, "DipSearch");
    bind_struct<TurnSearch>(m, "TurnSearch");
    bind_struct<EventConstants>(m, "EventConstants");
    bind_struct<BranchCurve>(m, "BranchCurve");
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
