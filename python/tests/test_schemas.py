"""The JSON Schemas of the configuration, which editors use: every configuration of this tree is
legal by them, and mistakes are not."""

import json
import tomllib
from pathlib import Path

import jsonschema
import pytest

TREE = Path(__file__).resolve().parents[2]
FILES = sorted([*TREE.glob("config/*/*.toml"), *TREE.glob("tests/real_leg/*.toml")])


def validator(file):
    schema = json.loads((TREE / f"docs/{file.stem}.schema.json").read_text())
    jsonschema.Draft7Validator.check_schema(schema)
    return jsonschema.Draft7Validator(schema)


@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.parent.name}/{file.name}")
def test_each_configuration_is_legal(file):
    assert list(validator(file).iter_errors(tomllib.loads(file.read_text()))) == []


@pytest.mark.parametrize(
    ("file", "right", "wrong"),
    [
        ("gateway.toml", "max_silence_ms", "max_silense_ms"),
        ("gateway.toml", 'driver = "ati', 'driver = "aty'),
        ("gateway.toml", 'kind = "virtual"', 'kind = "virtuel"'),
        ("gateway.toml", "period_ms = 2", 'period_ms = "2"'),
        ("estimator.toml", "[[force_torque]]", "[[force_torques]]"),
        ("estimator.toml", "[output]", "[output]\ntriger = 1"),
    ],
)
def test_a_mistake_is_not(file, right, wrong):
    file = TREE / "config/six_axis_arm" / file
    text = file.read_text()
    assert right in text
    mistaken = tomllib.loads(text.replace(right, wrong, 1))
    assert not validator(file).is_valid(mistaken)
