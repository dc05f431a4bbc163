// Twin of srm_mbs/integration/methods/multiplier_history.py: multipliers of recent steps, extrapolated into the zone.
#pragma once

#include <limits>
#include <vector>

namespace srm {

class History {
public:
    static constexpr int points = 5;
    static constexpr int window = 9;
    static constexpr double stale = 4.0;

    int size = 0;                 // nodes
    int nv = 0;
    std::vector<double> times;    // (size,)
    std::vector<double> values;   // (size, nv)
    double known_until = -std::numeric_limits<double>::infinity();
    double known_below = 0.0;
    std::vector<double> normals;  // (nv, normal_count), empty: none
    int normal_count = 0;

    bool begun() const { return size > 0; }
    void empty();
    // Adds the multiplier at t; the newest `points` nodes are kept, those ahead of t dropped.
    void extend(double t, const double* value, const std::vector<double>& normals,
                int normal_count);
    void predict(double t, double* out) const;
    bool predict_near(double t, double* out) const;
    void uncertainty(double t, double* out) const;

private:
    int first_around(double t) const;
    void interpolate(int first, int count, double t, double* out) const;
};

}  // namespace srm
