#include "touching_branch.hpp"

#include <algorithm>
#include <cmath>

#include "limits.hpp"
#include "linear.hpp"

namespace srm {

namespace {

using Vector = std::vector<double>;

// Weights at 0 of the polynomial through the first `count` places, and of its derivatives.
struct Weights {
    Vector value, first, second;

    Weights(const Vector& places, double shift, std::size_t count)
        : value(count, 1.0), first(count), second(count) {
        double sum = 0.0, squares = 0.0;
        for (std::size_t k = 0; k < count; ++k) {
            const double own = places[k] - shift;
            sum += 1.0 / own;
            squares += 1.0 / (own * own);
            for (std::size_t j = 0; j < count; ++j)
                if (j != k) value[k] *= -(places[j] - shift) / (places[k] - places[j]);
        }
        for (std::size_t k = 0; k < count; ++k) {
            const double inverse = 1.0 / (places[k] - shift), slope = inverse - sum;
            first[k] = value[k] * slope;
            second[k] = value[k] * (slope * slope + inverse * inverse - squares);
        }
    }
};

// Subtracts from `vector` (n,) its parts along the `count` rows of `tangents` (count, n).
void remove(const double* parts, const Vector& tangents, int count, int n, double* vector) {
    for (int i = 0; i < count; ++i) add(-parts[i], &tangents[i * n], vector, n);
}

}  // namespace

TouchingBranch::TouchingBranch(System& system, const Constants& constants)
    : system_(system),
      constants_(constants),
      nv_(system.nv),
      nx_(system.nq + system.nv),
      step_(2 * nv_),
      none_(2 * nv_),
      point_(nx_) {}

void TouchingBranch::frame_at(System& system, const Constants& constants, double t,
                              const double* state, const double* tangents, const Vector& slopes,
                              Vector& frame) {
    const int nv = system.nv, f = static_cast<int>(slopes.size());
    int steepest = 0;
    for (int i = 1; i < f; ++i)
        if (std::abs(slopes[i]) > std::abs(slopes[steepest])) steepest = i;
    frame.assign((f + 1) * nv, 0.0);
    double* const w = frame.data();
    double* const bend = w + f * nv;
    for (int i = 0, k = 1; i < f; ++i) {
        add(slopes[i], tangents + i * nv, w, nv);
        if (i == steepest) continue;
        std::copy_n(tangents + i * nv, nv, w + k * nv);
        add(-slopes[i] / slopes[steepest], tangents + steepest * nv, w + k * nv, nv);
        ++k;
    }
    const double size = system.position_norm(w);
    Vector moving(state, state + system.nq), none(nv);
    for (int i = 0; i < nv; ++i) {
        w[i] /= size;
        moving.push_back(w[i]);
        w[i] *= constants.touching;
    }
    system.evaluate(t, moving.data(), System::ZoneView{});
    system.multiplier_of(none.data(), bend);
    for (int i = 0; i < nv; ++i) bend[i] *= -0.5;
}

// The rates (f,) of `motion` (nv,) in the frame.
Vector TouchingBranch::along(const double* motion) const {
    Vector out(f_);
    for (int i = 0; i < f_; ++i) out[i] = dot(&along_[i * nv_], motion, nv_);
    return out;
}

// The motion from the start to x on the parabola, moved by `off`.
void TouchingBranch::place(double x, const Vector& off, Vector& out) const {
    out = off;
    for (int i = 0; i < nv_; ++i) out[i] += x * tangents_[i] + x * x * bend_[i];
    for (int i = 1; i < f_; ++i) add(beside_[i - 1], &tangents_[i * nv_], out.data(), nv_);
}

// The state that is `motion` away from the start, with the rates v.
void TouchingBranch::move(const double* motion, const double* v, Vector& out) {
    std::copy_n(motion, nv_, step_.begin());
    std::fill(step_.begin() + nv_, step_.end(), 0.0);
    out.resize(nx_);
    system_.retract(start_.data(), step_.data(), out.data());
    std::copy_n(v, nv_, out.end() - nv_);
}

void TouchingBranch::difference(const double* from, const double* to, Vector& out) {
    out.resize(2 * nv_);
    system_.difference(from, to, none_.data(), out.data());
}

bool TouchingBranch::prepare(double t, const double* state, const Vector& frame) {
    const int samples = constants_.touching_samples, each = constants_.touching_nodes;
    const double spacing = constants_.touching_spacing;
    f_ = static_cast<int>(frame.size()) / nv_ - 1;
    start_.assign(state, state + nx_);
    nodes_.clear();
    places_.clear();
    beside_.assign(f_ - 1, 0.0);
    tangents_.assign(frame.begin(), frame.end() - nv_);
    bend_.assign(frame.end() - nv_, frame.end());
    along_.resize(f_ * nv_);
    for (int i = 0; i < f_; ++i) {
        double* const own = &tangents_[i * nv_];
        const double size = system_.position_norm(own);
        for (int j = 0; j < nv_; ++j) {
            own[j] /= size;
            along_[i * nv_ + j] = own[j] / (system_.unit(j) * system_.unit(j));
        }
    }
    Vector gram(f_ * f_), column(f_);
    std::vector<int> pivots(f_);
    for (int i = 0; i < f_; ++i)
        for (int j = 0; j < f_; ++j)
            gram[j * f_ + i] = dot(&along_[i * nv_], &tangents_[j * nv_], nv_);
    if (!lu_factor(gram.data(), f_, pivots.data())) return false;
    for (int j = 0; j < nv_; ++j) {
        for (int i = 0; i < f_; ++i) column[i] = along_[i * nv_ + j];
        lu_solve(gram.data(), f_, pivots.data(), column.data());
        for (int i = 0; i < f_; ++i) along_[i * nv_ + j] = column[i];
    }
    remove(along(bend_.data()).data(), tangents_, f_, nv_, bend_.data());

    const int count = 2 * samples + 1;
    const Vector off(nv_, 0.0);
    Vector motion, roots(count);
    const auto x = [&](int k) { return (k - samples) * spacing; };
    for (int k = 0; k < count; ++k) {
        place(x(k), off, motion);
        move(motion.data(), none_.data(), point_);
        system_.evaluate(t, point_.data(), System::ZoneView{});
        roots[k] = std::sqrt(system_.sigma());
    }
    const double least = std::sqrt(constants_.touching_sigma);
    const int lowest =
        static_cast<int>(std::min_element(roots.begin(), roots.end()) - roots.begin());
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
    for (int k = 0; k < each; ++k)
        for (const double side : {-1.0, 1.0})
            places_.push_back(centre + side * (reach + k * spacing));
    return true;
}

// The node at x, by Newton's method from the parabola moved by node.off; whether it found it.
bool TouchingBranch::find(double t, double x, Node& node) {
    double last = infinity;
    Vector closing(nv_), basis, rates, gram(f_ * f_), column(f_);
    std::vector<int> pivots(f_);
    for (int iteration = 0; iteration < constants_.node_iterations; ++iteration) {
        place(x, node.off, node.motion);
        move(node.motion.data(), none_.data(), point_);
        system_.evaluate(t, point_.data(), System::ZoneView{});
        if (system_.rank_deficient() || !(system_.sigma() > constants_.touching_least))
            return false;
        system_.driven_residuals(node.residuals);
        system_.closing(node.residuals, closing.data());
        if (system_.branch_tangents(basis, &rates) != f_) return false;
        const int d = static_cast<int>(node.residuals.size());
        for (int j = 0; j < f_; ++j)
            for (int i = 0; i < f_; ++i)
                gram[j * f_ + i] = dot(&along_[i * nv_], &basis[j * nv_], nv_);
        if (!lu_factor(gram.data(), f_, pivots.data())) return false;
        node.tangents.assign(f_ * nv_, 0.0);
        node.driven.assign(f_ * d, 0.0);
        for (int j = 0; j < f_; ++j) {
            std::fill(column.begin(), column.end(), 0.0);
            column[j] = 1.0;
            lu_solve(gram.data(), f_, pivots.data(), column.data());
            for (int i = 0; i < f_; ++i) {
                add(column[i], &basis[i * nv_], &node.tangents[j * nv_], nv_);
                add(column[i], rates.data() + i * d, node.driven.data() + j * d, d);
            }
        }
        remove(along(closing.data()).data(), node.tangents, f_, nv_, closing.data());
        for (int i = 0; i < nv_; ++i) node.off[i] -= closing[i];
        const double change = system_.position_norm(closing.data());
        if (iteration == 0 && change > constants_.node_closing * constants_.touching_spacing)
            return false;
        if (change < constants_.touching_accuracy) {
            place(x, node.off, node.motion);
            return true;
        }
        if (iteration > 1 && !(change < last)) return false;
        last = change;
    }
    return false;
}

// Finds the nodes `beside` (f - 1,) the start; whether there are any.
bool TouchingBranch::follow(double t, const double* beside) {
    if (!nodes_.empty() && std::equal(beside_.begin(), beside_.end(), beside)) return true;
    std::copy_n(beside, f_ - 1, beside_.begin());
    const bool known = !nodes_.empty();
    nodes_.resize(places_.size());
    for (std::size_t k = 0; k < places_.size(); ++k) {
        if (!known) nodes_[k].off = k > 1 ? nodes_[k - 2].off : Vector(nv_, 0.0);
        if (find(t, places_[k], nodes_[k])) continue;
        nodes_.clear();
        places_.clear();
        return false;
    }
    return !nodes_.empty();
}

// Tangents, and rates of the drives along them, of the polynomials with `weights`.
void TouchingBranch::mean(const Vector& weights, Vector& tangents, Vector& driven) const {
    tangents.assign(nodes_[0].tangents.size(), 0.0);
    driven.assign(nodes_[0].driven.size(), 0.0);
    for (std::size_t k = 0; k < nodes_.size(); ++k) {
        add(weights[k], nodes_[k].tangents.data(), tangents.data(),
            static_cast<int>(tangents.size()));
        add(weights[k], nodes_[k].driven.data(), driven.data(), static_cast<int>(driven.size()));
    }
}

// The rates (f,) along `tangents` with the `momentum` (nv,) and the rates `targets` (d,) of the
// drives, at the state evaluated last; whether these determine each other.
bool TouchingBranch::share(const Vector& tangents, const Vector& driven, const double* momentum,
                           const Vector& targets, Vector& out) const {
    const int d = static_cast<int>(targets.size()), n = f_ + d;
    if (d > f_) return false;
    Vector whole(n * n), mass(nv_);
    std::vector<int> pivots(n);
    out.assign(n, 0.0);
    for (int j = 0; j < f_; ++j) {
        system_.mass_times(&tangents[j * nv_], mass.data());
        for (int i = 0; i < f_; ++i) whole[j * n + i] = dot(&tangents[i * nv_], mass.data(), nv_);
        for (int i = 0; i < d; ++i)
            whole[j * n + f_ + i] = whole[(f_ + i) * n + j] = driven[j * d + i];
        out[j] = dot(&tangents[j * nv_], momentum, nv_);
    }
    std::copy(targets.begin(), targets.end(), out.begin() + f_);
    if (!lu_factor(whole.data(), n, pivots.data())) return false;
    lu_solve(whole.data(), n, pivots.data(), out.data());
    out.resize(f_);
    return true;
}

// The point of the branch at z, or where the drives have it; whether there is one.
bool TouchingBranch::settle(double t, Vector& z, Vector& on) {
    Vector tangents, driven, residuals, shift(f_), motion(nv_), misfit(nv_);
    for (int iteration = 0; iteration < constants_.node_iterations; ++iteration) {
        if (places_.empty() || !follow(t, z.data() + 1)) return false;
        const std::size_t count = places_.size();
        const Weights weights(places_, z[0], count), coarse(places_, z[0], count - 2);
        std::fill(motion.begin(), motion.end(), 0.0);
        std::fill(misfit.begin(), misfit.end(), 0.0);
        for (std::size_t k = 0; k < count; ++k) {
            add(weights.value[k], nodes_[k].motion.data(), motion.data(), nv_);
            if (k + 2 < count) add(coarse.value[k], nodes_[k].motion.data(), misfit.data(), nv_);
        }
        add(-1.0, motion.data(), misfit.data(), nv_);
        if (!(system_.position_norm(misfit.data()) <= constants_.touching_misfit)) return false;
        move(motion.data(), none_.data(), on);
        system_.evaluate(t, on.data(), System::ZoneView{});
        system_.driven_residuals(residuals);
        std::fill(shift.begin(), shift.end(), 0.0);
        if (!residuals.empty()) {
            for (double& value : residuals) value = -value;
            mean(weights.value, tangents, driven);
            if (!share(tangents, driven, none_.data(), residuals, shift)) return false;
        }
        std::fill(motion.begin(), motion.end(), 0.0);
        for (int i = 0; i < f_; ++i) {
            add(shift[i], &tangents_[i * nv_], motion.data(), nv_);
            z[i] += shift[i];
        }
        if (system_.position_norm(motion.data()) < constants_.touching_settled)
            return system_.closure_residual() <= constants_.touching_residual;
    }
    return false;
}

// Adds `weight` times the accelerations, and those of the drives but for their own, of a motion
// through `node` whose rates s are constant.
void TouchingBranch::curvature(double t, const Node& node, const Vector& s, double weight,
                               Vector& bend, Vector& drift) {
    Vector v(nv_), multiplier(nv_);
    for (int i = 0; i < f_; ++i) add(s[i], &node.tangents[i * nv_], v.data(), nv_);
    move(node.motion.data(), v.data(), point_);
    system_.evaluate(t, point_.data(), System::ZoneView{});
    system_.multiplier_of(none_.data(), multiplier.data());
    const Vector parts = along(multiplier.data());
    const int d = static_cast<int>(drift.size());
    for (int i = 0; i < f_; ++i) {
        add(weight * parts[i], &node.tangents[i * nv_], bend.data(), nv_);
        add(weight * parts[i], node.driven.data() + i * d, drift.data(), d);
    }
    add(-weight, multiplier.data(), bend.data(), nv_);
}

bool TouchingBranch::solve(double t, const double* from, StageOnBranch& stage) {
    Vector apart;
    difference(start_.data(), from, apart);
    Vector z = along(apart.data());
    Vector& on = stage.state;
    if (!settle(t, z, on)) return false;
    // In the chart at a point of the branch, derivatives are those of the motion.
    const std::size_t count = nodes_.size();
    const int d = static_cast<int>(nodes_[0].residuals.size());
    std::vector<Vector> motions(count);
    Vector places(count);
    for (std::size_t k = 0; k < count; ++k) {
        move(nodes_[k].motion.data(), none_.data(), point_);
        difference(on.data(), point_.data(), motions[k]);
        places[k] = dot(along_.data(), motions[k].data(), nv_);
    }
    const Weights weights(places, 0.0, count);
    Vector tangents, driven, tangent(nv_), bend(nv_), rate(d), drift(d);
    mean(weights.value, tangents, driven);
    for (std::size_t k = 0; k < count; ++k) {
        add(weights.first[k], motions[k].data(), tangent.data(), nv_);
        add(weights.second[k], motions[k].data(), bend.data(), nv_);
        add(weights.first[k], nodes_[k].residuals.data(), rate.data(), d);
        add(weights.second[k], nodes_[k].residuals.data(), drift.data(), d);
    }
    const Vector curve = along(tangent.data()), parts = along(bend.data()), bent(bend);
    for (int i = 1; i < f_; ++i) {
        add(-curve[i], &tangents[i * nv_], tangent.data(), nv_);
        add(-curve[i], driven.data() + i * d, rate.data(), d);
    }
    for (int i = 0; i < nv_; ++i) tangents[i] = tangent[i] / curve[0];
    for (int i = 0; i < d; ++i) driven[i] = rate[i] / curve[0];
    remove(parts.data(), tangents, f_, nv_, bend.data());
    for (int i = 0; i < f_; ++i) add(-parts[i], driven.data() + i * d, drift.data(), d);
    // The rates and accelerations of the drives, from a motion at rest.
    Vector targets(d), accelerations(d), momentum(nv_), s, change, seen(2 * nv_);
    if (d > 0) {
        const Node& node = nodes_.back();
        move(node.motion.data(), none_.data(), point_);
        system_.evaluate(t, point_.data(), System::ZoneView{});
        system_.correction(seen.data());
        const Vector of_rates = along(&seen[nv_]);
        system_.multiplier_of(none_.data(), seen.data());
        const Vector of_accelerations = along(seen.data());
        for (int i = 0; i < f_; ++i) {
            add(-of_rates[i], node.driven.data() + i * d, targets.data(), d);
            add(-of_accelerations[i], node.driven.data() + i * d, accelerations.data(), d);
        }
    }
    const double* const v = from + nx_ - nv_;
    system_.evaluate(t, on.data(), System::ZoneView{});
    system_.mass_times(v, momentum.data());
    if (!share(tangents, driven, momentum.data(), targets, s)) return false;
    const double part = s[0] / curve[0];
    for (double& value : bend) value *= part * part;
    for (double& value : drift) value *= part * part;
    if (f_ > 1) {
        Vector own(curve);
        for (double& value : own) value *= part;
        for (std::size_t k = 0; k < count; ++k) {
            curvature(t, nodes_[k], s, weights.value[k], bend, drift);
            curvature(t, nodes_[k], own, -weights.value[k], bend, drift);
        }
    }
    double* const speed = &on[nx_ - nv_];
    std::fill_n(speed, nv_, 0.0);
    for (int i = 0; i < f_; ++i) add(s[i], &tangents[i * nv_], speed, nv_);
    system_.evaluate(t, on.data(), System::ZoneView{});
    Vector free(nv_), rest(nv_);
    system_.free_acceleration(free.data());
    for (int i = 0; i < nv_; ++i) rest[i] = free[i] - bend[i];
    system_.mass_times(rest.data(), momentum.data());
    for (int i = 0; i < d; ++i) accelerations[i] -= drift[i];
    if (!share(tangents, driven, momentum.data(), accelerations, change)) return false;
    for (int i = 0; i < f_; ++i) add(change[i], &tangents[i * nv_], bend.data(), nv_);
    difference(from, on.data(), apart);
    for (int i = 0; i < nv_; ++i) {
        stage.rate[i] = speed[i];
        stage.rate[nv_ + i] = bend[i];
        stage.multiplier[i] = free[i] - bend[i];
        stage.moved[i] = -apart[i];
        stage.moved[nv_ + i] = v[i] - speed[i];
    }
    const double size = system_.position_norm(tangents.data());
    stage.away = tangents;
    for (int i = 0; i < nv_; ++i) {
        stage.away[i] *= constants_.touching / size;
        stage.away.push_back(0.5 * bent[i] / (size * size));
    }
    return true;
}

}  // namespace srm
