"""Tables as arrays, and `identify` and `estimate` on the sessions of MuJoCo."""

import numpy as np
import proprio
import pytest
from conftest import TREE

SESSIONS = TREE / "tests" / "oracle" / "sessions"


def test_a_table_is_columns(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,joint/a/position,reason/a\n0.5,1.25,\n0.75,,stale\n")
    table = proprio.read_table(path)
    assert list(table) == ["t", "joint/a/position", "reason/a"]
    assert list(table.t) == [0.5, 0.75]
    assert table["joint/a/position"][0] == 1.25 and np.isnan(table["joint/a/position"][1])
    assert list(table["reason/a"]) == ["", "stale"]
    assert list(table.of("joint/a/position").t) == [0.5]
    assert table.to_pandas().shape == (2, 3)
    assert table == table and table != proprio.read_table(path) and len({table}) == 1
    # Reasons are text, also where there are none.
    path.write_text("t,residual/a/reason\n0.5,\n")
    assert proprio.read_table(path)["residual/a/reason"].dtype.kind == "U"
    path.write_text("t,a\n1,2\n1,x\n")
    with pytest.raises(ValueError, match="line 3, column a: 'x' is no number"):
        proprio.read_table(path)
    path.write_text("t,a,a\n")
    with pytest.raises(ValueError, match="a is there twice"):
        proprio.read_table(path)
    path.write_text("t,a\n1,2,3\n")
    with pytest.raises(ValueError, match="line 2: 3 cells for 2 columns"):
        proprio.read_table(path)
    path.write_text("")
    with pytest.raises(ValueError, match="empty"):
        proprio.read_table(path)


def test_identify_and_estimate(tmp_path):
    config = SESSIONS / "estimator.toml"
    outcome = proprio.identify(
        config,
        SESSIONS / "train.csv",
        out=tmp_path / "result",
        validate=[SESSIONS / "validate.csv"],
    )
    assert outcome.grade == "accept" and outcome.why and outcome.parameters is not None
    assert outcome.summary["verdict"] == "identified"
    assert "<iframe" in outcome._repr_html_() and outcome.report.is_file()

    # Of the same session: each begins with other offsets of the sensor.
    measured = proprio.read_table(SESSIONS / "train.csv").of("joint/l_elbow/torque")
    error = {}
    for name, parameters in ("cad", None), ("identified", outcome.parameters):
        out = tmp_path / f"{name}.csv"
        estimates = proprio.estimate(
            config, SESSIONS / "train.csv", out=out, parameters=parameters
        )
        valid, torque = estimates.valid("l_elbow"), estimates.torque("l_elbow")
        assert np.isfinite(torque[valid]).all() and np.isnan(torque[~valid]).all()
        assert (estimates.torque_std("l_elbow")[valid] > 0).all()
        truth = np.interp(estimates.t, measured.t, measured["joint/l_elbow/torque"])
        error[name] = np.abs(torque - truth)[valid]
    assert len(error["identified"]) > 0.9 * len(estimates.t), len(error["identified"])
    assert np.median(error["identified"]) < 0.5 * np.median(error["cad"]), error


def test_a_failure_is_one_and_costs_nothing(tmp_path, monkeypatch):
    config, samples = SESSIONS / "estimator.toml", SESSIONS / "train.csv"
    out, folder = tmp_path / "out.csv", tmp_path / "result"
    good = proprio.estimate(config, samples, out)
    assert any("estimates" in line for line in good.messages)
    kept = out.read_bytes()
    with pytest.raises(proprio.Failed):
        proprio.estimate("nowhere.toml", samples, out)
    assert out.read_bytes() == kept, "an earlier result stays"
    folder.mkdir()
    (folder / "summary.json").write_text("{}")
    with pytest.raises(proprio.Failed, match="nowhere.toml"):
        proprio.identify("nowhere.toml", samples, out=folder)
    assert (folder / "summary.json").read_text() == "{}"
    # A command that dies has not done it, whatever it left.
    dies = tmp_path / "proprio"
    dies.write_text(f"#!/bin/sh\necho 't' > {out}\necho 'No space left' >&2\nkill -9 $$\n")
    dies.chmod(0o755)
    monkeypatch.setenv("PROPRIO_PROGRAM", str(dies))
    with pytest.raises(proprio.Failed, match="No space left"):
        proprio.estimate(config, samples, out)


def test_the_commands_words_are_the_error(tmp_path):
    with pytest.raises(proprio.Failed, match="nowhere.toml"):
        proprio.estimate("nowhere.toml", SESSIONS / "train.csv", out=tmp_path / "out.csv")
    with pytest.raises(proprio.Failed, match="nowhere.csv"):
        proprio.identify(SESSIONS / "estimator.toml", "nowhere.csv", out=tmp_path / "result")


def test_the_pages_program_on_files(tmp_path, monkeypatch):
    page = (TREE / "docs/book/src/read/python.md").read_text()
    program = page.split("```python\n")[2].split("```")[0]
    for name in ("estimator.toml", "cad.urdf"):
        (tmp_path / name).write_bytes((SESSIONS / name).read_bytes())
    for to, of in ("a", "train"), ("b", "validate"), ("c", "validate"):
        (tmp_path / f"{to}.csv").write_bytes((SESSIONS / f"{of}.csv").read_bytes())
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(program, names)
    assert names["outcome"].grade == "accept" and names["estimates"].valid("l_elbow").any()
