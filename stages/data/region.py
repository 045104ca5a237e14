"""The fused cells of a run: what `FuseRegion` makes of each frame, and `MapRegion` turns into maps."""

from __future__ import annotations

from dataclasses import dataclass

from stages.data.arrays import check_resolution, publish_plain
from stages.data.motion import Transform
from stages.data.tiles import Tiles


@dataclass(frozen=True, eq=False)
class Region:
    """All cells that the frames of a run have fused up to `stamp`, in the frame of the pose.

    Parameters
    ----------
    cells : Tiles
        Of `stages.terrain.fused_map.CELL`. Cell (0, 0) begins at (0, 0). Nothing changes them later.
    resolution : float
        Cell size, m.
    level : Transform
        Frame `level` of that stamp in the region's frame.
    epoch : int
        Stamp, ns, of the first frame: regions of another epoch or frame do not continue each other.
    changed : (int, int, int, int)
        First row and column and end row and column of what the frame changed.
    has_ceiling : bool
        Whether the frames contain occluded cells.
    """

    stamp: int
    cells: Tiles
    resolution: float
    level: Transform
    epoch: int
    changed: tuple[int, int, int, int]
    has_ceiling: bool

    def __post_init__(self) -> None:
        publish_plain(self)
        check_resolution(self)

    @property
    def frame_id(self) -> str:
        """The frame of the pose."""
        return self.level.parent
