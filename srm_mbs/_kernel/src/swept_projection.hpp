// The sparse projection of a mechanism with many loops, its pivots taken along the graph of the loops.
//
// Twin of swept_qr in srm_mbs/dynamics/constraints/projection.py.  The largest norm as the next pivot hops about
// the graph, and what the pivots fill in between spreads.  So the next pivot is the largest in a
// window that moves along the order of the graph.  Columns below the floor wait for the next sweep,
// and so do those of less than a share of the largest norm if some depend on others.  That sweep
// goes back: their entries have spread to the rows behind them, and find these done.
//
// A column is reflected in stages: first over the rows that none of the columns to come shares, last
// over those that the latest of them shares.  All stages keep their part of the column in the same
// row, the pivot's.  So what the column leaves in the rows that it has in common with the next one
// are as few rows as before, and reflections stay as short as these columns, wherever the sweep is.
// A reflection with all of these rows would leave each of them filled with what its neighbours are.
#pragma once

#include "sparse_projection.hpp"

namespace srm {

class SweptProjection final : public SparseProjection {
public:
    SweptProjection(int structural_rank, double sigma_ref, const Pattern& pattern);

    void normals(double* out) const override;

private:
    void pivoted_qr(double floor) override;
    double smallest_pivot() const override;
    void take_columns();
    double start_sweep();
    double remaining(int column) const;
    int take_from_window();
    void gather(int column);
    void eliminate(int column, bool forward);
    void reflect(const int* at, double* v, int n);
    void take_right(int column, int pivot);
    void clear_rows();
    double* row(int i) { return &values_[static_cast<std::size_t>(i) * rows]; }
    const double* row(int i) const { return &values_[static_cast<std::size_t>(i) * rows]; }

    double pivot_share_;
    std::size_t pivot_window_;
    // Places of the coordinates among the working rows.
    std::vector<int> row_place_;
    // Working rows (nv, rows), of working columns, zero where they have none; open_columns_ are those
    // to come in the sweep.
    std::vector<double> values_;
    // Columns that wait, ascending, and those that will in the next sweep.
    std::vector<int> waiting_, deferred_, window_;
    // Of each working column: entries up to here are negligible, squares of what is left, and what
    // these were when they were last summed up.
    std::vector<double> small_, left_, summed_;
    // Rows of the column at hand, its entries in them, and the last column to come in each.
    std::vector<int> touched_, last_;
    std::vector<double> entries_;
    mutable std::vector<int> by_pivot_;
};

}  // namespace srm
