"""Random cases of a whole robot.

Two kinds: the equation of motion and its regressor for several bases; contact wrenches from F/T
readings.
"""

import json

import numpy as np

from libraries import (
    IDynTree,
    MuJoCo,
    Pinocchio,
    base_change,
    check_agreement,
    check_close,
    made_with,
    must,
    rotation_of,
)

TOLERANCE = 1e-10  # of the largest magnitude of a quantity, in each case


def plain(values):
    """Numbers for JSON: 15 digits, and zero as `0`."""
    return [float(f"{x:.15g}") if x else 0 for x in np.asarray(values, dtype=float).ravel()]


class Bench:
    """The three libraries on one robot, and the largest difference of each pair so far."""

    def __init__(self, robot):
        self.robot = robot
        self.mujoco, self.pinocchio, self.idyntree = (
            MuJoCo(robot, floating=True),
            Pinocchio(robot),
            IDynTree(robot),
        )
        self.worst = {}

    def agree(self, what, pair, first, second, columns=False):
        gap = check_close(f"{what}: {pair}", TOLERANCE, first, second, columns)
        self.worst[pair] = max(self.worst.get(pair, 0.0), gap)

    def agree_all(self, what, pair, first, second):
        gap = check_agreement(f"{what}: {pair}", TOLERANCE, first, second)
        self.worst[pair] = max(self.worst.get(pair, 0.0), gap)

    def report(self, what):
        for pair, gap in self.worst.items():
            print(f"{what}: {pair} agree within {gap:.1e}")
        self.worst.clear()

    def state(self, random):
        count = len(self.robot.joints)
        return (
            self.robot.random_position(random),
            random.uniform(-2, 2, count),
            random.uniform(-10, 10, count),
        )

    def frame_change(self, q, frame):
        """`base_change` from the root to any frame."""
        x, _, _ = self.pinocchio._state(q, np.zeros(len(q)), np.zeros(len(q)), None)
        return base_change(self.pinocchio.jacobian(x, frame))


def random_attitude(random, root_motion):
    """Gravity and the libraries' `base`, for a given motion of the root.

    Attitude, velocity and gravity are random, because only the proper acceleration may matter.
    """
    proper, omega, alpha = root_motion[:3], root_motion[3:6], root_motion[6:]
    rotation, gravity = rotation_of(random.uniform(-3, 3, 3)), random.uniform(-10, 10, 3)
    return gravity, (
        rotation,
        random.uniform(-1, 1, 3),
        proper + rotation.T @ gravity,
        omega,
        alpha,
    )


# ---------------------------------------------------------------- the equation of motion


def equation_cases(bench, random, bases, frames, each, whole=(), products=False):
    """The random parameter vectors, and `each` random cases for every base.

    All cases have the products of the regressor with the vectors; the first case of each base named
    in `whole` also has the regressor itself. With `products`, cases have products of the mass
    matrix with random vectors instead of the mass matrix.
    """
    robot, pin = bench.robot, bench.pinocchio
    size = 10 * len(robot.bodies)
    # The map is linear, so realistic magnitudes are not necessary: all columns have equal weight.
    vectors = random.uniform(-1, 1, (2, size))
    cases = []
    for base in bases:
        for number in range(each):
            what = f"{base} {number}"
            q, dq, ddq = bench.state(random)
            motion = np.concatenate(
                [random.uniform(-12, 12, 3), random.uniform(-2, 2, 3), random.uniform(-8, 8, 3)]
            )
            external = {
                frame: np.concatenate([random.uniform(-40, 40, 3), random.uniform(-4, 4, 3)])
                for frame in frames[:2]
            }
            change = bench.frame_change(q, base)
            at = pin.root_motion(q, dq, ddq, base, motion)

            # Inverse dynamics of the whole motion.
            gravity, pose = random_attitude(random, at)
            pushed = list(external.items())
            by_pin = pin.solve(q, dq, ddq, gravity, pushed, pose)
            by_mujoco = bench.mujoco.solve(
                q, dq, ddq, *(lambda g, b: (g, pushed, b))(*random_attitude(random, at))
            )
            need = change.T @ np.concatenate([by_pin["base"], by_pin["torque"]])
            bench.agree_all(
                what,
                "inverse dynamics: pinocchio and mujoco",
                {"generalised": need, "imu": by_pin["imu"]},
                {
                    "generalised": change.T
                    @ np.concatenate([by_mujoco["base"], by_mujoco["torque"]]),
                    "imu": by_mujoco["imu"],
                },
            )
            by_idyn = bench.idyntree.solve(q, dq, ddq, motion, pushed, base, base)
            from_imu = bench.idyntree.solve(q, dq, ddq, by_pin["imu"], pushed, robot.imu, base)
            answer = {"base": need[:6], "torque": need[6:]}
            bench.agree_all(
                what,
                "inverse dynamics: pinocchio and idyntree",
                answer,
                {k: by_idyn[k] for k in answer},
            )
            bench.agree_all(
                what,
                "inverse dynamics: pinocchio and idyntree started from the IMU",
                answer,
                {k: from_imu[k] for k in answer},
            )

            # The regressor.
            regressor = change.T @ pin.regressor(q, dq, ddq, gravity, pose)
            rotation = rotation_of(random.uniform(-3, 3, 3))
            other = bench.idyntree.regressor(
                base,
                q,
                dq,
                ddq,
                motion,
                random.uniform(-10, 10, 3),
                rotation,
                random.uniform(-1, 1, 3),
            )
            bench.agree(what, "regressor: pinocchio and idyntree", regressor, other, columns=True)

            # The blocks. The bias is due to velocities alone: the base's origin is at rest, and all
            # accelerations are zero.
            still = np.concatenate([np.zeros(3), motion[3:6], np.zeros(3)])
            zero = np.zeros(len(q))
            root = pin.root_motion(q, dq, zero, base, still)
            slow = pin.solve(
                q,
                dq,
                zero,
                np.zeros(3),
                (),
                (np.eye(3), np.zeros(3), root[:3], root[3:6], root[6:]),
            )
            bias = change.T @ np.concatenate([slow["base"], slow["torque"]])
            omega = root[3:6]
            blocks = {
                "pinocchio": pin.blocks(q, dq, omega),
                "mujoco": bench.mujoco.blocks(q, dq, omega, base),
                "idyntree": bench.idyntree.blocks(base, q, dq, motion[3:6]),
            }
            by_pin, by_mujoco, by_idyn = (
                blocks[name] for name in ("pinocchio", "mujoco", "idyntree")
            )
            if base == robot.root:
                bench.agree(
                    what, "bias: pinocchio's rnea and nonLinearEffects", bias, by_pin["bias"]
                )
                bench.agree(what, "bias: pinocchio and mujoco", bias, by_mujoco["bias"])
            slow = bench.mujoco.solve(
                q,
                dq,
                zero,
                np.zeros(3),
                (),
                (np.eye(3), np.zeros(3), root[:3], root[3:6], root[6:]),
            )
            bench.agree(
                what,
                "bias: pinocchio and mujoco",
                bias,
                change.T @ np.concatenate([slow["base"], slow["torque"]]),
            )
            bench.agree(what, "bias: pinocchio and idyntree", bias, by_idyn["bias"])
            own_change = base_change(by_mujoco["jacobian"])
            mass = change.T @ by_pin["mass"] @ change
            bench.agree(
                what,
                "mass matrix: pinocchio and mujoco",
                mass,
                own_change.T @ by_mujoco["mass"] @ own_change,
            )
            bench.agree(what, "mass matrix: pinocchio and idyntree", mass, by_idyn["mass"])

            case = {
                "base": base,
                "position": plain(q),
                "velocity": plain(dq),
                "acceleration": plain(ddq),
                "base_proper_acceleration": plain(motion[:3]),
                "base_angular_velocity": plain(motion[3:6]),
                "base_angular_acceleration": plain(motion[6:]),
                "external": {frame: plain(wrench) for frame, wrench in external.items()},
                "base_wrench": plain(need[:6]),
                "torque": plain(need[6:]),
                "regressor_products": [plain(regressor @ vector) for vector in vectors],
                "bias": plain(bias),
            }
            if products:
                motions = random.uniform(-1, 1, (2, len(mass)))
                case["generalised_accelerations"] = [plain(vector) for vector in motions]
                case["mass_matrix_products"] = [plain(mass @ vector) for vector in motions]
            else:
                case["mass_matrix"] = plain(mass[np.tril_indices(len(mass))])
            if number == 0 and base in whole:
                case["regressor"] = [
                    plain(np.where(np.abs(row) < 1e-13, 0.0, row)) for row in regressor
                ]
            cases.append(case)
    return vectors, cases


# ---------------------------------------------------------------- contacts


def contact(name, link, kind, position=(0.0, 0.0, 0.0), direction=None):
    """A contact as the golden files describe it."""
    return {"name": name, "link": link, "kind": kind, "position": list(position)} | (
        {"direction": list(direction)} if direction else {}
    )


def true_wrench(random, kind, position, direction):
    """A random wrench of a kind, at the origin and in the axes of its frame."""
    force = random.uniform(-40, 40, 3)
    if kind == "force_along":
        force = np.asarray(direction) / np.linalg.norm(direction) * random.uniform(-40, 40)
    torque = np.cross(position, force)
    if kind in ("wrench", "known"):
        torque = torque + random.uniform(-4, 4, 3)
    return np.concatenate([force, torque])


def contact_case(bench, random, what, scenario):
    """One random state of a scenario, with a random wrench of the right kind on each contact.

    The wrench on the scenario's `closing` contact follows from the equation of motion; without such
    a contact, the acceleration of the root does.
    """
    robot, pin = bench.robot, bench.pinocchio
    contacts = scenario["contacts"] + [
        {**known, "kind": "known"} for known in scenario.get("known", [])
    ]
    unpack = lambda c: (
        c["link"],
        c["kind"],
        np.array(c.get("position", [0.0, 0.0, 0.0])),
        c.get("direction"),
    )
    wrenches = [true_wrench(random, *unpack(c)[1:]) for c in contacts]
    links = [c["link"] for c in contacts]
    q, dq, ddq = bench.state(random)
    base = scenario["base"]
    if base["kind"] == "fixed":
        start, motion = base["link"], np.concatenate([-np.array(base["gravity"]), np.zeros(6)])
    else:
        start = robot.imu
        motion = np.concatenate(
            [random.uniform(-12, 12, 3), random.uniform(-2, 2, 3), random.uniform(-8, 8, 3)]
        )
    at = pin.root_motion(q, dq, ddq, start, motion)
    closing = scenario.get("closing")
    need = lambda pushed, at: pin.solve(
        q, dq, ddq, np.zeros(3), pushed, (np.eye(3), np.zeros(3), at[:3], at[3:6], at[6:])
    )
    if closing is None:
        # In flight: the contacts accelerate the root.
        at = np.concatenate([np.zeros(3), at[3:6], np.zeros(3)])
        root_inertia = pin.blocks(q, dq, at[3:6])["mass"][:6, :6]
        acceleration = -np.linalg.solve(root_inertia, need(list(zip(links, wrenches)), at)["base"])
        at = np.concatenate([acceleration[:3], at[3:6], acceleration[3:]])
    else:
        index = next(i for i, c in enumerate(contacts) if c["name"] == closing)
        must(contacts[index]["kind"] == "wrench", f"{what}: {closing} is not a full wrench")
        others = [
            (link, wrench) for i, (link, wrench) in enumerate(zip(links, wrenches)) if i != index
        ]
        answer = need(others, at)
        wrenches[index] = (
            bench.frame_change(q, links[index]).T
            @ np.concatenate([answer["base"], answer["torque"]])
        )[:6]

    pushed = list(zip(links, wrenches))
    gravity, pose = random_attitude(random, at)
    truth = pin.solve(q, dq, ddq, gravity, pushed, pose)
    by_mujoco = bench.mujoco.solve(
        q, dq, ddq, *(lambda g, b: (g, pushed, b))(*random_attitude(random, at))
    )
    # No wrench may remain on the root.
    largest = max(np.abs(truth["ft"]).max(), 1.0)
    for answer in (truth, by_mujoco):
        must(
            np.abs(answer.pop("base")).max() < TOLERANCE * largest,
            f"{what}: a wrench remains on the root",
        )
    bench.agree_all(what, "readings and torques: pinocchio and mujoco", truth, by_mujoco)
    held = [(link, wrench) for link, wrench in pushed if closing is None or link != links[index]]
    expected = bench.idyntree.solve(
        q, dq, ddq, truth["imu"], held, robot.imu, None if closing is None else links[index]
    )
    del expected["base"]
    bench.agree_all(what, "readings and torques: pinocchio and idyntree", expected, truth)

    told = [
        (link, kind, position, wrenches[i] if kind == "known" else direction)
        for i, (link, kind, position, direction) in enumerate(map(unpack, contacts))
    ]
    estimated = bench.idyntree.estimate(q, dq, ddq, truth["imu"], robot.imu, truth["ft"], told)
    bench.agree_all(
        what,
        "estimated torques: idyntree and the truth",
        {"torque": estimated["torque"]},
        {"torque": truth["torque"]},
    )
    # One scale for all forces of a case and one for all torques, because many are zero by their
    # kind.
    found = estimated["contact"].reshape(-1, 6)
    for part in (slice(0, 3), slice(3, 6)):
        if len(wrenches):
            bench.agree(
                what,
                "estimated contacts: idyntree and the truth",
                found[:, part],
                np.array(wrenches)[:, part],
            )
    count = len(scenario["contacts"])
    return {
        "position": plain(q),
        "velocity": plain(dq),
        "acceleration": plain(ddq),
        "imu": plain(truth["imu"]),
        "readings": [plain(row) for row in truth["ft"].reshape(-1, 6)],
        "torque": plain(truth["torque"]),
        "contacts": [plain(wrench) for wrench in wrenches[:count]],
        "known": [plain(wrench) for wrench in wrenches[count:]],
    }


def contact_scenarios(bench, random, scenarios, each):
    """The scenarios with `each` cases."""
    return [
        {
            **scenario,
            "cases": [
                contact_case(bench, random, f"{scenario['name']} {number}", scenario)
                for number in range(each)
            ],
        }
        for scenario in scenarios
    ]


# ---------------------------------------------------------------- files


def document(seed, head, lists):
    """JSON with one line per case. The head says what it was made with."""
    head = {"made_with": made_with(), "seed": seed} | head
    lines = [f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in head.items()]
    for key, values in lists.items():
        texts = (
            "    " + json.dumps(value, allow_nan=False, separators=(",", ":")) for value in values
        )
        lines.append(f"  {json.dumps(key)}: [\n" + ",\n".join(texts) + "\n  ]")
    return "{\n" + ",\n".join(lines) + "\n}\n"
