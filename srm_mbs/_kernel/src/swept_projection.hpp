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
#pragma once

#include "sparse_projection.hpp"

namespace srm {

class SweptProjection final : public SparseProjection {
public:
    SweptProjection(int structural_rank, double sigma_ref, const Pattern& pattern);

    void normals(double* out) const override;
    // Not those of many other rows: each takes nv numbers.
    void weak_normals(std::vector<double>& out) const override;

private:
    void sort_pivots() const;
    void normal_of_pivot(int k, double* out) const;
    void pivoted_qr(double floor) override;
    double smallest_pivot() const override;
    void take_columns();
    double start_sweep();
    double remaining(int column) const;
    int take_from_window();
    void gather(int column);
    void eliminate(int column, bool forward);
    void reflect(const int* at, double* v, int n);
    void reflect_pair(int one, int two, double second, double tau);
    void reflect_rows(const int* at, const double* v, int n, double tau);
    // Columns of word w that have an entry in a row from now on.
    void enter(int row, Word columns, int w) {
        if (columns & ~columns_of_.words(row)[w]) enter_fresh(row, columns, w);
    }
    void enter_fresh(int row, Word columns, int w);
    void take_right(int column, int pivot);
    void clear_rows();
    double* row(int i) { return &values_[static_cast<std::size_t>(i) * rows]; }
    const double* row(int i) const { return &values_[static_cast<std::size_t>(i) * rows]; }

    double pivot_share_;
    std::size_t pivot_window_;
    // Places of the coordinates among the working rows.
    std::vector<int> row_place_;
    // Working rows (nv, rows) of the working columns, zero outside their rows.  open_columns_ are
    // those to come in the sweep.
    LargeArray values_;
    // Columns of this sweep, ascending; those deferred to the next one; those in the window.
    std::vector<int> waiting_, deferred_, window_;
    // Of each working column: size up to which entries are negligible, squared norm of what is
    // left, and that norm when it was last summed, in the window.
    std::vector<double> small_, left_, summed_;
    // Columns that have lost most of that norm.
    std::vector<int> lost_;
    // Rows of the current column, the last column to come in each, and its entries.
    std::vector<int> touched_, last_;
    std::vector<double> entries_;
    mutable std::vector<int> by_pivot_;
    // rows_of_ and columns_of_ of W.
    BitSets first_rows_of_, first_columns_of_;
};

}  // namespace srm
