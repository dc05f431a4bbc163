// Terms of one mechanism from code that was generated for it: integration/generated.
#pragma once

#include <memory>
#include <string>
#include <vector>

namespace srm {

// Constant after construction, so that threads may share it.
class GeneratedTerms {
public:
    // Loads the library in `path`; the parameters are those of structure_of().  Throws
    // std::invalid_argument where it cannot be loaded or was generated for another structure.
    GeneratedTerms(const std::string& path, const std::vector<double>& parameters);
    // The same code with other parameters.
    GeneratedTerms(const GeneratedTerms& other, const std::vector<double>& parameters);

    // At q (nq,), v (nv,) and with the values of the laws (laws,): M (nv, nv), its upper triangle
    // column by column, nle (nv,), g and bias (rows,) and the entries of G by rows, as far as they
    // may differ from zero.  Adds the forces of elements but bushings to tau (nv,).  Of the bodies
    // of bushings B has the rotation, column by column, the translation and the velocity (6,) in
    // their axes, J (6, nv) the columns of the world Jacobian.  False where two points coincide.
    bool evaluate(const double* q, const double* v, const double* laws, double* M, double* nle,
                  double* tau, double* g, double* bias, double* const* G, double* const* B,
                  double* J) const {
        return terms_(q, v, constants_.data(), laws, M, nle, tau, g, bias, G, B, J) == 0;
    }
    // The factorisation of a DenseProjection: M, f, bias; A_, U_, inverse_, white_force, gamma_, tau_,
    // inverse_pivots_, row_squares_, order_.  Not 0 where M is not positive definite.
    using Factor = int(const double*, const double*, const double*, double*, double*, double*,
                       double*, double*, double*, double*, double*, int*);
    // Null where none was generated.
    Factor* factor() const { return factor_; }
    // Throws std::invalid_argument for a system of other sizes.
    void check(int nq, int nv, int rows, int rank, int laws, int bodies) const;

private:
    using Terms = int(const double*, const double*, const double*, const double*, double*, double*,
                      double*, double*, double*, double* const*, double* const*, double*);
    using Constants = void(const double*, double*);
    void set_parameters(const std::vector<double>& parameters);

    std::shared_ptr<void> library_;
    Terms* terms_;
    Constants* set_constants_;
    Factor* factor_;
    const int* sizes_;
    std::vector<double> constants_;
};

}  // namespace srm
