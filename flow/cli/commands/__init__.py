"""The commands of `roverflow`, a module each."""
