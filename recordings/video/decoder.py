"""Decodes compressed video message by message, with PyAV."""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import numpy as np

from recordings.errors import LogError, sentence_of
from recordings.ros2.image_from_msg import check_size, pixels_of
from recordings.video.formats import CODECS, VIDEO, FrameNumbers, is_key_frame, unread_video
from stages.data import Array

NO_KEY_FRAME = "no key frame yet: the video is read from its next one"


class PixelReader(Protocol):
    """A function to the pixels of a message, of the size that its calibration has."""

    def __call__(self, message: Any, size: tuple[int, int] | None = None) -> Array: ...


class VideoDecoder:
    """The brightness of the images of one video. Its messages are given in their order, also those not needed."""

    def __init__(self, max_pixels: int) -> None:
        self._max_pixels = max_pixels
        self._codec: Any = None
        self._format = ""
        self._is_begun = False
        self._numbers = FrameNumbers()

    def skip(self) -> None:
        """Note that a message is lost; so are all until the next key frame."""
        self._is_begun = False

    def __call__(self, message: Any, size: tuple[int, int] | None = None) -> Array:
        """The image of a message, (H, W) uint8; `size` and errors as of `pixels_of`."""
        try:
            return self._decoded(str(message.video_format), np.asarray(message.data, np.uint8).tobytes(), size)
        except Exception:
            self.skip()
            raise

    def _decoded(self, video_format: str, data: bytes, size: tuple[int, int] | None) -> Array:
        if why := unread_video(video_format):
            raise LogError(why)
        is_key = is_key_frame(video_format, data)
        if is_key and (video_format != self._format or not self._is_begun):
            self._begin(video_format)
        elif not self._is_begun or video_format != self._format:
            raise LogError(NO_KEY_FRAME)
        if video_format == "h264" and not self._numbers.follows(data):
            raise LogError(f"a message before it is missing, so there is {NO_KEY_FRAME}")
        frame = self._frame(data)
        check_size(frame.width, frame.height, size, self._max_pixels)
        return _brightness(frame)

    def _begin(self, video_format: str) -> None:
        """Begin at a key frame, without anything of the frames before."""
        import av

        self._codec = av.CodecContext.create(CODECS[video_format], "r")
        self._codec.thread_count = 1
        self._codec.flags |= av.codec.context.Flags.low_delay
        self._codec.options = {"max_pixels": str(self._max_pixels), "err_detect": "explode"}
        self._format, self._is_begun, self._numbers = video_format, True, FrameNumbers()

    def _frame(self, data: bytes) -> Any:
        import av

        try:
            frames = self._codec.decode(av.Packet(data))
        except (av.FFmpegError, ValueError) as error:
            raise LogError(f"the {self._format} video cannot be decoded ({sentence_of(error)})") from error
        if len(frames) != 1:
            raise LogError(f"a message of the {self._format} video gives {len(frames)} images; record one in each")
        if frames[0].is_corrupt:
            raise LogError(f"the image of the {self._format} video is damaged")
        return frames[0]


def _brightness(frame: Any) -> Array:
    """The brightness of a frame, (H, W) uint8, as it is coded."""
    is_planar = frame.format.is_planar and frame.format.components[0].bits == 8
    is_plane = frame.format.name == "gray" or (is_planar and frame.format.name.startswith(("yuv", "nv")))
    plane = (frame if is_plane else frame.reformat(format="gray")).planes[0]
    rows = np.frombuffer(plane, np.uint8)[: plane.line_size * frame.height].reshape(frame.height, plane.line_size)
    return rows[:, : frame.width].copy()


def begins_video(message: Any) -> bool:
    """Whether a video can be decoded from this message on."""
    return is_key_frame(str(message.video_format), np.asarray(message.data, np.uint8).tobytes())


def reader_of(schema: str, max_pixels: int) -> PixelReader:
    """A function to the pixels of the messages of one topic, in their order. schema: their full name."""
    return VideoDecoder(max_pixels) if schema == VIDEO else partial(pixels_of, max_pixels=max_pixels)
