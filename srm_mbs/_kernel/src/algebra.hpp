// The projection of given M and G, for the analysis of a mechanism.
#pragma once

#include <nanobind/nanobind.h>

namespace srm {

void bind_algebra(nanobind::module_& m);

}  // namespace srm
