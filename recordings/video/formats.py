"""The video formats that are read, and what the bytes of a frame say about it (ITU-T H.264 and H.265, Annex B)."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec

from flow.contracts import remedy_for

VIDEO_NOTE = "the images are compressed video, whose losses shift disparities by fractions of a pixel"
VIDEO = "foxglove_msgs/msg/CompressedVideo"
CODECS = {"h264": "h264", "h265": "hevc"}  # format -> FFmpeg's name of the codec
_MAX_UNITS, _UNIT_BYTES = 100, 512  # looked at in each frame
_H264_SLICES = range(1, 6)
_H264_KEY, _H264_PARAMETERS = 5, 7
_H265_KEYS, _H265_SLICES = range(16, 22), range(32)


def unread_video(video_format: str) -> str:
    """A sentence about a video that cannot be decoded here; empty for others."""
    if video_format not in CODECS:
        return f"the video format '{video_format}' is not supported; record it in {' or '.join(CODECS)}"
    if find_spec("av") is None:
        return f"compressed video needs PyAV; {remedy_for('av')}"
    return ""


def is_key_frame(video_format: str, data: bytes) -> bool:
    """Whether a video can be decoded from this frame on."""
    for unit in units_of(data):
        if video_format == "h264" and unit[0] & 31 in _H264_SLICES:
            return unit[0] & 31 == _H264_KEY
        if video_format == "h265" and unit[0] >> 1 & 63 in _H265_SLICES:
            return unit[0] >> 1 & 63 in _H265_KEYS
    return False


def units_of(data: bytes) -> Iterator[bytes]:
    """The first bytes of the first units of a frame; those before its picture are few and short."""
    start = data.find(b"\0\0\1")
    for _ in range(_MAX_UNITS):
        if start < 0 or start + 3 >= len(data):
            return
        yield data[start + 3 : start + 3 + _UNIT_BYTES]
        start = data.find(b"\0\0\1", start + 3)


class FrameNumbers:
    """Finds frames that are missing in an H.264 video: its decoder would make up a picture in their place."""

    def __init__(self) -> None:
        self._modulus = 0  # of the frame numbers; 0: not known
        self._has_planes = False
        self._expected: int | None = None

    def follows(self, data: bytes) -> bool:
        """Note a frame; whether it is a key frame or continues the one before."""
        for unit in units_of(data):
            kind, is_reference = unit[0] & 31, bool(unit[0] >> 5 & 3)
            if kind == _H264_PARAMETERS:
                self._modulus, self._has_planes = _number_range(_Bits(unit[1:]))
            elif kind in _H264_SLICES and self._modulus:
                bits = _Bits(unit[1:])
                for _ in range(3):  # first macroblock, kind of slice, parameter set
                    bits.exponential()
                bits.number(2 * self._has_planes)
                number = bits.number(self._modulus.bit_length() - 1)
                follows = kind == _H264_KEY or self._expected is None or number == self._expected
                self._expected = (number + is_reference) % self._modulus
                return follows
        return True


def _number_range(bits: _Bits) -> tuple[int, bool]:
    """How many frame numbers a sequence parameter set allows, and whether its colours are planes of their own."""
    profile, has_planes = bits.number(8), False
    bits.number(16)
    bits.exponential()
    if profile in (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135):
        chroma = bits.exponential()
        has_planes = chroma == 3 and bool(bits.number(1))
        bits.exponential()
        bits.exponential()
        bits.number(1)
        if bits.number(1):
            for place in range(12 if chroma == 3 else 8):
                _skip_scaling_list(bits, 16 if place < 6 else 64)
    return 1 << (bits.exponential() + 4), has_planes


def _skip_scaling_list(bits: _Bits, count: int) -> None:
    last = following = 8
    for _ in range(count if bits.number(1) else 0):
        if following:
            coded = bits.exponential()
            following = (last + ((coded + 1) // 2 if coded % 2 else -coded // 2)) % 256
        last = following or last


class _Bits:
    """The bits of a unit, without the bytes that keep start codes out of it; zeros beyond its end."""

    def __init__(self, data: bytes) -> None:
        self._text = "".join(f"{byte:08b}" for byte in data.replace(b"\0\0\3", b"\0\0"))
        self._place = 0

    def number(self, count: int) -> int:
        text = self._text[self._place : self._place + count].ljust(count, "0")
        self._place += count
        return int(text or "0", 2)

    def exponential(self) -> int:
        """An Exp-Golomb number; at most 15 bits, as all numbers here."""
        zeros = min(max(self._text.find("1", self._place) - self._place, 0), 15)
        return self.number(2 * zeros + 1) - 1
