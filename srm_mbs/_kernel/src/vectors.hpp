// Vectors of three numbers.
#pragma once

namespace srm {

struct Vec {
    double x, y, z;
};

inline Vec vec(const double* a) {
    return {a[0], a[1], a[2]};
}

inline Vec operator+(const Vec& a, const Vec& b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}

inline Vec operator-(const Vec& a, const Vec& b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}

inline Vec operator*(double s, const Vec& a) {
    return {s * a.x, s * a.y, s * a.z};
}

inline Vec cross(const Vec& a, const Vec& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

inline double dot(const Vec& a, const Vec& b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

// R a and R^T a; R column by column.
inline Vec to_world(const double* R, const Vec& a) {
    return {R[0] * a.x + R[3] * a.y + R[6] * a.z, R[1] * a.x + R[4] * a.y + R[7] * a.z,
            R[2] * a.x + R[5] * a.y + R[8] * a.z};
}

inline Vec from_world(const double* R, const Vec& a) {
    return {R[0] * a.x + R[1] * a.y + R[2] * a.z, R[3] * a.x + R[4] * a.y + R[5] * a.z,
            R[6] * a.x + R[7] * a.y + R[8] * a.z};
}

}  // namespace srm
