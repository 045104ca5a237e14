"""The commands of `roverflow` that find causes, a module each; docs/debugging.md leads through them."""
