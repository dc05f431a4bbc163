#include "terms.hpp"

#include <type_traits>

#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/rnea.hpp>

#include "workspace.hpp"

namespace pinocchio_model {

namespace {

using pinocchio::Data;
using pinocchio::JointDataBase;
using pinocchio::JointIndex;
using pinocchio::JointModelBase;
using pinocchio::Model;

using CrbaBackward =
    pinocchio::impl::CrbaWorldConventionBackwardStep<double, 0, pinocchio::JointCollectionDefaultTpl>;

template <typename Joint, typename... Kinds>
constexpr bool is_one_of = (std::is_same_v<Joint, Kinds> || ...);

using Joints = pinocchio::JointCollectionDefault;

template <typename Joint>
constexpr bool usual =
    is_one_of<Joint, Joints::JointModelRX, Joints::JointModelRY, Joints::JointModelRZ,
              Joints::JointModelRevoluteUnaligned, Joints::JointModelRUBX, Joints::JointModelRUBY,
              Joints::JointModelRUBZ, Joints::JointModelRevoluteUnboundedUnaligned,
              Joints::JointModelPX, Joints::JointModelPY, Joints::JointModelPZ,
              Joints::JointModelPrismaticUnaligned, Joints::JointModelSpherical,
              Joints::JointModelPlanar, Joints::JointModelFreeFlyer>;

struct IsUsual : boost::static_visitor<bool> {
    template <typename Joint>
    bool operator()(const Joint&) const {
        return usual<Joint>;
    }
};

using AtState = boost::fusion::vector<const Model&, Data&, const Argument&, const Argument&>;

// Placement of the body of a joint whose own data are computed.
template <typename JointModel>
void place_body(const JointModelBase<JointModel>& jmodel,
                const JointDataBase<typename JointModel::JointDataDerived>& jdata,
                const Model& model, Data& data) {
    const JointIndex i = jmodel.id(), parent = model.parents[i];
    data.liMi[i] = model.jointPlacements[i] * jdata.M();
    if (parent > 0) data.oMi[i] = data.oMi[parent] * data.liMi[i];
    else data.oMi[i] = data.liMi[i];
}

// JointJacobiansForwardStep, flattened as those below.
struct Place : pinocchio::fusion::JointUnaryVisitorBase<Place> {
    using ArgsType = boost::fusion::vector<const Model&, Data&, const Argument&>;

    template <typename JointModel>
    [[gnu::flatten]] static void algo(const JointModelBase<JointModel>& jmodel,
                                      JointDataBase<typename JointModel::JointDataDerived>& jdata,
                                      const Model& model, Data& data, const Argument& q) {
        if constexpr (usual<JointModel>) {
            jmodel.calc(jdata.derived(), q);
            place_body(jmodel, jdata, model, data);
            jmodel.jointExtendedModelCols(data.J) = data.oMi[jmodel.id()].act(jdata.S());
        }
    }
};

// Placement and velocity of the body of a joint: ForwardKinematicFirstStep.
template <typename JointModel>
void move_body(const JointModelBase<JointModel>& jmodel,
               JointDataBase<typename JointModel::JointDataDerived>& jdata, const Model& model,
               Data& data, const Argument& q, const Argument& v) {
    const JointIndex i = jmodel.id(), parent = model.parents[i];
    jmodel.calc(jdata.derived(), q, v);
    place_body(jmodel, jdata, model, data);
    data.v[i] = jdata.v();
    if (parent > 0) data.v[i] += data.liMi[i].actInv(data.v[parent]);
}

// Flattened, because products of six numbers cost less than calls.
struct Move : pinocchio::fusion::JointUnaryVisitorBase<Move> {
    using ArgsType = AtState;

    template <typename JointModel>
    [[gnu::flatten]] static void algo(const JointModelBase<JointModel>& jmodel,
                                      JointDataBase<typename JointModel::JointDataDerived>& jdata,
                                      const Model& model, Data& data, const Argument& q,
                                      const Argument& v) {
        if constexpr (usual<JointModel>) move_body(jmodel, jdata, model, data, q, v);
    }
};

// CrbaWorldConventionForwardStep and NLEForwardStep.
struct Forward : pinocchio::fusion::JointUnaryVisitorBase<Forward> {
    using ArgsType = AtState;

    template <typename JointModel>
    [[gnu::flatten]] static void algo(const JointModelBase<JointModel>& jmodel,
                                      JointDataBase<typename JointModel::JointDataDerived>& jdata,
                                      const Model& model, Data& data, const Argument& q,
                                      const Argument& v) {
        if constexpr (usual<JointModel>) {
            const JointIndex i = jmodel.id(), parent = model.parents[i];
            move_body(jmodel, jdata, model, data, q, v);
            jmodel.jointExtendedModelCols(data.J) = data.oMi[i].act(jdata.S());
            data.oYcrb[i] = data.oMi[i].act(model.inertias[i]);
            data.a_gf[i] = jdata.c() + (data.v[i] ^ jdata.v());
            data.a_gf[i] += data.liMi[i].actInv(data.a_gf[parent]);
            data.f[i] = model.inertias[i] * data.a_gf[i] + model.inertias[i].vxiv(data.v[i]);
        }
    }
};

// CrbaWorldConventionBackwardStep and NLEBackwardStep.
struct Backward : pinocchio::fusion::JointUnaryVisitorBase<Backward> {
    using ArgsType = boost::fusion::vector<const Model&, Data&>;

    template <typename JointModel>
    [[gnu::flatten]] static void algo(const JointModelBase<JointModel>& jmodel,
                                      JointDataBase<typename JointModel::JointDataDerived>& jdata,
                                      const Model& model, Data& data) {
        if constexpr (usual<JointModel>) {
            CrbaBackward::algo(jmodel, model, data);
            const JointIndex i = jmodel.id(), parent = model.parents[i];
            jmodel.JointMappedVelocitySelector(data.nle) += jdata.S().transpose() * data.f[i];
            if (parent > 0) data.f[parent] += data.liMi[i].act(data.f[i]);
        }
    }
};

}  // namespace

bool has_usual_joints(const Model& model) {
    for (std::size_t i = 1; i < model.joints.size(); ++i)
        if (!boost::apply_visitor(IsUsual(), model.joints[i].toVariant())) return false;
    return true;
}

void place_bodies(Workspace& work) {
    const Model& model = work.model;
    const Argument q(work.q);
    if (!work.one_pass) {
        pinocchio::computeJointJacobians(model, work.data, q);
        return;
    }
    for (int i = 1; i < model.njoints; ++i)
        Place::run(model.joints[i], work.data.joints[i], Place::ArgsType(model, work.data, q));
}

void move_bodies(Workspace& work, const std::vector<int>* joints) {
    const Model& model = work.model;
    Data& data = work.data;
    const Argument q(work.q), v(work.v);
    if (!work.one_pass) {
        pinocchio::forwardKinematics(model, data, q, v);
        return;
    }
    data.v[0].setZero();
    const auto move = [&](int i) {
        Move::run(model.joints[i], data.joints[i], AtState(model, data, q, v));
    };
    if (joints)
        for (const int i : *joints) move(i);
    else
        for (int i = 1; i < model.njoints; ++i) move(i);
}

void compute_terms(Workspace& work) {
    const Model& model = work.model;
    Data& data = work.data;
    const Argument q(work.q), v(work.v);
    if (!work.one_pass) {
        pinocchio::crba(model, data, q, pinocchio::Convention::WORLD);
        pinocchio::nonLinearEffects(model, data, q, v);
        return;
    }
    data.oYcrb[0].setZero();
    data.nle.setZero();
    data.v[0].setZero();
    data.a_gf[0] = -model.gravity;
    const auto count = static_cast<JointIndex>(model.njoints);
    for (JointIndex i = 1; i < count; ++i)
        Forward::run(model.joints[i], data.joints[i], Forward::ArgsType(model, data, q, v));
    for (JointIndex i = count - 1; i > 0; --i)
        Backward::run(model.joints[i], data.joints[i], Backward::ArgsType(model, data));
    data.M.diagonal() += model.armature;
}

}  // namespace pinocchio_model
