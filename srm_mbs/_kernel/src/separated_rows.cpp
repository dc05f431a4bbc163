#include "separated_rows.hpp"

#include <cmath>

#include "limits.hpp"

namespace srm {

void SeparatedRows::check() const {
    const std::size_t rows = supports.size();
    const long last = static_cast<long>(rows) - 1;
    expect_size("left", left.size(), rows);
    expect_size("factors", factors.size(), rows ? factors.size() / rows * rows : 0);
    const long width = rows ? static_cast<long>(factors.size() / rows) : 0;
    for (const std::vector<int>& support : supports)
        expect_within("supports", support, 0, width - 1);
    expect_size("share_others", share_others.size(), share_rows.size());
    expect_size("shares", shares.size(), share_rows.size());
    expect_within("share_rows", share_rows, 0, last);
    expect_within("share_others", share_others, 0, last);
    expect_within("active", active, 0, last);
    for (std::size_t j = 1; j < active.size(); ++j)
        expect_within("active", active[j], active[j - 1] + 1, last);
}

void SeparatedRows::write(System& system, double t, const double* q,
                          std::vector<double>& G) const {
    const std::size_t rows = supports.size(), n = factors.size() / rows;
    // Entries in which only another row may have a share are not written.
    for (const int row : share_rows)
        for (const int k : supports[row]) G[row * n + k] = 0.0;
    system.write_rows(t, q, G.data(), static_cast<int>(n));
    for (std::size_t row = 0; row < rows; ++row)
        for (const int k : supports[row]) G[row * n + k] *= factors[row * n + k];
    for (std::size_t s = 0; s < shares.size(); ++s) {
        double* const own = &G[share_rows[s] * n];
        const double* const other = &G[share_others[s] * n];
        for (const int k : supports[share_rows[s]]) own[k] -= shares[s] * other[k];
    }
    for (std::size_t row = 0; row < rows; ++row)
        for (const int k : supports[row]) G[row * n + k] /= left[row];
}

double SeparatedRows::smallest(System& system, Algebra& algebra, double t, const double* q,
                               std::vector<double>& G, std::vector<double>* left_vector) const {
    const std::size_t rows = supports.size(), n = factors.size() / rows;
    write(system, t, q, G);
    std::size_t next = 0;
    for (std::size_t row = 0; row < rows; ++row) {
        const bool used = next < active.size() && active[next] == static_cast<int>(row);
        double* const out = used ? algebra.row(static_cast<int>(next)) : nullptr;
        double squares = 0.0;
        for (const int k : supports[row]) {
            const double value = G[row * n + k];
            squares += value * value;
            if (used) out[k] = value;
        }
        // Active rows may vanish somewhere: they stay rows of the algebra.
        if (!used && std::sqrt(squares) > inert)
            return not_a_number;
        next += used;
    }
    return algebra.smallest_of_rows(left_vector);
}

}  // namespace srm
