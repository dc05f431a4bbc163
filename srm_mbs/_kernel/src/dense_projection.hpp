// The projection of a mechanism with few loops: M = U^T U, L = U^T, in dense arrays.
//
// Q stays in its reflections: a stage multiplies by it once or twice, which costs less than
// forming it.
#pragma once

#include <memory>
#include <vector>

#include "projection.hpp"

namespace srm {

// With a size for `nv` that the compiler knows where that is small: its loops are then unrolled.
std::unique_ptr<Projection> make_dense_projection(int nv, int rows, int structural_rank,
                                                  double sigma_ref);

}  // namespace srm
