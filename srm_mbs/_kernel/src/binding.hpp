// What the files share that bind the classes of the kernel to Python.
#pragma once

#include <initializer_list>
#include <string>
#include <vector>

#include <nanobind/nanobind.h>
// All of them in all of these files, so that a type is converted in the same way everywhere.
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "model.hpp"
#include "run.hpp"
#include "struct_binding.hpp"
#include "system.hpp"

namespace srm {

// The vector `array`, which has `size` numbers.
inline const double* vector_of(const Array& array, int size, const char* name) {
    if (array.ndim() != 1 || static_cast<int>(array.size()) != size)
        throw nb::value_error((std::string(name) + " has not the shape (" + std::to_string(size) +
                               ",)").c_str());
    return array.data();
}

// The `size` numbers of `array`.
inline std::vector<double> numbers(nb::handle array, int size, const char* name) {
    std::vector<double> out = to_vector(array);
    if (static_cast<int>(out.size()) != size)
        throw nb::value_error((std::string(name) + " has not " + std::to_string(size) +
                               " numbers").c_str());
    return out;
}

inline const void* pinocchio_model_in(nb::handle model) {
    const void* found = model_in(model.ptr());
    if (!found) throw nb::type_error("not a pinocchio.Model");
    return found;
}

// Type slots that show the garbage collector the objects that a T keeps alive: a controller may
// refer back to a solution.
template <typename T, nb::object T::*... kept>
int traverse(PyObject* self, visitproc visit, void* arg) {
    Py_VISIT(Py_TYPE(self));
    if (!nb::inst_ready(self)) return 0;
    T* object = nb::inst_ptr<T>(self);
    for (PyObject* held : {(object->*kept).ptr()...}) Py_VISIT(held);
    return 0;
}

template <typename T, nb::object T::*... kept>
int clear(PyObject* self) {
    if (!nb::inst_ready(self)) return 0;
    T* object = nb::inst_ptr<T>(self);
    ((object->*kept).reset(), ...);
    return 0;
}

template <typename T, nb::object T::*... kept>
PyType_Slot* collected() {
    static PyType_Slot slots[] = {
        {Py_tp_traverse, reinterpret_cast<void*>(traverse<T, kept...>)},
        {Py_tp_clear, reinterpret_cast<void*>(clear<T, kept...>)},
        {0, nullptr},
    };
    return slots;
}

// The System of a Python object of that class, which keeps it alive.
System& system_in(nb::handle object);

// The records of a run, and the shapes of their arrays.
struct PyRecords {
    StepRecords records;
    std::vector<double> end_rate;
    std::size_t nx, n, stages, corrected;  // stages: those of a step and its end
};

void bind_system(nb::module_& m);
void bind_branch_motion(nb::module_& m);
void bind_run(nb::module_& m);
void bind_dense_output(nb::module_& m);

}  // namespace srm
