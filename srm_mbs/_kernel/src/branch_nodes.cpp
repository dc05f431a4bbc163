#include "branch_nodes.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "errors.hpp"
#include "limits.hpp"
#include "linear.hpp"

namespace srm {

namespace {

// Places of the nodes in spacings, and the weights of the polynomials through them, and through
// all but the outermost two, for the value and for the slope at 0.
constexpr std::array<int, 8> places = {-1, 1, -2, 2, -3, 3, -4, 4};
constexpr std::array<double, 8> value = {0.8,          0.8,          -0.4,        -0.4,
                                         4.0 / 35.0,   4.0 / 35.0,   -1.0 / 70.0, -1.0 / 70.0};
constexpr std::array<double, 8> coarse = {0.75, 0.75, -0.3, -0.3, 0.05, 0.05, 0.0, 0.0};
constexpr std::array<double, 8> slope = {-0.8,          0.8,          0.2,         -0.2,
                                         -4.0 / 105.0,  4.0 / 105.0,  1.0 / 280.0, -1.0 / 280.0};

}  // namespace

BranchNodes::BranchNodes(System& system, const Constants& constants, double singular)
    : system_(system),
      constants_(constants),
      singular_(singular),
      nv_(system.nv),
      nx_(system.nq + system.nv),
      nodes_(count * nx_),
      closings_(count * nv_),
      off_(count * nv_),
      multipliers_(count * nv_),
      point_(nx_),
      step_(2 * nv_),
      closing_(nv_),
      change_(2 * nv_) {
    state.resize(nx_);
    rate.resize(2 * nv_);
    multiplier.resize(nv_);
    moved.resize(2 * nv_);
    away.resize(nv_);
}

double BranchNodes::sigma_at(double t, const double* from, const double* direction,
                             double length) {
    for (int i = 0; i < nv_; ++i) step_[i] = length * direction[i];
    std::fill(step_.begin() + nv_, step_.end(), 0.0);
    system_.retract(from, step_.data(), point_.data());
    system_.evaluate(t, point_.data(), System::ZoneView{});
    return system_.sigma();
}

void BranchNodes::find_direction(double t, const double* from, std::vector<double>& out) {
    out.clear();
    system_.evaluate(t, from, System::ZoneView{});
    const double sigma = system_.sigma();
    if (system_.rank_deficient() || !(sigma > constants_.known_direction)) return;
    const int tangents = system_.branch_tangents(basis_);
    if (tangents == 0) return;
    std::vector<double> w(nv_), slopes(tangents, 1.0);
    for (int j = 0; j < tangents; ++j) {
        const double* f = &basis_[static_cast<std::size_t>(j) * nv_];
        if (tangents > 1) {
            const double length = constants_.direction_probe * sigma / system_.position_norm(f);
            slopes[j] = (sigma_at(t, from, f, length) - sigma_at(t, from, f, -length)) / length;
        }
        add(slopes[j], f, w.data(), nv_);
    }
    if (!(largest(w.data(), nv_) > 0.0)) return;
    if (!spaced(t, from, w, out))
        TouchingBranch::frame_at(system_, constants_, t, from, basis_.data(), slopes, out);
}

bool BranchNodes::spaced(double t, const double* from, std::vector<double>& w,
                         std::vector<double>& out) {
    out.clear();
    const double size = system_.position_norm(w.data());
    if (!(size > 0.0)) return false;
    for (double& x : w) x /= size;
    for (int doublings = 0; doublings <= constants_.node_doublings; ++doublings) {
        const double spacing = std::ldexp(constants_.node_spacing, doublings);
        if (!(std::min(sigma_at(t, from, w.data(), spacing),
                       sigma_at(t, from, w.data(), -spacing)) >= constants_.node_sigma))
            continue;
        out = w;
        for (double& x : out) x *= spacing;
        return true;
    }
    return false;
}

// Node k: the point of the branch that is nearest, in the mass metric, to the state moved along
// `direction`.
bool BranchNodes::follow(int k, double t, const double* from,
                         const std::vector<double>& direction) {
    double* const closing = &closings_[k * nv_];
    double* const node = &nodes_[k * nx_];
    std::fill(closing, closing + nv_, 0.0);
    const double* const v = from + nx_ - nv_;
    double last = infinity;
    for (int iteration = 0; iteration < constants_.node_iterations; ++iteration) {
        for (int i = 0; i < nv_; ++i) step_[i] = places[k] * direction[i] + closing[i];
        std::fill(step_.begin() + nv_, step_.end(), 0.0);
        system_.retract(from, step_.data(), node);
        system_.evaluate(t, node, System::ZoneView{});
        if (system_.rank_deficient() || !(system_.sigma() > 0.5 * constants_.node_sigma))
            return false;
        if (iteration == 0) {  // drives go with the node
            system_.driven_residuals(allowed_);
            for (std::size_t i = 0; i < allowed_.size(); ++i) allowed_[i] -= residuals_[i];
        }
        system_.closing(allowed_, closing_.data());
        system_.normal_part(closing, change_.data());
        for (int i = 0; i < nv_; ++i) {
            const double next = change_[i] - closing_[i];
            change_[i] = next - closing[i];
            closing[i] = next;
        }
        const double change = system_.position_norm(change_.data());
        if (iteration == 0 &&
            change > constants_.node_closing * system_.position_norm(direction.data()))
            return false;
        const bool settled = iteration > 1 && !(change < last);
        if (settled && !(change < constants_.node_rounding)) return false;
        last = change;
        if (settled || change < constants_.node_accuracy) {
            system_.correction(change_.data());
            std::copy(change_.begin() + nv_, change_.end(), &off_[k * nv_]);
            for (int i = 0; i < nv_; ++i) node[nx_ - nv_ + i] = v[i] - off_[k * nv_ + i];
            return true;
        }
    }
    return false;
}

// Whether the closures at the state between the nodes, evaluated last, are open by more than a branch
// may be: they avoid the singular configuration, and the nodes are on two curves.  sigma |E g| is
// the residual of the critical combination of rows, and not that of others.
bool BranchNodes::avoided() {
    if (!(system_.closure_residual() > singular_)) return false;
    system_.correction(change_.data());
    return system_.sigma() * system_.position_norm(change_.data()) > singular_;
}

bool BranchNodes::solve(double t, const double* from, const std::vector<double>& direction) {
    // The state itself was evaluated last.
    system_.driven_residuals(residuals_);
    for (int k = 0; k < count; ++k)
        if (!follow(k, t, from, direction)) return false;
    std::fill(moved.begin(), moved.end(), 0.0);
    away = direction;
    for (int k = 0; k < count; ++k) {
        add(-value[k], &closings_[k * nv_], moved.data(), nv_);
        add(value[k], &off_[k * nv_], moved.data() + nv_, nv_);
        add(slope[k], &closings_[k * nv_], away.data(), nv_);
    }
    for (int i = 0; i < 2 * nv_; ++i) step_[i] = -moved[i];
    system_.retract(from, step_.data(), state.data());
    system_.evaluate(t, state.data(), System::ZoneView{});
    if (avoided()) return false;
    std::copy(state.end() - nv_, state.end(), rate.begin());
    double* const acceleration = rate.data() + nv_;
    system_.free_acceleration(acceleration);
    // What closures leave of the forces of joined laws, F - M P M^-1 F, is smooth on the branch.
    const std::vector<double>* const joined = system_.joined_laws();
    laws = joined ? *joined : system_.law_values();
    if (joined) {
        by_laws_.resize(nv_);
        system_.acceleration_by(joined->data(), by_laws_.data());
    }
    std::fill(multiplier.begin(), multiplier.end(), 0.0);
    std::fill(change_.begin(), change_.end(), 0.0);
    double size = 0.0;
    for (int k = 0; k < count; ++k) {
        double* const own = &multipliers_[k * nv_];
        system_.evaluate(t, &nodes_[k * nx_], System::ZoneView{});
        system_.free_acceleration(closing_.data());
        size = std::max(size, system_.position_norm(closing_.data()));
        system_.multiplier_of(acceleration, own);
        add(value[k], own, multiplier.data(), nv_);
        add(value[k] - coarse[k], own, change_.data(), nv_);
        if (!joined) continue;
        system_.normal_part(by_laws_.data(), closing_.data());
        system_.mass_times(closing_.data(), step_.data());
        add(-value[k], step_.data(), laws.data(), nv_);
    }
    size += system_.position_norm(multiplier.data());
    if (!(system_.position_norm(change_.data()) <= constants_.node_misfit * size)) return false;
    for (int i = 0; i < nv_; ++i) acceleration[i] -= multiplier[i];
    return true;
}

}  // namespace srm
