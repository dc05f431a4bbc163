// Pinocchio's objects from and for Python, through Boost.Python's registry.
#pragma once

#include <Python.h>

namespace srm {

// A pointer to the pinocchio::Model in `object`, which keeps it alive; null if it is none.
const void* model_in(PyObject* object);

// A new Python object, a pin.Data for the algorithms that lean_data.hpp names.
PyObject* lean_data(const void* model);

}  // namespace srm
