#include "swept_projection.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "across_columns.hpp"
#include "processor.hpp"
#include "scattered.hpp"

namespace srm {

namespace {

// Norms below this multiple of the floor count as below it: rounding may move them there.
constexpr double floor_margin = 1.0 + 1e-12;
// Squared norms with a ratio above this count as equal: rounding may have made the difference.
constexpr double equal_squares = 1.0 - 1e-8;

// Applies 1 - tau v v^T to n rows of 64 columns where one of them has entries (`met`) and that
// changes more than a negligible part of a column, `least` (64,).  Returns the columns that change.
SRM_FOR_PROCESSOR Word reflect_word(double* const* rows, const double* v, int n, double tau,
                                    const double* least, Word met) {
    using Bits = std::int64_t __attribute__((vector_size(8 * lanes)));
    constexpr Word first_of_vector = 0x1111111111111111;
    Word changed = 0;
    met |= met >> 1;
    for (met = (met | met >> 2) & first_of_vector; met; met &= met - 1) {
        const int c = __builtin_ctzll(met);
        Lanes along = v[0] * at(rows[0] + c);
        for (int i = 1; i < n; ++i) along += v[i] * at(rows[i] + c);
        along *= tau;
        const Bits kept = (Bits)(along > at(least + c)) | (Bits)(-along > at(least + c));
        along = (Lanes)((Bits)along & kept);
        for (int i = 0; i < n; ++i) at(rows[i] + c) -= v[i] * along;
        const Bits which = kept & Bits{1, 2, 4, 8};
        changed |= static_cast<Word>(which[0] | which[1] | which[2] | which[3]) << c;
    }
    return changed;
}

}  // namespace

SweptProjection::SweptProjection(int structural_rank, double sigma_ref, const Pattern& pattern)
    : SparseProjection(structural_rank, sigma_ref, pattern),
      pivot_share_(pattern.pivot_share),
      pivot_window_(pattern.pivot_window),
      panel_row_(nv, -1),
      place_(rows),
      most_(pivot_window_ / 4 + 1),
      touched_(nv),
      last_(nv),
      entries_(nv),
      at_(nv),
      by_pivot_(structural_rank) {
    first_sweep_.columns = pattern.order;
    for (const int g : pattern.order) {
        const auto in = support_.begin();
        first_sweep_.coordinates.insert(first_sweep_.coordinates.end(), in + support_start_[g],
                                        in + support_start_[g + 1]);
        first_sweep_.start.push_back(static_cast<int>(first_sweep_.coordinates.size()));
    }
    first_sweep_.values.resize(first_sweep_.coordinates.size());
    find_reach(first_sweep_);
    window_.reserve(pivot_window_);
    resize(1);
}

void SweptProjection::find_reach(Sweep& sweep) const {
    const int count = static_cast<int>(sweep.columns.size());
    std::vector<int> last(nv);
    const auto each_entry = [&](const auto& act) {
        for (int p = 0; p < count; ++p)
            for (int s = sweep.start[p]; s < sweep.start[p + 1]; ++s) act(p, sweep.coordinates[s]);
    };
    each_entry([&](int p, int k) { last[k] = p; });
    sweep.reach.resize(count);
    std::iota(sweep.reach.begin(), sweep.reach.end(), 0);
    each_entry([&](int p, int k) { sweep.reach[p] = std::max(sweep.reach[p], last[k]); });
}

// Makes room for 64 `words` rows and columns in an empty panel, which is zero everywhere.
void SweptProjection::resize(int words) {
    words_ = words;
    const std::size_t places = static_cast<std::size_t>(words) * 64;
    for (auto* of : {&open_rows_, &open_columns_, &coming_}) of->assign(words, 0);
    if (small_.size() >= places) return;
    panel_.resize(places * places);
    for (auto* of : {&columns_in_, &rows_in_}) of->resize(places * words);
    for (auto* of : {&small_, &left_, &lost_}) of->resize(places);
    for (auto* of : {&row_at_, &column_at_}) of->resize(places);
}

// Empties the panel, and hands its entries to `act`.
template <class Act>
void SweptProjection::empty_panel(const Act& act) {
    for (int v = 0; v < words_; ++v)
        each_bit(open_rows_[v], v << 6, [&](int r) {
            double* const a = row(r, words_);
            Word* const own = columns_in(r, words_);
            for (int w = 0; w < words_; ++w) {
                each_bit(own[w], w << 6, [&](int c) {
                    act(row_at_[r], c, a[c]);
                    a[c] = 0.0;
                });
                own[w] = 0;
            }
            panel_row_[row_at_[r]] = -1;
        });
    std::fill_n(rows_in_.begin(), column_count_ * words_, Word{0});
    for (auto* of : {&open_rows_, &open_columns_, &coming_})
        std::fill(of->begin(), of->end(), Word{0});
    row_count_ = column_count_ = 0;
}

// Moves the open rows and columns to the front of the panel, in the same order, or to a larger one,
// so that a column with `entries` fits in.
void SweptProjection::make_room(int entries) {
    const std::vector<Word> open(open_columns_), coming(coming_);
    int columns = 0, count = 0;
    for (const Word word : open_rows_) count += __builtin_popcountll(word);
    for (int w = 0; w < words_; ++w)
        each_bit(open[w], w << 6, [&](int c) {
            small_[columns] = small_[c];
            left_[columns] = left_[c];
            lost_[columns] = lost_[c];
            column_at_[columns] = column_at_[c];
            place_[c] = columns++;
        });
    for (int& c : window_) c = place_[c];
    moved_.clear();
    empty_panel([&](int coordinate, int c, double value) {
        moved_.push_back({coordinate, place_[c], value});
    });
    int words = words_;
    while (4 * std::max(columns + 1, count + entries) > 3 * 64 * words) words *= 2;
    if (words > words_) resize(words);
    column_count_ = columns;
    for (int c = 0; c < columns; ++c) set(open_columns_.data(), c);
    int first = 0;
    for (const Word word : coming) {
        each_bit(word, first, [&](int c) { set(coming_.data(), place_[c]); });
        first += 64;
    }
    for (const Entry& entry : moved_) enter(entry.coordinate, entry.column, entry.value);
}

// Writes an entry into the panel.
inline void SweptProjection::enter(int coordinate, int c, double value) {
    int r = panel_row_[coordinate];
    if (r < 0) {
        panel_row_[coordinate] = r = row_count_++;
        row_at_[r] = coordinate;
        set(open_rows_.data(), r);
    }
    row(r, words_)[c] = value;
    set(columns_in(r, words_), c);
    set(rows_in(c, words_), r);
}

// Takes the next column of the sweep into the panel.
inline void SweptProjection::take_column(const Sweep& sweep) {
    const int p = taken_++, g = sweep.columns[p], start = sweep.start[p], end = sweep.start[p + 1];
    const int entries = end - start, places = 64 * words_;
    if (column_count_ == places || row_count_ + entries > places) make_room(entries);
    const int c = column_count_++;
    column_at_[c] = g;
    const double least = small_[c] = least_[g];
    left_[c] = squares_[g];
    lost_[c] = norm_lost * left_[c];
    set(open_columns_.data(), c);
    set(coming_.data(), c);
    for (int s = start; s < end; ++s)
        if (std::abs(sweep.values[s]) > least) enter(sweep.coordinates[s], c, sweep.values[s]);
}

// Fills the window with the next columns of the sweep.
inline void SweptProjection::fill_window(const Sweep& sweep) {
    const int count = static_cast<int>(sweep.columns.size());
    for (; window_.size() < pivot_window_ && next_ < count; ++next_) {
        while (taken_ <= sweep.reach[next_]) take_column(sweep);
        // Columns that have not been in the window are the last of the panel.
        window_.push_back(column_count_ - (taken_ - next_));
    }
}

// Computes the squared norm of what is left of a column.
void SweptProjection::sum(int column) {
    double squares = 0.0;
    for (int w = 0; w < words_; ++w)
        each_bit(rows_in(column, words_)[w] & open_rows_[w], w << 6, [&](int r) {
            const double value = row(r, words_)[column];
            if (std::abs(value) > small_[column]) squares += value * value;
        });
    left_[column] = squares;
    lost_[column] = norm_lost * squares;
}

// The place in the window of the largest column, the first of those that are equal up to rounding.
inline int SweptProjection::largest_in_window() {
    const int n = static_cast<int>(window_.size());
    const int* const at = window_.data();
    const double* const left = left_.data();
    const auto larger = [](double x, double y) { return x > y ? x : y; };
    // The largest up to the end of each block of four.
    double* block = most_.data();
    double most = 0.0;
    int i = 0;
    for (; i + 4 <= n; i += 4) {
        const double first = larger(left[at[i]], left[at[i + 1]]);
        const double second = larger(left[at[i + 2]], left[at[i + 3]]);
        *block++ = most = larger(larger(first, second), most);
    }
    for (; i < n; ++i) most = larger(left[at[i]], most);
    *block = most;
    const double least = equal_squares * most;
    int place = 0;
    for (block = most_.data(); *block < least; ++block) place += 4;
    while (left[at[place]] < least) ++place;
    return place;
}

// Moves the entries of a column in its open rows to entries_, and their rows to touched_.  Returns
// their number.
template <class Words>
inline int SweptProjection::gather(int column, Words words) {
    const double least = small_[column];
    int n = 0;
    for (int w = 0; w < words; ++w)
        each_bit(rows_in(column, words)[w] & open_rows_[w], w << 6, [&](int r) {
            double& place = row(r, words)[column];
            const double value = place;
            place = 0.0;
            unset(columns_in(r, words), column);
            if (!(std::abs(value) > least)) return;
            entries_[n] = value;
            touched_[n++] = r;
        });
    return n;
}

// Sorts n rows in touched_, and entries_, by the last column to come in each.
template <class Words>
inline void SweptProjection::sort(int n, Words words) {
    for (int i = 0; i < n; ++i) {
        const int r = touched_[i];
        const double entry = entries_[i];
        const Word* const own = columns_in(r, words);
        int last = -1;
        for (int w = words - 1; w >= 0 && last < 0; --w)
            if (const Word both = own[w] & coming_[w])
                last = (w << 6) + 63 - __builtin_clzll(both);
        int at = i;
        for (; at > 0 && last_[at - 1] > last; --at) {
            touched_[at] = touched_[at - 1];
            entries_[at] = entries_[at - 1];
            last_[at] = last_[at - 1];
        }
        touched_[at] = r;
        entries_[at] = entry;
        last_[at] = last;
    }
}

void SweptProjection::pivoted_qr(double floor) {
    reflections_[0] = reflection_start_[0] = right_start_[0] = steps_ = 0;
    // A regular evaluation needs less room than one before it may have needed.
    if (words_ > 1) resize(words_ / 2);
    for (std::size_t p = 0; p < first_sweep_.columns.size(); ++p) {
        double* const a = column(first_sweep_.columns[p]);
        for (int s = first_sweep_.start[p]; s < first_sweep_.start[p + 1]; ++s) {
            first_sweep_.values[s] = a[first_sweep_.coordinates[s]];
            a[first_sweep_.coordinates[s]] = 0.0;
        }
    }
    const Sweep* sweep = &first_sweep_;
    while (true) {
        double largest = 0.0;
        for (const int g : sweep->columns) largest = std::max(largest, squares_[g]);
        largest = std::sqrt(largest);
        double least = structural_rank < rows ? pivot_share_ * largest : 0.0;
        if (largest > floor * floor_margin) least = std::max(least, floor);
        const int before = steps_;
        taken_ = next_ = 0;
        window_.clear();
        // If all columns left are zero, so are the pivots.
        bool done = !(largest > 0.0);
        while (!done)
            done = words_ == 1 ? take_pivots(*sweep, least * least, One())
                               : take_pivots(*sweep, least * least, words_);
        if (steps_ == before || steps_ == structural_rank) break;
        keep_deferred();
        sweep = &later_sweep_;
    }
    for (int k = 0; k < structural_rank; ++k)
        pivots_[k] = k < steps_ ? std::abs(right_diagonal_[k]) : 0.0;
    empty_panel([](int, int, double) {});
}

// The next pivots of a sweep, of squares from `least` on: false if the panel has no longer as many
// words, true if these are all.
template <class Words>
bool SweptProjection::take_pivots(const Sweep& sweep, double least, Words words) {
    while (steps_ < structural_rank) {
        fill_window(sweep);
        if (words != words_) return false;
        if (window_.empty()) break;
        const int place = largest_in_window(), c = window_[place];
        if (left_[c] > 0.0 && left_[c] >= least) {
            window_.erase(window_.begin() + place);
            unset(coming_.data(), c);
            if (const int n = gather(c, words)) {
                unset(open_columns_.data(), c);
                eliminate(c, n, words);
            }
        } else {
            for (const int other : window_) unset(coming_.data(), other);
            window_.clear();
        }
    }
    return true;
}

// Moves what is left of the open columns, all of which are deferred, in the opposite order to the
// next sweep.
void SweptProjection::keep_deferred() {
    Sweep& later = later_sweep_;
    later = Sweep();
    for (int c = column_count_ - 1; c >= 0; --c) {
        if (!has(open_columns_.data(), c)) continue;
        const int g = column_at_[c];
        double squares = 0.0;
        for (int w = 0; w < words_; ++w)
            each_bit(rows_in(c, words_)[w] & open_rows_[w], w << 6, [&](int r) {
                const double value = row(r, words_)[c];
                if (!(std::abs(value) > small_[c])) return;
                later.coordinates.push_back(row_at_[r]);
                later.values.push_back(value);
                squares += value * value;
            });
        squares_[g] = squares;
        later.columns.push_back(g);
        later.start.push_back(static_cast<int>(later.values.size()));
    }
    find_reach(later);
    empty_panel([](int, int, double) {});
}

// Makes `column`, whose n entries gather() has found, the next pivot.
template <class Words>
inline void SweptProjection::eliminate(int column, int n, Words words) {
    const int k = steps_, done = reflections_[k];
    reflections_[k + 1] = done;
    int pivot = 0;
    if (n > 1) {
        // At most as many reflections as rows but one, each with the row of the pivot.
        if (static_cast<std::size_t>(done + n) > tau_.size()) {
            tau_.resize(2 * tau_.size() + n);
            reflection_start_.resize(tau_.size() + 1);
        }
        room(reflection_row_, reflection_start_[done], 2 * n);
        room(reflection_, reflection_start_[done], 2 * n);
        sort(n, words);
        int end = 1, top = 0;
        for (; end < n && last_[end] == last_[0]; ++end)
            if (std::abs(entries_[end]) > std::abs(entries_[top])) top = end;
        if (top > 0) {
            std::swap(touched_[0], touched_[top]);
            std::swap(entries_[0], entries_[top]);
        }
        while (true) {
            if (end - pivot > 1) reflect(pivot, end - pivot, words);
            if (end == n) break;
            // Of the rows before the next ones only that of the pivot is left.
            touched_[end - 1] = touched_[pivot];
            entries_[end - 1] = entries_[pivot];
            pivot = end - 1;
            const int last = last_[end];
            for (++end; end < n && last_[end] == last; ++end);
        }
    }
    right_diagonal_[k] = entries_[pivot];
    take_right(column, touched_[pivot], words);
}

// Reflects n rows in touched_, from place `first` on, so that of their entries_ only the first is
// not zero.
template <class Words>
inline void SweptProjection::reflect(int first, int n, Words words) {
    const int* const of = &touched_[first];
    double* const entries = &entries_[first];
    // By scalars: two numbers that have just been written are not yet there for a vector.
    const double alpha = entries[0], second = entries[1];
    double squares = alpha * alpha + second * second;
    for (int i = 2; i < n; ++i) squares += entries[i] * entries[i];
    const double beta = -std::copysign(std::sqrt(squares), alpha);
    const int l = reflections_[steps_ + 1]++, used = reflection_start_[l];
    reflection_start_[l + 1] = used + n;
    int* const rows_at = reflection_row_.data() + used;
    double* const v = reflection_.data() + used;
    for (int i = 0; i < n; ++i) rows_at[i] = row_at_[of[i]];
    if (n == 2) {
        // 1 / beta, without waiting for the root.
        const double by = beta * (1.0 / squares);
        v[0] = alpha * by;
        v[1] = second * by;
        reflect_pair(of[0], of[1], v[0], v[1], words);
    } else {
        tau_[l] = (beta - alpha) / beta;
        const double scale = 1.0 / (alpha - beta);
        v[0] = 1.0;
        for (int i = 1; i < n; ++i) v[i] = entries[i] * scale;
        reflect_rows(of, v, n, tau_[l]);
    }
    entries[0] = beta;
}

// Multiplies two rows, the first that of the pivot, by [p, q; q, -p], as most reflections do, where
// that changes more than negligible parts of columns.
template <class Words>
inline void SweptProjection::reflect_pair(int one, int two, double p, double q, Words words) {
    double *const a = row(one, words), *const b = row(two, words);
    const double* const least = small_.data();
    for (int w = 0; w < words; ++w) {
        const Word own = columns_in(two, words)[w], met = columns_in(one, words)[w] | own;
        Word changed = met;
        each_bit(met, w << 6, [&](int c) {
            const double x = a[c], y = b[c], first = p * x + q * y;
            // The second row changes less.
            if (std::abs(first - x) > least[c]) {
                a[c] = first;
                b[c] = q * x - p * y;
            } else {
                changed ^= Word{1} << (c & 63);
            }
        });
        // The row of the pivot, which closes, needs no column to know it.
        columns_in(one, words)[w] |= changed;
        columns_in(two, words)[w] |= changed;
        each_bit(changed & ~own, w << 6, [&](int c) { set(rows_in(c, words), two); });
    }
}

// Applies 1 - tau v v^T, v = (1, v[1], ...), |v[i]| <= 1, to n rows in the same way.
void SweptProjection::reflect_rows(const int* of, const double* v, int n, double tau) {
    for (int w = 0; w < words_; ++w) {
        Word met = 0;
        for (int i = 0; i < n; ++i) {
            met |= columns_in(of[i], words_)[w];
            at_[i] = row(of[i], words_) + 64 * w;
        }
        if (!met) continue;
        const Word changed = reflect_word(at_.data(), v, n, tau, small_.data() + 64 * w, met);
        for (int i = 0; i < n; ++i) {
            Word& own = columns_in(of[i], words_)[w];
            each_bit(changed & ~own, w << 6, [&](int c) { set(rows_in(c, words_), of[i]); });
            own |= changed;
        }
    }
}

// Moves the row of the pivot to R.
template <class Words>
inline void SweptProjection::take_right(int column, int pivot, Words words) {
    const int k = steps_++;
    order_[k] = column_at_[column];
    pivot_row_[k] = row_at_[pivot];
    double* const a = row(pivot, words);
    Word* const own = columns_in(pivot, words);
    int* const columns = room(right_column_, right_start_[k], words * 64);
    double* const values = room(right_, right_start_[k], words * 64);
    const double *const least = small_.data(), *const lost = lost_.data();
    double* const left = left_.data();
    const int* const at = column_at_.data();
    int used = 0;
    bool any_lost = false;
    for (int w = 0; w < words; ++w)
        each_bit(own[w], w << 6, [&](int c) {
            const double value = a[c];
            a[c] = 0.0;
            columns[used] = at[c];
            values[used] = value;
            used += std::abs(value) > least[c];
            left[c] -= value * value;
            any_lost |= left[c] <= lost[c];
        });
    right_start_[k + 1] = right_start_[k] + used;
    unset(open_rows_.data(), pivot);
    panel_row_[row_at_[pivot]] = -1;
    for (int w = 0; w < words; ++w) {
        if (any_lost)
            each_bit(own[w], w << 6, [&](int c) {
                if (left[c] <= lost[c]) sum(c);
            });
        own[w] = 0;
    }
}

inline void SweptProjection::apply_reflection(int l, double* x) const {
    const int start = reflection_start_[l], n = reflection_start_[l + 1] - start;
    const int* const at = reflection_row_.data() + start;
    const double* const v = reflection_.data() + start;
    if (n > 2) return reflected(tau_[l], v, at, n, x);
    double &a = x[at[0]], &b = x[at[1]];
    const double first = v[0] * a + v[1] * b;
    b = v[1] * a - v[0] * b;
    a = first;
}

void SweptProjection::times_q_transposed(double* x) const {
    for (int l = 0; l < reflections_[rank]; ++l) apply_reflection(l, x);
}

void SweptProjection::times_q(double* x) const {
    for (int l = reflections_[rank] - 1; l >= 0; --l) apply_reflection(l, x);
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
    for (int l = reflections_[k + 1] - 1; l >= 0; --l) apply_reflection(l, out);
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
