"""Makes the golden files of this folder with MuJoCo, Pinocchio and iDynTree: dynamics that owe nothing to this project's own.

Usage: python generate.py [--out DIR]        (DIR: this file's folder by default; packages: requirements.txt)

The robot is config/icub_left_arm/model.urdf. Every number is computed by two or three of the libraries, each from the URDF by its own reader,
and the script fails if they disagree. README.md says what each file holds.

Conventions: SI; 6-vectors are force (or linear part) first; a joint torque is positive along the URDF axis, by the parent on the child; the F/T
reading is -(wrench by l_shoulder_3 on l_upper_arm) at l_upper_arm's origin in its axes; a contact wrench is by the environment on l_hand, at its
origin in its axes; an IMU measures its classical acceleration minus gravity, its angular velocity and acceleration, in its own axes.
"""

import argparse
import importlib.metadata
import json
import pathlib
import sys
import xml.etree.ElementTree as ElementTree

import idyntree.swig as idyntree
import mujoco
import numpy as np
import pinocchio

HERE = pathlib.Path(__file__).resolve().parent
URDF = HERE.parent.parent / "config" / "icub_left_arm" / "model.urdf"

SEED = 20150526
JOINTS = ["l_shoulder_pitch", "l_shoulder_roll", "l_shoulder_yaw", "l_elbow", "l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw"]
FT_JOINT, FT_LINK = "l_arm_ft_sensor", "l_upper_arm"
BASE, HAND, IMU_FRAME = "chest", "l_hand", "chest_imu_frame"
GRAVITY = np.array([0.0, 0.0, -9.80665])  # in chest axes [m/s^2]

DURATION_MS, STEP_MS = 10_000, 50
CASES = 30
CSV_TOLERANCE = 1e-9  # of the largest magnitude of a quantity, over the whole file
CASE_TOLERANCE = 1e-10  # of the largest magnitude of a quantity, in each case


# ---------------------------------------------------------------- the three libraries

class MuJoCo:
    """Inverse dynamics by `mj_inverse`; F/T and IMU by MuJoCo's own sensors."""

    def __init__(self, urdf, floating):
        root = ElementTree.fromstring(urdf)
        extension = ElementTree.SubElement(root, "mujoco")
        # Static bodies are kept: l_upper_arm must remain a body of its own for its parent's wrench to be seen.
        ElementTree.SubElement(
            extension, "compiler",
            fusestatic="false", discardvisual="true", balanceinertia="false", boundmass="0", boundinertia="0",
        )
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        for link in (FT_LINK, IMU_FRAME):
            spec.body(link).add_site(name=link)
        if floating:
            spec.body(BASE).add_freejoint()
        kinds = mujoco.mjtSensor
        self._sensors = {
            "force": (kinds.mjSENS_FORCE, FT_LINK), "torque": (kinds.mjSENS_TORQUE, FT_LINK),
            "a": (kinds.mjSENS_ACCELEROMETER, IMU_FRAME), "g": (kinds.mjSENS_GYRO, IMU_FRAME),
            "al": (kinds.mjSENS_FRAMEANGACC, IMU_FRAME),
        }
        for name, (kind, site) in self._sensors.items():
            spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)
        disable = mujoco.mjtDisableBit
        spec.option.disableflags = int(
            disable.mjDSBL_CONSTRAINT | disable.mjDSBL_CONTACT | disable.mjDSBL_LIMIT | disable.mjDSBL_FRICTIONLOSS
            | disable.mjDSBL_SPRING | disable.mjDSBL_DAMPER
        )
        self.floating = floating
        self.model = spec.compile()
        assert not self.model.dof_armature.any() and not self.model.dof_damping.any() and not self.model.dof_frictionloss.any()
        self.data = mujoco.MjData(self.model)
        ids = [self.model.joint(j).id for j in JOINTS]
        self.q_index = self.model.jnt_qposadr[ids]
        self.v_index = self.model.jnt_dofadr[ids]

    def solve(self, q, dq, ddq, gravity, contact=None, base=None):
        """`base`: (rotation of chest in world, velocity, classical acceleration, angular velocity, angular acceleration), chest axes."""
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        model.opt.gravity[:] = gravity
        data.qpos[self.q_index], data.qvel[self.v_index], data.qacc[self.v_index] = q, dq, ddq
        if self.floating:
            rotation, velocity, acceleration, omega, alpha = base
            mujoco.mju_mat2Quat(data.qpos[3:7], rotation.ravel())
            # MuJoCo's free joint: linear part in world axes, angular part in the body's.
            data.qvel[:3], data.qvel[3:6] = rotation @ velocity, omega
            data.qacc[:3], data.qacc[3:6] = rotation @ acceleration, alpha
        applied = np.zeros(model.nv)
        if contact is not None:
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            hand = model.body(HAND).id
            turn = data.xmat[hand].reshape(3, 3)
            force, torque = turn @ contact[:3], turn @ contact[3:]
            mujoco.mj_applyFT(model, data, force, torque, data.xpos[hand], hand, applied)
            # xfrc_applied acts at the centre of mass; the F/T sensor sees it, mj_inverse's generalised forces do not.
            data.xfrc_applied[hand, :3] = force
            data.xfrc_applied[hand, 3:] = torque + np.cross(data.xpos[hand] - data.xipos[hand], force)
        mujoco.mj_inverse(model, data)
        total = data.qfrc_inverse - applied
        imu = data.site(IMU_FRAME).xmat.reshape(3, 3)
        read = lambda name: data.sensor(name).data.copy()
        answer = {
            "torque": total[self.v_index],
            # MuJoCo's force sensor gives what the parent exerts on the child.
            "ft": -np.concatenate([read("force"), read("torque")]),
            "imu": np.concatenate([read("a"), read("g"), imu.T @ read("al")]),
        }
        if self.floating:
            rotation = data.body(BASE).xmat.reshape(3, 3)
            answer["base"] = np.concatenate([rotation.T @ total[:3], total[3:6]])
        return answer


class Pinocchio:
    """Inverse dynamics by `rnea` on a free-flying chest; the F/T joint is a revolute joint held at zero, so that its force is kept."""

    def __init__(self, urdf):
        root = ElementTree.fromstring(urdf)
        joint = next(j for j in root.iter("joint") if j.get("name") == FT_JOINT and j.get("type"))
        joint.set("type", "revolute")
        ElementTree.SubElement(joint, "axis", xyz="1 0 0")
        ElementTree.SubElement(joint, "limit", lower="-1", upper="1", effort="1", velocity="1")
        self.model = pinocchio.buildModelFromXML(ElementTree.tostring(root, encoding="unicode"), pinocchio.JointModelFreeFlyer())
        self.data = self.model.createData()
        joints = [self.model.joints[self.model.getJointId(j)] for j in JOINTS]
        self.q_index, self.v_index = [j.idx_q for j in joints], [j.idx_v for j in joints]
        self.imu = self.model.getFrameId(IMU_FRAME)

    def solve(self, q, dq, ddq, gravity, contact=None, base=None):
        model, data = self.model, self.data
        model.gravity.linear = np.asarray(gravity)
        rotation, velocity, acceleration, omega, alpha = base if base else (np.eye(3), *np.zeros((4, 3)))
        x, v, a = pinocchio.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        x[3:7] = pinocchio.Quaternion(rotation).coeffs()
        x[self.q_index], v[self.v_index], a[self.v_index] = q, dq, ddq
        v[:3], v[3:6] = velocity, omega
        # Spatial acceleration of the free flyer in its own axes = classical acceleration - omega x velocity.
        a[:3], a[3:6] = acceleration - np.cross(omega, velocity), alpha
        forces = pinocchio.StdVec_Force()
        for _ in range(model.njoints):
            forces.append(pinocchio.Force.Zero())
        if contact is not None:
            forces[model.getJointId("l_wrist_yaw")] = pinocchio.Force(np.asarray(contact))
        tau = pinocchio.rnea(model, data, x, v, a, forces)
        by_parent = data.f[model.getJointId(FT_JOINT)].vector.copy()
        pinocchio.forwardKinematics(model, data, x, v, a)
        pinocchio.updateFramePlacements(model, data)
        local = pinocchio.ReferenceFrame.LOCAL
        turn = data.oMf[self.imu].rotation
        classical = pinocchio.getFrameClassicalAcceleration(model, data, self.imu, local).linear
        return {
            "torque": tau[self.v_index],
            "ft": -by_parent,
            "base": tau[:6].copy(),
            "imu": np.concatenate([
                classical - turn.T @ np.asarray(gravity),
                pinocchio.getFrameVelocity(model, data, self.imu, local).angular,
                pinocchio.getFrameAcceleration(model, data, self.imu, local).angular,
            ]),
        }


class IDynTree:
    """`ExtWrenchesAndJointTorquesEstimator`'s expected measurements, with an unknown wrench on chest. Needs no gravity: kinematics start from the
    proper acceleration of any frame, the chest's or the IMU's. Reads the URDF's <sensor> element."""

    def __init__(self, path):
        self.estimator = idyntree.ExtWrenchesAndJointTorquesEstimator()
        self.path = str(path)
        if not self.estimator.loadModelAndSensorsFromFileWithSpecifiedDOFs(self.path, JOINTS):
            raise SystemExit(f"iDynTree cannot load {path}")
        self.model = self.estimator.model()
        assert self.model.getNrOfDOFs() == len(JOINTS)

    def solve(self, q, dq, ddq, proper_acceleration, omega, alpha, contact=None, frame=BASE):
        def dofs(kind, values):
            array = kind(self.model)
            for index, joint in enumerate(JOINTS):
                array.setVal(self.model.getJoint(self.model.getJointIndex(joint)).getDOFsOffset(), float(values[index]))
            return array

        vector = lambda values: idyntree.Vector3(np.asarray(values, dtype=float))
        ok = self.estimator.updateKinematicsFromFloatingBase(
            dofs(idyntree.JointPosDoubleArray, q), dofs(idyntree.JointDOFsDoubleArray, dq), dofs(idyntree.JointDOFsDoubleArray, ddq),
            self.model.getFrameIndex(frame), vector(proper_acceleration), vector(omega), vector(alpha),
        )
        assert ok
        unknowns = idyntree.LinkUnknownWrenchContacts(self.model)
        unknowns.addNewUnknownFullWrenchInFrameOrigin(self.model, self.model.getFrameIndex(BASE))
        if contact is not None:
            known = idyntree.UnknownWrenchContact()
            known.unknownType = idyntree.NO_UNKNOWNS
            known.contactPoint = idyntree.Position.Zero()
            wrench = idyntree.Wrench()
            for index in range(6):
                wrench.setVal(index, float(contact[index]))
            known.knownWrench = wrench
            unknowns.addNewContactInFrame(self.model, self.model.getFrameIndex(HAND), known)
        sensors = self.estimator.sensors()
        measured = idyntree.SensorsMeasurements(sensors)
        contacts = idyntree.LinkContactWrenches(self.model)
        torques = idyntree.JointDOFsDoubleArray(self.model)
        assert self.estimator.computeExpectedFTSensorsMeasurements(unknowns, measured, contacts, torques)
        ft = idyntree.Wrench()
        index = sensors.getSensorIndex(idyntree.SIX_AXIS_FORCE_TORQUE, FT_JOINT)
        assert index >= 0 and measured.getMeasurement(idyntree.SIX_AXIS_FORCE_TORQUE, index, ft)
        base = contacts.contactWrench(self.model.getLinkIndex(BASE), 0).contactWrench
        offsets = [self.model.getJoint(self.model.getJointIndex(j)).getDOFsOffset() for j in JOINTS]
        return {
            "torque": np.array([torques.getVal(offset) for offset in offsets]),
            "ft": np.array([ft.getVal(i) for i in range(6)]),
            "base": np.array([base.getVal(i) for i in range(6)]),
        }


# ---------------------------------------------------------------- checks

def check_agreement(what, tolerance, first, second):
    """Fails unless two libraries agree on every quantity that both give (arrays: one row per instant, or one vector)."""
    worst = 0.0
    for name in sorted(first.keys() & second.keys()):
        a, b = np.asarray(first[name]), np.asarray(second[name])
        # Forces and torques are scaled apart: a torque of 1e-3 Nm must not hide behind 70 N.
        parts = [slice(0, 3), slice(3, 6), slice(6, 9)] if name != "torque" else [slice(None)]
        for part in parts:
            if a[..., part].size == 0:
                continue
            scale = max(np.abs(a[..., part]).max(), np.abs(b[..., part]).max())
            gap = np.abs(a[..., part] - b[..., part]).max()
            if not np.isfinite(gap) or gap > tolerance * scale:
                raise SystemExit(f"{what}: {name} differs by {gap:.3e} (largest magnitude {scale:.3e}, allowed {tolerance:.0e} of it)")
            worst = max(worst, gap / scale if scale else 0.0)
    return worst


def check_inertias(urdf):
    """Every link has mass, but the massless frames; every inertia is positive definite and obeys the triangle inequality. Returns the masses."""
    masses = {}
    for link in ElementTree.fromstring(urdf).findall("link"):
        name, inertial = link.get("name"), link.find("inertial")
        if inertial is None:
            assert name in (IMU_FRAME, "l_hand_palm"), f"{name} has no mass"
            continue
        masses[name] = float(inertial.find("mass").get("value"))
        i = {key: float(value) for key, value in inertial.find("inertia").attrib.items()}
        matrix = np.array([
            [i["ixx"], i["ixy"], i["ixz"]],
            [i["ixy"], i["iyy"], i["iyz"]],
            [i["ixz"], i["iyz"], i["izz"]],
        ])
        principal = np.linalg.eigvalsh(matrix)
        assert masses[name] > 0 and principal[0] > 0 and principal[0] + principal[1] > principal[2], f"{name}: inertia not physical"
    return masses


# ---------------------------------------------------------------- motions

def limits(urdf):
    found = {j.get("name"): j.find("limit") for j in ElementTree.fromstring(urdf).findall("joint") if j.get("type") == "revolute"}
    return (np.array([float(found[j].get(side)) for j in JOINTS]) for side in ("lower", "upper"))


def multi_sine(random, centre, amplitude, t):
    """Three sines between 0.2 and 1.5 Hz for each element; value, first and second derivative, one row per instant."""
    count, terms = len(centre), 3
    frequency = random.uniform([0.2, 0.5, 1.0], [0.5, 1.0, 1.5], (count, terms))
    phase = random.uniform(0, 2 * np.pi, (count, terms))
    weight = random.uniform(0.5, 1.0, (count, terms)) / frequency
    weight *= (amplitude / weight.sum(axis=1))[:, None]
    omega = 2 * np.pi * frequency
    angle = omega * t[:, None, None] + phase
    return (
        centre + (weight * np.sin(angle)).sum(axis=-1),
        (weight * omega * np.cos(angle)).sum(axis=-1),
        -(weight * omega**2 * np.sin(angle)).sum(axis=-1),
    )


# ---------------------------------------------------------------- files

def make_log(urdf, libraries, q, dq, ddq, contact):
    """Fixed chest, with or without a wrench on the hand: MuJoCo's answer for every instant, checked against the two others."""
    fixed, pin, idyn = libraries
    rows = {"mujoco": [], "pinocchio": [], "idyntree": []}
    for k in range(len(q)):
        wrench = None if contact is None else contact[k]
        rows["mujoco"].append(fixed.solve(q[k], dq[k], ddq[k], GRAVITY, wrench))
        rows["pinocchio"].append(pin.solve(q[k], dq[k], ddq[k], GRAVITY, wrench))
        rows["idyntree"].append(idyn.solve(q[k], dq[k], ddq[k], -GRAVITY, np.zeros(3), np.zeros(3), wrench))
    stacked = {name: {key: np.array([row[key] for row in answers]) for key in answers[0]} for name, answers in rows.items()}
    what = "log with contact" if contact is not None else "log"
    for other in ("pinocchio", "idyntree"):
        worst = check_agreement(f"{what}: mujoco and {other}", CSV_TOLERANCE, stacked["mujoco"], stacked[other])
        print(f"{what}: mujoco and {other} agree within {worst:.1e}")
    return stacked["mujoco"]


def write_log(path, q, dq, ddq, answer, contact):
    columns = ["t"]
    columns += [f"joint/{j}/{what}" for j in JOINTS for what in ("position", "velocity", "acceleration", "torque")]
    columns += [f"wrench/{FT_JOINT}/{c}" for c in ("fx", "fy", "fz", "tx", "ty", "tz")]
    columns += [f"imu/chest_imu/{c}" for c in ("ax", "ay", "az", "gx", "gy", "gz", "alx", "aly", "alz")]
    if contact is not None:
        columns += [f"contact/hand/{c}" for c in ("fx", "fy", "fz", "tx", "ty", "tz")]
    lines = [",".join(columns)]
    for k in range(len(q)):
        joints = np.stack([q[k], dq[k], ddq[k], answer["torque"][k]], axis=1).ravel()
        values = [joints, answer["ft"][k], answer["imu"][k]] + ([] if contact is None else [contact[k]])
        t = k * STEP_MS
        cells = [f"{t // 1000}.{t % 1000:03d}"] + [repr(float(x) + 0.0) for x in np.concatenate(values)]
        assert len(cells) == len(columns)
        lines.append(",".join(cells))
    path.write_text("\n".join(lines) + "\n")


def make_cases(random, lower, upper, floating, pin, idyn):
    """Random states of a moving chest, each solved three times."""
    cases, worst = [], {}
    for number in range(CASES):
        q, dq, ddq = random.uniform(lower, upper), random.uniform(-3, 3, 7), random.uniform(-20, 20, 7)
        proper, omega, alpha = random.uniform(-15, 15, 3), random.uniform(-3, 3, 3), random.uniform(-15, 15, 3)
        # Only the proper acceleration can matter: Pinocchio and MuJoCo are each given an attitude, a velocity and a gravity of their own.
        motions = []
        for _ in range(2):
            rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
            rotation *= np.sign(np.linalg.det(rotation))
            gravity = random.uniform(-10, 10, 3)
            motions.append((gravity, (rotation, random.uniform(-1, 1, 3), proper + rotation.T @ gravity, omega, alpha)))
        by_pin = pin.solve(q, dq, ddq, motions[0][0], base=motions[0][1])
        imu = by_pin["imu"]
        answers = {
            "mujoco": floating.solve(q, dq, ddq, motions[1][0], base=motions[1][1]),
            "idyntree": idyn.solve(q, dq, ddq, proper, omega, alpha),
            "idyntree started from the IMU": idyn.solve(q, dq, ddq, imu[:3], imu[3:6], imu[6:], frame=IMU_FRAME),
        }
        for name, answer in answers.items():
            gap = check_agreement(f"case {number}: pinocchio and {name}", CASE_TOLERANCE, by_pin, answer)
            worst[name] = max(worst.get(name, 0.0), gap)
        plain = lambda values: [float(x) for x in values]
        cases.append({
            "position": plain(q), "velocity": plain(dq), "acceleration": plain(ddq),
            "base_proper_acceleration": plain(proper), "base_angular_velocity": plain(omega), "base_angular_acceleration": plain(alpha),
            "torque": plain(by_pin["torque"]), "ft": plain(by_pin["ft"]), "base_wrench": plain(by_pin["base"]),
            "imu_proper_acceleration": plain(imu[:3]), "imu_angular_velocity": plain(imu[3:6]), "imu_angular_acceleration": plain(imu[6:]),
        })
    for name, gap in worst.items():
        print(f"moving base: pinocchio and {name} agree within {gap:.1e}")
    return cases


def write_cases(path, cases):
    head = {
        "model": "config/icub_left_arm/model.urdf",
        "joints": JOINTS,
        "units": "SI; wrenches are [fx, fy, fz, tx, ty, tz]",
        "base": "chest: classical acceleration of its origin minus gravity, angular velocity, angular acceleration, all in chest axes",
        "torque": "along the URDF axis, by the parent on the child, in the order of joints",
        "ft": "l_arm_ft_sensor: wrench by l_upper_arm on l_shoulder_3, at the origin and in the axes of l_upper_arm",
        "base_wrench": "wrench by the environment on chest, the only one on the robot, at the origin and in the axes of chest",
        "imu": "at the origin and in the axes of chest_imu_frame",
    }
    lines = [f"  {json.dumps(key)}: {json.dumps(value)}," for key, value in head.items()]
    body = ",\n".join("    " + json.dumps(case, allow_nan=False) for case in cases)
    path.write_text("{\n" + "\n".join(lines) + '\n  "cases": [\n' + body + "\n  ]\n}\n")


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--out", type=pathlib.Path, default=HERE, help="folder to write the golden files to (default: this file's)")
    out = arguments.parse_args().out
    out.mkdir(parents=True, exist_ok=True)

    for requirement in (HERE / "requirements.txt").read_text().split():
        package, version = requirement.split("==")
        if importlib.metadata.version(package) != version:
            print(f"note: {package} {importlib.metadata.version(package)} is not the pinned {version}: last digits may differ", file=sys.stderr)

    urdf = URDF.read_text()
    masses = check_inertias(urdf)
    print(f"arm: {sum(masses.values()) - masses[BASE]:.3f} kg, {len(masses) - 1} links; every inertia physical")

    random = np.random.default_rng(SEED)
    t = np.arange(0, DURATION_MS + 1, STEP_MS) / 1000.0
    lower, upper = limits(urdf)
    q, dq, ddq = multi_sine(random, (lower + upper) / 2, np.minimum(0.4, 0.45 * (upper - lower)), t)
    assert (q > lower).all() and (q < upper).all()
    contact = multi_sine(random, np.array([3.0, -2.0, 5.0, 0.1, 0.2, -0.1]), np.array([10.0, 10.0, 10.0, 0.5, 0.5, 0.5]), t)[0]

    libraries = (MuJoCo(urdf, floating=False), Pinocchio(urdf), IDynTree(URDF))
    logs = {"icub_left_arm_mujoco.csv": None, "icub_left_arm_mujoco_contact.csv": contact}
    for name, wrenches in logs.items():
        write_log(out / name, q, dq, ddq, make_log(urdf, libraries, q, dq, ddq, wrenches), wrenches)
    cases = make_cases(random, lower, upper, MuJoCo(urdf, floating=True), *libraries[1:])
    write_cases(out / "icub_left_arm_moving_base.json", cases)


if __name__ == "__main__":
    main()
