"""Sessions: logs of simulated boards with the true torques, for tests of identification.

MuJoCo moves the robot. A session is a log in the project's CSV format. Every board samples at its
own period and phase, its stamps are a little late, and its values have noise and a resolution. The
robot has the inertias of its URDF; the estimator gets another URDF, with errors of 20 % in every
link. Each robot has five sessions: `train` stands still, then swings; `validate` goes from posture
to posture; in `contact` the hand is pushed; in `payload` the hand picks up something half-way; in
`pushed` hand and forearm are pushed with 2 to 50 N without declaration. README.md ("Sessions")
describes the files.
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
    made_with,
    move_wrench,
    must,
    origin_of,
    rotation_of,
)

SEED = 20260704
GRAVITY = np.array([0.0, 0.0, -9.80665])
TOLERANCE = 1e-9  # of the largest magnitude of a quantity, over the compared instants

# Standard deviation and resolution of the readings of an iCub arm's strain board while the robot
# stands still: [fx fy fz tx ty tz] [N, Nm].
FT_NOISE = np.array([0.0760, 0.0894, 0.1794, 0.00194, 0.00286, 0.00143])
FT_STEP = np.array([1804.0] * 3 + [31.0] * 3) / 32768.0
# Offsets: random within +-OFFSET at the start of a session; then drift of a board that gets warm,
# and a random walk.
OFFSET = np.array([8.0] * 3 + [0.4] * 3)
WARM, WARM_SECONDS = np.array([0.7] * 3 + [0.01] * 3), 150.0
WALK = np.array([0.02] * 3 + [3e-4] * 3)  # per square root of a second
# IMU: noise and resolution of acceleration [m/s^2] and angular velocity [rad/s], as in the
# simulator and the driver.
IMU_NOISE = np.array([0.03] * 3 + [0.002] * 3)
IMU_STEP = np.array([0.01] * 3 + [np.pi / 180 / 16] * 3)
CLOCK_PPM = 30.0

PERTURBATION = 0.2
WRENCH, IMU = ("fx", "fy", "fz", "tx", "ty", "tz"), ("ax", "ay", "az", "gx", "gy", "gz")
PAYLOAD_MASS, PAYLOAD_SIDE, PICK_UP_SECONDS = 0.5, 0.06, 0.5
TRUTH_EVERY = 5  # samples of the first F/T sensor


# ---------------------------------------------------------------- inertias


def pseudo_inertia(link):
    """The 4x4 matrix [[integral x x' dm, m c], [m c', m]] of a <link>, in its axes.

    None for a link without mass.
    """
    inertial = link.find("inertial")
    if inertial is None or float(inertial.find("mass").get("value")) == 0.0:
        return None
    mass = float(inertial.find("mass").get("value"))
    i = {key: float(value) for key, value in inertial.find("inertia").attrib.items()}
    tensor = np.array(
        [
            [i["ixx"], i["ixy"], i["ixz"]],
            [i["ixy"], i["iyy"], i["iyz"]],
            [i["ixz"], i["iyz"], i["izz"]],
        ]
    )
    turn, centre = origin_of(inertial)
    tensor = turn @ tensor @ turn.T
    return assemble(mass, centre, np.trace(tensor) / 2 * np.eye(3) - tensor)


def assemble(mass, centre, spread):
    """The pseudo-inertia from mass, centre of mass, and second moments about the centre."""
    whole = np.zeros((4, 4))
    whole[:3, :3] = spread + mass * np.outer(centre, centre)
    whole[:3, 3] = whole[3, :3] = mass * centre
    whole[3, 3] = mass
    return whole


def take_apart(whole):
    """Mass, centre of mass, and second moments about the centre."""
    mass, centre = whole[3, 3], whole[:3, 3] / whole[3, 3]
    return mass, centre, whole[:3, :3] - mass * np.outer(centre, centre)


def set_inertia(link, whole):
    """Replaces the <inertial> of a <link>, in the link's axes."""
    mass, centre, spread = take_apart(whole)
    tensor = np.trace(spread) * np.eye(3) - spread
    inertial = link.find("inertial")
    text = lambda values: " ".join(f"{x:.9g}" for x in values)
    inertial.find("origin").set("xyz", text(centre))
    inertial.find("origin").set("rpy", "0 0 0")
    inertial.find("mass").set("value", f"{mass:.9g}")
    for key, (row, column) in {
        "ixx": (0, 0),
        "ixy": (0, 1),
        "ixz": (0, 2),
        "iyy": (1, 1),
        "iyz": (1, 2),
        "izz": (2, 2),
    }.items():
        inertial.find("inertia").set(key, f"{tensor[row, column]:.9g}")


def another_body(whole, random):
    """A similar physical body, with errors of 20 %, up or down.

    The errors are in the mass, each component of the first moment, and each principal second moment
    about the centre. The principal axes are rotated by 0.2 rad.
    """
    off = lambda count: PERTURBATION * random.choice([-1.0, 1.0], count)
    mass, centre, spread = take_apart(whole)
    extents, axes = np.linalg.eigh(spread)
    must(extents[0] > 0, "a link of the URDF is not physical")
    other_mass = mass * (1 + off(1)[0])
    axes = rotation_of(off(3) / np.sqrt(3)) @ axes
    return assemble(
        other_mass,
        mass * centre * (1 + off(3)) / other_mass,
        (axes * (extents * (1 + off(3)))) @ axes.T,
    )


def wrong_urdf(path, random):
    """A random URDF with errors for the estimator, without shapes."""
    tree = ElementTree.parse(path).getroot()
    for link in tree.findall("link"):
        for shape in link.findall("visual") + link.findall("collision"):
            link.remove(shape)
        whole = pseudo_inertia(link)
        if whole is not None:
            wrong = another_body(whole, random)
            must(np.linalg.eigvalsh(wrong)[0] > 0, f"{link.get('name')}: not physical")
            set_inertia(link, wrong)
    return ElementTree.tostring(tree, encoding="unicode") + "\n"


def wrong_enough(plan, world, path, random, file):
    """The first `wrong_urdf` with large enough errors of torque.

    In every joint beyond a sensor the RMS error must be more than a tenth of the RMS torque.
    Otherwise errors of neighbouring links may cancel, and there is nothing to identify. `file` is
    overwritten with each candidate.
    """
    robot = world.robot
    joints = [robot.joints.index(joint) for joint in plan["distal"]]
    instants = np.linspace(0, plan["durations"]["train"], 25)
    torques = lambda world: np.array([world.at(t)["torque"][joints] for t in instants])
    truth = torques(world)
    for _ in range(2000):
        text = wrong_urdf(path, random)
        file.write_text(text)
        engines = {
            "bare": (MuJoCo(Robot(file, robot.imu), floating=True), world.engines["bare"][1])
        }
        wrong = torques(World(plan, robot, engines, world.motion, world.leaning, None, None))
        if (np.sum((wrong - truth) ** 2, axis=0) > 0.1**2 * np.sum(truth**2, axis=0)).all():
            return text
    raise SystemExit("no URDF has large enough errors")


def loaded(robot, hand, centre):
    """The robot with a cube of PAYLOAD_MASS in its hand, its `centre` in the hand's axes."""
    other = Robot(robot.path, robot.imu)
    tree = ElementTree.fromstring(other.text)
    (link,) = [link for link in tree.findall("link") if link.get("name") == hand]
    cube = assemble(PAYLOAD_MASS, centre, PAYLOAD_MASS * PAYLOAD_SIDE**2 / 12 * np.eye(3))
    set_inertia(link, pseudo_inertia(link) + cube)
    other.text = ElementTree.tostring(tree, encoding="unicode")
    return other


# ---------------------------------------------------------------- motions


def smooth_step(x):
    """A step from 0 to 1 for x from 0 to 1, and its first two derivatives.

    Three derivatives are continuous at both ends.
    """
    x = np.clip(x, 0.0, 1.0)
    y = 1.0 - x
    return (
        x**4 * (35 + x * (-84 + x * (70 - 20 * x))),
        140 * (x * y) ** 3,
        420 * (x * y) ** 2 * (y - x),
    )


class Swing:
    """Every joint stands at `rest` until `still`, then follows three sines of 0.1 to 0.9 Hz.

    It stays within `reach` of `rest` and below `speed`.
    """

    BLEND = 2.0

    def __init__(self, random, rest, reach, speed, still):
        count = len(rest)
        frequency = random.uniform([0.1, 0.25, 0.5], [0.25, 0.5, 0.9], (count, 3))
        self.omega, self.phase = 2 * np.pi * frequency, random.uniform(0, 2 * np.pi, (count, 3))
        weight = random.uniform(0.5, 1.0, (count, 3)) / frequency
        fastest = (weight * self.omega).sum(axis=1) + weight.sum(axis=1) * (140 / 64) / self.BLEND
        self.weight = weight * np.minimum(reach / weight.sum(axis=1), speed / fastest)[:, None]
        self.rest, self.still = np.asarray(rest), still

    def at(self, t):
        w, dw, ddw = smooth_step((t - self.still) / self.BLEND)
        dw, ddw = dw / self.BLEND, ddw / self.BLEND**2
        angle = self.omega * t + self.phase
        s = (self.weight * np.sin(angle)).sum(axis=1)
        ds = (self.weight * self.omega * np.cos(angle)).sum(axis=1)
        dds = -(self.weight * self.omega**2 * np.sin(angle)).sum(axis=1)
        return self.rest + w * s, dw * s + w * ds, ddw * s + 2 * dw * ds + w * dds


class Postures:
    """Moves between random postures within `reach` of `rest`, with a stop in each.

    A move takes at least 1 s, and so long that no joint is faster than `speed`.
    """

    def __init__(self, random, rest, reach, speed, still, duration):
        self.starts, self.places, self.lasts = [still], [np.asarray(rest)], []
        while self.starts[-1] < duration:
            place = rest + reach * random.uniform(-1, 1, len(rest))
            gone = np.abs(place - self.places[-1]).max()
            self.lasts.append(max(random.uniform(1.0, 2.0), (140 / 64) * gone / speed))
            self.places.append(place)
            self.starts.append(self.starts[-1] + self.lasts[-1] + random.uniform(0.0, 0.4))

    def at(self, t):
        number = int(np.clip(np.searchsorted(self.starts, t) - 1, 0, len(self.lasts) - 1))
        last, way = self.lasts[number], self.places[number + 1] - self.places[number]
        s, ds, dds = smooth_step((t - self.starts[number]) / last)
        return self.places[number] + s * way, ds / last * way, dds / last**2 * way


class Pushes:
    """Forces of 4 to 10 N at one point of the hand, in its axes, for 1 to 3 s each.

    Each rises and falls within 0.15 s.
    """

    EDGE = 0.15

    def __init__(self, random, first, last, point):
        self.point, self.spans = point, []
        start = first
        while True:
            end = start + random.uniform(1.0, 3.0)
            if end > last:
                break
            direction = random.normal(size=3)
            self.spans.append(
                (start, end, random.uniform(4.0, 10.0) * direction / np.linalg.norm(direction))
            )
            start = end + random.uniform(1.5, 3.5)

    def at(self, t):
        force = np.zeros(3)
        for start, end, most in self.spans:
            force = (
                force
                + most
                * smooth_step((t - start) / self.EDGE)[0]
                * smooth_step((end - t) / self.EDGE)[0]
            )
        return np.concatenate([force, np.cross(self.point, force)])


class Pokes:
    """Undeclared pushes of one second, at one point of each of some links in turn.

    After each round of the links the force is the next of `forces`. Forces and points are in the
    axes of the link.
    """

    EDGE, LAST, PAUSE = 0.05, 1.0, 3.0

    def __init__(self, random, first, last, points, forces):
        self.spans, start, number = [], first, 0
        while start + self.LAST <= last:
            link, point = list(points.items())[number % len(points)]
            direction = random.normal(size=3)
            force = forces[number // len(points) % len(forces)]
            self.spans.append(
                (
                    start,
                    start + self.LAST,
                    force * direction / np.linalg.norm(direction),
                    link,
                    np.array(point),
                )
            )
            start, number = start + self.LAST + self.PAUSE, number + 1

    def at(self, t):
        """The pushed links, each with the wrench at its origin."""
        found = []
        for start, end, most, link, point in self.spans:
            if start < t < end:
                force = (
                    most
                    * smooth_step((t - start) / self.EDGE)[0]
                    * smooth_step((end - t) / self.EDGE)[0]
                )
                found.append((link, np.concatenate([force, np.cross(point, force)])))
        return found


class Leaning:
    """A root that swings up to 5 degrees about a point 0.3 m below it, from the time `still`."""

    ARM = np.array([0.0, 0.0, 0.3])

    def __init__(self, random, still):
        self.angles = Swing(random, np.zeros(2), 0.08, 0.3, still)

    def at(self, t):
        """The `base` of `MuJoCo.solve`: attitude, then velocity, classical acceleration, angular
        velocity and angular acceleration in the root's axes.
        """
        (r, p), (dr, dp), (ddr, ddp) = self.angles.at(t)
        sr, cr = np.sin(r), np.cos(r)
        omega = np.array([dr, dp * cr, -dp * sr])
        alpha = np.array([ddr, ddp * cr - dp * dr * sr, -ddp * sr - dp * dr * cr])
        velocity = np.cross(omega, self.ARM)
        return (
            rotation_of([r, p, 0.0]),
            velocity,
            np.cross(alpha, self.ARM) + np.cross(omega, velocity),
            omega,
            alpha,
        )


# ---------------------------------------------------------------- the robot, moved


class World:
    """The true motion, F/T and IMU readings, and torques at any time.

    All come from MuJoCo, with a second model for the robot with its payload.
    """

    def __init__(self, plan, robot, engines, motion, leaning, pushes, pick_up):
        self.plan, self.robot, self.engines, self.motion = plan, robot, engines, motion
        self.leaning, self.pushes, self.pick_up = leaning, pushes, pick_up

    def held(self, t):
        """The share of the payload that the hand carries; the rest is still on the table."""
        return (
            0.0
            if self.pick_up is None
            else float(smooth_step((t - self.pick_up) / PICK_UP_SECONDS)[0])
        )

    def at(self, t):
        share = self.held(t)
        parts = [(1 - share, self.engines["bare"])] * (share < 1) + [
            (share, self.engines.get("loaded"))
        ] * (share > 0)
        answers = [(weight, self.solve(t, *engine)) for weight, engine in parts]
        # Readings and torques are linear in the robot's inertias.
        return {
            key: sum(weight * answer[key] for weight, answer in answers) for key in answers[0][1]
        }

    def wrenches(self, t):
        if isinstance(self.pushes, Pokes):
            return self.pushes.at(t)
        return [] if self.pushes is None else [(self.plan["hand"], self.pushes.at(t))]

    def base(self, t, pinocchio):
        """Gravity and the `base` of `MuJoCo.solve`."""
        if self.leaning is not None:
            return GRAVITY, self.leaning.at(t)
        # The foot stands. Only the root's proper acceleration matters, so gravity can be zero.
        felt = pinocchio.root_motion(
            *self.motion.at(t), self.plan["stands_on"], np.concatenate([-GRAVITY, np.zeros(6)])
        )
        return np.zeros(3), (np.eye(3), np.zeros(3), felt[:3], felt[3:6], felt[6:])

    def solve(self, t, engine, pinocchio):
        state, (gravity, base), wrenches = (
            self.motion.at(t),
            self.base(t, pinocchio),
            self.wrenches(t),
        )
        answer = engine.solve(*state, gravity, wrenches, base)
        if self.plan["stands_on"] is not None:
            # The wrench that the root needs acts on the foot.
            root, foot = (
                engine.data.body(name) for name in (self.robot.root, self.plan["stands_on"])
            )
            turn = root.xmat.reshape(3, 3).T @ foot.xmat.reshape(3, 3)
            way = root.xmat.reshape(3, 3).T @ (foot.xpos - root.xpos)
            support = move_wrench(answer["base"], turn.T, -turn.T @ way)
            answer = engine.solve(
                *state, gravity, wrenches + [(self.plan["stands_on"], support)], base
            )
            must(np.abs(answer["base"]).max() < 1e-8, "a wrench remains on the root")
            answer["support"] = support
        return answer


# ---------------------------------------------------------------- the boards


def instants(random, period, duration):
    """The true times of a board's samples, and their stamps, which are up to 0.1 ms late."""
    period *= 1 + 1e-6 * CLOCK_PPM * random.uniform(-1, 1)
    t = np.arange(random.uniform(0, period), duration, period)
    return t, t + random.uniform(0, 1e-4, len(t))


def cell(value, digits):
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def in_steps(values, step):
    return np.round(values / step) * step


class Log:
    """A table with one row per sample of a board, in the order of stamps; other cells are empty."""

    def __init__(self, columns):
        self.columns, self.rows = {name: i for i, name in enumerate(columns)}, []

    def add(self, stamp, cells):
        row = [""] * len(self.columns)
        for name, text in cells.items():
            row[self.columns[name]] = text
        self.rows.append((stamp, len(self.rows), row))

    def text(self):
        lines = [",".join(["t", *self.columns])]
        lines += [f"{stamp:.5f}," + ",".join(row) for stamp, _, row in sorted(self.rows)]
        return "\n".join(lines) + "\n"


def record(plan, robot, world, duration, stream):
    """The log of one session, and the true offsets and pushes."""
    joints = robot.joints
    columns = [f"joint/{j}/position" for j in joints] + [f"joint/{j}/torque" for j in joints]
    columns += [f"wrench/{s.name}/{c}" for s in robot.sensors for c in WRENCH]
    columns += [f"imu/{plan['imu']}/{c}" for c in IMU] if plan["imu"] else []
    pushed = isinstance(world.pushes, Pushes)
    columns += [f"contact/{plan['contact']}/{c}" for c in ("active", *WRENCH)] if pushed else []
    log, truth = Log(columns), {"offsets": {}}

    for number, sensor in enumerate(robot.sensors):
        random = stream("force_torque", number)
        start, warm = random.uniform(-OFFSET, OFFSET), random.uniform(-WARM, WARM)
        walk, before, offset = np.zeros(6), 0.0, start
        for index, (t, stamp) in enumerate(zip(*instants(random, plan["ft_period"], duration))):
            walk = walk + np.sqrt(t - before) * WALK * random.normal(size=6)
            before, offset = t, start + warm * (1 - np.exp(-t / WARM_SECONDS)) + walk
            now = world.at(t)
            reading = now["ft"].reshape(-1, 6)[number] + offset + FT_NOISE * random.normal(size=6)
            cells = {
                f"wrench/{sensor.name}/{c}": cell(x, 3 if c[0] == "f" else 4)
                for c, x in zip(WRENCH, in_steps(reading, FT_STEP))
            }
            if number == 0 and index % TRUTH_EVERY == 0:
                cells |= {f"joint/{j}/torque": cell(x, 5) for j, x in zip(joints, now["torque"])}
                if pushed:
                    cells |= {
                        f"contact/{plan['contact']}/{c}": cell(x, 4)
                        for c, x in zip(WRENCH, world.pushes.at(t))
                    }
            log.add(stamp, cells)
        truth["offsets"][sensor.name] = {"start": plain(start), "end": plain(offset)}

    for number, board in enumerate(plan["encoders"]):
        random = stream("encoders", number)
        places = [joints.index(joint) for joint in board]
        for t, stamp in zip(*instants(random, plan["encoder_period"], duration)):
            noisy = world.motion.at(t)[0][places] + plan["encoder_noise"] * random.normal(
                size=len(places)
            )
            read = in_steps(noisy, plan["encoder_step"])
            log.add(stamp, {f"joint/{j}/position": cell(x, 5) for j, x in zip(board, read)})

    if plan["imu"]:
        random = stream("imu", 0)
        for t, stamp in zip(*instants(random, plan["imu_period"], duration)):
            read = in_steps(world.at(t)["imu"][:6] + IMU_NOISE * random.normal(size=6), IMU_STEP)
            log.add(
                stamp,
                {
                    f"imu/{plan['imu']}/{c}": cell(x, 2 if c[0] == "a" else 4)
                    for c, x in zip(IMU, read)
                },
            )

    if pushed:
        # The declaration begins a little before the contact and ends a little after it.
        declared = [(0.0, 0)] + [
            at
            for start, end, _ in world.pushes.spans
            for at in ((start - 0.05, 1), (end + 0.05, 0))
        ]
        for t, active in declared:
            log.add(t, {f"contact/{plan['contact']}/active": str(active)})
        truth["pushes"] = [
            {"from": round(start, 5), "to": round(end, 5), "force": plain(force)}
            for start, end, force in world.pushes.spans
        ]
    if isinstance(world.pushes, Pokes):
        truth["pushes"] = [
            {
                "from": round(start, 5),
                "to": round(end, 5),
                "force": plain(force),
                "link": link,
                "point": plain(point),
            }
            for start, end, force, link, point in world.pushes.spans
        ]
    return log.text(), truth


def plain(values):
    return [float(f"{x:.6g}") for x in np.asarray(values).ravel()]


# ---------------------------------------------------------------- sessions


def make(plan, urdf, out, seed):
    """Writes all files of a robot."""
    robot = Robot(urdf, plan["imu_frame"])
    stream = lambda *what: np.random.default_rng([seed, *(number_of(w) for w in what)])
    out.mkdir(parents=True, exist_ok=True)
    config = (
        plan["config"]
        .replace("POSITION_NOISE", f"{plan['encoder_step'] / 2 + 1.4e-4:.2g}")
        .replace("PALM", str(plan["palm"]))
    )
    (out / "estimator.toml").write_text(config)
    point = np.array(plan["palm"])
    payload = loaded(robot, plan["hand"], point)
    engines = {
        "bare": (MuJoCo(robot, floating=True), Pinocchio(robot)),
        "loaded": (MuJoCo(payload, floating=True), Pinocchio(payload)),
    }
    idyn = IDynTree(robot)
    lower, upper = (np.array([robot.limits[j][side] for j in robot.joints]) for side in (0, 1))
    rest, reach = (lower + upper) / 2, np.minimum(plan["reach"], 0.42 * (upper - lower))
    facts, exact = {}, []
    for name, duration in plan["durations"].items():
        still = 5.0 if name == "train" else 1.0
        of = lambda *what, name=name: stream(name, *what)
        if name in ("train", "contact", "pushed"):
            motion = Swing(of("motion"), rest, reach, plan["speed"], still)
        else:
            motion = Postures(of("motion"), rest, reach, plan["speed"], still, duration)
        leaning = Leaning(of("leaning"), still) if plan["stands_on"] is None else None
        pushes = (
            Pushes(of("pushes"), still + 3.0, duration - 2.0, point) if name == "contact" else None
        )
        if name == "pushed":
            points = {plan["hand"]: plan["palm"], plan["forearm"]: plan["forearm_point"]}
            pushes = Pokes(of("pushes"), still + 9.0, duration, points, plan["forces"])
        world = World(
            plan,
            robot,
            engines,
            motion,
            leaning,
            pushes,
            duration / 2 if name == "payload" else None,
        )
        if name == "train":
            (out / "cad.urdf").write_text(
                wrong_enough(plan, world, urdf, stream("cad"), out / "cad.urdf")
            )
        compared = compare(
            plan, robot, idyn, world, name, of("exact").uniform(0, duration, plan["compared"])
        )
        # The columns of exact.csv have no place for contacts other than that of the hand.
        exact += compared if name != "pushed" else []
        text, truth = record(plan, robot, world, duration, of)
        (out / f"{name}.csv").write_text(text)
        facts[name] = {"seconds": duration, "still_until": still, **truth}
        if name == "payload":
            cube = PAYLOAD_MASS * PAYLOAD_SIDE**2 / 6
            facts[name]["payload"] = {
                "from": duration / 2,
                "all_from": duration / 2 + PICK_UP_SECONDS,
                "link": plan["hand"],
                "mass": PAYLOAD_MASS,
                "centre": plain(point),
                "inertia_about_centre": plain([cube] * 3),
            }
        print(f"{out.name}/{name}.csv: {len(text) / 1000:.0f} kB, {text.count(chr(10)) - 1} rows")
    write_exact(plan, robot, out, exact)
    head = {
        "made_with": made_with(),
        "seed": seed,
        "model": plan["model"],
        "units": "SI; wrenches are [fx, fy, fz, tx, ty, tz]",
        "sessions": facts,
    }
    (out / "sessions.json").write_text(json.dumps(head, indent=1) + "\n")


def number_of(what):
    return what if isinstance(what, int) else int.from_bytes(what.encode(), "big") % (1 << 63)


def compare(plan, robot, idyn, world, name, times):
    """Compares the libraries at some instants of a session. Returns MuJoCo's answers there.

    iDynTree takes part without payload only, because it reads the URDF from its file.
    """
    rows, worst = [], 0.0
    for t in sorted(times):
        share = world.held(t)
        if 0 < share < 1:
            continue
        now, state = world.at(t), world.motion.at(t)
        pinocchio = world.engines["loaded" if share else "bare"][1]
        gravity, base = world.base(t, pinocchio)
        wrenches = world.wrenches(t)
        support = [(plan["stands_on"], now["support"])] if plan["stands_on"] else []
        by_pin = pinocchio.solve(*state, gravity, wrenches + support, base)
        shown = ("torque", "ft", "imu")
        worst = max(
            worst,
            check_agreement(
                f"{name} at {t:.3f} s: mujoco and pinocchio",
                TOLERANCE,
                {k: now[k] for k in shown},
                by_pin,
            ),
        )
        if not share:
            by_idyn = idyn.solve(
                *state, by_pin["imu"], wrenches, robot.imu, plan["stands_on"] or robot.root
            )
            worst = max(
                worst,
                check_agreement(
                    f"{name} at {t:.3f} s: mujoco and idyntree",
                    TOLERANCE,
                    {k: now[k] for k in ("torque", "ft")},
                    by_idyn,
                ),
            )
        rows.append((state, now, share, wrenches[0][1] if wrenches else None))
    print(
        f"{name}: mujoco, pinocchio and idyntree agree within {worst:.1e} at {len(rows)} instants"
    )
    return rows


def write_exact(plan, robot, out, rows):
    """Writes exact.csv: instants of the sessions, 10 s apart, without noise, offset or rounding.

    Every row contains all quantities. A payload counts as a contact of the hand, with an empty
    wrench.
    """
    columns = ["t"] + [
        f"joint/{j}/{what}"
        for j in robot.joints
        for what in ("position", "velocity", "acceleration", "torque")
    ]
    columns += [f"wrench/{s.name}/{c}" for s in robot.sensors for c in WRENCH]
    columns += (
        [f"imu/{plan['imu']}/{c}" for c in (*IMU, "alx", "aly", "alz")] if plan["imu"] else []
    )
    columns += [f"contact/{plan['contact']}/{c}" for c in ("active", *WRENCH)]
    lines = [",".join(columns)]
    for number, ((q, dq, ddq), now, share, pushed) in enumerate(rows):
        values = [np.stack([q, dq, ddq, now["torque"]], axis=1).ravel(), now["ft"]] + (
            [now["imu"]] if plan["imu"] else []
        )
        cells = [str(10 * number)] + [f"{x + 0.0:.13g}" for x in np.concatenate(values)]
        wrench = np.zeros(6) if pushed is None else pushed
        cells += (
            ["1", *[""] * 6]
            if share
            else ["0" if pushed is None else "1", *(f"{x + 0.0:.13g}" for x in wrench)]
        )
        must(len(cells) == len(columns), "a row is not as long as the header")
        lines.append(",".join(cells))
    (out / "exact.csv").write_text("\n".join(lines) + "\n")


# ---------------------------------------------------------------- robots

ARM_CONFIG = """\
# The arm of config/icub_left_arm for tests of identification: a URDF with errors of 20 % in every
# link, unknown offsets, and a hand that is free unless contact is declared or found. Written by
# tests/oracle/sessions.py.
schema = 1
robot = "icub_left_arm"
model = "cad.urdf"

[base]
kind = "imu"
sensor = "chest_imu"
link = "chest_imu_frame"

[[force_torque]]
sensor = "l_arm_ft_sensor"
joint = "l_arm_ft_sensor"
frame = "child"
direction = "child_to_parent"
noise_n = [0.076, 0.0894, 0.1794]
noise_nm = [0.00194, 0.00286, 0.00143]

[[contact]]
name = "stand"
link = "chest"

[[contact]]
name = "hand"
link = "l_hand"
position_m = PALM
presence = "possible"

[differentiation]
# Half an encoder's step, its noise of 2e-5 rad, and the error of stamps that are up to 0.1 ms late,
# which is 1e-4 rad at 1 rad/s.
position_noise_rad = POSITION_NOISE

[input]
max_silence_ms = 100.0

[output]
trigger = "l_arm_ft_sensor"
max_wait_ms = 60.0
"""

ARM = {
    "model": "config/icub_left_arm/model.urdf",
    "config": ARM_CONFIG,
    "imu": "chest_imu",
    "imu_frame": "chest_imu_frame",
    "stands_on": None,
    "hand": "l_hand",
    "palm": [-0.0017, 0.0056, 0.0592],
    "contact": "hand",
    "forearm": "l_forearm",
    "forearm_point": [0.0007, 0.0053, 0.0405],
    "encoders": [
        ["l_shoulder_pitch", "l_shoulder_roll", "l_shoulder_yaw", "l_elbow"],
        ["l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw"],
    ],
    "distal": ["l_elbow", "l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw"],
    # The resolution of a log with five decimals. The encoder of a geared motor has a finer one.
    "encoder_noise": 2e-5,
    "encoder_step": 1e-5,
    "reach": 0.8,
    "speed": 1.2,
    "compared": 30,
}
# The sessions in the repository are small: every board has a period of 20 ms.
SMALL = {
    "ft_period": 0.02,
    "encoder_period": 0.02,
    "imu_period": 0.02,
    "durations": {
        "train": 28.0,
        "validate": 18.0,
        "contact": 24.0,
        "payload": 24.0,
        "pushed": 27.0,
    },
    "forces": (5.0, 20.0),
}
FULL = {
    "ft_period": 0.01,
    "encoder_period": 0.01,
    "imu_period": 0.01,
    "durations": {
        "train": 45.0,
        "validate": 20.0,
        "contact": 45.0,
        "payload": 45.0,
        "pushed": 90.0,
    },
    "forces": (2.0, 5.0, 10.0, 20.0, 50.0),
}


def limb(side):
    arm = [
        f"{side}_shoulder_pitch",
        f"{side}_shoulder_roll",
        f"{side}_shoulder_yaw",
        f"{side}_elbow",
        f"{side}_wrist_prosup",
        f"{side}_wrist_pitch",
        f"{side}_wrist_yaw",
    ]
    leg = [
        f"{side}_hip_pitch",
        f"{side}_hip_roll",
        f"{side}_hip_yaw",
        f"{side}_knee",
        f"{side}_ankle_pitch",
        f"{side}_ankle_roll",
    ]
    return [arm, leg]


ICUB_CONFIG_HEAD = """\
# An iCub on its left foot for tests of identification: a URDF with errors of 20 % in every link,
# unknown offsets, and a hand that is free unless contact is declared or found. Written by
# tests/oracle/sessions.py.
schema = 1
robot = "icub"
model = "cad.urdf"

[base]
kind = "fixed"
link = "l_sole"
gravity_mps2 = [0.0, 0.0, -9.80665]
"""

ICUB_CONFIG_TAIL = """
[[contact]]
name = "hand"
link = "l_hand"
position_m = PALM
presence = "possible"

[differentiation]
# Half an encoder's step, its noise of 2e-5 rad, and the error of stamps that are up to 0.1 ms late,
# which is 1e-4 rad at 1 rad/s.
position_noise_rad = POSITION_NOISE

[input]
max_silence_ms = 100.0

[output]
max_wait_ms = 60.0
"""

ICUB = {
    "model": "iCubGazeboV2_5.urdf of icub-models 3.2.0",
    "imu": None,
    "imu_frame": "chest",
    "stands_on": "l_sole",
    "hand": "l_hand",
    "palm": [0.0, 0.0, 0.06],
    "contact": "hand",
    "forearm": "l_forearm",
    "forearm_point": [0.0, 0.005, 0.04],
    "encoders": [
        *limb("l"),
        *limb("r"),
        ["torso_pitch", "torso_roll", "torso_yaw"],
        ["neck_pitch", "neck_roll", "neck_yaw"],
    ],
    "distal": [*limb("l")[0][3:], *limb("r")[0][3:], *limb("r")[1][2:]],
    "encoder_noise": 2e-5,
    "encoder_step": 1e-5,
    "reach": 0.4,
    "speed": 1.0,
    "compared": 25,
}


def write_arm(urdf, out):
    """The small sessions of the arm, as in the repository."""
    make({**ARM, **SMALL}, urdf, out, SEED)


def write_in_full(urdf, icub, out, seed, encoder_step_deg=None):
    """Sessions of the arm or of the iCub, with full length and rate."""
    plan = {**(ICUB if icub else ARM), **FULL}
    if encoder_step_deg:
        plan["encoder_step"] = np.radians(encoder_step_deg)
    if icub:
        sensors = Robot(urdf, plan["imu_frame"]).sensors
        tables = "".join(
            f'\n[[force_torque]]\nsensor = "{sensor.name}"\njoint = "{sensor.joint}"\n'
            for sensor in sensors
        )
        plan["config"] = ICUB_CONFIG_HEAD + tables + ICUB_CONFIG_TAIL
    make(plan, urdf, out, seed)
