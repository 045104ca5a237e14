"""Rows that wait are those that rerun would write one by one, in fewer and larger pieces."""

import numpy as np
import pytest
import rerun as rr

from recordings.sinks.blueprint import CLOCK, FRAME
from recordings.sinks.entity_rows import BATCH_BYTES, EntityRows, blob, components_of, drawn, fields_of
from tests.recordings.sinks.recorded_scene import rows

RANDOM = np.random.default_rng(1)
PLACES, COLORS = RANDOM.normal(size=(5, 3)), RANDOM.integers(0, 256, (5, 3), np.uint8)
TRIANGLES = np.array([[0, 1, 2], [2, 3, 4]], np.uint32)
SOLID = rr.components.FillMode.Solid
SHAPES = [
    (rr.Points3D, {"positions": PLACES, "colors": COLORS, "radii": rr.Radius.ui_points(2.0)}),
    (rr.Points3D, {"positions": np.empty((0, 3)), "colors": np.empty((0, 3), np.uint8)}),
    (rr.Points2D, {"positions": [(1.0, 2.0)], "labels": ["one"], "show_labels": True, "draw_order": 3.0}),
    (rr.Points2D, {"positions": PLACES[:, :2], "colors": [(1, 2, 3, 150)], "radii": np.arange(5.0)}),
    (rr.Boxes3D, {"half_sizes": np.full((5, 3), 0.1), "centers": PLACES, "colors": COLORS, "fill_mode": SOLID}),
    (rr.Mesh3D, {"vertex_positions": PLACES, "triangle_indices": TRIANGLES, "vertex_colors": COLORS}),
    (rr.Arrows3D, {"origins": [PLACES[0]], "vectors": [PLACES[1]], "colors": [(255, 210, 60)]}),
    (rr.LineStrips3D, {"strips": [PLACES[:2], PLACES[2:]], "radii": rr.Radius.ui_points(1.0)}),
    (rr.LineStrips2D, {"strips": [[(0.0, 1.0), (2.0, 3.0)]], "colors": [(1, 2, 3)]}),
]


@pytest.mark.parametrize(("kind", "fields"), SHAPES)
def test_a_drawn_archetype_is_that_of_rerun(kind, fields):
    expected = {one.descriptor: one.content for one in components_of(kind(**fields))}
    for _ in range(2):  # rerun makes the first one
        found = {one.descriptor: one.content for one in drawn(kind, **fields).components}
        assert found.keys() == expected.keys()
        assert all(content.equals(expected[name]) for name, content in found.items())
        assert all(content.type == expected[name].type for name, content in found.items())


def test_a_row_lacks_what_it_leaves_out_and_has_nothing_where_it_is_cleared(tmp_path):
    stream = rr.RecordingStream("rows")
    stream.set_sinks(rr.FileSink(str(tmp_path / "rows.rrd")))
    waiting, form = EntityRows(stream), fields_of(rr.EncodedImage, media_type="image/png")
    for frame, components in enumerate([(blob(rr.EncodedImage, "blob", b"one"), *form), (), ()]):
        row = components or (blob(rr.EncodedImage, "blob", np.arange(frame, dtype=np.uint8)),)
        waiting.add("picture", (10 * frame, frame), row)
    waiting.add("picture", (30, 3), fields_of(rr.EncodedImage, clear_unset=True))
    waiting.send()
    stream.disconnect()
    assert rows(tmp_path / "rows.rrd", "/picture", "EncodedImage:media_type") == [(0, 0, ["image/png"]), (30, 3, [])]
    blobs = [value for *_, value in rows(tmp_path / "rows.rrd", "/picture", "EncodedImage:blob")]
    assert blobs == [[list(b"one")], [[0]], [[0, 1]], []]


def test_an_entity_is_sent_when_its_rows_are_large_and_others_wait(tmp_path):
    stream, path = rr.RecordingStream("rows"), tmp_path / "rows.rrd"
    stream.set_sinks(rr.FileSink(str(path)))
    waiting = EntityRows(stream)
    for frame in range(5):
        for name, content in (("large", bytes(BATCH_BYTES // 2)), ("small", b"small")):
            waiting.add(name, (10 * frame, frame), (blob(rr.EncodedImage, "blob", content),))
    waiting.send()
    stream.disconnect()
    chunks = [chunk.to_record_batch() for chunk in rr.chunk.RrdReader(str(path)).stream()]
    frames = [batch.column(FRAME).to_pylist() for batch in chunks if CLOCK in batch.schema.names]
    assert sorted(frames) == [[0, 1], [0, 1, 2, 3, 4], [2, 3], [4]]
