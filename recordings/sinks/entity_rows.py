"""Rows of a recording's entities, which wait and are sent together: a call of rerun costs more than most of them.

A component that a row leaves out stays what it was in the row before.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import cache, lru_cache
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr

from recordings.sinks.blueprint import CLOCK, FRAME
from stages.data import Array

_FORMS: dict[tuple[Any, str], tuple[rr.ComponentDescriptor, pa.DataType]] = {}  # of an archetype's fields
BATCH_BYTES = 1 << 19  # that one entity waits with; each stored chunk takes 3 kB besides its content


class Blob(NamedTuple):
    """The bytes of an image, which are copied only once, when they are sent."""

    content: pa.Buffer
    kind: pa.DataType

    @property
    def nbytes(self) -> int:
        """Its size, with the place of its end in a list."""
        return int(self.content.size) + 4


At = tuple[int, int]  # the stamp, ns, and the number of a frame


class Component(NamedTuple):
    """A component of an entity in one row."""

    descriptor: rr.ComponentDescriptor
    content: Any  # an array of Arrow, a Blob, or a number

    @property
    def nbytes(self) -> int:
        """The size of its content. Arrow takes ten times as long for the `nbytes` of an array."""
        if isinstance(self.content, float):
            return 8
        return int(self.content.nbytes if isinstance(self.content, Blob) else self.content.get_total_buffer_size())


class _Column(NamedTuple):
    """A component of an entity in many rows, as rerun takes it."""

    descriptor: rr.ComponentDescriptor
    values: pa.ListArray

    def component_descriptor(self) -> rr.ComponentDescriptor:
        return self.descriptor

    def as_arrow_array(self) -> pa.ListArray:
        return self.values


class EntityRows:
    """The rows that wait, by the paths of their entities. An entity's rows are sent when they have `BATCH_BYTES`."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._rows: defaultdict[str, list[tuple[At, Sequence[Component]]]] = defaultdict(list)
        self._bytes: defaultdict[str, int] = defaultdict(int)

    def add(self, path: str, at: At, components: Sequence[Component]) -> None:
        """Add a row."""
        self._rows[path].append((at, components))
        self._bytes[path] += sum(one.nbytes for one in components)
        if self._bytes[path] >= BATCH_BYTES:
            self._send(path)

    def send(self) -> None:
        """Send all rows that wait."""
        for path in tuple(self._rows):
            self._send(path)

    def _send(self, path: str) -> None:
        rows, columns = self._rows.pop(path), dict[rr.ComponentDescriptor, list[Any]]()
        del self._bytes[path]
        for number, (_, components) in enumerate(rows):
            for descriptor, content in components:
                columns.setdefault(descriptor, [None] * len(rows))[number] = content
        sent = [_Column(descriptor, _listed(contents)) for descriptor, contents in columns.items()]
        stamps, frames = zip(*(at for at, _ in rows), strict=True)
        times = np.array(stamps, "datetime64[ns]")
        clocks = [rr.TimeColumn(CLOCK, timestamp=times), rr.TimeColumn(FRAME, sequence=frames)]
        self._recording.send_columns(path, indexes=clocks, columns=sent, strict=True)  # type: ignore[arg-type]


class Drawn(NamedTuple):
    """An archetype as rows have it."""

    kind: type
    components: tuple[Component, ...]


def components_of(archetype: Any) -> tuple[Component, ...]:
    """The components of an archetype, as rows have them."""
    batches = archetype.as_component_batches()
    return tuple(Component(batch.component_descriptor(), batch.as_arrow_array()) for batch in batches)


def drawn(kind: Any, **fields: Any) -> Drawn:
    """An archetype with these fields: numbers, colours, texts and lines, in a fifth of the time that rerun takes."""
    return Drawn(kind, tuple(_component(kind, name, values) for name, values in fields.items()))


@lru_cache(maxsize=256)
def fields_of(kind: Any, **fields: Any) -> tuple[Component, ...]:
    """Fields of an archetype. To make these takes longer than to log an image, so those that recur are kept."""
    return components_of(kind.from_fields(**fields))


@cache
def masking(name: str, color: tuple[int, ...]) -> tuple[Component, ...]:
    """How a mask is drawn: 1 in a colour, 0 not at all."""
    labels = [
        rr.AnnotationInfo(id=0, label="known", color=(0, 0, 0, 0)),
        rr.AnnotationInfo(id=1, label=name, color=color),
    ]
    opaque = fields_of(rr.SegmentationImage, opacity=1.0)
    return (*opaque, *components_of(rr.AnnotationContext(labels)))


@lru_cache(maxsize=256)
def image_format(kind: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> tuple[Component, ...]:
    """The size and the type of the pixels of an image that is not encoded."""
    components = components_of(kind(np.zeros(shape, dtype)))
    return tuple(one for one in components if one.descriptor.component.endswith(":format"))


@lru_cache(maxsize=256)
def depth_range(ends: tuple[float, float]) -> Component:
    """The ends of the colours of values."""
    (like,) = fields_of(rr.DepthImage, depth_range=(0.0, 1.0))
    stored = pa.FixedSizeListArray.from_arrays(np.array(ends, np.float64), type=like.content.type)
    return Component(like.descriptor, stored)


def _component(kind: Any, name: str, values: Any) -> Component:
    """A field of an archetype. rerun makes the first one, which shows the form of the others."""
    if (kind, name) not in _FORMS:
        ((descriptor, content),) = components_of(kind.from_fields(**{name: values}))
        _FORMS[kind, name] = descriptor, content.type
        return Component(descriptor, content)
    descriptor, form = _FORMS[kind, name]
    return Component(descriptor, _as_arrow(values, form))


def _as_arrow(values: Any, form: pa.DataType) -> pa.Array:
    """Values of one component: numbers, colours as RGB or RGBA, places (n, k), lines of places, texts, enums."""
    if pa.types.is_fixed_size_list(form):
        flat = np.ascontiguousarray(values, form.value_type.to_pandas_dtype()).ravel()
        return pa.FixedSizeListArray.from_arrays(pa.array(flat), type=form)
    if pa.types.is_list(form):
        places = _as_arrow(np.concatenate([np.asarray(line) for line in values]), form.value_type)
        return pa.ListArray.from_arrays(_ends([len(line) for line in values]), places, type=form)
    if form == pa.uint32():
        colors = np.asarray(values, np.uint8)
        abgr = np.full((len(colors), 4), 255, np.uint8)
        for channel in range(colors.shape[1]):  # numpy is faster by columns
            abgr[:, 3 - channel] = colors[:, channel]
        return pa.array(abgr.view("<u4").ravel())
    if pa.types.is_floating(form):
        return pa.array(np.array(values, form.to_pandas_dtype(), ndmin=1))
    return pa.array(values if isinstance(values, list) else [getattr(values, "value", values)], form)


def blob(kind: Any, field: str, content: bytes | Array) -> Component:
    """The bytes of an image as the field of an archetype, not copied."""
    ((descriptor, empty),) = fields_of(kind, **{field: b""})
    return Component(descriptor, Blob(pa.py_buffer(content), empty.type))


def _listed(contents: Sequence[Any]) -> pa.ListArray:
    """What many rows have of a component: nothing where it is cleared, null where a row leaves it out."""
    present = [content for content in contents if content is not None]
    if isinstance(present[0], float):
        return pa.array([[content] if content is not None else None for content in contents])
    blobs = [content for content in present if isinstance(content, Blob)]
    values = _joined(blobs) if blobs else pa.concat_arrays(present)
    lengths = [0 if content is None else 1 if isinstance(content, Blob) else len(content) for content in contents]
    missing = pa.array([content is None for content in contents]) if len(present) < len(contents) else None
    return pa.ListArray.from_arrays(_ends(lengths), values, mask=missing)


def _joined(blobs: Sequence[Blob]) -> pa.ListArray:
    """The bytes of many images."""
    joined = pa.py_buffer(b"".join(blob.content for blob in blobs))
    values = pa.Array.from_buffers(pa.uint8(), joined.size, [None, joined])
    return pa.ListArray.from_arrays(_ends([blob.content.size for blob in blobs]), values, type=blobs[0].kind)


def _ends(lengths: Sequence[int]) -> pa.Array:
    """The places at which lists of these lengths begin, and the end."""
    return pa.array(list(accumulate(lengths, initial=0)), pa.int32())
