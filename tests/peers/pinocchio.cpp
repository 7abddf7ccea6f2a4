// Times Pinocchio. Usage: peers-pinocchio pinocchio.txt states.txt        (protocol: server.rs)
//
// This program uses only Pinocchio's templates, compiled for this processor. It must not be linked
// with Pinocchio's libraries: they are compiled for any processor, for which Eigen has another
// memory layout. So the model comes as text, from prepare.py.

#include "server.hpp"

#include <pinocchio/multibody.hpp>

#include <pinocchio/algorithm/joint-configuration.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/regressor.hpp>
#include <pinocchio/algorithm/rnea.hpp>

#include <Eigen/QR>

namespace pin = pinocchio;
using peers::fail;
using peers::Output;
using peers::Row;
using peers::State;
using peers::States;

namespace {

Eigen::Vector3d vector(const peers::Triple& values)
{
    return Eigen::Vector3d(values[0], values[1], values[2]);
}

// The order of the inertia tensor: xx xy yy xz yz zz in Pinocchio, xx xy xz yy yz zz in the states.
constexpr std::array<int, 10> ORDER{0, 1, 2, 3, 4, 5, 7, 6, 8, 9};

struct Robot
{
    const States& states;
    pin::Model model;
    // The robot's joints and their child links, in the order of the model.
    std::vector<std::string> joints, children;
    // Index of the base's joint in the model; 0 if the base is fixed.
    pin::JointIndex root = 0;
    std::vector<Eigen::VectorXd> positions, velocities, accelerations;

    Robot(const std::string& path, const States& states_, bool floating)
        : states(states_)
    {
        std::ifstream in(path);
        if (!in)
            fail("cannot read " + path);
        in.exceptions(std::ios::failbit | std::ios::badbit);
        model.gravity.linear(vector(states.gravity));
        std::size_t count = 0;
        in >> count;
        const pin::Inertia base = inertia(in);
        if (floating)
        {
            root = model.addJoint(0, pin::JointModelFreeFlyer(), pin::SE3::Identity(), "root");
            model.appendBodyToJoint(root, base, pin::SE3::Identity());
        }
        for (std::size_t number = 0; number < count; ++number)
        {
            std::size_t parent = 0;
            std::string name, child, kind;
            Eigen::Vector3d axis, translation;
            Eigen::Matrix3d rotation;
            in >> parent >> name >> child >> kind;
            for (int i = 0; i < 3; ++i)
                in >> axis[i];
            for (int row = 0; row < 3; ++row)
                for (int column = 0; column < 3; ++column)
                    in >> rotation(row, column);
            for (int i = 0; i < 3; ++i)
                in >> translation[i];
            const pin::SE3 placement(rotation, translation);
            const pin::JointIndex joint = add(kind, axis, root + parent, placement, name);
            model.appendBodyToJoint(joint, inertia(in), pin::SE3::Identity());
            joints.push_back(name);
            children.push_back(child);
        }
        for (const State& state : states.states)
        {
            Eigen::VectorXd q = pin::neutral(model), dq = Eigen::VectorXd::Zero(model.nv), ddq = dq;
            if (floating)
            {
                dq.head<6>() << vector(state.baseVelocity), vector(state.baseAngularVelocity);
                ddq.head<6>() << vector(states.baseSpatialAcceleration(state)),
                    vector(state.baseAngularAcceleration);
            }
            for (std::size_t joint = 0; joint < count; ++joint)
            {
                const std::size_t at = peers::place(states.joints, joints[joint]);
                q.tail(count)[joint] = state.position[at];
                dq.tail(count)[joint] = state.velocity[at];
                ddq.tail(count)[joint] = state.acceleration[at];
            }
            positions.push_back(q);
            velocities.push_back(dq);
            accelerations.push_back(ddq);
        }
    }

    void showGeneralized(const Eigen::VectorXd& generalized, Output& output) const
    {
        if (root != 0)
        {
            output.add3("force", "base", generalized.segment<3>(0));
            output.add3("moment", "base", generalized.segment<3>(3));
        }
        for (std::size_t joint = 0; joint < joints.size(); ++joint)
            output.add("torque", joints[joint], generalized.tail(joints.size())[joint]);
    }

    void showKinematics(const pin::Data& data, Output& output) const
    {
        for (std::size_t number = 0; number < children.size(); ++number)
        {
            const pin::JointIndex joint = root + 1 + number;
            const Eigen::Vector3d omega = data.v[joint].angular();
            const Eigen::Vector3d gravity
                = data.oMi[joint].rotation().transpose() * model.gravity.linear();
            const Eigen::Vector3d acceleration
                = data.a[joint].linear() + omega.cross(data.v[joint].linear()) - gravity;
            output.add3("position", children[number], data.oMi[joint].translation());
            output.add3("omega", children[number], omega);
            output.add3("alpha", children[number], data.a[joint].angular());
            output.add3("acceleration", children[number], acceleration);
        }
    }

    // Random parameters, ten per link, so that every column of a regressor counts.
    Eigen::VectorXd parameters() const
    {
        Eigen::VectorXd parameters(10 * (1 + children.size()));
        for (std::size_t link = 0; link <= children.size(); ++link)
        {
            const std::size_t body
                = link == 0 ? 0 : peers::place(states.bodies, children[link - 1]);
            for (int i = 0; i < 10; ++i)
                parameters[10 * link + i] = states.parameters[body][ORDER[i]];
        }
        return parameters;
    }

    void showRegressor(const pin::Data& data, Output& output) const
    {
        showGeneralized(data.jointTorqueRegressor * parameters(), output);
    }

private:
    static pin::Inertia inertia(std::istream& in)
    {
        Eigen::VectorXd parameters(10);
        for (int i = 0; i < 10; ++i)
            in >> parameters[i];
        return pin::Inertia::FromDynamicParameters(parameters);
    }

    // The joint type that Pinocchio's URDF reader chose.
    pin::JointIndex
    add(const std::string& kind, const Eigen::Vector3d& axis, pin::JointIndex parent,
        const pin::SE3& at, const std::string& name)
    {
        if (kind == "JointModelRX")
            return model.addJoint(parent, pin::JointModelRX(), at, name);
        if (kind == "JointModelRY")
            return model.addJoint(parent, pin::JointModelRY(), at, name);
        if (kind == "JointModelRZ")
            return model.addJoint(parent, pin::JointModelRZ(), at, name);
        if (kind == "JointModelRevoluteUnaligned")
            return model.addJoint(parent, pin::JointModelRevoluteUnaligned(axis), at, name);
        fail("joint " + name + " is a " + kind + ", which this program does not support");
    }
};

// A pass of least squares over a log, as in ours/src/main.rs: the regressor of each sample, and the
// rows of some samples at once into [R z], with Eigen's Householder QR.
struct Pass
{
    static constexpr std::size_t SAMPLES = 16;
    const Robot& robot;
    pin::Data data{robot.model};
    const Eigen::Index rows = robot.model.nv, columns = 10 * (1 + robot.children.size());
    // [R | z] at the top, new rows below it.
    Eigen::MatrixXd stacked = Eigen::MatrixXd::Zero(columns + rows * SAMPLES, columns + 1);
    double residual = 0.0;
    std::size_t waiting = 0, last = 0;

    explicit Pass(const Robot& robot_)
        : robot(robot_)
    {
    }

    void take(std::size_t k)
    {
        last = k;
        pin::computeJointTorqueRegressor(
            robot.model, data, robot.positions[k], robot.velocities[k], robot.accelerations[k]);
        auto to = stacked.middleRows(columns + rows * waiting, rows);
        to.leftCols(columns) = data.jointTorqueRegressor;
        to.col(columns) = robot.velocities[k];
        if (++waiting < SAMPLES)
            return;
        waiting = 0;
        Eigen::HouseholderQR<Eigen::Ref<Eigen::MatrixXd>> inPlace(stacked);
        stacked.topRows(columns).triangularView<Eigen::StrictlyLower>().setZero();
        residual += stacked(columns, columns) * stacked(columns, columns);
    }

    void show(Output& output) const
    {
        Pass fresh(robot);
        for (std::size_t k = 0; k < (last / SAMPLES + 1) * SAMPLES; ++k)
            fresh.take(k);
        const auto root = fresh.stacked.topLeftCorner(columns, columns);
        const Eigen::VectorXd misfit
            = root * robot.parameters() - fresh.stacked.col(columns).head(columns);
        const Eigen::VectorXd gradient = root.transpose() * misfit;
        output.add("square", "sum", misfit.squaredNorm() + fresh.residual);
        for (Eigen::Index link = 0; 10 * link < columns; ++link)
        {
            const std::string name = link == 0 ? "base" : robot.children[link - 1];
            const auto of = gradient.segment<10>(10 * link);
            output.add("mass", name, of[0]);
            output.add3("moment", name, of.segment<3>(1));
            for (int i = 4; i < 10; ++i)
                output.add("inertia", name + "." + std::to_string(ORDER[i] - 4), of[i]);
        }
    }
};

} // namespace

int main(int count, char** arguments)
{
    if (count != 3)
        fail("usage: peers-pinocchio pinocchio.txt states.txt");
    const States states(arguments[2]);
    const Robot fixed(arguments[1], states, false), floating(arguments[1], states, true);
    pin::Data fixedData(fixed.model), floatingData(floating.model);
    Pass pass(floating);

    peers::serve(
        states.states.size(),
        {
            {"kinematics",
             [&](std::size_t k) {
                 pin::forwardKinematics(
                     fixed.model, fixedData, fixed.positions[k], fixed.velocities[k],
                     fixed.accelerations[k]);
             },
             [&](Output& o) { fixed.showKinematics(fixedData, o); }},
            {"rnea",
             [&](std::size_t k) {
                 pin::rnea(
                     fixed.model, fixedData, fixed.positions[k], fixed.velocities[k],
                     fixed.accelerations[k]);
             },
             [&](Output& o) { fixed.showGeneralized(fixedData.tau, o); }},
            {"rnea_floating",
             [&](std::size_t k) {
                 pin::rnea(
                     floating.model, floatingData, floating.positions[k], floating.velocities[k],
                     floating.accelerations[k]);
             },
             [&](Output& o) { floating.showGeneralized(floatingData.tau, o); }},
            {"regressor_33",
             [&](std::size_t k) {
                 pin::computeJointTorqueRegressor(
                     floating.model, floatingData, floating.positions[k], floating.velocities[k],
                     floating.accelerations[k]);
             },
             [&](Output& o) { floating.showRegressor(floatingData, o); }},
            {"pass_33", [&](std::size_t k) { pass.take(k); }, [&](Output& o) { pass.show(o); }},
        });
}
