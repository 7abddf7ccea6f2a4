"""A robot's proprioception: joint torques, contact wrenches and measurements, live and from logs.

Live, from the shared memory of a running gateway and estimator::

    import proprio

    with proprio.RobotReader("icub_left_arm", max_age=0.005) as robot:
        while True:
            robot.wait_for_estimate(timeout=0.01)
            torque = robot.torque("l_elbow")
            print(f"{torque.torque} +- {torque.standard_deviation} Nm" if torque else torque)

From logs::

    table = proprio.read_table("a.csv")             # or proprio.read_recording("a.mcap")
    outcome = proprio.identify("estimator.toml", ["a.csv", "b.csv"], out="result")
    estimates = proprio.estimate("estimator.toml", "c.csv", parameters=outcome.parameters)
"""

from ._library import __version__
from .live import (
    IMU,
    JOINT,
    STATUS,
    WRENCH,
    Contact,
    Imu,
    JointState,
    Missing,
    RobotReader,
    Torque,
    Torques,
    Unavailable,
    Wrench,
    now,
)
from .logs import Failed, Identification, Table, estimate, identify, read_recording, read_table
from ._program import program

__all__ = [
    "IMU",
    "JOINT",
    "STATUS",
    "WRENCH",
    "Contact",
    "Failed",
    "Identification",
    "Imu",
    "JointState",
    "Missing",
    "RobotReader",
    "Table",
    "Torque",
    "Torques",
    "Unavailable",
    "Wrench",
    "__version__",
    "estimate",
    "identify",
    "now",
    "program",
    "read_recording",
    "read_table",
]
