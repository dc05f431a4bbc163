// The projection of a mechanism with many loops: only entries that are not zero are touched.
//
// M = L^T L with L lower triangular, eliminated from the leaves (Featherstone, Rigid Body Dynamics
// Algorithms, 6.5): L has no entries but those of a coordinate and its ancestors.  The pivots of
// W = L^-T G^T = Q R Pi^T follow the dense rule, but a reflection acts on the rows of its own
// column alone, keeps its pivot in one of these rows instead of row k, and touches only the
// columns that share rows with it.
//
// Along a chain of loops the entries of Q and R decay geometrically without becoming zero: what
// falls below `negligible` of a column's norm, a tenth of the rounding error of the dense
// algebra, is left out.  That bounds the rows of a reflection and the columns that it meets.  What
// is left when half of the columns are done is packed, so that it lies together.
//
// Equal norms are told apart by position as in the dense algebra, but rounding differs: of two
// columns whose norms agree to rounding, either may be the pivot.
#pragma once

#include <cstddef>
#include <vector>

#include "bit_sets.hpp"
#include "projection.hpp"

namespace srm {

// Rows of the columns of W: the supports with all ancestors.
std::vector<std::vector<int>> with_ancestors(const Pattern& pattern);

// Whether the sparse algebra is the faster one.
bool sparse_pays(const Pattern& pattern);

class SparseProjection : public Projection {
public:
    SparseProjection(int structural_rank, double sigma_ref, const Pattern& pattern);

    double* column(int row) override { return &A_[static_cast<std::size_t>(row) * nv]; }
    double* filled(int row) override { return column(row); }
    void normal(const double* g, double* white) const override;
    void multiplier(const double* white, double* g) const override;
    void remove_normal(double* white) const override;
    void whiten_velocity(double* x) const override;
    void unwhiten(double* x) const override;
    void normals(double* out) const override;
    void complement(double* out) const override;
    bool sparse() const override { return true; }
    std::size_t entries() const override {
        return static_cast<std::size_t>(reflection_start_[reflections_[steps_]]) +
               right_start_[steps_];
    }

protected:
    // pivots_ and all of Q and R; the columns of W are zero again.
    virtual void pivoted_qr(double floor);
    // Zero, but for the entries of the row's support, before W; then before clearing.
    std::vector<double> A_;
    // Rows of W's columns, ascending, with all ancestors.
    std::vector<int> support_start_, support_;
    // Squares of W's columns, at first and of what is left; below the last, entries are left out.
    std::vector<double> squares_, first_squares_, least_;

    // Pivot k: its column of W in order_, its row in pivot_row_, its part of R's row k beside the
    // diagonal at right_start_[k], and its reflections, those from reflections_[k] on.  Reflection l:
    // rows and values (1 in the pivot row) at reflection_start_[l].
    int steps_ = 0;
    std::vector<int> order_, pivot_row_, reflections_, reflection_start_, right_start_;
    std::vector<double> tau_, right_diagonal_;
    std::vector<int> reflection_row_, right_column_;
    std::vector<double> reflection_, right_;

    // Working rows and columns: their rows and columns of W, bit sets of the rows of each column and
    // of the columns of each row, and those that are not done.
    std::vector<int> row_at_, column_at_;
    BitSets rows_of_, columns_of_;
    std::vector<Word> open_rows_, open_columns_, changed_;
    std::vector<double> along_;
    mutable std::vector<double> scratch_;

private:
    void factorise(const double* M, const double* f, const double* bias, double floor) override;
    void keep_normal(double* white) const override;
    void cholesky(const double* M);
    void whiten_columns(const double* bias);
    void start_pivots();
    void open_all(int row_count, int column_count);
    void pack(int open_columns);
    int next_pivot(int k);
    bool reflection(int k, int column);
    void apply(int k);
    double remaining_squares(int column) const;
    double* working(int place) { return &A_[static_cast<std::size_t>(place) * row_count_]; }
    const double* working(int place) const {
        return &A_[static_cast<std::size_t>(place) * row_count_];
    }
    void clear();
    void times_q(double* x) const;
    void times_q_transposed(double* x) const;

    // The tree: ancestors of coordinate k, the nearest first, at ancestor_start_[k]; L_ in the same
    // places, its diagonal inverted apart.
    std::vector<int> ancestor_start_, ancestors_;
    std::vector<double> L_, diagonal_, inverse_;
    // Working columns (row_count_, column_count_) in A_, zero outside their rows.  All of W at
    // first; then pack() keeps those that are open, in their order; place_of_ is the inverse of
    // column_at_.
    int row_count_ = 0, column_count_ = 0;
    std::vector<int> place_of_, new_row_;
    BitSets packed_rows_of_;
    std::vector<Word> met_, own_rows_;
    // The reflection at hand: its working rows and its pivot's, and its values from the first of
    // these rows to the last.
    std::vector<int> at_;
    int pivot_ = 0;
    std::vector<double> window_;
    int own_first_ = 0, own_last_ = -1;
    std::vector<int> met_columns_;

    // Pivots: columns by position as in the dense algebra, which swaps them (order_), and positions
    // of the working columns; blocks of these remember their largest norm.
    std::vector<int> position_, best_;
    std::vector<char> stale_;
    std::vector<double> best_square_;
};

}  // namespace srm
