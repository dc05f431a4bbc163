#include "branch_motion.hpp"

#include "limits.hpp"
#include "linear.hpp"

namespace srm {

void BranchCurve::check() const {
    const std::size_t n = unit.size(), k = nodes.size();
    expect_size("along", along.size(), n);
    if (k < 2 || velocities.size() % k) throw std::invalid_argument("nodes do not fit velocities");
    const std::size_t nv = velocities.size() / k;
    if (n != nv && n != nv + 1) throw std::invalid_argument("unit does not fit velocities");
    expect_size("normal", normal.size(), k * nv * n);
    expect_size("quadratic", quadratic.size(), k * nv);
}

BranchMotion::BranchMotion(System& system, const ButcherTableau& scheme,
                           const Constants& constants, const ErrorNorm& norm)
    : system_(system), step_(system, scheme, constants, norm), delta_(2 * system.nv) {}

void BranchMotion::advance(double t, double t_new, const MultiplierHistory& known,
                           BranchPoint& point) {
    IntegratorState memory;
    memory.rate = point.rate;
    memory.state_scale.resize(2 * system_.nv);
    system_.state_scale(point.state.data(), memory.state_scale.data());
    memory.sigma = point.sigma;
    memory.history = known;
    // Known everywhere: every stage takes the interpolated multiplier.
    memory.history->known_until = infinity;
    memory.history->known_below = infinity;
    point.state = step_.make(t, t_new - t, point.state.data(), memory, 1.0).state;
}

void BranchMotion::correct(double t, double threshold, BranchPoint& point) {
    System::ZoneView zone;
    zone.threshold = threshold;
    system_.evaluate(t, point.state.data(), zone);
    system_.correction(delta_.data());
    for (double& value : delta_) value = -value;
    std::vector<double> moved(point.state.size());
    system_.retract(point.state.data(), delta_.data(), moved.data());
    point.state = std::move(moved);
}

bool BranchMotion::solve(double t, double direct, const BranchCurve* curve, BranchPoint& point) {
    system_.evaluate(t, point.state.data(), System::ZoneView{});
    point.sigma = system_.sigma();
    if (!(point.sigma >= direct)) {
        if (!curve) return false;
        BranchPoint moved = point;
        correct(t, 2.0 * direct, moved);
        if (!on_curve(t, *curve, moved)) return false;
        point = std::move(moved);
        return true;
    }
    // The rates again, where the corrected position is.
    for (int twice = 0; twice < 2; ++twice) correct(t, -1.0, point);
    system_.evaluate(t, point.state.data(), System::ZoneView{});
    system_.rate(point.rate.data());
    system_.multiplier(point.multiplier.data());
    point.sigma = system_.sigma();
    return true;
}

// [P, -E s'] (v, 1), in the model's coordinates.
void BranchMotion::normal_part(const double* normal, int n, const double* rates,
                               double* out) const {
    for (int i = 0; i < system_.nv; ++i) {
        out[i] = 0.0;
        for (int j = 0; j < n; ++j) out[i] += normal[i * n + j] * rates[j];
    }
}

bool BranchMotion::on_curve(double t, const BranchCurve& curve, BranchPoint& point) {
    const int nv = system_.nv, nq = system_.nq;
    const int n = static_cast<int>(curve.unit.size()), k = static_cast<int>(curve.nodes.size());
    if (curve.velocities.size() != static_cast<std::size_t>(k) * nv ||
        curve.q.size() != static_cast<std::size_t>(nq))
        return false;
    std::vector<double> start(point.state), near(nv, 0.0), rates(n), weights(k, 1.0);
    std::copy(curve.q.begin(), curve.q.end(), start.begin());
    system_.difference(start.data(), point.state.data(), near.data(), delta_.data());
    double place = 0.0;
    for (int i = 0; i < nv; ++i) place += curve.along[i] * delta_[i] / curve.unit[i];
    if (n > nv) place += curve.along[nv] * (t - curve.t) / curve.unit[nv];
    if (!(place >= curve.first && place <= curve.last)) return false;
    for (int i = 0; i < k; ++i)
        for (int j = 0; j < k; ++j)
            if (i != j)
                weights[i] *= (place - curve.nodes[j]) / (curve.nodes[i] - curve.nodes[j]);
    std::vector<double> normal(static_cast<std::size_t>(nv) * n, 0.0), off(nv), z(nv, 0.0);
    for (int i = 0; i < k; ++i)
        add(weights[i], &curve.normal[i * normal.size()], normal.data(), nv * n);
    double* v = point.state.data() + nq;
    const auto set_rates = [&] {
        for (int i = 0; i < nv; ++i) rates[i] = v[i] / curve.unit[i];
        if (n > nv) rates[nv] = 1.0 / curve.unit[nv];
    };
    set_rates();
    normal_part(normal.data(), n, rates.data(), off.data());
    for (int i = 0; i < nv; ++i) v[i] -= off[i] * curve.unit[i];
    set_rates();
    // E (Gdot v - s'') is quadratic in the velocity of the branch, which has one direction.
    for (int i = 0; i < k; ++i) {
        normal_part(&curve.normal[i * normal.size()], n, rates.data(), off.data());
        const double* known = &curve.velocities[i * nv];
        double product = 0.0, square = 0.0;
        for (int j = 0; j < nv; ++j) {
            product += (v[j] - off[j] * curve.unit[j]) * known[j];
            square += known[j] * known[j];
        }
        const double share = square > 0.0 ? product / square : 0.0;
        add(weights[i] * share * share, &curve.quadratic[i * nv], z.data(), nv);
    }
    System::ZoneView dropped;
    dropped.threshold = infinity;
    system_.evaluate(t, point.state.data(), dropped);
    system_.rate(point.rate.data());
    for (int i = 0; i < nv; ++i) rates[i] = point.rate[nv + i] / curve.unit[i];
    if (n > nv) rates[nv] = 0.0;
    normal_part(normal.data(), n, rates.data(), off.data());
    for (int i = 0; i < nv; ++i) {
        point.multiplier[i] = off[i] * curve.unit[i] + z[i];
        point.rate[nv + i] -= point.multiplier[i];
    }
    return true;
}

}  // namespace srm
