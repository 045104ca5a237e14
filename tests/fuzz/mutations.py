"""Changes of valid files by chance: of bytes, of text, and of the messages and schemas of a log."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Callable
from functools import partial
from random import Random

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

Mutate = Callable[[Random, bytes], bytes]

_POWERS = tuple((1 << bits) - by for bits in (7, 8, 15, 16, 31, 32, 40, 63, 64) for by in (0, 1))
_SIZES = (0, 1, 2, *_POWERS)
_FORMATS = ("<B", "<H", ">H", "<I", ">I", "<Q", ">Q")
_FLOATS = (float("nan"), float("inf"), -float("inf"), 5e-324, -0.0)
_VALUES = (
    "", "~", "null", "0", "-1", "1", "1e400", "-1e308", "1e-320", ".nan", ".inf", "-.inf", "true", "no", "[]", "{}",
    "[[]]", "[1, 2]", "{a: 1}", "9" * 400, "-" + "9" * 5000, "0x1F", "1:30", "1_000", "2001-01-01", "2001-13-45",
    "2001-01-01 99:99:99", '"\\ud800"', '"\\0"', "!!python/object/apply:os.getcwd []", "!!binary x", "!!set {a}",
    "!!timestamp x", "!!int x", "!!float y", "&x [*x]", "*x", "<<: 1", "? [a]\n: b", "[" * 2000, "{a: " * 300,
    "- " * 2000, "5 ms", "3 m", "1e3 px", "é", "\u2028", "'", '"', "|", ">", "%", "@", "\t", "${x}", "$x", "a: b: c",
)  # fmt: skip
_JSON = (
    b"null", b"-1", b"1e999", b"NaN", b"-Infinity", b'""', b'"a"', b"[]", b"{}", b"true", b"9" * 400, b"[[1]]",
    b'{"a": 1}', b"1.5", b"[" * 500 + b"]" * 500, b'"\\ud800"', b"0",
)  # fmt: skip
_TYPES = (
    "string", "wstring", "string<=5", "uint8[]", "uint8[<=3]", "float64[9]", "float64[1000000000]", "string[999]",
    "bool", "char", "byte", "time", "duration", "Header", "std_msgs/Header", "std_msgs/Header[]", "wchar", "int64",
    "geometry_msgs/Point[3]", "geometry_msgs/Point[]", "float32[0]", "uint8[-1]", "sensor_msgs/Image", "no_msgs/None",
)  # fmt: skip
_TOPICS = (
    "", "/", "/tf", "/tf_static", "\0", "x" * 5000, "/stereo/left/image_rect", "/stereo/right/camera_info", "é\n",
)  # fmt: skip
_KINDS = (
    "", "/", "a/b/c/d", "sensor_msgs/msg/Imu", "sensor_msgs/msg/CameraInfo", "foxglove.RawImage", "x" * 5000,
)  # fmt: skip


def mutated_bytes(chance: Random, content: bytes) -> bytes:
    """One to four changes: bits, numbers, and parts cut out, doubled or moved."""
    changed = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 4))):
        if not changed:
            break
        at, size = chance.randrange(len(changed)), min(chance.choice((1, 2, 4, 8, 9, 64, 4096)), len(changed))
        kind = chance.randrange(8)
        if kind == 0:
            changed[at] ^= 1 << chance.randrange(8)
        elif kind == 1:
            changed[at : at + size] = chance.randbytes(size)
        elif kind in (2, 3):
            packed = _number(chance)
            changed[at : at + len(packed)] = packed
        elif kind == 4:
            del changed[at : at + size]
        elif kind == 5:
            del changed[at:]
        elif kind == 6:
            changed[at:at] = changed[at : at + size] * chance.choice((1, 2, 50))
        else:
            other = chance.randrange(len(changed))
            changed[at : at + size] = changed[other : other + size]
    return bytes(changed)


def _number(chance: Random) -> bytes:
    if chance.random() < 0.2:
        return struct.pack(chance.choice(("<d", ">d", "<f")), chance.choice(_FLOATS))
    form = chance.choice(_FORMATS)
    return struct.pack(form, chance.choice(_SIZES) % (1 << 8 * struct.calcsize(form)))


def mutated_text(chance: Random, content: bytes) -> bytes:
    """One to three changes of YAML, JSON or a message definition."""
    text = content.decode("utf-8", "replace")
    for _ in range(chance.choice((1, 1, 2, 3))):
        kind = chance.randrange(8)
        words = list(re.finditer(r"[^\s,:\[\]{}]+", text))
        lines = text.split("\n")
        at = chance.randrange(len(lines))
        if kind in (0, 1, 2) and words:
            word = chance.choice(words)
            text = text[: word.start()] + chance.choice(_VALUES) + text[word.end() :]
        elif kind == 3 and words:
            one, other = chance.choice(words), chance.choice(words)
            text = text[: one.start()] + other.group() + text[one.end() :]
        elif kind == 4:
            del lines[at]
            text = "\n".join(lines)
        elif kind == 5:
            lines.insert(at, chance.choice(lines))
            text = "\n".join(lines)
        elif kind == 6:
            lines[at] = chance.choice(("", "  ", "\t", "- ", "? ")) + lines[at] + chance.choice(("", "  ", ": x", " #"))
            text = "\n".join(lines)
        else:
            return mutated_bytes(chance, text.encode())
    return text.encode()


def _rewritten(chance: Random, content: bytes, messages: bool) -> bytes:
    """A sound MCAP file whose messages are changed, or its schemas, topics and encodings."""
    out = io.BytesIO()
    writer, known = Writer(out, compression=CompressionType.NONE), dict[int, int]()
    writer.start()
    rows = list(make_reader(io.BytesIO(content)).iter_messages())
    target = chance.choice(sorted({channel.topic for _, channel, _ in rows}))
    share = chance.choice((0.1, 0.5, 1.0))
    for schema, channel, message in rows:
        if channel.id not in known:
            hit = not messages and (channel.topic == target or chance.random() < 0.1)
            known[channel.id] = _register(chance if hit else None, writer, schema, channel)
        data, times = message.data, [message.log_time, message.publish_time]
        if messages and channel.topic == target and chance.random() < share:
            is_json = channel.message_encoding == "json"
            data = _mutated_json(chance, data) if is_json else mutated_bytes(chance, _head_first(chance, data))
            if chance.random() < 0.05:
                times[0] = chance.choice(_SIZES) % (1 << 64)
        writer.add_message(known[channel.id], times[0], data, times[1])
    writer.finish()
    return out.getvalue()


mutated_messages, mutated_schemas = (partial(_rewritten, messages=which) for which in (True, False))


def _head_first(chance: Random, data: bytes) -> bytes:
    """The data with a changed number near its start, where the lengths and the header are."""
    if chance.random() < 0.5 or len(data) < 8:
        return data
    at, packed = chance.randrange(min(len(data), 120)), _number(chance)
    return data[:at] + packed + data[at + len(packed) :]


def _mutated_json(chance: Random, data: bytes) -> bytes:
    """JSON with a value replaced: what the text mutations would rarely leave valid."""
    values = list(re.finditer(rb'(?<=[:\[,]) ?("[^"]*"|-?[\d.e+-]+|true|false|null)', data))
    if not values or chance.random() < 0.2:
        return mutated_text(chance, data)
    value = chance.choice(values)
    return data[: value.start()] + chance.choice(_JSON) + data[value.end() :]


def _register(chance: Random | None, writer: Writer, schema: object, channel: object) -> int:
    name, encoding, text = schema.name, schema.encoding, schema.data  # type: ignore[attr-defined]
    topic, message_encoding = channel.topic, channel.message_encoding  # type: ignore[attr-defined]
    if chance is not None:
        kind = chance.randrange(8)
        if kind < 4 and encoding.startswith("ros"):
            text = _mutated_definition(chance, text)
        elif kind < 5:
            text = mutated_bytes(chance, text)
        elif kind == 5:
            topic = chance.choice(_TOPICS)
        elif kind == 6:
            message_encoding = chance.choice(("cdr", "ros1", "protobuf", "json", "", "é"))
        else:
            name = chance.choice(_KINDS)
            encoding = chance.choice((encoding, "ros2msg", "ros2idl", "ros1msg", "protobuf", "jsonschema", ""))
    known = writer.register_schema(name, encoding, text) if chance is None or chance.random() > 0.05 else 0
    return writer.register_channel(topic, message_encoding, known)


def _mutated_definition(chance: Random, text: bytes) -> bytes:
    """A message definition with another type of a field, or changed as a text."""
    fields = list(re.finditer(rb"^([\w/\[\]<=]+)[ \t]+\w+", text, re.MULTILINE))
    if not fields or chance.random() < 0.3:
        return mutated_text(chance, text)
    kind = chance.choice(fields)
    return text[: kind.start(1)] + chance.choice(_TYPES).encode() + text[kind.end(1) :]
