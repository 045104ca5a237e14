"""The engine: a fixed pool of workers that always takes the most downstream work there is.

A frame is one stamp of the pipeline's clock. Every stream gets exactly one value for it: an item, or `Absent` with the
ledger's entry about the loss, which passes through everything downstream. So nobody waits for an item that cannot come,
and every admitted frame reaches every sink. An item is freed as soon as all stages and sinks that read it are done.

Each stage has a bounded inbox: the frames whose inputs are there or being made. A stage starts only when the inboxes
that take its output have room; only the oldest frame in flight may enter a full one. That frame waits for no other, so
the engine cannot deadlock. Downstream work goes first, and few frames are in flight at a time.

A stage that is `large` needs much memory while it works. At most every second worker is in one, so that the memory is
needed fewer times; the others find other work.

A stage may return None, where nothing is new; then `Unchanged` passes through everything downstream. A stage that can
`flush` takes a frame when the next one is there, or none will come: so it can flush with the last frame.
"""

from __future__ import annotations

import math
import pickle
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

from flow.contracts import Absent, FrameRecord, Loss, LossReason, Sink, Unchanged
from flow.runtime.bottleneck import READING, bottleneck
from flow.runtime.checkpoint import Checkpoint
from flow.runtime.graph import Node, start
from flow.runtime.ledger import Ledger, failure
from flow.runtime.work import NO_ITEM, Frame, Work, missing_of


class Engine:
    """Runs stages and sinks over frames.

    stages: in topological order; sinks: name -> (sink, the streams it gets); ledger: gets an entry for every loss;
    workers: threads; capacity: frames that an inbox holds, and one more where a stage flushes; max_frames: in flight,
    at least 2 if a stage flushes; on_frame: called after every frame, with whether it lost nothing; states: stream ->
    state that its stage begins with in place of a new one; resumed: the checkpoint that the run goes on from.
    """

    def __init__(
        self,
        stages: Sequence[Node],
        sinks: Mapping[str, tuple[Sink, Sequence[str]]],
        ledger: Ledger,
        workers: int = 2,
        capacity: int = 2,
        max_frames: int = 1024,
        on_frame: Callable[[bool], None] = lambda complete: None,
        states: Mapping[str, Any] | None = None,
        resumed: Checkpoint | None = None,
    ) -> None:
        self._ledger, self._on_frame = ledger, on_frame
        self._capacity, self._max_large = capacity, max(1, workers // 2)
        lock = threading.RLock()
        self._condition, self._caller = threading.Condition(lock), threading.Condition(lock)  # workers; the caller
        self._fits: Callable[[], bool] = lambda: False  # whether what `admit` waits with has room
        self._frames: deque[Frame] = deque()
        self.states = start(stages) | dict(states or {})  # stream -> state of its stage, of this run
        self.states |= {name: resumed.state(name) for name in self.states} if resumed is not None else {}
        self.unsaved = ""  # why there are no checkpoints
        self.checkpoint: Checkpoint | None = None  # the last one that every stage and sink is through
        self._work = [self._stage_work(node) for node in stages]
        self._sink_seconds = dict.fromkeys(sinks, 0.0)  # of the last frame that was through
        self._max_frames = max(max_frames, 2) if any(work.flushes for work in self._work) else max_frames
        for name, (sink, streams) in sinks.items():
            self._work.append(self._sink_work(name, sink, streams))
        self._readers: dict[str, list[Work]] = {}
        late = set[str | None]()  # streams that wait for the next frame
        for work in self._work:
            work.consumers = [other for other in self._work if work.output in other.inputs]
            late |= {work.output} if work.flushes or late.intersection(work.inputs) else set()
            for stream in work.reads:
                self._readers.setdefault(stream, []).append(work)
        self._prompt = {work for work in self._work if work.output and work.output not in late}
        self._ending = self._closed = self._over = False  # _ending: no frame is admitted any more
        self._writing = 0  # workers inside a sink
        self._in_large = 0  # workers inside a large stage
        self._reporting = threading.Lock()
        self.failure: tuple[str, BaseException] | None = None
        self.admitted = self.through = self.complete = self.resumed = 0
        if resumed is not None:
            self._resume(resumed)
        self.late_entries: list[Loss] = []  # losses of the frames that did not get through
        self.latencies: list[float] = []  # s, from when a frame was due until its stages were through
        self.waiting = 0.0  # s that `admit` waited for room
        self.reading = 0.0  # s that the caller took to read the frames, which it sets
        self._threads = [
            threading.Thread(target=self._work_loop, name=f"worker-{index}", daemon=True) for index in range(workers)
        ]
        for thread in self._threads:
            thread.start()

    def _resume(self, checkpoint: Checkpoint) -> None:
        """Begin behind the frames before a checkpoint."""
        self.admitted = self.through = self.resumed = checkpoint.frames
        self.complete = checkpoint.complete
        for loss in checkpoint.losses:
            self._ledger.add(loss)
        for work in self._work:
            work.next = checkpoint.frames

    def admit(
        self,
        stamp: int,
        values: dict[str, Any],
        entries: Iterable[Loss],
        stop: Callable[[], bool] = lambda: False,
        due: float | None = None,
        deadline: float = math.inf,
        save: bool = False,
    ) -> bool:
        """Take in a frame as soon as there is room; False if the engine fails, `stop()` is true or the deadline passes.

        values: stream -> item or Absent, for every stream that no stage makes; due, deadline: s of `time.perf_counter`;
        save: whether a checkpoint follows the frame.
        """
        begun = time.perf_counter()
        frame = Frame(self.admitted, stamp, begun if due is None else due, dict(values), list(entries), set(values))
        frame.entries += [value.cause for value in values.values() if isinstance(value, Absent)]
        frame.saved = {} if save else None
        with self._condition:
            first = [work for work in self._work if all(stream in frame.values for stream in work.inputs)]
            self._fits = lambda: len(self._frames) < self._max_frames and self._has_room(first, frame)
            fits = self._wait_for_room(stop, deadline)
            self.waiting += time.perf_counter() - begun
            if not fits:
                return False
            self.admitted += 1
            self._frames.append(frame)
            self._free(frame, tuple(values))
            self._pass_absence(frame)
            retired = list(self._retire())  # a frame without work is through at once
            self._condition.notify_all()
        self.report(retired)
        return True

    def _wait_for_room(self, stop: Callable[[], bool], deadline: float) -> bool:
        while not self.failure:
            if self._fits():
                return True
            left = deadline - time.perf_counter()
            if stop() or left <= 0:
                return False
            self._caller.wait(min(0.1, left))
        return False

    def finish(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Wait until every frame is through, the engine has failed, or `stop()` is true; then end the workers.

        After `stop()`, only workers inside a sink may finish; what the others still do is lost.
        """
        with self._condition:
            self._ending = True
            self._condition.notify_all()
            while self._frames and not self.failure and not stop():
                self._caller.wait(0.1)
            self._closed = True
            self._condition.notify_all()
            while self._writing:
                self._caller.wait(0.1)
        for thread in self._threads:
            while thread.is_alive() and not stop():
                thread.join(0.1)
        with self._condition:
            self._over = True
            for frame in self._frames:
                detail = "the run ended before the frame was finished"
                entry = self._ledger.add(Loss("frame", frame.stamp, "engine", LossReason.ABANDONED, detail))
                self.late_entries += [*frame.entries, entry]

    @property
    def seconds(self) -> dict[str, float]:
        """Stage or sink -> its time so far, s."""
        return {work.name: work.seconds for work in self._work}

    @property
    def cpu_seconds(self) -> dict[str, float]:
        """Stage or sink -> the CPU time of its worker so far, s, without threads that it starts itself."""
        return {work.name: work.cpu_seconds for work in self._work}

    def bottleneck(self, cores: int) -> dict[str, Any]:
        """What limits the rate of the run, on this number of cores (`flow.runtime.bottleneck`)."""
        sinks = [work.name for work in self._work if work.output is None]
        serial = {work.name: work.seconds for work in self._work if work.ordered} | {READING: self.reading}
        return bottleneck(self.seconds, sinks, serial, len(self._threads), self.through - self.resumed, cores)

    # -- scheduling: everything below, up to the work itself, runs under the lock --------------------------------

    def _work_loop(self) -> None:
        while True:
            with self._condition:
                while True:
                    task = self._next_task()
                    if self.failure or self._ending or self._fits():
                        self._caller.notify()  # only then: a wake-up for each result costs as much as reading
                    if task is not None:
                        break
                    if self._closed or self.failure:
                        return
                    self._condition.wait()
            work, frame = task
            seconds, cpu = time.perf_counter(), time.thread_time()
            try:
                value = work.run(frame)
            except BaseException as error:
                value = error
            seconds, cpu = time.perf_counter() - seconds, time.thread_time() - cpu
            with self._condition:
                if self._over:  # the frame has been abandoned
                    return
                retired: list[bool] = []
                try:
                    self._writing -= work.output is None
                    self._in_large -= work.large
                    work.seconds += seconds
                    work.cpu_seconds += cpu
                    frame.seconds[work.name] = seconds
                    retired = self._deliver(work, frame, value)
                except BaseException as error:  # a worker must not die silently
                    self.failure = self.failure or (work.name, error)
                self._condition.notify_all()
            del work, frame, task, value  # a worker that waits must keep no item
            self.report(retired)

    def report(self, retired: list[bool]) -> None:
        """Report frames, complete or not, outside the lock. A progress display that fails must not stop the run."""
        for complete in retired:
            with self._reporting, suppress(Exception):
                self._on_frame(complete)

    def _next_task(self) -> tuple[Work, Frame] | None:
        """The most downstream work that is ready and has room for its result, on the oldest frame possible."""
        if self._closed or self.failure:
            return None
        for work in reversed(self._work):
            if work.inbox and not (work.large and self._in_large >= self._max_large):
                for frame in self._frames:
                    if self._ready(work, frame) and self._has_room(work.consumers, frame):
                        self._begin(work, frame)
                        return work, frame
        return None

    def _begin(self, work: Work, frame: Frame) -> None:
        frame.begun.add(work)
        work.inbox.discard(frame.index)
        self._in_large += work.large
        if work.output:
            frame.coming.add(work.output)
            self._expect(frame, work.consumers)
        else:
            self._writing += 1

    def _ready(self, work: Work, frame: Frame) -> bool:
        if frame.index not in work.inbox or (work.ordered and frame.index != work.next):
            return False
        if work.flushes and frame is self._frames[-1] and not self._ending:
            return False
        return all(stream in frame.values for stream in work.inputs)

    def _has_room(self, consumers: Iterable[Work], frame: Frame) -> bool:
        """Whether the inboxes of all `consumers` have room for `frame`; the oldest frame always has right of way."""
        if not self._frames or frame is self._frames[0]:
            return True
        return all(len(c.inbox) < self._capacity + c.flushes or frame.index in c.inbox for c in consumers)

    def _expect(self, frame: Frame, nodes: Iterable[Work]) -> None:
        """Put `frame` into the inboxes of those nodes whose inputs are all there or being made."""
        for work in nodes:
            if work not in frame.begun and frame.coming.issuperset(work.inputs):
                work.inbox.add(frame.index)

    def _deliver(self, work: Work, frame: Frame, value: Any) -> list[bool]:
        """Store the result of a work; returns for each frame that is now through whether it is complete."""
        if isinstance(value, BaseException):
            if work.output is None:
                self.failure = self.failure or (work.name, value)
            stream = work.output or "frame"
            entry = self._ledger.add(Loss(stream, frame.stamp, work.name, LossReason.FAILED, failure(value)))
            frame.entries.append(entry)
            value = Absent(entry)
        if work.output:
            frame.values[work.output] = value
        elif isinstance(value, Mapping):
            for stream, why in value.items():
                self._ledger.add(Loss(stream, frame.stamp, work.name, LossReason.UNWRITABLE, why))
        self._complete(work, frame)
        if isinstance(value, NO_ITEM):
            self._pass_absence(frame)
        return list(self._retire())

    def _complete(self, work: Work, frame: Frame) -> None:
        frame.done.add(work)
        if not frame.served and frame.done.issuperset(self._prompt):
            frame.served = True
            self.latencies.append(time.perf_counter() - frame.due)
        self._free(frame, work.reads if work.output is None else (*work.reads, work.output))
        for other in self._frames if work.ordered else ():
            if other.index == work.next and work in other.done:
                self._save(work, other)
                work.next += 1

    def _save(self, work: Work, frame: Frame) -> None:
        """Save the state after a frame, if a checkpoint follows it."""
        saved = frame.saved
        if saved is None:
            return
        state = work.state()
        try:
            saved[work.name] = pickle.dumps(state)
        except Exception as error:
            frame.saved, self.unsaved = None, f"the state of '{work.name}' cannot be pickled: {error}"

    def _free(self, frame: Frame, streams: Iterable[str]) -> None:
        """Let go of the items that no work on the frame will read any more. What marks a missing item stays."""
        for stream in streams:
            unread = frame.done.issuperset(self._readers.get(stream, ()))
            if unread and stream in frame.values and not isinstance(frame.values[stream], NO_ITEM):
                frame.values[stream] = None

    def _pass_absence(self, frame: Frame) -> None:
        """Make the output of every stage with an absent input absent, unless it flushes (in topological order)."""
        for work in self._work:
            if work.output is None or work.flushes or work in frame.begun:
                continue
            missing = missing_of(frame.values.get(stream) for stream in work.inputs)
            if missing:
                frame.begun.add(work)
                work.inbox.discard(frame.index)
                frame.values[work.output] = missing
                frame.coming.add(work.output)
                self._complete(work, frame)
        self._expect(frame, self._work)

    def _retire(self) -> Iterator[bool]:
        """Drop the frames that are through, oldest first; yields whether each is complete."""
        while self._frames and len(self._frames[0].done) == len(self._work):
            frame = self._frames.popleft()
            complete = not self.failure and not any(isinstance(value, Absent) for value in frame.values.values())
            self._sink_seconds = {name: frame.seconds[name] for name in self._sink_seconds}
            self.through += 1
            self.complete += complete
            if frame.saved is not None and not self.failure:
                names = {work.name for work in self._work}
                entries = (entry for entry in self._ledger.entries if entry.stage in names)
                losses = tuple(entry for entry in entries if entry.stamp <= frame.stamp)
                self.checkpoint = Checkpoint(self.through, self.complete, frame.saved, losses)
            yield complete

    # -- the work itself, outside the lock -------------------------------------------------------------------

    def _stage_work(self, node: Node) -> Work:
        state = {"state": self.states[node.name]} if node.stateful else {}
        streams, flushes = tuple(node.inputs.values()), hasattr(node.actor, "flush")

        def run(frame: Frame) -> Any:
            given = {port: frame.values[stream] for port, stream in node.inputs.items()}
            missing = missing_of(given.values())
            value = None if missing else node.actor(**given, **state)
            if value is None and flushes and self._ending and frame is self._frames[-1]:
                value, frame.saved = node.actor.flush(**state), None  # its state is not that of a run that goes on
            if value is None and (missing or node.sparse):
                return missing or Unchanged()
            return node.checked(value, given.values(), frame.stamp)

        large = bool(getattr(node.actor, "large", False))
        return Work(
            node.name, streams, streams, node.name, node.stateful, run, lambda: self.states[node.name], large, flushes
        )

    def _sink_work(self, name: str, sink: Sink, streams: Sequence[str]) -> Work:
        stages = [work for work in self._work if work.output]
        order = {work.name: index for index, work in enumerate(self._work)}

        def run(frame: Frame) -> Mapping[str, str] | None:
            values = {stream: frame.values[stream] for stream in streams}
            items = {stream: value for stream, value in values.items() if not isinstance(value, NO_ITEM)}
            unchanged = frozenset(stream for stream, value in values.items() if isinstance(value, Unchanged))
            entries = tuple(sorted(frame.entries, key=lambda entry: (order.get(entry.stage, -1), entry.stamp)))
            with self._condition:
                seconds = frame.seconds | self._sink_seconds
                queues = {work.name: len(work.inbox) for work in stages}
            return sink.write(FrameRecord(frame.index, frame.stamp, items, entries, seconds, queues, unchanged))

        # A sink waits for every stream of the frame, even those it does not get: only then are the entries complete.
        every = tuple(dict.fromkeys([*streams, *(work.name for work in stages)]))
        return Work(name, every, tuple(streams), None, True, run, getattr(sink, "checkpoint", lambda: None))
