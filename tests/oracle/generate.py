"""Makes the golden files of this folder with MuJoCo, Pinocchio and iDynTree: dynamics that owe nothing to this project's own.

Usage: python generate.py [--out DIR]                      (DIR: this file's folder by default; packages: requirements.txt)
       python generate.py --icub URDF --out DIR            (the iCub's file alone, which is no part of the repository)
       python generate.py --sessions [--icub URDF] --out DIR     (sessions alone, in full length and rate, of the arm or of the iCub)
       With --any-version also with other versions than those of requirements.txt.

Every number is computed by two or three of the libraries, each from the URDF by its own reader, and the script fails if they disagree. README.md says
what each file holds and in which conventions.
"""

import argparse
import pathlib
import sys

sys.dont_write_bytecode = True  # no __pycache__ beside the golden files

import arm
import icub
import sessions
import walker
from libraries import made_with, must, pinned

HERE = pathlib.Path(__file__).resolve().parent
CONFIG = HERE.parent.parent / "config"


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--out", type=pathlib.Path, default=HERE, help="folder to write the golden files to (default: this file's)")
    arguments.add_argument("--icub", type=pathlib.Path, help="iCubGazeboV2_5.urdf of icub-models: makes icub_v25.json, and nothing else")
    arguments.add_argument("--sessions", action="store_true", help="makes sessions in full, and nothing else")
    arguments.add_argument("--seed", type=int, default=sessions.SEED, help="of the sessions (default: that of the repository's)")
    arguments.add_argument("--encoder-step-deg", type=float, help="of the sessions' encoders (default: 1e-5 rad)")
    arguments.add_argument("--any-version", action="store_true", help="let versions differ from requirements.txt: digits may, then, too")
    arguments = arguments.parse_args()
    out = arguments.out.resolve()
    must(not arguments.sessions or out != HERE, "generate.py: --sessions wants an --out elsewhere: those of the repository are shorter")
    special = arguments.seed != sessions.SEED or arguments.encoder_step_deg
    must(arguments.sessions or not special, "generate.py: --seed and --encoder-step-deg are for --sessions: the golden files have their own")
    must(
        not arguments.icub or out != HERE,
        "generate.py: --icub wants an --out elsewhere: what is made from that URDF is under its licence, and is not to be in the repository",
    )
    here = made_with()
    others = [f"{package} {here[package]}, not {version}" for package, version in pinned().items() if here[package] != version]
    must(not others or arguments.any_version, f"generate.py: {'; '.join(others)} (requirements.txt). --any-version takes them as they are")
    out.mkdir(parents=True, exist_ok=True)

    urdf = CONFIG / "icub_left_arm" / "model.urdf"
    if arguments.sessions:
        sessions.write_in_full(arguments.icub or urdf, bool(arguments.icub), out, arguments.seed, arguments.encoder_step_deg)
    elif arguments.icub:
        icub.write(arguments.icub, out)
    else:
        arm.write(urdf, out)
        walker.write(out)
        sessions.write_arm(urdf, out / "sessions")


if __name__ == "__main__":
    main()
