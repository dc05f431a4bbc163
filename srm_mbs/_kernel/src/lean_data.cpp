#include "lean_data.hpp"

#include <pinocchio/algorithm/joint-configuration.hpp>

namespace pinocchio_model {

namespace {

using pinocchio::Data;
using pinocchio::JointIndex;
using pinocchio::Model;

// The supports and subtrees of the rows of M, as the constructor finds them for models without
// mimic joints.
void find_rows(Data& data, const Model& model) {
    const auto count = static_cast<JointIndex>(model.njoints);
    data.nvSubtree.assign(count, 0);
    for (JointIndex i = count; i-- > 0;) {
        const JointIndex parent = model.parents[i];
        data.nvSubtree[i] += model.joints[i].nv();
        data.nvSubtree[parent] += data.nvSubtree[i];
    }
    const auto rows = static_cast<std::size_t>(model.nv);
    for (auto* list : {&data.parents_fromRow, &data.mimic_parents_fromRow,
                       &data.non_mimic_parents_fromRow, &data.nvSubtree_fromRow,
                       &data.start_idx_v_fromRow, &data.end_idx_v_fromRow,
                       &data.idx_vExtended_to_idx_v_fromRow})
        list->assign(rows, -1);
    data.supports_fromRow.assign(rows, {});
    for (JointIndex i = 1; i < count; ++i) {
        const JointIndex parent = model.parents[i];
        const int first = model.idx_vs[i], size = model.nvs[i];
        for (int row = first; row < first + size; ++row) {
            const auto at = static_cast<std::size_t>(row);
            const int above = row > first  ? row - 1
                              : parent > 0 ? model.idx_vs[parent] + model.nvs[parent] - 1
                                           : -1;
            data.parents_fromRow[at] = data.non_mimic_parents_fromRow[at] = above;
            // Set for the rows of a joint after its first, as by the constructor.
            if (row > first) data.mimic_parents_fromRow[at] = above;
            data.nvSubtree_fromRow[at] = data.nvSubtree[i] - (row - first);
            data.start_idx_v_fromRow[at] = first;
            data.end_idx_v_fromRow[at] = first + size - 1;
            data.idx_vExtended_to_idx_v_fromRow[at] = row;
            if (above >= 0)
                data.supports_fromRow[at] = data.supports_fromRow[static_cast<std::size_t>(above)];
            data.supports_fromRow[at].push_back(row);
        }
    }
}

}  // namespace

void prepare(Data& data, const Model& model, bool local_crba) {
    if (!model.mimicking_joints.empty()) {
        data = Data(model);
        return;
    }
    const auto count = static_cast<std::size_t>(model.njoints);
    const Eigen::Index nv = model.nv;
    data.q_in = pinocchio::neutral(model);
    for (auto* vector : {&data.v_in, &data.a_in, &data.tau_in, &data.tau, &data.ddq,
                         &data.dq_after})
        vector->setZero(nv);
    for (auto* vector : {&data.nle, &data.g, &data.u, &data.D, &data.Dinv, &data.tmp,
                         &data.torque_residual})
        vector->setZero(nv);
    for (auto* list : {&data.a, &data.oa, &data.oa_drift, &data.oa_augmented, &data.a_gf,
                       &data.oa_gf, &data.v, &data.ov, &data.a_bias})
        list->assign(count, pinocchio::Motion::Zero());
    for (auto* list : {&data.f, &data.of, &data.of_augmented, &data.h, &data.oh})
        list->assign(count, pinocchio::Force::Zero());
    for (auto* list : {&data.oMi, &data.liMi, &data.iMf})
        list->assign(count, pinocchio::SE3::Identity());
    data.oMf.assign(static_cast<std::size_t>(model.nframes), pinocchio::SE3::Identity());
    for (auto* list : {&data.Ycrb, &data.oinertias, &data.oYcrb})
        list->assign(count, pinocchio::Inertia::Zero());
    for (auto* list : {&data.dYcrb, &data.vxI, &data.Ivx, &data.B, &data.doYcrb, &data.Yaba,
                       &data.oYaba, &data.oYaba_augmented, &data.oL, &data.oK})
        list->assign(count, pinocchio::Inertia::Matrix6::Zero());
    data.M.setZero(nv, nv);
    for (auto* matrix : {&data.dHdq, &data.dFdq, &data.dFdv, &data.dFda, &data.SDinv, &data.UDinv,
                         &data.IS, &data.Ag, &data.dAg, &data.J, &data.dJ, &data.ddJ, &data.psid,
                         &data.psidd, &data.dVdq, &data.dAdq, &data.dAdv})
        matrix->setZero(6, nv);
#ifdef NDEBUG
    const std::size_t frames = local_crba ? count : 1;
#else
    const std::size_t frames = count;  // at which Pinocchio's assertions look
#endif
    data.Fcrb.resize(count);
    for (std::size_t i = 0; i < frames; ++i) data.Fcrb[i].setZero(6, nv);
    data.hg.setZero();
    data.dhg.setZero();
    data.Ig.setZero();
    for (auto* list : {&data.com, &data.vcom, &data.acom})
        list->assign(count, Eigen::Vector3d::Zero());
    data.mass.assign(count, -1.0);
    data.Jcom.setZero(3, nv);
    data.kinetic_energy = data.potential_energy = data.mechanical_energy = 0.0;
    int widest = 0;
    for (int size : model.nvs) widest = std::max(widest, size);
    data.joint_apparent_inertia =
        Data::DynamicMatrixStack(count, static_cast<std::size_t>(widest) * widest);
    for (std::size_t i = 0; i < count; ++i) {
        data.joints.push_back(model.joints[i].createData());
        data.joint_apparent_inertia.push_back(model.nvs[i], model.nvs[i]);
        data.joint_apparent_inertia.back().setZero();
    }
    data.joints_augmented = data.joints;
    find_rows(data, model);
    data.a_gf[0] = -model.gravity;
}

}  // namespace pinocchio_model
