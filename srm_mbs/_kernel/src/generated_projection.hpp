// The projection of a mechanism whose algebra is generated code: integration/generated/algebra.py.
#pragma once

#include <memory>
#include <new>
#include <vector>

#include "generated.hpp"
#include "projection.hpp"

namespace srm {

class GeneratedProjection final : public Projection {
public:
    // `algebra` outlives it, or is replaced before it is used again.
    GeneratedProjection(int nv, int rows, int structural_rank, double sigma_ref,
                        const GeneratedAlgebra& algebra);

    // The same sizes in another library.
    void use(const GeneratedAlgebra& algebra);

    // The rows of G for code that writes all entries that differ from zero: others are zero.
    double* const* rows_for_code();

    double* column(int row) override;
    double* filled(int row) override { return &G_[static_cast<std::size_t>(row) * nv]; }
    void normal(const double* g, double* white) const override;
    void multiplier(const double* white, double* g) const override;
    void remove_normal(double* white) const override;
    void whiten_force(double* x) const override { algebra_->whiten_force(factors_.get(), x); }
    void whiten_velocity(double* x) const override { algebra_->whiten_velocity(factors_.get(), x); }
    void unwhiten(double* x) const override { algebra_->unwhiten(factors_.get(), x); }
    void normals(double* out) const override;
    void complement(double* out) const override;
    bool sparse() const override { return false; }
    std::size_t entries() const override { return G_.size(); }

private:
    void factorise(const double* M, const double* f, const double* bias, double floor) override;
    void keep_normal(double* white) const override;
    const int* pivot_rows() const { return algebra_->pivot_rows(factors_.get()); }
    void column_of_q(int k, double* out) const;

    struct Free {
        void operator()(void* memory) const { ::operator delete(memory, alignment); }
    };
    static constexpr std::align_val_t alignment{64};  // of the widest vectors

    const GeneratedAlgebra* algebra_ = nullptr;
    std::unique_ptr<void, Free> factors_;
    std::size_t size_ = 0;  // of the factors
    std::vector<double> G_;
    std::vector<double*> rows_;
    bool others_written_ = false;  // entries that code does not write
};

}  // namespace srm
