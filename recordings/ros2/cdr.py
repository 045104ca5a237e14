"""ROS 2 message types and their CDR codec, without a ROS installation.

`standard_types` has the message classes we write. `decoder_for` builds a decoder from the schema in a log, so messages
of a vendor or of an older version are read as they were written. The codec is rosbags'; a decoded image is a view of
the message's bytes, not a copy.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache, lru_cache, partial
from importlib import import_module
from textwrap import shorten
from typing import Any

import zstandard
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_idl, get_types_from_msg

from recordings.errors import LogError
from recordings.mcap.chunk import MAX_CHUNK_BYTES, max_unpacked
from recordings.ros2.typestore import REGISTERING, SharedTypestore

GRID_MAP = """\
std_msgs/Header header
grid_map_msgs/GridMapInfo info
string[] layers
string[] basic_layers
std_msgs/Float32MultiArray[] data
uint16 outer_start_index
uint16 inner_start_index
"""
GRID_MAP_INFO = """\
float64 resolution
float64 length_x
float64 length_y
geometry_msgs/Pose pose
"""

LAST_STAMP = (1 << 31) * 1_000_000_000  # ns; the seconds of a ROS time are a signed 32 bit number

FORMATS = ("ros2msg", "ros2idl")  # of a schema
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # no CDR message begins so
_MAX_REASON = 100  # characters of a parser's message, which may contain the whole schema
_SEPARATOR = re.compile(r"^={20,}\s*$", re.MULTILINE)
_MAX_LINES = 1000  # of a definition
_MAX_ELEMENTS = 1000  # of an array of a fixed size, unless they are numbers


def _typestore(name: str) -> SharedTypestore:
    with REGISTERING:
        return SharedTypestore(import_module(f"rosbags.typesys.stores.{name}"))


def standard_types() -> SharedTypestore:
    """The message classes we write. They take long to import, so the first call does it."""
    with REGISTERING:
        return _standard_types()


@cache
def _standard_types() -> SharedTypestore:
    store = _typestore("ros2_jazzy")
    definitions = get_types_from_msg(GRID_MAP_INFO, "grid_map_msgs/msg/GridMapInfo")
    store.register({**definitions, **get_types_from_msg(GRID_MAP, "grid_map_msgs/msg/GridMap")})
    return store


def make(name: str, /, **fields: Any) -> Any:
    """Make a message of the type `name`, such as "std_msgs/msg/Header", from all of its fields."""
    cls: Any = standard_types().types[name]
    return cls(**fields)


def full_name(schema_name: str) -> str:
    """The full name: "sensor_msgs/msg/Image" for "sensor_msgs/Image"."""
    package, _, rest = schema_name.partition("/")
    return schema_name if "/" in rest or not rest else f"{package}/msg/{rest}"


@lru_cache(maxsize=256)
def decoder_for(schema_name: str, schema_encoding: str, text: bytes) -> Callable[[bytes | memoryview], Any]:
    """Build a function from CDR bytes to a message by the schema of a log ("ros2msg" or "ros2idl").

    An empty schema means the standard type of that name, or a type without fields; if its encoding is empty as well, a
    standard type. Raises LogError for a schema that cannot be parsed. The returned function raises the codec's
    exceptions for bytes that do not fit.
    """
    name = full_name(schema_name)
    undefined = not text.strip()
    if undefined and schema_encoding in ("", *FORMATS) and name in standard_types().types:
        return lambda data: standard_types().deserialize_cdr(plain(data), name)
    if undefined and not schema_encoding:
        raise LogError(f"schema '{schema_name}' has no definition, and is no standard type of ROS 2")
    if schema_encoding not in FORMATS:
        raise LogError(f"schema '{schema_name}' is in '{schema_encoding}', not a ROS 2 format ({', '.join(FORMATS)})")
    store = store_of(schema_name, schema_encoding, text)
    return lambda data: store.deserialize_cdr(plain(data), name)


def store_of(schema_name: str, schema_encoding: str, text: bytes) -> SharedTypestore:
    """A store of the types in a schema ("ros2msg", "ros2idl" or "ros1msg"). Raises LogError if it cannot be parsed."""
    name = full_name(schema_name)
    try:
        # Definitions may contain a byte order mark, Windows line ends, and comments that are not UTF-8.
        store = _store_of(name, schema_encoding, text.decode("utf-8-sig", "replace").replace("\r\n", "\n"))
    except Exception as error:  # a parser of foreign text may fail in any way
        why = shorten(f"{type(error).__name__}: {error}", _MAX_REASON, placeholder=" ...")
        raise LogError(f"schema '{schema_name}' cannot be parsed ({why})") from error
    return store


def is_packed(data: bytes | memoryview) -> bool:
    """Whether rosbag2 compressed a message or a file by itself."""
    return bytes(data[: len(_ZSTD_MAGIC)]) == _ZSTD_MAGIC  # a memoryview compares slowly


def plain(data: bytes | memoryview, size: int = MAX_CHUNK_BYTES) -> bytes | memoryview:
    """At least the first `size` bytes of a message, decompressed if rosbag2 compressed it by itself (zstd)."""
    if not is_packed(data):
        return data
    whole, limit = zstandard.frame_content_size(data), max_unpacked(len(data))
    with zstandard.ZstdDecompressor().stream_reader(data) as stream:
        found = bytes(stream.read(min(size, limit + 1 if whole < 0 else whole, limit + 1)))
    if len(found) > limit:
        raise LogError(f"it unpacks from {len(data)} to more than {limit} bytes")
    return found


def _store_of(name: str, encoding: str, text: str) -> SharedTypestore:
    """A store of the types in the schema, completed by the standard types that it leaves out."""
    store = _typestore("empty")
    with REGISTERING:
        # Lines of '=' separate a schema's definitions. The time to parse one grows with its square.
        parts = _SEPARATOR.split(text)
        if max(map(_lines_of, parts)) > _MAX_LINES:
            raise ValueError(f"a definition has more than {_MAX_LINES} lines")
        # One in IDL begins with "IDL: package/msg/Name". Its includes are among the definitions, and the parser does
        # not know #include.
        if encoding == "ros2idl":
            for part in parts:
                body = re.sub(r"^\s*(IDL:|#).*$", "", part, flags=re.MULTILINE)
                if body.strip():
                    store.register(get_types_from_idl(body))
        else:
            store.register(get_types_from_msg(text, name))
        known = partial(_typestore, "ros1_noetic") if encoding == "ros1msg" else standard_types
        parts_of = set[str]()
        _complete(store, known, name, [], parts_of)
        _check_arrays(store)
        for part in sorted(parts_of):  # what cannot be built is refused now
            getattr(store.get_msgdef(part), "deserialize_ros1" if encoding == "ros1msg" else "deserialize_cdr_le")
    return store


def _lines_of(part: str) -> int:
    """The number of lines or statements of a definition, without comments."""
    return sum(bool(line.strip()) for line in re.split(r"[\n;]", re.sub(r"#.*|//.*", "", part)))


def _check_arrays(store: SharedTypestore) -> None:
    """Refuse long arrays of texts or messages: the codec has a line of code for each element."""
    part: Any
    for name, (_, fields) in store.fielddefs.items():
        for field, (kind, part) in fields:
            if kind == Nodetype.ARRAY and part[1] > _MAX_ELEMENTS:
                (element, detail), size = part
                if element == Nodetype.NAME or detail[0] in ("string", "wstring"):
                    raise ValueError(f"{name}.{field} has {size} elements")


def _complete(
    store: SharedTypestore, known: Callable[[], SharedTypestore], name: str, above: list[str], done: set[str]
) -> None:
    """Add the `known` types in the fields of type `name`, recursively. above: the types that contain it."""
    if name in above:
        raise ValueError(f"{name} contains itself")
    if name in done:
        return
    if name not in store.fielddefs:
        store.fielddefs[name] = known().fielddefs[name]
        store.types[name] = known().types[name]
    for part in sorted(_references(store.fielddefs[name][1])):
        _complete(store, known, part, [*above, name], done)
    done.add(name)


def _references(fields: Any) -> set[str]:
    """The names of the message types in a list of field definitions."""
    found: set[str] = set()
    for _, (kind, detail) in fields:
        node, inner = (kind, detail) if kind in (Nodetype.BASE, Nodetype.NAME) else detail[0]
        if node == Nodetype.NAME:
            found.add(inner)
    return found
