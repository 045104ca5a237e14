"""Results as Foxglove messages in protobuf."""
