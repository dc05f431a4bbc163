// Powers of force elements: Observables.powers and stage_powers of dynamics/observables.py.
#include <algorithm>
#include <vector>

#include <pinocchio/algorithm/jacobian.hpp>

#include "linear.hpp"
#include "system.hpp"
#include "workspace.hpp"

namespace srm {

namespace {

// Others depend on coordinates alone.
bool on_bodies(const ForceElement& e) {
    return e.kind == ForceKind::spring_damper || e.kind == ForceKind::wrench ||
           e.kind == ForceKind::bushing;
}

void sort_unique(std::vector<int>& list) {
    std::sort(list.begin(), list.end());
    list.erase(std::unique(list.begin(), list.end()), list.end());
}

}  // namespace

SeparateElements System::separate(const std::vector<ForceElement>& elements) const {
    const auto& model = work_->model;
    SeparateElements out;
    for (const ForceElement& e : elements) {
        check_indices(e, nq, nv, model.njoints);
        out.each.push_back({e});
        std::vector<int> acted_on;
        if (on_bodies(e)) {
            for (const int body : {e.a.joint, e.b.joint})
                for (const auto joint : model.supports[body])
                    if (joint > 0) out.joints.push_back(static_cast<int>(joint));
        } else if (e.kind == ForceKind::coupling_spring) {
            acted_on = e.columns;
        } else {
            const int count =
                e.kind == ForceKind::joint_torque ? static_cast<int>(e.numbers.size()) : 1;
            for (int i = 0; i < count; ++i) acted_on.push_back(e.in_v + i);
        }
        out.coordinates.insert(out.coordinates.end(), acted_on.begin(), acted_on.end());
        out.acted_on.push_back(std::move(acted_on));
    }
    sort_unique(out.joints);
    for (const int joint : out.joints)
        for (int i = 0; i < model.nvs[joint]; ++i)
            out.coordinates.push_back(model.idx_vs[joint] + i);
    sort_unique(out.coordinates);
    return out;
}

void System::powers(const double* t, const double* states, std::size_t n,
                    const SeparateElements& elements, bool resting, double* out) {
    auto& w = *work_;
    std::vector<BushingStep> none;
    const bool bodies = !elements.joints.empty();
    std::vector<double> wrenches(6 * w.model.njoints);
    const auto power_on = [&](int joint) {
        const pinocchio::Motion motion = w.data.oMi[joint].act(w.data.v[joint]);
        return dot(&wrenches[6 * joint], motion.toVector().data(), 6);
    };
    for (std::size_t i = 0; i < n; ++i, states += nq + nv) {
        const double* const v = states + nq;
        w.place(states);
        if (resting) w.v.setZero();
        else std::copy(v, v + nv, w.v.data());
        // Bodies that move tell the power of a wrench, which takes no Jacobian.
        if (bodies) pinocchio_model::move_bodies(w, resting ? nullptr : &elements.joints);
        if (bodies && resting) pinocchio::computeJointJacobians(w.model, w.data);
        for (std::size_t k = 0; k < elements.each.size(); ++k) {
            const std::vector<ForceElement>& one = elements.each[k];
            const std::vector<int>& acted_on = elements.acted_on[k];
            const ForceElement& e = one.front();
            if (!resting && e.kind == ForceKind::spring_damper) {
                *out++ = spring_damper_power(e, data_.coincident, w);
                continue;
            }
            const bool by_wrenches = !resting && on_bodies(e);
            if (by_wrenches)
                for (const int joint : {e.a.joint, e.b.joint})
                    std::fill_n(&wrenches[6 * joint], 6, 0.0);
            else if (acted_on.empty())
                std::fill(f_.begin(), f_.end(), 0.0);
            else
                for (const int j : acted_on) f_[j] = 0.0;
            add_forces(one, data_.coincident, w, t[i], states, w.v.data(), none,
                       by_wrenches ? nullptr : f_.data(), nullptr,
                       by_wrenches ? wrenches.data() : nullptr);
            double power = 0.0;
            if (by_wrenches)
                power = power_on(e.a.joint) +
                        (e.a.joint == e.b.joint ? 0.0 : power_on(e.b.joint));
            else if (acted_on.empty())
                power = dot(f_.data(), v, nv);
            else
                for (const int j : acted_on) power += f_[j] * v[j];
            *out++ = power;
        }
    }
}

void System::stage_powers(const std::vector<long>& chosen, const StageArrays& steps,
                          const SeparateElements& elements, double* out) {
    const auto nx = static_cast<std::size_t>(nq + nv), n = 2 * static_cast<std::size_t>(nv);
    // The other coordinates stay where the step starts.
    std::vector<int> entries = elements.coordinates;
    for (const int i : elements.coordinates) entries.push_back(nv + i);
    const std::size_t k = entries.size(), s = steps.rows, stages = steps.stages;
    std::vector<double> rates(s * k), sum(k), moved(n), x(stages * nx), t(stages);
    for (const long step : chosen) {
        const double h = steps.times[step + 1] - steps.times[step];
        const double* const own = steps.rates + step * steps.width * n;
        for (std::size_t j = 0; j < s; ++j)
            for (std::size_t e = 0; e < k; ++e) rates[j * k + e] = own[j * n + entries[e]];
        for (std::size_t i = 0; i < stages; ++i) {
            combine(h, steps.A + i * s, static_cast<int>(s), rates.data(), static_cast<int>(k),
                    sum.data());
            for (std::size_t e = 0; e < k; ++e) moved[entries[e]] = sum[e];
            retract_some(steps.states + step * nx, moved.data(), elements.coordinates, &x[i * nx]);
            t[i] = steps.times[step] + h * steps.c[i];
        }
        powers(t.data(), x.data(), stages, elements, false, out);
        out += stages * elements.each.size();
    }
}

}  // namespace srm
