#include "turns.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/Dense>

#include "critical.hpp"

namespace srm {

namespace {

using RowMatrix = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Rows = Eigen::Map<const RowMatrix>;

// The step in which all rates change their sign, about when (s) they vanish, and the time over their
// change.
struct Reversal {
    long step;
    double time, slope;
};

class TurnFinder {
public:
    TurnFinder(const TurnSearch& search, const SeparatedRows& rows, System& all_rows,
               const DipSearch& dips, DenseOutput& dense, System& system, double tolerance,
               const Constants& constants)
        : search_(search),
          rows_(rows),
          all_rows_(all_rows),
          dips_(dips),
          dense_(dense),
          system_(system),
          closures_(system, search.time_unit),
          tolerance_(tolerance),
          constants_(constants),
          steps_(dense.steps()),
          stages_(static_cast<long>(dips.columns.size())),
          nv_(system.nv),
          nq_(system.nq),
          unknowns_(static_cast<long>(rows.factors.size() / rows.supports.size())),
          state_(nq_ + nv_),
          change_(nv_),
          G_(rows.factors.size()) {}

    Turns among(const SigmaDips& recorded) {
        const auto& dips = recorded.dips;
        const std::size_t n = dips.size();
        Turns out{std::vector<char>(n), {}};
        for (std::size_t first = 0, next; first < n; first = next) {
            next = first + 1;
            while (next < n && dips[next][0] - dips[next - 1][2] < 2 * stages_) ++next;
            // A turn beyond may show as several dips, less than two steps apart.
            if (next > first + 1 && turns(recorded, first, next - 1, out)) continue;
            for (std::size_t i = first; i < next; ++i) turns(recorded, i, i, out);
        }
        return out;
    }

private:
    const double* state(long end) const { return steps_.states + end * (nq_ + nv_); }
    double rate(long end, int k) const { return state(end)[nq_ + k] / search_.unit[k]; }

    // Whether the dips from `from` to `to` are those of one turn, which is then added to `out`.
    bool turns(const SigmaDips& recorded, std::size_t from, std::size_t to, Turns& out) {
        const auto& dips = recorded.dips;
        const long first = std::max(dips[from][0] - 1, 0L) / stages_;
        const long last = (dips[to][2] - 1) / stages_;
        // Nothing is read beyond an event that ends the run.
        if (!(steps_.times[last + 1] <= steps_.end)) return false;
        if (from > 0 && dips[from - 1][1] >= first * stages_) return false;
        if (to + 1 < dips.size() && dips[to + 1][1] <= (last + 1) * stages_) return false;
        Reversal reversal;
        Turn turn;
        if (!reverses(first, last, reversal)) return false;
        const long top = recorded.tops[from];
        if (!stays_short(first, last, reversal, sigma_at(dips[from][1]), top, turn)) {
            allowed_.clear();
            if (!certain(first, last, reversal, top, turn)) return false;
        }
        if (system_.driven() && turn.values[0] > 0.0 && avoids(turn.times[1])) return false;
        for (std::size_t i = from; i <= to; ++i) out.found[i] = 1;
        if (turn.values[0] < 0.0) out.beyond.push_back(turn);
        return true;
    }

    // Whether all rates that the rows depend on change their sign in one of the steps, once.
    bool reverses(long first, long last, Reversal& out) {
        long found = -1;
        for (long step = first; step <= last; ++step) {
            double along = 0.0;
            for (const int k : search_.columns) along += rate(step, k) * rate(step + 1, k);
            if (!(along < 0.0)) continue;
            if (found >= 0) return false;
            found = step;
        }
        if (found < 0) return false;
        double size = 0.0, before = 0.0, after = 0.0, both = 0.0;
        for (const int k : search_.columns) {
            const double a = rate(found, k), b = rate(found + 1, k);
            change_[k] = b - a;
            size += change_[k] * change_[k];
            before += a * change_[k];
            after += b * change_[k];
            both += a * a + b * b;
        }
        const double resting = search_.resting * size;
        if (!(size * both - before * before - after * after < resting * resting)) return false;
        const double start = steps_.times[found], length = steps_.times[found + 1] - start;
        out = {found, start - before / size * length, length / size};
        return true;
    }

    // When (s) the rates vanish; the state there is read.
    double turning_time(const Reversal& reversal) {
        const double start = steps_.times[reversal.step], end = steps_.times[reversal.step + 1];
        double t = reversal.time;
        for (int i = 0; i < search_.newton_steps; ++i) {
            read(t);
            double along = 0.0;
            for (const int k : search_.columns)
                along += state_[nq_ + k] / search_.unit[k] * change_[k];
            t = std::clamp(t - along * reversal.slope, start, end);
        }
        read(t);
        return t;
    }

    // Whether the turn certainly stays short of the singular configuration by polynomials through
    // ends of steps, which take no evaluation.  sigma: next to it.
    bool stays_short(long first, long last, const Reversal& reversal, double sigma, long top,
                     Turn& turn) {
        const double error = search_.reading_part * sigma;
        if (!(error > search_.least_reading)) return false;
        const double length = steps_.times[reversal.step + 1] - steps_.times[reversal.step];
        allowed_.resize(2 * nv_);
        for (int k = 0; k < nv_; ++k) {
            allowed_[k] = error * search_.unit[k];
            allowed_[nv_ + k] = allowed_[k] / length;
        }
        return certain(first, last, reversal, top, turn) && turn.values[0] > 0.0 &&
               turn.values[1] > search_.reading_margin * error;
    }

    void read(double t) {
        if (allowed_.empty())
            dense_.states(system_, &t, 1, state_.data());
        else
            dense_.between_ends(system_, &t, 1, allowed_.data(), ends_, state_.data());
    }

    double sigma_at(long sample) const {
        if (!sample) return steps_.sigmas[0];
        const long step = (sample - 1) / stages_, stage = (sample - 1) % stages_;
        return steps_.sigmas[step * dense_.sigma_width() + dips_.columns[stage]];
    }

    Rows rows_at(double t, const double* q) {
        rows_.write(all_rows_, t, q, G_);
        return Rows(G_.data(), static_cast<long>(rows_.supports.size()), unknowns_);
    }

    // Whether the motion certainly did not touch the singular configuration.
    bool certain(long first, long last, const Reversal& reversal, long top, Turn& turn) {
        const double time = turning_time(reversal);
        turn.times = {steps_.times[first], time, steps_.times[last + 1]};
        turn.top = top;
        svd_.compute(rows_at(time, state_.data()),
                     Eigen::ComputeThinU | Eigen::ComputeThinV);
        const int k = search_.rank - 1;
        const Eigen::VectorXd& sizes = svd_.singularValues();
        const double value = sizes[k];
        if (k > 0 && !(sizes[k - 1] > search_.together * value)) return false;
        turn.values[1] = value;
        for (const int side : {0, 2}) {
            const Rows G = rows_at(turn.times[side], state(side ? last + 1 : first));
            turn.values[side] = svd_.matrixU().col(k).dot(G * svd_.matrixV().col(k));
        }
        if (!(turn.values[0] * turn.values[2] > 0.0)) return false;
        // The largest value of the window follows from the recorded sigmas, about.
        const long width = dense_.sigma_width();
        const double untouched = search_.untouched * sigma_at(top);
        if (value * steps_.sigmas[first * width] > untouched * std::abs(turn.values[0]) &&
            value * steps_.sigmas[(last + 1) * width - 1] > untouched * std::abs(turn.values[2]))
            return true;
        const long step = (top - 1) / stages_, stage = (top - 1) % stages_;
        const double start = steps_.times[step], length = steps_.times[step + 1] - start;
        const double t = top > 0 ? start + dips_.abscissae[stage] * length : start;
        dense_.states(system_, &t, 1, state_.data());
        svd_.compute(rows_at(t, state_.data()), 0);
        return value > search_.touching * sizes[k];
    }

    // Whether the motion followed the residual of the critical configuration next to it at t (s).
    bool avoids(double t) {
        dense_.states(system_, &t, 1, state_.data());
        const auto found = critical_near(closures_, t, state_, search_.reach, constants_);
        return found && std::abs(found->residual) > tolerance_;
    }

    const TurnSearch& search_;
    const SeparatedRows& rows_;
    System& all_rows_;
    const DipSearch& dips_;
    DenseOutput& dense_;
    System& system_;
    UnitClosures closures_;
    const double tolerance_;
    const Constants& constants_;
    const StepArrays& steps_;
    const long stages_;
    const int nv_, nq_;
    const long unknowns_;  // columns of the rows: time is one of them with drives
    // allowed_ (2 nv,): error of what is read; without any, it is read by the dense output.
    std::vector<double> state_, change_, allowed_, G_;
    EndReadings ends_;
    Eigen::JacobiSVD<RowMatrix> svd_;
};

}  // namespace

Turns recorded_turns(const TurnSearch& search, const SeparatedRows& rows, System& all_rows,
                     const DipSearch& dips, const SigmaDips& recorded, DenseOutput& dense,
                     System& system, double tolerance, const Constants& constants) {
    return TurnFinder(search, rows, all_rows, dips, dense, system, tolerance, constants)
        .among(recorded);
}

}  // namespace srm
