// Twin of srm_mbs/systems/projection.py: E, P, rank and sigma from one pivoted factorisation.
//
//     M = L L^T,  W = L^{-1} G^T,  W Pi = Q R,
//     E g = L^{-T} Q R^{-T} Pi^T g,   P v = L^{-T} Q Q^T L^T v,   yhat = E gamma.
//
// Q stays in its reflections: a stage multiplies by it once or twice, which costs less than
// forming it.
#pragma once

#include <vector>

namespace srm {

class Projection {
public:
    Projection(int nv, int rows, int structural_rank, double sigma_ref);

    // Columns of G^T (nv, rows), to be filled before factor(), which overwrites them.
    double* columns() { return A_.data(); }

    // Factorises the upper triangle of M (nv, nv) and G, and solves for the multiplier with the
    // forces f (nv,) and bias (rows,).  threshold < 0: none.
    void factor(const double* M, const double* f, const double* bias, double threshold);

    // Keeps the motion tangential to the last normals (nv, count) in place of the dropped rows.
    void hold(const double* normals, int count);

    // white = Q R^-T Pi^T g, for g (rows,) in their own order.
    void normal(const double* g, double* white) const;
    // white = Q Q^T L^T w, held normals included.
    void white_project(const double* w, double* white) const;
    // Subtracts Q Q^T x from x, in place.
    void remove_normal(double* white) const;
    // x = L^T x and x = L^-T x, in place.
    void whiten_velocity(double* x) const;
    void unwhiten(double* x) const;
    // M-orthonormal normals L^-T Q (nv, rank).
    void normals(double* out) const;

    int nv, rows, structural_rank;
    double sigma_ref;
    double sigma = 0.0;
    int rank = 0;
    bool weak = false;
    bool held = false;
    long factorisations = 0;
    std::vector<double> white_force, white_multiplier;

private:
    void cholesky(const double* M);
    void pivoted_qr();
    void whiten(double* x) const;
    void times_q(double* x) const;
    void times_q_transposed(double* x) const;

    std::vector<double> U_, A_, tau_, norms_, first_norms_, gamma_, held_;
    mutable std::vector<double> work_;
    std::vector<int> order_;
    int held_count_ = 0;
};

}  // namespace srm
