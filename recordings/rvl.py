"""RVL, the lossless code for depth images that the rerun viewer reads (Wilson, Fast Lossless Depth Image Compression,
2017), in the envelope of ROS 2's compressedDepth.

Runs of zeros and of other values take turns. Each run begins with its length; of the others each value follows as its
difference from the one before. Its one trick is that nothing is searched for: numbers are cut into groups of three
bits, least first, each with a bit that says whether more follow. A disparity image so takes a third more room than as
PNG, which the recording's own compression takes back, and a sixth of the time.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numba import njit

from stages.data import Array

MEDIA_TYPE = "application/rvl"
_HEAD = struct.Struct("<iffII")  # format; quantisation of depth, 0 for none; width, height
_GROUPS = 6  # of three bits, in a difference of 16 bit numbers with its sign; in words of eight groups


def rvl(values: Array) -> bytes:
    """values, (H, W) uint16, as RVL; 0 is unknown."""
    height, width = values.shape
    # A single value between zeros takes the most: two lengths of one group each, and its difference.
    words = np.empty(values.size * (_GROUPS + 2) // 8 + 16, np.uint32)
    count = _encoded(np.ascontiguousarray(values).reshape(-1), words)
    return _HEAD.pack(0, 0.0, 0.0, width, height) + words[:count].astype("<u4", copy=False).tobytes()


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _put(number: Any, words: Any, count: Any, word: Any, free: Any) -> Any:
    """Append a number's groups; a word that is full goes out, its first group in the highest bits."""
    while True:
        group = number & 7
        number >>= 3
        if number > 0:
            group |= 8
        word = (word << 4) | group
        free -= 1
        if free == 0:
            words[count] = word
            count += 1
            word = 0
            free = 8
        if number == 0:
            return count, word, free


@njit(nogil=True, cache=True, error_model="numpy")
def _encoded(values: Any, words: Any) -> int:
    """Write the code of values, (N,) uint16, into words, uint32; returns how many were needed."""
    count, word, free = 0, 0, 8
    at, before = 0, np.int64(0)
    while at < values.size:
        for wanted in (0, 1):  # a run of zeros, then one of other values
            start = at
            while at < values.size and (values[at] != 0) == wanted:
                at += 1
            count, word, free = _put(at - start, words, count, word, free)
        for k in range(start, at):
            difference = np.int64(values[k]) - before
            before = before + difference
            count, word, free = _put((difference << 1) ^ (difference >> 63), words, count, word, free)
    if free < 8:
        words[count] = word << (4 * free)
        count += 1
    return count
