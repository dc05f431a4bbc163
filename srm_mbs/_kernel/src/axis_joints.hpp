// The terms of large trees whose joints all turn about an axis or slide along one.
#pragma once

#include <vector>

#include <pinocchio/multibody.hpp>

#include "vectors.hpp"

namespace pinocchio_model {

using srm::Vec;

// A joint with its body: constants, in the order in which a pass over the tree reads them.
struct AxisJoint {
    enum class Kind { revolute, unbounded, prismatic };
    Kind kind;
    bool turned;  // whether its placement rotates
    int parent, in_q, in_v;
    int along;  // the coordinate axis that the axis lies along, or -1
    Vec axis;
    double rotation[9];  // of its placement, column by column
    Vec at;
    // Of the body, in its axes: mass, centre of mass, and second moments about it (xx, xy, xz, yy,
    // yz, zz).
    double mass;
    Vec centre;
    double moments[6];
};

// Variables of a joint and its body, in world axes about the origin of the joint.
struct AxisBody {
    Vec axis, from_parent;
    Vec velocity, spin, bias, spin_bias;  // accelerations without those of joints, with -gravity
    double mass;                          // from here on with those of the bodies that it carries
    Vec centre, force, moment;
    double moments[6];  // about the centre of mass
};

// The joints of a model, after one in the place of the ground; none if it has other joints or few.
std::vector<AxisJoint> axis_joints(const pinocchio::Model& model);

struct Workspace;

// compute_terms of terms.hpp for these joints.
void compute_axis_terms(Workspace& work);

}  // namespace pinocchio_model
