// Times iDynTree. Usage: peers-idyntree robot.urdf states.txt        (protocol: server.rs)
//
// Everything that a caller can prepare once is prepared for each state beforehand, so that only the
// calls of the library are timed. Each call has another state, because iDynTree keeps the sines of
// joints that have not moved.

#include "server.hpp"

#include <iDynTree/Dynamics.h>
#include <iDynTree/EigenHelpers.h>
#include <iDynTree/ExtWrenchesAndJointTorquesEstimator.h>
#include <iDynTree/ForwardKinematics.h>
#include <iDynTree/Model.h>
#include <iDynTree/ModelLoader.h>
#include <iDynTree/Sensors.h>

#include <memory>
#include <set>

using namespace iDynTree;
using peers::fail;
using peers::Output;
using peers::Row;
using peers::State;
using peers::States;

namespace {

void must(bool fine)
{
    if (!fine)
        fail("iDynTree refused a call");
}

std::vector<std::string> jointNames(const Model& model)
{
    std::vector<std::string> names(model.getNrOfDOFs());
    for (JointIndex joint = 0; joint < static_cast<JointIndex>(model.getNrOfJoints()); ++joint)
        if (model.getJoint(joint)->getNrOfDOFs() == 1)
            names.at(model.getJoint(joint)->getDOFsOffset()) = model.getJointName(joint);
    return names;
}

template <class Vector>
void setJoints(
    Vector& to, const std::vector<double>& from, const std::vector<std::string>& names,
    const States& states)
{
    for (std::size_t joint = 0; joint < names.size(); ++joint)
        to(joint) = from[peers::place(states.joints, names[joint])];
}

// The low-level functions that iDynTree's classes call, each object with its own model.
struct LowLevel
{
    const States& states;
    Model model;
    Traversal traversal;
    std::vector<std::string> joints;
    std::vector<FreeFloatingPos> positions;
    std::vector<FreeFloatingVel> velocities;
    std::vector<FreeFloatingAcc> accelerations;
    LinkPositions linkPositions;
    LinkVelArray linkVelocities;
    LinkAccArray linkAccelerations;
    LinkNetExternalWrenches external;
    LinkInternalWrenches internal;
    FreeFloatingGeneralizedTorques torques;
    MatrixDynSize regressor;
    bool floating;

    LowLevel(const Model& model_, const States& states_, bool floating_)
        : states(states_)
        , model(model_)
        , joints(jointNames(model))
        , linkPositions(model)
        , linkVelocities(model)
        , linkAccelerations(model)
        , external(model)
        , internal(model)
        , torques(model)
        , regressor(6 + model.getNrOfDOFs(), 10 * model.getNrOfLinks())
        , floating(floating_)
    {
        must(model.computeFullTreeTraversal(traversal));
        external.zero();
        for (const State& state : states.states)
        {
            FreeFloatingPos position(model);
            FreeFloatingVel velocity(model);
            FreeFloatingAcc acceleration(model);
            setJoints(position.jointPos(), state.position, joints, states);
            setJoints(velocity.jointVel(), state.velocity, joints, states);
            setJoints(acceleration.jointAcc(), state.acceleration, joints, states);
            position.worldBasePos() = Transform::Identity();
            velocity.baseVel().zero();
            acceleration.baseAcc().zero();
            // Spatial accelerations minus gravity. A base fixed to the world has only gravity.
            const peers::Triple spatial = states.baseSpatialAcceleration(state);
            for (int axis = 0; axis < 3; ++axis)
            {
                if (floating)
                {
                    velocity.baseVel().getLinearVec3()(axis) = state.baseVelocity[axis];
                    velocity.baseVel().getAngularVec3()(axis) = state.baseAngularVelocity[axis];
                    acceleration.baseAcc().getAngularVec3()(axis)
                        = state.baseAngularAcceleration[axis];
                }
                acceleration.baseAcc().getLinearVec3()(axis)
                    = (floating ? spatial[axis] : 0.0) - states.gravity[axis];
            }
            positions.push_back(position);
            velocities.push_back(velocity);
            accelerations.push_back(acceleration);
        }
    }

    void kinematics(std::size_t k)
    {
        must(ForwardPosVelAccKinematics(
            model, traversal, positions[k], velocities[k], accelerations[k], linkPositions,
            linkVelocities, linkAccelerations));
    }

    void showKinematics(Output& output) const
    {
        for (LinkIndex link = 0; link < static_cast<LinkIndex>(model.getNrOfLinks()); ++link)
        {
            if (link == model.getDefaultBaseLink())
                continue;
            const std::string name = model.getLinkName(link);
            const Eigen::Vector3d omega = toEigen(linkVelocities(link).getAngularVec3());
            const Eigen::Vector3d velocity = toEigen(linkVelocities(link).getLinearVec3());
            const Eigen::Vector3d acceleration
                = toEigen(linkAccelerations(link).getLinearVec3()) + omega.cross(velocity);
            output.add3("position", name, toEigen(linkPositions(link).getPosition()));
            output.add3("omega", name, omega);
            output.add3("alpha", name, toEigen(linkAccelerations(link).getAngularVec3()));
            output.add3("acceleration", name, acceleration);
        }
    }

    // Inverse dynamics needs only velocities and accelerations, no poses.
    void inverseDynamics(std::size_t k)
    {
        must(ForwardVelAccKinematics(
            model, traversal, positions[k], velocities[k], accelerations[k], linkVelocities,
            linkAccelerations));
        must(RNEADynamicPhase(
            model, traversal, positions[k].jointPos(), linkVelocities, linkAccelerations, external,
            internal, torques));
    }

    void showInverseDynamics(Output& output) const
    {
        for (std::size_t joint = 0; joint < joints.size(); ++joint)
            output.add("torque", joints[joint], torques.jointTorques()(joint));
        if (floating)
        {
            output.add3("force", "base", toEigen(torques.baseWrench().getLinearVec3()));
            output.add3("moment", "base", toEigen(torques.baseWrench().getAngularVec3()));
        }
    }

    void regress(std::size_t k)
    {
        kinematics(k);
        must(InverseDynamicsInertialParametersRegressor(
            model, traversal, linkPositions, linkVelocities, linkAccelerations, regressor));
    }

    // The regressor times random parameters, so that every column counts.
    void showRegressor(Output& output) const
    {
        Eigen::VectorXd parameters(10 * model.getNrOfLinks());
        for (LinkIndex link = 0; link < static_cast<LinkIndex>(model.getNrOfLinks()); ++link)
        {
            const std::size_t body = link == model.getDefaultBaseLink()
                                         ? 0
                                         : peers::place(states.bodies, model.getLinkName(link));
            for (int i = 0; i < 10; ++i)
                parameters(10 * link + i) = states.parameters[body][i];
        }
        const Eigen::VectorXd product = toEigen(regressor) * parameters;
        output.add3("force", "base", product.segment<3>(0));
        output.add3("moment", "base", product.segment<3>(3));
        for (std::size_t joint = 0; joint < joints.size(); ++joint)
            output.add("torque", joints[joint], product(6 + joint));
    }
};

// From F/T readings: a full contact wrench on each sub-tree between sensors, and all torques.
struct Estimation
{
    const States& states;
    ExtWrenchesAndJointTorquesEstimator estimator;
    std::vector<std::string> joints;
    std::vector<VectorDynSize> positions, velocities, accelerations;
    std::vector<SensorsMeasurements> readings;
    std::unique_ptr<LinkUnknownWrenchContacts> unknowns;
    LinkContactWrenches contacts;
    JointDOFsDoubleArray torques;
    FrameIndex base;
    Vector3 gravity;

    Estimation(const Model& model, const States& states_)
        : states(states_)
    {
        must(estimator.setModel(model));
        const SensorsList& sensors = estimator.model().sensors();
        joints = jointNames(estimator.model());
        if (sensors.getNrOfSensors(SIX_AXIS_FORCE_TORQUE) != states.sensors.size())
            fail("iDynTree finds another number of F/T sensors");
        for (const State& state : states.states)
        {
            VectorDynSize q(joints.size()), dq(joints.size()), ddq(joints.size());
            setJoints(q, state.position, joints, states);
            setJoints(dq, state.velocity, joints, states);
            setJoints(ddq, state.acceleration, joints, states);
            positions.push_back(q);
            velocities.push_back(dq);
            accelerations.push_back(ddq);
            SensorsMeasurements measured(sensors);
            for (std::size_t number = 0; number < states.sensors.size(); ++number)
            {
                Wrench reading;
                for (int axis = 0; axis < 3; ++axis)
                {
                    reading(axis) = state.readings[number][0][axis];
                    reading(3 + axis) = state.readings[number][1][axis];
                }
                std::ptrdiff_t index = -1;
                must(sensors.getSensorIndex(SIX_AXIS_FORCE_TORQUE, states.sensors[number], index));
                must(measured.setMeasurement(SIX_AXIS_FORCE_TORQUE, index, reading));
            }
            readings.push_back(measured);
        }
        unknowns = std::make_unique<LinkUnknownWrenchContacts>(estimator.model());
        std::set<std::size_t> pieces;
        for (const std::string& name : states.contacts)
        {
            const FrameIndex frame = estimator.model().getFrameIndex(name);
            must(unknowns->addNewUnknownFullWrenchInFrameOrigin(estimator.model(), frame));
            pieces.insert(
                estimator.submodels().getSubModelOfLink(estimator.model().getFrameLink(frame)));
        }
        if (pieces.size() != states.contacts.size()
            || pieces.size() != estimator.submodels().getNrOfSubModels())
            fail("not one contact in every sub-model");
        contacts.resize(estimator.model());
        torques.resize(estimator.model());
        // The URDF's root, as in the other programs.
        base = estimator.model().getDefaultBaseLink();
        for (int axis = 0; axis < 3; ++axis)
            gravity(axis) = states.gravity[axis];
    }

    void run(std::size_t k)
    {
        must(estimator.updateKinematicsFromFixedBase(
            positions[k], velocities[k], accelerations[k], base, gravity));
        must(estimator.estimateExtWrenchesAndJointTorques(
            *unknowns, readings[k], contacts, torques));
    }

    void show(Output& output) const
    {
        for (std::size_t joint = 0; joint < joints.size(); ++joint)
            output.add("torque", joints[joint], torques(joint));
        for (const std::string& name : states.contacts)
        {
            const LinkIndex link
                = estimator.model().getFrameLink(estimator.model().getFrameIndex(name));
            const Wrench& wrench = contacts.contactWrench(link, 0).contactWrench();
            output.add3("force", name, toEigen(wrench.getLinearVec3()));
            output.add3("moment", name, toEigen(wrench.getAngularVec3()));
        }
    }
};

} // namespace

int main(int count, char** arguments)
{
    if (count != 3)
        fail("usage: peers-idyntree robot.urdf states.txt");
    const States states(arguments[2]);
    // The first model merges links at all fixed joints. The second keeps the joints of the F/T
    // sensors, which is iDynTree's own choice.
    ModelLoader folding, loader;
    must(folding.loadReducedModelFromFile(arguments[1], states.joints));
    must(loader.loadModelFromFile(arguments[1]));

    LowLevel folded(folding.model(), states, false);
    LowLevel foldedFloating(folding.model(), states, true);
    LowLevel keptFloating(loader.model(), states, true);
    Estimation estimation(loader.model(), states);

    peers::serve(
        states.states.size(),
        {
            {"kinematics", [&](std::size_t k) { folded.kinematics(k); },
             [&](Output& o) { folded.showKinematics(o); }},
            {"rnea", [&](std::size_t k) { folded.inverseDynamics(k); },
             [&](Output& o) { folded.showInverseDynamics(o); }},
            {"rnea_floating", [&](std::size_t k) { foldedFloating.inverseDynamics(k); },
             [&](Output& o) { foldedFloating.showInverseDynamics(o); }},
            {"regressor_33", [&](std::size_t k) { foldedFloating.regress(k); },
             [&](Output& o) { foldedFloating.showRegressor(o); }},
            {"regressor_39", [&](std::size_t k) { keptFloating.regress(k); },
             [&](Output& o) { keptFloating.showRegressor(o); }},
            {"cycle", [&](std::size_t k) { estimation.run(k); },
             [&](Output& o) { estimation.show(o); }},
        });
}
