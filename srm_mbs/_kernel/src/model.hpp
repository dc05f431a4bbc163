// Pinocchio's objects from and for Python, through Boost.Python's registry.
#pragma once

#include <vector>

#include <Python.h>

namespace srm {

// A pointer to the pinocchio::Model in `object`, which keeps it alive; null if it is none.
const void* model_in(PyObject* object);

// Of every joint, the universe's first: its placement in its parent (n, 12), rotation row by row, then
// translation; and its body (n, 10): mass, centre of mass, xx, xy, xz, yy, yz, zz about it.
void tree_numbers(const void* model, std::vector<double>& placements, std::vector<double>& bodies);

// A new Python object, a pin.Data for the algorithms that lean_data.hpp names.
PyObject* lean_data(const void* model);

}  // namespace srm
