"""The blueprint has one view, with a name of its own, for every entity that was logged."""

from typing import Any

from recordings.sinks.blueprint import Panel, ViewSpec, blueprint


def views(part: Any) -> list[Any]:
    """All views of a blueprint part."""
    return [view for inner in part.contents for view in views(inner)] if hasattr(part, "grid_columns") else [part]


def test_the_blueprint_has_a_view_for_each_entity_and_no_empty_one():
    specs = [
        ViewSpec(Panel.LEFT, "rectified", "left", "left"),
        ViewSpec(Panel.DISPARITY, "matched", "pixels", "matched"),
    ]
    names = [view.name for view in views(blueprint(specs).root_container)]
    assert sorted(names) == ["frames", "ledger", "left", "matched", "run"]


def test_two_streams_of_one_type_have_tabs_of_two_names():
    def names(*streams):
        panels = ((Panel.RELIEF, "relief"), (Panel.LAYER, "elevation"), (Panel.LAYER, "slope"))
        specs = [ViewSpec(panel, stream, title, title) for stream in streams for panel, title in panels]
        specs.append(ViewSpec(Panel.RELIEF, "regional", "relief", "relief (odom)"))
        return [view.name for view in views(blueprint(specs).root_container)][:-3]

    assert names("sparse") == ["relief", "relief (odom)", "elevation", "slope"]
    assert names("maps/sparse", "dense") == [
        "maps/sparse: relief", "dense: relief", "relief (odom)",
        "maps/sparse: elevation", "maps/sparse: slope", "dense: elevation", "dense: slope",
    ]  # fmt: skip


def test_a_plot_of_many_lines_has_no_legend():
    for stages in (2, 25):
        specs = [ViewSpec(Panel.STAGE, root, str(n), str(n)) for root in ("seconds", "queues") for n in range(stages)]
        plots = views(blueprint(specs).root_container)[:2]
        shown = [plot.properties["PlotLegend"].visible.as_arrow_array().to_pylist() for plot in plots]
        assert shown == [[stages == 2]] * 2
        assert [plot.name.endswith("hover for names") for plot in plots] == [stages == 25] * 2
