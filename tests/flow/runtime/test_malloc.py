"""The program's threads share one heap, by glibc's own statistics."""

import os
import platform
import subprocess
import sys

import pytest

THREADS = """
import ctypes, threading
together = threading.Barrier(4)

def work():
    together.wait()  # all at once, so that each would want a heap of its own
    for _ in range(100):
        bytes(100_000)
    together.wait()

threads = [threading.Thread(target=work) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
ctypes.CDLL(None).malloc_stats()
"""
PROGRAM = "import sys; sys.argv = ['roverflow', 'graph']; from flow.cli.__main__ import program; program()\n"


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators are left alone")
@pytest.mark.parametrize(("before", "several"), [("", True), (PROGRAM, False)])
def test_the_threads_of_the_program_share_one_heap(before, several):
    environment = {
        name: value for name, value in os.environ.items() if name not in ("MALLOC_ARENA_MAX", "GLIBC_TUNABLES")
    }
    command = [sys.executable, "-c", before + THREADS]
    stderr = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stderr
    assert (stderr.count("Arena ") > 1) == several
