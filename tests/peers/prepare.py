"""Writes the files that every program of this folder reads: the robot and its states.

Usage: python prepare.py FOLDER        (packages: requirements.txt; `run` calls this)

robot.urdf
    iCubGazeboV2_5 of icub-models: 213 links, most of them massless frames; six F/T sensors in fixed
    joints.
folded.urdf
    The same dynamics in 33 links, one per moving joint and the root, for a program that does not
    merge links at fixed joints.
pinocchio.txt
    The 32 joints as Pinocchio reads them, one a line, for a program that is not linked with its
    URDF reader: parent's number, joint's name, child's name, type, axis, placement (rotation by
    rows, translation), ten parameters.
states.txt
    Words and numbers separated by blanks, in SI units, in this order:
    - joints N, their names
    - sensors N, their names
    - bodies N, their names: the first is the URDF's root, the others are the links that moving
      joints and F/T joints move
    - contacts N, names of links, one for every sub-tree between F/T sensors
    - gravity, three numbers
    - parameters, ten random numbers per body (order: estimator/dynamics/src/spatial.rs)
    - states N, then for each state:
        - positions, velocities, accelerations of the joints
        - motion of the base: angular velocity, velocity of the origin, angular acceleration,
          classical acceleration of the origin, in base axes, which are those of the world
        - readings of the sensors: force, torque

The numbers are random, from a fixed seed: realistic values are not necessary.
"""

import pathlib
import random
import sys
import xml.etree.ElementTree as ElementTree

import icub_models
import numpy as np
import pinocchio

ROBOT = "iCubGazeboV2_5"
SEED = 20150526
STATES = 64
GRAVITY = [0.0, 0.0, -9.80665]  # dynibo supports no other
CONTACTS = ["root_link", "l_hand", "r_hand", "l_upper_leg", "r_upper_leg", "l_foot", "r_foot"]


def text(values):
    return " ".join(repr(float(value)) for value in values)


def names(key, values):
    return f"{key} {len(values)} {' '.join(values)}\n"


def states(moving, sensors, bodies):
    """The text of states.txt."""
    source = random.Random(SEED)

    def reals(count, size):
        return [source.uniform(-size, size) for _ in range(count)]

    out = (
        names("joints", moving)
        + names("sensors", sensors)
        + names("bodies", bodies)
        + names("contacts", CONTACTS)
    )
    out += f"gravity {text(GRAVITY)}\nparameters\n"
    for _ in bodies:
        out += text(reals(10, 1.0)) + "\n"
    out += f"states {STATES}\n"
    for _ in range(STATES):
        for size in (0.5, 1.0, 1.0):  # rad, rad/s, rad/s^2
            out += text(reals(len(moving), size)) + "\n"
        for size in (1.0, 1.0, 1.0, 2.0):
            out += text(reals(3, size)) + "\n"
        for _ in sensors:
            out += text(reals(3, 50.0) + reals(3, 5.0)) + "\n"
    return out


def rpy(rotation):
    """Roll, pitch and yaw of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    cos = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], cos)
    if cos > 1e-9:
        return [
            np.arctan2(rotation[2, 1], rotation[2, 2]),
            pitch,
            np.arctan2(rotation[1, 0], rotation[0, 0]),
        ]
    return [np.arctan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0]


def folded_link(name, inertia):
    i = inertia.inertia  # about the centre of mass
    moments = " ".join(
        f'{key}="{float(i[a, b])!r}"'
        for key, a, b in (
            ("ixx", 0, 0),
            ("ixy", 0, 1),
            ("ixz", 0, 2),
            ("iyy", 1, 1),
            ("iyz", 1, 2),
            ("izz", 2, 2),
        )
    )
    return (
        f'<link name="{name}"><inertial><origin xyz="{text(inertia.lever)}" rpy="0 0 0"/>'
        f'<mass value="{float(inertia.mass)!r}"/><inertia {moments}/></inertial></link>\n'
    )


def main(folder):
    folder = pathlib.Path(folder)
    urdf = pathlib.Path(icub_models.get_model_file(ROBOT))
    robot = ElementTree.parse(urdf).getroot()
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    child = {name: joint.find("child").get("link") for name, joint in joints.items()}
    (root,) = {link.get("name") for link in robot.findall("link")} - set(child.values())
    moving = [name for name, joint in joints.items() if joint.get("type") != "fixed"]
    sensors = [s for s in robot.findall("sensor") if s.get("type") == "force_torque"]
    cuts = [sensor.find("parent").get("joint") for sensor in sensors]
    bodies = [root] + [child[name] for name in [*moving, *cuts]]

    model = pinocchio.buildModelFromUrdf(str(urdf))
    # Joint 0 of Pinocchio is the fixed base, with the links that do not move.
    folded = folded_link(root, model.inertias[0])
    lines = f"{model.njoints - 1}\n{text(model.inertias[0].toDynamicParameters())}\n"
    for number in range(1, model.njoints):
        name, placement, inertia = (
            model.names[number],
            model.jointPlacements[number],
            model.inertias[number],
        )
        kind = model.joints[number].shortname()
        if (
            joints[name].get("type") not in ("revolute", "continuous")
            or model.joints[number].nq != 1
        ):
            sys.exit(f"prepare.py: joint {name} is a {kind}; only revolute joints are supported")
        axis = np.array([float(x) for x in joints[name].find("axis").get("xyz").split()])
        axis /= np.linalg.norm(axis)
        parent = model.parents[number]
        lines += (
            f"{parent} {name} {child[name]} {kind} {text(axis)} "
            f"{text(placement.rotation.ravel())} {text(placement.translation)} "
            f"{text(inertia.toDynamicParameters())}\n"
        )
        folded += folded_link(child[name], inertia)
        folded += (
            f'<joint name="{name}" type="revolute">'
            f'<parent link="{root if parent == 0 else child[model.names[parent]]}"/>'
            f'<child link="{child[name]}"/>'
            f'<origin xyz="{text(placement.translation)}" rpy="{text(rpy(placement.rotation))}"/>'
            f'<axis xyz="{text(axis)}"/>'
            f'<limit lower="-4" upper="4" effort="1000" velocity="100"/></joint>\n'
        )

    (folder / "robot.urdf").write_bytes(urdf.read_bytes())
    (folder / "folded.urdf").write_text(f'<robot name="folded">\n{folded}</robot>\n')
    (folder / "pinocchio.txt").write_text(lines)
    (folder / "states.txt").write_text(states(moving, [s.get("name") for s in sensors], bodies))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
