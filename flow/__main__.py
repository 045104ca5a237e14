"""`python -m flow` runs the command line."""

from __future__ import annotations

import sys

from roverflow import program

sys.exit(program())
