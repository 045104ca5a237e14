"""`roverflow report`: one HTML page about a run."""

import base64
import re
from html.parser import HTMLParser

import cv2
import numpy as np

from recordings.comparison.text import moment
from recordings.export.png_pages import elevation_page
from recordings.mcap.writer import Ros2Writer
from recordings.reporting.page import write_report
from recordings.reporting.run_facts import read_facts
from recordings.ros2 import to_msg as ros2
from recordings.sinks.colormaps import elevation_limits
from stages.data import ElevationMap
from tests.conftest import SMALL, rewrite, roverflow, run_fast

VOID = {"meta", "img", "link", "line", "circle", "polyline"}


class Page(HTMLParser):
    """The images, texts and outside references of a page, whose tags must be balanced."""

    def __init__(self, text):
        super().__init__()
        self.open, self.images, self.words, self.outside = [], [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.outside += [url for url in (values.get("src"), values.get("href")) if url and not url.startswith("data:")]
        if tag == "img":
            self.images.append((values["alt"], values["src"].partition(",")[2]))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def test_a_report_stands_alone_and_shows_maps_frames_and_losses(result, tmp_path, said):
    out = tmp_path / "out.html"
    assert f"wrote {out} (" in said(0, "report", result, "-o", out).out
    page = Page(out.read_text())
    assert page.outside == []
    assert out.stat().st_size < 5_000_000
    names = [name for name, _ in page.images]
    assert names[:2] == ["regional elevation map", "regional navigation map"]
    assert [name for name in names if "/nav/disparity" in name] == [
        "/nav/disparity of the typical frame", "/nav/disparity of the worst frame"
    ]  # fmt: skip
    for _, data in page.images:
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert pixels.std() > 10
    text = " ".join(page.words)
    assert "COMPLETE" in text
    assert "Nothing was lost." in text
    assert re.search(r"disparities=64", text)
    assert "\n# parts/match_pyramid.yaml:\n" in "\n".join(page.words)


def test_a_report_shows_all_ground_of_the_run_in_each_frame_of_reference(tmp_path, monkeypatch):
    path, drawn = tmp_path / "out.mcap", []
    with Ros2Writer(path) as writer:
        writer.metadata("roverflow", {"pipeline": ""})
        for frame_id, windows in (("odom", 3), ("odom/2", 2)):
            heights = np.tile(np.linspace(0, windows, 100 * windows, dtype=np.float32), (100, 1))
            drawn.append(ElevationMap(1, {"elevation": heights}, 0.1, (0.0, 0.0), frame_id))
            for number, part in enumerate(np.hsplit(heights, windows)):
                layers = {"elevation": part} | ({"slope": part} if number else {})  # others than heights do not matter
                grid = ElevationMap(number, layers, 0.1, (10.0 * number, 0.0), frame_id)
                writer.write("/nav/regional_map", ros2.grid_map(grid), 10 * len(drawn) + number)
    write_report(tmp_path / "out.html", [path])
    images = Page((tmp_path / "out.html").read_text()).images
    assert [name for name, _ in images] == ["regional elevation map"] * 2
    for (_, data), whole in zip(images, drawn, strict=True):
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        page = elevation_page(whole, elevation_limits(whole.layers["elevation"])).pixels
        page = cv2.resize(page, pixels.shape[1::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(page.astype(float) - pixels).mean() < 2
    monkeypatch.setattr("recordings.reporting.page.MAX_REGIONS", 1)
    write_report(tmp_path / "out.html", [path])
    text = (tmp_path / "out.html").read_text()
    assert Page(text).images == images[:1]
    assert "1 smaller map in other frames of reference" in text


def test_the_report_of_a_result_that_was_cut_says_so(result, tmp_path, said):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(result.read_bytes()[: result.stat().st_size // 2])
    assert f"WARNING: {cut}: the log is truncated or damaged at byte" in said(3, "report", cut).out
    text = " ".join(Page(cut.with_suffix(".html").read_text()).words)
    assert "the log is truncated before its verdict" in text
    assert "No loss is recorded before the log ends." in text
    assert "losses unknown" in text
    assert re.search(r"unreadable the log is truncated or damaged at byte \d+", text)


def test_two_results_stand_beside_each_other(traverse, result, tmp_path):
    other, change = tmp_path / "other" / result.name, ("--set", "navigation_map.rover.max_step=9 cm")
    other.parent.mkdir()
    assert roverflow("run", traverse, *SMALL, "-o", other, "--no-rrd", *change) == 0
    assert roverflow("report", result, other) == 0
    page = Page(result.with_suffix(".html").read_text())
    assert "the results first differ at /nav/navigation_map" in " ".join(page.words)
    assert len([name for name, _ in page.images if name == "/nav/navigation_map of the worst frame"]) == 2
    assert page.words.count(str(result)) == page.words.count(str(other)) == 4  # curves of three plots and the way


def test_a_result_beside_another_is_drawn_at_the_same_stamps(result):
    alone = read_facts(result)
    stamps = [stamp for stamp, _ in alone.drawn.values()]
    other = dict(zip(alone.drawn, ((stamp, {}) for stamp in reversed(stamps)), strict=True))
    drawn = read_facts(result, other).drawn
    assert [stamp for stamp, _ in drawn.values()] == stamps[::-1] != stamps
    assert all("/nav/disparity" in messages for _, messages in drawn.values())
    assert read_facts(result, {"typical frame": (1, {})}).drawn.keys() == alone.drawn.keys()


def test_losses_are_listed_and_a_foreign_file_is_kept(traverse, tmp_path, refused):
    right = "/stereo/right/image_rect_color"
    cut = rewrite(traverse, tmp_path / "cut.mcap", lambda topic, at, data: None if (topic, at) == (right, 1) else data)
    out = run_fast(tmp_path / "out.mcap", cut, code=3)
    assert roverflow("report", out) == 0
    row = f"<td>left</td><td>{moment(1700086400513000000)}</td><td>unmatched</td>"
    assert row in out.with_suffix(".html").read_text()
    out.with_suffix(".html").write_text("my own page")
    assert "exists and is not a roverflow report" in refused("report", out)
    assert "is not a result log" in refused("report", traverse)
    for several in ((tmp_path, out), (out, tmp_path), (out, out, out)):
        assert "give one or two result logs, or the folder of one fleet" in refused("report", *several)
    assert "missing.mcap: No such file or directory" in refused("report", tmp_path / "missing.mcap")
