"""Writes walker.urdf, an invented two-legged robot, and its golden files.

The robot has an example of everything that a URDF reader can get wrong. It has 25 bodies after
merging links at fixed joints, 19 degrees of freedom (two prismatic, two continuous, oblique axes)
and five F/T joints, which divide it into six sub-trees. Some links with mass are fixed to others,
some links are massless frames, and some joints have a merged link as parent. The F/T sensors differ
in frame and direction. The structure below is made by hand; the centres of mass and the attitude of
the principal axes are random, from the seed.
"""

import numpy as np

from cases import Bench, contact, contact_scenarios, document, equation_cases, plain
from libraries import Robot, check_inertias

SEED = 20161121
NAME = "walker"
ROOT = "pelvis"
IMU_FRAME = "chest_imu"

# Link, mass [kg], size of the equivalent box of uniform density [m], centre of the box [m].
LINKS = [
    ("pelvis", 6.0, (0.20, 0.28, 0.16), (0.0, 0.0, 0.02)),
    ("battery", 2.5, (0.10, 0.20, 0.08), (0.0, 0.0, 0.0)),
    ("torso_link", 1.2, (0.10, 0.12, 0.10), (0.0, 0.0, 0.05)),
    ("chest", 8.0, (0.18, 0.30, 0.30), (0.01, 0.0, 0.15)),
    ("backpack", 2.0, (0.10, 0.24, 0.26), (0.0, 0.0, 0.0)),
    ("neck_bracket", 0.3, (0.06, 0.06, 0.08), (0.0, 0.0, 0.03)),
    ("head", 1.8, (0.16, 0.14, 0.18), (0.02, 0.0, 0.10)),
    ("camera", 0.2, (0.03, 0.12, 0.03), (0.0, 0.0, 0.0)),
    ("l_shoulder", 0.9, (0.09, 0.09, 0.10), (0.0, 0.03, 0.0)),
    ("l_upper_arm_1", 0.8, (0.08, 0.08, 0.12), (0.0, 0.0, -0.05)),
    ("l_upper_arm_2", 0.9, (0.07, 0.07, 0.14), (0.0, 0.01, -0.08)),
    ("l_forearm", 0.8, (0.06, 0.06, 0.20), (0.01, 0.0, -0.09)),
    ("l_hand", 0.5, (0.04, 0.08, 0.12), (0.0, 0.0, -0.06)),
    ("r_shoulder", 0.9, (0.09, 0.09, 0.10), (0.0, -0.03, 0.0)),
    ("r_upper_arm", 1.5, (0.08, 0.08, 0.24), (0.0, 0.0, -0.12)),
    ("r_forearm", 0.9, (0.05, 0.05, 0.24), (0.0, 0.01, -0.10)),
    ("r_hand", 0.6, (0.06, 0.08, 0.10), (0.01, 0.0, -0.05)),
    ("l_hip", 1.1, (0.10, 0.10, 0.10), (0.02, 0.0, 0.0)),
    ("l_thigh_1", 1.4, (0.11, 0.10, 0.14), (0.0, 0.0, -0.06)),
    ("l_thigh_2", 2.2, (0.10, 0.09, 0.24), (0.0, 0.01, -0.12)),
    ("l_shin", 1.9, (0.08, 0.08, 0.32), (0.01, 0.0, -0.16)),
    ("l_ankle", 0.4, (0.06, 0.06, 0.05), (0.0, 0.0, 0.0)),
    ("l_instep", 0.5, (0.10, 0.07, 0.04), (0.01, 0.0, -0.02)),
    ("l_foot", 0.7, (0.20, 0.09, 0.03), (0.03, 0.0, -0.02)),
    ("r_hip", 1.1, (0.10, 0.10, 0.10), (0.02, 0.0, 0.0)),
    ("r_thigh", 3.4, (0.11, 0.10, 0.36), (0.0, -0.01, -0.18)),
    ("r_shin", 1.6, (0.06, 0.06, 0.30), (0.0, 0.0, -0.12)),
    ("r_instep", 0.6, (0.10, 0.07, 0.05), (0.01, 0.0, -0.02)),
    ("r_foot", 0.8, (0.20, 0.09, 0.03), (0.03, 0.0, -0.02)),
]
FRAMES = ["chest_imu", "l_palm", "r_flange", "r_palm", "l_sole", "l_toe", "r_sole"]

# Joint, type, parent, child, xyz [m], rpy [rad], axis, limits [rad or m]. Moving joints are not in
# the order of a traversal of the tree.
JOINTS = [
    ("battery_joint", "fixed", "pelvis", "battery",
     (-0.12, 0.01, 0.03), (0.0, 0.2, 0.1), None, None),
    ("r_hip_roll", "revolute", "pelvis", "r_hip",
     (0.0, -0.10, -0.06), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (-0.9, 0.6)),
    ("torso_pitch", "revolute", "pelvis", "torso_link",
     (0.01, 0.0, 0.11), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-0.5, 0.9)),
    ("torso_yaw", "continuous", "torso_link", "chest",
     (0.0, 0.0, 0.10), (0.0, 0.05, 0.0), (0.0, 0.0, 1.0), None),
    ("backpack_joint", "fixed", "chest", "backpack",
     (-0.15, 0.0, 0.16), (0.1, -0.1, 0.3), None, None),
    ("chest_imu_joint", "fixed", "backpack", "chest_imu",
     (0.03, 0.05, 0.08), (3.0, 0.1, -1.5), None, None),
    ("neck_bracket_joint", "fixed", "chest", "neck_bracket",
     (0.02, 0.0, 0.31), (0.0, 0.3, 0.0), None, None),
    ("neck", "revolute", "neck_bracket", "head",
     (0.0, 0.0, 0.07), (0.1, -0.3, 0.0), (0.2, 0.9, -0.4), (-0.8, 0.8)),
    ("camera_joint", "fixed", "head", "camera",
     (0.09, 0.0, 0.12), (0.0, 0.5, 0.0), None, None),
    ("l_shoulder_pitch", "revolute", "chest", "l_shoulder",
     (0.0, 0.17, 0.24), (-0.3, 0.0, 0.0), (0.0, 1.0, 0.0), (-2.5, 1.5)),
    ("l_shoulder_roll", "revolute", "l_shoulder", "l_upper_arm_1",
     (0.01, 0.05, 0.0), (0.0, 0.0, 0.2), (1.0, 0.0, 0.0), (-0.2, 2.4)),
    ("l_arm_ft_sensor", "fixed", "l_upper_arm_1", "l_upper_arm_2",
     (0.0, 0.0, -0.11), (0.3, -0.4, 0.8), None, None),
    ("l_elbow", "revolute", "l_upper_arm_2", "l_forearm",
     (0.0, 0.01, -0.16), (0.0, 0.1, -0.8), (0.3, -0.8, 0.1), (0.0, 2.2)),
    ("l_wrist", "continuous", "l_forearm", "l_hand",
     (0.01, 0.0, -0.20), (0.1, 0.0, 0.0), (0.0, 0.0, -1.0), None),
    ("l_palm_joint", "fixed", "l_hand", "l_palm",
     (0.02, 0.0, -0.08), (0.0, 1.4, 0.3), None, None),
    ("r_shoulder_pitch", "revolute", "chest", "r_shoulder",
     (0.0, -0.17, 0.24), (0.3, 0.0, 0.0), (0.1, -0.9, 0.2), (-1.5, 2.5)),
    ("r_shoulder_roll", "revolute", "r_shoulder", "r_upper_arm",
     (0.01, -0.05, 0.0), (0.0, 0.0, -0.2), (1.0, 0.0, 0.0), (-2.4, 0.2)),
    ("r_reach", "prismatic", "r_upper_arm", "r_forearm",
     (0.0, 0.0, -0.20), (0.4, -0.3, 0.0), (0.1, -0.2, -0.9), (0.0, 0.15)),
    ("r_flange_joint", "fixed", "r_forearm", "r_flange",
     (0.01, 0.02, -0.22), (0.0, 0.2, -0.7), None, None),
    ("r_wrist_ft_sensor", "fixed", "r_flange", "r_hand",
     (0.0, 0.01, -0.03), (0.5, 0.0, 1.1), None, None),
    ("r_palm_joint", "fixed", "r_hand", "r_palm",
     (0.0, -0.02, -0.07), (0.2, -1.3, 0.0), None, None),
    ("l_hip_roll", "revolute", "pelvis", "l_hip",
     (0.0, 0.10, -0.06), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (-0.6, 0.9)),
    ("l_hip_pitch", "revolute", "l_hip", "l_thigh_1",
     (0.02, 0.02, -0.02), (0.0, 0.0, 0.1), (0.0, -1.0, 0.0), (-0.6, 1.6)),
    ("l_leg_ft_sensor", "fixed", "l_thigh_1", "l_thigh_2",
     (0.0, 0.0, -0.12), (-0.5, 0.3, -0.6), None, None),
    ("l_knee", "revolute", "l_thigh_2", "l_shin",
     (0.0, 0.01, -0.24), (0.0, 0.0, 0.5), (0.0, 1.0, 0.0), (0.0, 2.1)),
    ("l_ankle_pitch", "revolute", "l_shin", "l_ankle",
     (0.01, 0.0, -0.33), (0.0, 0.1, 0.0), (0.1, -0.9, 0.1), (-0.7, 0.7)),
    ("l_ankle_roll", "revolute", "l_ankle", "l_instep",
     (0.0, 0.0, -0.02), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (-0.4, 0.4)),
    ("l_foot_ft_sensor", "fixed", "l_instep", "l_foot",
     (0.01, 0.0, -0.05), (3.1, 0.0, 0.4), None, None),
    ("l_sole_joint", "fixed", "l_foot", "l_sole",
     (0.03, 0.0, 0.04), (3.1, 0.0, -0.4), None, None),
    ("l_toe_joint", "fixed", "l_sole", "l_toe",
     (0.10, 0.01, 0.0), (0.0, 0.2, 0.0), None, None),
    ("r_hip_pitch", "revolute", "r_hip", "r_thigh",
     (0.02, -0.02, -0.02), (0.0, 0.0, -0.1), (0.3, 0.8, -0.2), (-1.6, 0.6)),
    ("r_leg_length", "prismatic", "r_thigh", "r_shin",
     (0.0, -0.01, -0.30), (0.1, 0.0, 0.3), (0.0, 0.0, -1.0), (0.0, 0.2)),
    ("r_ankle_pitch", "revolute", "r_shin", "r_instep",
     (0.0, 0.01, -0.28), (0.0, 0.1, -0.3), (0.0, 1.0, 0.0), (-0.7, 0.7)),
    ("r_foot_ft_sensor", "fixed", "r_instep", "r_foot",
     (0.01, 0.01, -0.06), (0.4, 0.6, -0.5), None, None),
    ("r_sole_joint", "fixed", "r_foot", "r_sole",
     (0.03, 0.0, -0.04), (0.0, 0.0, 0.5), None, None),
]

# Sensor, joint, frame, direction, pose in the child link if the frame is that of the sensor.
SENSORS = [
    ("l_arm_ft", "l_arm_ft_sensor", "sensor", "parent_to_child",
     ((0.01, -0.02, 0.03), (0.3, -0.5, 1.2))),
    ("r_wrist_ft", "r_wrist_ft_sensor", "parent", "child_to_parent", None),
    ("l_leg_ft", "l_leg_ft_sensor", "child", "child_to_parent", None),
    ("l_foot_ft", "l_foot_ft_sensor", "sensor", "child_to_parent",
     ((0.0, 0.01, 0.02), (-1.0, 0.2, 0.4))),
    ("r_foot_ft", "r_foot_ft_sensor", "child", "parent_to_child", None),
]


def triple(values):
    return " ".join(f"{value:g}" for value in values)


def inertial(random, mass, size, centre):
    """The inertia of a box, with small random changes of centre of mass and principal axes.

    So no two links have the same inertia, and none is diagonal in the axes of its link.
    """
    squares = np.square(size)
    moments = mass / 12 * (squares.sum() - squares)
    at = np.round(np.asarray(centre) + random.uniform(-0.01, 0.01, 3), 4)
    turn = np.round(random.uniform(-0.6, 0.6, 3), 3)
    # Both products of inertia and a rotation, because readers may combine the two in a wrong way.
    # The products are small enough to keep the tensor physical.
    products = 0.1 * moments.min() * random.uniform(-1, 1, 3)
    ixx, iyy, izz = moments + moments.min() * 0.2
    ixy, ixz, iyz = products
    tensor = " ".join(
        f'{name}="{value:.5g}"'
        for name, value in zip(
            ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), (ixx, ixy, ixz, iyy, iyz, izz)
        )
    )
    return (
        f'<inertial><origin xyz="{triple(at)}" rpy="{triple(turn)}"/>'
        f'<mass value="{mass:g}"/><inertia {tensor}/></inertial>'
    )


def urdf():
    """The whole file as text."""
    random = np.random.default_rng(SEED)
    lines = [
        '<?xml version="1.0"?>',
        "<!-- Written by walker.py: see there. -->",
        f'<robot name="{NAME}">',
    ]
    lines += [
        f'  <link name="{name}">{inertial(random, mass, size, centre)}</link>'
        for name, mass, size, centre in LINKS
    ]
    lines += [f'  <link name="{name}"/>' for name in FRAMES]
    for name, kind, parent, child, xyz, rpy, axis, limits in JOINTS:
        more = ""
        if axis:
            more += f'<axis xyz="{triple(axis)}"/>'
        if limits:
            more += (
                f'<limit lower="{limits[0]:g}" upper="{limits[1]:g}" effort="100" velocity="10"/>'
            )
        lines.append(
            f'  <joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{triple(xyz)}" rpy="{triple(rpy)}"/>{more}</joint>'
        )
    for name, joint, frame, direction, pose in SENSORS:
        origin = f'<origin xyz="{triple(pose[0])}" rpy="{triple(pose[1])}"/>' if pose else ""
        lines.append(
            f'  <sensor name="{name}" type="force_torque"><parent joint="{joint}"/>'
            f"<force_torque><frame>{frame}</frame>"
            f"<measure_direction>{direction}</measure_direction></force_torque>{origin}</sensor>"
        )
    return "\n".join(lines) + "\n</robot>\n"


# ---------------------------------------------------------------- golden files

# On both sides of F/T joints, with merged links between them, beyond a prismatic joint. The
# regressor itself is stored for two of them.
BASES, WHOLE, EACH = ["pelvis", "chest", "l_foot", "r_hand"], ["pelvis", "l_foot"], 3
TOUCHED = ["l_toe", "camera", "r_palm"]

IMU = {"kind": "imu"}


# Six sub-trees: trunk (with head, shoulders, hips and right leg), left arm, right hand, left leg,
# left foot, right foot. Each has at most six unknowns, which can be distinguished, so that the
# answer is unique.
SCENARIOS = [
    {
        "name": "a full wrench in every sub-tree",
        "base": IMU,
        "closing": "trunk",
        "contacts": [
            contact("trunk", "pelvis", "wrench"),
            contact("left palm", "l_palm", "wrench", (0.01, 0.02, 0.03)),
            contact("right palm", "r_palm", "wrench"),
            contact("left shin", "l_shin", "wrench"),
            contact("left sole", "l_sole", "wrench"),
            contact("right sole", "r_sole", "wrench"),
        ],
    },
    {
        "name": "pelvis held, some touched",
        "base": {"kind": "fixed", "link": "pelvis", "gravity": [1.5, -0.8, -9.6]},
        "closing": "support",
        "contacts": [
            contact("support", "pelvis", "wrench"),
            contact("left palm", "l_palm", "force", (0.01, 0.02, 0.03)),
            contact("right palm", "r_palm", "force_along", (0.02, 0.0, -0.01), (0.3, -0.2, 0.9)),
            contact("left sole", "l_sole", "wrench"),
        ],
    },
    {
        "name": "standing on the left sole",
        "base": {"kind": "fixed", "link": "l_sole", "gravity": [0.4, 1.1, -9.7]},
        "closing": "sole",
        "contacts": [contact("sole", "l_sole", "wrench"), contact("left palm", "l_palm", "wrench")],
    },
    {
        "name": "six unknowns of several contacts",
        "base": IMU,
        "closing": "trunk",
        "contacts": [
            contact("trunk", "battery", "wrench"),
            # One force at a point and three along lines; six along lines.
            contact("sole", "l_sole", "force", (-0.03, 0.01, 0.0)),
            contact("toe inside", "l_toe", "force_along", (0.0, -0.03, 0.0), (0.1, 0.0, 1.0)),
            contact("toe outside", "l_toe", "force_along", (0.0, 0.04, 0.0), (0.0, -0.2, 1.0)),
            contact("toe tip", "l_toe", "force_along", (0.03, 0.0, 0.01), (0.2, 1.0, 0.1)),
            contact("line 1", "r_sole", "force_along", (0.1, 0.05, 0.0), (0.0, 0.1, 1.0)),
            contact("line 2", "r_sole", "force_along", (0.1, -0.05, 0.0), (0.1, 0.0, 1.0)),
            contact("line 3", "r_sole", "force_along", (-0.1, 0.0, 0.0), (-0.1, 0.1, 1.0)),
            contact("line 4", "r_foot", "force_along", (0.1, 0.0, 0.0), (0.0, 1.0, 0.2)),
            contact("line 5", "r_foot", "force_along", (-0.1, 0.0, 0.02), (0.1, 1.0, 0.0)),
            contact("line 6", "r_foot", "force_along", (0.0, 0.0, 0.0), (1.0, 0.0, 0.1)),
            # Two links of one sub-tree.
            contact("knee", "l_shin", "force", (0.04, 0.0, -0.02)),
            contact("ankle", "l_instep", "force_along", (0.0, 0.0, -0.02), (0.2, 0.7, -0.4)),
        ],
    },
    {
        "name": "fewer unknowns than equations, in flight",
        "base": IMU,
        "closing": None,
        "contacts": [
            contact("pelvis", "pelvis", "force", (-0.1, 0.02, 0.05)),
            contact("head", "head", "force_along", (0.0, 0.0, 0.2), (0.1, 0.2, -1.0)),
            contact("left forearm", "l_forearm", "force", (0.02, 0.0, -0.1)),
            contact("right palm", "r_palm", "force_along", (0.0, 0.0, 0.0), (0.0, 0.3, 1.0)),
            contact("sole", "l_sole", "force", (-0.03, 0.01, 0.0)),
            contact("toe", "l_toe", "force_along", (0.0, 0.0, 0.0), (0.1, 0.0, 1.0)),
            contact("right sole", "r_sole", "force"),
        ],
    },
    {"name": "nothing touched, in flight", "base": IMU, "closing": None, "contacts": []},
    {
        "name": "known wrenches beside unknown ones",
        "base": IMU,
        "closing": "trunk",
        "contacts": [
            contact("trunk", "backpack", "wrench"),
            contact("right palm", "r_palm", "wrench"),
            contact("left hand", "l_hand", "force", (0.0, 0.0, -0.1)),
            contact("left sole", "l_sole", "wrench"),
        ],
        "known": [
            contact(name, name, "known")
            for name in ("camera", "r_thigh", "r_flange", "l_shin", "l_palm", "r_hand", "r_foot")
        ],
    },
]


def write(out):
    """The URDF and both golden files."""
    path = out / "walker.urdf"
    path.write_text(urdf())
    robot = Robot(path, IMU_FRAME)
    masses = check_inertias(robot.text, FRAMES)
    print(
        f"walker: {sum(masses.values()):.3f} kg, {len(robot.bodies)} bodies, "
        f"{len(robot.joints)} joints; every inertia is physical"
    )
    bench, random = Bench(robot), np.random.default_rng(SEED)
    head = {"model": "tests/oracle/walker.urdf", "joints": robot.joints, "bodies": robot.bodies}
    vectors, cases = equation_cases(bench, random, BASES, TOUCHED, EACH, whole=WHOLE)
    bench.report("walker")
    (out / "walker_equation.json").write_text(
        document(SEED, head, {"parameters": [plain(vector) for vector in vectors], "cases": cases})
    )
    head = {
        "model": "tests/oracle/walker.urdf",
        "imu": IMU_FRAME,
        "joints": robot.joints,
        "sensors": [s.name for s in robot.sensors],
    }
    scenarios = contact_scenarios(bench, random, SCENARIOS, 4)
    bench.report("walker")
    (out / "walker_contacts.json").write_text(document(SEED, head, {"scenarios": scenarios}))
