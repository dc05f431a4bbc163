#include "dense.hpp"

#include <algorithm>
#include <cmath>

#include "linear.hpp"

namespace srm {

DenseOutput::DenseOutput(System& system, Extension extension, std::vector<double> abscissae,
                         HermiteConstants hermite, StepArrays steps)
    : system_(system),
      extension_(std::move(extension)),
      abscissae_(std::move(abscissae)),
      hermite_(std::move(hermite)),
      steps_(std::move(steps)),
      n_(2 * system.nv),
      nx_(system.nq + system.nv),
      nq_(system.nq),
      extra_(steps_.count),
      smooth_(steps_.count),
      near_(steps_.count, 0),
      delta_(n_),
      x_(nx_),
      weights_(extension_.n_rates) {}

void DenseOutput::states(const double* t, long k, double* out) {
    const double* times = steps_.times;
    const long count = steps_.count;
    for (long i = 0; i < k; ++i, out += nx_) {
        const long found = std::upper_bound(times, times + count + 1, t[i]) - times - 1;
        const long step = std::clamp(found, 0L, count - 1);
        const double theta = (t[i] - times[step]) / (times[step + 1] - times[step]);
        if (near_[step] == 0) near_[step] = close_to_singular(step) ? 2 : 1;
        if (near_[step] == 1) {
            regular(step, theta, out);
        } else {
            value(smooth(step), theta, delta_.data());
            system_.retract(steps_.states + step * nx_, delta_.data(), out);
        }
    }
}

std::pair<long, long> DenseOutput::piece(long step) const {
    const auto& breaks = steps_.breaks;
    const auto next = std::upper_bound(breaks.begin(), breaks.end(), step);
    return {next == breaks.begin() ? 0 : *(next - 1), next == breaks.end() ? steps_.count : *next};
}

const double* DenseOutput::rate_at(long node, long last) const {
    if (node < last) return steps_.rates + node * steps_.width * n_;
    if (node == steps_.count) return steps_.end_rate;
    const auto& breaks = steps_.breaks;
    return steps_.break_rates + (std::lower_bound(breaks.begin(), breaks.end(), node) - breaks.begin()) * n_;
}

bool DenseOutput::close_to_singular(long step) const {
    const auto [first, last] = piece(step);
    if (last - first < 2) return false;  // without neighbours there is no polynomial
    if (steps_.in_zone[step]) return true;
    const int width = static_cast<int>(abscissae_.size());
    const double* sigmas = steps_.sigmas + step * width;
    if (!finite(sigmas, width)) return false;
    double change = 0.0, lowest = sigmas[0];
    for (int j = 1; j < width; ++j) {
        change = std::max(change, std::abs(sigmas[j] - sigmas[0]) / abscissae_[j]);
        lowest = std::min(lowest, sigmas[j]);
    }
    return lowest < hermite_.close * change;
}

void DenseOutput::weights(double theta, double* out) const {
    const int width = extension_.n_rates;
    std::fill(out, out + width, 0.0);
    for (int k = extension_.degree - 1; k >= 0; --k) {
        const double factor = k % 2 ? 1.0 - theta : theta;
        const double* row = &extension_.rows[k * width];
        for (int i = 0; i < width; ++i) out[i] = factor * (out[i] + row[i]);
    }
}

const std::vector<double>& DenseOutput::extra(long step, double h) {
    std::vector<double>& out = extra_[step];
    if (!out.empty() || extension_.n_extra == 0) return out;
    const double* rates = steps_.rates + step * steps_.width * n_;
    std::vector<double> rate(n_);
    out.assign(static_cast<std::size_t>(extension_.n_extra) * n_, 0.0);
    for (int i = 0; i < extension_.n_extra; ++i) {
        const double* a = &extension_.extra_A[i * extension_.n_rates];
        std::fill(delta_.begin(), delta_.end(), 0.0);
        for (int k = 0; k < steps_.width + i; ++k) {
            if (a[k] == 0.0) continue;
            const double* from =
                k < steps_.width ? rates + k * n_ : &out[(k - steps_.width) * n_];
            add(h * a[k], from, delta_.data(), n_);
        }
        system_.retract(steps_.states + step * nx_, delta_.data(), x_.data());
        system_.evaluate(steps_.times[step] + extension_.extra_c[i] * h, x_.data(),
                         System::ZoneView{});
        system_.rate(rate.data());
        system_.chart_rate(delta_.data(), rate.data(), &out[i * n_]);
    }
    return out;
}

void DenseOutput::regular(long step, double theta, double* out) {
    const double h = steps_.times[step + 1] - steps_.times[step];
    const std::vector<double>& more = extra(step, h);
    const double* rates = steps_.rates + step * steps_.width * n_;
    weights(theta, weights_.data());
    std::fill(delta_.begin(), delta_.end(), 0.0);
    for (int k = 0; k < extension_.n_rates; ++k)
        add(h * weights_[k],
            k < steps_.width ? rates + k * n_ : &more[(k - steps_.width) * n_], delta_.data(), n_);
    system_.retract(steps_.states + step * nx_, delta_.data(), out);
    if (!steps_.corrected) return;
    // The correction at the step end, as a smooth ramp.
    const double* correction = steps_.corrections + step * n_;
    const double s = theta * theta * (3.0 - 2.0 * theta), r = theta * theta * (theta - 1.0);
    const int nv = n_ / 2;
    for (int i = 0; i < nv; ++i) {
        delta_[i] = -s * correction[i] - h * r * correction[nv + i];
        delta_[nv + i] = -s * correction[nv + i];
    }
    system_.retract(out, delta_.data(), out);
}

// Up to `count` ends of steps around the step, none too close together.
std::vector<long> DenseOutput::nodes(long step, int count) const {
    const double* times = steps_.times;
    const double near = hermite_.spacing * (times[step + 1] - times[step]);
    std::vector<long> before{step}, after{step + 1};
    long i = step - 1, j = step + 2;
    // Rates jump at breakpoints: a polynomial goes no further.
    const auto [first, last] = piece(step);
    while (static_cast<int>(before.size() + after.size()) < count && (i >= first || j <= last)) {
        if (i >= first && (j > last || before.size() <= after.size())) {
            if (times[before.back()] - times[i] >= near) before.push_back(i);
            --i;
        } else {
            if (times[j] - times[after.back()] >= near) after.push_back(j);
            ++j;
        }
    }
    before.insert(before.end(), after.begin(), after.end());
    std::sort(before.begin(), before.end());
    return before;
}

// Divided differences of the states and rates at ends of steps, in the chart of the step.
DenseOutput::Polynomial DenseOutput::through(long step, int count) {
    const double *times = steps_.times, *start = steps_.states + step * nx_;
    const double h = times[step + 1] - times[step];
    Polynomial out;
    std::vector<double> slopes, rate(n_);
    const long last = piece(step).second;
    for (long i : nodes(step, count)) {
        const double at = (times[i] - times[step]) / h;
        system_.difference(start, steps_.states + i * nx_, delta_.data());
        system_.chart_rate(delta_.data(), rate_at(i, last), rate.data());
        for (int twice = 0; twice < 2; ++twice) {
            out.points.push_back(at);
            out.coefficients.insert(out.coefficients.end(), delta_.begin(), delta_.end());
        }
        for (double& value : rate) value *= h;
        slopes.insert(slopes.end(), rate.begin(), rate.end());
    }
    const int k = static_cast<int>(out.points.size());
    std::vector<double>& c = out.coefficients;
    for (int order = 1; order < k; ++order) {
        for (int i = k - 1; i >= order; --i) {
            const double span = out.points[i] - out.points[i - order];
            double* here = &c[i * n_];
            if (span == 0.0) {
                std::copy_n(&slopes[(i / 2) * n_], n_, here);
            } else {
                const double* below = &c[(i - 1) * n_];
                for (int m = 0; m < n_; ++m) here[m] = (here[m] - below[m]) / span;
            }
        }
    }
    return out;
}

void DenseOutput::value(const Polynomial& polynomial, double theta, double* out) const {
    const int k = static_cast<int>(polynomial.points.size());
    std::copy_n(&polynomial.coefficients[(k - 1) * n_], n_, out);
    for (int i = k - 2; i >= 0; --i) {
        const double factor = theta - polynomial.points[i];
        const double* c = &polynomial.coefficients[i * n_];
        for (int m = 0; m < n_; ++m) out[m] = c[m] + factor * out[m];
    }
}

// Degree 11 where degree 15 confirms it better than it confirms degree 7.
const DenseOutput::Polynomial& DenseOutput::smooth(long step) {
    Polynomial& out = smooth_[step];
    if (!out.points.empty()) return out;
    std::vector<Polynomial> tried;
    for (int count : hermite_.nodes) tried.push_back(through(step, count));
    double changes[2] = {0.0, 0.0};
    std::vector<double> a(n_), b(n_);
    for (int k = 0; k < 2; ++k)
        for (double theta : hermite_.probes) {
            value(tried[k], theta, a.data());
            value(tried[k + 1], theta, b.data());
            for (int i = 0; i < n_; ++i) changes[k] = std::max(changes[k], std::abs(b[i] - a[i]));
        }
    out = tried[changes[1] <= changes[0] ? 1 : 0];
    return out;
}

}  // namespace srm
