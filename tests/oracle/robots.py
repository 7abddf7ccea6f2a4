"""Every URDF of the PyPI packages example-robot-data and icub-models, with Pinocchio's torques.

Neither the URDFs nor what follows from them is in the repository: they have licences of their own,
and are large. `write` takes the wheels as `pip download` leaves them; README.md has the commands.
"""

import json
import pathlib
import xml.etree.ElementTree as ElementTree
import zipfile

import numpy as np
import pinocchio

from libraries import made_with, must

SEED = 20260521
STATES = 3


def unpack(wheels, out):
    """The URDFs of the wheels, as `<package>/<the last folders of its path>`."""
    for wheel in wheels:
        package = wheel.name.split("-")[0]
        archive = zipfile.ZipFile(wheel)
        for member in sorted(archive.namelist()):
            if member.endswith(".urdf"):
                parts = [part for part in member.split("/")[-4:] if part not in ("robots", "urdf")]
                name = "-".join([package, *parts])
                (out / name).write_bytes(archive.read(member))
                yield name


def mimic_of(tree, name):
    """The `<mimic>` of a joint, if it names a joint that is there."""
    mimic = tree.find(f"joint[@name='{name}']/mimic")
    if mimic is not None and tree.find(f"joint[@name='{mimic.get('joint')}']") is not None:
        return mimic


def followed(tree, name):
    """The joint that a joint follows in the end, with ratio and offset."""
    mimic = mimic_of(tree, name)
    if mimic is None:
        return name, 1.0, 0.0
    leader, ratio, offset = followed(tree, mimic.get("joint"))
    multiplier = float(mimic.get("multiplier", 1.0))
    return leader, multiplier * ratio, multiplier * offset + float(mimic.get("offset", 0.0))


def cases(path, random):
    """Torques of random states by Pinocchio's RNEA.

    Where joints have a `<mimic>`, they follow: `q = S q_own + s`, the torque is `S^T` times that of
    all joints. Pinocchio's own mimic joints must agree, where it can make them (it cannot where it
    meets a joint before the one that it follows).
    """
    model = pinocchio.buildModelFromUrdf(str(path))
    data = model.createData()
    tree = ElementTree.parse(path).getroot()
    moving = {
        model.names[joint]: model.joints[joint].idx_v
        for joint in range(1, model.njoints)
        if model.joints[joint].nv == 1
    }
    own = [name for name in moving if mimic_of(tree, name) is None]
    matrix, shift = np.zeros((model.nv, len(own))), np.zeros(model.nv)
    for name, row in moving.items():
        leader, ratio, shift[row] = followed(tree, name)
        if leader in own:  # it may be a fixed joint
            matrix[row, own.index(leader)] = ratio
    # This project takes the child of a floating joint as the root.
    base, gravity = None, model.gravity.linear
    pinocchio.framesForwardKinematics(model, data, pinocchio.neutral(model))
    for joint in tree.findall("joint"):
        if joint.get("type") in ("floating", "planar"):
            base = joint.find("child").get("link")
            gravity = data.oMf[model.getFrameId(base)].rotation.T @ gravity
    rows = []
    for _ in range(STATES):
        position, velocity, acceleration = (
            random.uniform(-size, size, len(own)) for size in (1.0, 2.0, 5.0)
        )
        q = pinocchio.integrate(model, pinocchio.neutral(model), matrix @ position + shift)
        torque = matrix.T @ pinocchio.rnea(
            model, data, q, matrix @ velocity, matrix @ acceleration
        )
        agree(path, own, position, velocity, acceleration, torque)
        rows.append(
            {
                name: [float(x) for x in vector]
                for name, vector in (
                    ("position", position),
                    ("velocity", velocity),
                    ("acceleration", acceleration),
                    ("torque", torque),
                )
            }
        )
    return {
        "joints": own,
        "base": base,
        "gravity": [float(x) for x in gravity],
        "cases": rows,
    }


def agree(path, own, position, velocity, acceleration, torque):
    """Ends the program unless Pinocchio's mimic joints have the same torques."""
    try:
        model = pinocchio.buildModelFromUrdf(str(path), mimic=True)
    except ValueError:
        return
    if not all(model.existJointName(name) for name in own):
        return
    columns = [model.joints[model.getJointId(name)].idx_v for name in own]
    q, v, a = np.zeros((3, model.nv))
    q[columns], v[columns], a[columns] = position, velocity, acceleration
    data, q = model.createData(), pinocchio.integrate(model, pinocchio.neutral(model), q)
    other = pinocchio.rnea(model, data, q, v, a)[columns]
    worst = np.abs(other - torque).max(initial=0.0)
    must(worst <= 1e-9 * (1 + np.abs(torque).max(initial=0.0)), f"{path.name}: {worst}")


def write(wheels, out):
    """The URDFs and `robots.json`."""
    random = np.random.default_rng(SEED)
    robots = {}
    for name in unpack(wheels, out):
        try:
            robots[name] = cases(out / name, random)
        except (ValueError, RuntimeError) as error:
            robots[name] = {"refused": str(error).splitlines()[0].replace(str(out), "")}
    head = {"made_with": made_with(), "seed": SEED}
    (out / "robots.json").write_text(json.dumps({**head, "robots": robots}, indent=1))
    refused = sum("refused" in robot for robot in robots.values())
    print(f"robots: {len(robots)}, of which Pinocchio refuses {refused}")
