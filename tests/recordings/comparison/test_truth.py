"""The errors of disparities as pages."""

import cv2
import numpy as np

from recordings.comparison.pages import ONLY_ONE, error_page, signed_colors
from recordings.comparison.truth import error_pages
from recordings.export.page_layout import MARGIN_STEP, MIN_STEPS
from recordings.mcap.file import iter_decoded
from recordings.ros2.from_msg import read_disparity, stamp_of


def test_a_page_shows_by_how_much_and_where_a_disparity_is_wrong():
    truth = np.full((60, 80), 20.0, np.float32)
    estimate = truth + np.where(np.arange(80) < 40, 0.5, -0.25).astype(np.float32)
    estimate[:10], truth[50:] = np.nan, np.nan
    png = error_page(estimate, truth)
    assert png is not None
    page = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    margin = MARGIN_STEP * MIN_STEPS  # of a small picture
    drawn = page[margin:, margin:][:60, :80]
    for place, expected in (((30, 10), 0.5), ((30, 70), -0.25)):
        assert drawn[place].tolist() == signed_colors(np.array([expected]), 1.0)[0].tolist()
    assert (tuple(drawn[5, 5]), tuple(drawn[55, 5])) == (ONLY_ONE[1][1], ONLY_ONE[2][1])
    assert error_page(estimate[:30], truth) is None


def test_each_variant_has_a_page_of_each_frame_with_truth(traverse, fast_result):
    def disparities(log, topic):
        return {stamp_of(each.header): read_disparity(each) for _, _, each in iter_decoded(log, [topic])}

    estimates, truths = disparities(fast_result, "/nav/disparity"), disparities(traverse, "/truth/disparity")
    pages = list(error_pages({"A": fast_result, "B": fast_result}, [traverse]))
    assert [label for label, _, _ in pages] == ["A"] * len(estimates) + ["B"] * len(estimates)
    expected = {stamp: error_page(estimates[stamp], truths[stamp]) for stamp in estimates}
    assert {stamp: page for _, stamp, page in pages} == expected
