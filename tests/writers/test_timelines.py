"""Timelines are opened by the libraries of their formats, which show the numbers that went in."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from asbuilt.dynamics import link_poses
from asbuilt.experiment import Recording
from asbuilt.findings import Finding
from asbuilt.validation import Validation, validate_samples
from asbuilt.writers import Timeline, Track, timelines_of_validations, write_mcap, write_rrd
from example_identification import Example


@pytest.fixture
def validation(example: Example) -> Validation:
    return validate_samples(example.result, example.held_out)


@pytest.fixture
def recording(example: Example, validation: Validation) -> Recording:
    """The recording of the held-out samples at twice their rate, on a line between two poses."""
    t = np.linspace(validation.t[0], validation.t[-1], 2 * len(validation.t) - 1)
    ends = np.array([[0.1, 0.2, 0.05, -0.3], [0.7, -0.4, 0.15, 0.3]])
    q = np.linspace(*ends, len(t))
    return Recording(
        t=t, q=q, tau=np.sin(q), source=validation.source, joint_names=example.model.joint_names
    )


@pytest.fixture
def timelines(example: Example, validation: Validation, recording: Recording) -> list[Timeline]:
    middle = float(validation.t[len(validation.t) // 2])
    found = [
        Finding("gap", "warning", "a gap of 2 s", time=middle),
        Finding("weak_excitation", "warning", "without a time"),
    ]
    return timelines_of_validations(example.model, [validation], [recording], found)


def test_positions_are_those_of_the_recording(timelines: list[Timeline]) -> None:
    (timeline,) = timelines
    share = (timeline.t - timeline.t[0]) / (timeline.t[-1] - timeline.t[0])
    np.testing.assert_allclose(timeline.q[:, 0], 0.1 + 0.6 * share, atol=1e-12)
    assert [mark.text for mark in timeline.marks] == ["a gap of 2 s."]


def test_mcap_holds_joint_states_and_logs(
    timelines: list[Timeline], validation: Validation, tmp_path: Path
) -> None:
    reader = pytest.importorskip("mcap.reader")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    path = write_mcap(tmp_path / "study.mcap", timelines)
    found: dict[str, list] = {}
    times = []
    with path.open("rb") as stream:
        opened = reader.make_reader(stream)
        assert opened.get_header().profile == "ros2"
        for schema, channel, message in opened.iter_messages(log_time_order=False):
            times.append(message.log_time)
            decoded = store.deserialize_cdr(message.data, schema.name)
            found.setdefault(channel.topic, []).append((message, decoded))
    assert times == sorted(times)
    assert set(found) == {"/measured", "/as_built", "/cad", "/error", "/position", "/events"}
    for topic, expected in (
        ("/measured", validation.measured),
        ("/as_built", validation.predicted),
        ("/cad", validation.predicted_cad),
        ("/error", validation.measured - validation.predicted),
    ):
        np.testing.assert_array_equal([each.effort for _, each in found[topic]], expected)
        assert found[topic][0][1].name == list(validation.joint_names)
    stamps = [each.header.stamp.sec + 1e-9 * each.header.stamp.nanosec for _, each in found["/cad"]]
    np.testing.assert_allclose(stamps, validation.t, atol=1e-9)
    ((_, event),) = found["/events"]
    assert (event.level, event.msg) == (30, "a gap of 2 s.")
    # The last eight bytes of a joint state with efforts are the last effort, by the standard.
    assert (
        struct.unpack("<d", found["/cad"][-1][0].data[-8:])[0] == validation.predicted_cad[-1, -1]
    )


@pytest.mark.study
def test_recordings_have_topics_of_their_own(timelines: list[Timeline], tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    pytest.importorskip("rosbags.typesys")
    path = write_mcap(tmp_path / "study.mcap", [*timelines, *timelines])
    with path.open("rb") as stream:
        topics = {each.topic for each in reader.make_reader(stream).get_summary().channels.values()}
    assert all(topic.count("/") == 2 for topic in topics)


def test_joints_with_times_of_their_own_are_messages_of_their_own(
    example: Example, tmp_path: Path
) -> None:
    reader = pytest.importorskip("mcap.reader")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    t = np.array([[-0.5, 0.0, 0.1, 0.2], [1.0, 1.1, 1.2, 1.3]])
    track = Track("external", t, 10.0 * t)
    nowhere = np.empty(0), np.empty((0, 4))
    path = write_mcap(tmp_path / "w.mcap", [Timeline("log", example.model, *nowhere, (track,))])
    with path.open("rb") as stream:
        messages = [
            (message.log_time, store.deserialize_cdr(message.data, schema.name))
            for schema, _, message in reader.make_reader(stream).iter_messages()
        ]
    seen = {(each.name[0], time): each.effort[0] for time, each in messages}
    names = example.model.joint_names
    expected = {
        (names[k], round(1e9 * (t[i, k] + 0.5))): 10.0 * t[i, k] for i in range(2) for k in range(4)
    }
    assert seen == pytest.approx(expected)


def test_rrd_holds_the_moving_robot_and_its_torques(
    timelines: list[Timeline], validation: Validation, example: Example, tmp_path: Path
) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    (timeline,) = timelines
    path = write_rrd(tmp_path / "study.rrd", timelines)
    tables = [each.to_record_batch() for each in chunk.RrdReader(path).stream()]
    places = {}
    for table in tables:
        place = table.schema.metadata[b"rerun:entity_path"].decode()
        places.setdefault(place, []).append(table)

    def values(place: str, component: str) -> np.ndarray:
        columns = [
            table.column(component).to_pylist()
            for table in places[place]
            if component in table.schema.names
        ]
        return np.array([row for column in columns for row in column]).squeeze()

    joint = example.model.joint_names[0]
    torque = values(f"/torque/{joint}/as_built", "Scalars:scalars")
    np.testing.assert_array_equal(torque, validation.predicted[:, 0])
    poses = link_poses(example.model, timeline.q)
    last = next(place for place in places if place.startswith("/robot/4") and place.count("/") == 2)
    np.testing.assert_allclose(
        values(last, "Transform3D:translation"), poses[:, 3, :3, 3], atol=1e-6
    )
    turned = values(last, "Transform3D:mat3x3").reshape(-1, 3, 3)
    np.testing.assert_allclose(turned.transpose(0, 2, 1), poses[:, 3, :3, :3], atol=1e-6)
    assert values("/events", "TextLog:text") == "a gap of 2 s."
    assert any("rod" in place or "housing" in place for place in places)
