"""The settings of a rerun recording in a pipeline file."""

from __future__ import annotations

from dataclasses import dataclass

from flow.parameters import Checked, parameter
from recordings.sinks import DESKS

MIN_WIDTH = 8  # px, of a picture


@dataclass(eq=False)
class RecordingSettings(Checked):
    """What a recording draws, how large, and how the viewer shows it."""

    application_id: str = parameter("roverflow", "recordings of one application share the layout that the viewer saves")
    max_points: int = parameter(8_000, "most points drawn of a cloud", low=1)
    max_width: int = parameter(
        0, "widest picture; an intermediate has three eighths of it. 0: half as wide as the camera's images, but 320 "
        "to 640 px, and intermediates 120 to 240 px",
        low=0, unit="px",
    )  # fmt: skip
    jpeg_quality: int = parameter(75, "of the camera images", low=1, high=100)
    every: int = parameter(1, "images, clouds and surfaces of each n-th frame are drawn", low=1)
    max_megabytes: int = parameter(
        0, "room of the recording before its compression; 0: no limit. Images, clouds and surfaces are drawn half as "
        "often each time that half of the remaining room is used",
        low=0, unit="MB",
    )  # fmt: skip
    live_pipe: int = parameter(
        0, "file descriptor of a pipe to a viewer, which gets the recording while it is written; 0: none", low=0
    )
    without: tuple[str, ...] = parameter((), "streams that are not drawn, as names or patterns such as disparity/*")
    limits: tuple[str, ...] = parameter(
        (),
        "limits of layers, as elevation_map/step=0.17, which their scales show; `run` sets those of the hazard rule",
    )
    desk: str = parameter("overview", "layout that the viewer opens with", choices=DESKS)

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.max_width < MIN_WIDTH:
            raise ValueError(
                f"{type(self).__name__}.max_width must be 0 or at least {MIN_WIDTH} px, not {self.max_width} px"
            )
