// The sparse projection of a mechanism with many loops, with pivots along the graph of the loops.
//
// See swept_qr in dynamics/constraints/projection.py.  If the next pivot were the largest norm of
// all, successive pivots would be far apart in the graph, and the columns between them would fill
// in.  So the next pivot is the largest norm in a window that moves along the order of the graph.
// Columns below the floor are deferred to the next sweep, and so are columns with less than a share
// of the largest norm if some rows depend on others.  The next sweep runs back: the entries of
// deferred columns have spread to rows further along, with which the sweep back is done first.
//
// A column is reflected in stages: first over the rows that it shares with none of the columns to
// come, last over those that it shares with the latest of them.  All stages keep their part of the
// column in the same row, that of the pivot.  So the column fills no more of the rows that it has
// in common with the next one than before, and reflections stay as short as the columns.  One
// reflection over all rows would fill each of them with the columns of all others.
//
// The rows and columns that the sweep has met and not closed yet are in a small dense panel, which
// a processor keeps in its first cache.  When it is full, they move to its front; it grows when
// they fill it.  Columns come to it in the order of the sweep, and those that remain keep it.
#pragma once

#include <type_traits>

#include "sparse_projection.hpp"

namespace srm {

class SweptProjection final : public SparseProjection {
public:
    SweptProjection(int structural_rank, double sigma_ref, const Pattern& pattern);

    void normals(double* out) const override;
    // Not those of many other rows: each takes nv numbers.
    void weak_normals(std::vector<double>& out) const override;

private:
    // Columns of W in their order, and the coordinates and values of what is left of each: in the
    // first sweep, all of W.  reach: up to which column all have to be in the panel before each is
    // reflected, since a reflection of a row changes all of its columns.
    struct Sweep {
        std::vector<int> columns, start{0}, coordinates, reach;
        std::vector<double> values;
    };
    // An entry of the panel that moves, to `column`.
    struct Entry {
        int coordinate, column;
        double value;
    };
    // The number of words of the panel, if it is known to the compiler.
    using One = std::integral_constant<int, 1>;

    void pivoted_qr(double floor) override;
    void times_q(double* x) const override;
    void times_q_transposed(double* x) const override;
    double smallest_pivot() const override;
    void apply_reflection(int l, double* x) const;
    void sort_pivots() const;
    void normal_of_pivot(int k, double* out) const;
    void find_reach(Sweep& sweep) const;
    void keep_deferred();
    void resize(int words);
    void make_room(int entries);
    template <class Act>
    void empty_panel(const Act& act);
    void enter(int coordinate, int c, double value);
    void take_column(const Sweep& sweep);
    void fill_window(const Sweep& sweep);
    int largest_in_window();
    void sum(int column);
    template <class Words>
    bool take_pivots(const Sweep& sweep, double least, Words words);
    template <class Words>
    int gather(int column, Words words);
    template <class Words>
    void sort(int n, Words words);
    template <class Words>
    void eliminate(int column, int n, Words words);
    template <class Words>
    void reflect(int first, int n, Words words);
    template <class Words>
    void reflect_pair(int one, int two, double p, double q, Words words);
    void reflect_rows(const int* of, const double* v, int n, double tau);
    template <class Words>
    void take_right(int column, int pivot, Words words);

    template <class Words>
    double* row(int r, Words words) {
        return panel_.data() + static_cast<std::ptrdiff_t>(r) * words * 64;
    }
    template <class Words>
    Word* columns_in(int r, Words words) {
        return columns_in_.data() + static_cast<std::ptrdiff_t>(r) * words;
    }
    template <class Words>
    Word* rows_in(int c, Words words) {
        return rows_in_.data() + static_cast<std::ptrdiff_t>(c) * words;
    }

    double pivot_share_;
    std::size_t pivot_window_;
    Sweep first_sweep_, later_sweep_;

    // The panel, row by row, with room for 64 words_ rows and columns; zero outside the bit sets,
    // the columns in each row and the rows in each column.  Rows are of the coordinates row_at_,
    // and panel_row_ of a coordinate is its row, or -1.  open_columns_ are no pivots yet, and
    // coming_ are those of them that are not deferred.
    int words_ = 0, row_count_ = 0, column_count_ = 0;
    std::vector<double> panel_;
    std::vector<int> panel_row_;
    std::vector<Word> columns_in_, rows_in_, coming_;
    // Of each column: size up to which entries are negligible, squared norm of what is left, and
    // below which that has lost its digits.
    std::vector<double> small_, left_, lost_;
    // Where each column moves, and the entries that do.
    std::vector<int> place_;
    std::vector<Entry> moved_;
    // How many columns of the sweep were taken into the panel, and into the window; the window.
    int taken_ = 0, next_ = 0;
    std::vector<int> window_;
    std::vector<double> most_;  // see largest_in_window()
    // Rows of the current column, the last column to come in each, and its entries.
    std::vector<int> touched_, last_;
    std::vector<double> entries_;
    std::vector<double*> at_;  // a word of rows that are reflected
    mutable std::vector<int> by_pivot_;
};

}  // namespace srm
