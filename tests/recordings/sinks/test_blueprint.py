"""The desk has a view for every picture that hangs, each with a name of its own."""

from __future__ import annotations

from typing import Any

from recordings.sinks.blueprint import Panel, ViewSpec, blueprint


def views(part: Any) -> list[Any]:
    """All views of a blueprint part."""
    return [view for inner in part.contents for view in views(inner)] if hasattr(part, "grid_columns") else [part]


def test_the_desk_has_a_view_for_each_picture_and_none_without() -> None:
    places = [ViewSpec(Panel.LEFT, "rectified/left", "left"), ViewSpec(Panel.DISPARITY, "matched/pixels", "matched")]
    names = [view.name for view in views(blueprint(places).root_container)]
    assert sorted(names) == ["ledger", "left", "matched", "run"]


def test_two_streams_of_one_type_have_tabs_of_two_names() -> None:
    def names(*streams: str) -> list[str]:
        panels = ((Panel.RELIEF, "relief"), (Panel.LAYER, "elevation"), (Panel.LAYER, "slope"))
        places = [ViewSpec(panel, f"{stream}/{title}", title) for stream in streams for panel, title in panels]
        places.append(ViewSpec(Panel.RELIEF, "regional/relief", "relief (odom)"))
        return [view.name for view in views(blueprint(places).root_container)][:-2]

    assert names("sparse") == ["relief", "relief (odom)", "elevation", "slope"]
    assert names("sparse", "dense") == [
        "sparse: relief", "dense: relief", "relief (odom)",
        "sparse: elevation", "sparse: slope", "dense: elevation", "dense: slope",
    ]  # fmt: skip


def test_a_legend_that_would_hide_its_plot_is_not_shown() -> None:
    for stages in (2, 25):
        places = [ViewSpec(Panel.STAGE, f"{root}/{n}", str(n)) for root in ("seconds", "queues") for n in range(stages)]
        plots = views(blueprint(places).root_container)[:2]
        shown = [plot.properties["PlotLegend"].visible.as_arrow_array().to_pylist() for plot in plots]
        assert shown == [[stages == 2]] * 2
        assert [plot.name.endswith("hover for names") for plot in plots] == [stages == 25] * 2
