// Python classes for the structs of struct_fields.hpp, and NumPy arrays.
#pragma once

#include <array>
#include <cstring>
#include <initializer_list>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

namespace srm {

namespace nb = nanobind;

using Array = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;

// A NumPy array that owns `values`.
template <class Number = double>
nb::object owned_array(std::vector<Number> values, std::initializer_list<std::size_t> shape) {
    auto* kept = new std::vector<Number>(std::move(values));
    nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<Number>*>(p); });
    return nb::cast(
        nb::ndarray<nb::numpy, Number>(kept->data(), shape.size(), shape.begin(), owner));
}

template <class Number = double>
nb::object owned_array(std::vector<Number> values) {
    const std::size_t size = values.size();
    return owned_array(std::move(values), {size});
}

inline std::vector<double> to_vector(const Array& array) {
    return std::vector<double>(array.data(), array.data() + array.size());
}

// The numbers of `array`, by the buffer protocol if they are doubles one after the other: a tenth
// of the cost of an Array.
inline std::vector<double> to_vector(nb::handle array) {
    Py_buffer buffer;
    if (PyObject_GetBuffer(array.ptr(), &buffer, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) == 0) {
        const bool doubles = buffer.format && std::strcmp(buffer.format, "d") == 0;
        std::vector<double> out;
        if (doubles) {
            const double* first = static_cast<const double*>(buffer.buf);
            out.assign(first, first + buffer.len / static_cast<Py_ssize_t>(sizeof(double)));
        }
        PyBuffer_Release(&buffer);
        if (doubles) return out;
    }
    PyErr_Clear();
    return to_vector(nb::cast<Array>(array));
}

// Reads a field from Python and shows it there: arrays of floats are NumPy arrays, of any shape
// when read and flat when shown, enumerators are their numbers.
template <class T>
struct FieldCaster {
    static T read(nb::handle value) {
        if constexpr (std::is_enum_v<T>)
            return static_cast<T>(nb::cast<int>(value));
        else
            return nb::cast<T>(value);
    }
    static nb::object show(const T& value) {
        if constexpr (std::is_enum_v<T>)
            return nb::cast(static_cast<int>(value));
        else
            return nb::cast(value);
    }
};

template <>
struct FieldCaster<std::vector<double>> {
    static std::vector<double> read(nb::handle value) { return to_vector(value); }
    static nb::object show(const std::vector<double>& value) { return owned_array(value); }
};

template <std::size_t size>
struct FieldCaster<std::array<double, size>> {
    static std::array<double, size> read(nb::handle value) {
        const Array array = nb::cast<Array>(value);
        if (array.size() != size) throw nb::cast_error();
        std::array<double, size> out;
        std::copy_n(array.data(), size, out.begin());
        return out;
    }
    static nb::object show(const std::array<double, size>& value) {
        return owned_array({value.begin(), value.end()});
    }
};

template <class T, class = void>
struct HasCheck : std::false_type {};
template <class T>
struct HasCheck<T, std::void_t<decltype(std::declval<const T&>().check())>> : std::true_type {};

// An object of T from keyword arguments: every field and no other name.  Raises TypeError for
// missing and unknown names, ValueError for values of another type or size.
template <class T>
T from_keywords(const char* name, const std::vector<PyObject*>& fields, const nb::kwargs& given) {
    T out;
    std::size_t used = 0;
    const auto place = [name](const char* field) { return std::string(name) + "." + field; };
    T::template each_field<T>([&](const char* field, auto member) {
        using Value = std::remove_reference_t<decltype(out.*member)>;
        const nb::handle value = PyDict_GetItemWithError(given.ptr(), fields[used]);
        if (!value) throw nb::type_error((place(field) + " is not given").c_str());
        ++used;
        try {
            out.*member = FieldCaster<Value>::read(value);
        } catch (const nb::cast_error&) {
            throw nb::value_error((place(field) + " has another type or size").c_str());
        }
    });
    if (used < given.size()) {
        for (auto item : given) {
            const auto key = nb::cast<std::string>(item.first);
            bool known = false;
            T::template each_field<T>([&](const char* field, auto) { known |= key == field; });
            if (!known) throw nb::type_error((std::string(name) + " has no field " + key).c_str());
        }
    }
    if constexpr (HasCheck<T>::value) {
        try {
            out.check();
        } catch (const std::invalid_argument& error) {
            throw nb::value_error((place(error.what())).c_str());
        }
    }
    return out;
}

// The Python class of T: made by keywords, immutable.
template <class T>
nb::class_<T> bind_struct(nb::handle scope, const char* name) {
    nb::class_<T> cls(scope, name);
    // The names, interned for ever: the lookup of a field compares pointers.
    std::vector<PyObject*> fields;
    T::template each_field<T>(
        [&](const char* field, auto) { fields.push_back(PyUnicode_InternFromString(field)); });
    cls.def("__init__", [name, fields](T* self, const nb::kwargs& given) {
        new (self) T(from_keywords<T>(name, fields, given));
    });
    T::template each_field<T>([&](const char* field, auto member) {
        cls.def_prop_ro(field, [member](const T& self) {
            return FieldCaster<std::decay_t<decltype(self.*member)>>::show(self.*member);
        });
    });
    return cls;
}

}  // namespace srm
