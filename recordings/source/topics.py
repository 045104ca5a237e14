"""The messages of a log by topic, decoded by the schemas in its files.

A message may have any fields, whatever the name of its type. What cannot be converted becomes a LogError in its place;
reading continues.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from typing import Any, TypeVar

import numpy as np

from recordings.containers.container import LostMessage, MessageSchema, RawMessage
from recordings.containers.header import peek_stamp
from recordings.containers.recording import Recording
from recordings.containers.time_range import MAX_LATENESS_NS
from recordings.encodings.decoding import MAX_SCHEMA_BYTES, Decoder, decoder_of, weight_of
from recordings.errors import LogError, sentence_of
from recordings.mcap.chunk import Unpacking
from recordings.ros2.from_msg import frame_of, stamp_of
from recordings.video.decoder import PixelReader, VideoDecoder, begins_video, reader_of

MAX_CHANNELS = 1000  # that are decoded; a rover has a tenth of it
_RATE_SECONDS = 10  # over which the rate of a topic is a mean, as recorders write late messages in bursts
_SAMPLE_PLACES = 4  # parts of a log with samples each, because a sensor may begin with invalid messages
_MAX_SAMPLES = 20  # messages of each part
MAX_TRIED = 200  # likewise, where one suffices; most transforms on /tf may be of other frames

_MAX_WAITING_BYTES = 200_000_000  # of messages while calibrations and transforms are read ahead
_ITEM_BYTES = 1000  # of a message that waits, beside its data

T = TypeVar("T")


@dataclass
class TopicReader:
    """Reads the messages of one topic. item: (message, log time) -> item of the stream, None for none;
    video: the decoder of a video, for which no message may be left out.
    """

    stream: str
    topic: str
    decoders: dict[int, Decoder]
    item: Callable[[Any, int], Any]
    video: VideoDecoder | None = None

    def __call__(self, raw: RawMessage) -> Any:
        """The item of a message, or a LogError."""
        try:
            return self.item(self.decoders[raw.channel](raw.data), raw.log_time)
        except Exception as error:  # foreign bytes may fail a codec in any way; the message is lost, not the log
            self.note_lost(raw.channel)
            return LogError(f"{self.topic} at {raw.log_time} ns: {sentence_of(error)}")

    def note_lost(self, channel: int | None) -> None:
        """Note a lost message, which a video needs for those after it. channel: None if unknown."""
        if self.video is not None and (channel is None or channel in self.decoders):
            self.video.skip()

    def begins_video(self, raw: RawMessage) -> bool:
        """Whether a message is a key frame of a video."""
        return attempt(lambda: begins_video(self.decoders[raw.channel](raw.data))) is True


class _GoneError(LogError):
    """A message that is lost in the file."""


class DecodedTopics:
    """The messages of a log by topic, converted by a function `make`; a LogError where it fails.

    decoders: by channel; undecodable_channels: channel -> reason; schemas: decodable topic -> full ROS 2 type name.
    """

    def __init__(self, file: Recording, max_pixels: int, max_rate: int) -> None:
        self.file, self._max_pixels = file, max_pixels
        self.decoders: dict[int, Decoder] = {}
        self.undecodable_channels: dict[int, str] = {}
        self.schemas: dict[str, str] = {}
        self._ahead: dict[str, int] = {}
        self._last: tuple[Any, Any] = None, None  # data and message
        weights, unpacking, dense = dict[MessageSchema, int](), Unpacking(), self._dense_topics(max_rate)
        for place, (number, channel) in enumerate(file.channels.items()):
            if place >= MAX_CHANNELS:
                self.undecodable_channels[number] = f"the log has more than {MAX_CHANNELS} channels"
                continue
            if channel.schema is not None and channel.schema not in weights:
                weights[channel.schema] = weight_of(channel.schema)
            try:
                if channel.topic in dense:
                    raise LogError(dense[channel.topic])
                if sum(weights.values()) > MAX_SCHEMA_BYTES:
                    raise LogError(f"the schemas of the log have more than {MAX_SCHEMA_BYTES} bytes")
                self.schemas[channel.topic], decode = decoder_of(channel, unpacking)
                self.decoders[number] = partial(self._decoded, decode)
            except LogError as error:
                self.undecodable_channels[number] = str(error)

    def _decoded(self, decode: Decoder, data: bytes | memoryview) -> Any:
        """A message. The last one is kept, as some are decoded for their stamp, and then for their content."""
        last = self._last
        if last[0] is not data:
            self._last = last = data, decode(data)
        return last[1]

    def _dense_topics(self, max_rate: int) -> dict[str, str]:
        """The topics with more messages in a time than any sensor has -> a sentence."""
        most, dense = _RATE_SECONDS * max_rate, dict[str, str]()
        remedy = "set 'max_rate' of the source to the rate of the sensor, Hz, if it is that fast"
        for topic in {channel.topic for channel in islice(self.file.channels.values(), MAX_CHANNELS)}:
            channels = self.file.channels_of([topic])
            times = self.file.times(channels, allow_repeats=True) if self.file.count(channels) > most else np.zeros(0)
            if len(times) > most and np.min(times[most:] - times[:-most]) < _RATE_SECONDS * 1_000_000_000:
                what = f"over {most} of its {len(times)} messages were logged within {_RATE_SECONDS} s"
                dense[topic] = f"{what}; {remedy}"
        return dense

    def pixel_reader(self, topic: str) -> PixelReader:
        """A function to the pixels of a topic's messages, in their order."""
        return reader_of(self.schemas[topic], self._max_pixels)

    def channels_of(self, topic: str) -> set[int]:
        """The channels of a topic that can be decoded."""
        return self.file.channels_of([topic]) & self.decoders.keys()

    def count(self, topic: str) -> int:
        """The number of messages of a topic in decodable channels."""
        return self.file.count(self.channels_of(topic))

    def stamp_of(self, raw: RawMessage) -> int:
        """The header stamp of a message, ns; 0 if there is none."""
        channel = self.file.channels[raw.channel]
        if channel.message_encoding in ("cdr", "ros1"):
            return peek_stamp(raw.data, channel.message_encoding) if raw.channel in self.file.stamped else 0
        stamp = attempt(lambda: stamp_of(self.decoders[raw.channel](raw.data).header))
        return 0 if isinstance(stamp, LogError) else stamp

    def ahead_of(self, topic: str) -> int:
        """How far the last stamp of a topic is ahead of its log time, ns, where they are of two clocks; else 0."""
        if topic not in self._ahead:
            times = self.file.times(self.channels_of(topic))
            raws = self.file.messages(self.channels_of(topic), max(times[-1:], default=None))
            last = next((raw for raw in raws if isinstance(raw, RawMessage)), None)
            stamp = self.stamp_of(last) if last is not None else 0
            ahead = stamp - last.log_time if last is not None and stamp else 0
            self._ahead[topic] = ahead if abs(ahead) > MAX_LATENESS_NS else 0
        return self._ahead[topic]

    def delay_of(self, topic: str) -> int:
        """The median of the log times less the stamps of a sample, ns; 0 for messages without stamps."""
        channels = self.channels_of(topic)
        parts = (islice(self.file.messages(channels, start), _MAX_SAMPLES) for start in self._places())
        raws = [raw for raw in chain.from_iterable(parts) if isinstance(raw, RawMessage)]
        delays = [raw.log_time - stamp for raw in raws if (stamp := self.stamp_of(raw))]
        return int(np.median(delays)) if delays else 0

    def is_unstamped(self, topic: str) -> bool:
        """Whether the header stamps of a topic are 0 and not those of a clock that begins there."""
        return self.first(topic, lambda message: stamp_of(message.header)) == 0 and not self.ahead_of(topic)

    def each(
        self, topic: str, make: Callable[[Any], T], start: int | None = None, allow_repeats: bool = False
    ) -> Iterator[T | LogError]:
        """Convert each message of a topic from the log time `start`, ns."""
        for raw in self.file.messages(self.channels_of(topic), start, allow_repeats=allow_repeats):
            if not isinstance(raw, LostMessage):
                yield attempt(lambda data, decoder: make(decoder(data)), raw.data, self.decoders[raw.channel])
            elif raw.channel is not None:
                yield _GoneError(raw.reason)

    def sample(self, topic: str, make: Callable[[Any], T], most: int | None = None) -> Iterator[T | LogError]:
        """Convert some messages of a topic, spread over the log, without lost ones. most: of each part."""
        for start in self._places():
            made = self.each(topic, make, start, allow_repeats=True)
            yield from islice((each for each in made if not isinstance(each, _GoneError)), most or _MAX_SAMPLES)

    def _places(self) -> list[int]:
        """The log times at which samples begin, ns."""
        length = self.file.end - self.file.start
        return [self.file.start + length * place // _SAMPLE_PLACES for place in range(_SAMPLE_PLACES)]

    def last(self, topic: str, make: Callable[[Any], T]) -> Iterator[T | LogError]:
        """Convert the messages of a topic at its last log time."""
        return self.each(topic, make, max(self.file.times(self.channels_of(topic))[-1:], default=None))

    def first(self, topic: str, make: Callable[[Any], T]) -> T | LogError:
        """Convert the first message, or the first of a sample for which this succeeds; otherwise the LogError."""
        made = next(self.each(topic, make), LogError(f"{topic} has no messages"))
        if isinstance(made, LogError):
            made = next((each for each in self.sample(topic, make, MAX_TRIED) if not isinstance(each, LogError)), made)
        return made

    def frame_of(self, topic: str) -> str:
        """The frame_id of a topic's first message, or an empty string."""
        frame = self.first(topic, frame_of)
        return "" if isinstance(frame, LogError) else frame


def attempt(make: Callable[..., T], *arguments: Any) -> T | LogError:
    """Call `make` and return any exception as a LogError: foreign messages may fail a codec in any way."""
    try:
        return make(*arguments)
    except LogError as error:
        error.__cause__ = error.__context__ = None  # they hold the message
        return error.with_traceback(None)
    except (AttributeError, TypeError) as error:
        return LogError(f"its content does not match the name of its type ({sentence_of(error)})")
    except Exception as error:
        return LogError(sentence_of(error))


def with_lookahead(
    raws: Iterable[RawMessage | LostMessage], early: dict[int, list[TopicReader]], lag: int
) -> Iterator[tuple[RawMessage | LostMessage, list[tuple[str, Any]]]]:
    """Each message with the streams and results of its readers in `early`, which read `lag` ns ahead."""
    waiting: deque[tuple[RawMessage | LostMessage, list[tuple[str, Any]]]] = deque()
    size = 0
    for raw in raws:
        size += _size(raw)
        made = [(each.stream, each(raw)) for each in early.get(raw.channel, ())] if isinstance(raw, RawMessage) else []
        waiting.append((raw, made))
        while waiting[0][0].log_time < raw.log_time - lag or (size > _MAX_WAITING_BYTES and len(waiting) > 1):
            size -= _size(waiting[0][0])
            yield waiting.popleft()
    yield from waiting


def _size(raw: RawMessage | LostMessage) -> int:
    return _ITEM_BYTES + (len(raw.data) if isinstance(raw, RawMessage) else 0)
