"""Evaluates streams of a pipeline on one frame in memory, as in a notebook: without a log and without threads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flow.contracts import nearest
from flow.errors import UsageError
from flow.runtime.graph import Graph, Node, ports_of, start, unfit


def evaluate(
    graph: Graph, given: Mapping[str, Any], wanted: str, states: dict[str, Any] | None = None
) -> dict[str, Any]:
    """The streams from those given up to the wanted one, by name, for one frame; without those that have nothing new.

    Parameters
    ----------
    graph
        A pipeline, as `flow.config.loader.load` returns it.
    given
        Stream -> item, such as {"rectified": frame}. These streams are not made.
    wanted
        The stream to make. Inputs that a stage can do without are left out where they are not given.
    states
        Stream -> state of its stage. One dict for all frames continues with each; by default states are new.

    Raises
    ------
    UsageError
        If the pipeline lacks one of these streams, if another one must be given, as of an aligner, or if a setting
        needs an input that is left out.
    TypeError, StageError
        If a stage returns another type, or another stamp than that of the frame.

    Examples
    --------
    >>> import numpy as np
    >>> from flow.config.loader import load
    >>> from stages import StereoCamera, StereoFrame
    >>> scene = np.random.default_rng(0).integers(0, 256, (96, 134), np.uint8)
    >>> camera = StereoCamera(fx=100, fy=100, cx=64, cy=48, baseline=0.1, width=128, height=96)
    >>> frame = StereoFrame(0, scene[:, :128], scene[:, 6:], camera)
    >>> streams = evaluate(load("rover", ["disparities=32"]), {"rectified": frame}, "disparity")
    >>> round(float(np.nanmedian(streams["disparity"].pixels)), 1)
    6.0
    """
    if not isinstance(graph, Graph):
        raise UsageError(f"the graph must be what flow.config.loader.load returns, not a {type(graph).__name__}")
    plan, lacking = dict[str, tuple[Node, dict[str, str]]](), dict[str, str]()  # lacking: stream -> the one to give
    known = [*graph.source_streams, *(node.name for node in graph.nodes)]
    for name in (wanted, *given):
        if name not in known:
            raise UsageError(f"the pipeline has no stream '{name}'{nearest(name, known)}")
    for node in graph.upstream_of([wanted], given).nodes:
        inputs = {port: stream for port, stream in node.inputs.items() if stream in given or stream in plan}
        absent = node.inputs.keys() - inputs.keys()
        if node.aligns:
            lacking[node.name] = node.name
        elif required := absent and absent - ports_of(type(node.actor))[1]:
            stream = node.inputs[min(required)]
            lacking[node.name] = lacking.get(stream, stream)
        elif absent and (why := unfit(node.name, node.actor, inputs)):
            raise UsageError(why)
        else:
            plan[node.name] = node, inputs
    if wanted not in {*given, *plan}:
        missing = lacking.get(wanted, wanted)
        raise UsageError(f"'{wanted}' needs a stream that only a run makes from a log; give '{missing}'")
    streams, states = dict(given), {} if states is None else states
    stamp = next((item.stamp for item in given.values() if hasattr(item, "stamp")), None)
    states |= start(node for name, (node, _) in plan.items() if name not in states)
    for name, (node, inputs) in plan.items():
        if streams.keys() >= {*inputs.values()}:
            state = {"state": states[name]} if node.stateful else {}
            ports = {port: streams[stream] for port, stream in inputs.items()}
            item = node.actor(**ports, **state)
            if item is not None or not node.sparse:
                streams[name] = node.checked(item, ports.values(), stamp)
    return streams
