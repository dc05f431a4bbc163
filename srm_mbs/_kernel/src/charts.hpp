// Tangent charts of ball, free and planar joints: dynamics/manifold.py.
#pragma once

#include <vector>

#include "struct_fields.hpp"

namespace srm {

enum class Group { so3, se3, se2 };

#define SRM_GROUP_JOINT(field)                        \
    field(Group, group)                               \
    field(int, start)    /* first velocity index */   \
    field(int, size)                                  \
    field(int, position) /* first configuration index */

struct GroupJoint {
    SRM_FIELDS(SRM_GROUP_JOINT)

    // Norm of the joint's angular part of the tangent vector v (nv,).
    double rotation(const double* v) const;
    // out = [u, v] on the group's algebra.
    void bracket(const double* u, const double* v, double* out) const;
    // out = dexp^-1_u v; the arrays hold this joint's components.
    void dexp_inverse(const double* u, const double* v, const std::vector<double>& series,
                      double* out) const;
};

// Translation of the planar joint coordinates q (4,) (+) u (3,).
void planar_translation(const double* q, const double* u, double* out);

}  // namespace srm
