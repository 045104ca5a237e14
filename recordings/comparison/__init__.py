"""Two results side by side: what differs, from which frame on, by how much, in tables and pictures."""
