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
// algebra, is left out.  That makes the cost proportional to the number of loops.
//
// Equal norms are told apart by position as in the dense algebra, but rounding differs: of two
// columns whose norms agree to rounding, either may be the pivot.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "projection.hpp"

namespace srm {

// Rows of the columns of W: the supports with all ancestors.
std::vector<std::vector<int>> with_ancestors(const Pattern& pattern);

// Whether the sparse algebra is the faster one.
bool sparse_pays(const Pattern& pattern);

class SparseProjection final : public Projection {
public:
    SparseProjection(int structural_rank, double sigma_ref, const Pattern& pattern);

    double* column(int row) override { return &A_[static_cast<std::size_t>(row) * nv]; }
    void normal(const double* g, double* white) const override;
    void remove_normal(double* white) const override;
    void whiten_velocity(double* x) const override;
    void unwhiten(double* x) const override;
    void normals(double* out) const override;
    bool sparse() const override { return true; }

    using Word = std::uint64_t;

private:
    // Sets of bits, each with the range of its words that are not zero.
    class BitSets {
    public:
        BitSets(int sets, int bits);
        void clear();
        void set(int which, int i);
        void add(int which, const Word* bits, int from, int to);
        void add_to(int which, Word* bits) const;
        const Word* words(int which) const { return &words_[which * stride_]; }
        std::vector<int> first, last;

    private:
        std::ptrdiff_t stride_;
        std::vector<Word> words_;
    };

    void factorise(const double* M, const double* f, const double* bias) override;
    void keep_normal(double* white) const override;
    void cholesky(const double* M);
    void whiten_columns(const double* bias);
    void pivoted_qr();
    void start_pivots();
    int next_pivot(int k);
    bool reflection(int k, int column);
    void apply(int k);
    double remaining_squares(int column) const;
    void clear();
    void times_q(double* x) const;
    void times_q_transposed(double* x) const;

    // The tree: ancestors of coordinate k, the nearest first, at ancestor_start_[k]; L_ in the same
    // places, its diagonal inverted apart.
    std::vector<int> ancestor_start_, ancestors_;
    std::vector<double> L_, diagonal_, inverse_;
    // Rows of W's columns, ascending, with all ancestors.
    std::vector<int> support_start_, support_;

    // Working columns (nv, rows), zero outside their rows; bit sets of the rows of each column and
    // of the columns of each row.
    std::vector<double> A_;
    int row_words_, column_words_;
    BitSets rows_of_, columns_of_;
    std::vector<Word> open_rows_, open_columns_, met_, changed_, own_rows_;
    int own_first_ = 0, own_last_ = -1;
    std::vector<int> met_columns_;
    std::vector<double> along_, squares_, first_squares_, least_;

    // Pivots: columns by position as in the dense algebra, which swaps them; blocks of columns
    // remember their largest norm.
    std::vector<int> order_, position_, best_;
    std::vector<char> stale_;
    std::vector<double> best_square_;
    int steps_ = 0;

    // Reflection k: rows and values (1 in the pivot row) at reflection_start_[k]; row k of R alike.
    std::vector<int> pivot_row_, reflection_start_, right_start_;
    std::vector<double> tau_, right_diagonal_;
    std::vector<int> reflection_row_, right_column_;
    std::vector<double> reflection_, right_;
    mutable std::vector<double> scratch_;
};

}  // namespace srm
