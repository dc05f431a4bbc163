#include "charts.hpp"

#include <cmath>

#include "linear.hpp"

namespace srm {

double GroupJoint::rotation(const double* v) const {
    const int first = group == Group::so3 ? 0 : group == Group::se3 ? 3 : 2;
    return norm(v + start + first, size - first);
}

void GroupJoint::bracket(const double* u, const double* v, double* out) const {
    if (group == Group::so3) {
        cross(u, v, out);
    } else if (group == Group::se3) {
        double linear[3], mixed[3], angular[3];
        cross(u + 3, v, linear);
        cross(u, v + 3, mixed);
        cross(u + 3, v + 3, angular);
        for (int i = 0; i < 3; ++i) {
            out[i] = linear[i] + mixed[i];
            out[3 + i] = angular[i];
        }
    } else {
        const double x = -u[2] * v[1] + u[1] * v[2];
        const double y = u[2] * v[0] - u[0] * v[2];
        out[0] = x;
        out[1] = y;
        out[2] = 0.0;
    }
}

void GroupJoint::dexp_inverse(const double* u, const double* v, const std::vector<double>& series,
                              double* out) const {
    double w[6];
    bracket(u, v, w);
    for (int i = 0; i < size; ++i) out[i] = v[i] + 0.5 * w[i];
    const double negligible = 1e-18 * largest(v, size);
    for (double coefficient : series) {
        bracket(u, w, w);
        double term = 0.0;
        for (int i = 0; i < size; ++i) {
            out[i] += coefficient * w[i];
            term = std::max(term, std::abs(coefficient * w[i]));
        }
        if (term <= negligible) break;
        bracket(u, w, w);
    }
}

void planar_translation(const double* q, const double* u, double* out) {
    const double half = 0.5 * u[2];
    const double chord = half != 0.0 ? std::sin(half) / half : 1.0;
    const double along = chord * std::cos(half), across = chord * std::sin(half);
    const double a = along * u[0] - across * u[1], b = across * u[0] + along * u[1];
    out[0] = q[0] + q[2] * a - q[3] * b;
    out[1] = q[1] + q[3] * a + q[2] * b;
}

}  // namespace srm
