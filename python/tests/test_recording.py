"""A recording, read with the readers that its format's authors publish."""

import subprocess

import numpy as np
import proprio
import pytest
from conftest import until
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory


def test_others_read_a_recording(arm, tmp_path):
    with arm.reader() as robot:
        until("a torque", lambda: robot.update() or robot.torque("l_elbow"))
    out = tmp_path / "run.mcap"
    command = [str(proprio.program()), "record", "--out", str(out), "--seconds", "4"]
    done = subprocess.run(command, env=arm.environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr

    seen = {}
    with out.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert [m.metadata["robot"] for m in reader.iter_metadata()] == ["icub_left_arm"]
        for schema, channel, message, content in reader.iter_decoded_messages():
            seen.setdefault(channel.topic, []).append((schema.name, message.log_time, content))
    types = {topic: messages[0][0] for topic, messages in seen.items()}
    assert types["/joint_states"] == "sensor_msgs/msg/JointState"
    assert types["/imu/chest_imu"] == "sensor_msgs/msg/Imu"
    assert types["/ft/l_arm_ft_sensor"] == "geometry_msgs/msg/WrenchStamped"
    assert types["/samples/joint/l_elbow"] == "proprio_msgs/msg/Joint"

    # What viewers see is what was sampled and estimated.
    elbow = [(t, sample.position) for _, t, sample in seen["/samples/joint/l_elbow"]]
    states, torques = seen["/joint_states"], seen["/torques"]
    assert len(states) == len(torques) > 100
    for (_, t, state), (_, same, torque) in zip(states, torques):
        assert t == same and state.name == torque.joint and state.name[3] == "l_elbow"
        assert state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == t
        assert np.isnan(state.effort[3]) if not torque.valid[3] else (
            state.effort[3] == torque.torque[3] and torque.reason[3] == ""
        )
        newest = [position for at, position in elbow if t - 20_000_000 < at <= t]
        assert not newest or state.position[3] == newest[-1]
    raw = [sample for _, _, sample in seen["/samples/wrench/l_arm_ft_sensor"]]
    shown = [content.wrench for _, _, content in seen["/ft/l_arm_ft_sensor"]]
    assert [(s.fx, s.tz) for s in raw] == [(w.force.x, w.torque.z) for w in shown]
    raw = [sample for _, _, sample in seen["/samples/imu/chest_imu"]]
    shown = [content for _, _, content in seen["/imu/chest_imu"]]
    assert [(s.ax, s.gz) for s in raw] == [
        (i.linear_acceleration.x, i.angular_velocity.z) for i in shown
    ]
    assert shown[0].orientation_covariance[0] == (-1 if np.isnan(raw[0].qw) else 0)

    # All was well, and the file says so.
    states = [status for _, _, all_ in seen["/diagnostics"] for status in all_.status]
    assert len(states) > 20 and {status.name for status in states} >= {
        "icub_left_arm: gateway", "icub_left_arm: bus left_arm", "icub_left_arm: estimator"
    }
    bad = [(status.name, status.message) for status in states if status.level not in (0, b"\0")]
    assert not bad, bad

    # As tables: the samples, and the estimates, to the last bit.
    samples, estimates = proprio.read_recording(out), proprio.read_recording(out, estimates=True)
    own = samples.of("wrench/l_arm_ft_sensor/fx")["wrench/l_arm_ft_sensor/fx"]
    raw = [sample.fx for _, _, sample in seen["/samples/wrench/l_arm_ft_sensor"]]
    assert own.tolist() == raw
    live = np.array([torque.torque[3] for _, _, torque in torques])
    assert np.array_equal(estimates.torque("l_elbow"), live, equal_nan=True)
    assert estimates.valid("l_elbow").tolist() == [t.valid[3] for _, _, t in torques]
    again = proprio.estimate(arm.config / "estimator.toml", out)
    assert set(again) >= set(name for name in estimates if "/" in name)
    with pytest.raises(proprio.Failed, match="cannot be read"):
        proprio.read_recording(arm.config / "model.urdf")
