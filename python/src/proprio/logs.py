"""Recorded tables and recordings as arrays, and `identify` and `estimate` on files."""

import csv
import html
import json
import math
import subprocess
import tempfile
from array import array
from os import PathLike
from pathlib import Path
from typing import Any, Dict, Iterator, List, Mapping, Optional, Sequence, Tuple, Union

import numpy as np
import numpy.typing as npt

from ._program import program

AnyPath = Union[str, "PathLike[str]"]


class Failed(RuntimeError):
    """The command did not do it; the text is its own."""


class Table(Mapping[str, npt.NDArray[Any]]):
    """The columns of a table by name, as ``table["joint/l_elbow/position"]``.

    Numbers are arrays of float64, NaN where a cell is empty; other columns (reasons) are arrays of
    text. ``proprio`` describes the names in its README; ``t`` are seconds.
    """

    def __init__(
        self, columns: Dict[str, npt.NDArray[Any]], messages: Sequence[str] = ()
    ) -> None:
        self._columns = columns
        self.messages = list(messages)
        """what the command that made it said of it, line by line"""

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    @property
    def t(self) -> npt.NDArray[Any]:
        """The stamps [s]."""
        return self._columns["t"]

    def of(self, name: str) -> "Table":
        """The rows in which this column has a value: a sensor's own samples."""
        column = self._columns[name]
        is_there = ~np.isnan(column) if column.dtype.kind == "f" else column != ""
        return Table({key: values[is_there] for key, values in self._columns.items()})

    def torque(self, joint: str) -> npt.NDArray[Any]:
        """The torque of a joint in a table of estimates [Nm]; NaN where it is withheld."""
        return self._columns[f"torque/{joint}"]

    def torque_std(self, joint: str) -> npt.NDArray[Any]:
        """Its standard deviation [Nm]; NaN where it is withheld."""
        deviation = self._columns[f"torque_std/{joint}"]
        return np.where(self.valid(joint), deviation, np.nan)

    def valid(self, joint: str) -> npt.NDArray[np.bool_]:
        """Where the torque of a joint may be used."""
        valid: npt.NDArray[np.bool_] = self._columns[f"valid/{joint}"] == 1
        return valid

    def to_pandas(self) -> Any:
        """A pandas.DataFrame."""
        import pandas

        return pandas.DataFrame(self._columns)

    # Columns are arrays, which have no single truth.
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def __repr__(self) -> str:
        rows = len(self._columns["t"]) if "t" in self._columns else 0
        return f"<Table of {rows} rows: {', '.join(self._columns)}>"


def _is_text(name: str) -> bool:
    return name.startswith("reason/") or name.endswith("/reason")


def read_recording(path: AnyPath, estimates: bool = False) -> Table:
    """The samples of a recording (MCAP), or its estimates, as a table.

    Raises Failed if it has none, or cannot be read. What ``messages`` says of a recording whose end
    is missing: its recorder was killed.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = str(Path(folder) / "table.csv")
        arguments = ["table", "--recording", str(path), "--out", out]
        code, said = _run(arguments + (["--estimates"] if estimates else []))
        if code != 0:
            raise _failed(code, said)
        table = read_table(out)
        table.messages = said
        return table


def read_table(path: AnyPath) -> Table:
    """Reads a table of samples or estimates (CSV).

    Raises OSError, and ValueError with the line if a row has more or fewer cells than there are
    columns, or a cell that is no number.
    """
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        names = next(reader, [])
        if not names:
            raise ValueError(f"{path} is empty")
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"{path}: the column {twice} is there twice")
        columns: List[Any] = [[] if _is_text(name) else array("d") for name in names]
        for row in reader:
            if len(row) != len(names):
                raise ValueError(
                    f"{path}, line {reader.line_num}: {len(row)} cells for {len(names)} columns"
                )
            for column, cell, name in zip(columns, row, names):
                if isinstance(column, list):
                    column.append(cell)
                    continue
                try:
                    column.append(float(cell) if cell else math.nan)
                except ValueError:
                    raise ValueError(
                        f"{path}, line {reader.line_num}, column {name}: {cell!r} is no number"
                    ) from None
    arrays = [np.array(c, dtype=str) if isinstance(c, list) else np.array(c) for c in columns]
    return Table(dict(zip(names, arrays)))


def _run(arguments: Sequence[str]) -> "Tuple[int, List[str]]":
    """Runs the command: its exit code, and what it said."""
    done = subprocess.run(
        [str(program()), *arguments], stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    return done.returncode, done.stderr.strip().splitlines()


def _failed(code: int, said: Sequence[str]) -> Failed:
    return Failed("\n".join(said[-20:]) or f"proprio ended with {code}")


def _paths(paths: Union[AnyPath, Sequence[AnyPath]]) -> List[str]:
    if isinstance(paths, (str, PathLike)):
        return [str(paths)]
    return [str(path) for path in paths]


def estimate(
    config: Optional[AnyPath],
    samples: AnyPath,
    out: Optional[AnyPath] = None,
    parameters: Optional[AnyPath] = None,
) -> Table:
    """Estimates joint torques and contact wrenches from a table or recording; `proprio estimate`.

    ``config`` is an estimator.toml (None: the one that a recording has), ``parameters`` a
    parameters.toml to use instead of the URDF's. Writes the table ``out``, if it is given. Raises
    Failed, with the command's own words.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "estimates.csv" if out is None else out)
        words = ["estimate", "--samples", str(samples), "--out", file]
        if config is not None:
            words += ["--config", str(config)]
        if parameters is not None:
            words += ["--parameters", str(parameters)]
        code, said = _run(words)
        if code != 0:
            raise _failed(code, said)
        table = read_table(file)
        table.messages.extend(said)
        return table


class Identification:
    """An outcome of ``identify``. In a notebook it shows its report, with all plots."""

    def __init__(self, folder: AnyPath, messages: Sequence[str] = ()) -> None:
        self.messages = list(messages)
        """what the command said, line by line"""
        self.folder = Path(folder)
        """where the files are"""
        self.summary: Dict[str, Any] = json.loads((self.folder / "summary.json").read_text())
        """summary.json: see the top of cli/src/identify/summary.rs"""

    @property
    def grade(self) -> str:
        """``accept``, ``care`` or ``reject``: whether to use the parameters."""
        return str(self.summary["advice"]["grade"])

    @property
    def why(self) -> List[str]:
        """Why, in sentences."""
        return list(self.summary["advice"]["why"])

    @property
    def next(self) -> List[str]:
        """What to do next, in sentences."""
        return list(self.summary["advice"]["next"])

    @property
    def parameters(self) -> Optional[Path]:
        """parameters.toml; None if the outcome was rejected."""
        path = self.folder / "parameters.toml"
        return path if path.is_file() else None

    @property
    def report(self) -> Path:
        """report.html"""
        return self.folder / "report.html"

    def _repr_html_(self) -> str:
        page = html.escape(self.report.read_text(encoding="utf-8"), quote=True)
        return f'<iframe srcdoc="{page}" style="width:100%;height:800px;border:0"></iframe>'

    def __repr__(self) -> str:
        return f"<Identification in {self.folder}: {self.grade}; {' '.join(self.why)}>"


def identify(
    config: AnyPath,
    samples: Union[AnyPath, Sequence[AnyPath]],
    out: AnyPath,
    validate: Union[AnyPath, Sequence[AnyPath]] = (),
) -> Identification:
    """Identifies inertial parameters, F/T offsets and friction from tables of samples; `proprio
    identify`.

    ``config`` is an estimator.toml. Writes the folder ``out``. A rejected outcome is an outcome:
    look at its ``grade``. Raises Failed, with the command's own words, if there is none.
    """
    words = ["identify", "--config", str(config), "--out", str(out)]
    for path in _paths(samples):
        words += ["--samples", path]
    for path in _paths(validate):
        words += ["--validate", path]
    summary = Path(out) / "summary.json"
    before = summary.stat() if summary.exists() else None
    code, said = _run(words)
    after = summary.stat() if summary.exists() else None
    # A rejected outcome ends the command with 1, and has a summary: a new file.
    is_new = after is not None and (
        before is None or (after.st_ino, after.st_mtime_ns) != (before.st_ino, before.st_mtime_ns)
    )
    if code not in (0, 1) or not is_new:
        raise _failed(code, said)
    return Identification(out, said)
