// The projection of a mechanism with few loops: M = U^T U, L = U^T, in dense arrays.
//
// Q is kept as reflections: a stage multiplies by it once or twice, which costs less than forming
// it.
#pragma once

#include <memory>
#include <vector>

#include "projection.hpp"

namespace srm {

// For small nv the size is a template argument, so that the compiler unrolls the loops.
std::unique_ptr<Projection> make_dense_projection(int nv, int rows, int structural_rank,
                                                  double sigma_ref);

}  // namespace srm
