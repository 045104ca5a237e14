"""Images, numbers, texts, tables and dataclasses of a stage are drawn, and written in a standard form."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray

from flow.config.loader import load
from flow.errors import PipelineError
from recordings import McapSink
from recordings.errors import LogError
from recordings.mcap.file import iter_decoded
from recordings.results import read_result
from recordings.ros2.plain import array_of
from recordings.sinks.own_types import leaves, refusal
from stages.data import Disparity, StereoFrame, Transform
from stages.stage import Stage
from tests.conftest import FRAMES, roverflow
from tests.recordings.sinks.recorded_scene import START, Record, decoded, entities, record_of, rows, scene
from tests.recordings.sinks.test_mcap_sink import last_messages, logged

PIPELINE = """\
source: {use: recordings.McapSource}
streams:
  stereo:     {use: flow.align.pair, left: left, right: right, slop: 5 ms}
  sharpness:  {use: tests.recordings.sinks.test_own_types.Sharpness, frame: stereo}
  edges:      {use: tests.recordings.sinks.test_own_types.Edges, frame: stereo}
sinks:
  - {use: recordings.RerunSink}
  - use: recordings.McapSink
    results: [sharpness]
    also: [edges]
"""


@dataclass(frozen=True)
class Sharpness:
    def __call__(self, frame: StereoFrame) -> float:
        return float(frame.left.std())


@dataclass(frozen=True)
class Edges:
    def __call__(self, frame: StereoFrame) -> NDArray[np.uint8]:
        return np.asarray(cv2.Canny(np.ascontiguousarray(frame.left), 50, 100))


@dataclass(frozen=True)
class Surrogates(Stage):
    """A text, in its second frame of half a character."""

    def start(self) -> list[StereoFrame]:
        return []

    def __call__(self, frame: StereoFrame, *, state: list[StereoFrame]) -> str:
        state.append(frame)
        return "\ud800" if len(state) == 2 else "dusty"


@dataclass(frozen=True)
class Columns(Stage):
    """An image of four columns, but of three in its second frame, which makes it points."""

    def start(self) -> list[StereoFrame]:
        return []

    def __call__(self, frame: StereoFrame, *, state: list[StereoFrame]) -> NDArray[np.float32]:
        state.append(frame)
        return np.ones((5, 3 if len(state) == 2 else 4), np.float32)


@dataclass(frozen=True)
class Listing:
    def __call__(self, frame: StereoFrame) -> list[str]:
        return []


@dataclass(frozen=True)
class Report:
    stamp: int
    blur: float
    lamps: int | None
    mask: NDArray[np.bool_]
    corners: NDArray[np.float64]
    histogram: NDArray[np.int64]
    text: str
    range_m: tuple[float, float]
    mount: Transform
    disparity: Disparity
    by_side: Mapping[str, float]
    frame_id: str = "camera"


def report() -> Report:
    return Report(
        START, 2, None, np.eye(4, 5, dtype=bool), np.arange(6.0).reshape(2, 3), np.arange(4), "dusty", (0.5, 8.0),
        Transform("a", "b", np.eye(3), np.ones(3)), scene()["disparity"], {"left eye": 1, "2": 2.5},
    )  # fmt: skip


def written(path: Path, kinds: dict[str, Any], *frames: dict[str, Any]) -> dict[str, Any]:
    """The last message of each topic of a log with these streams."""
    assert not any(McapSink(results=tuple(kinds)).unwritable(name, kind) for name, kind in kinds.items())
    records = (Record(START + number, items) for number, items in enumerate(frames))
    return last_messages(logged(path, *records, streams=kinds, results=tuple(kinds)))


def drawn(path: Path, kinds: dict[str, Any], *frames: dict[str, Any]) -> set[str]:
    return entities(record_of(path, [Record(START + n, items) for n, items in enumerate(frames)], streams=kinds))


@pytest.mark.parametrize(("value", "kind", "message"), [
    (0.5, float, "Float64"), (3, float, "Float64"), (np.float32(0.5), np.float32, "Float64"), (7, int, "Int64"),
    (True, bool, "Bool"), (np.bool_(False), bool, "Bool"), ("dusty", str, "String"),
])  # fmt: skip
def test_numbers_and_texts_become_std_msgs(tmp_path, value, kind, message):
    read = written(tmp_path / "out.mcap", {"own": kind}, {"own": value})["/nav/own"]
    assert (read.__msgtype__, read.data) == (f"std_msgs/msg/{message}", value)


@pytest.mark.parametrize(("dtype", "shape", "encoding"), [
    (np.uint8, (4, 6), "mono8"), (np.uint8, (4, 6, 3), "rgb8"), (np.uint16, (4, 6), "mono16"),
    (np.float32, (4, 6), "32FC1"), (">f4", (4, 6), "32FC1"),
    (np.float16, (4, 6), "32FC1"), (bool, (4, 6), "mono8"), (np.int32, (4, 6), "32SC1"),
])  # fmt: skip
def test_images_become_sensor_msgs_images(tmp_path, dtype, shape, encoding):
    pixels = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    read = written(tmp_path / "out.mcap", {"own/image": np.ndarray}, {"own/image": pixels})["/nav/own/image"]
    assert (read.__msgtype__, read.encoding, read.height, read.width) == ("sensor_msgs/msg/Image", encoding, 4, 6)
    np.testing.assert_array_equal(array_of(read), 255 * pixels.astype(np.uint8) if dtype is bool else pixels)


def test_a_dataclass_becomes_a_topic_per_field(tmp_path):
    read = written(tmp_path / "out.mcap", {"own": Report}, {"own": report()})
    del read["/nav/diagnostics"]
    types = {topic.removeprefix("/nav/own/"): message.__msgtype__ for topic, message in read.items()}
    assert {name: kind.replace("/msg/", "/") for name, kind in types.items()} == {
        "blur": "std_msgs/Float64", "mask": "sensor_msgs/Image", "corners": "sensor_msgs/PointCloud2",
        "histogram": "std_msgs/Int64MultiArray", "text": "std_msgs/String", "range_m": "std_msgs/Float64MultiArray",
        "mount": "geometry_msgs/TransformStamped", "disparity": "stereo_msgs/DisparityImage",
        "disparity/source": "sensor_msgs/Image", "disparity/camera_info": "sensor_msgs/CameraInfo",
        "by_side/left_eye": "std_msgs/Float64", "by_side/_2": "std_msgs/Float64",
    }  # fmt: skip
    assert read["/nav/own/mask"].header.frame_id == "camera"
    assert read["/nav/own/histogram"].data.tolist() == [0, 1, 2, 3]
    assert array_of(read["/nav/own/range_m"]).tolist() == [0.5, 8.0]


@pytest.mark.parametrize(("kind", "values", "message"), [
    (list[int], [[], [1]], "Int64MultiArray"), (list[float], [[1, 2], [], [0.5]], "Float64MultiArray"),
    (tuple[float, float], [(1, 2), (0.5, 2)], "Float64MultiArray"), (list[bool], [[True], []], "Int64MultiArray"),
])  # fmt: skip
def test_the_annotation_of_a_list_decides_its_message(tmp_path, kind, values, message):
    read = written(tmp_path / "out.mcap", {"own": kind}, *({"own": value} for value in values))["/nav/own"]
    assert (read.__msgtype__, read.data.tolist()) == (f"std_msgs/msg/{message}", list(values[-1]))


def test_an_array_of_more_dimensions_is_read_back_in_its_shape(tmp_path):
    tensor = np.arange(24, dtype=np.int32).reshape(2, 3, 4)
    read = written(tmp_path / "out.mcap", {"own": np.ndarray}, {"own": tensor})["/nav/own"]
    np.testing.assert_array_equal(array_of(read), tensor)


LARGE = "a whole number beyond 64 bits has no standard form"


@pytest.mark.parametrize(("kind", "value", "part", "why"), [
    (dict[str, float], {"a b": 1.0, "a_b": 2.0}, "own/a_b", "its topic /nav/own/a_b is that of 'own/a b'; rename one"),
    (dict, {"a": b"raw"}, "own/a", "a value of type bytes has no standard form"),  # unlike its annotation
    (str, "\ud800", "own", "'utf-8' codec can't encode character"),
    (list[float], [[1.0], [1.0, 2.0]], "own", "setting an array element with a sequence"),
    (int, 1 << 63, "own", LARGE), (int, -(1 << 63) - 1, "own", LARGE),
    (np.ndarray, np.array([1, 1 << 63], np.uint64), "own", LARGE),
])  # fmt: skip
def test_a_value_without_a_message_or_a_topic_is_a_loss(tmp_path, kind, value, part, why):
    sink = McapSink(results=("own",))
    sink.open(tmp_path / "out.mcap", {"own": kind}, {})
    lost = sink.write(Record(START, {"own": value}))
    sink.discard()
    assert [*lost] == [part]
    assert lost[part].startswith(why)


def test_values_without_a_form_in_one_frame_are_losses_of_that_frame(tmp_path, traverse, capsys):
    file, out, summary = tmp_path / "own.yaml", tmp_path / "out.mcap", tmp_path / "summary.json"
    file.write_text(PIPELINE.replace("Sharpness", "Surrogates").replace("Edges", "Columns"))
    assert roverflow("run", traverse, "-p", file, "-o", out, "--workers", 2, "--summary", summary) == 3
    lost = {(loss["stage"], loss["stream"]) for loss in json.loads(summary.read_text())["ledger"]}
    assert lost == {
        ("recordings.McapSink", "sharpness"), ("recordings.McapSink", "edges"), ("recordings.RerunSink", "sharpness")
    }  # fmt: skip
    assert "  2 unwritable, first: edges at " in capsys.readouterr().out
    read = list(iter_decoded(out, ["/nav/sharpness", "/nav/edges"]))
    assert [topic for topic, *_ in read] == (FRAMES - 1) * ["/nav/sharpness", "/nav/edges"]
    statuses = last_messages(out)["/nav/diagnostics"].status
    assert [status.name for status in statuses if status.message.startswith("topic /nav/edges has the type ")] == [
        "recordings.McapSink/edges"
    ]


@pytest.mark.parametrize(("kind", "why"), [
    (list[str], "a list of anything but numbers has no standard form"),
    (NDArray[np.complex64], "an array of complex64 has no standard form"),
    (dict[str, bytes], "bytes has no standard form"),
    (float | None, ""), (tuple[int, ...], ""), (NDArray[Any], ""),
])  # fmt: skip
def test_a_type_without_a_standard_form_is_refused(kind, why):
    assert refusal(kind) == why


def test_the_refusal_names_the_field_and_the_line(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text(PIPELINE.replace("Edges", "Listing"))
    with pytest.raises(PipelineError) as refused:
        load(str(file))
    assert str(refused.value) == (
        "own.yaml:10: McapSink cannot write 'edges': a list of anything but numbers has no standard form; "
        "leave it out of 'also'"
    )


def test_a_pipeline_of_own_types_runs(tmp_path, traverse):
    file, out = tmp_path / "own.yaml", tmp_path / "out.mcap"
    file.write_text(PIPELINE)
    assert roverflow("run", traverse, "-p", file, "-o", out) == 0
    read = list(iter_decoded(out, ["/nav/sharpness", "/nav/edges"]))
    assert [topic for topic, *_ in read] == FRAMES * ["/nav/sharpness", "/nav/edges"]
    assert [frame.items["sharpness"] for frame in read_result(out, ["sharpness"])] == [m.data for _, _, m in read[::2]]
    for frame, (_, _, image) in zip(read_result(out, "edges"), read[1::2], strict=True):
        np.testing.assert_array_equal(frame.items["edges"], image.data.reshape(image.height, image.width))
    assert set(next(read_result(out)).items) == {"sharpness", "edges"}
    with pytest.raises(LogError, match=r"stream 'diagnostics' is .*/DiagnosticArray, which read_result does not read"):
        next(read_result(out, ["diagnostics"]))
    assert {"/sharpness", "/edges"} <= entities(out.with_suffix(".rrd"))
    arguments = ("-p", file, "-o", tmp_path / "viewer.mcap", "--no-rrd", "--profile", "foxglove", "--every", FRAMES)
    assert roverflow("run", traverse, *arguments) == 0
    with (tmp_path / "viewer.mcap").open("rb") as log:
        encodings = {channel.topic: channel.message_encoding for _, channel, _ in make_reader(log).iter_messages()}
    assert (encodings["/nav/sharpness"], encodings["/nav/edges"]) == ("cdr", "protobuf")


def test_own_types_are_drawn_field_by_field(tmp_path):
    path = tmp_path / "own.rrd"
    kinds = {"own/report": Report, "level": int, "note": str}
    found = drawn(path, kinds, {"own/report": report(), "level": 3, "note": "dry\n  soft"})
    own = {entity.removeprefix("/own/report/") for entity in found if entity.startswith("/own/report/")}
    assert own >= {"blur", "mask", "corners", "histogram", "text", "by_side/2", "disparity/pixels", "range_m"}
    assert rows(path, "/level", "Scalars:scalars")[0][2] == [3.0]
    assert [value for *_, value in rows(path, "/note", "TextLog:text")] == [["dry"], ["  soft"]]
    mask = decoded(rows(path, "/own/report/mask", "EncodedImage:blob")[0][2][0], cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(mask, 255 * np.eye(4, 5))


def test_an_image_that_a_frame_lacks_is_cleared(tmp_path):
    path = tmp_path / "own.rrd"
    drawn(path, {"own": np.ndarray}, {"own": np.ones((4, 5), np.float32)}, {})
    assert [row[1] for row in rows(path, "/own", "Clear:is_recursive") if row[2] is not None] == [1]


def test_leaves_have_their_paths():
    assert dict(leaves({"a": {"b": 1}, "c": None}, dict)) == {("a", "b"): 1.0}
