"""The lines and tables of a difference."""

from recordings.comparison.diff import Diff, TopicDiff
from recordings.comparison.text import comparison, format_diff

STAMP = 1_700_000_000_000_000_000


def test_a_single_pixel_or_cell_is_in_the_singular():
    worst = {"pixels": 1.0, "pixels known only in A": 1.0, "pixels known only in B": 2.0}
    found = Diff(("/nav/disparity", STAMP), {"/nav/disparity": TopicDiff(1, 1, first=STAMP, worst=worst)})
    line = "up to 1 pixel a message, 1 pixel known only in A, 2 pixels known only in B"
    assert line in comparison(found)


def test_a_fact_of_several_lines_has_a_line_for_each_of_the_first_ten():
    long = "\n".join(map(str, range(12)))
    text = format_diff(Diff(facts={"version": ("1", ""), "pipeline": ("a\nb", long)}))
    shown = ["version: A 1 | B -", "pipeline:", "  A a", "  A b", *(f"  B {number}" for number in range(10))]
    assert text.splitlines()[:-1] == [*shown, "  B and 2 more lines"]
