"""The match pyramid (coarse to fine): frames at half size, disparities at double size, and the views swapped.

A frame at half size has a quarter of the pixels, and the same search range reaches twice as near. Noise averages out
and weak texture gains contrast. The result guides the search at full size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2

from flow.contracts import StageError
from stages.data import Disparity, StereoFrame
from stages.matching.kernels.resample import doubled, halved
from stages.matching.match import MIN_SIDE
from stages.stage import Stage, check_rectified, check_same_time, check_types, parameter


@dataclass(frozen=True)
class Halve(Stage):
    """The frame at half size, each pixel the mean of four; an odd last row or column is repeated."""

    def __call__(self, frame: StereoFrame) -> StereoFrame:
        """The smaller frame, with a camera of its size."""
        check_rectified(self, frame)
        full_height, full_width = frame.left.shape[:2]
        left, right = halved(frame.left), halved(frame.right)
        height, width = left.shape[:2]
        if min(height, width) < MIN_SIDE:
            raise StageError(
                f"Halve: images are {full_width}x{full_height}, too small to be matched at half size: each side must "
                f"be at least {2 * MIN_SIDE - 1} px; use a pipeline without stages.Halve, such as paper"
            )
        camera = frame.camera
        # Pixel centres are whole numbers: u becomes (u + 0.5) / 2 - 0.5.
        cx, cy, cx_right = ((value + 0.5) / 2 - 0.5 for value in (camera.cx, camera.cy, camera.cx_right))
        small = replace(
            camera, fx=camera.fx / 2, fy=camera.fy / 2, cx=cx, cy=cy, cx_right=cx_right, width=width, height=height
        )
        return StereoFrame(frame.stamp, left, right, small)


@dataclass(frozen=True)
class Upsample(Stage):
    """A disparity image of half size, enlarged to the size of a frame: a prior for matching the frame.

    Disparities are doubled, and interpolated within a surface. Source and confidence are those of the nearest pixel.
    """

    keep_sigma: bool = parameter(False, "double the sigma as well; a prior needs none")

    def __call__(self, frame: StereoFrame, disparity: Disparity) -> Disparity:
        """The disparity of `frame`, from that of `Halve()(frame)`."""
        check_types(self, frame=frame, disparity=disparity)
        height, width = frame.left.shape[:2]
        small = disparity.pixels.shape
        if small != ((height + 1) // 2, (width + 1) // 2):
            raise StageError(f"Upsample: the disparity has shape {small}, which is not half of {(height, width)}")
        check_same_time(self, frame=frame.stamp, disparity=disparity.stamp)
        pixels = doubled(disparity.pixels, height, width)
        layers = [disparity.source, disparity.confidence]
        if self.keep_sigma and disparity.sigma is not None:
            layers.append(2 * disparity.sigma)
        source, confidence, *sigma = (
            cv2.resize(layer, (2 * small[1], 2 * small[0]), interpolation=cv2.INTER_NEAREST)[:height, :width]
            for layer in layers
        )
        return Disparity(
            frame.stamp, pixels, source, confidence, camera=frame.camera, sigma=sigma[0] if sigma else None
        )


@dataclass(frozen=True)
class SwapViews(Stage):
    """The frame of the right camera's view: the images exchanged and mirrored, so that disparities stay positive.

    The disparity of a swapped frame, mirrored back, is that of the right image.
    """

    def __call__(self, frame: StereoFrame) -> StereoFrame:
        """The swapped frame."""
        check_rectified(self, frame)
        camera = frame.camera
        last = camera.width - 1
        mirrored = replace(camera, cx=last - camera.cx_right, cx_right=last - camera.cx)
        return StereoFrame(frame.stamp, cv2.flip(frame.right, 1), cv2.flip(frame.left, 1), mirrored)
