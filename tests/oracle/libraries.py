"""MuJoCo, Pinocchio and iDynTree behind one convention, for any robot given as a URDF.

They compute inverse dynamics, sensor readings, regressors and the blocks of the equation of motion.

The answers of all libraries have these conventions: SI units; force (or linear part) first in
6-vectors and rows; a joint torque is along the URDF axis, exerted by the parent on the child;
joints in the order of the URDF. The *root* is that of the URDF. `generalised` velocities and forces
are [linear part of the root, angular part of the root; joints], 6 + n numbers, the root's parts in
root axes at its origin. README.md defines what F/T sensors and IMUs read.
"""

import importlib.metadata
import pathlib
import xml.etree.ElementTree as ElementTree

import idyntree.swig as idyntree
import mujoco
import numpy as np
import pinocchio

REQUIREMENTS = pathlib.Path(__file__).with_name("requirements.txt")


def must(holds, what):
    """Ends the program unless `holds`. (`python -O` would skip an `assert` and the calls in it.)"""
    if not holds:
        raise SystemExit(what)


def pinned():
    """The packages that make the golden files, with their versions from requirements.txt."""
    return dict(line.split("==") for line in REQUIREMENTS.read_text().split())


def made_with():
    """The same packages with the installed versions. Every JSON file contains this."""
    return {package: importlib.metadata.version(package) for package in pinned()}


def rotation_of(rpy):
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def origin_of(element):
    """Pose (rotation, translation) of an element's <origin>."""
    origin = None if element is None else element.find("origin")
    numbers = lambda key: (
        np.array([float(x) for x in (origin.get(key) or "0 0 0").split()])
        if origin is not None
        else np.zeros(3)
    )
    return rotation_of(numbers("rpy")), numbers("xyz")


def move_wrench(wrench, rotation, translation):
    """Moves a wrench from the origin and axes of b to those of a.

    (rotation, translation) is the pose of b in a.
    """
    force = rotation @ wrench[:3]
    return np.concatenate([force, rotation @ wrench[3:] + np.cross(translation, force)])


class Sensor:
    """An F/T sensor: name, joint, the joint's links, measurement frame in the child, and sign."""

    def __init__(self, name, joint, parent, child, frame, direction, origin, own):
        self.name, self.joint, self.parent, self.child = name, joint, parent, child
        if frame == "child":
            self.rotation, self.translation = np.eye(3), np.zeros(3)
        elif frame == "parent":
            self.rotation, self.translation = origin[0].T, -origin[0].T @ origin[1]
        else:
            self.rotation, self.translation = own
        # The sign is relative to the wrench by the parent on the child.
        self.sign = -1.0 if direction == "child_to_parent" else 1.0

    def reading(self, by_parent_on_child):
        """What it reads, from the wrench at the origin and in the axes of the child."""
        return self.sign * move_wrench(
            by_parent_on_child, self.rotation.T, -self.rotation.T @ self.translation
        )


class Robot:
    """A URDF: its text without shapes and friction, its names, limits and sensors."""

    def __init__(self, path, imu_frame):
        self.path, self.imu = path, imu_frame
        tree = ElementTree.parse(path).getroot()
        for link in tree.findall("link"):
            # Shapes are in other files, which may be missing.
            for shape in link.findall("visual") + link.findall("collision"):
                link.remove(shape)
        for joint in tree.findall("joint"):
            # Joint torques are on the link side, where there is no friction.
            for dynamics in joint.findall("dynamics"):
                joint.remove(dynamics)
        self.text = ElementTree.tostring(tree, encoding="unicode")
        joints = {j.get("name"): j for j in tree.findall("joint")}
        self.links = [link.get("name") for link in tree.findall("link")]
        self.joints = [name for name, j in joints.items() if j.get("type") != "fixed"]
        children = {j.find("child").get("link") for j in joints.values()}
        (self.root,) = [link for link in self.links if link not in children]
        self.sensors = []
        for element in tree.findall("sensor"):
            if element.get("type") != "force_torque":
                continue
            name = element.find("parent").get("joint")
            facts = element.find("force_torque")
            text = lambda tag, default: facts.findtext(tag, default).strip()
            parent, child = (joints[name].find(role).get("link") for role in ("parent", "child"))
            self.sensors.append(
                Sensor(
                    element.get("name"),
                    name,
                    parent,
                    child,
                    text("frame", "child"),
                    text("measure_direction", "child_to_parent"),
                    origin_of(joints[name]),
                    origin_of(element),
                )
            )
        # A body is a group of links that move together, named after the link that its joint moves.
        moved = {s.joint for s in self.sensors} | set(self.joints)
        self.bodies = [self.root] + [
            j.find("child").get("link") for name, j in joints.items() if name in moved
        ]
        self.limits = {
            name: (float(j.find("limit").get("lower")), float(j.find("limit").get("upper")))
            for name, j in joints.items()
            if j.get("type") in ("revolute", "prismatic")
        }

    def random_position(self, random):
        """Positions within the limits, or within +-3 for a joint without limits."""
        return np.array(
            [random.uniform(*self.limits.get(joint, (-3.0, 3.0))) for joint in self.joints]
        )


class MuJoCo:
    """`mj_inverse`, MuJoCo's own sensors for F/T and IMU, `mj_fullM` and `mj_jac`."""

    def __init__(self, robot, floating):
        root = ElementTree.fromstring(robot.text)
        extension = ElementTree.SubElement(root, "mujoco")
        # Keep static bodies: MuJoCo can only measure the wrench in an F/T joint if its child
        # remains a separate body.
        ElementTree.SubElement(
            extension,
            "compiler",
            fusestatic="false",
            discardvisual="true",
            balanceinertia="false",
            boundmass="0",
            boundinertia="0",
        )
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        kinds = mujoco.mjtSensor

        def sense(name, kind, site):
            spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)

        for sensor in robot.sensors:
            quaternion = np.zeros(4)
            mujoco.mju_mat2Quat(quaternion, sensor.rotation.ravel())
            spec.body(sensor.child).add_site(
                name=sensor.name, pos=sensor.translation, quat=quaternion
            )
            sense("force " + sensor.name, kinds.mjSENS_FORCE, sensor.name)
            sense("torque " + sensor.name, kinds.mjSENS_TORQUE, sensor.name)
        spec.body(robot.imu).add_site(name="imu")
        sense("a", kinds.mjSENS_ACCELEROMETER, "imu")
        sense("g", kinds.mjSENS_GYRO, "imu")
        sense("al", kinds.mjSENS_FRAMEANGACC, "imu")
        if floating:
            spec.body(robot.root).add_freejoint()
        disable = mujoco.mjtDisableBit
        spec.option.disableflags = int(
            disable.mjDSBL_CONSTRAINT
            | disable.mjDSBL_CONTACT
            | disable.mjDSBL_LIMIT
            | disable.mjDSBL_FRICTIONLOSS
            | disable.mjDSBL_SPRING
            | disable.mjDSBL_DAMPER
        )
        self.robot, self.floating = robot, floating
        self.model = spec.compile()
        own = (self.model.dof_armature, self.model.dof_damping, self.model.dof_frictionloss)
        must(not any(values.any() for values in own), "MuJoCo: a joint has armature or friction")
        self.data = mujoco.MjData(self.model)
        ids = [self.model.joint(j).id for j in robot.joints]
        self.q_index = self.model.jnt_qposadr[ids]
        self.v_index = self.model.jnt_dofadr[ids]

    def _set(self, q, dq, ddq, gravity, base):
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        model.opt.gravity[:] = gravity
        data.qpos[self.q_index], data.qvel[self.v_index], data.qacc[self.v_index] = q, dq, ddq
        if self.floating:
            rotation, velocity, acceleration, omega, alpha = base
            mujoco.mju_mat2Quat(data.qpos[3:7], rotation.ravel())
            # A free joint of MuJoCo has its linear part in world axes, its angular part in body
            # axes.
            data.qvel[:3], data.qvel[3:6] = rotation @ velocity, omega
            data.qacc[:3], data.qacc[3:6] = rotation @ acceleration, alpha

    def _generalised(self, force):
        """Converts a generalised force from MuJoCo's order and axes."""
        joints = force[self.v_index]
        if not self.floating:
            return joints
        rotation = self.data.body(self.robot.root).xmat.reshape(3, 3)
        return np.concatenate([rotation.T @ force[:3], force[3:6], joints])

    def solve(self, q, dq, ddq, gravity, wrenches=(), base=None):
        """Torques, F/T and IMU readings, and with a floating root the wrench that it needs.

        `base`: (rotation of root in world, velocity, classical acceleration, angular velocity,
        angular acceleration), in root axes. `wrenches`: (link, wrench at its origin in its axes).
        """
        model, data = self.model, self.data
        self._set(q, dq, ddq, gravity, base)
        applied = np.zeros(model.nv)
        if wrenches:
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
        for link, wrench in wrenches:
            body = model.body(link).id
            turn = data.xmat[body].reshape(3, 3)
            force, torque = turn @ wrench[:3], turn @ wrench[3:]
            mujoco.mj_applyFT(model, data, force, torque, data.xpos[body], body, applied)
            # xfrc_applied acts at the centre of mass. The F/T sensors include it, but the
            # generalised forces of mj_inverse do not.
            data.xfrc_applied[body, :3] += force
            data.xfrc_applied[body, 3:] += torque + np.cross(
                data.xpos[body] - data.xipos[body], force
            )
        mujoco.mj_inverse(model, data)
        total = self._generalised(data.qfrc_inverse - applied)
        imu = data.site("imu").xmat.reshape(3, 3)
        read = lambda name: data.sensor(name).data.copy()
        # MuJoCo's force sensor gives the force by the parent on the child.
        readings = [
            s.sign * np.concatenate([read("force " + s.name), read("torque " + s.name)])
            for s in self.robot.sensors
        ]
        answer = {
            "torque": total[-len(self.robot.joints) :],
            "ft": np.concatenate(readings),
            "imu": np.concatenate([read("a"), read("g"), imu.T @ read("al")]),
        }
        if self.floating:
            answer["base"] = total[:6]
        return answer

    def blocks(self, q, dq, omega, base):
        """Mass matrix, bias and Jacobian of a link, for a floating root with its origin at rest.

        The bias is the generalised force due to the velocities, without gravity or acceleration.
        """
        model, data = self.model, self.data
        zeros = np.zeros(len(q))
        rotation = rotation_of([0.4, -0.7, 2.0])
        self._set(
            q, dq, zeros, np.zeros(3), (rotation, np.zeros(3), np.zeros(3), omega, np.zeros(3))
        )
        mujoco.mj_forward(model, data)
        # Converts generalised velocities to MuJoCo's.
        to_own = np.zeros((model.nv, model.nv))
        to_own[:3, :3], to_own[3:6, 3:6] = rotation, np.eye(3)
        to_own[self.v_index, 6 + np.arange(len(q))] = 1.0
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacBody(model, data, linear, angular, model.body(base).id)
        turn = data.body(base).xmat.reshape(3, 3)
        return {
            "mass": to_own.T @ mass @ to_own,
            "bias": to_own.T @ data.qfrc_bias,
            "jacobian": np.vstack([turn.T @ linear, turn.T @ angular]) @ to_own,
        }


class Pinocchio:
    """`rnea`, `crba`, regressor and frame Jacobians, with a free-flying root.

    An F/T joint becomes a revolute joint held at zero, because Pinocchio only keeps the forces of
    moving joints.
    """

    def __init__(self, robot):
        root = ElementTree.fromstring(robot.text)
        sensed = {s.joint for s in robot.sensors}
        for joint in root.findall("joint"):
            if joint.get("name") in sensed:
                joint.set("type", "revolute")
                ElementTree.SubElement(joint, "axis", xyz="1 0 0")
                ElementTree.SubElement(
                    joint, "limit", lower="-1", upper="1", effort="1", velocity="1"
                )
        self.robot = robot
        self.model = pinocchio.buildModelFromXML(
            ElementTree.tostring(root, encoding="unicode"), pinocchio.JointModelFreeFlyer()
        )
        self.data = self.model.createData()
        self.v_index = [self.model.joints[self.model.getJointId(j)].idx_v for j in robot.joints]
        self.kept = [*range(6), *self.v_index]

    def _state(self, q, dq, ddq, base):
        model = self.model
        rotation, velocity, acceleration, omega, alpha = (
            base if base else (np.eye(3), *np.zeros((4, 3)))
        )
        x, v, a = pinocchio.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        x[3:7] = pinocchio.Quaternion(rotation).coeffs()
        for name, angle in zip(self.robot.joints, q):
            joint = model.joints[model.getJointId(name)]
            # The position of a continuous joint is a point on the unit circle.
            x[joint.idx_q : joint.idx_q + joint.nq] = (
                angle if joint.nq == 1 else (np.cos(angle), np.sin(angle))
            )
        v[self.v_index], a[self.v_index] = dq, ddq
        v[:3], v[3:6] = velocity, omega
        # The spatial acceleration of the free flyer in its own axes is the classical acceleration
        # minus omega x velocity.
        a[:3], a[3:6] = acceleration - np.cross(omega, velocity), alpha
        return x, v, a

    def solve(self, q, dq, ddq, gravity, wrenches=(), base=None):
        model, data = self.model, self.data
        model.gravity.linear = np.asarray(gravity)
        x, v, a = self._state(q, dq, ddq, base)
        forces = pinocchio.StdVec_Force()
        for _ in range(model.njoints):
            forces.append(pinocchio.Force.Zero())
        for link, wrench in wrenches:
            frame = model.frames[model.getFrameId(link)]
            forces[frame.parentJoint] = forces[frame.parentJoint] + frame.placement.act(
                pinocchio.Force(np.asarray(wrench))
            )
        tau = pinocchio.rnea(model, data, x, v, a, forces)
        readings = [s.reading(data.f[model.getJointId(s.joint)].vector) for s in self.robot.sensors]
        pinocchio.forwardKinematics(model, data, x, v, a)
        pinocchio.updateFramePlacements(model, data)
        return {
            "torque": tau[self.v_index],
            "ft": np.concatenate(readings),
            "base": tau[:6].copy(),
            "imu": self._felt(self.robot.imu, gravity),
        }

    def _felt(self, link, gravity):
        """What an IMU at a link's origin reads. Call forward kinematics first."""
        model, data, local = self.model, self.data, pinocchio.ReferenceFrame.LOCAL
        frame = model.getFrameId(link)
        turn = data.oMf[frame].rotation
        classical = pinocchio.getFrameClassicalAcceleration(model, data, frame, local).linear
        return np.concatenate(
            [
                classical - turn.T @ np.asarray(gravity),
                pinocchio.getFrameVelocity(model, data, frame, local).angular,
                pinocchio.getFrameAcceleration(model, data, frame, local).angular,
            ]
        )

    def root_motion(self, q, dq, ddq, link, motion):
        """Motion of the root from the motion of another link.

        A motion is proper acceleration, angular velocity and angular acceleration, nine numbers.
        """
        proper, omega, alpha = motion[:3], motion[3:6], motion[6:]
        still = np.zeros(3)
        x, v, _ = self._state(q, dq, ddq, None)
        jacobian = self.jacobian(x, link)
        to_root = base_change(jacobian)
        velocity = to_root @ np.concatenate([still, omega, dq])
        _, v, a = self._state(
            q,
            dq,
            np.zeros(len(q)),
            (np.eye(3), velocity[:3], np.cross(velocity[3:6], velocity[:3]), velocity[3:6], still),
        )
        # Without gravity the proper acceleration is the classical one. The link's origin is at
        # rest, so its classical acceleration equals its spatial one.
        pinocchio.forwardKinematics(self.model, self.data, x, v, a)
        bias = pinocchio.getFrameAcceleration(
            self.model, self.data, self.model.getFrameId(link), pinocchio.ReferenceFrame.LOCAL
        ).vector
        acceleration = to_root @ np.concatenate([np.concatenate([proper, alpha]) - bias, ddq])
        return np.concatenate(
            [
                acceleration[:3] + np.cross(velocity[3:6], velocity[:3]),
                velocity[3:6],
                acceleration[3:6],
            ]
        )

    def jacobian(self, x, link):
        frame = self.model.getFrameId(link)
        return pinocchio.computeFrameJacobian(
            self.model, self.data, x, frame, pinocchio.ReferenceFrame.LOCAL
        )[:, self.kept]

    def regressor(self, q, dq, ddq, gravity, base):
        """The regressor of the wrench on the root and the joint torques, (6 + n) x 10 bodies.

        The columns of a body are in the order [m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz].
        """
        self.model.gravity.linear = np.asarray(gravity)
        x, v, a = self._state(q, dq, ddq, base)
        whole = pinocchio.computeJointTorqueRegressor(self.model, self.data, x, v, a)[self.kept]
        # Pinocchio's order of the inertia tensor is [xx, xy, yy, xz, yz, zz].
        order = np.array([0, 1, 2, 3, 4, 5, 7, 6, 8, 9])
        of_body = {}
        for body in self.robot.bodies:
            frame = self.model.frames[self.model.getFrameId(body)]
            must(
                np.allclose(frame.placement.homogeneous, np.eye(4), atol=1e-15),
                f"Pinocchio: the frame of {body} is not that of its joint",
            )
            of_body[body] = whole[:, 10 * (frame.parentJoint - 1) + order]
        return np.hstack([of_body[body] for body in self.robot.bodies])

    def blocks(self, q, dq, omega):
        zeros = np.zeros(len(q))
        x, v, a = self._state(
            q, dq, zeros, (np.eye(3), np.zeros(3), np.zeros(3), omega, np.zeros(3))
        )
        self.model.gravity.linear = np.zeros(3)
        bias = pinocchio.nonLinearEffects(self.model, self.data, x, v)[self.kept]
        mass = pinocchio.crba(self.model, self.data, x)
        mass = np.triu(mass) + np.triu(mass, 1).T
        return {
            "mass": mass[np.ix_(self.kept, self.kept)],
            "bias": bias,
        }


class IDynTree:
    """`ExtWrenchesAndJointTorquesEstimator` and `KinDynComputations`.

    The former reads the URDF's <sensor> elements. It needs no gravity, because its kinematics start
    from the proper acceleration of any frame.
    """

    def __init__(self, robot):
        self.robot = robot
        self.estimator = idyntree.ExtWrenchesAndJointTorquesEstimator()
        # The whole model, because with a reduced one iDynTree does not find the parent link of an
        # F/T joint if that link is a massless frame.
        must(
            self.estimator.loadModelAndSensorsFromFile(str(robot.path)),
            f"iDynTree: cannot load {robot.path}",
        )
        self.model = self.estimator.model()
        must(
            self.model.getNrOfDOFs() == len(robot.joints),
            "iDynTree: not the same joints as in the URDF",
        )
        self.offsets = [
            self.model.getJoint(self.model.getJointIndex(j)).getDOFsOffset() for j in robot.joints
        ]
        self.kindyn = {}

    def _own_order(self, values):
        own = np.zeros(len(values))
        own[self.offsets] = values
        return own

    def _start(self, q, dq, ddq, proper_acceleration, omega, alpha, frame):
        def dofs(kind, values):
            array = kind(self.model)
            for offset, value in zip(self.offsets, values):
                array.setVal(offset, float(value))
            return array

        vector = lambda values: idyntree.Vector3(np.asarray(values, dtype=float))
        done = self.estimator.updateKinematicsFromFloatingBase(
            dofs(idyntree.JointPosDoubleArray, q),
            dofs(idyntree.JointDOFsDoubleArray, dq),
            dofs(idyntree.JointDOFsDoubleArray, ddq),
            self.model.getFrameIndex(frame),
            vector(proper_acceleration),
            vector(omega),
            vector(alpha),
        )
        must(done, f"iDynTree: kinematics from {frame} fail")

    def _contacts(self, contacts):
        """iDynTree's contacts, from (frame, kind, position, more).

        `more` is the direction of a force, or a known wrench at the frame's origin.
        """
        unknowns = idyntree.LinkUnknownWrenchContacts(self.model)
        kinds = {
            "wrench": idyntree.FULL_WRENCH,
            "force": idyntree.PURE_FORCE,
            "force_along": idyntree.PURE_FORCE_WITH_KNOWN_DIRECTION,
            "known": idyntree.NO_UNKNOWNS,
        }
        for frame, kind, position, more in contacts:
            contact = idyntree.UnknownWrenchContact()
            contact.unknownType = kinds[kind]
            contact.contactPoint = idyntree.Position(*(float(x) for x in position))
            if kind == "force_along":
                contact.forceDirection = idyntree.Direction(*(float(x) for x in more))
            if kind == "known":
                must(not np.any(position), f"a known wrench on {frame} is not at its origin")
                # Give it at the link's origin: addNewContactInFrame of iDynTree 15.1 moves a known
                # wrench to the link's origin twice, so that its force acts with twice the lever
                # arm.
                number, rotation, translation = self._frame(frame)
                wrench = idyntree.Wrench()
                for index, value in enumerate(
                    move_wrench(np.asarray(more, dtype=float), rotation, translation)
                ):
                    wrench.setVal(index, float(value))
                contact.knownWrench = wrench
                frame = self.model.getLinkName(number)
            must(
                unknowns.addNewContactInFrame(self.model, self.model.getFrameIndex(frame), contact),
                f"iDynTree: cannot add a contact on {frame}",
            )
        return unknowns

    def _frame(self, name):
        """The link that a frame is fixed to, and its pose there."""
        index = self.model.getFrameIndex(name)
        pose = self.model.getFrameTransform(index)
        rotation = np.array([[pose.getRotation().getVal(i, j) for j in range(3)] for i in range(3)])
        translation = np.array([pose.getPosition().getVal(i) for i in range(3)])
        return self.model.getFrameLink(index), rotation, translation

    def _answer(self, contacts, found, torques):
        """Torques, and the contacts' wrenches, each at the origin and in the axes of its frame."""
        met, wrenches = {}, []
        for frame, *_ in contacts:
            link, rotation, translation = self._frame(frame)
            number = met.get(link, 0)
            met[link] = number + 1
            contact = found.contactWrench(link, number)
            # iDynTree gives the wrench about the contact's point, in the link's axes.
            point = np.array([contact.contactPoint.getVal(i) for i in range(3)])
            wrench = np.array([contact.contactWrench.getVal(i) for i in range(6)])
            wrenches.append(move_wrench(wrench, rotation.T, rotation.T @ (point - translation)))
        return {
            "torque": np.array([torques.getVal(offset) for offset in self.offsets]),
            "contact": np.concatenate(wrenches or [np.zeros(0)]),
        }

    def solve(self, q, dq, ddq, motion, wrenches=(), frame=None, held=None):
        """Torques and expected readings from the motion of `frame`.

        The only unknown is a full wrench on `held`. Both links are the root by default.
        """
        frame, held = frame or self.robot.root, held or self.robot.root
        self._start(q, dq, ddq, motion[:3], motion[3:6], motion[6:], frame)
        contacts = [(held, "wrench", np.zeros(3), None)]
        contacts += [(link, "known", np.zeros(3), wrench) for link, wrench in wrenches]
        sensors = self.estimator.sensors()
        measured, found = (
            idyntree.SensorsMeasurements(sensors),
            idyntree.LinkContactWrenches(self.model),
        )
        torques = idyntree.JointDOFsDoubleArray(self.model)
        must(
            self.estimator.computeExpectedFTSensorsMeasurements(
                self._contacts(contacts), measured, found, torques
            ),
            "iDynTree: the prediction of readings fails",
        )
        readings = []
        for sensor in self.robot.sensors:
            reading = idyntree.Wrench()
            index = sensors.getSensorIndex(idyntree.SIX_AXIS_FORCE_TORQUE, sensor.name)
            must(
                index >= 0
                and measured.getMeasurement(idyntree.SIX_AXIS_FORCE_TORQUE, index, reading),
                f"iDynTree: no sensor {sensor.name}",
            )
            readings.append([reading.getVal(i) for i in range(6)])
        answer = self._answer(contacts, found, torques)
        return {
            "torque": answer["torque"],
            "ft": np.concatenate(readings),
            "base": answer["contact"][:6],
        }

    def estimate(self, q, dq, ddq, motion, frame, readings, contacts):
        """Torques and contact wrenches from F/T readings."""
        self._start(q, dq, ddq, motion[:3], motion[3:6], motion[6:], frame)
        sensors = self.estimator.sensors()
        measured, found = (
            idyntree.SensorsMeasurements(sensors),
            idyntree.LinkContactWrenches(self.model),
        )
        for number, sensor in enumerate(self.robot.sensors):
            reading = idyntree.Wrench()
            for i in range(6):
                reading.setVal(i, float(readings[6 * number + i]))
            index = sensors.getSensorIndex(idyntree.SIX_AXIS_FORCE_TORQUE, sensor.name)
            must(
                index >= 0
                and measured.setMeasurement(idyntree.SIX_AXIS_FORCE_TORQUE, index, reading),
                f"iDynTree: no sensor {sensor.name}",
            )
        torques = idyntree.JointDOFsDoubleArray(self.model)
        must(
            self.estimator.estimateExtWrenchesAndJointTorques(
                self._contacts(contacts), measured, found, torques
            ),
            "iDynTree: the estimation fails",
        )
        return self._answer(contacts, found, torques)

    def _set(self, base, q, dq, velocity, gravity, rotation):
        # One object per base: after a second setFloatingBase, iDynTree 15.1 leaves old values in
        # the mass matrix where it should be zero with the new base.
        if base not in self.kindyn:
            self.kindyn[base] = idyntree.KinDynComputations()
            must(
                self.kindyn[base].loadRobotModel(self.model)
                and self.kindyn[base].setFloatingBase(base),
                f"iDynTree: cannot use {base} as the base",
            )
            must(
                self.kindyn[base].setFrameVelocityRepresentation(
                    idyntree.BODY_FIXED_REPRESENTATION
                ),
                "iDynTree: cannot use body-fixed velocities",
            )
        pose = np.eye(4)
        pose[:3, :3] = rotation
        state = (
            pose,
            self._own_order(q),
            np.asarray(velocity),
            self._own_order(dq),
            np.asarray(gravity),
        )
        must(self.kindyn[base].setRobotState(*state), "iDynTree: cannot set the state")

    def regressor(self, base, q, dq, ddq, motion, gravity, rotation, velocity):
        """As Pinocchio's, but for the wrench on any link `base`, whose motion is `motion`.

        iDynTree does not merge links that have mass: the columns of a body are those of the link
        that it is named after.
        """
        omega = motion[3:6]
        self._set(base, q, dq, np.concatenate([velocity, omega]), gravity, rotation)
        acceleration = np.concatenate(
            [motion[:3] + rotation.T @ gravity - np.cross(omega, velocity), motion[6:]]
        )
        count = len(q)
        whole = idyntree.MatrixDynSize(6 + count, 10 * self.model.getNrOfLinks())
        own = idyntree.VectorDynSize(count)
        for index, value in enumerate(self._own_order(ddq)):
            own.setVal(index, float(value))
        base_acceleration = idyntree.Vector6()
        for index, value in enumerate(acceleration):
            base_acceleration.setVal(index, float(value))
        must(
            self.kindyn[base].inverseDynamicsInertialParametersRegressor(
                base_acceleration, own, whole
            ),
            "iDynTree: cannot compute the regressor",
        )
        rows = whole.toNumPy()[[*range(6), *(6 + offset for offset in self.offsets)]]
        return np.hstack(
            [rows[:, 10 * self.model.getLinkIndex(body) :][:, :10] for body in self.robot.bodies]
        )

    def blocks(self, base, q, dq, omega):
        """As the others', but for any base: velocities are [linear, angular part of it; joints]."""
        self._set(
            base,
            q,
            dq,
            np.concatenate([np.zeros(3), omega]),
            np.zeros(3),
            rotation_of([0.4, -0.7, 2.0]),
        )
        count = 6 + len(q)
        order = [*range(6), *(6 + offset for offset in self.offsets)]
        mass = idyntree.MatrixDynSize(count, count)
        must(
            self.kindyn[base].getFreeFloatingMassMatrix(mass),
            "iDynTree: cannot compute the mass matrix",
        )
        bias = idyntree.FreeFloatingGeneralizedTorques(self.model)
        must(self.kindyn[base].generalizedBiasForces(bias), "iDynTree: cannot compute the bias")
        wrench = [bias.baseWrench().getVal(i) for i in range(6)]
        return {
            "mass": mass.toNumPy()[np.ix_(order, order)],
            "bias": np.array(
                wrench + [bias.jointTorques().getVal(offset) for offset in self.offsets]
            ),
        }


def base_change(jacobian):
    """The change of base from the root to a link, from the link's Jacobian for the root.

    It is the matrix T that takes [velocity of the link; joint velocities] to [velocity of the root;
    joint velocities]. Mass matrices change to T' M T, forces to T' f, Jacobians to J T.
    """
    change = np.eye(jacobian.shape[1])
    inverse = np.linalg.inv(jacobian[:, :6])
    change[:6, :6], change[:6, 6:] = inverse, -inverse @ jacobian[:, 6:]
    return change


# ---------------------------------------------------------------- checks


def check_close(what, tolerance, first, second, columns=False):
    """Fails unless two arrays agree. Returns their difference.

    It is relative to their largest magnitude, with `columns` that of each column.
    """
    first, second = np.asarray(first), np.asarray(second)
    must(
        first.shape == second.shape and first.size > 0,
        f"{what}: cannot compare {first.shape} and {second.shape} numbers",
    )
    axis = 0 if columns else None
    gap = np.abs(first - second).max(axis=axis)
    scale = np.maximum(np.abs(first).max(axis=axis), np.abs(second).max(axis=axis))
    near = np.isfinite(gap).all() and (gap <= tolerance * scale).all()
    must(
        near,
        f"{what}: differ by {np.max(gap):.3e} "
        f"(largest magnitude {np.max(scale):.3e}, tolerance {tolerance:.0e} of it)",
    )
    return float(np.max(gap / np.where(scale > 0, scale, 1.0)))


def check_agreement(what, tolerance, first, second):
    """Fails unless two libraries agree on every quantity that both give. Returns the difference.

    A quantity is one vector, or an array with one row per instant.
    """
    shared, worst = sorted(first.keys() & second.keys()), 0.0
    must(shared, f"{what}: no quantity that both give")
    for name in shared:
        a, b = np.asarray(first[name]), np.asarray(second[name])
        # Forces and torques have separate scales: an error of 1e-3 Nm must not hide behind 70 N.
        parts = (
            [slice(None)]
            if name == "torque"
            else [slice(i, i + 3) for i in range(0, a.shape[-1], 3)]
        )
        for part in parts:
            worst = max(
                worst, check_close(f"{what}: {name}", tolerance, a[..., part], b[..., part])
            )
    return worst


def check_inertias(urdf, frames):
    """Checks the inertias of all links but `frames`, which have no mass. Returns the masses.

    Every inertia must be positive definite and obey the triangle inequality.
    """
    masses = {}
    for link in ElementTree.fromstring(urdf).findall("link"):
        name, inertial = link.get("name"), link.find("inertial")
        if inertial is None:
            must(name in frames, f"{name} has no mass")
            continue
        masses[name] = float(inertial.find("mass").get("value"))
        i = {key: float(value) for key, value in inertial.find("inertia").attrib.items()}
        matrix = np.array(
            [
                [i["ixx"], i["ixy"], i["ixz"]],
                [i["ixy"], i["iyy"], i["iyz"]],
                [i["ixz"], i["iyz"], i["izz"]],
            ]
        )
        principal = np.linalg.eigvalsh(matrix)
        must(
            masses[name] > 0 and principal[0] > 0 and principal[0] + principal[1] > principal[2],
            f"{name}: the inertia is not physical",
        )
    return masses
