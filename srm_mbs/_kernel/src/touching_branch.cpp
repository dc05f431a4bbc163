#include "touching_branch.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "linear.hpp"

namespace srm {

TouchingBranch::TouchingBranch(System& system, const Constants& constants)
    : system_(system),
      constants_(constants),
      nv_(system.nv),
      nx_(system.nq + system.nv),
      along_(nv_),
      w_(nv_),
      bend_(nv_),
      step_(2 * nv_),
      none_(2 * nv_),
      point_(nx_) {}

// The place at x on the parabola, moved by `off` (nv,).
void TouchingBranch::place(const double* state, double x, const std::vector<double>& off,
                           double* out) {
    for (int i = 0; i < nv_; ++i) step_[i] = x * w_[i] + x * x * bend_[i] + off[i];
    std::fill(step_.begin() + nv_, step_.end(), 0.0);
    system_.retract(state, step_.data(), out);
}

bool TouchingBranch::prepare(double t, const double* state, const double* rate,
                             const std::vector<double>& w) {
    const int samples = constants_.touching_samples, each = constants_.touching_nodes;
    const double spacing = constants_.touching_spacing;
    const double size = system_.position_norm(w.data());
    for (int i = 0; i < nv_; ++i) {
        w_[i] = w[i] / size;
        along_[i] = w_[i] / (system_.unit(i) * system_.unit(i));
    }
    const double whole = dot(along_.data(), w_.data(), nv_);
    for (double& value : along_) value /= whole;
    const double *const v = rate, *const a = rate + nv_;
    const double speed = dot(along_.data(), v, nv_);
    if (!(std::abs(speed) > 0.0)) return false;
    const double part = dot(along_.data(), a, nv_) / speed;
    for (int i = 0; i < nv_; ++i) bend_[i] = 0.5 * (a[i] - v[i] * part) / (speed * speed);

    const int count = 2 * samples + 1;
    std::vector<double> off(nv_, 0.0), roots(count);
    const auto x = [&](int k) { return spacing * (k - samples); };
    for (int k = 0; k < count; ++k) {
        place(state, x(k), off, point_.data());
        system_.evaluate(t, point_.data(), System::ZoneView{});
        roots[k] = std::sqrt(system_.sigma());
    }
    const int lowest =
        static_cast<int>(std::min_element(roots.begin(), roots.end()) - roots.begin());
    // The ends of the part around the lowest sigma where it is below that of the first nodes.
    const double least = std::sqrt(constants_.touching_sigma);
    double ends[2];
    for (int i = 0; i < 2; ++i) {
        const int side = i ? 1 : -1, last = i ? count - 1 : 0;
        int k = lowest;
        while (k != last && !(roots[k + side] > least)) k += side;
        if (k == last) return false;
        const double part = (least - roots[k]) / (roots[k + side] - roots[k]);
        ends[i] = x(k) + side * part * spacing;
    }
    const double centre = 0.5 * (ends[0] + ends[1]);
    const double reach = std::max(constants_.touching, 0.5 * (ends[1] - ends[0]));
    if (reach > constants_.touching_farthest) return false;
    nodes_.resize(2 * each * nx_);
    for (int side = 0; side < 2; ++side) {
        std::fill(off.begin(), off.end(), 0.0);
        for (int k = 0; k < each; ++k) {
            const double distance = (side ? 1.0 : -1.0) * (reach + k * spacing);
            if (!close(t, state, centre + distance, off,
                       &nodes_[(2 * k + side) * nx_]))
                return false;
        }
    }
    return true;
}

// The node at x, from the place moved by `off`, which becomes its own; whether Newton's method
// found it.
bool TouchingBranch::close(double t, const double* state, double x, std::vector<double>& off,
                           double* node) {
    double last = std::numeric_limits<double>::infinity();
    std::vector<double> closing(2 * nv_);
    for (int iteration = 0; iteration < constants_.node_iterations; ++iteration) {
        place(state, x, off, node);
        system_.evaluate(t, node, System::ZoneView{});
        if (system_.rank_deficient() || !(system_.sigma() > constants_.touching_least))
            return false;
        system_.correction(closing.data());
        for (int i = 0; i < nv_; ++i) off[i] -= closing[i];
        const double change = system_.position_norm(closing.data());
        if (iteration == 0 && change > constants_.node_closing * constants_.touching_spacing)
            return false;
        if (change < constants_.touching_accuracy) {
            place(state, x, off, node);
            return true;
        }
        if (iteration > 1 && !(change < last)) return false;
        last = change;
    }
    return false;
}

// The motions to the nodes, and their places.
void TouchingBranch::see(const double* state, std::vector<double>& places) {
    const int count = static_cast<int>(nodes_.size()) / nx_;
    motions_.resize(static_cast<std::size_t>(count) * nv_);
    places.resize(count);
    for (int k = 0; k < count; ++k) {
        system_.difference(state, &nodes_[k * nx_], none_.data(), step_.data());
        std::copy_n(step_.begin(), nv_, &motions_[k * nv_]);
        places[k] = dot(&motions_[k * nv_], along_.data(), nv_);
    }
}

// Weights at 0 of the polynomial through the first `count` places, and of its derivatives.
void TouchingBranch::weigh(const std::vector<double>& places, int count) {
    value_.assign(count, 1.0);
    first_.resize(count);
    second_.resize(count);
    double sum = 0.0, squares = 0.0;
    for (int k = 0; k < count; ++k) {
        sum += 1.0 / places[k];
        squares += 1.0 / (places[k] * places[k]);
        for (int j = 0; j < count; ++j)
            if (j != k) value_[k] *= -places[j] / (places[k] - places[j]);
    }
    for (int k = 0; k < count; ++k) {
        const double inverse = 1.0 / places[k], slope = inverse - sum;
        first_[k] = value_[k] * slope;
        second_[k] = value_[k] * (slope * slope + inverse * inverse - squares);
    }
}

bool TouchingBranch::solve(double t, const double* from, StageOnBranch& stage) {
    std::vector<double> places, delta(2 * nv_, 0.0), tangent(nv_, 0.0), bend(nv_, 0.0);
    see(from, places);
    const int count = static_cast<int>(places.size());
    weigh(places, count);
    for (int k = 0; k < count; ++k) add(value_[k], &motions_[k * nv_], delta.data(), nv_);
    std::vector<double>& on = stage.state;
    system_.retract(from, delta.data(), on.data());
    // In the chart at a point of the branch, derivatives are those of the motion.
    see(on.data(), places);
    weigh(places, count);
    for (int k = 0; k < count; ++k) {
        add(first_[k], &motions_[k * nv_], tangent.data(), nv_);
        add(second_[k], &motions_[k * nv_], bend.data(), nv_);
    }
    weigh(places, count - 2);
    std::vector<double> coarse(nv_, 0.0), momentum(nv_), free(nv_);
    for (int k = 0; k + 2 < count; ++k) add(value_[k], &motions_[k * nv_], coarse.data(), nv_);
    if (system_.position_norm(coarse.data()) > constants_.touching_misfit) return false;
    system_.evaluate(t, on.data(), System::ZoneView{});
    if (system_.closure_residual() > constants_.touching_residual) return false;
    system_.mass_times(tangent.data(), momentum.data());
    const double inertia = dot(momentum.data(), tangent.data(), nv_);
    const double* const v = from + nx_ - nv_;
    const double s = dot(momentum.data(), v, nv_) / inertia;
    for (int i = 0; i < nv_; ++i) {
        on[nx_ - nv_ + i] = s * tangent[i];
        bend[i] *= s * s;
        stage.moved[i] = -delta[i];
        stage.moved[nv_ + i] = v[i] - s * tangent[i];
    }
    system_.evaluate(t, on.data(), System::ZoneView{});
    system_.free_acceleration(free.data());
    double forward = 0.0;
    for (int i = 0; i < nv_; ++i) forward += momentum[i] * (free[i] - bend[i]) / inertia;
    const double length = constants_.touching / system_.position_norm(tangent.data());
    for (int i = 0; i < nv_; ++i) {
        const double acceleration = tangent[i] * forward + bend[i];
        stage.rate[i] = s * tangent[i];
        stage.rate[nv_ + i] = acceleration;
        stage.multiplier[i] = free[i] - acceleration;
        stage.away[i] = length * tangent[i];
    }
    return true;
}

}  // namespace srm
