"""Runs the programs of this folder in turn, checks that they agree, and prints their times.

Usage: python drive.py FOLDER [--rounds N] [--row ROW]...
(needs only the standard library; `run` builds the programs into FOLDER and calls this)

Every program loads the robot, then waits for requests (the protocol is in server.rs). First each
row's outputs are compared at a few states, by name. A difference from our portable build of more
than 1e-9 of the largest value of its kind ends the run. Then come the rounds. In each, every
program computes one batch of every row, one after the other on the same core, so that a disturbance
of the machine affects all of them equally. The results are the least and the median of the rounds'
times per call, and their ratios to ours.
"""

import argparse
import datetime
import json
import math
import os
import pathlib
import platform
import re
import statistics
import subprocess
import sys

# Name, what is computed. A new row needs a line here and an entry in the programs that have it.
ROWS = {
    "kinematics": "pose, velocity and acceleration of 33 links (ours: their net wrenches too)",
    "rnea": "inverse dynamics (RNEA), base standing, 33 links",
    "rnea_floating": "inverse dynamics (RNEA), base moving, 33 links",
    "regressor_33": "regressor, base moving, 38 x 330",
    "regressor_39": "regressor, base moving, F/T joints kept, 38 x 390",
    "pass_33": "least squares over a log: regressor_33, its rows into [R z] every 16 samples; "
    "per sample",
    "cycle": "full cycle: kinematics, 6 F/T readings to 7 contact wrenches and 32 torques",
    "recursion_44": "recursive least squares, 44 unknowns, 6 rows a sample, solved at each sample; "
    "per sample",
    "panels_44": "the same, absorbed and solved every 8 samples; per sample, square-root form",
}
# Name in the tables, command in the folder. The first two are those that the others are compared
# with.
OURS_NATIVE, OURS_PORTABLE = "ours, native", "ours, portable"
IDYNTREE = "iDynTree, portable: the wheel's libraries"
PROGRAMS = {
    OURS_NATIVE: ["native/release/peers-ours", "robot.urdf", "states.txt"],
    OURS_PORTABLE: ["portable/release/peers-ours", "robot.urdf", "states.txt"],
    IDYNTREE: ["peers-idyntree", "robot.urdf", "states.txt"],
    "Pinocchio, native": ["peers-pinocchio", "pinocchio.txt", "states.txt"],
    "dynibo, native": ["dynibo/release/peers-dynibo", "folded.urdf", "states.txt"],
    "Eigen, native": ["peers-eigen"],
}
# The build of ours with the same kind of flags as a peer: the ratio to it compares libraries, not
# compiler flags.
BUILT_LIKE = {
    IDYNTREE: OURS_PORTABLE,
    "Pinocchio, native": OURS_NATIVE,
    "dynibo, native": OURS_NATIVE,
    "Eigen, native": OURS_NATIVE,
}
REFERENCE = OURS_PORTABLE
TOLERANCE = 1e-9
SHOWN_STATES = (0, 17, 63)
BATCH_NS = 2e6  # much more than the clock and the pipe take, much less than most disturbances


class Failure(Exception):
    """The reason for which the run ends, in one sentence."""


class Program:
    def __init__(self, name, folder):
        self.name = name
        path, *arguments = PROGRAMS[name]
        try:
            self._process = subprocess.Popen(
                [str(folder / path), *arguments],
                cwd=folder,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        except OSError as error:
            raise Failure(f"{name}: {error}") from error
        self.rows = self._ask("rows").split()
        unknown = set(self.rows) - set(ROWS)
        if unknown:
            raise Failure(
                f"{name} has rows that drive.py does not know: {' '.join(sorted(unknown))}"
            )

    def _ask(self, line):
        try:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            raise Failure(
                f"{self.name} ended when asked '{line}', with status {self._process.wait()}"
            )
        return answer

    def time(self, row, calls):
        """Nanoseconds per call."""
        return float(self._ask(f"time {row} {calls}"))

    def show(self, row, state):
        """The outputs of a row at a state, by name."""
        return {
            name: float(value)
            for name, value in (
                pair.split("=") for pair in self._ask(f"show {row} {state}").split()
            )
        }

    def close(self):
        self._process.stdin.close()
        self._process.wait()


def largest_difference(values, reference):
    """The largest difference of two outputs, and its name. Both must have the same names.

    It is relative to the largest value of the same kind.
    """
    if values.keys() != reference.keys() or not values:
        only = sorted(values.keys() ^ reference.keys())
        raise Failure(f"not the same outputs: {' '.join(only[:8]) or 'none'}")
    # A comparison with NaN would always pass.
    wrong = [
        name
        for output in (values, reference)
        for name, value in output.items()
        if not math.isfinite(value)
    ]
    if wrong:
        raise Failure(f"not finite: {' '.join(wrong[:8])}")
    size = {}
    for name, value in reference.items():
        kind = name.partition("/")[0]
        size[kind] = max(size.get(kind, 0.0), abs(value))
    worst, where = 0.0, ""
    for name, value in values.items():
        difference = abs(value - reference[name])
        scale = size[name.partition("/")[0]]
        if difference > worst * scale:
            worst, where = difference / scale if scale else float("inf"), name
    return worst, where


def check(row, programs):
    """Fails unless the outputs of a row agree. Returns the largest difference by program."""
    reference = next((p for p in programs if p.name == REFERENCE), programs[0])
    found = {}
    for program in programs:
        if program is reference:
            continue
        for state in SHOWN_STATES:
            try:
                worst, where = largest_difference(
                    program.show(row, state), reference.show(row, state)
                )
            except Failure as failure:
                raise Failure(f"{row}, {program.name} and {reference.name}: {failure}") from failure
            if worst > TOLERANCE:
                raise Failure(
                    f"{row}, state {state}: {program.name} differs from {reference.name} "
                    f"by {worst:.1e} in {where}"
                )
            found[program.name] = max(found.get(program.name, 0.0), worst)
    return found


def measure(rows, rounds):
    """Nanoseconds per call in each round, by row and program."""
    times = {row: {program.name: [] for program in programs} for row, programs in rows.items()}
    calls = {
        (row, program.name): max(64, round(BATCH_NS / program.time(row, 64)))
        for row, programs in rows.items()
        for program in programs
    }
    for number in range(rounds):
        for row, programs in rows.items():
            # Another program first in each round, so that the order changes.
            shift = number % len(programs)
            for program in programs[shift:] + programs[:shift]:
                times[row][program.name].append(program.time(row, calls[row, program.name]))
    return times


def machine():
    """The machine on which the times were measured."""
    try:
        cpus = re.findall(
            r"^model name\s*: (.*)$", pathlib.Path("/proc/cpuinfo").read_text(), re.MULTILINE
        )
    except OSError:
        cpus = []
    return {
        "cpu": cpus[0] if cpus else platform.machine(),
        "cores": sorted(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "system": platform.platform(),
        "time": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
    }


def report(times, differences):
    """The rows of the result, as data."""
    rows = []
    for row, by_program in times.items():
        low = {name: min(values) / 1e3 for name, values in by_program.items()}
        middle = {name: statistics.median(values) / 1e3 for name, values in by_program.items()}
        for name in by_program:
            rows.append(
                {
                    "row": row,
                    "program": name,
                    "min_us": low[name],
                    "median_us": middle[name],
                    # Relative to ours.
                    "ratio_min": {
                        ours: low[name] / low[ours] for ours in (OURS_NATIVE, OURS_PORTABLE)
                    },
                    "ratio_median": {
                        ours: middle[name] / middle[ours] for ours in (OURS_NATIVE, OURS_PORTABLE)
                    },
                    "built_like": BUILT_LIKE.get(name),
                    "difference": differences[row].get(name),
                }
            )
    return rows


def markdown(rows, rounds, at):
    """The result as Markdown tables."""
    lines = [
        f"{at['cpu']}, core {' '.join(map(str, at['cores']))}, {at['system']}, {at['time']}; "
        f"load {at['load']:.2f} at the start; {rounds} rounds.",
        "Microseconds per call. Ratio: the program's time over ours, of the least / of the "
        "medians. Difference: the largest relative difference of the outputs.",
        "The ratio that counts, marked *, is to the build of ours with the same kind of flags: the",
        "portable one for iDynTree, whose libraries are built for any processor.",
        "",
    ]
    header = ["program", "min", "median", "ratio to native", "ratio to portable", "difference"]
    for row, title in ROWS.items():
        entries = [entry for entry in rows if entry["row"] == row]
        if not entries:
            continue
        table = [header]
        for entry in entries:
            ratios = [
                f"{entry['ratio_min'][ours]:.2f} / {entry['ratio_median'][ours]:.2f}"
                f"{' *' if entry['built_like'] == ours else '  '}"
                for ours in (OURS_NATIVE, OURS_PORTABLE)
            ]
            difference = "-" if entry["difference"] is None else f"{entry['difference']:.0e}"
            table.append(
                [
                    entry["program"],
                    f"{entry['min_us']:.2f}",
                    f"{entry['median_us']:.2f}",
                    *ratios,
                    difference,
                ]
            )
        widths = [max(len(line[column]) for line in table) for column in range(len(header))]
        table.insert(1, ["-" * width for width in widths])
        lines += [f"## {row}: {title}", ""]
        for number, cells in enumerate(table):
            padded = [cells[0].ljust(widths[0])] + [
                cell.rjust(width) for cell, width in zip(cells[1:], widths[1:])
            ]
            if number == 1:
                padded[1:] = [cell[:-1] + ":" for cell in padded[1:]]
            lines.append("| " + " | ".join(padded) + " |")
        lines.append("")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description="see the top of this file")
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument(
        "--row", action="append", choices=ROWS, help="measure only this row; may be repeated"
    )
    arguments = parser.parse_args()
    if arguments.rounds < 1:
        parser.error("--rounds: at least 1")
    folder = arguments.folder.resolve()

    at = machine()
    if at["load"] > 0.5:
        print(
            f"drive.py: the machine is not idle (load {at['load']:.2f}): "
            "only the least times may be reliable",
            file=sys.stderr,
        )
    programs = [Program(name, folder) for name in PROGRAMS]
    rows = {
        row: [p for p in programs if row in p.rows]
        for row in ROWS
        if row in (arguments.row or ROWS)
    }
    rows = {row: having for row, having in rows.items() if having}
    for row, having in rows.items():
        if not {OURS_NATIVE, OURS_PORTABLE} <= {program.name for program in having}:
            raise Failure(f"{row}: one of the two builds of ours does not have this row")
    differences = {row: check(row, having) for row, having in rows.items()}
    compared = sum(map(len, differences.values()))
    print(
        f"drive.py: outputs agree in {compared} comparisons; now {arguments.rounds} rounds",
        file=sys.stderr,
    )
    times = measure(rows, arguments.rounds)
    for program in programs:
        program.close()

    result = report(times, differences)
    text = markdown(result, arguments.rounds, at)
    (folder / "results.md").write_text(text)
    (folder / "results.json").write_text(
        json.dumps({"machine": at, "rounds": arguments.rounds, "rows": result}, indent=1) + "\n"
    )
    print(text)


if __name__ == "__main__":
    try:
        main()
    except Failure as failure:
        sys.exit(f"drive.py: {failure}")
