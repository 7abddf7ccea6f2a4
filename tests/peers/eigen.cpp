// Times recursive least squares written with Eigen. Usage: peers-eigen        (protocol: server.rs)
//
// There is no library for this to compare with; in C++ one would use Eigen. There are two methods:
// that of the paper's authors, a Cholesky factor of the information matrix, updated row by row and
// solved at every sample; and the square-root form that ours has, in panels, with Eigen's
// Householder QR.

#include "server.hpp"

#include <Eigen/Dense>

#include <cstdint>
#include <memory>

using peers::Output;
using peers::Row;

namespace {

// The same as in ours/src/main.rs.
constexpr int UNKNOWNS = 44, ROWS = 6, SAMPLES = 8;
constexpr std::size_t STATES = 64;

// SplitMix64, between -1 and 1.
class Random
{
public:
    double next()
    {
        word += 0x9E3779B97F4A7C15u;
        std::uint64_t z = word;
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
        z ^= z >> 31;
        return static_cast<double>(z >> 11) / 9007199254740992.0 * 2.0 - 1.0;
    }

private:
    std::uint64_t word = 44;
};

struct Sample
{
    // The regressor transposed, so that each of its rows is contiguous.
    Eigen::Matrix<double, UNKNOWNS, ROWS> transposed;
    Eigen::Matrix<double, ROWS, 1> measured;
};

std::vector<Sample> samples()
{
    Random random;
    std::vector<Sample> all(STATES);
    for (Sample& sample : all)
        for (int row = 0; row < ROWS; ++row)
        {
            for (int column = 0; column < UNKNOWNS; ++column)
                sample.transposed(column, row) = random.next();
            sample.measured[row] = random.next();
        }
    return all;
}

// Both methods start with one row x = 0 for every unknown.
struct RankUpdates
{
    Eigen::LLT<Eigen::MatrixXd> factor{Eigen::MatrixXd::Identity(UNKNOWNS, UNKNOWNS)};
    Eigen::VectorXd right = Eigen::VectorXd::Zero(UNKNOWNS), x = right, row = right;

    void take(const Sample& sample)
    {
        for (int i = 0; i < ROWS; ++i)
        {
            row = sample.transposed.col(i);
            factor.rankUpdate(row, 1.0);
        }
        right.noalias() += sample.transposed * sample.measured;
        x = factor.solve(right);
    }
};

struct Panels
{
    static constexpr int BELOW = ROWS * SAMPLES;
    // [R | z] at the top, new rows below it.
    Eigen::MatrixXd stacked = Eigen::MatrixXd::Identity(UNKNOWNS + BELOW, UNKNOWNS + 1);
    Eigen::VectorXd x = Eigen::VectorXd::Zero(UNKNOWNS);
    int waiting = 0;

    void take(const Sample& sample)
    {
        auto to = stacked.middleRows(UNKNOWNS + ROWS * waiting, ROWS);
        to.leftCols(UNKNOWNS) = sample.transposed.transpose();
        to.col(UNKNOWNS) = sample.measured;
        if (++waiting < SAMPLES)
            return;
        waiting = 0;
        Eigen::HouseholderQR<Eigen::Ref<Eigen::MatrixXd>> inPlace(stacked);
        auto square = stacked.topLeftCorner(UNKNOWNS, UNKNOWNS);
        square.triangularView<Eigen::StrictlyLower>().setZero();
        x = stacked.col(UNKNOWNS).head(UNKNOWNS);
        square.triangularView<Eigen::Upper>().solveInPlace(x);
    }
};

template <class Recursion> Row row(const std::string& name, const std::vector<Sample>& all)
{
    auto running = std::make_shared<Recursion>();
    auto last = std::make_shared<std::size_t>(0);
    return {
        name,
        [running, last, &all](std::size_t state) {
            running->take(all[state]);
            *last = state;
        },
        // The samples absorbed during timing differ between programs, so start afresh.
        [last, &all](Output& output) {
            Recursion fresh;
            for (std::size_t state = 0; state < (*last / SAMPLES + 1) * SAMPLES; ++state)
                fresh.take(all[state]);
            for (int k = 0; k < UNKNOWNS; ++k)
                output.add("unknown", std::to_string(k), fresh.x[k]);
        }};
}

} // namespace

int main()
{
    const std::vector<Sample> all = samples();
    peers::serve(STATES, {row<RankUpdates>("recursion_44", all), row<Panels>("panels_44", all)});
}
