#include "sparse_projection.hpp"

#include <algorithm>
#include <cmath>

#include "errors.hpp"
#include "linear.hpp"
#include "scattered.hpp"

namespace srm {

namespace {

// Entries and changes below this part of a column's norm are dropped.
constexpr double negligible = 1e-16;
// Columns of a block, which remembers its largest norm.
constexpr int block = 32;
// Number of columns up to which the working matrix is not packed: their bits fill one word.
constexpr int few = 64;
// The working matrix is packed when this part of its columns is still open.
constexpr double packing = 0.5;
// In a packed matrix, reflections of at least long_reflection rows, which are at least dense_part
// of the rows from their first to their last, run over all of these: contiguous numbers cost half
// as much as gathered ones.
constexpr int long_reflection = 8;
constexpr double dense_part = 0.5;
// The sparse algebra is chosen above this number of coordinates, where at most this part of W's
// entries differs from zero.  Measured with AVX2: for 21 to 25 coordinates in branched trees the
// dense algebra is 1.4 times as fast, and for 40 with a third of the entries 1.5 times; in chains of
// loops, which fill in least, both cost the same up to 33 coordinates, and the sparse one less above.
constexpr int largest_dense = 32;
constexpr double densest = 0.25;

// The largest of numbers >= -1; four partial results, so that the compiler may use vector
// registers.
inline double greatest(const double* values, int n) {
    double m0 = -1.0, m1 = -1.0, m2 = -1.0, m3 = -1.0;
    int i = 0;
    for (; i + 4 <= n; i += 4) {
        m0 = std::max(m0, values[i]);
        m1 = std::max(m1, values[i + 1]);
        m2 = std::max(m2, values[i + 2]);
        m3 = std::max(m3, values[i + 3]);
    }
    for (; i < n; ++i) m0 = std::max(m0, values[i]);
    return std::max(std::max(m0, m1), std::max(m2, m3));
}

}  // namespace

std::vector<std::vector<int>> with_ancestors(const Pattern& pattern) {
    const int nv = static_cast<int>(pattern.parents.size());
    std::vector<std::vector<int>> out;
    std::vector<char> in(nv);
    for (const std::vector<int>& support : pattern.supports) {
        std::fill(in.begin(), in.end(), 0);
        for (int k : support)
            for (int i = k; i >= 0 && !in[i]; i = pattern.parents[i]) in[i] = 1;
        out.emplace_back();
        for (int i = 0; i < nv; ++i)
            if (in[i]) out.back().push_back(i);
    }
    return out;
}

bool sparse_pays(const Pattern& pattern) {
    if (pattern.parents.size() <= largest_dense) return false;
    std::size_t entries = 0;
    for (const std::vector<int>& support : with_ancestors(pattern)) entries += support.size();
    return entries <= densest * pattern.parents.size() * pattern.supports.size();
}

SparseProjection::SparseProjection(int structural_rank, double sigma_ref, const Pattern& pattern)
    : Projection(static_cast<int>(pattern.parents.size()),
                 static_cast<int>(pattern.supports.size()), structural_rank, sigma_ref),
      A_(static_cast<std::size_t>(nv) * rows),
      squares_(rows),
      first_squares_(rows),
      least_(rows),
      order_(rows),
      pivot_row_(structural_rank),
      reflections_(structural_rank + 1),
      reflection_start_(structural_rank + 1),
      right_start_(structural_rank + 1),
      tau_(structural_rank),
      right_diagonal_(structural_rank),
      row_at_(nv),
      column_at_(rows),
      open_rows_(words_for(nv)),
      open_columns_(words_for(rows)),
      diagonal_(nv),
      inverse_(nv),
      scratch_(rows),
      solved_(structural_rank),
      rows_of_(rows, nv),
      columns_of_(nv, rows),
      changed_(words_for(rows)),
      along_(rows),
      place_of_(rows),
      new_row_(nv),
      packed_rows_of_(rows, nv),
      met_(words_for(rows)),
      own_rows_(words_for(nv)),
      at_(nv),
      window_(nv),
      met_columns_(rows),
      position_(rows),
      best_((rows + block - 1) / block),
      stale_(best_.size()),
      best_square_(best_.size()) {
    // Each pivot has one reflection.
    for (int k = 0; k <= structural_rank; ++k) reflections_[k] = k;
    ancestor_start_.push_back(0);
    for (int k = 0; k < nv; ++k) {
        for (int i = pattern.parents[k]; i >= 0; i = pattern.parents[i]) ancestors_.push_back(i);
        ancestor_start_.push_back(static_cast<int>(ancestors_.size()));
    }
    L_.resize(ancestors_.size());
    support_start_.push_back(0);
    for (const std::vector<int>& support : with_ancestors(pattern)) {
        support_.insert(support_.end(), support.begin(), support.end());
        support_start_.push_back(static_cast<int>(support_.size()));
    }
}

// M = L^T L: row k of L after those of all its descendants.
void SparseProjection::cholesky(const double* M) {
    for (int k = 0; k < nv; ++k) {
        const double* column = M + static_cast<std::size_t>(k) * nv;
        diagonal_[k] = column[k];
        for (int s = ancestor_start_[k]; s < ancestor_start_[k + 1]; ++s)
            L_[s] = column[ancestors_[s]];
    }
    for (int k = nv - 1; k >= 0; --k) {
        if (!(diagonal_[k] > 0.0)) throw EvaluationError{Failure::mass_matrix};
        diagonal_[k] = std::sqrt(diagonal_[k]);
        inverse_[k] = 1.0 / diagonal_[k];
        double* row = L_.data() + ancestor_start_[k];
        const int* above = ancestors_.data() + ancestor_start_[k];
        const int n = ancestor_start_[k + 1] - ancestor_start_[k];
        for (int s = 0; s < n; ++s) row[s] *= inverse_[k];
        // The ancestors of an ancestor are the rest of the list.
        for (int s = 0; s < n; ++s) {
            diagonal_[above[s]] -= row[s] * row[s];
            add(-row[s], row + s + 1, L_.data() + ancestor_start_[above[s]], n - s - 1);
        }
    }
}

void SparseProjection::unwhiten(double* x) const {
    for (int k = 0; k < nv; ++k) {
        const int first = ancestor_start_[k], n = ancestor_start_[k + 1] - first;
        x[k] = (x[k] - gathered(L_.data() + first, ancestors_.data() + first, n, x)) * inverse_[k];
    }
}

void SparseProjection::whiten_force(double* x) const {
    for (int k = nv - 1; k >= 0; --k) {
        const int first = ancestor_start_[k], n = ancestor_start_[k + 1] - first;
        x[k] *= inverse_[k];
        scattered(-x[k], L_.data() + first, ancestors_.data() + first, n, x);
    }
}

void SparseProjection::whiten_velocity(double* x) const {
    for (int k = nv - 1; k >= 0; --k) {
        const int first = ancestor_start_[k], n = ancestor_start_[k + 1] - first;
        x[k] = diagonal_[k] * x[k] + gathered(L_.data() + first, ancestors_.data() + first, n, x);
    }
}

// Computes W, gamma and the norms of the columns.
void SparseProjection::whiten_columns(const double* bias) {
    whiten_force(white_force.data());
    for (int j = 0; j < rows; ++j) {
        double* a = column(j);
        const int start = support_start_[j], end = support_start_[j + 1];
        double squares = 0.0, along = 0.0;
        for (int s = end - 1; s >= start; --s) {
            const int k = support_[s];
            if (a[k] == 0.0) continue;
            a[k] *= inverse_[k];
            const int first = ancestor_start_[k], n = ancestor_start_[k + 1] - first;
            scattered(-a[k], L_.data() + first, ancestors_.data() + first, n, a);
            squares += a[k] * a[k];
            along += a[k] * white_force[k];
        }
        gamma_[j] = along + bias[j];
        squares_[j] = first_squares_[j] = row_squares_[j] = squares;
        if (!std::isfinite(squares)) {
            std::fill(A_.begin(), A_.end(), 0.0);
            throw EvaluationError{Failure::closures};
        }
        least_[j] = negligible * std::sqrt(squares);
    }
}

void SparseProjection::start_pivots() {
    rows_of_.clear(rows, nv);
    columns_of_.clear(nv, rows);
    for (int j = 0; j < rows; ++j) {
        double* a = column(j);
        for (int s = support_start_[j]; s < support_start_[j + 1]; ++s) {
            const int k = support_[s];
            if (std::abs(a[k]) > least_[j]) {
                rows_of_.set(j, k);
                columns_of_.set(k, j);
            } else {
                a[k] = 0.0;
            }
        }
    }
    for (int i = 0; i < nv; ++i) row_at_[i] = i;
    for (int j = 0; j < rows; ++j) order_[j] = position_[j] = column_at_[j] = place_of_[j] = j;
    open_all(nv, rows);
    reflection_start_[0] = right_start_[0] = steps_ = 0;
}

// Opens all working rows and columns.
void SparseProjection::open_all(int row_count, int column_count) {
    row_count_ = row_count;
    column_count_ = column_count;
    std::fill(open_rows_.begin(), open_rows_.end(), Word{0});
    for (int i = 0; i < row_count; ++i) set(open_rows_.data(), i);
    std::fill(open_columns_.begin(), open_columns_.end(), Word{0});
    for (int j = 0; j < column_count; ++j) set(open_columns_.data(), j);
    std::fill(stale_.begin(), stale_.end(), 1);
}

// Removes closed rows and columns, and entries that have become negligible, from the working
// matrix, so that the open ones and their bits are contiguous.
void SparseProjection::pack(int open_columns) {
    int row_count = 0;
    for (int i = 0; i < row_count_; ++i) {
        if (!has(open_rows_.data(), i)) continue;
        row_at_[row_count] = row_at_[i];
        new_row_[i] = row_count++;
    }
    packed_rows_of_.clear(open_columns, row_count);
    columns_of_.clear(row_count, open_columns);
    double* const A = A_.data();
    const int* const new_row = new_row_.data();
    int to = 0;
    for (int j = 0; j < column_count_; ++j) {
        const bool open = has(open_columns_.data(), j);
        const Word* own = rows_of_.words(j);
        double* const from = A + j * static_cast<std::size_t>(row_count_);
        double* const packed = A + to * static_cast<std::size_t>(row_count);
        const double least = least_[j];
        int last = -1;
        Word bits = 0;
        for (int w = rows_of_.first[j]; w <= rows_of_.last[j]; ++w) {
            const Word kept = open ? own[w] & open_rows_[w] : 0;
            each_bit(own[w] & ~kept, w << 6, [&](int i) { from[i] = 0.0; });
            // Numbers move towards the front, in ascending order: each place is read before it is
            // written.
            each_bit(kept, w << 6, [&](int i) {
                const double value = from[i];
                from[i] = 0.0;
                if (!(std::abs(value) > least)) return;
                const int row = new_row[i];
                packed[row] = value;
                if (row >> 6 != last) {
                    if (last >= 0) packed_rows_of_.add(to, bits, last);
                    last = row >> 6;
                    bits = 0;
                }
                bits |= Word{1} << (row & 63);
                columns_of_.set(row, to);
            });
        }
        if (last >= 0) packed_rows_of_.add(to, bits, last);
        if (!open) continue;
        column_at_[to] = column_at_[j];
        place_of_[column_at_[to]] = to;
        position_[to] = position_[j];
        squares_[to] = squares_[j];
        first_squares_[to] = first_squares_[j];
        least_[to] = least_[j];
        ++to;
    }
    std::swap(rows_of_, packed_rows_of_);
    open_all(row_count, to);
}

// Moves the column of the largest norm, the first by position among equals, to position k.  Returns
// its place in the working matrix.
int SparseProjection::next_pivot(int k) {
    const int blocks = (column_count_ + block - 1) / block;
    double largest = -1.0;
    for (int b = 0; b < blocks; ++b) {
        if (stale_[b]) {
            const int first = b * block, end = std::min(column_count_, first + block);
            best_square_[b] = greatest(&squares_[first], end - first);
            best_[b] = -1;
            stale_[b] = 0;
        }
        largest = std::max(largest, best_square_[b]);
    }
    int pivot = -1;
    for (int b = 0; b < blocks; ++b) {
        if (best_square_[b] != largest) continue;
        int& best = best_[b];
        if (best < 0) {
            const int first = b * block, end = std::min(column_count_, first + block);
            for (int j = first; j < end; ++j)
                if (squares_[j] == largest && (best < 0 || position_[j] < position_[best]))
                    best = j;
        }
        if (pivot < 0 || position_[best] < position_[pivot]) pivot = best;
    }
    const int other = place_of_[order_[k]], place = position_[pivot];
    order_[place] = order_[k];
    position_[other] = place;
    order_[k] = column_at_[pivot];
    position_[pivot] = k;
    // Positions decide between equal norms.
    best_[other / block] = -1;
    stale_[pivot / block] = 1;
    squares_[pivot] = -1.0;
    unset(open_columns_.data(), pivot);
    return pivot;
}

// Makes reflection k, which maps what is left of a column onto the row of its largest entry; false
// if nothing is left.
bool SparseProjection::reflection(int k, int column) {
    const double* a = working(column);
    const double least = least_[column];
    const Word* own = rows_of_.words(column);
    int* const at = at_.data();
    double* const values = room(reflection_, reflection_start_[k], nv);
    double squares = 0.0, largest = 0.0;
    int n = 0, top = 0;
    own_first_ = rows_of_.first[column];
    own_last_ = rows_of_.last[column];
    for (int w = own_first_; w <= own_last_; ++w) {
        Word kept = 0;
        each_bit(own[w] & open_rows_[w], w << 6, [&](int i) {
            const double value = a[i];
            if (!(std::abs(value) > least)) return;
            kept |= Word{1} << (i & 63);
            squares += value * value;
            if (std::abs(value) > largest) {
                largest = std::abs(value);
                top = n;
            }
            at[n] = i;
            values[n++] = value;
        });
        own_rows_[w] = kept;
    }
    if (n == 0) return false;
    const double alpha = values[top];
    pivot_ = at[top];
    pivot_row_[k] = row_at_[pivot_];
    if (n == 1) {
        tau_[k] = 0.0;
        right_diagonal_[k] = alpha;
    } else {
        const double beta = -std::copysign(std::sqrt(squares), alpha);
        tau_[k] = (beta - alpha) / beta;
        right_diagonal_[k] = beta;
        const double scale = 1.0 / (alpha - beta);
        for (int i = 0; i < n; ++i) values[i] *= scale;
    }
    values[top] = 1.0;
    int* const rows_at = room(reflection_row_, reflection_start_[k], n);
    for (int i = 0; i < n; ++i) rows_at[i] = row_at_[at[i]];
    reflection_start_[k + 1] = reflection_start_[k] + n;
    return true;
}

// Applies reflection k to the other columns, and removes the pivot row from their norms.
void SparseProjection::apply(int k) {
    const int start = reflection_start_[k], n = reflection_start_[k + 1] - start;
    const int* at = at_.data();
    const double* v = reflection_.data() + start;
    const int pivot = pivot_;
    const double tau = tau_[k];
    int first = static_cast<int>(met_.size()), last = -1;
    int first_changed = column_count_, last_changed = -1;
    for (int i = 0; i < n; ++i) {
        first = std::min(first, columns_of_.first[at[i]]);
        last = std::max(last, columns_of_.last[at[i]]);
    }
    std::fill(met_.begin() + first, met_.begin() + last + 1, Word{0});
    for (int i = 0; i < n; ++i) columns_of_.add_to(at[i], met_.data());
    unset(open_rows_.data(), pivot);
    int count = 0;
    int* const met = met_columns_.data();
    for (int w = first; w <= last; ++w) {
        changed_[w] = 0;
        each_bit(met_[w] & open_columns_[w], w << 6, [&](int j) { met[count++] = j; });
    }
    double* const A = A_.data();
    const double* const least = least_.data();
    const std::size_t stride = row_count_;
    double* const along = along_.data();
    const int low = at[0], span = at[n - 1] - low + 1;
    const bool dense = row_count_ < nv && n >= long_reflection && n >= dense_part * span;
    double* const window = window_.data();
    if (dense) {
        std::fill_n(window, span, 0.0);
        for (int i = 0; i < n; ++i) window[at[i] - low] = v[i];
        for (int c = 0; c < count; ++c)
            along[c] = tau * dot(window, A + met[c] * stride + low, span);
    } else if (tau != 0.0) {
        for (int c = 0; c < count; ++c) along[c] = tau * gathered(v, at, n, A + met[c] * stride);
    } else {
        std::fill_n(along, count, 0.0);
    }
    // A change of along[c] v has the length |along[c]| |v|.
    const double length = tau != 0.0 ? std::sqrt(2.0 / tau) : 0.0;
    double* const right = room(right_, right_start_[k], count);
    int* const right_column = room(right_column_, right_start_[k], count);
    int kept = 0;
    for (int c = 0; c < count; ++c) {
        const int j = met[c];
        double* const a = A + j * stride;
        if (std::abs(along[c]) * length > least[j]) {
            if (dense)
                add(-along[c], window, a + low, span);
            else
                scattered(-along[c], v, at, n, a);
            rows_of_.add(j, own_rows_.data(), own_first_, own_last_);
            set(changed_.data(), j);
            first_changed = std::min(first_changed, j >> 6);
            last_changed = j >> 6;
        }
        const double value = a[pivot];
        if (!(std::abs(value) > least[j])) continue;
        right_column[kept] = column_at_[j];
        right[kept++] = value;
        // Norms only decrease: a block is stale only if its largest one has.
        if (squares_[j] == best_square_[j / block]) stale_[j / block] = 1;
        squares_[j] -= value * value;
        if (squares_[j] <= norm_lost * first_squares_[j]) {
            squares_[j] = first_squares_[j] = remaining_squares(j);
            stale_[j / block] = 1;
        }
    }
    right_start_[k + 1] = right_start_[k] + kept;
    if (last_changed < 0) return;
    for (int i = 0; i < n; ++i)
        columns_of_.add(at[i], changed_.data(), first_changed, last_changed);
}

double SparseProjection::remaining_squares(int column) const {
    const double* a = working(column);
    const Word* own = rows_of_.words(column);
    double squares = 0.0;
    for (int w = rows_of_.first[column]; w <= rows_of_.last[column]; ++w)
        each_bit(own[w] & open_rows_[w], w << 6, [&](int i) { squares += a[i] * a[i]; });
    return squares;
}

void SparseProjection::pivoted_qr(double) {
    start_pivots();
    for (int k = 0; k < structural_rank; ++k) {
        if (column_count_ > few && rows - k <= packing * column_count_) pack(rows - k);
        const int column = next_pivot(k);
        // All columns left are zero, and so are the pivots.
        if (!reflection(k, column)) break;
        apply(k);
        steps_ = k + 1;
    }
    for (int k = 0; k < structural_rank; ++k)
        pivots_[k] = k < steps_ ? std::abs(right_diagonal_[k]) : 0.0;
    clear();
}

// Clears the working columns for the next evaluation.
void SparseProjection::clear() {
    for (int j = 0; j < column_count_; ++j) {
        double* a = working(j);
        const Word* own = rows_of_.words(j);
        for (int w = rows_of_.first[j]; w <= rows_of_.last[j]; ++w)
            each_bit(own[w], w << 6, [&](int i) { a[i] = 0.0; });
    }
}

void SparseProjection::factorise(const double* M, const double* f, const double* bias,
                                 double floor) {
    cholesky(M);
    std::copy(f, f + nv, white_force.begin());
    whiten_columns(bias);
    pivoted_qr(floor);
}

void SparseProjection::times_q_transposed(double* x) const {
    for (int k = 0; k < reflections_[rank]; ++k) {
        if (tau_[k] == 0.0) continue;
        const int start = reflection_start_[k], n = reflection_start_[k + 1] - start;
        reflected(tau_[k], reflection_.data() + start, reflection_row_.data() + start, n, x);
    }
}

void SparseProjection::times_q(double* x) const {
    for (int k = reflections_[rank] - 1; k >= 0; --k) {
        if (tau_[k] == 0.0) continue;
        const int start = reflection_start_[k], n = reflection_start_[k + 1] - start;
        reflected(tau_[k], reflection_.data() + start, reflection_row_.data() + start, n, x);
    }
}

template <class Solved>
void SparseProjection::forward(const double* g, Solved solved) const {
    double* left = scratch_.data();
    std::copy(g, g + rows, left);
    for (int k = 0; k < rank; ++k) {
        const double z = left[order_[k]] / right_diagonal_[k];
        solved(k, z);
        const int start = right_start_[k];
        scattered(-z, right_.data() + start, right_column_.data() + start,
                  right_start_[k + 1] - start, left);
    }
}

double SparseProjection::beside_diagonal(int k, const double* g) const {
    const int start = right_start_[k];
    return gathered(right_.data() + start, right_column_.data() + start,
                    right_start_[k + 1] - start, g);
}

void SparseProjection::normal(const double* g, double* white) const {
    std::fill(white, white + nv, 0.0);
    forward(g, [&](int k, double z) { white[pivot_row_[k]] = z; });
    times_q(white);
}

void SparseProjection::multiplier(const double* white, double* g) const {
    std::vector<double> x(white, white + nv);
    times_q_transposed(x.data());
    std::fill(g, g + rows, 0.0);
    for (int k = rank - 1; k >= 0; --k)
        g[order_[k]] = (x[pivot_row_[k]] - beside_diagonal(k, g)) / right_diagonal_[k];
}

// Q drops out.
void SparseProjection::inverse_gram(const double* g, double* out) const {
    double* z = solved_.data();
    forward(g, [&](int k, double value) { z[k] = value; });
    std::fill(out, out + rows, 0.0);
    for (int k = rank - 1; k >= 0; --k)
        out[order_[k]] = (z[k] - beside_diagonal(k, out)) / right_diagonal_[k];
}

void SparseProjection::keep_normal(double* white) const {
    times_q_transposed(white);
    double* kept = scratch_.data();
    for (int k = 0; k < rank; ++k) kept[k] = white[pivot_row_[k]];
    std::fill(white, white + nv, 0.0);
    for (int k = 0; k < rank; ++k) white[pivot_row_[k]] = kept[k];
    times_q(white);
}

void SparseProjection::remove_normal(double* white) const {
    times_q_transposed(white);
    for (int k = 0; k < rank; ++k) white[pivot_row_[k]] = 0.0;
    times_q(white);
}

void SparseProjection::normals(double* out) const {
    // Column k of Q is the product of the first k + 1 reflections with a unit vector.  Most of them
    // act on rows in which it is still zero.
    for (int k = 0; k < rank; ++k) {
        double* x = out + static_cast<std::size_t>(k) * nv;
        std::fill(x, x + nv, 0.0);
        x[pivot_row_[k]] = 1.0;
        int low = pivot_row_[k], high = low;
        for (int l = k; l >= 0; --l) {
            if (tau_[l] == 0.0) continue;
            const int start = reflection_start_[l], n = reflection_start_[l + 1] - start;
            const int* at = reflection_row_.data() + start;
            if (at[0] > high || at[n - 1] < low) continue;
            const double* v = reflection_.data() + start;
            const double s = tau_[l] * gathered(v, at, n, x);
            if (!(std::abs(s) > negligible)) continue;
            scattered(-s, v, at, n, x);
            low = std::min(low, at[0]);
            high = std::max(high, at[n - 1]);
        }
        unwhiten(x);
    }
}

void SparseProjection::complement(double* out) const {
    std::vector<char> in_use(nv);
    for (int k = 0; k < rank; ++k) in_use[pivot_row_[k]] = 1;
    for (int i = 0; i < nv; ++i) {
        if (in_use[i]) continue;
        std::fill(out, out + nv, 0.0);
        out[i] = 1.0;
        times_q(out);
        out += nv;
    }
}

}  // namespace srm
