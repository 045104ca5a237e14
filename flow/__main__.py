"""`python -m flow` runs the command line."""

from __future__ import annotations

import sys

from flow.cli.__main__ import program

sys.exit(program())
