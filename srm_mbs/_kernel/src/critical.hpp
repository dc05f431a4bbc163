// Critical configurations: dynamics/singularities/critical.py.
#pragma once

#include <optional>
#include <vector>

#include "constants.hpp"
#include "system.hpp"

namespace srm {

// Solves A x = b in place, A (n, n) by rows; whether it has no zero pivot.
bool solve(std::vector<double>& A, std::vector<double>& b);

// The closures over places (q, t) in row units and in the units of the n coordinates, of which time
// is the last one with drives: ClosureGeometry of constraints/geometry.py.
class UnitClosures {
public:
    UnitClosures(System& system, double time_unit);

    // g (rows,) and G (rows, n), by rows, at a place; velocities in x (nx,) do not matter.
    void evaluate(const std::vector<double>& x, double t);
    // x (+) delta, delta (n,) in units; the rates in x stay.
    void move(const double* delta, std::vector<double>& x, double& t);
    // The motion (n,) in units from one place to another.
    void difference(const std::vector<double>& from, double t_from, const std::vector<double>& to,
                    double t_to, double* out);
    double unit(int j) const { return j < nv ? system.unit(j) : time_unit; }

    System& system;
    const int nv, n, rows;
    const double time_unit;
    std::vector<double> g, G;

private:
    std::vector<double> move_, away_, none_;
};

struct CriticalConfiguration {
    std::vector<double> x;        // (nx,)
    double t;
    std::vector<int> rows;        // independent closures (rank,)
    std::vector<double> u;        // (rank,), of unit length
    std::vector<double> hessian;  // (n, n), of u . g
    double residual;
    bool passed = false;          // the straight motion leads past it
};

// The critical configuration within `reach` (units) of a place x (nx,) at t (s), of which velocities
// do not matter, to rounding and without its Hessian; none if there is none.
std::optional<CriticalConfiguration> critical_near(UnitClosures& closures, double t,
                                                   const std::vector<double>& x, double reach,
                                                   const Constants& constants);

// The critical configuration next to a motion at `zero` (s), from the state `begin` at t with the
// tangent rate `rate`; none if there is none.
std::optional<CriticalConfiguration> critical_of_passage(UnitClosures& closures, double t,
                                                         const double* begin, const double* rate,
                                                         double zero, const Constants& constants);

}  // namespace srm
