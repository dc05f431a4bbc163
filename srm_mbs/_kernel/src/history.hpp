// Multipliers of recent steps, extrapolated into the zone: methods/multiplier_history.py.
#pragma once

#include <limits>
#include <vector>

#include "struct_fields.hpp"

namespace srm {

#define SRM_MULTIPLIER_HISTORY(field)                                                     \
    field(int, nv)                                                                        \
    field(std::vector<double>, times)   /* (k,), ascending */                             \
    field(std::vector<double>, values)  /* (k, nv) */                                     \
    /* Up to known_until (s) the values hold for sigma below known_below. */              \
    field(double, known_until)                                                            \
    field(double, known_below)                                                            \
    field(std::vector<double>, normals) /* (m, nv), of the weakest row last; or empty */      \
    /* Direction of the branch that leads away from a singular configuration (1, nv), or its */ \
    /* frame where branches touch (f + 1, nv); or empty. */                                     \
    field(std::vector<double>, away)

class MultiplierHistory {
public:
    SRM_FIELDS(SRM_MULTIPLIER_HISTORY)

    static constexpr int points = 5;      // nodes that are kept
    static constexpr int window = 9;      // nodes of an interpolation
    static constexpr double stale = 4.0;  // spans beyond which nothing is extrapolated

    int size() const { return static_cast<int>(times.size()); }
    int normal_count() const { return nv > 0 ? static_cast<int>(normals.size()) / nv : 0; }
    bool begun() const { return !times.empty(); }
    void clear();
    // Adds the multiplier at t; the newest `points` nodes are kept, those after t dropped.  The
    // normals are exchanged with those before, so that no step allocates them.
    void extend(double t, const double* value, std::vector<double>&& normals,
                const std::vector<double>& away);
    void predict(double t, double* out) const;
    // Predicts unless t is too far from the nodes; whether it does.
    bool predict_near(double t, double* out) const;
    // Difference of the predictions with all nodes and without the oldest.
    void uncertainty(double t, double* out) const;
    void check() const;

private:
    void forget_known();
    int first_around(double t) const;
    void interpolate(int first, int count, double t, double* out) const;
};

}  // namespace srm
