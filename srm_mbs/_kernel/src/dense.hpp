// Twin of srm_mbs/integration/dense_output.py and hermite.py: the state at any time of a run.
#pragma once

#include <utility>
#include <vector>

#include "system.hpp"

namespace srm {

// The continuous extension of a scheme, in the nested form of srm_mbs/integration/methods/butcher.py.
struct Extension {
    int degree = 0, n_rates = 0, n_extra = 0;
    std::vector<double> rows, extra_A, extra_c;
};

struct HermiteConstants {
    std::vector<int> nodes;
    double spacing, close;
    std::vector<double> probes;
};

// The accepted steps, as arrays that the caller keeps alive.
struct StepArrays {
    long count = 0;
    double end = 0.0, slack = 0.0;  // of the run, and what of it may be read beyond
    int width = 0;  // rates per step
    bool corrected = false;
    const double *times, *states, *rates, *corrections, *sigmas, *end_rate;
    std::vector<char> in_zone;  // (count,)
    std::vector<long> breaks;   // numbers of the steps that end on breakpoints, from 1
    const double* break_rates = nullptr;  // tangent rates before them
};

class DenseOutput {
public:
    DenseOutput(int nq, int nv, Extension extension, std::vector<double> abscissae,
                HermiteConstants hermite, StepArrays steps);
    // States (k, nx) at the times t (k,); `system` is any workspace of the mechanism.  Throws
    // std::out_of_range for times outside the run.
    void states(System& system, const double* t, long k, double* out);

private:
    struct Polynomial {
        std::vector<double> points, coefficients;  // (k,), (k, n): Newton form
    };
    // First and last end of a step between the breakpoints around a step.
    std::pair<long, long> piece(long step) const;
    const double* rate_at(long node, long last) const;
    bool close_to_singular(long step) const;
    void weights(double theta, double* out) const;
    const std::vector<double>& extra(System& system, long step, double h);
    void regular(System& system, long step, double theta, double* out);
    const Polynomial& smooth(System& system, long step);
    std::vector<long> nodes(const System& system, long step, int count) const;
    void moved(long step, long node, double* out) const;
    Polynomial through(System& system, long step, int count);
    void value(const Polynomial& polynomial, double theta, double* out) const;

    Extension extension_;
    std::vector<double> abscissae_;
    HermiteConstants hermite_;
    StepArrays steps_;
    const int n_, nx_;
    std::vector<std::vector<double>> extra_;
    std::vector<Polynomial> smooth_;
    std::vector<char> near_;  // 0 unknown, 1 regular, 2 close to a singular configuration
    std::vector<double> delta_, x_, weights_;
    std::vector<double> whole_;  // weights of the rates over a whole step,
    const int whole_count_;      // as far as the steps have them: those of extra stages are zero
};

}  // namespace srm
