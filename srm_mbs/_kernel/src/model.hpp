// The pin.Model behind a Python object, through Boost.Python's registry.
#pragma once

#include <Python.h>

namespace srm {

// A pointer to the pinocchio::Model in `object`, which keeps it alive; null if it is none.
const void* model_in(PyObject* object);

}  // namespace srm
