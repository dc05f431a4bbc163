#include "regular_start.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "limits.hpp"
#include "linear.hpp"
#include "workspace.hpp"

namespace srm {

// Bounding box of joints, centres of mass and anchors: _diagonal() of dynamics/scaling.py.
double System::scene_diagonal(double rounding) const {
    const auto& model = work_->model;
    const auto& work = *work_;
    Eigen::Array3d least = Eigen::Array3d::Constant(infinity);
    Eigen::Array3d most = -least;
    double gyration = 0.0;
    const auto mark = [&](const Eigen::Vector3d& at) {
        least = least.min(at.array());
        most = most.max(at.array());
    };
    for (int i = 0; i < model.njoints; ++i) {
        const auto& body = model.inertias[i];
        if (i) mark(work.in_world(i, Eigen::Vector3d::Zero()));
        if (!(body.mass() > 0.0)) continue;
        if (i) mark(work.in_world(i, body.lever()));
        gyration = std::max(gyration, body.inertia().matrix().trace() / body.mass());
    }
    for (const ClosureRows& closure : data_.closures) {
        mark(work.in_world(closure.joint_a, Eigen::Vector3d(closure.at_a.data())));
        mark(work.in_world(closure.joint_b, Eigen::Vector3d(closure.at_b.data())));
    }
    if (!(least <= most).all()) return 0.0;
    const double farthest = std::max(least.abs().maxCoeff(), most.abs().maxCoeff());
    const double out = (most - least).matrix().norm();
    return out > rounding * std::max(farthest, std::sqrt(gyration)) ? out : 0.0;
}

Gyrations System::gyrations(double diagonal) const {
    const auto& model = work_->model;
    std::vector<double> sizes(model.njoints);
    const auto reach = [&](int joint, const auto& at) {
        sizes[joint] = std::max(sizes[joint], at.norm());
    };
    for (int i = 1; i < model.njoints; ++i) {
        reach(i, model.inertias[i].lever());
        reach(static_cast<int>(model.parents[i]), model.jointPlacements[i].translation());
    }
    for (const ClosureRows& closure : data_.closures) {
        reach(closure.joint_a, Eigen::Vector3d(closure.at_a.data()));
        reach(closure.joint_b, Eigen::Vector3d(closure.at_b.data()));
    }
    Gyrations out{infinity, 0.0};
    for (int i = 1; i < model.njoints; ++i) {
        const double mass = model.inertias[i].mass();
        const double half_trace = 0.5 * model.inertias[i].inertia().matrix().trace();
        if (mass == 0.0 && half_trace == 0.0) continue;
        if (!(mass > 0.0 && half_trace >= 0.0)) return {0.0, infinity};
        const double gyration = std::sqrt(half_trace / mass);
        out.least = std::min(out.least, gyration / sizes[i]);
        out.largest = std::max(out.largest, gyration / diagonal);
    }
    return out;
}

double System::least_inertia(const double* q) {
    std::vector<double> rows(static_cast<std::size_t>(data_.rows) * nv);
    rows_and_mass(q, rows.data());
    const Eigen::MatrixXd M =
        work_->data.M.selfadjointView<Eigen::Upper>().toDenseMatrix().reverse();
    const Eigen::VectorXd size = M.diagonal().cwiseSqrt().cwiseInverse();
    const Eigen::LLT<Eigen::MatrixXd> factors(size.asDiagonal() * M * size.asDiagonal());
    const Eigen::VectorXd pivots = factors.matrixLLT().diagonal();
    return factors.info() == Eigen::Success && pivots.allFinite() ? pivots.cwiseAbs2().minCoeff()
                                                                  : 0.0;
}

void System::row_blocks(double length, const double* unit, std::vector<RowBlock>& out) const {
    for (const ClosureRows& closure : data_.closures) {
        const int count = static_cast<int>(closure.count());
        const int turns = static_cast<int>(closure.alignments.size() / 6);
        out.push_back({closure.first_row, count - turns, RowKind::along, length});
        out.push_back({closure.first_row + count - turns, turns, RowKind::turning, 1.0});
    }
    for (const JointRow& joints : data_.joint_rows) {
        double largest = 0.0;
        for (std::size_t i = 0; i < joints.in_v.size(); ++i)
            largest = std::max(largest, std::abs(joints.coefficients[i]) * unit[joints.in_v[i]]);
        out.push_back({joints.row, 1, RowKind::of_joints, largest});
    }
}

namespace {

using Matrix = Eigen::MatrixXd;
using Vector = Eigen::VectorXd;
using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

Matrix columns_of(const Matrix& A, const std::vector<int>& columns) {
    Matrix out(A.rows(), columns.size());
    for (std::size_t j = 0; j < columns.size(); ++j) out.col(j) = A.col(columns[j]);
    return out;
}

// Shortest solutions of A x = b, for rows that are independent of each other.
class ShortestSolution {
public:
    explicit ShortestSolution(Matrix A) : A_(std::move(A)), gram_(A_ * A_.transpose()) {}

    // The smallest singular value; 0 if it is rounding, or not finite.
    double smallest() const {
        if (A_.rows() > A_.cols() || !gram_.allFinite()) return 0.0;
        const Eigen::SelfAdjointEigenSolver<Matrix> found(gram_, Eigen::EigenvaluesOnly);
        return std::sqrt(std::max(found.eigenvalues()(0), 0.0));
    }
    Vector operator()(const Vector& b) { return A_.transpose() * factors().solve(b); }

private:
    const Eigen::LLT<Matrix>& factors() {
        if (factors_.rows() != gram_.rows()) factors_.compute(gram_);
        return factors_;
    }
    Matrix A_, gram_;
    Eigen::LLT<Matrix> factors_;
};

// The closures at one configuration after the other, in units: ClosureGeometry in
// dynamics/constraints/geometry.py.
class Closures {
public:
    Closures(System& system, const StartRules& rules, const StartRequest& request)
        : system_(system), rules_(rules), rows_(system.rows()), nv_(system.nv),
          unit_(Vector::Ones(nv_)), row_unit_(rows_), g_(rows_), G_(rows_, nv_),
          state_(Vector::Zero(system.nq + nv_)), delta_(Vector::Zero(2 * nv_)) {
        std::copy_n(request.q, system.nq, state_.data());
        evaluate(state_);
        diagonal = system.scene_diagonal(rules.size_rounding);
        length_ = diagonal > 0.0 ? diagonal : 1.0;
        unit_.setConstant(length_);
        for (const int j : request.turning) unit_[j] = 1.0;
        system.row_blocks(length_, unit_.data(), blocks_);
        for (const RowBlock& block : blocks_)
            row_unit_.segment(block.first, block.count).setConstant(block.unit);
    }

    void evaluate(const Vector& state) {
        system_.closures_at(0.0, state.data(), g_.data(), G_.data(), nv_);
    }
    Vector errors() const { return g_.cwiseQuotient(row_unit_); }
    Matrix in_units() const {
        return row_unit_.cwiseInverse().asDiagonal() * G_ * unit_.asDiagonal();
    }

    // Usual norms of the rows, from open configurations, and which are not rounding in all.
    void measure(const StartRequest& request) {
        Vector squares = Vector::Zero(rows_), there(state_.size()), whole = Vector::Zero(rows_);
        double along = 0.0, turning = 0.0;
        const double n = static_cast<double>(request.count);
        for (std::size_t i = 0; i < request.count; ++i) {
            const Eigen::Map<const Vector> spread(request.spreads + i * nv_, nv_);
            delta_.head(nv_) = spread.cwiseProduct(unit_);
            system_.retract(state_.data(), delta_.data(), there.data());
            evaluate(there);
            squares += in_units().rowwise().squaredNorm() / n;
            const std::vector<double> J = system_.world_jacobian();
            for (int j = 0; j < nv_; ++j) {
                const double turn = norm(&J[6 * j + 3], 3) * unit_[j];
                const double shift = norm(&J[6 * j], 3) * unit_[j] / length_ + turn;
                along += shift * shift / n;
                turning += turn * turn / n;
            }
        }
        size_ = squares;
        for (const RowBlock& block : blocks_) {
            if (!block.count || block.kind == RowKind::of_joints) continue;
            const double uncancelled = block.kind == RowKind::along ? along : turning;
            const double rounding = rules_.rounding_row * rules_.rounding_row * uncancelled;
            double mean = squares.segment(block.first, block.count).mean();
            if (!(mean > rules_.clearly_more) && mean <= rounding) mean = uncancelled;
            size_.segment(block.first, block.count).setConstant(mean);
            whole.segment(block.first, block.count).setConstant(rounding);
        }
        for (int row = 0; row < rows_; ++row) {
            size_[row] = size_[row] > 0.0 ? std::sqrt(size_[row]) : 1.0;
            if (!(squares[row] <= whole[row])) used_.push_back(row);
        }
    }

    // The normalised rows in use where the closures were evaluated last; none if others are in use
    // there, too.
    Matrix rows_in_use() const {
        const Matrix all = size_.cwiseInverse().asDiagonal() * in_units();
        Matrix out(used_.size(), nv_);
        std::size_t next = 0;
        for (int row = 0; row < rows_; ++row) {
            if (next < used_.size() && used_[next] == row)
                out.row(next++) = all.row(row);
            else if (!(all.row(row).norm() <= rules_.zero))
                return Matrix(0, nv_);
        }
        return out;
    }
    // The errors of these rows.
    Vector errors_in_use() const {
        Vector out(used_.size());
        for (std::size_t i = 0; i < used_.size(); ++i)
            out[i] = g_[used_[i]] / row_unit_[used_[i]] / size_[used_[i]];
        return out;
    }

    // Newton's iteration by shortest steps of the free coordinates, as long as errors fall.
    void close(const std::vector<int>& free) {
        double error = errors().cwiseAbs().maxCoeff();
        if (!(error > rules_.exact)) return;
        Vector there(state_.size());
        for (int k = 1; k < rules_.evaluations && error > 0.0; ++k) {
            const Matrix rows = rows_in_use();
            if (!rows.rows()) break;
            const Vector step = ShortestSolution(columns_of(rows, free))(errors_in_use());
            delta_.setZero();
            for (std::size_t j = 0; j < free.size(); ++j)
                delta_[free[j]] = -step[j] * unit_[free[j]];
            system_.retract(state_.data(), delta_.data(), there.data());
            evaluate(there);
            const double size = errors().cwiseAbs().maxCoeff();
            if (!(size < error)) break;
            error = size;
            state_ = there;
        }
        evaluate(state_);
    }

    const Vector& state() const { return state_; }
    const Vector& unit() const { return unit_; }

    double diagonal = 0.0;

private:
    System& system_;
    const StartRules& rules_;
    const int rows_, nv_;
    double length_ = 1.0;
    std::vector<RowBlock> blocks_;
    std::vector<int> used_;
    Vector unit_, row_unit_, size_, g_;
    RowMajor G_;
    Vector state_, delta_;
};

}  // namespace

bool find_regular_start(System& system, const StartRules& rules, const StartRequest& request,
                        RegularStart& out) {
    const int nv = system.nv;
    Closures closures(system, rules, request);
    out.diagonal = closures.diagonal;
    if (!system.rows() || !(closures.errors().norm() <= rules.closed)) return false;
    closures.measure(request);
    closures.evaluate(closures.state());
    Matrix rows = closures.rows_in_use();
    if (!rows.rows()) return false;
    if (!(ShortestSolution(columns_of(rows, request.free_q)).smallest() > rules.regular))
        return false;
    closures.close(request.free_q);
    rows = closures.rows_in_use();
    if (!rows.rows()) return false;
    const double smallest = std::min(ShortestSolution(rows).smallest(), 1.0);
    ShortestSolution shortest(columns_of(rows, request.free_v));
    if (!(smallest > rules.regular && shortest.smallest() > rules.regular)) return false;
    Vector u = Eigen::Map<const Vector>(request.v, nv).cwiseQuotient(closures.unit());
    const double fastest = u.cwiseAbs().maxCoeff();
    for (int pass = 0; pass < 2; ++pass) {  // the second removes the rounding of the first
        const Vector change = shortest(rows * u);
        for (std::size_t j = 0; j < request.free_v.size(); ++j) u[request.free_v[j]] -= change[j];
    }
    if (u.cwiseAbs().maxCoeff() <= rules.at_rest * fastest) u.setZero();
    const double error = (closures.in_units() * u).cwiseAbs().maxCoeff();
    const double allowed = std::max(
        rules.rate_error, std::min(rules.position_error / smallest, rules.largest_rate_error));
    if (!(error <= allowed * std::max(1.0, fastest))) return false;
    out.q.assign(closures.state().data(), closures.state().data() + system.nq);
    u = u.cwiseProduct(closures.unit());
    out.v.assign(u.data(), u.data() + nv);
    out.least_inertia = system.least_inertia(out.q.data());
    out.gyrations = system.gyrations(out.diagonal);
    return true;
}

}  // namespace srm
