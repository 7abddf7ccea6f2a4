"""Makes the golden files of this folder with MuJoCo, Pinocchio and iDynTree.

Usage: python generate.py [--out DIR]
           all golden files; DIR is this file's folder by default
       python generate.py --icub URDF --out DIR
           only the iCub's file, which is not part of the repository
       python generate.py --robots WHEEL... --out DIR
           only the URDFs in these wheels, and robots.json
       python generate.py --sessions [--icub URDF] --out DIR
           only sessions of the arm or of the iCub, with full length and rate

Needs the packages of requirements.txt; --any-version accepts other versions of them.

These libraries share no code with this project. Two or three of them compute every number, each
with its own URDF reader, and the script fails if they disagree. README.md describes the contents
and the conventions of the files.
"""

import argparse
import pathlib
import sys

sys.dont_write_bytecode = True  # no __pycache__ beside the golden files

import arm
import icub
import robots
import sessions
import walker
from libraries import made_with, must, pinned

HERE = pathlib.Path(__file__).resolve().parent
CONFIG = HERE.parent.parent / "config"


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument(
        "--out",
        type=pathlib.Path,
        default=HERE,
        help="folder to write the golden files to (default: this file's)",
    )
    arguments.add_argument(
        "--icub",
        type=pathlib.Path,
        help="iCubGazeboV2_5.urdf of icub-models: make only icub_v25.json",
    )
    arguments.add_argument(
        "--robots",
        type=pathlib.Path,
        nargs="+",
        metavar="WHEEL",
        help="wheels with URDFs (example-robot-data, icub-models): make only robots.json",
    )
    arguments.add_argument(
        "--sessions", action="store_true", help="make only sessions, with full length and rate"
    )
    arguments.add_argument(
        "--seed",
        type=int,
        default=sessions.SEED,
        help="seed of the sessions (default: that of the repository's sessions)",
    )
    arguments.add_argument(
        "--encoder-step-deg", type=float, help="step of the sessions' encoders (default: 1e-5 rad)"
    )
    arguments.add_argument(
        "--any-version",
        action="store_true",
        help="accept other versions than requirements.txt; the last digits may then differ",
    )
    arguments = arguments.parse_args()
    out = arguments.out.resolve()
    must(
        not arguments.sessions or out != HERE,
        "generate.py: --sessions needs another --out: the repository's sessions are shorter",
    )
    special = arguments.seed != sessions.SEED or arguments.encoder_step_deg
    must(
        arguments.sessions or not special,
        "generate.py: --seed and --encoder-step-deg need --sessions: golden files have fixed ones",
    )
    must(
        not (arguments.icub or arguments.robots) or out != HERE,
        "generate.py: --icub and --robots need another --out: what is made from that URDF "
        "has its licence and "
        "must not be in the repository",
    )
    here = made_with()
    others = [
        f"{package} {here[package]}, not {version}"
        for package, version in pinned().items()
        if here[package] != version
    ]
    must(
        not others or arguments.any_version,
        f"generate.py: {'; '.join(others)} (requirements.txt). --any-version accepts them",
    )
    out.mkdir(parents=True, exist_ok=True)

    urdf = CONFIG / "icub_left_arm" / "model.urdf"
    if arguments.sessions:
        sessions.write_in_full(
            arguments.icub or urdf,
            bool(arguments.icub),
            out,
            arguments.seed,
            arguments.encoder_step_deg,
        )
    elif arguments.robots:
        robots.write(arguments.robots, out)
    elif arguments.icub:
        icub.write(arguments.icub, out)
    else:
        arm.write(urdf, out)
        walker.write(out)
        sessions.write_arm(urdf, out / "sessions")


if __name__ == "__main__":
    main()
