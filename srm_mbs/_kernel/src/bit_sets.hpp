// Sets of small numbers as bits.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace srm {

using Word = std::uint64_t;

inline int words_for(int bits) { return (bits + 63) / 64; }

inline void set(Word* bits, int i) { bits[i >> 6] |= Word{1} << (i & 63); }
inline void unset(Word* bits, int i) { bits[i >> 6] &= ~(Word{1} << (i & 63)); }
inline bool has(const Word* bits, int i) { return bits[i >> 6] >> (i & 63) & 1; }

template <class Act>
void each_bit(Word word, int first, const Act& act) {
    for (; word; word &= word - 1) act(first + __builtin_ctzll(word));
}

// Sets of bits, each with the range of its words that may be nonzero.
class BitSets {
public:
    BitSets(int sets, int bits)
        : first(sets), last(sets), stride_(words_for(bits)), words_(sets * std::size_t(stride_)) {}

    // Empties the sets and changes their number and size, which may not exceed those at
    // construction.
    void clear(int sets, int bits) {
        stride_ = words_for(bits);
        std::fill_n(words_.begin(), sets * stride_, Word{0});
        std::fill_n(first.begin(), sets, static_cast<int>(stride_));
        std::fill_n(last.begin(), sets, -1);
    }

    void set(int which, int i) { add(which, Word{1} << (i & 63), i >> 6); }

    // The bits of word w.
    void add(int which, Word bits, int w) {
        words_[which * stride_ + w] |= bits;
        first[which] = std::min(first[which], w);
        last[which] = std::max(last[which], w);
    }

    void add(int which, const Word* bits, int from, int to) {
        Word* own = &words_[which * stride_];
        // Mostly there is one word, for which an unrolled loop would cost more than all else.
        own[from] |= bits[from];
        for (int w = from + 1; w <= to; ++w) own[w] |= bits[w];
        first[which] = std::min(first[which], from);
        last[which] = std::max(last[which], to);
    }

    void add_to(int which, Word* bits) const {
        const Word* own = &words_[which * stride_];
        const int from = first[which], to = last[which];
        if (from > to) return;
        bits[from] |= own[from];
        for (int w = from + 1; w <= to; ++w) bits[w] |= own[w];
    }

    const Word* words(int which) const { return &words_[which * stride_]; }

    std::vector<int> first, last;

private:
    std::ptrdiff_t stride_;
    std::vector<Word> words_;
};

}  // namespace srm
