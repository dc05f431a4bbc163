#include "passage.hpp"

#include <algorithm>
#include <cmath>
#include <complex>
#include <numeric>

#include "errors.hpp"
#include "linear.hpp"

namespace srm {

void Collocation::check() const {
    expect_size("weights", weights.size(), nodes.size());
    expect_size("integrals", integrals.size(), nodes.size() * nodes.size());
}

namespace {

using Vector = std::vector<double>;

// The motion has no passage along the curve.
struct NoPassage {};

// Extends orthonormal rows (count, n) by `more` others.
void extend(Vector& basis, int n, int more) {
    for (int k = 0; k < more; ++k) {
        const int count = static_cast<int>(basis.size()) / n;
        int next = 0;
        double most = -1.0;
        for (int j = 0; j < n; ++j) {
            double left = 1.0;
            for (int i = 0; i < count; ++i) left -= basis[i * n + j] * basis[i * n + j];
            if (left > most) {
                most = left;
                next = j;
            }
        }
        Vector e(n, 0.0);
        e[next] = 1.0;
        for (int pass = 0; pass < 2; ++pass)
            for (int i = 0; i < count; ++i)
                add(-dot(&basis[i * n], e.data(), n), &basis[i * n], e.data(), n);
        const double length = norm(e.data(), n);
        for (double& x : e) x /= length;
        basis.insert(basis.end(), e.begin(), e.end());
    }
}

// The curve of closed configurations beside a critical one: CurveThroughSaddle.
class SaddleCurve {
public:
    // `rates` (n,), in units: those of a motion that starts in a layer whose residual counts as zero.
    SaddleCurve(UnitClosures& closures, const MotionAlongCurve& motion, const Vector& x, double t,
                const Constants& constants, const Vector* rates = nullptr)
        : closures_(closures),
          critical_(motion.critical),
          n_(closures.n),
          rank_(static_cast<int>(critical_.rows.size())),
          exact_(motion.exact),
          largest_deviation_(constants.largest_deviation) {
        const CriticalConfiguration& critical = critical_;
        if (n_ - rank_ != 1) throw NoPassage{};
        strong_ = critical.u;
        extend(strong_, rank_, rank_ - 1);
        strong_.erase(strong_.begin(), strong_.begin() + rank_);
        closures_.evaluate(critical.x, critical.t);
        combine();
        // The plane of the displacements that keep the other combinations closed.
        Vector basis;
        for (int i = 0; i + 1 < rank_; ++i) {
            Vector row(&rows_[i * n_], &rows_[i * n_] + n_);
            const double whole = norm(row.data(), n_);
            for (int pass = 0; pass < 2; ++pass)
                for (int k = 0; k < i; ++k)
                    add(-dot(&basis[k * n_], row.data(), n_), &basis[k * n_], row.data(), n_);
            const double length = norm(row.data(), n_);
            if (!(length > constants.dependent_row * whole)) throw NoPassage{};
            for (double& value : row) value /= length;
            basis.insert(basis.end(), row.begin(), row.end());
        }
        extend(basis, n_, 2);
        const double* first = &basis[(rank_ - 1) * n_];
        const double* second = first + n_;
        const double a = form(first, first), c = form(second, second);
        const double b = 0.5 * (form(first, second) + form(second, first));
        const double middle = 0.5 * (a + c), radius = std::hypot(0.5 * (a - c), b);
        const double low = middle - radius, high = middle + radius;
        if (!(low < 0.0 && 0.0 < high &&
              std::min(-low, high) > constants.definite * std::max(-low, high)))
            throw NoPassage{};
        const double angle = 0.5 * std::atan2(2.0 * b, a - c);
        Vector of_low(n_, 0.0), of_high(n_, 0.0);
        add(std::cos(angle), first, of_high.data(), n_);
        add(std::sin(angle), second, of_high.data(), n_);
        add(-std::sin(angle), first, of_low.data(), n_);
        add(std::cos(angle), second, of_low.data(), n_);
        // delta > 0: the coordinate of the negative curvature keeps its sign.
        delta_ = critical.residual;
        const bool positive = delta_ > 0.0;
        kept_ = positive ? of_low : of_high;
        along = positive ? of_high : of_low;
        const double of_kept = positive ? -low : high, of_along = positive ? high : -low;
        level_ = exact_ ? 0.0 : 2.0 * std::abs(delta_) / of_kept;
        ratio_ = of_along / of_kept;
        width = std::sqrt(level_ / ratio_);
        layer = std::sqrt(2.0 * std::abs(delta_) / of_along);
        if (motion.begun) {
            beta = motion.beta;
            side = motion.side;
            return;
        }
        Vector away(n_), on(n_), slope(n_);
        closures_.difference(critical.x, critical.t, x, t, away.data());
        beta = dot(along.data(), away.data(), n_);
        const double beside = dot(kept_.data(), away.data(), n_);
        side = (exact_ ? beside * beta : beside) > 0.0 ? 1 : -1;
        const double distance = norm(away.data(), n_);
        double nearest = 0.0;
        if (rates) {
            // Along each hyperbola d kept / d beta has the sign of kept / beta, and at q* it is the
            // slope of a branch: the rates tell the branch, also where the place does not.
            const double ahead = dot(along.data(), rates->data(), n_);
            if (ahead == 0.0) throw NoPassage{};
            const double rise = dot(kept_.data(), rates->data(), n_) / ahead;
            side = rise > 0.0 ? 1 : -1;
            nearest = layer * std::sqrt(ratio_);  // of the hyperbola
            const bool straight = std::abs(std::abs(rise) / std::sqrt(ratio_) - 1.0) <
                                  constants.straight + nearest;
            if (distance < largest_deviation_ * nearest && !straight) throw NoPassage{};
        }
        hyperbola(beta, on, slope);
        add(-1.0, on.data(), away.data(), n_);
        if (!(norm(away.data(), n_) < largest_deviation_ * distance + nearest)) throw NoPassage{};
    }

    // The sign of the kept coordinate of a place, at beta; 0 if the hyperbola does not tell it.
    int side_of(const Vector& x, double t, double& at) {
        Vector away(n_);
        closures_.difference(critical_.x, critical_.t, x, t, away.data());
        at = dot(along.data(), away.data(), n_);
        const int sign = dot(kept_.data(), away.data(), n_) > 0.0 ? 1 : -1;
        const double kept = std::sqrt(level_ + ratio_ * at * at);
        add(-at, along.data(), away.data(), n_);
        add(-sign * kept, kept_.data(), away.data(), n_);
        return norm(away.data(), n_) < largest_deviation_ * kept ? sign : 0;
    }

    // The point of the hyperbola at `at`, as a displacement from q*, and its derivative.
    void hyperbola(double at, Vector& away, Vector& slope) const {
        double kept = std::sqrt(level_ + ratio_ * at * at);
        double rise = kept > 0.0 ? ratio_ * at / kept : std::sqrt(ratio_);
        const double sign = exact_ && at < 0.0 ? -side : side;
        kept *= sign;
        rise *= sign;
        for (int j = 0; j < n_; ++j) {
            away[j] = at * along[j] + kept * kept_[j];
            slope[j] = along[j] + rise * kept_[j];
        }
    }

    // Newton's step onto the configuration at `at`, from a place next to it, and the direction of
    // the curve, of which the part along beta is 1; solve_bend() then refers to that place.
    void linearise(const Vector& x, double t, double at, bool closed, Vector& step,
                   Vector& tangent) {
        closures_.evaluate(x, t);
        combine();
        const double target = exact_ && !closed ? delta_ : 0.0;
        step.assign(n_, 0.0);
        closures_.difference(critical_.x, critical_.t, x, t, step.data());
        const double off = dot(along.data(), step.data(), n_) - at;
        for (int i = 0; i < rank_; ++i) step[i] = -values_[i];
        step[rank_ - 1] += target;
        step[rank_] = -off;
        tangent.assign(n_, 0.0);
        tangent[rank_] = 1.0;
        std::copy(along.begin(), along.end(), &rows_[rank_ * n_]);
        for (Vector* side : {&step, &tangent}) solve_rows(*side);
    }

    // Minus the solution for the bias (all rows), Gdot v - s'' in row units.
    void solve_bend(const Vector& bias, Vector& bend) {
        bend.assign(n_, 0.0);
        for (int i = 0; i < rank_; ++i)
            for (int k = 0; k < rank_; ++k)
                bend[i] -= weight(i, k) * bias[critical_.rows[k]];
        solve_rows(bend);
    }

    double beta = 0.0, width = 0.0;
    double layer = 0.0;  // the width, also if the residual counts as zero
    int side = 1;
    Vector along;

private:
    double weight(int i, int k) const {
        return i + 1 < rank_ ? strong_[i * rank_ + k] : critical_.u[k];
    }

    // The combinations of g and G, the critical one last.
    void combine() {
        values_.assign(rank_, 0.0);
        rows_.assign(static_cast<std::size_t>(n_) * n_, 0.0);
        for (int i = 0; i < rank_; ++i)
            for (int k = 0; k < rank_; ++k) {
                values_[i] += weight(i, k) * closures_.g[critical_.rows[k]];
                add(weight(i, k), &closures_.G[critical_.rows[k] * n_], &rows_[i * n_], n_);
            }
    }

    double form(const double* a, const double* b) const {
        double sum = 0.0;
        for (int i = 0; i < n_; ++i) sum += a[i] * dot(&critical_.hessian[i * n_], b, n_);
        return sum;
    }

    void solve_rows(Vector& side) {
        matrix_ = rows_;
        if (!solve(matrix_, side)) throw NoPassage{};
    }

    UnitClosures& closures_;
    const CriticalConfiguration& critical_;
    const int n_, rank_;
    const bool exact_;
    const double largest_deviation_;
    double delta_ = 0.0, level_ = 0.0, ratio_ = 1.0;
    Vector strong_, kept_, values_, rows_, matrix_;
};

struct Node {
    Vector x;  // (nq + nv,), rates unused
    double time = 0.0;
    double beta = 0.0;
    Vector tangent, rates;  // (n,)
    double off = 0.0, inertia = 0.0, power = 0.0, sigma = 0.0;
    Vector acceleration;  // (nv,)
};

struct Found {
    Node node;
    double energy, t;
};

class Passage {
public:
    Passage(UnitClosures& closures, MotionAlongCurve& motion, double t, const Vector& state,
            double end, double rtol, const Collocation& collocation, const Constants& constants)
        : closures_(closures),
          system_(closures.system),
          critical_(motion.critical),
          motion_(motion),
          constants_(constants),
          collocation_(collocation),
          count_(static_cast<int>(collocation.nodes.size())),
          nq_(system_.nq),
          nv_(system_.nv),
          n_(closures.n),
          driven_(system_.driven()),
          rtol_(rtol),
          end_(end),
          begin_(state),
          curve_(closures, motion, state, t, constants) {
        Vector rates(n_);
        for (int j = 0; j < nv_; ++j) rates[j] = state[nq_ + j] / closures.unit(j);
        if (driven_) rates[nv_] = 1.0 / closures.time_unit;
        const bool begun = motion.begun;
        const double beta = curve_.beta, start = begun ? motion.start : beta;
        motion.start = start;
        heading_ = start > 0.0 ? -1.0 : 1.0;
        const bool beside = begun && motion.beside;
        Node here;
        here.x = state;
        here.time = t;
        here.rates = rates;
        if (beside) {
            system_.evaluate(t, state.data(), System::ZoneView{});  // for the mass matrix
            double rate;
            here = predicted(beta, motion.energy, rate);
        }
        here = evaluated(here.x, here.time, beta, here.rates, closes(beta), begun && rounded(beta));
        clock_ = beside && driven_ ? here.time : t;
        if (!beside) {
            here.x = state;
            here.time = t;
        }
        if (!begun && !(dot(rates.data(), here.tangent.data(), n_) * start < 0.0))
            throw NoPassage{};
        width_ = curve_.width > 0.0 ? curve_.width : std::abs(start);
        const double speed = dot(curve_.along.data(), rates.data(), n_) /
                             dot(curve_.along.data(), here.tangent.data(), n_);
        energy_ = begun ? motion.energy : 0.5 * here.inertia * speed * speed;
        found_.push_back({std::move(here), energy_, t});
        const double reach = std::asinh(std::abs(start) / width_);
        const Vector edges = panel_edges(reach, !motion.exact);
        double at = begun ? heading_ * std::asinh(beta / width_) : edges.front();
        motion.side = curve_.side;
        motion.begun = motion.beside = false;
        for (std::size_t k = 1; k < edges.size() && !(at < edges[k - 1]); ++k)
            at = panels(at, edges[k]);
        if (clock_ < end_) {
            const bool whole = !(at < edges.back());
            point(whole ? -start : width_ * std::sinh(heading_ * at), energy_, clock_);
            if (driven_) found_.back().t = found_.back().node.time;
        }
    }

    std::vector<PassagePoint> points() const {
        std::vector<PassagePoint> out;
        for (const Found& one : found_) {
            PassagePoint p{one.t, one.node.sigma, one.node.x, Vector(2 * nv_)};
            if (out.empty()) {
                p.state = begin_;
            } else {
                const double rate = speed(one.node, one.energy);
                for (int j = 0; j < nv_; ++j)
                    p.state[nq_ + j] = rate * one.node.tangent[j] * closures_.unit(j);
            }
            std::copy_n(&p.state[nq_], nv_, p.rate.begin());
            std::copy(one.node.acceleration.begin(), one.node.acceleration.end(),
                      p.rate.begin() + nv_);
            out.push_back(std::move(p));
        }
        return out;
    }

private:
    // Whether the closures are to hold at beta, also where their residual counts as zero: where it
    // turns the curve by less than the tolerance, and at the ends.
    bool closes(double beta) const {
        return rtol_ * beta * beta > curve_.layer * curve_.layer ||
               !(std::abs(beta) < std::abs(motion_.start));
    }

    // Whether rounding turns the normals at beta, on a curve that leads straight through the critical
    // configuration, by more than the tolerance.
    bool rounded(double beta) const {
        return motion_.exact && constants_.place_rounding > rtol_ * beta * beta;
    }

    // The node next to a place, from one evaluation on the curve with the rates (n,), in units;
    // `known`: it is there, and the rates are along the curve.
    Node evaluated(Vector x, double t, double beta, Vector rates, bool closed, bool known = false) {
        Node node;
        Vector step(n_, 0.0);
        if (known) {
            node.tangent = rates;
            const double length = dot(curve_.along.data(), rates.data(), n_);
            for (double& value : node.tangent) value /= length;
        } else {
            // Newton steps onto the curve take the closures alone: they cost a part of an evaluation.
            double last = distance(beta);
            for (int k = 0;; ++k) {
                curve_.linearise(x, t, beta, closed, step, node.tangent);
                const double off = largest(step.data(), n_);
                if (k == constants_.placing_steps || placed(beta, off) ||
                    !(off <= constants_.converging * last))
                    break;
                last = off;
                closures_.move(step.data(), x, t);
                const double length = dot(curve_.along.data(), rates.data(), n_);
                for (int j = 0; j < n_; ++j) rates[j] = length * node.tangent[j];
            }
        }
        const double grown = growth(x, t, node.tangent);
        for (double& value : node.tangent) value /= grown;
        Vector state(x);
        for (int j = 0; j < nv_; ++j) state[nq_ + j] = rates[j] * closures_.unit(j);
        system_.evaluate(t, state.data(), System::ZoneView{});
        node.sigma = system_.sigma();
        Vector bias(system_.bias());
        for (std::size_t i = 0; i < bias.size(); ++i)
            bias[i] *= system_.residual_scale(static_cast<int>(i));
        Vector turned(n_, 0.0), own(nv_), mass(nv_), all(nv_), working(nv_), turning(nv_);
        Vector inertial(nv_);
        if (!known) curve_.solve_bend(bias, turned);
        for (int j = 0; j < nv_; ++j) {
            own[j] = node.tangent[j] * closures_.unit(j);
            turning[j] = turned[j] * closures_.unit(j);
        }
        system_.mass_times(own.data(), mass.data());
        system_.mass_times(turning.data(), inertial.data());
        system_.working_forces(all.data(), working.data());
        node.inertia = dot(own.data(), mass.data(), nv_);
        double forward;
        if (driven_) {
            forward = -turned[nv_] / node.tangent[nv_];
        } else {
            node.power = dot(own.data(), working.data(), nv_);
            forward = (dot(own.data(), all.data(), nv_) - dot(own.data(), inertial.data(), nv_)) /
                      node.inertia;
        }
        node.acceleration.resize(nv_);
        for (int j = 0; j < nv_; ++j) node.acceleration[j] = own[j] * forward + turning[j];
        node.beta = beta;
        node.rates = rates;
        node.off = largest(step.data(), n_);
        node.x = x;
        node.time = t;
        closures_.move(step.data(), node.x, node.time);
        return node;
    }

    // Derivative of beta along a tangent whose part along it is 1.
    double growth(const Vector& x, double t, const Vector& tangent) {
        if (system_.commutes()) return 1.0;
        Vector away(n_), delta(2 * nv_, 0.0), rate(2 * nv_, 0.0), charted(2 * nv_);
        closures_.difference(critical_.x, critical_.t, x, t, away.data());
        for (int j = 0; j < nv_; ++j) {
            delta[j] = away[j] * closures_.unit(j);
            rate[j] = tangent[j] * closures_.unit(j);
        }
        system_.chart_rate(delta.data(), rate.data(), charted.data());
        double out = driven_ ? curve_.along[nv_] * tangent[nv_] : 0.0;
        for (int j = 0; j < nv_; ++j) out += curve_.along[j] * charted[j] / closures_.unit(j);
        return out;
    }

    // beta' of a motion with the kinetic energy (J), or with drives that of their time.
    double speed(const Node& node, double energy) const {
        if (driven_) return 1.0 / (node.tangent[nv_] * closures_.time_unit);
        return heading_ * std::sqrt(2.0 * energy / node.inertia);
    }

    Vector off_hyperbola(const Node& node) {
        Vector away(n_), on(n_), slope(n_);
        closures_.difference(critical_.x, critical_.t, node.x, node.time, away.data());
        curve_.hyperbola(node.beta, on, slope);
        add(-1.0, on.data(), away.data(), n_);
        return away;
    }

    // The node at beta before its first evaluation, and beta' there, with the kinetic energy (J):
    // that of the hyperbola, moved by the distance of the last nodes from it, which grows with the
    // square of that from the critical configuration.  The mass matrix is that of the evaluation
    // made last.
    Node predicted(double beta, double energy, double& speed) {
        Vector away(n_), tangent(n_);
        curve_.hyperbola(beta, away, tangent);
        std::vector<double> at;
        std::vector<Vector> known;
        for (std::size_t k = found_.size() < 2 ? 0 : found_.size() - 2; k < found_.size(); ++k) {
            const Node& node = found_[k].node;
            const double square = squared_distance(node.beta);
            if (!(square > constants_.extrapolated * std::abs(beta))) continue;
            at.push_back(node.beta);
            known.push_back(off_hyperbola(node));
            for (double& value : known.back()) value /= square;
        }
        const double square = squared_distance(beta);
        for (int j = 0; j < n_ && !at.empty(); ++j) {
            const double last = known.back()[j], run = at.back() - at.front();
            const double slope = at.size() == 2 ? (last - known.front()[j]) / run : 0.0;
            const double curvature = last + (beta - at.back()) * slope;
            away[j] += square * curvature;
            tangent[j] += 2.0 * beta * curvature + square * slope;
        }
        Node out;
        out.beta = beta;
        out.x = critical_.x;
        out.time = critical_.t;
        closures_.move(away.data(), out.x, out.time);
        if (!driven_) out.inertia = inertia(tangent);
        out.tangent = std::move(tangent);
        speed = this->speed(out, energy);
        set_rates(out, speed);
        return out;
    }

    double inertia(const Vector& tangent) const {
        Vector own(nv_), mass(nv_);
        for (int j = 0; j < nv_; ++j) own[j] = tangent[j] * closures_.unit(j);
        system_.mass_times(own.data(), mass.data());
        return dot(own.data(), mass.data(), nv_);
    }

    static void set_rates(Node& node, double speed) {
        node.rates = node.tangent;
        for (double& value : node.rates) value *= speed;
    }

    // The node from an evaluation of `guess`, at its own time with drives, else at t.
    Node again(const Node& guess, double t, bool closed) {
        return evaluated(guess.x, driven_ ? guess.time : t, guess.beta, guess.rates, closed);
    }

    // Whether a node is on the curve and was evaluated with the rates of the speed, for the
    // tolerance or to rounding.
    bool solved(const Node& node, double speed) const {
        if (!placed(node.beta, node.off)) return false;
        double change = 0.0, most = 0.0;
        for (int j = 0; j < n_; ++j) {
            const double rate = speed * node.tangent[j];
            change = std::max(change, std::abs(rate - node.rates[j]));
            most = std::max(most, std::abs(rate));
        }
        const double away = distance(node.beta);
        const double rounding = constants_.place_rounding / (away * away);
        return change <= (constants_.passage_turned * rtol_ + rounding) * most;
    }

    // Whether a Newton step of the size `off` (units) leads to the curve at beta, for the tolerance
    // or to rounding.
    bool placed(double beta, double off) const {
        return off <= constants_.passage_converged * rtol_ * distance(beta) +
                          constants_.place_rounding / distance(beta);
    }

    // Size of the displacement from the critical configuration at beta (units).
    double distance(double beta) const { return std::hypot(beta, curve_.width); }
    double squared_distance(double beta) const { return distance(beta) * distance(beta); }

    // Refuses a node to which the tangents there and at the one before do not lead: closed
    // configurations have other curves.
    void check_neighbours(const Node& before, const Node& node) {
        Vector moved(n_), led(n_, 0.0);
        closures_.difference(before.x, before.time, node.x, node.time, moved.data());
        for (const Node* one : {&before, &node})
            add(0.5 * (node.beta - before.beta), one->tangent.data(), led.data(), n_);
        add(-1.0, led.data(), moved.data(), n_);
        if (!(norm(moved.data(), n_) < constants_.largest_deviation * norm(led.data(), n_)))
            throw NoPassage{};
    }

    // Refuses nodes beyond the layer at which sigma falls: the curve comes to another one.
    void check_sigmas(const std::vector<Node>& nodes) const {
        double most = found_.back().node.sigma;
        for (const Node& node : nodes) {
            most = std::max(most, node.sigma);
            if (node.sigma < constants_.falling_sigma * most) throw NoPassage{};
        }
    }

    // Whether the energy of a straight motion may change by a part only on the panel from a to b: the
    // shortest ones follow it as well as they can.
    bool bounded(double a, double b) const {
        return motion_.exact && !driven_ && b - a > constants_.shortest_panel;
    }

    // Goes on from `at` to the edge, of xi times the heading; returns where that led.  Beyond the
    // layer that may be less, where the motion turns back soon.  Where the energy changes much, panels
    // are shorter.
    double panels(double at, double edge) {
        double target = edge;
        while (at < edge && clock_ < end_) {
            try {
                at = panel(at, target);
                target = edge;
            } catch (const NoPassage&) {
                const bool beyond = at >= constants_.layer, before = target <= -constants_.layer;
                const bool is_bounded = bounded(at, target);
                target = at + constants_.panel_shortened * (target - at);
                if (is_bounded) continue;
                if (motion_.exact || !(beyond || before)) throw;
                if (target - at < constants_.shortest_panel) {
                    if (before) throw;
                    break;
                }
            }
        }
        return at;
    }

    // Goes on along the panel from a to b, of xi times the heading, or only to a place behind the
    // end of the passage; returns where it led.
    double panel(double a, double b) {
        const Vector& x = collocation_.nodes;
        const double start = width_ * std::sinh(heading_ * a), power = found_.back().node.power;
        Vector slope(count_), t(count_ + 1), energies(count_ + 1), times(count_ + 1);
        Vector works(count_), durations(count_);
        std::vector<Node> nodes(count_);
        Vector own{0.0};
        own.insert(own.end(), x.begin(), x.end());
        own.push_back(1.0);
        double least = 0.0, most = infinity;
        if (!(driven_ || motion_.exact)) {
            if (a >= constants_.layer) least = constants_.least_energy * energy_;
            if (b <= -constants_.layer) most = energy_ / constants_.least_energy;
        } else if (bounded(a, b)) {
            least = constants_.least_energy * energy_;
            most = energy_ / constants_.least_energy;
        }
        const auto with_start = [](double first, const Vector& values) {
            Vector out{first};
            out.insert(out.end(), values.begin(), values.end());
            return out;
        };
        for (;;) {
            for (int i = 0; i < count_; ++i) {
                const double xi = heading_ * (a + (b - a) * x[i]), beta = width_ * std::sinh(xi);
                const double energy = energy_ + power * (beta - start);
                if (!(energy > least && energy < most)) throw NoPassage{};
                double rate;
                nodes[i] = predicted(beta, energy, rate);
                slope[i] = width_ * std::cosh(xi) * heading_ * (b - a);
                durations[i] = slope[i] / rate;
            }
            integrate(durations, clock_, t);
            if (!(t[count_] > end_)) break;
            const double length = constants_.panel_cut * bisected(own, with_start(clock_, t), end_);
            if (!(length < constants_.panel_cut_from)) break;
            b = a + length * (b - a);
        }
        for (int i = 0; i < count_; ++i) nodes[i] = again(nodes[i], t[i], false);
        for (int sweep = 0;; ++sweep) {
            if (sweep == constants_.passage_sweeps) throw NoPassage{};
            for (int i = 0; i < count_; ++i) works[i] = slope[i] * nodes[i].power;
            integrate(works, energy_, energies);
            for (double value : energies)
                if (!(value > least && value < most)) throw NoPassage{};
            for (int i = 0; i < count_; ++i) {
                durations[i] = slope[i] / speed(nodes[i], energies[i]);
                if (!(durations[i] > 0.0)) throw NoPassage{};
            }
            integrate(durations, clock_, times);
            bool done = true;
            for (int i = 0; i < count_; ++i) {
                const double rate = slope[i] / durations[i];
                if (solved(nodes[i], rate)) continue;
                done = false;
                set_rates(nodes[i], rate);
                nodes[i] = again(nodes[i], times[i], false);
            }
            if (done) break;
        }
        for (int i = 0; i < count_; ++i)
            check_neighbours(i ? nodes[i - 1] : found_.back().node, nodes[i]);
        if (a >= constants_.layer) check_sigmas(nodes);
        const double begin = clock_, energy_before = energy_;
        energy_ = energies[count_];
        clock_ = times[count_];
        // The end of the run, or of its smooth interval, may lie in the panel.
        const bool ends = clock_ >= end_;
        double at = 0.0;
        Node last;
        if (ends) {
            at = bisected(own, with_start(begin, times), end_);
            motion_.beta = width_ * std::sinh(heading_ * (a + (b - a) * at));
            motion_.energy = interpolated(own, with_start(energy_before, energies), at);
            motion_.begun = heading_ * motion_.beta <
                            (1.0 - constants_.smallest_rest) * std::abs(motion_.start);
            if (rounded(motion_.beta)) last = between(nodes, at, motion_.beta);
        }
        for (int i = 0; i < count_; ++i) {
            const double time = driven_ ? nodes[i].time : times[i];
            if (found_.front().t < time && time < end_)
                found_.push_back({std::move(nodes[i]), energies[i], time});
        }
        if (!ends) return b;
        if (rounded(motion_.beta))
            found_.push_back({std::move(last), motion_.energy, end_});
        else
            point(motion_.beta, motion_.energy, end_);
        return b;
    }

    // The node at beta, a part `at` of the panel with the nodes, by interpolation.
    Node between(const std::vector<Node>& nodes, double at, double beta) {
        const Vector& x = collocation_.nodes;
        Vector values(count_), away(n_);
        std::vector<Vector> places(count_, Vector(n_));
        for (int i = 0; i < count_; ++i)
            closures_.difference(critical_.x, critical_.t, nodes[i].x, nodes[i].time,
                                 places[i].data());
        const auto through = [&](auto value_of) {
            for (int i = 0; i < count_; ++i) values[i] = value_of(i);
            return interpolated(x, values, at);
        };
        Node out;
        out.beta = beta;
        out.tangent.resize(n_);
        out.acceleration.resize(nv_);
        for (int j = 0; j < n_; ++j) {
            away[j] = through([&](int i) { return places[i][j]; });
            out.tangent[j] = through([&](int i) { return nodes[i].tangent[j]; });
        }
        for (int j = 0; j < nv_; ++j)
            out.acceleration[j] = through([&](int i) { return nodes[i].acceleration[j]; });
        out.rates = out.tangent;
        out.inertia = through([&](int i) { return nodes[i].inertia; });
        out.power = through([&](int i) { return nodes[i].power; });
        out.sigma = std::abs(through([&](int i) { return nodes[i].sigma; }));
        out.x = critical_.x;
        out.time = critical_.t;
        closures_.move(away.data(), out.x, out.time);
        return out;
    }

    // start + the integrals of `values` (k,) up to the nodes and to the end (k + 1,).
    void integrate(const Vector& values, double start, Vector& out) const {
        for (int i = 0; i < count_; ++i)
            out[i] = start + dot(&collocation_.integrals[i * count_], values.data(), count_);
        out[count_] = start + dot(collocation_.weights.data(), values.data(), count_);
    }

    // Goes on to beta, where the motion has the kinetic energy (J) at t; a residual that counts as
    // zero is closed again where it can be.
    void point(double beta, double energy, double t) {
        double rate;
        Node node = predicted(beta, energy, rate);
        for (int sweep = 0;; ++sweep) {
            if (sweep == constants_.passage_sweeps) throw NoPassage{};
            node = again(node, t, closes(beta));
            rate = speed(node, energy);
            if (solved(node, rate)) break;
            set_rates(node, rate);
        }
        check_neighbours(found_.back().node, node);
        found_.push_back({std::move(node), energy, t});
    }

    double interpolation_error(double a, double b, bool layer) const {
        using Complex = std::complex<double>;
        const double middle = 0.5 * (a + b), half = 0.5 * (b - a), quarter = std::atan(1.0);
        const Complex of_curve = std::asinh(Complex(0.0, constants_.curvature / width_));
        const Complex places[] = {{of_curve.real(), 2.0 * quarter},
                                  {-of_curve.real(), 2.0 * quarter},
                                  {0.0, quarter}};
        double error = 0.0;
        for (int k = 0; k < (layer ? 3 : 2); ++k) {
            const Complex z = (places[k] - middle) / half, root = std::sqrt(z * z - 1.0);
            const double radius = std::max(std::abs(z + root), std::abs(z - root));
            error = std::max(error, std::pow(radius, -count_));
        }
        return error;
    }

    Vector panel_edges(double reach, bool layer) const {
        const auto accurate = [&](double a, double b) {
            const double error = interpolation_error(a, b, layer);
            return error <= std::min(constants_.relative_panel_error,
                                     constants_.panel_error * rtol_ / (width_ * std::sinh(b)));
        };
        const double within = 4.0 / 3.0 * constants_.layer, shortest = constants_.shortest_panel;
        double edge = reach;
        Vector out{reach};
        while (edge > shortest && !(edge <= within && accurate(-edge, edge))) {
            double length = edge > within ? edge - constants_.layer : 0.5 * edge;
            while (length > shortest && !accurate(edge - length, edge))
                length *= constants_.panel_shrinkage;
            edge -= length;
            out.push_back(edge);
        }
        Vector edges;
        for (double x : out) edges.push_back(-x);
        edges.insert(edges.end(), out.rbegin(), out.rend());
        return edges;
    }

    // The polynomial through values at x, at a point between.
    static double interpolated(const Vector& x, const Vector& values, double at) {
        double above = 0.0, below = 0.0;
        for (std::size_t i = 0; i < x.size(); ++i) {
            if (at == x[i]) return values[i];
            double product = at - x[i];
            for (std::size_t k = 0; k < x.size(); ++k)
                if (k != i) product *= x[i] - x[k];
            above += values[i] / product;
            below += 1.0 / product;
        }
        return above / below;
    }

    double bisected(const Vector& x, const Vector& values, double value) const {
        double low = x.front(), high = x.back();
        for (int k = 0; k < constants_.bisections; ++k) {
            const double middle = 0.5 * (low + high);
            (interpolated(x, values, middle) < value ? low : high) = middle;
        }
        return 0.5 * (low + high);
    }

    UnitClosures& closures_;
    System& system_;
    const CriticalConfiguration& critical_;
    MotionAlongCurve& motion_;
    const Constants& constants_;
    const Collocation& collocation_;
    const int count_, nq_, nv_, n_;
    const bool driven_;
    const double rtol_, end_;
    const Vector begin_;  // the state there
    SaddleCurve curve_;
    double heading_ = 1.0, width_ = 1.0, energy_ = 0.0, clock_ = 0.0;
    std::vector<Found> found_;
};

}  // namespace

std::vector<PassagePoint> passage_along_curve(System& system, MotionAlongCurve& motion, double t,
                                              const std::vector<double>& state, double end,
                                              double rtol, const Collocation& collocation,
                                              const Constants& constants) {
    UnitClosures closures(system, motion.time_unit);
    try {
        return Passage(closures, motion, t, state, end, rtol, collocation, constants).points();
    } catch (const NoPassage&) {
        motion.begun = false;
        return {};
    }
}

std::optional<MotionAlongCurve> motion_in_layer(System& system, double t,
                                                const std::vector<double>& state, double time_unit,
                                                double tolerance, double reach,
                                                const Constants& constants) {
    const int nv = system.nv;
    UnitClosures closures(system, time_unit);
    if (closures.n - system.structural_rank() != 1) return {};
    try {
        const std::vector<double> still(2 * nv, 0.0);
        auto critical = critical_of_passage(closures, t, state.data(), still.data(), t, constants);
        if (!critical || !(std::abs(critical->residual) > constants.stepped_residual)) return {};
        const bool exact = !(std::abs(critical->residual) >
                             std::max(tolerance, constants.rounded_residual));
        MotionAlongCurve motion{std::move(*critical), time_unit, exact};
        std::vector<double> rates(closures.n);
        for (int j = 0; j < nv; ++j) rates[j] = state[system.nq + j] / closures.unit(j);
        if (system.driven()) rates[nv] = 1.0 / time_unit;
        const SaddleCurve curve(closures, motion, state, t, constants, exact ? &rates : nullptr);
        const double along = dot(curve.along.data(), rates.data(), closures.n);
        // Of the rates as they are: rounding turns them by more than it changes their size.
        system.evaluate(t, state.data(), System::ZoneView{});
        std::vector<double> momentum(nv);
        system.mass_times(&state[system.nq], momentum.data());
        motion.energy = 0.5 * dot(&state[system.nq], momentum.data(), nv);
        if (exact && !system.driven()) {
            Vector away(nv), tangent(nv), all(nv), working(nv);
            curve.hyperbola(curve.beta, away, tangent);
            system.working_forces(all.data(), working.data());
            double power = 0.0;
            for (int j = 0; j < nv; ++j) power += tangent[j] * closures.unit(j) * working[j];
            const double spent = constants.spent_energy * motion.energy;
            if (std::abs(power) * reach > spent) reach = spent / std::abs(power);
            if (!(reach > constants.layers_left * curve.layer)) return {};
        }
        if (along == 0.0 || !(std::max(std::abs(curve.beta), curve.layer) < reach)) return {};
        motion.begun = true;
        motion.beside = exact;
        motion.side = curve.side;
        motion.beta = curve.beta;
        motion.start = along > 0.0 ? -reach : reach;
        return motion;
    } catch (const NoPassage&) {
        return {};
    } catch (const EvaluationError&) {
        return {};
    }
}

bool leads_to_dead_point(UnitClosures& closures, const CriticalConfiguration& critical, double t,
                         const std::vector<double>& state, const Constants& constants) {
    if (!closures.system.driven()) return false;
    const MotionAlongCurve motion{critical, closures.time_unit, false};
    try {
        const SaddleCurve curve(closures, motion, state, t, constants);
        if (!(curve.width < constants.dead_point_width)) return false;
        Vector away(closures.n), slope(closures.n);
        const auto time = [&](double beta) {
            curve.hyperbola(beta, away, slope);
            return away.back();
        };
        const double far = constants.dead_point_widths * curve.width;
        return std::max(time(far), time(-far)) < time(0.0);
    } catch (const NoPassage&) {
        return false;
    }
}

StepBeside step_beside(UnitClosures& closures, const CriticalConfiguration& critical, double t,
                       const std::vector<double>& state, double t_end,
                       const std::vector<double>& end, const Constants& constants) {
    const MotionAlongCurve motion{critical, closures.time_unit, false};
    try {
        SaddleCurve curve(closures, motion, state, t, constants);
        double first, last;
        const int sides = curve.side_of(state, t, first) * curve.side_of(end, t_end, last);
        if (sides == 0) return StepBeside::unknown;
        if (sides < 0) return StepBeside::changes;
        return first * last < 0.0 ? StepBeside::passes : StepBeside::stays;
    } catch (const NoPassage&) {
        return StepBeside::unknown;
    }
}

}  // namespace srm
