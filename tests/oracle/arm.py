"""The arm of config/icub_left_arm.

Three files: a log with a fixed chest, the same with a wrench on the hand, and random states with a
moving chest.
"""

import json
import xml.etree.ElementTree as ElementTree

import numpy as np

from libraries import (
    IDynTree,
    MuJoCo,
    Pinocchio,
    Robot,
    check_agreement,
    check_inertias,
    made_with,
    must,
)

SEED = 20150526
JOINTS = [
    "l_shoulder_pitch",
    "l_shoulder_roll",
    "l_shoulder_yaw",
    "l_elbow",
    "l_wrist_prosup",
    "l_wrist_pitch",
    "l_wrist_yaw",
]
FT_JOINT = "l_arm_ft_sensor"
BASE, HAND, IMU_FRAME = "chest", "l_hand", "chest_imu_frame"
GRAVITY = np.array([0.0, 0.0, -9.80665])  # in chest axes [m/s^2]

DURATION_MS, STEP_MS = 10_000, 50
CASES = 30
CSV_TOLERANCE = 1e-9  # of the largest magnitude of a quantity, over the whole file
CASE_TOLERANCE = 1e-10  # of the largest magnitude of a quantity, in each case


# ---------------------------------------------------------------- motions


def limits(urdf):
    found = {
        j.get("name"): j.find("limit")
        for j in ElementTree.fromstring(urdf).findall("joint")
        if j.get("type") == "revolute"
    }
    return (np.array([float(found[j].get(side)) for j in JOINTS]) for side in ("lower", "upper"))


def multi_sine(random, centre, amplitude, t):
    """Value, first and second derivative of three sines for each element, one row per instant.

    Their frequencies are between 0.2 and 1.5 Hz.
    """
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


def make_log(libraries, q, dq, ddq, contact):
    """MuJoCo's answer for every instant, checked against the two others.

    The chest is fixed; there may be a wrench on the hand.
    """
    fixed, pin, idyn = libraries
    rows = {"mujoco": [], "pinocchio": [], "idyntree": []}
    for k in range(len(q)):
        wrench = [] if contact is None else [(HAND, contact[k])]
        rows["mujoco"].append(fixed.solve(q[k], dq[k], ddq[k], GRAVITY, wrench))
        rows["pinocchio"].append(pin.solve(q[k], dq[k], ddq[k], GRAVITY, wrench))
        rows["idyntree"].append(
            idyn.solve(q[k], dq[k], ddq[k], np.concatenate([-GRAVITY, np.zeros(6)]), wrench)
        )
    stacked = {
        name: {key: np.array([row[key] for row in answers]) for key in answers[0]}
        for name, answers in rows.items()
    }
    what = "log with contact" if contact is not None else "log"
    for other in ("pinocchio", "idyntree"):
        worst = check_agreement(
            f"{what}: mujoco and {other}", CSV_TOLERANCE, stacked["mujoco"], stacked[other]
        )
        print(f"{what}: mujoco and {other} agree within {worst:.1e}")
    return stacked["mujoco"]


def write_log(path, q, dq, ddq, answer, contact):
    columns = ["t"]
    columns += [
        f"joint/{j}/{what}"
        for j in JOINTS
        for what in ("position", "velocity", "acceleration", "torque")
    ]
    columns += [f"wrench/{FT_JOINT}/{c}" for c in ("fx", "fy", "fz", "tx", "ty", "tz")]
    columns += [
        f"imu/chest_imu/{c}" for c in ("ax", "ay", "az", "gx", "gy", "gz", "alx", "aly", "alz")
    ]
    if contact is not None:
        columns += [f"contact/hand/{c}" for c in ("fx", "fy", "fz", "tx", "ty", "tz")]
    lines = [",".join(columns)]
    for k in range(len(q)):
        joints = np.stack([q[k], dq[k], ddq[k], answer["torque"][k]], axis=1).ravel()
        values = [joints, answer["ft"][k], answer["imu"][k]] + (
            [] if contact is None else [contact[k]]
        )
        t = k * STEP_MS
        cells = [f"{t // 1000}.{t % 1000:03d}"] + [
            repr(float(x) + 0.0) for x in np.concatenate(values)
        ]
        must(len(cells) == len(columns), f"{path}: a row is not as long as the header")
        lines.append(",".join(cells))
    path.write_text("\n".join(lines) + "\n")


def make_cases(random, lower, upper, floating, pin, idyn):
    """Random states with a moving chest, each solved by all three libraries."""
    cases, worst = [], {}
    for number in range(CASES):
        q, dq, ddq = (
            random.uniform(lower, upper),
            random.uniform(-3, 3, 7),
            random.uniform(-20, 20, 7),
        )
        proper, omega, alpha = (
            random.uniform(-15, 15, 3),
            random.uniform(-3, 3, 3),
            random.uniform(-15, 15, 3),
        )
        # Only the proper acceleration may matter: Pinocchio and MuJoCo get different attitudes,
        # velocities and gravities.
        motions = []
        for _ in range(2):
            rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
            rotation *= np.sign(np.linalg.det(rotation))
            gravity = random.uniform(-10, 10, 3)
            motions.append(
                (
                    gravity,
                    (
                        rotation,
                        random.uniform(-1, 1, 3),
                        proper + rotation.T @ gravity,
                        omega,
                        alpha,
                    ),
                )
            )
        by_pin = pin.solve(q, dq, ddq, motions[0][0], base=motions[0][1])
        imu = by_pin["imu"]
        answers = {
            "mujoco": floating.solve(q, dq, ddq, motions[1][0], base=motions[1][1]),
            "idyntree": idyn.solve(q, dq, ddq, np.concatenate([proper, omega, alpha])),
            "idyntree started from the IMU": idyn.solve(q, dq, ddq, imu, frame=IMU_FRAME),
        }
        for name, answer in answers.items():
            gap = check_agreement(
                f"case {number}: pinocchio and {name}", CASE_TOLERANCE, by_pin, answer
            )
            worst[name] = max(worst.get(name, 0.0), gap)
        plain = lambda values: [float(x) for x in values]
        cases.append(
            {
                "position": plain(q),
                "velocity": plain(dq),
                "acceleration": plain(ddq),
                "base_proper_acceleration": plain(proper),
                "base_angular_velocity": plain(omega),
                "base_angular_acceleration": plain(alpha),
                "torque": plain(by_pin["torque"]),
                "ft": plain(by_pin["ft"]),
                "base_wrench": plain(by_pin["base"]),
                "imu_proper_acceleration": plain(imu[:3]),
                "imu_angular_velocity": plain(imu[3:6]),
                "imu_angular_acceleration": plain(imu[6:]),
            }
        )
    for name, gap in worst.items():
        print(f"moving base: pinocchio and {name} agree within {gap:.1e}")
    return cases


def write_cases(path, cases):
    head = {
        "made_with": made_with(),
        "seed": SEED,
        "model": "config/icub_left_arm/model.urdf",
        "joints": JOINTS,
        "units": "SI; wrenches are [fx, fy, fz, tx, ty, tz]",
        "base": "chest: classical acceleration of its origin minus gravity, angular velocity, "
        "angular acceleration, all in chest axes",
        "torque": "along the URDF axis, by the parent on the child, in the order of joints",
        "ft": "l_arm_ft_sensor: wrench by l_upper_arm on l_shoulder_3, "
        "at the origin and in the axes of l_upper_arm",
        "base_wrench": "wrench by the environment on chest, the only one on the robot, "
        "at the origin and in the axes of chest",
        "imu": "at the origin and in the axes of chest_imu_frame",
    }
    lines = [f"  {json.dumps(key)}: {json.dumps(value)}," for key, value in head.items()]
    body = ",\n".join("    " + json.dumps(case, allow_nan=False) for case in cases)
    path.write_text("{\n" + "\n".join(lines) + '\n  "cases": [\n' + body + "\n  ]\n}\n")


def write(urdf, out):
    """All three files."""
    robot = Robot(urdf, IMU_FRAME)
    must(robot.joints == JOINTS and robot.root == BASE, f"{urdf}: not the arm")
    masses = check_inertias(robot.text, {IMU_FRAME, "l_hand_palm"})
    print(
        f"arm: {sum(masses.values()) - masses[BASE]:.3f} kg, {len(masses) - 1} links; "
        "every inertia is physical"
    )

    random = np.random.default_rng(SEED)
    t = np.arange(0, DURATION_MS + 1, STEP_MS) / 1000.0
    lower, upper = limits(robot.text)
    q, dq, ddq = multi_sine(random, (lower + upper) / 2, np.minimum(0.4, 0.45 * (upper - lower)), t)
    must((q > lower).all() and (q < upper).all(), "a joint leaves its range")
    contact = multi_sine(
        random,
        np.array([3.0, -2.0, 5.0, 0.1, 0.2, -0.1]),
        np.array([10.0, 10.0, 10.0, 0.5, 0.5, 0.5]),
        t,
    )[0]

    libraries = (MuJoCo(robot, floating=False), Pinocchio(robot), IDynTree(robot))
    logs = {"icub_left_arm_mujoco.csv": None, "icub_left_arm_mujoco_contact.csv": contact}
    for name, wrenches in logs.items():
        write_log(out / name, q, dq, ddq, make_log(libraries, q, dq, ddq, wrenches), wrenches)
    cases = make_cases(random, lower, upper, MuJoCo(robot, floating=True), *libraries[1:])
    write_cases(out / "icub_left_arm_moving_base.json", cases)
