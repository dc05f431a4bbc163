// The projection of a mechanism with few loops: M = U^T U, L = U^T, in dense arrays.
//
// Q stays in its reflections: a stage multiplies by it once or twice, which costs less than
// forming it.
#pragma once

#include <vector>

#include "projection.hpp"

namespace srm {

class DenseProjection final : public Projection {
public:
    DenseProjection(int nv, int rows, int structural_rank, double sigma_ref);

    double* column(int row) override;
    void normal(const double* g, double* white) const override;
    void remove_normal(double* white) const override;
    void whiten_velocity(double* x) const override;
    void unwhiten(double* x) const override;
    void normals(double* out) const override;
    bool sparse() const override { return false; }

private:
    void factorise(const double* M, const double* f, const double* bias) override;
    void keep_normal(double* white) const override;
    void cholesky(const double* M);
    void pivoted_qr();
    void whiten(double* x) const;
    void times_q(double* x) const;
    void times_q_transposed(double* x) const;

    std::vector<double> U_, A_, tau_, norms_, first_norms_;
    std::vector<int> order_;
};

}  // namespace srm
