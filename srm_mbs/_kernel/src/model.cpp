#include "model.hpp"

#include <pinocchio/multibody.hpp>
// After Pinocchio, which sets up Boost's preprocessor for its variants.
#include <boost/python/extract.hpp>

namespace srm {

const void* model_in(PyObject* object) {
    boost::python::extract<const pinocchio::Model&> found(object);
    return found.check() ? &found() : nullptr;
}

}  // namespace srm
