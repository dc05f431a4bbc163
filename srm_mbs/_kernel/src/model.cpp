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

PyObject* lean_data(const void* model) {
    const auto data = std::make_shared<pinocchio::Data>();
    pinocchio_model::prepare(*data, *static_cast<const pinocchio::Model*>(model));
    return boost::python::incref(boost::python::object(data).ptr());
}

}  // namespace srm
