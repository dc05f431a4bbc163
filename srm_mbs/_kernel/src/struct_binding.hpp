// Python classes for the structs of struct_fields.hpp, and NumPy arrays.
#pragma once

#include <array>
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
inline nb::object owned_array(std::vector<double> values,
                              std::initializer_list<std::size_t> shape) {
    auto* kept = new std::vector<double>(std::move(values));
    nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<double>*>(p); });
    return nb::cast(
        nb::ndarray<nb::numpy, double>(kept->data(), shape.size(), shape.begin(), owner));
}

inline nb::object owned_array(std::vector<double> values) {
    const std::size_t size = values.size();
    return owned_array(std::move(values), {size});
}

inline std::vector<double> to_vector(const Array& array) {
    return std::vector<double>(array.data(), array.data() + array.size());
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
    static std::vector<double> read(nb::handle value) { return to_vector(nb::cast<Array>(value)); }
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
T from_keywords(const std::string& name, const nb::kwargs& given) {
    T out;
    std::size_t used = 0;
    T::template each_field<T>([&](const char* field, auto member) {
        using Value = std::remove_reference_t<decltype(out.*member)>;
        const std::string place = name + "." + field;
        if (!given.contains(field)) throw nb::type_error((place + " is not given").c_str());
        ++used;
        try {
            out.*member = FieldCaster<Value>::read(given[field]);
        } catch (const nb::cast_error&) {
            throw nb::value_error((place + " has another type or size").c_str());
        }
    });
    if (used < given.size()) {
        for (auto item : given) {
            const auto key = nb::cast<std::string>(item.first);
            bool known = false;
            T::template each_field<T>([&](const char* field, auto) { known |= key == field; });
            if (!known) throw nb::type_error((name + " has no field " + key).c_str());
        }
    }
    if constexpr (HasCheck<T>::value) {
        try {
            out.check();
        } catch (const std::invalid_argument& error) {
            throw nb::value_error((name + "." + error.what()).c_str());
        }
    }
    return out;
}

// The Python class of T: made by keywords, immutable.
template <class T>
nb::class_<T> bind_struct(nb::handle scope, const char* name) {
    nb::class_<T> cls(scope, name);
    cls.def("__init__", [name](T* self, const nb::kwargs& given) {
        new (self) T(from_keywords<T>(name, given));
    });
    T::template each_field<T>([&](const char* field, auto member) {
        cls.def_prop_ro(field, [member](const T& self) {
            return FieldCaster<std::decay_t<decltype(self.*member)>>::show(self.*member);
        });
    });
    return cls;
}

}  // namespace srm
