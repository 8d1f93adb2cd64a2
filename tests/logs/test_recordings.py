"""Recordings by others' libraries: the same numbers as in CSV, and one clear line for whatever is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bag_files
import pumafuse as pf
from bag_files import KINDS, motion, written
from pumafuse.errors import RunError
from pumafuse.logs import recordings
from refusals import one_line

ARM = """
name = "lift"
update_period_ms = 20.0
delay_ms = 30.0
""" + "".join(
    f"""
[axes.{axis}]
plant = "first-order"
time_constant_ms = 40.0
"""
    for axis in "xyz"
)
FUSION = """
arm = "arm.toml"
[start]
offset_sd_mm = 2.0
[process]
input_noise_mm_rtHz = 0.05
drift_mm_rts = 0.2
[sensors.camera]
sd_mm = 1.0
[sensors.encoder]
sd_mm = 1.0
[sensors.level]
sd_mm = 2.0
latency_ms = 4.0
"""


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> pf.FusionConfig:
    folder = tmp_path_factory.mktemp("config")
    (folder / "arm.toml").write_text(ARM)
    (folder / "fusion.toml").write_text(FUSION)
    return pf.FusionConfig.load(folder / "fusion.toml")


@pytest.fixture(scope="module")
def expected(config: pf.FusionConfig, tmp_path_factory: pytest.TempPathFactory) -> pf.Estimates:
    folder = tmp_path_factory.mktemp("csv")
    (folder / "run.toml").write_text(bag_files.csv(folder, motion()))
    return pf.fuse(pf.Run.read(folder), config)


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_fuses_bit_for_bit_like_the_same_data_in_csv(
    kind: str, config: pf.FusionConfig, expected: pf.Estimates, tmp_path: Path
) -> None:
    """Stamps keep their nanoseconds and numbers all their digits, whatever format and compression."""
    written(tmp_path, KINDS[kind], motion())
    est = pf.fuse(pf.Run.read(tmp_path), config)
    assert np.array_equal(est.time, expected.time)
    for axis in "xyz":
        for name in ("position", "position_sd", "velocity"):
            found, other = getattr(est[axis], name), getattr(expected[axis], name)
            assert np.array_equal(found, other, equal_nan=True), (axis, name)
    assert est.measurements.counts() == expected.measurements.counts() == {"fused": 750}  # 150 · (3 + 1 + 1)
    assert est.notes == expected.notes


@pytest.mark.parametrize("kind", KINDS)
def test_topics_are_listed_with_type_number_and_numeric_fields(kind: str, tmp_path: Path) -> None:
    """The listing says what is there: as many messages as were written, and the paths that read() takes."""
    samples = motion(20)
    path = written(tmp_path, KINDS[kind], samples)
    listed = {topic.name: topic for topic in recordings.topics(path)}
    for topic, mine in bag_files.topics(samples):
        found = listed[topic]
        assert found.count == len(mine) == 20
        table = recordings.read(path, topic)
        assert table.rows == 20
        for name in found.fields:
            table.column(name)
        if kind != "rrd":
            assert (found.first, found.last) == (mine[0].logged, mine[-1].logged)
    if KINDS[kind].manifest == bag_files.ROS:
        assert listed["/joints"].fields[-2:] == ("position[slide]", "position[lift]")
        assert {name: topic.type.replace("/msg/", "/") for name, topic in listed.items()} == {
            name: one.replace("/msg/", "/") for name, one in bag_files.TYPES.items()
        }


def test_only_fields_that_are_asked_for_are_kept(tmp_path: Path) -> None:
    """A path keeps its top field; the others are named, so that a wrong name can be answered with the right ones."""
    path = written(tmp_path, KINDS["mcap"], motion(5))
    table = recordings.read(path, "/command", ["pose.position.x"])
    assert set(table.columns) == {"pose", "log_time"}
    text = one_line(RunError, lambda: recordings.read(path, "/command", ["log_time"]).column("pose2"))
    assert "pose2" in text
