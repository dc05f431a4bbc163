// The projection of a mechanism with many loops, in sparse arrays.
//
// M = L^T L with L lower triangular, eliminated from the leaves (Featherstone, Rigid Body Dynamics
// Algorithms, 6.5): L has no entries but those of a coordinate and its ancestors.  The pivots of
// W = L^-T G^T = Q R Pi^T follow the rule of the dense algebra.  A reflection acts on the rows of
// its own column only, keeps its pivot in one of these rows instead of row k, and changes only the
// columns that share rows with it.
//
// Along a chain of loops the entries of Q and R decay geometrically without becoming zero.  Entries
// below `negligible` of a column's norm, less than what one operation of the dense algebra rounds
// off, are dropped: this bounds the rows of a reflection and the columns that it changes.  When half
// of the columns are done, the others are packed into a contiguous matrix.
//
// Of equal norms the first by position is the pivot, as in the dense algebra.  Rounding differs: of
// two columns whose norms agree to rounding, either may be the pivot.
#pragma once

#include <cstddef>
#include <vector>

#include "bit_sets.hpp"
#include "large_array.hpp"
#include "projection.hpp"

namespace srm {

// Rows of the columns of W: the supports with all ancestors.
std::vector<std::vector<int>> with_ancestors(const Pattern& pattern);

// Whether the sparse algebra is faster than the dense one.
bool sparse_pays(const Pattern& pattern);

class SparseProjection : public Projection {
public:
    SparseProjection(int structural_rank, double sigma_ref, const Pattern& pattern);

    double* column(int row) override { return &A_[static_cast<std::size_t>(row) * nv]; }
    double* filled(int row) override { return column(row); }
    void normal(const double* g, double* white) const override;
    void multiplier(const double* white, double* g) const override;
    void inverse_gram(const double* g, double* out) const override;
    void remove_normal(double* white) const override;
    void whiten_force(double* x) const override;
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
    // Computes pivots_, Q and R, and clears the columns of W.
    virtual void pivoted_qr(double floor);
    virtual void times_q(double* x) const;
    virtual void times_q_transposed(double* x) const;
    // G^T, then W, column by column; between evaluations zero outside the supports of the rows.
    LargeArray A_;
    // Rows of W's columns, ascending, with all ancestors.
    std::vector<int> support_start_, support_;
    // Squared norms of what is left of W's columns, and of the whole columns; entries below least_
    // are dropped.
    std::vector<double> squares_, first_squares_, least_;

    // Pivot k: its column of W in order_[k], its row in pivot_row_[k], row k of R without the
    // diagonal at right_start_[k], its reflections from reflections_[k] to reflections_[k + 1].
    // Reflection l: rows and values (1 in the pivot row) at reflection_start_[l].
    int steps_ = 0;
    std::vector<int> order_, pivot_row_, reflections_, reflection_start_, right_start_;
    std::vector<double> tau_, right_diagonal_;
    std::vector<int> reflection_row_, right_column_;
    std::vector<double> reflection_, right_;

    // Working rows and columns: the rows and columns of W that they are, and the open ones, which
    // are not done.
    std::vector<int> row_at_, column_at_;
    std::vector<Word> open_rows_, open_columns_;

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
    // Row k of R times g, without the diagonal.
    double beside_diagonal(int k, const double* g) const;
    // Solves R^T z = Pi^T g: `solved(k, z_k)` for each k in turn.
    template <class Solved>
    void forward(const double* g, Solved solved) const;

    // The tree: ancestors of coordinate k, the nearest first, at ancestor_start_[k]; L_ at the same
    // places; its diagonal, and the inverse of that.
    std::vector<int> ancestor_start_, ancestors_;
    std::vector<double> L_, diagonal_, inverse_;
    mutable std::vector<double> scratch_, solved_;
    // Bit sets of the rows of each working column and of the columns of each row.
    BitSets rows_of_, columns_of_;
    std::vector<Word> changed_;
    std::vector<double> along_;
    // The working columns (row_count_, column_count_) are in A_, zero outside their rows: first all
    // of W, after pack() the open ones in the same order.  place_of_ is the inverse of column_at_.
    int row_count_ = 0, column_count_ = 0;
    std::vector<int> place_of_, new_row_;
    BitSets packed_rows_of_;
    std::vector<Word> met_, own_rows_;
    // The current reflection: its working rows, that of its pivot, and its values in all rows from
    // the first of these to the last.
    std::vector<int> at_;
    int pivot_ = 0;
    std::vector<double> window_;
    int own_first_ = 0, own_last_ = -1;
    std::vector<int> met_columns_;

    // Positions of the working columns in order_, which swaps columns as the dense algebra does.
    // Blocks of working columns remember their largest norm; stale ones have to find it again.
    std::vector<int> position_, best_;
    std::vector<char> stale_;
    std::vector<double> best_square_;
};

}  // namespace srm
