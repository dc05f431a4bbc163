// Twin of srm_mbs/stepping/dense.py and hermite.py: the state at any time of a run.
#pragma once

#include <utility>
#include <vector>

#include "system.hpp"

namespace srm {

// The continuous extension of a scheme, in the nested form of srm_mbs/methods/butcher.py.
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
    int width = 0;  // rates per step
    bool corrected = false;
    const double *times, *states, *rates, *corrections, *sigmas, *end_rate;
    std::vector<char> in_zone;  // (count,)
    std::vector<long> breaks;   // numbers of the steps that end on breakpoints, from 1
    const double* break_rates = nullptr;  // tangent rates before them
};

class DenseOutput {
public:
    DenseOutput(System& system, Extension extension, std::vector<double> abscissae,
                HermiteConstants hermite, StepArrays steps);
    // States (k, nx) at the times t (k,).
    void states(const double* t, long k, double* out);

private:
    struct Polynomial {
        std::vector<double> points, coefficients;  // (k,), (k, n): Newton form
    };
    // First and last end of a step between the breakpoints around a step.
    std::pair<long, long> piece(long step) const;
    const double* rate_at(long node, long last) const;
    bool close_to_singular(long step) const;
    void weights(double theta, double* out) const;
    const std::vector<double>& extra(long step, double h);
    void regular(long step, double theta, double* out);
    const Polynomial& smooth(long step);
    std::vector<long> nodes(long step, int count) const;
    Polynomial through(long step, int count);
    void value(const Polynomial& polynomial, double theta, double* out) const;

    System& system_;
    Extension extension_;
    std::vector<double> abscissae_;
    HermiteConstants hermite_;
    StepArrays steps_;
    const int n_, nx_, nq_;
    std::vector<std::vector<double>> extra_;
    std::vector<Polynomial> smooth_;
    std::vector<char> near_;  // 0 unknown, 1 regular, 2 close to a singular configuration
    std::vector<double> delta_, x_, weights_;
};

}  // namespace srm
