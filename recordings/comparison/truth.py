"""How far the disparities of variants are off the truth of their log, as pages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path

from recordings.comparison.pages import error_page
from recordings.containers.opening import open_recording
from recordings.mcap.file import decoded, iter_decoded
from recordings.ros2.from_msg import read_disparity, stamp_of

MAX_FRAMES = 10  # that are drawn
MARGIN = 1_000_000_000  # ns of log time before and after the frames in which their truth may be


def error_pages(results: Mapping[str, Path], truth: Sequence[Path]) -> Iterator[tuple[str, int, bytes]]:
    """(Variant, stamp, PNG page) of the disparities with truth; none for truth of another image size.

    results: variant -> its result log; truth: the files or the folder of the log with /truth/disparity.
    """
    with open_recording(truth) as log:
        for label, result in results.items():
            found = islice(iter_decoded(result, ["/nav/disparity"], Counter()), MAX_FRAMES)
            estimates = {stamp: read_disparity(message) for _, stamp, message in found}
            if not estimates:
                continue
            part = min(estimates) - MARGIN, max(estimates) + MARGIN
            for _, _, message in decoded(log, ["/truth/disparity"], Counter(), part):
                estimate = estimates.get(stamp_of(message.header))
                if estimate is not None and (page := error_page(estimate, read_disparity(message))) is not None:
                    yield label, stamp_of(message.header), page
