#include "algebra.hpp"

#include <algorithm>
#include <memory>
#include <utility>
#include <vector>

#include "projection.hpp"
#include "struct_binding.hpp"

namespace srm {

namespace {

using Columns = nb::ndarray<const double, nb::f_contig, nb::device::cpu>;

// See dynamics/constraints/row_algebra.py.
class Algebra {
public:
    Algebra(std::vector<int> parents, std::vector<std::vector<int>> supports,
            std::vector<int> order, double pivot_share, int pivot_window,
            const std::string& choice)
        : pattern_{std::move(parents), std::move(supports), std::move(order), pivot_window,
                   pivot_share},
          nv_(static_cast<int>(pattern_.parents.size())),
          rows_(static_cast<int>(pattern_.supports.size())),
          projection_(make_projection(std::min(nv_, rows_), 1.0, pattern_, choice)),
          zeros_(std::max(nv_, rows_)) {}

    void factor(const Columns& M, const Array& G, double threshold) {
        if (M.ndim() != 2 || G.ndim() != 2 || static_cast<int>(M.shape(0)) != nv_ ||
            static_cast<int>(M.shape(1)) != nv_ || static_cast<int>(G.shape(0)) != rows_ ||
            static_cast<int>(G.shape(1)) != nv_)
            throw nb::value_error("M and G are not (nv, nv) and (rows, nv)");
        for (int j = 0; j < rows_; ++j) {
            double* const out = projection_->column(j);
            const double* const row = G.data() + static_cast<std::size_t>(j) * nv_;
            for (int k : pattern_.supports[j]) out[k] = row[k];
        }
        projection_->factor(M.data(), zeros_.data(), zeros_.data(), threshold);
    }

    nb::object tangential(const Array& w) const {
        std::vector<double> x = checked(w, nv_);
        projection_->whiten_velocity(x.data());
        projection_->remove_normal(x.data());
        projection_->unwhiten(x.data());
        return owned_array(std::move(x));
    }

    nb::object solve(const Array& g) const {
        const std::vector<double> right = checked(g, rows_);
        std::vector<double> x(nv_);
        projection_->normal(right.data(), x.data());
        projection_->unwhiten(x.data());
        return owned_array(std::move(x));
    }

    nb::object multiplier(const Array& white) const {
        const std::vector<double> x = checked(white, nv_);
        std::vector<double> g(rows_);
        projection_->multiplier(x.data(), g.data());
        return owned_array(std::move(g));
    }

    // The basis, one vector per row.
    nb::object complement() const {
        const auto count = static_cast<std::size_t>(nv_ - projection_->rank);
        const auto n = static_cast<std::size_t>(nv_);
        std::vector<double> out(count * n);
        projection_->complement(out.data());
        return owned_array(std::move(out), {count, n});
    }

    const Projection& projection() const { return *projection_; }

private:
    static std::vector<double> checked(const Array& values, int size) {
        if (values.ndim() != 1 || static_cast<int>(values.size()) != size)
            throw nb::value_error("not a vector of the right size");
        return std::vector<double>(values.data(), values.data() + size);
    }

    Pattern pattern_;
    int nv_, rows_;
    std::unique_ptr<Projection> projection_;
    std::vector<double> zeros_;
};

}  // namespace

void bind_algebra(nb::module_& m) {
    nb::class_<Algebra>(m, "Algebra")
        .def(nb::init<std::vector<int>, std::vector<std::vector<int>>, std::vector<int>, double,
                      int, const std::string&>(),
             nb::arg("parents"), nb::arg("supports"), nb::arg("order"), nb::arg("pivot_share"),
             nb::arg("pivot_window"), nb::arg("algebra"))
        .def("factor", &Algebra::factor, nb::arg("M"), nb::arg("G"), nb::arg("threshold"))
        .def("tangential", &Algebra::tangential)
        .def("solve", &Algebra::solve)
        .def("multiplier", &Algebra::multiplier)
        .def("complement", &Algebra::complement)
        .def_prop_ro("rank", [](const Algebra& a) { return a.projection().rank; })
        .def_prop_ro("sparse", [](const Algebra& a) { return a.projection().sparse(); })
        .def_prop_ro("entries", [](const Algebra& a) { return a.projection().entries(); })
        .def_prop_ro("pivots", [](const Algebra& a) {
            return owned_array(a.projection().pivots());
        })
        .def_prop_ro("row_squares", [](const Algebra& a) {
            return owned_array(a.projection().row_squares());
        });
}

}  // namespace srm
