// Arrays of which an evaluation touches a few numbers in each page.
#pragma once

#include <cstddef>
#include <new>
#include <vector>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace srm {

// Allocates in pages of 2 MB where the system has them: of pages of 4 kB, a large sparse array in
// dense storage has more than a processor keeps translations of.
template <class Number>
struct LargePages {
    using value_type = Number;

    LargePages() = default;
    template <class Other>
    LargePages(const LargePages<Other>&) {}

    Number* allocate(std::size_t count) {
        std::size_t bytes = count * sizeof(Number);
        if (bytes < page) return static_cast<Number*>(::operator new(bytes));
        bytes = (bytes + page - 1) / page * page;
        void* const out = ::operator new(bytes, std::align_val_t{page});
#ifdef MADV_HUGEPAGE
        madvise(out, bytes, MADV_HUGEPAGE);  // advice: what it answers changes no result
#endif
        return static_cast<Number*>(out);
    }
    void deallocate(Number* memory, std::size_t count) {
        if (count * sizeof(Number) < page)
            ::operator delete(memory);
        else
            ::operator delete(memory, std::align_val_t{page});
    }

    friend bool operator==(const LargePages&, const LargePages&) { return true; }
    friend bool operator!=(const LargePages&, const LargePages&) { return false; }

private:
    static constexpr std::size_t page = std::size_t{1} << 21;
};

using LargeArray = std::vector<double, LargePages<double>>;

}  // namespace srm
