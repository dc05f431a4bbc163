// Structs whose fields are filled in from Python.  A field is written once, in a list:
//
//     #define SRM_POINT_FIELDS(field) \
//         field(double, x)            \
//         field(double, y)
//
//     struct Point {
//         SRM_FIELDS(SRM_POINT_FIELDS)
//     };
//
// SRM_FIELDS declares the members, with zero or empty values, and each_field, which calls
// visit("x", &Point::x) and visit("y", &Point::y); struct_binding.hpp makes a Python class from it.
#pragma once

#include <cmath>
#include <stdexcept>
#include <string>
#include <vector>

#define SRM_DECLARE_FIELD(type, name) type name{};
#define SRM_VISIT_FIELD(type, name) visit(#name, &Self::name);
#define SRM_FIELDS(fields)                      \
    fields(SRM_DECLARE_FIELD)                   \
    template <class Self, class Visitor>        \
    static void each_field(Visitor&& visit) {   \
        fields(SRM_VISIT_FIELD)                 \
    }

namespace srm {

// Refuses an array field that has not `expected` numbers.
inline void expect_size(const char* field, std::size_t found, std::size_t expected) {
    if (found != expected)
        throw std::invalid_argument(std::string(field) + " has " + std::to_string(found) +
                                    " numbers instead of " + std::to_string(expected));
}

// Refuses a number outside of [low, high].
inline void expect_within(const std::string& field, long number, long low, long high) {
    if (number < low || number > high)
        throw std::invalid_argument(field + " has " + std::to_string(number) + ", outside of " +
                                    std::to_string(low) + " to " + std::to_string(high));
}

inline void expect_within(const std::string& field, const std::vector<int>& numbers, long low,
                          long high) {
    for (const int number : numbers) expect_within(field, number, low, high);
}

inline void expect_finite(const std::string& field, const std::vector<double>& numbers) {
    for (const double number : numbers)
        if (!std::isfinite(number)) throw std::invalid_argument(field + " is not finite");
}

}  // namespace srm
