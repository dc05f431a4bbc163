// Terms of one mechanism from code that was generated for it: integration/generated.
#pragma once

#include <cstddef>
#include <memory>
#include <string>
#include <vector>

namespace srm {

// The algebra of one mechanism on factors of its own, which lie in `size` bytes: integration/generated.
// White vectors are in the order of its elimination.
struct GeneratedAlgebra {
    std::size_t size;
    // M (nv, nv), f (nv,), bias (rows,), G (rows, nv): L^-1 f (nv,), G M^-1 f + bias (rows,), |R_kk|
    // (rank,) and the squares of W's columns (rows,).  Not 0 where M is not positive definite.
    int (*factor)(void*, const double*, const double*, const double*, const double*, double*,
                  double*, double*, double*);
    const int* (*pivot_rows)(const void*);  // place (nv,) of each pivot in white vectors, then others
    // With the first `rank` pivots: Q R^-T Pi^T g, Pi R^-1 Q^T x, and Q x or Q^T x in place.
    void (*normal)(const void*, int rank, const double* g, double* white);
    void (*multiplier)(const void*, int rank, const double* white, double* g);
    void (*times_q)(const void*, int rank, int transposed, double* white);
    // L^-1 x, L^T x and L^-T x, in place.
    void (*whiten_force)(const void*, double*);
    void (*whiten_velocity)(const void*, double*);
    void (*unwhiten)(const void*, double*);
};

// Constant after construction, so that threads may share it.
class GeneratedTerms {
public:
    // Loads the library in `path`; the parameters are those of structure_of().  Throws
    // std::invalid_argument where it cannot be loaded or was generated for another structure.
    GeneratedTerms(const std::string& path, const std::vector<double>& parameters);
    // The same code with other parameters.
    GeneratedTerms(const GeneratedTerms& other, const std::vector<double>& parameters);

    // At q (nq,), v (nv,) and with the values of the laws over time (laws,): M (nv, nv), its upper
    // triangle column by column, nle (nv,), g and bias (rows,) and the entries of G by rows, as far
    // as they may differ from zero.  Adds the forces of elements but bushings, without and with laws
    // that stiff steps hold, to tau and lawful (nv,), which may be the same.  `values` (held,) are
    // the laws of elements between links, for which `applied` acts unless it is null, own (nv,)
    // those of coordinates, which then do not act.  Of the bodies of bushings B has the rotation,
    // column by column, the translation and the velocity (6,) in their axes, J (6, nv) the columns
    // of the world Jacobian.  False where two points coincide.
    bool evaluate(const double* q, const double* v, const double* laws, const double* applied,
                  double* M, double* nle, double* tau, double* lawful, double* values, double* own,
                  double* g, double* bias, double* const* G, double* const* B, double* J) const {
        return terms_(q, v, constants_.data(), laws, applied ? 1.0 : 0.0, applied, M, nle, tau,
                      lawful, values, own, g, bias, G, B, J) == 0;
    }
    // Of r = M a + nle + G^T lam - f with a (nv,), lam (rows,) and the laws `applied` (held,) held,
    // of c = G a + bias and of the laws: derivatives along the chart coordinates of q and along v,
    // and of r along the laws, as far as they may differ from zero: Dr (nv, 2 nv + held),
    // Dc (rows, 2 nv) and Dl (held, 2 nv), column by column; Dq and Dv (nv,) of the laws of
    // coordinates.  turns (5 per bushing): phi, c and its derivative, of integration/generated.
    void linearise(const double* q, const double* v, const double* laws, const double* a,
                   const double* lam, const double* applied, const double* turns, double* Dr,
                   double* Dc, double* Dl, double* Dq, double* Dv) const {
        linearise_(q, v, linear_constants_.data(), laws, a, lam, applied, turns, Dr, Dc, Dl, Dq,
                   Dv);
    }
    // Whether that was generated.
    bool linearises() const { return linearise_ != nullptr; }
    int held() const;
    // Null where none was generated.
    const GeneratedAlgebra* algebra() const { return algebra_.factor ? &algebra_ : nullptr; }
    // Throws std::invalid_argument for a system of other sizes.
    void check(int nq, int nv, int rows, int rank, int laws, int bodies) const;

private:
    using Terms = int(const double*, const double*, const double*, const double*, double,
                      const double*, double*, double*, double*, double*, double*, double*, double*,
                      double*, double* const*, double* const*, double*);
    using Linearise = void(const double*, const double*, const double*, const double*,
                           const double*, const double*, const double*, const double*, double*,
                           double*, double*, double*, double*);
    using Constants = void(const double*, double*);
    void set_parameters(const std::vector<double>& parameters);

    std::shared_ptr<void> library_;
    Terms* terms_;
    Linearise* linearise_;
    Constants *set_constants_, *set_linear_constants_;
    GeneratedAlgebra algebra_{};
    const int* sizes_;
    std::vector<double> constants_, linear_constants_;
};

}  // namespace srm
