#include "dense.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "limits.hpp"
#include "linear.hpp"

namespace srm {

void Extension::check() const {
    const std::size_t width = static_cast<std::size_t>(n_rates);
    if (n_rates < 1) throw std::invalid_argument("n_rates is not positive");
    expect_size("rows", rows.size(), rows.size() / width * width);
    expect_size("extra_A", extra_A.size(), extra_c.size() * width);
}

void DenseConstants::check() const {
    expect_size("nodes", nodes.size(), 3);
    expect_within("nodes", nodes, 2, most_nodes);
    if (!std::is_sorted(nodes.begin(), nodes.end()))
        throw std::invalid_argument("nodes do not ascend");
}

DenseOutput::DenseOutput(int nq, int nv, const std::vector<SchemeDense>& schemes,
                         DenseConstants constants, StepArrays steps)
    : constants_(std::move(constants)),
      steps_(std::move(steps)),
      n_(2 * nv),
      nx_(nq + nv),
      places_(steps_.count, Place::unknown),
      delta_(n_),
      x_(std::max(nx_, n_)),
      near_(nv) {
    if (steps_.count < 1) throw std::invalid_argument("there are no steps");
    if (schemes.empty()) throw std::invalid_argument("there are no schemes");
    for (const auto& [abscissae, extension] : schemes) {
        if (abscissae.empty()) throw std::invalid_argument("there are no abscissae");
        if (abscissae.size() != schemes[0].abscissae.size())
            throw std::invalid_argument("the schemes have other numbers of stages");
        // Every step has its rates, or as many as the extra stages complete.
        const int count = extension.n_rates, own = count - extension.extra_stages();
        if (steps_.width != own && steps_.width < count)
            throw std::invalid_argument("StepArrays.rates has another number of rates");
        std::vector<double> whole(count);
        extension.weights(1.0, whole.data());
        whole.resize(std::min(count, steps_.width));
        if (static_cast<int>(weights_.size()) < count) weights_.resize(count);
        schemes_.push_back({abscissae, extension, std::move(whole)});
    }
    if (steps_.width > static_cast<int>(weights_.size()))
        throw std::invalid_argument("StepArrays.rates has another number of rates");
    long before = 0;
    for (const long step : steps_.breaks) {
        expect_within("StepArrays.breaks", step, before + 1, steps_.count);
        before = step;
    }
}

long DenseOutput::step_at(double t) const {
    const double* times = steps_.times;
    const double slack = constants_.slack * std::max(std::abs(times[0]), std::abs(steps_.end));
    if (!(t >= times[0] - slack && t <= steps_.end + slack))
        throw std::out_of_range("outside the run");
    const long found = std::upper_bound(times, times + steps_.count + 1, t) - times - 1;
    return std::clamp(found, 0L, steps_.count - 1);
}

void DenseOutput::states(System& system, const double* t, long k, double* out) {
    const double* times = steps_.times;
    for (long i = 0; i < k; ++i, out += nx_) {
        const long step = step_at(t[i]);
        const double theta = (t[i] - times[step]) / (times[step + 1] - times[step]);
        if (theta == 0.0 || theta == 1.0) {
            std::copy_n(steps_.states + (step + (theta == 1.0)) * nx_, nx_, out);
            continue;
        }
        if (places_[step] == Place::unknown)
            places_[step] = close_to_singular(step) ? Place::near_singular : Place::regular;
        if (places_[step] == Place::regular) {
            extended(system, step, theta, out);
        } else {
            const Polynomial& best = best_polynomial(system, step);
            value(best, variable(step, theta, best.in_layer), delta_.data());
            system.retract(steps_.states + step * nx_, delta_.data(), out);
        }
    }
}

// First and last end of a step between the breakpoints around a step.
std::pair<long, long> DenseOutput::smooth_interval(long step) const {
    const auto& breaks = steps_.breaks;
    const auto next = std::upper_bound(breaks.begin(), breaks.end(), step);
    return {next == breaks.begin() ? 0 : *(next - 1), next == breaks.end() ? steps_.count : *next};
}

const double* DenseOutput::rate_at(long node, long last) const {
    if (node < last) return steps_.rates + node * steps_.width * n_;
    if (node == steps_.count) return steps_.end_rate;
    const auto& breaks = steps_.breaks;
    const auto at = std::lower_bound(breaks.begin(), breaks.end(), node);
    return steps_.break_rates + (at - breaks.begin()) * n_;
}

bool DenseOutput::close_to_singular(long step) const {
    const auto [first, last] = smooth_interval(step);
    if (last - first < 2) return false;  // without neighbours there is no polynomial
    if (steps_.in_zone[step]) return true;
    const std::vector<double>& abscissae = scheme_of(step).abscissae;
    return srm::close_to_singular(abscissae, steps_.sigmas + step * abscissae.size(),
                                  constants_.close, constants_.branch_below);
}

bool DenseOutput::has_stages(long step) const {
    const std::vector<double>& abscissae = schemes_[0].abscissae;
    return !steps_.in_zone[step] && !steps_.stiff[step] &&
           !srm::close_to_singular(abscissae, steps_.sigmas + step * abscissae.size(),
                                   constants_.close, constants_.branch_below);
}

bool close_to_singular(const std::vector<double>& abscissae, const double* sigmas, double close,
                       double branch_below) {
    const int width = static_cast<int>(abscissae.size());
    if (!finite(sigmas, width)) return false;
    double change = 0.0, lowest = sigmas[0];
    for (int j = 1; j < width; ++j) {
        if (abscissae[j] > 0.0)
            change = std::max(change, std::abs(sigmas[j] - sigmas[0]) / abscissae[j]);
        lowest = std::min(lowest, sigmas[j]);
    }
    return lowest < std::max(close * change, branch_below);
}

void Extension::weights(double theta, double* out) const {
    const int width = n_rates;
    std::fill(out, out + width, 0.0);
    for (int k = degree() - 1; k >= 0; --k) {
        const double factor = k % 2 ? 1.0 - theta : theta;
        const double* row = &rows[k * width];
        for (int i = 0; i < width; ++i) out[i] = factor * (out[i] + row[i]);
    }
}

const std::vector<double>& DenseOutput::extra_rates(System& system, long step, double h) {
    static const std::vector<double> none;
    const Extension& extension = scheme_of(step).extension;
    if (steps_.width >= extension.n_rates) return none;
    std::vector<double>& kept = extra_[step];
    if (!kept.empty()) return kept;
    std::vector<double> out;  // kept only once all of them could be evaluated
    const double* rates = steps_.rates + step * steps_.width * n_;
    rate_.resize(n_);
    system.begin_step(steps_.times[step], steps_.states + step * nx_);
    out.assign(static_cast<std::size_t>(extension.extra_stages()) * n_, 0.0);
    for (int i = 0; i < extension.extra_stages(); ++i) {
        const double* a = &extension.extra_A[i * extension.n_rates];
        std::fill(delta_.begin(), delta_.end(), 0.0);
        for (int k = 0; k < steps_.width + i; ++k) {
            if (a[k] == 0.0) continue;
            const double* from =
                k < steps_.width ? rates + k * n_ : &out[(k - steps_.width) * n_];
            add(h * a[k], from, delta_.data(), n_);
        }
        system.retract(steps_.states + step * nx_, delta_.data(), x_.data());
        system.evaluate(steps_.times[step] + extension.extra_c[i] * h, x_.data(),
                         System::ZoneView{});
        system.rate(rate_.data());
        system.chart_rate(delta_.data(), rate_.data(), &out[i * n_]);
    }
    system.end_step();
    kept = std::move(out);
    return kept;
}

void DenseOutput::extended(System& system, long step, double theta, double* out) {
    const double h = steps_.times[step + 1] - steps_.times[step];
    const std::vector<double>& more = extra_rates(system, step, h);
    const double* rates = steps_.rates + step * steps_.width * n_;
    const Extension& extension = scheme_of(step).extension;
    extension.weights(theta, weights_.data());
    std::fill(delta_.begin(), delta_.end(), 0.0);
    for (int k = 0; k < extension.n_rates; ++k)
        add(h * weights_[k],
            k < steps_.width ? rates + k * n_ : &more[(k - steps_.width) * n_], delta_.data(), n_);
    system.retract(steps_.states + step * nx_, delta_.data(), out);
    if (!steps_.corrected) return;
    // The correction at the step end, as a smooth ramp.
    const double* correction = steps_.corrections + step * n_;
    const double s = theta * theta * (3.0 - 2.0 * theta), r = theta * theta * (theta - 1.0);
    const int nv = n_ / 2;
    for (int i = 0; i < nv; ++i) {
        delta_[i] = -s * correction[i] - h * r * correction[nv + i];
        delta_[nv + i] = -s * correction[nv + i];
    }
    system.retract(out, delta_.data(), out);
}

// Up to `count` ends of steps around the step, none too close together, with `least_sigma` at least,
// and no more than `reach` steps away.
DenseOutput::Nodes DenseOutput::nodes(const System* charts, long step, int count,
                                      double least_sigma, long reach) const {
    const double *times = steps_.times, *start = steps_.states + step * nx_;
    const double near = constants_.spacing * (times[step + 1] - times[step]);
    const long width = static_cast<long>(scheme_of(step).abscissae.size());
    // Rates jump at breakpoints: a polynomial has no nodes beyond.
    auto [first, last] = smooth_interval(step);
    long i = step, j = step + 1;
    if (reach < i - first) first = i - reach;
    if (reach < last - j) last = j + reach;
    long before[most_nodes], after[most_nodes];
    int left_count = 0, right_count = 0;
    while (left_count + right_count < count && (i >= first || j <= last)) {
        const bool left = i >= first && (j > last || left_count <= right_count);
        const long node = left ? i-- : j++;
        long* const own = left ? before : after;
        int& found = left ? left_count : right_count;
        if (found && std::abs(times[own[found - 1]] - times[node]) < near) continue;
        if (charts && !charts->reachable(start, steps_.states + node * nx_)) {
            if (left) first = node + 1;
            else last = node - 1;
        } else if (least_sigma <= 0.0 ||
                   steps_.sigmas[node < steps_.count ? node * width : steps_.count * width - 1] >=
                       least_sigma) {
            own[found++] = node;
        }
    }
    Nodes out;
    for (int k = left_count; k-- > 0;) out.at[out.count++] = before[k];
    for (int k = 0; k < right_count; ++k) out.at[out.count++] = after[k];
    return out;
}

// As nodes(), without ends whose rates may carry rounding; all if few others are near, or none on
// one side of the step: polynomials are no extrapolations.
DenseOutput::Nodes DenseOutput::nodes_away(const System* charts, long step, int count) const {
    const Nodes away =
        nodes(charts, step, count, constants_.branch_below, constants_.away_reach);
    const bool within = away.count >= constants_.least_away && away.at[0] <= step &&
                        away.at[away.count - 1] > step;
    return within ? away : nodes(charts, step, count);
}

// Motion of the positions from the step to a node, whole turns included: the sum of the motions of
// the steps between, each in its own chart.
void DenseOutput::motion(long step, long node, double* out) const {
    const int nv = n_ / 2;
    std::fill(out, out + nv, 0.0);
    const double sign = node > step ? 1.0 : -1.0;
    for (long k = std::min(step, node); k < std::max(step, node); ++k) {
        const double h = sign * (steps_.times[k + 1] - steps_.times[k]);
        const double* rates = steps_.rates + k * steps_.width * n_;
        const std::vector<double>& whole = scheme_of(k).whole;
        const int count = static_cast<int>(whole.size());
        for (int j = 0; j < count; ++j) add(h * whole[j], rates + j * n_, out, nv);
    }
}

// The variable of polynomials at a fraction of the step, and its derivative by the time in steps.
double DenseOutput::variable(long step, double theta, bool in_layer, double* growth) const {
    if (growth) *growth = 1.0;
    if (!in_layer) return theta;
    const double centre = steps_.layers[2 * step], width = steps_.layers[2 * step + 1];
    const double h = steps_.times[step + 1] - steps_.times[step];
    const double beside = (steps_.times[step] - centre + theta * h) / width;
    if (growth) *growth = h / width / std::hypot(1.0, beside);
    return std::asinh(beside);
}

// The polynomials through `sets` of ends of steps, from divided differences of the states and rates
// there, in the chart of the step.  Those of the last set contain those of sets that are part of it.
void DenseOutput::hermite(System& system, long step, const Nodes* sets, int set_count,
                          bool in_layer, Polynomial* out) {
    const double *times = steps_.times, *start = steps_.states + step * nx_;
    const double h = times[step + 1] - times[step];
    const Nodes& nodes = sets[set_count - 1];
    const int k = 2 * nodes.count;
    points_.resize(k);
    differences_.resize(static_cast<std::size_t>(k) * n_);
    slopes_.resize(static_cast<std::size_t>(nodes.count) * n_);
    std::vector<double>& c = differences_;
    const long last = smooth_interval(step).second;
    for (int node = 0; node < nodes.count; ++node) {
        const long i = nodes.at[node];
        double growth;
        points_[2 * node] = points_[2 * node + 1] =
            variable(step, (times[i] - times[step]) / h, in_layer, &growth);
        double* const here = &c[2 * node * n_];
        double* const slope = &slopes_[node * n_];
        if (system.wraps()) motion(step, i, near_.data());
        system.difference(start, steps_.states + i * nx_, near_.data(), here);
        std::copy_n(here, n_, here + n_);
        system.chart_rate(here, rate_at(i, last), slope);
        for (int m = 0; m < n_; ++m) slope[m] *= h / growth;
    }
    int first[3];  // row of each set's first end; -1: the set is no part of the last one
    for (int set = 0; set < set_count; ++set) {
        const long *from = sets[set].at, *end = nodes.at + nodes.count;
        const long* const found = std::search(nodes.at, end, from, from + sets[set].count);
        first[set] = found == end ? -1 : 2 * static_cast<int>(found - nodes.at);
        if (found == end) continue;
        out[set].in_layer = in_layer;
        out[set].points.assign(&points_[first[set]], &points_[first[set]] + 2 * sets[set].count);
        out[set].coefficients.resize(static_cast<std::size_t>(2) * sets[set].count * n_);
    }
    // Row i has the difference over the points i - order to i.
    for (int order = 0; order < k; ++order) {
        for (int i = k - 1; i >= order && order > 0; --i) {
            const double span = points_[i] - points_[i - order];
            double* const here = &c[i * n_];
            if (span == 0.0) {
                std::copy_n(&slopes_[(i / 2) * n_], n_, here);
            } else {
                const double* const below = here - n_;
                const double by = 1.0 / span;
                for (int m = 0; m < n_; ++m) here[m] = (here[m] - below[m]) * by;
            }
        }
        for (int set = 0; set < set_count; ++set)
            if (first[set] >= 0 && order < 2 * sets[set].count)
                std::copy_n(&c[(first[set] + order) * n_], n_, &out[set].coefficients[order * n_]);
    }
    for (int set = 0; set < set_count; ++set)
        if (first[set] < 0) hermite(system, step, &sets[set], 1, in_layer, &out[set]);
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

// Of the polynomials of degree 7, 11 and 15, the middle one if it differs less from the last than
// the first from it; else the first.  Past a critical configuration those in the variable of the
// layer, if they are confirmed better.
const DenseOutput::Polynomial& DenseOutput::best_polynomial(System& system, long step) {
    Polynomial& out = polynomials_[step];
    if (!out.points.empty()) return out;
    const bool layer = steps_.layers && steps_.layers[2 * step + 1] > 0.0;
    double best = infinity;
    Nodes ends[3], away[3];
    bool same = true;
    for (int k = 0; k < 3; ++k) {
        ends[k] = nodes(&system, step, constants_.nodes[k]);
        away[k] = nodes_away(&system, step, constants_.nodes[k]);
        same = same && ends[k].count == away[k].count &&
               std::equal(ends[k].at, ends[k].at + ends[k].count, away[k].at);
    }
    for (const auto& [in_layer, chosen] :
         {std::pair(false, &ends), {false, &away}, {true, &ends}}) {
        if (in_layer ? !layer : chosen == &away && same) continue;
        hermite(system, step, *chosen, 3, in_layer, tried_);
        double changes[2] = {0.0, 0.0};
        for (const double theta : constants_.probes) {
            const double at = variable(step, theta, in_layer);
            value(tried_[0], at, x_.data());
            for (int k = 0; k < 2; ++k) {
                std::copy_n(x_.data(), n_, delta_.data());
                value(tried_[k + 1], at, x_.data());
                for (int i = 0; i < n_; ++i)
                    changes[k] = std::max(changes[k], std::abs(x_[i] - delta_[i]));
            }
        }
        const double change = std::min(changes[0], changes[1]);
        if (!(change < best) && !out.points.empty()) continue;
        best = change;
        std::swap(out, tried_[changes[1] <= changes[0] ? 1 : 0]);
    }
    return out;
}

}  // namespace srm
