#include "sparse_projection.hpp"

#include <algorithm>
#include <cmath>

#include "errors.hpp"
#include "linear.hpp"

namespace srm {

namespace {

using Word = SparseProjection::Word;

// Entries and changes below this part of a column's norm are left out.
constexpr double negligible = 1e-17;
// Columns whose largest norm is remembered together.
constexpr int block = 32;
// Part of W's entries up to which the sparse algebra is chosen.  Measured on the bundled mechanisms
// and random ones of 6 to 96 coordinates: above it both cost about the same, except that the dense
// one is up to 1.8 times as fast where a long chain makes W full; below it the sparse one wins.
constexpr double densest = 0.5;

int words_for(int bits) { return (bits + 63) / 64; }

void set(Word* bits, int i) { bits[i >> 6] |= Word{1} << (i & 63); }
void unset(Word* bits, int i) { bits[i >> 6] &= ~(Word{1} << (i & 63)); }

template <class Act>
void each_bit(Word word, int first, const Act& act) {
    for (; word; word &= word - 1) act(first + __builtin_ctzll(word));
}

inline double gathered(const double* values, const int* rows, int n, const double* x) {
    double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
    int i = 0;
    for (; i + 4 <= n; i += 4) {
        s0 += values[i] * x[rows[i]];
        s1 += values[i + 1] * x[rows[i + 1]];
        s2 += values[i + 2] * x[rows[i + 2]];
        s3 += values[i + 3] * x[rows[i + 3]];
    }
    for (; i < n; ++i) s0 += values[i] * x[rows[i]];
    return (s0 + s1) + (s2 + s3);
}

inline void scattered(double a, const double* values, const int* rows, int n, double* x) {
    for (int i = 0; i < n; ++i) x[rows[i]] += a * values[i];
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
    std::size_t entries = 0;
    for (const std::vector<int>& support : with_ancestors(pattern)) entries += support.size();
    return entries <= densest * pattern.parents.size() * pattern.supports.size();
}

SparseProjection::BitSets::BitSets(int sets, int bits)
    : first(sets), last(sets), stride_(words_for(bits)), words_(sets * std::size_t(stride_)) {}

void SparseProjection::BitSets::clear() {
    std::fill(words_.begin(), words_.end(), Word{0});
    std::fill(first.begin(), first.end(), static_cast<int>(stride_));
    std::fill(last.begin(), last.end(), -1);
}

void SparseProjection::BitSets::set(int which, int i) {
    const int w = i >> 6;
    srm::set(&words_[which * stride_], i);
    first[which] = std::min(first[which], w);
    last[which] = std::max(last[which], w);
}

inline void SparseProjection::BitSets::add(int which, const Word* bits, int from, int to) {
    Word* own = &words_[which * stride_];
    for (int w = from; w <= to; ++w) own[w] |= bits[w];
    first[which] = std::min(first[which], from);
    last[which] = std::max(last[which], to);
}

inline void SparseProjection::BitSets::add_to(int which, Word* bits) const {
    const Word* own = &words_[which * stride_];
    for (int w = first[which]; w <= last[which]; ++w) bits[w] |= own[w];
}

SparseProjection::SparseProjection(int structural_rank, double sigma_ref, const Pattern& pattern)
    : Projection(static_cast<int>(pattern.parents.size()),
                 static_cast<int>(pattern.supports.size()), structural_rank, sigma_ref),
      diagonal_(nv),
      inverse_(nv),
      A_(static_cast<std::size_t>(nv) * rows),
      row_words_(words_for(nv)),
      column_words_(words_for(rows)),
      rows_of_(rows, nv),
      columns_of_(nv, rows),
      open_rows_(row_words_),
      open_columns_(column_words_),
      met_(column_words_),
      changed_(column_words_),
      own_rows_(row_words_),
      met_columns_(rows),
      along_(rows),
      squares_(rows),
      first_squares_(rows),
      least_(rows),
      order_(rows),
      position_(rows),
      best_((rows + block - 1) / block),
      stale_(best_.size()),
      best_square_(best_.size()),
      pivot_row_(structural_rank),
      reflection_start_(structural_rank + 1),
      right_start_(structural_rank + 1),
      tau_(structural_rank),
      right_diagonal_(structural_rank),
      scratch_(rows) {
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

// Row k of L after all its descendants: M = L^T L.
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

void SparseProjection::whiten_velocity(double* x) const {
    for (int k = nv - 1; k >= 0; --k) {
        const int first = ancestor_start_[k], n = ancestor_start_[k + 1] - first;
        x[k] = diagonal_[k] * x[k] + gathered(L_.data() + first, ancestors_.data() + first, n, x);
    }
}

// W and gamma; the rows of each column are those with entries above `negligible`.
void SparseProjection::whiten_columns(const double* bias) {
    for (int k = nv - 1; k >= 0; --k) {
        const int first = ancestor_start_[k], n = ancestor_start_[k + 1] - first;
        white_force[k] *= inverse_[k];
        scattered(-white_force[k], L_.data() + first, ancestors_.data() + first, n,
                  white_force.data());
    }
    rows_of_.clear();
    columns_of_.clear();
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
        squares_[j] = first_squares_[j] = squares;
        if (!std::isfinite(squares)) {
            std::fill(A_.begin(), A_.end(), 0.0);
            throw EvaluationError{Failure::closures};
        }
        least_[j] = negligible * std::sqrt(squares);
        for (int s = start; s < end; ++s) {
            const int k = support_[s];
            if (std::abs(a[k]) > least_[j]) {
                rows_of_.set(j, k);
                columns_of_.set(k, j);
            } else {
                a[k] = 0.0;
            }
        }
    }
}

void SparseProjection::start_pivots() {
    for (int j = 0; j < rows; ++j) order_[j] = position_[j] = j;
    std::fill(stale_.begin(), stale_.end(), 1);
    std::fill(open_rows_.begin(), open_rows_.end(), Word{0});
    for (int i = 0; i < nv; ++i) set(open_rows_.data(), i);
    std::fill(open_columns_.begin(), open_columns_.end(), Word{0});
    for (int j = 0; j < rows; ++j) set(open_columns_.data(), j);
    reflection_row_.clear();
    reflection_.clear();
    right_column_.clear();
    right_.clear();
    steps_ = 0;
}

// Moves the column of the largest norm, the first by position among equals, to position k.
int SparseProjection::next_pivot(int k) {
    const auto before = [&](int a, int b) {
        return squares_[a] > squares_[b] ||
               (squares_[a] == squares_[b] && position_[a] < position_[b]);
    };
    const int blocks = static_cast<int>(best_.size());
    double largest = -1.0;
    for (int b = 0; b < blocks; ++b) {
        if (stale_[b]) {
            const int first = b * block, end = std::min(rows, first + block);
            int best = first;
            for (int j = first + 1; j < end; ++j)
                if (before(j, best)) best = j;
            best_[b] = best;
            best_square_[b] = squares_[best];
            stale_[b] = 0;
        }
        largest = std::max(largest, best_square_[b]);
    }
    int pivot = -1;
    for (int b = 0; b < blocks; ++b)
        if (best_square_[b] == largest && (pivot < 0 || position_[best_[b]] < position_[pivot]))
            pivot = best_[b];
    const int other = order_[k], place = position_[pivot];
    order_[place] = other;
    position_[other] = place;
    order_[k] = pivot;
    position_[pivot] = k;
    // Equal norms are told apart by positions.
    stale_[pivot / block] = stale_[other / block] = 1;
    squares_[pivot] = -1.0;
    unset(open_columns_.data(), pivot);
    return pivot;
}

// Reflection k, which takes what is left of a column to its largest row; false if nothing is left.
bool SparseProjection::reflection(int k, int column) {
    const std::size_t start = reflection_.size();
    const double* a = this->column(column);
    const Word* own = rows_of_.words(column);
    double squares = 0.0;
    std::size_t top = start;
    own_first_ = rows_of_.first[column];
    own_last_ = rows_of_.last[column];
    for (int w = own_first_; w <= own_last_; ++w) {
        own_rows_[w] = 0;
        each_bit(own[w] & open_rows_[w], w << 6, [&](int i) {
            const double value = a[i];
            if (!(std::abs(value) > least_[column])) return;
            reflection_row_.push_back(i);
            reflection_.push_back(value);
            own_rows_[w] |= Word{1} << (i & 63);
            squares += value * value;
            if (std::abs(value) > std::abs(reflection_[top])) top = reflection_.size() - 1;
        });
    }
    const std::size_t n = reflection_.size() - start;
    if (n == 0) return false;
    const double alpha = reflection_[top];
    pivot_row_[k] = reflection_row_[top];
    if (n == 1) {
        tau_[k] = 0.0;
        right_diagonal_[k] = alpha;
    } else {
        const double beta = -std::copysign(std::sqrt(squares), alpha);
        tau_[k] = (beta - alpha) / beta;
        right_diagonal_[k] = beta;
        const double scale = 1.0 / (alpha - beta);
        for (std::size_t i = start; i < start + n; ++i) reflection_[i] *= scale;
    }
    reflection_[top] = 1.0;
    return true;
}

// Reflects the other columns, and takes the pivot row out of their norms.
void SparseProjection::apply(int k) {
    const int start = reflection_start_[k], n = reflection_start_[k + 1] - start;
    const int* at = reflection_row_.data() + start;
    const double* v = reflection_.data() + start;
    const int pivot = pivot_row_[k];
    const double tau = tau_[k];
    int first = column_words_, last = -1;
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
    const std::size_t stride = nv;
    double* const along = along_.data();
    if (tau != 0.0) {
        for (int c = 0; c < count; ++c) along[c] = tau * gathered(v, at, n, A + met[c] * stride);
        const double length = std::sqrt(2.0 / tau);
        for (int c = 0; c < count; ++c) {
            const int j = met[c];
            if (!(std::abs(along[c]) * length > least[j])) continue;
            scattered(-along[c], v, at, n, A + j * stride);
            rows_of_.add(j, own_rows_.data(), own_first_, own_last_);
            srm::set(changed_.data(), j);
        }
    }
    const std::size_t start_right = right_.size();
    right_.resize(start_right + count);
    right_column_.resize(start_right + count);
    double* const right = right_.data() + start_right;
    int* const right_column = right_column_.data() + start_right;
    int kept = 0;
    for (int c = 0; c < count; ++c) {
        const int j = met[c];
        const double value = A[j * stride + pivot];
        if (!(std::abs(value) > least[j])) continue;
        right_column[kept] = j;
        right[kept++] = value;
        squares_[j] -= value * value;
        if (squares_[j] <= norm_lost * first_squares_[j])
            squares_[j] = first_squares_[j] = remaining_squares(j);
        // Norms only fall: those of the others in a block stay below its largest.
        if (best_[j / block] == j) stale_[j / block] = 1;
    }
    right_.resize(start_right + kept);
    right_column_.resize(start_right + kept);
    for (int i = 0; i < n; ++i) columns_of_.add(at[i], changed_.data(), first, last);
}

double SparseProjection::remaining_squares(int column) const {
    const double* a = &A_[static_cast<std::size_t>(column) * nv];
    const Word* own = rows_of_.words(column);
    double squares = 0.0;
    for (int w = rows_of_.first[column]; w <= rows_of_.last[column]; ++w)
        each_bit(own[w] & open_rows_[w], w << 6, [&](int i) { squares += a[i] * a[i]; });
    return squares;
}

void SparseProjection::pivoted_qr() {
    start_pivots();
    for (int k = 0; k < structural_rank; ++k) {
        const int column = next_pivot(k);
        reflection_start_[k] = static_cast<int>(reflection_.size());
        right_start_[k] = static_cast<int>(right_.size());
        // All columns left are zero: no pivot from here on is used.
        if (!reflection(k, column)) break;
        reflection_start_[k + 1] = static_cast<int>(reflection_.size());
        apply(k);
        right_start_[k + 1] = static_cast<int>(right_.size());
        steps_ = k + 1;
    }
    for (int k = 0; k < structural_rank; ++k)
        pivots_[k] = k < steps_ ? std::abs(right_diagonal_[k]) : 0.0;
}

// The working columns are zero again, but for the supports that the next evaluation writes.
void SparseProjection::clear() {
    for (int j = 0; j < rows; ++j) {
        double* a = column(j);
        const Word* own = rows_of_.words(j);
        for (int w = rows_of_.first[j]; w <= rows_of_.last[j]; ++w)
            each_bit(own[w], w << 6, [&](int i) { a[i] = 0.0; });
    }
}

void SparseProjection::factorise(const double* M, const double* f, const double* bias) {
    cholesky(M);
    std::copy(f, f + nv, white_force.begin());
    whiten_columns(bias);
    pivoted_qr();
    clear();
}

void SparseProjection::times_q_transposed(double* x) const {
    for (int k = 0; k < rank; ++k) {
        if (tau_[k] == 0.0) continue;
        const int start = reflection_start_[k], n = reflection_start_[k + 1] - start;
        const int* at = reflection_row_.data() + start;
        const double* v = reflection_.data() + start;
        scattered(-tau_[k] * gathered(v, at, n, x), v, at, n, x);
    }
}

void SparseProjection::times_q(double* x) const {
    for (int k = rank - 1; k >= 0; --k) {
        if (tau_[k] == 0.0) continue;
        const int start = reflection_start_[k], n = reflection_start_[k + 1] - start;
        const int* at = reflection_row_.data() + start;
        const double* v = reflection_.data() + start;
        scattered(-tau_[k] * gathered(v, at, n, x), v, at, n, x);
    }
}

void SparseProjection::normal(const double* g, double* white) const {
    double* left = scratch_.data();
    std::copy(g, g + rows, left);
    std::fill(white, white + nv, 0.0);
    for (int k = 0; k < rank; ++k) {
        const double z = left[order_[k]] / right_diagonal_[k];
        white[pivot_row_[k]] = z;
        const int start = right_start_[k];
        scattered(-z, right_.data() + start, right_column_.data() + start,
                  right_start_[k + 1] - start, left);
    }
    times_q(white);
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
    // Column k of Q is the product of the first k + 1 reflections with a unit vector: most of them
    // lie outside the rows that it has come to.
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

}  // namespace srm
