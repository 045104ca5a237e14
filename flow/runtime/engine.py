"""The scheduler: a fixed pool of workers that always takes the most downstream work there is.

A frame is one stamp of the pipeline's clock. For every frame each stream gets exactly one value: an item, or `Absent`
with the ledger entry of its loss, which passes straight through everything downstream. So no one ever waits for what
will not come, and frames admitted = frames delivered to every sink.

Each stage has a bounded inbox, the frames whose inputs are all there or being made. A stage starts only when the
inboxes it delivers to have room; only the oldest frame in flight is let through a full one. Since that frame waits for
nobody else, the engine cannot lock up, and since downstream work goes first, few frames are in flight at a time.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from flow.contracts import Absent, FrameRecord, Loss, LossReason, Sink
from flow.runtime.graph import Node, is_item, start
from flow.runtime.ledger import Ledger, failure


@dataclass(eq=False)
class _Frame:
    index: int
    stamp: int
    values: dict[str, Any]
    entries: list[Loss]
    coming: set[str]  # streams that are there or being made
    seconds: dict[str, float] = field(default_factory=dict)
    begun: set[_Work] = field(default_factory=set)
    done: set[_Work] = field(default_factory=set)


@dataclass(eq=False)
class _Work:
    """A node of the schedule: a stage, or a sink (`output` is then None)."""

    name: str
    inputs: tuple[str, ...]
    output: str | None
    ordered: bool
    run: Callable[[_Frame], Any]
    consumers: list[_Work] = field(default_factory=list)
    inbox: set[int] = field(default_factory=set)
    next: int = 0


class Engine:
    """Runs stages and sinks over frames.

    stages: in topological order; sinks: name -> (sink, the streams it is given); capacity: of each inbox, frames.
    `states` maps the streams of the stages with state to the states of this run.
    """

    def __init__(
        self,
        stages: Sequence[Node],
        sinks: Mapping[str, tuple[Sink, Sequence[str]]],
        ledger: Ledger,
        workers: int = 2,
        capacity: int = 2,
        on_frame: Callable[[bool], None] = lambda whole: None,
    ) -> None:
        self._ledger, self._capacity, self._on_frame = ledger, capacity, on_frame
        self._condition = threading.Condition()
        self._frames: deque[_Frame] = deque()
        self.states = start(stages)
        self._work = [self._stage_work(node) for node in stages]
        self._work += [self._sink_work(name, sink, streams) for name, (sink, streams) in sinks.items()]
        for work in self._work:
            work.consumers = [other for other in self._work if work.output in other.inputs]
        self._closed = self._over = False
        self._writing = 0  # workers inside a sink
        self._telling = threading.Lock()
        self.failure: tuple[str, BaseException] | None = None
        self.admitted = self.through = self.whole = 0
        self.late_entries: list[Loss] = []  # losses of the frames that did not get through
        self.seconds = dict.fromkeys((work.name for work in self._work), 0.0)
        self._threads = [
            threading.Thread(target=self._work_loop, name=f"worker-{index}", daemon=True) for index in range(workers)
        ]
        for thread in self._threads:
            thread.start()

    def admit(
        self, stamp: int, values: dict[str, Any], entries: Iterable[Loss], stop: Callable[[], bool] = lambda: False
    ) -> bool:
        """Take a frame in, waiting for room; False if the engine failed or `stop()` became true before there was any.

        Stamps must increase. values: stream -> item or Absent, for every stream that no stage makes.
        """
        frame = _Frame(self.admitted, stamp, dict(values), list(entries), set(values))
        frame.entries += [value.cause for value in values.values() if isinstance(value, Absent)]
        with self._condition:
            first = [work for work in self._work if all(stream in frame.values for stream in work.inputs)]
            while not self._has_room(first, frame):
                if self.failure or stop():
                    return False
                self._condition.wait(0.1)
            if self.failure:
                return False
            self.admitted += 1
            self._frames.append(frame)
            self._pass_absence(frame)
            retired = list(self._retire())  # a frame that has nothing to work on is through at once
            self._condition.notify_all()
        self._tell(retired)
        return True

    def finish(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Wait until every frame is through (or the engine failed, or `stop()`), then end the workers.

        After `stop()` only those are waited for that are inside a sink; what the others still do is lost.
        """
        with self._condition:
            while self._frames and not self.failure and not stop():
                self._condition.wait(0.1)
            self._closed = True
            self._condition.notify_all()
            while self._writing:
                self._condition.wait(0.1)
        for thread in self._threads:
            while thread.is_alive() and not stop():
                thread.join(0.1)
        with self._condition:
            self._over = True
            for frame in self._frames:
                detail = "the run ended before it was through"
                entry = self._ledger.add(Loss("frame", frame.stamp, "engine", LossReason.ABANDONED, detail))
                self.late_entries += [*frame.entries, entry]

    # -- scheduling: everything below, up to the work itself, runs under the lock --------------------------------

    def _work_loop(self) -> None:
        while True:
            with self._condition:
                task = self._next_task()
                while task is None:
                    if self._closed or self.failure:
                        return
                    self._condition.wait()
                    task = self._next_task()
            work, frame = task
            value, seconds = None, time.perf_counter()
            try:
                value = work.run(frame)
            except BaseException as error:
                value = error
            seconds = time.perf_counter() - seconds
            with self._condition:
                if self._over:  # the frame has been abandoned
                    return
                retired: list[bool] = []
                try:
                    self._writing -= work.output is None
                    frame.seconds[work.name] = seconds
                    self.seconds[work.name] += seconds
                    retired = self._deliver(work, frame, value)
                except BaseException as error:  # a worker must not die unheard
                    self.failure = self.failure or (work.name, error)
                self._condition.notify_all()
            self._tell(retired)

    def _tell(self, retired: list[bool]) -> None:
        """Report progress, outside the lock; a progress display that fails is not worth a run."""
        for whole in retired:
            with self._telling, suppress(Exception):
                self._on_frame(whole)

    def _next_task(self) -> tuple[_Work, _Frame] | None:
        """The most downstream work that is ready and has room for its result; of one node, the oldest frame's."""
        if self._closed or self.failure:
            return None
        for work in reversed(self._work):
            for frame in self._frames if work.inbox else ():
                if frame.index not in work.inbox or not self._ready(work, frame):
                    continue
                if self._has_room(work.consumers, frame):
                    frame.begun.add(work)
                    work.inbox.discard(frame.index)
                    if work.output:
                        frame.coming.add(work.output)
                        self._expect(frame, work.consumers)
                    else:
                        self._writing += 1
                    return work, frame
        return None

    def _ready(self, work: _Work, frame: _Frame) -> bool:
        if work.ordered and frame.index != work.next:
            return False
        return all(stream in frame.values for stream in work.inputs)

    def _has_room(self, consumers: Iterable[_Work], frame: _Frame) -> bool:
        """Whether all `consumers` can take what comes for `frame`; the oldest frame always has right of way."""
        if not self._frames or frame is self._frames[0]:
            return True
        return all(len(c.inbox) < self._capacity or frame.index in c.inbox for c in consumers)

    def _expect(self, frame: _Frame, nodes: Iterable[_Work]) -> None:
        """Note `frame` in the inbox of those of the nodes whose inputs are all there or being made."""
        for work in nodes:
            if work not in frame.begun and frame.coming.issuperset(work.inputs):
                work.inbox.add(frame.index)

    def _deliver(self, work: _Work, frame: _Frame, value: Any) -> list[bool]:
        """Put a result in its place; for each frame that is now through, whether it is whole."""
        if isinstance(value, BaseException):
            if work.output is None:
                self.failure = self.failure or (work.name, value)
            stream = work.output or "frame"
            entry = self._ledger.add(Loss(stream, frame.stamp, work.name, LossReason.FAILED, failure(value)))
            frame.entries.append(entry)
            value = Absent(entry)
        if work.output:
            frame.values[work.output] = value
        self._complete(work, frame)
        if isinstance(value, Absent):
            self._pass_absence(frame)
        return list(self._retire())

    def _complete(self, work: _Work, frame: _Frame) -> None:
        frame.done.add(work)
        while work.ordered and any(f.index == work.next and work in f.done for f in self._frames):
            work.next += 1

    def _pass_absence(self, frame: _Frame) -> None:
        """Give every stage whose inputs are there but not whole its absent output (stages are in topological order)."""
        for work in self._work:
            if work.output is None or work in frame.begun:
                continue
            lost = [frame.values[s] for s in work.inputs if isinstance(frame.values.get(s), Absent)]
            if lost:
                frame.begun.add(work)
                work.inbox.discard(frame.index)
                frame.values[work.output] = lost[0]
                frame.coming.add(work.output)
                self._complete(work, frame)
        self._expect(frame, self._work)

    def _retire(self) -> Iterator[bool]:
        """Let go of the frames, oldest first, that are through."""
        while self._frames and len(self._frames[0].done) == len(self._work):
            frame = self._frames.popleft()
            whole = not self.failure and not any(isinstance(value, Absent) for value in frame.values.values())
            self.through += 1
            self.whole += whole
            yield whole

    # -- the work itself, outside the lock -------------------------------------------------------------------

    def _stage_work(self, node: Node) -> _Work:
        own = {"state": self.states[node.name]} if node.stateful else {}

        def run(frame: _Frame) -> Any:
            value = node.actor(**{port: frame.values[stream] for port, stream in node.inputs.items()}, **own)
            if not is_item(value, node.output):
                raise TypeError(f"{node.use} returned {type(value).__name__}, not {node.output.__name__}")
            return value

        return _Work(node.name, tuple(node.inputs.values()), node.name, node.stateful, run)

    def _sink_work(self, name: str, sink: Sink, streams: Sequence[str]) -> _Work:
        order = {work.name: index for index, work in enumerate(self._work)}

        def run(frame: _Frame) -> None:
            items = {s: frame.values[s] for s in streams if not isinstance(frame.values[s], Absent)}
            entries = tuple(sorted(frame.entries, key=lambda entry: (order.get(entry.stage, -1), entry.stamp)))
            with self._condition:
                seconds = dict(frame.seconds)
                queues = {work.name: len(work.inbox) for work in self._work if work.output}
            sink.write(FrameRecord(frame.index, frame.stamp, items, entries, seconds, queues))

        # A sink waits for every stream of the frame, also those it is not given: only then are the entries complete.
        every = tuple(dict.fromkeys([*streams, *(work.name for work in self._work if work.output)]))
        return _Work(name, every, None, True, run)
