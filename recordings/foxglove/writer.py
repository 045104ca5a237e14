"""Writes a result log in Foxglove's own messages, in protobuf."""

from __future__ import annotations

from typing import Any

from mcap_protobuf.schema import build_file_descriptor_set

from recordings.foxglove.to_protobuf import foxglove_messages
from recordings.mcap.writer import MessageKind, Ros2Writer


class FoxgloveWriter(Ros2Writer):
    """Takes ROS 2 messages as `Ros2Writer` does; types with a counterpart become Foxglove messages."""

    profile = ""

    def write(self, topic: str, message: Any, stamp: int) -> None:
        """Append one message at `stamp`, ns; a list of diagnostics becomes a message for each."""
        found = foxglove_messages(message)
        if found is None:
            super().write(topic, message, stamp)
            return
        for known in found:
            self.add(topic, self._protobuf_kind(known), stamp, known.SerializeToString(deterministic=True))

    def _protobuf_kind(self, message: Any) -> MessageKind:
        name = message.DESCRIPTOR.full_name
        if name not in self._kinds:
            text = build_file_descriptor_set(type(message)).SerializeToString(deterministic=True)
            self._kinds[name] = MessageKind(name, "protobuf", "protobuf", text)
        return self._kinds[name]
