// E, P, rank and sigma from one pivoted factorisation: dynamics/constraints/projection.py.
//
//     M = L L^T,  W = L^{-1} G^T,  W Pi = Q R,
//     E g = L^{-T} Q R^{-T} Pi^T g,   P v = L^{-T} Q Q^T L^T v,   yhat = E gamma.
//
// White vectors are L^T v.  Two factors L of the same M differ by an orthogonal matrix: norms,
// pivots and sigma of W are the same for both, white vectors are not.
#pragma once

#include <cstddef>
#include <memory>
#include <string>
#include <vector>

namespace srm {

class Projection {
public:
    virtual ~Projection() = default;

    // Column `row` of G^T (nv,), cleared.  The caller writes the entries of the row's support
    // before it calls factor(), which overwrites them.
    virtual double* column(int row) = 0;
    // The same column after it was written.
    virtual double* filled(int row) = 0;

    // Factorises the upper triangle of M (nv, nv) and G, and solves for the multiplier with the
    // forces f (nv,) and bias (rows,).  threshold < 0: none.
    void factor(const double* M, const double* f, const double* bias, double threshold);

    // Keeps the motion tangential to the normals (count, nv), the weakest last, in place of the
    // rows that are not in use.
    void hold(const double* normals, int count);

    // white = Q R^-T Pi^T g, for g (rows,) in the order of G.
    virtual void normal(const double* g, double* white) const = 0;
    // white = Q Q^T L^T w, and the part along held normals.
    void white_project(const double* w, double* white) const;
    // g = Pi R^-1 Q^T x, the transpose of normal(): zero in the rows that are not in use.
    virtual void multiplier(const double* white, double* g) const = 0;
    // out = (W^T W)^-1 g (rows,) = Pi R^-1 R^-T Pi^T g, zero in the rows that are not in use.
    virtual void inverse_gram(const double* g, double* out) const;
    // Subtracts Q Q^T x from x, in place.
    virtual void remove_normal(double* white) const = 0;
    // x = L^-1 x, x = L^T x and x = L^-T x, in place.
    virtual void whiten_force(double* x) const = 0;
    virtual void whiten_velocity(double* x) const = 0;
    virtual void unwhiten(double* x) const = 0;
    // M-orthonormal normals L^-T Q (rank, nv), that of the smallest pivot last.
    virtual void normals(double* out) const = 0;
    // The last of them (k, nv), at least those whose pivots are below sigma_ref.
    virtual void weak_normals(std::vector<double>& out) const {
        out.resize(static_cast<std::size_t>(rank) * nv);
        normals(out.data());
    }
    // Orthonormal white vectors (nv - rank, nv), orthogonal to the rows in use.
    virtual void complement(double* out) const = 0;
    // |R_kk| (structural rank,) in the order of the pivots, and the squares of W's columns (rows,).
    const std::vector<double>& pivots() const { return pivots_; }
    const std::vector<double>& row_squares() const { return row_squares_; }
    virtual bool sparse() const = 0;
    // Numbers that Q and R hold, a measure of the cost of a factorisation and of products with
    // them.
    virtual std::size_t entries() const = 0;

    int nv, rows, structural_rank;
    double sigma_ref;
    double sigma = 0.0;
    int rank = 0;
    bool rank_deficient = false;
    bool held = false;
    long factorisations = 0;
    std::vector<double> white_force, white_multiplier;

protected:
    Projection(int nv, int rows, int structural_rank, double sigma_ref);

    // Computes white_force, gamma_, row_squares_ and |R_kk| (pivots_) down to the structural rank;
    // pivots below `floor` are the last ones.
    virtual void factorise(const double* M, const double* f, const double* bias,
                           double floor) = 0;
    virtual double smallest_pivot() const { return pivots_[structural_rank - 1]; }
    // x = Q Q^T x
    virtual void keep_normal(double* white) const = 0;

    std::vector<double> gamma_, pivots_, row_squares_;

private:
    std::vector<double> held_;
    mutable std::vector<double> work_;
    int held_count_ = 0;
};

// LAPACK's xGEQP3 recomputes a column norm once its square has lost this much: sqrt(2^-53).
constexpr double norm_lost = 1.0536712127723509e-8;

// The sparsity of W.
struct Pattern {
    std::vector<int> parents;                 // (nv,), next coordinate towards the root, or -1
    std::vector<std::vector<int>> supports;   // of the rows of G, ascending
    // The rows of G along the graph of the loops; empty: the largest is the next pivot.
    std::vector<int> order;
    int pivot_window = 1;                     // columns along it, of which the largest is the next
    double pivot_share = 1.0;                 // of the largest of all, if some depend on others
};

// choice: "auto", "dense" or "sparse".
std::unique_ptr<Projection> make_projection(int structural_rank, double sigma_ref,
                                            const Pattern& pattern, const std::string& choice);

}  // namespace srm
