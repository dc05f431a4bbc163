#include "model.hpp"

#include <memory>

#include <pinocchio/multibody.hpp>
// After Pinocchio, which sets up Boost's preprocessor for its variants.
#include <boost/python/extract.hpp>
#include <boost/python/object.hpp>

#include "lean_data.hpp"

namespace srm {

const void* model_in(PyObject* object) {
    boost::python::extract<const pinocchio::Model&> found(object);
    return found.check() ? &found() : nullptr;
}

void tree_numbers(const void* from, std::vector<double>& placements, std::vector<double>& bodies) {
    const auto& model = *static_cast<const pinocchio::Model*>(from);
    for (int joint = 0; joint < model.njoints; ++joint) {
        const auto& place = model.jointPlacements[joint];
        const auto& body = model.inertias[joint];
        const pinocchio::Inertia::Matrix3 moments = body.inertia().matrix();
        bodies.push_back(body.mass());
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) placements.push_back(place.rotation()(i, j));
            bodies.push_back(body.lever()[i]);
        }
        for (int i = 0; i < 3; ++i) {
            placements.push_back(place.translation()[i]);
            for (int j = i; j < 3; ++j) bodies.push_back(moments(i, j));
        }
    }
}

PyObject* lean_data(const void* model) {
    const auto data = std::make_shared<pinocchio::Data>();
    pinocchio_model::prepare(*data, *static_cast<const pinocchio::Model*>(model), true);
    return boost::python::incref(boost::python::object(data).ptr());
}

}  // namespace srm
