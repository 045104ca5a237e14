"""The containers that messages come in, behind one protocol: what the source needs of a file, whatever its format."""
