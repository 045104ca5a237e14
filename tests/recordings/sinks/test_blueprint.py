"""The blueprint has one view, with a name of its own, for every entity that was logged."""

from typing import Any

import pytest

from flow.cli.debugging.desk import MAX_LAYOUT_BYTES
from recordings.errors import LogError
from recordings.sinks import DESKS as NAMES
from recordings.sinks.blueprint import DESKS, Layout, Panel, ViewSpec, read_layout
from tests.conftest import roverflow
from tests.limits import file_size_limited
from tests.recordings.sinks.recorded_scene import entities, rows


def views(part: Any) -> list[Any]:
    """All views of a blueprint part."""
    return [view for inner in part.contents for view in views(inner)] if hasattr(part, "grid_columns") else [part]


def container(specs: list[ViewSpec], desk: str = "overview") -> Any:
    return Layout(tuple(specs)).blueprint(desk).root_container


def test_the_blueprint_has_a_view_for_each_entity_and_no_empty_one():
    shown = (Panel.LEFT, "rectified", "left", "left"), (Panel.DISPARITY, "matched", "pixels", "matched")
    names = [view.name for view in views(container([ViewSpec(*spec) for spec in shown]))]
    assert sorted(names) == ["frames", "ledger", "left", "matched", "run"]


@pytest.mark.parametrize("number", range(2, 8))
def test_the_overview_has_no_empty_place_for_any_number_of_images(number):
    def empty(part: Any) -> int:
        """The cells without content of the grids of a part."""
        inner = part.contents if hasattr(part, "grid_columns") else []
        return (-len(inner) % part.grid_columns if inner and part.grid_columns else 0) + sum(map(empty, inner))

    panels = ["LEFT", "RIGHT", "DISPARITY", "SOURCE", "OWN_IMAGE", "SUPERPIXELS", "DISPARITY"][:number]
    specs = [ViewSpec(Panel[panel], f"stream{count}", "", panel.lower()) for count, panel in enumerate(panels)]
    assert {*panels} <= {view.name.rpartition(": ")[2].upper() for view in views(container(specs))}
    assert empty(container(specs)) == 0


def test_two_streams_of_one_type_have_tabs_of_two_names():
    def names(*streams):
        panels = ((Panel.RELIEF, "relief"), (Panel.LAYER, "elevation"), (Panel.LAYER, "slope"))
        specs = [ViewSpec(panel, stream, title, title) for stream in streams for panel, title in panels]
        specs.append(ViewSpec(Panel.RELIEF, "regional", "relief", "relief (odom)"))
        return [view.name for view in views(container(specs))][:-3]

    assert names("sparse") == ["relief", "relief (odom)", "elevation", "slope"]
    assert names("maps/sparse", "dense") == [
        "maps/sparse: relief", "dense: relief", "relief (odom)",
        "maps/sparse: elevation", "maps/sparse: slope", "dense: elevation", "dense: slope",
    ]  # fmt: skip


def test_a_plot_of_many_lines_has_no_legend():
    for stages in (2, 25):
        specs = [ViewSpec(Panel.STAGE, root, str(n), str(n)) for root in ("seconds", "queues") for n in range(stages)]
        plots = views(container(specs))[:2]
        shown = [plot.properties["PlotLegend"].visible.as_arrow_array().to_pylist() for plot in plots]
        assert shown == [[stages == 2]] * 2
        assert [plot.name.endswith("hover for names") for plot in plots] == [stages == 25] * 2


def test_a_recording_that_was_cut_is_refused_in_one_sentence(rrd, tmp_path, recwarn):
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(rrd.read_bytes()[:5000])
    with pytest.raises(
        LogError, match=r"cannot read .*cut\.rrd as a recording: Failed to read RRD file at .*; run the log"
    ):
        read_layout(cut)
    assert not recwarn


def test_the_names_of_curves_stand_beside_a_plot_and_hide_none(rrd):
    layout = read_layout(rrd)
    for desk in ("overview", "tilt"):
        shown = views(layout.blueprint(desk).root_container)
        beside = {view.origin for view in shown if str(view.origin).startswith("curves/")}
        assert {"curves/ANGLE", "curves/HEALTH"} <= beside
        plots = [view for view in shown if view.name in ("tilt (degrees)", "tilt check (degrees)")]
        legends = [view.properties["PlotLegend"].visible.as_arrow_array().to_pylist() for view in plots]
        assert legends == [[False], [False]]
    assert rows(rrd, "/curves/ANGLE", "Points2D:labels")[-1][2] == [
        "inclinometer x up", "inclinometer y up", "camera pitch down", "camera roll right"
    ]  # fmt: skip
    curves = (
        "tilt/inclinometer x up",
        "tilt/inclinometer y up",
        "points/camera pitch down",
        "points/camera roll right",
    )
    colors = [rows(rrd, f"/{name}".replace(" ", "\\ "), "SeriesLines:colors") for name in curves]
    assert rows(rrd, "/curves/ANGLE", "Points2D:colors")[-1][2] == [color for ((_, _, (color,)),) in colors]
    assert len({color for ((_, _, (color,)),) in colors}) == 4


def test_a_camera_image_stays_in_its_place_whatever_hazards_are_drawn_over_it(rrd):
    shown = {view.name: view for view in views(read_layout(rrd).blueprint().root_container)}
    for side in ("left", "right"):
        bounds = shown[f"rectified: {side}"].properties["VisualBounds2D"].range.as_arrow_array().to_pylist()
        assert bounds == [{"x_range": [0.0, 64.0], "y_range": [0.0, 48.0]}]


def test_the_command_line_names_the_desks_in_their_order():
    assert tuple(DESKS) == NAMES


@pytest.mark.parametrize("desk", NAMES)
def test_a_desk_shows_only_what_a_recording_has(desk, rrd):
    layout = read_layout(rrd)
    logged = entities(rrd) - {"/layout"}
    shown = [str(path) for view in views(layout.blueprint(desk).root_container) for path in view_paths(view)]
    assert shown
    assert all(any(entity.startswith(path) for entity in logged) for path in shown)


def test_the_desk_of_matching_shows_the_images_and_what_is_known_of_errors(rrd):
    shown = {path for view in views(container(list(read_layout(rrd).views), "matching")) for path in view_paths(view)}
    assert shown >= {
        "/rectified/left", "/rectified/right", "/disparity/difference", "/matched/confidence", "/disparity/confidence",
        "/disparity/source",
    }  # fmt: skip


def test_the_desk_of_terrain_has_the_frames_of_a_regional_map_behind_its_reasons(rrd):
    regional = [ViewSpec(Panel.LAYER, "regional_map", "layers/frames", "frames (odom)", "odom")]
    names = [view.name for view in views(container([*read_layout(rrd).views, *regional], "terrain"))]
    assert names[names.index("reason") + 1] == "frames (odom)"
    assert names.index("frames (odom)") < names.index("slope") < names.index("elevation")


def view_paths(view: Any) -> list[str]:
    """The entities that a view shows."""
    if view.contents == "$origin/**" or not isinstance(view.contents, list):
        return [f"/{view.origin.lstrip('/')}"]
    return [line.removeprefix("+ ").removesuffix("/**") for line in view.contents]


@pytest.mark.parametrize("desk", NAMES)
def test_a_desk_of_nothing_is_the_ledger(desk):
    assert "ledger" in {view.name for view in views(container([], desk))} | {container([], desk).name}


def test_the_desks_of_a_recording_are_files_for_the_viewer(rrd, tmp_path, capsys):
    assert roverflow("desk", rrd, "--out", tmp_path) == 0
    assert sorted(tmp_path.iterdir()) == sorted(tmp_path / f"{rrd.stem}-{name}.rbl" for name in NAMES)
    assert all(path.read_bytes().startswith(b"RRF2") for path in tmp_path.iterdir())
    assert roverflow("desk", rrd, "--out", tmp_path, "--desk", "tilt") == 0  # again
    assert roverflow("desk", tmp_path / f"{rrd.stem}-tilt.rbl", "--desk", "tilt", "--out", tmp_path) == 2
    (tmp_path / f"{rrd.stem}-tilt.rbl").write_text("mine")
    assert roverflow("desk", rrd, "--out", tmp_path, "--desk", "tilt") == 2
    assert "exists and is not a roverflow desk" in capsys.readouterr().err


def test_a_desk_is_not_begun_on_a_full_disk(rrd, tmp_path, said, monkeypatch):
    monkeypatch.setattr("flow.cli.debugging.desk.room_to_grow", lambda file: 1_000_000)
    assert "less than 4 MB more can be written there; " in said(1, "desk", rrd, "--out", tmp_path).err
    assert list(tmp_path.iterdir()) == []


def test_a_desk_fits_on_a_disk_with_little_room(rrd, tmp_path):
    with file_size_limited(5_000_000):
        assert roverflow("desk", rrd, "--out", tmp_path) == 0
    assert max(desk.stat().st_size for desk in tmp_path.iterdir()) < MAX_LAYOUT_BYTES / 4


def test_what_is_no_recording_has_no_desk(tmp_path):
    (tmp_path / "a.rrd").write_text("nothing")
    for path in (tmp_path / "a.rrd", tmp_path / "b.rrd"):
        with pytest.raises(LogError, match=path.name):
            read_layout(path)
