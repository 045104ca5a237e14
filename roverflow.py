"""The entry point: checks that `flow`, `stages` and `recordings` are roverflow's own, then runs the command line.

Other packages use the same three names. Without this check a foreign module would end in a traceback.
"""

from __future__ import annotations

import base64
import hashlib
import sys
from importlib import import_module
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path

PACKAGES = ("flow", "stages", "recordings")
HOME = Path(__file__).resolve().parent


def program() -> int:
    """Run the command line; returns the exit code."""
    if problem := foreign_module() or overwritten_module():
        print(f"roverflow: {problem}", file=sys.stderr)
        return 2
    for name in PACKAGES:  # before a module beside a pipeline file can take the name
        import_module(name)
    from flow.cli.__main__ import program

    return program()


def foreign_module() -> str:
    """A sentence about the first package that Python finds elsewhere than beside this file; empty if there is none."""
    for name in PACKAGES:
        spec = find_spec(name)
        found = Path(spec.origin).resolve() if spec and spec.origin else None
        if found != HOME / name / "__init__.py":
            what = f"{found} is in the way of" if found else f"Python does not find {HOME / name},"
            return f"{what} roverflow's package '{name}'; rename it, or change PYTHONPATH or the current folder"
    return ""


def overwritten_module() -> str:
    """A sentence about the first package whose installed file is not roverflow's; empty if there is none."""
    try:
        files = distribution("roverflow").files or []
    except PackageNotFoundError:
        return ""
    for file in files:
        if file.name == "__init__.py" and str(file.parent) in PACKAGES and file.hash:
            path = Path(str(file.locate()))
            digest = base64.urlsafe_b64encode(hashlib.sha256(path.read_bytes()).digest()).rstrip(b"=").decode()
            if digest != file.hash.value:
                return f"another package overwrote {path}; install roverflow in an environment of its own"
    return ""


if __name__ == "__main__":
    sys.exit(program())
