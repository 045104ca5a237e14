"""The state that a run had before an instant, from its result log: the regional map and the pose.

A log has a regional map for each metre driven. The frame of the last map before the instant runs again: it shows where
the map lies, and visual odometry continues from its pose. The frames after it are fused into the map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flow.cli.debugging.result_input import check_input
from flow.cli.debugging.variants import Variants, sink_of
from flow.errors import UsageError
from flow.runtime.graph import Graph, Node
from recordings.comparison.text import moment
from recordings.mcap.file import McapFile, by_stamp
from recordings.ros2.from_msg import pose_of, read_regional_map
from recordings.scoring.result_log import about_run, check_profile
from stages import Fuse, FuseRegion, MapRegion, PoseFilter, VisualOdometry
from stages.data import ElevationMap, Pose
from stages.localisation.pose_filter import segment_of

if TYPE_CHECKING:
    from recordings.source.log import McapLog

MAP = "grid_map_msgs/msg/GridMap"


@dataclass(frozen=True)
class LoggedState:
    """What a result log has of the frames before an instant.

    stamp: ns, of the frame whose state it is; maps: stream of `Fuse` or `FuseRegion` -> its regional maps up to there;
    poses: those of visual odometry up to there, none if that frame has none.
    """

    stamp: int
    maps: Mapping[str, list[ElevationMap]]
    poses: list[Pose]

    def states(self, graphs: Mapping[str, Graph], variants: Variants) -> tuple[dict[str, Any], dict[str, str]]:
        """Stream of the joined graph -> the state that its stage begins with; and stream -> why it begins without."""
        states, without = dict[str, Any](), dict[str, str]()
        for label, graph in graphs.items():
            for node in graph.stages:
                name = variants.names[label][node.name]
                if name in states or name in without:
                    continue
                try:
                    state = self._state(node)
                except ValueError as error:
                    without[name] = str(error)
                    continue
                if state is not None:
                    states[name] = state
                elif node.stateful and not _needs_none(node):
                    without[name] = "a result log does not contain it"
        return states, without

    def _state(self, node: Node) -> Any:
        """The state of a stage at `stamp`, None without one; raises ValueError where that of the log does not fit."""
        stage = node.actor
        if isinstance(stage, Fuse | FuseRegion) and node.name in self.maps:
            maps = self.maps[node.name]
            if segment_of(maps[-1].frame_id) is not None and not self.poses:
                raise ValueError(f"the log has no pose in the map's frame '{maps[-1].frame_id}'")
            return stage.resumed(maps)
        if isinstance(stage, PoseFilter | VisualOdometry) and self.poses:
            last = self.poses[-1]
            if isinstance(stage, VisualOdometry):
                return stage.resumed(segment_of(last.frame_id) or 1)
            way = np.array([pose.position for pose in self.poses if pose.frame_id == last.frame_id])
            return stage.resumed(last, float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()))
        return None


def _needs_none(node: Node) -> bool:
    """Whether a stage with a state begins as well without: `MapRegion` at a map, `PoseFilter` with logged poses."""
    return isinstance(node.actor, MapRegion) or (isinstance(node.actor, PoseFilter) and "logged" in node.inputs)


def resume(
    result: Path, graphs: Mapping[str, Graph], variants: Variants, *, log: McapLog, files: Sequence[Path], before: int
) -> tuple[np.datetime64 | int, dict[str, Any], list[str]]:
    """The first frame to run, the states that stages of the joined graph have there, and what a terminal prints.

    result: a log of the run of the first graph; log, files: its input; before: stamp of the instant, ns. Raises
    UsageError for another input or a run of selected frames, LogError for messages of another profile.
    """
    about = about_run(result)
    check_profile(result, about)
    if about.get("every"):
        raise UsageError(f"{result} has only the frames of --every {about['every']}; give the result of a whole run")
    notes = check_input(log, files, result)
    logged = logged_state(result, graphs["A"], before)
    if logged is None:
        none = f"{result} has no regional map or visual odometry before the instant, so no stage has a state"
        return 0, {}, [*notes, none]
    states, without = logged.states(graphs, variants)
    sink: Any = sink_of(graphs["A"], ".mcap")
    notes.append(f"state of {', '.join(states) or 'no stage'} from {result} at {moment(logged.stamp)}")
    if logged.maps and sink.length_step:
        step = 1e3 * sink.length_step
        notes[-1] += f"; the log rounds its heights to {step:.1g} mm and its variances to {100 * sink.precision:g} %"
    reasons = dict.fromkeys(without.values())
    notes += [
        f"without state: {', '.join(name for name in without if without[name] == why)} ({why})" for why in reasons
    ]
    return np.datetime64(logged.stamp, "ns"), states, notes


def logged_state(result: Path, graph: Graph, before: int) -> LoggedState | None:
    """The state of the run of a graph at its last regional map before a stamp, ns; without maps, at its last pose.

    None if the result log has neither. Raises LogError if it cannot be read.
    """
    map_topics, pose_topics = _topics(result, graph)
    maps: dict[str, list[ElevationMap]] = {stream: [] for stream in map_topics.values()}
    poses = list[Pose]()
    topics = [*map_topics, *pose_topics, "/tf", "/nav/diagnostics"]
    for stamp, messages in by_stamp(result, topics, part=(None, before)):
        for topic in messages.keys() & map_topics.keys():
            maps[map_topics[topic]].append(read_regional_map(messages, topic, stamp))
        found = (pose_of(messages[topic][-1], stamp, "") for topic in messages.keys() & pose_topics)
        poses += [pose for pose in found if pose is not None and segment_of(pose.frame_id) is not None]
    ends = [{part.stamp for part in parts if part.level is not None} for parts in maps.values()]
    ends = ends or [{pose.stamp for pose in poses}]
    last = max(set.intersection(*ends), default=None)
    if last is None:
        return None
    kept = {stream: [part for part in parts if part.stamp <= last] for stream, parts in maps.items()}
    poses = [pose for pose in poses if pose.stamp <= last]
    return LoggedState(last, kept, poses if poses and poses[-1].stamp == last else [])


def _topics(result: Path, graph: Graph) -> tuple[dict[str, str], set[str]]:
    """Topic of regional maps -> the stream of the stage that fused them; and the topics of filtered poses."""
    with McapFile(result) as log:
        schemas = {channel.topic: getattr(channel.schema, "name", "") for channel in log.channels.values()}
    maps = dict[str, str]()
    for node in graph.stages:
        if isinstance(node.actor, Fuse | FuseRegion):
            made = {node.name}
            for later in graph.stages:
                if made & set(later.inputs.values()):
                    made.add(later.name)
            topics = [f"/nav/{name}" for name in graph.kinds if name in made and schemas.get(f"/nav/{name}") == MAP]
            maps |= dict.fromkeys(topics[:1], node.name)
    poses = {f"/nav/{node.name}" for node in graph.stages if isinstance(node.actor, PoseFilter)}
    return maps, poses & schemas.keys()
