#include "swept_projection.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "linear.hpp"
#include "scattered.hpp"

namespace srm {

namespace {

// Norms below this multiple of the floor count as below it: rounding may move them there.
constexpr double floor_margin = 1.0 + 1e-12;
// Squared norms with a ratio above this count as equal: rounding may have made the difference.
constexpr double equal_squares = 1.0 - 1e-8;
// In place of a squared norm that the next pivots cannot fall below.
constexpr double not_summed = -std::numeric_limits<double>::infinity();

}  // namespace

SweptProjection::SweptProjection(int structural_rank, double sigma_ref, const Pattern& pattern)
    : SparseProjection(structural_rank, sigma_ref, pattern),
      pivot_share_(pattern.pivot_share),
      pivot_window_(pattern.pivot_window),
      row_place_(nv),
      values_(static_cast<std::size_t>(nv) * rows),
      small_(rows),
      left_(rows),
      summed_(rows),
      touched_(nv),
      last_(nv),
      entries_(nv),
      by_pivot_(structural_rank),
      first_rows_of_(rows_of_),
      first_columns_of_(columns_of_) {
    lost_.reserve(rows);
    waiting_.reserve(rows);
    deferred_.reserve(rows);
    window_.reserve(pivot_window_);
    column_at_ = pattern.order;
    // Rows in the order of the last column of each.
    std::vector<int> done(nv, rows);
    for (int j = 0; j < rows; ++j) {
        const int row_of_g = column_at_[j];
        for (int s = support_start_[row_of_g]; s < support_start_[row_of_g + 1]; ++s)
            done[support_[s]] = j;
    }
    std::iota(row_at_.begin(), row_at_.end(), 0);
    std::stable_sort(row_at_.begin(), row_at_.end(),
                     [&](int a, int b) { return done[a] < done[b]; });
    for (int i = 0; i < nv; ++i) row_place_[row_at_[i]] = i;
    rows_of_.clear(rows, nv);
    columns_of_.clear(nv, rows);
    for (int j = 0; j < rows; ++j) {
        const int row_of_g = column_at_[j];
        for (int s = support_start_[row_of_g]; s < support_start_[row_of_g + 1]; ++s) {
            rows_of_.set(j, row_place_[support_[s]]);
            columns_of_.set(row_place_[support_[s]], j);
        }
    }
    first_rows_of_ = rows_of_;
    first_columns_of_ = columns_of_;
}

// Copies the columns of W into the working rows, and clears them.
void SweptProjection::take_columns() {
    rows_of_.restore(first_rows_of_);
    columns_of_.restore(first_columns_of_);
    for (int j = 0; j < rows; ++j) {
        const int from = column_at_[j];
        double* const a = column(from);
        small_[j] = least_[from];
        left_[j] = squares_[from];
        for (int s = support_start_[from]; s < support_start_[from + 1]; ++s) {
            const int k = support_[s];
            const int i = row_place_[k];
            if (std::abs(a[k]) > small_[j]) {
                row(i)[j] = a[k];
            } else {
                rows_of_.remove(j, i);
                columns_of_.remove(i, j);
            }
            a[k] = 0.0;
        }
    }
    std::fill(open_rows_.begin(), open_rows_.end(), Word{0});
    for (int i = 0; i < nv; ++i) set(open_rows_.data(), i);
    std::fill(open_columns_.begin(), open_columns_.end(), Word{0});
    waiting_.resize(rows);
    std::iota(waiting_.begin(), waiting_.end(), 0);
    reflections_[0] = reflection_start_[0] = right_start_[0] = steps_ = 0;
}

// Opens all columns of this sweep; the largest of their norms.
double SweptProjection::start_sweep() {
    if (steps_ > 0) {
        // The rows of deferred columns were not updated.
        rows_of_.clear(rows, nv);
        for (const int j : waiting_) left_[j] = 0.0;
        for (std::size_t w = 0; w < open_rows_.size(); ++w)
            each_bit(open_rows_[w], static_cast<int>(w) << 6, [&](int i) {
                const double* const a = row(i);
                const Word* const own = columns_of_.words(i);
                for (int u = columns_of_.first[i]; u <= columns_of_.last[i]; ++u)
                    each_bit(own[u], u << 6, [&](int j) {
                        left_[j] += a[j] * a[j];
                        rows_of_.set(j, i);
                    });
            });
    }
    double largest = 0.0;
    for (const int j : waiting_) {
        largest = std::max(largest, left_[j]);
        summed_[j] = not_summed;
        set(open_columns_.data(), j);
    }
    return std::sqrt(largest);
}

// Squared norm of what is left of an open column.
double SweptProjection::remaining(int column) const {
    const Word* const own = rows_of_.words(column);
    double squares = 0.0;
    for (int w = rows_of_.first[column]; w <= rows_of_.last[column]; ++w)
        each_bit(own[w] & open_rows_[w], w << 6, [&](int i) {
            const double value = row(i)[column];
            if (std::abs(value) > small_[column]) squares += value * value;
        });
    return squares;
}

// The place in the window of the largest column, the first of those that are equal up to rounding.
int SweptProjection::take_from_window() {
    double largest = 0.0;
    for (const int j : window_) largest = std::max(largest, left_[j]);
    int place = 0;
    while (left_[window_[place]] < equal_squares * largest) ++place;
    return place;
}

// Moves the entries of a column in its open rows to entries_, and their rows to touched_.
void SweptProjection::gather(int column) {
    const Word* const own = rows_of_.words(column);
    touched_.clear();
    entries_.clear();
    for (int w = rows_of_.first[column]; w <= rows_of_.last[column]; ++w)
        each_bit(own[w] & open_rows_[w], w << 6, [&](int i) {
            double& value = row(i)[column];
            if (std::abs(value) > small_[column]) {
                touched_.push_back(i);
                entries_.push_back(value);
            }
            value = 0.0;
            columns_of_.remove(i, column);
        });
}

void SweptProjection::pivoted_qr(double floor) {
    take_columns();
    bool forward = true;
    while (steps_ < structural_rank) {
        const double largest = start_sweep();
        // All columns left are zero, and so are the pivots.
        if (!(largest > 0.0)) break;
        double least = structural_rank < rows ? pivot_share_ * largest : 0.0;
        if (largest > floor * floor_margin) least = std::max(least, floor);
        deferred_.clear();
        window_.clear();
        const int count = static_cast<int>(waiting_.size()), before = steps_;
        int next = 0;
        while (steps_ < structural_rank) {
            for (; window_.size() < pivot_window_ && next < count; ++next) {
                const int j = waiting_[forward ? next : count - 1 - next];
                left_[j] = summed_[j] = remaining(j);
                window_.push_back(j);
            }
            if (window_.empty()) break;
            const int place = take_from_window(), j = window_[place];
            if (left_[j] > 0.0 && left_[j] >= least * least) {
                window_.erase(window_.begin() + place);
                unset(open_columns_.data(), j);
                gather(j);
                if (touched_.empty())
                    deferred_.push_back(j);
                else
                    eliminate(j, forward);
            } else {
                for (const int other : window_) unset(open_columns_.data(), other);
                deferred_.insert(deferred_.end(), window_.begin(), window_.end());
                window_.clear();
            }
        }
        // All entries left are negligible.
        if (steps_ == before) break;
        if (!forward) std::reverse(deferred_.begin(), deferred_.end());
        std::swap(waiting_, deferred_);
        forward = !forward;
    }
    for (int k = 0; k < structural_rank; ++k)
        pivots_[k] = k < steps_ ? std::abs(right_diagonal_[k]) : 0.0;
    clear_rows();
}

// Makes `column`, whose entries gather() has found, the next pivot.
void SweptProjection::eliminate(int column, bool forward) {
    const int k = steps_, n = static_cast<int>(touched_.size());
    const Word* const coming = open_columns_.data();
    // Sorts the rows by the last column to come in each, in the direction of the sweep.
    for (int c = 0; c < n; ++c) {
        const int i = touched_[c];
        const double entry = entries_[c];
        const Word* const of = columns_of_.words(i);
        int last = -1;
        if (forward) {
            for (int w = columns_of_.last[i]; w >= columns_of_.first[i] && last < 0; --w)
                if (const Word both = of[w] & coming[w])
                    last = (w << 6) + 63 - __builtin_clzll(both);
        } else {
            for (int w = columns_of_.first[i]; w <= columns_of_.last[i] && last < 0; ++w)
                if (const Word both = of[w] & coming[w])
                    last = rows - (w << 6) - __builtin_ctzll(both);
        }
        int place = c;
        for (; place > 0 && last_[place - 1] > last; --place) {
            touched_[place] = touched_[place - 1];
            entries_[place] = entries_[place - 1];
            last_[place] = last_[place - 1];
        }
        touched_[place] = i;
        entries_[place] = entry;
        last_[place] = last;
    }
    reflections_[k + 1] = reflections_[k];
    int pivot = 0;
    const auto exchange = [&](int a, int b) {
        std::swap(touched_[a], touched_[b]);
        std::swap(entries_[a], entries_[b]);
    };
    for (int first = 0, end = 1; end <= n; ++end) {
        if (end < n && last_[end] == last_[first]) continue;
        if (first == 0) {
            int top = 0;
            for (int c = 1; c < end; ++c)
                if (std::abs(entries_[c]) > std::abs(entries_[top])) top = c;
            exchange(0, top);
        } else {
            // Of the rows before these only that of the pivot is left.
            exchange(first - 1, pivot);
            pivot = first - 1;
        }
        if (end - pivot > 1) reflect(touched_.data() + pivot, entries_.data() + pivot, end - pivot);
        first = end;
    }
    right_diagonal_[k] = entries_[pivot];
    take_right(column, touched_[pivot]);
}

// Reflects n rows so that of v, their entries in the column of the next pivot, only the first is
// not zero.
void SweptProjection::reflect(const int* at, double* v, int n) {
    double squares = 0.0;
    for (int c = 0; c < n; ++c) squares += v[c] * v[c];
    const double alpha = v[0], beta = -std::copysign(std::sqrt(squares), alpha);
    const double tau = (beta - alpha) / beta, scale = 1.0 / (alpha - beta);
    v[0] = 1.0;
    for (int c = 1; c < n; ++c) v[c] *= scale;
    if (n == 2)
        reflect_pair(at[0], at[1], v[1], tau);
    else
        reflect_rows(at, v, n, tau);
    const int l = reflections_[steps_ + 1]++;
    if (static_cast<int>(tau_.size()) <= l) {
        tau_.resize(2 * tau_.size());
        reflection_start_.resize(tau_.size() + 1);
    }
    tau_[l] = tau;
    const int used = reflection_start_[l];
    int* const rows_at = room(reflection_row_, used, n);
    double* const kept = room(reflection_, used, n);
    for (int c = 0; c < n; ++c) {
        rows_at[c] = row_at_[at[c]];
        kept[c] = v[c];
    }
    reflection_start_[l + 1] = used + n;
    v[0] = beta;
}

// Applies 1 - tau v v^T with v = (1, second) to two rows, the first that of the pivot, as
// most reflections do, where it changes more than negligible parts of columns.
void SweptProjection::reflect_pair(int one, int two, double second, double tau) {
    double *const a = row(one), *const b = row(two);
    const double* const least = small_.data();
    const Word *const in_a = columns_of_.words(one), *const in_b = columns_of_.words(two);
    // A change of along v has the length |along| |v|.
    const double length = std::sqrt(1.0 + second * second);
    const int from = std::min(columns_of_.first[one], columns_of_.first[two]);
    const int to = std::max(columns_of_.last[one], columns_of_.last[two]);
    for (int w = from; w <= to; ++w) {
        Word changed = 0;
        each_bit(in_a[w] | in_b[w], w << 6, [&](int j) {
            const double along = tau * (a[j] + second * b[j]);
            if (!(std::abs(along) * length > least[j])) return;
            a[j] -= along;
            b[j] -= second * along;
            changed |= Word{1} << (j & 63);
        });
        // The row of the pivot, which closes, needs no column to know it.
        columns_of_.add(one, changed, w);
        enter(two, changed, w);
    }
}

// The same with n rows.
void SweptProjection::reflect_rows(const int* at, const double* v, int n, double tau) {
    const double length = std::sqrt(2.0 / tau);
    double* const along = along_.data();
    int from = static_cast<int>(open_columns_.size()), to = -1;
    for (int c = 0; c < n; ++c) {
        from = std::min(from, columns_of_.first[at[c]]);
        to = std::max(to, columns_of_.last[at[c]]);
    }
    for (int w = from; w <= to; ++w) {
        Word met = 0;
        for (int c = 0; c < n; ++c) met |= columns_of_.words(at[c])[w];
        if (!met) continue;
        // From the first of these columns to the last; those between are zero in these rows.
        const int gap = __builtin_ctzll(met), count = 64 - __builtin_clzll(met) - gap;
        const int start = (w << 6) + gap;
        const double* const least = small_.data() + start;
        const double* a = row(at[0]) + start;
        for (int j = 0; j < count; ++j) along[j] = tau * a[j];
        for (int c = 1; c < n; ++c) add(tau * v[c], row(at[c]) + start, along, count);
        Word changed = 0;
        for (int j = 0; j < count; ++j) {
            const bool kept = std::abs(along[j]) * length > least[j];
            along[j] = kept ? along[j] : 0.0;
            changed |= Word{kept} << j;
        }
        if (!changed) continue;
        columns_of_.add(at[0], changed << gap, w);  // as in reflect_pair()
        for (int c = 0; c < n; ++c) {
            add(-v[c], along, row(at[c]) + start, count);
            if (c > 0) enter(at[c], changed << gap, w);
        }
    }
}

void SweptProjection::enter_fresh(int row, Word columns, int w) {
    const Word fresh = columns & ~columns_of_.words(row)[w];
    columns_of_.add(row, fresh, w);
    each_bit(fresh & open_columns_[w], w << 6, [&](int j) { rows_of_.set(j, row); });
}

// Moves the row of the pivot to R.
void SweptProjection::take_right(int column, int pivot) {
    const int k = steps_++;
    double* const a = row(pivot);
    order_[k] = column_at_[column];
    pivot_row_[k] = row_at_[pivot];
    const Word* const own = columns_of_.words(pivot);
    int used = right_start_[k];
    for (int w = columns_of_.first[pivot]; w <= columns_of_.last[pivot]; ++w) {
        if (!own[w]) continue;
        int* const columns = room(right_column_, used, 64);
        double* const values = room(right_, used, 64);
        int kept = 0;
        each_bit(own[w], w << 6, [&](int j) {
            const double value = a[j];
            a[j] = 0.0;
            if (!(std::abs(value) > small_[j])) return;
            columns[kept] = column_at_[j];
            values[kept++] = value;
            left_[j] -= value * value;
            // Only columns in the window are summed.
            if (left_[j] <= norm_lost * summed_[j]) lost_.push_back(j);
        });
        used += kept;
    }
    right_start_[k + 1] = used;
    unset(open_rows_.data(), pivot);
    for (const int j : lost_) left_[j] = summed_[j] = remaining(j);
    lost_.clear();
}

// Clears the working rows.
void SweptProjection::clear_rows() {
    for (std::size_t w = 0; w < open_rows_.size(); ++w)
        each_bit(open_rows_[w], static_cast<int>(w) << 6, [&](int i) {
            double* const a = row(i);
            const Word* const own = columns_of_.words(i);
            for (int u = columns_of_.first[i]; u <= columns_of_.last[i]; ++u)
                each_bit(own[u], u << 6, [&](int j) { a[j] = 0.0; });
        });
}

double SweptProjection::smallest_pivot() const {
    return *std::min_element(pivots_.begin(), pivots_.end());
}

// Pivots in the order of their size, the smallest last.
void SweptProjection::sort_pivots() const {
    std::iota(by_pivot_.begin(), by_pivot_.begin() + rank, 0);
    std::stable_sort(by_pivot_.begin(), by_pivot_.begin() + rank,
                     [&](int a, int b) { return pivots_[a] > pivots_[b]; });
}

void SweptProjection::normal_of_pivot(int k, double* out) const {
    std::fill(out, out + nv, 0.0);
    out[pivot_row_[k]] = 1.0;
    for (int l = reflections_[k + 1] - 1; l >= 0; --l) {
        const int start = reflection_start_[l], n = reflection_start_[l + 1] - start;
        const int* const at = reflection_row_.data() + start;
        const double* const v = reflection_.data() + start;
        const double s = tau_[l] * gathered(v, at, n, out);
        if (s != 0.0) scattered(-s, v, at, n, out);
    }
    unwhiten(out);
}

void SweptProjection::normals(double* out) const {
    sort_pivots();
    for (int k = 0; k < rank; ++k, out += nv) normal_of_pivot(by_pivot_[k], out);
}

void SweptProjection::weak_normals(std::vector<double>& out) const {
    sort_pivots();
    int first = rank;
    while (first > 0 && pivots_[by_pivot_[first - 1]] < sigma_ref) --first;
    out.resize(static_cast<std::size_t>(rank - first) * nv);
    double* normal = out.data();
    for (int k = first; k < rank; ++k, normal += nv) normal_of_pivot(by_pivot_[k], normal);
}

}  // namespace srm
