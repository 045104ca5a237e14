"""The lines and tables of a difference."""

from recordings.comparison.diff import Diff, TopicDiff
from recordings.comparison.text import comparison

STAMP = 1_700_000_000_000_000_000


def test_a_single_pixel_or_cell_is_in_the_singular():
    worst = {"pixels": 1.0, "pixels known only in A": 1.0, "pixels known only in B": 2.0}
    found = Diff(("/nav/disparity", STAMP), {"/nav/disparity": TopicDiff(1, 1, first=STAMP, worst=worst)})
    line = "up to 1 pixel a message, 1 pixel known only in A, 2 pixels known only in B"
    assert line in comparison(found)
