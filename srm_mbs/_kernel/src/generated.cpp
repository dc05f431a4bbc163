#include "generated.hpp"

#include <dlfcn.h>

#include <stdexcept>
#include <type_traits>

namespace srm {

namespace {

constexpr int interface_version = 3;  // ABI in integration/generated/source.py

// Places in srm_mbs_sizes.
enum Size {
    version,
    coordinates,
    rates,
    rows_of,
    rank_of,
    parameters_of,
    constants_of,
    laws_of,
    bodies_of,
    held_of,
    linear_constants_of
};

}  // namespace

GeneratedTerms::GeneratedTerms(const std::string& path, const std::vector<double>& parameters) {
    void* const handle = dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL);
    if (!handle) throw std::invalid_argument(dlerror());
    library_.reset(handle, dlclose);
    const auto find = [&](const char* name) {
        void* const found = dlsym(handle, name);
        if (!found) throw std::invalid_argument(path + " has no " + name);
        return found;
    };
    sizes_ = static_cast<const int*>(find("srm_mbs_sizes"));
    if (sizes_[version] != interface_version)
        throw std::invalid_argument(path + " has another interface");
    terms_ = reinterpret_cast<Terms*>(find("srm_mbs_terms"));
    set_constants_ = reinterpret_cast<Constants*>(find("srm_mbs_constants"));
    if (const void* size = dlsym(handle, "srm_mbs_factors_size")) {
        algebra_.size = *static_cast<const std::size_t*>(size);
        const auto take = [&](auto& function, const char* name) {
            function = reinterpret_cast<std::decay_t<decltype(function)>>(find(name));
        };
        take(algebra_.factor, "srm_mbs_factor");
        take(algebra_.pivot_rows, "srm_mbs_pivot_rows");
        take(algebra_.normal, "srm_mbs_normal");
        take(algebra_.multiplier, "srm_mbs_multiplier");
        take(algebra_.times_q, "srm_mbs_times_q");
        take(algebra_.whiten_force, "srm_mbs_whiten_force");
        take(algebra_.whiten_velocity, "srm_mbs_whiten_velocity");
        take(algebra_.unwhiten, "srm_mbs_unwhiten");
    }
    linearise_ = reinterpret_cast<Linearise*>(dlsym(handle, "srm_mbs_linearise"));
    set_linear_constants_ =
        linearise_ ? reinterpret_cast<Constants*>(find("srm_mbs_linear_constants")) : nullptr;
    set_parameters(parameters);
}

GeneratedTerms::GeneratedTerms(const GeneratedTerms& other, const std::vector<double>& parameters)
    : GeneratedTerms(other) {
    set_parameters(parameters);
}

void GeneratedTerms::set_parameters(const std::vector<double>& parameters) {
    if (static_cast<std::size_t>(sizes_[parameters_of]) != parameters.size())
        throw std::invalid_argument("the generated code has another number of parameters");
    constants_.resize(static_cast<std::size_t>(sizes_[constants_of]));
    set_constants_(parameters.data(), constants_.data());
    if (!linearise_) return;
    linear_constants_.resize(static_cast<std::size_t>(sizes_[linear_constants_of]));
    set_linear_constants_(parameters.data(), linear_constants_.data());
}

int GeneratedTerms::held() const { return sizes_[held_of]; }

void GeneratedTerms::check(int nq, int nv, int rows, int rank, int laws, int bodies) const {
    if (sizes_[coordinates] != nq || sizes_[rates] != nv || sizes_[rows_of] != rows ||
        sizes_[rank_of] != rank || sizes_[laws_of] != laws || sizes_[bodies_of] != bodies)
        throw std::invalid_argument("the code was generated for a system of another size");
}

}  // namespace srm
