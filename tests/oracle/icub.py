"""A whole iCub.

The URDF is iCubGazeboV2_5.urdf of the PyPI package icub-models 3.2.0 (CC BY-SA 4.0); README.md
describes how to get it. Because of its licence it is not copied here. Nor is icub_v25.json, whose
numbers determine the robot's inertial parameters: those who have the URDF make the file from it.
"""

import numpy as np

from cases import Bench, contact, contact_scenarios, document, equation_cases, plain
from libraries import Robot

SEED = 20250911
IMU_FRAME = "chest"
BASES, TOUCHED = ["root_link", "chest", "l_foot"], ["r_hand", "head"]

ENDS = [
    contact("left hand", "l_hand", "wrench"),
    contact("right hand", "r_hand", "wrench"),
    contact("left foot", "l_foot", "wrench"),
    contact("right foot", "r_foot", "wrench"),
    contact("left thigh", "l_upper_leg", "wrench"),
    contact("right thigh", "r_upper_leg", "wrench"),
]
SCENARIOS = [
    {
        "name": "root held, every limb touched",
        "base": {"kind": "fixed", "link": "root_link", "gravity": [0.6, -1.1, -9.7]},
        "closing": "root",
        "contacts": [contact("root", "root_link", "wrench"), *ENDS],
    },
    {
        "name": "standing on the left foot",
        "base": {"kind": "fixed", "link": "l_sole", "gravity": [0.1, 0.2, -9.8]},
        "closing": "sole",
        "contacts": [
            contact("sole", "l_sole", "wrench"),
            contact("left hand", "l_hand", "force", (0.05, 0.01, 0.02)),
            contact("elbow", "r_elbow_1", "force_along", (0.0, 0.02, 0.0), (0.2, 1.0, -0.3)),
        ],
    },
    {
        "name": "walking with a hand on a wall",
        "base": {"kind": "imu"},
        "closing": "right sole",
        "contacts": [
            contact("right sole", "r_sole", "wrench"),
            contact("left sole", "l_sole", "force", (0.02, 0.0, 0.0)),
            contact("left heel", "l_sole", "force_along", (-0.05, 0.01, 0.0), (0.0, 0.1, 1.0)),
            contact("right hand", "r_hand", "force"),
        ],
    },
]


def write(urdf, out):
    """One file with the contents of both golden files of the walker."""
    robot = Robot(urdf, IMU_FRAME)
    bench, random = Bench(robot), np.random.default_rng(SEED)
    print(f"icub: {len(robot.bodies)} bodies, {len(robot.joints)} joints")
    head = {
        "model": "iCubGazeboV2_5.urdf of icub-models 3.2.0",
        "imu": IMU_FRAME,
        "joints": robot.joints,
        "bodies": robot.bodies,
        "sensors": [s.name for s in robot.sensors],
    }
    vectors, cases = equation_cases(bench, random, BASES, TOUCHED, 2, products=True)
    scenarios = contact_scenarios(bench, random, SCENARIOS, 2)
    bench.report("icub")
    lists = {
        "parameters": [plain(vector) for vector in vectors],
        "cases": cases,
        "scenarios": scenarios,
    }
    (out / "icub_v25.json").write_text(document(SEED, head, lists))
