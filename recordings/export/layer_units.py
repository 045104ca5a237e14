"""Unit and meaning of the layers of maps, for files that state them."""

from __future__ import annotations

_LAYERS = {
    "elevation": ("m", "mean height"),
    "minimum": ("m", "least height"),
    "maximum": ("m", "greatest height"),
    "count": ("", "measured points"),
    "interpolated": ("", "1: may rest on pixels of neighbouring cells only"),
    "variance": ("m^2", "variance of the elevation within a frame"),
    "common_variance": ("m^2", "variance of the elevation from the tilt"),
    "occluded": ("", "1: hidden from the cameras"),
    "ceiling": ("m", "lowest line of sight over an occluded cell"),
    "filled": ("m", "mean height of points that are not measured"),
    "unmatched": ("", "why no pixel was matched: 1 dark, 2 burnt out, 3 bare (textureless), 4 other"),
    "ground": ("m", "height of the ground below obstacles"),
    "step": ("m", "height of an obstacle or depth of a pit"),
    "slope": ("rad", "slope of the ground below the footprint"),
    "steepness": ("rad", "slope below a wheel"),
    "roughness": ("m", "RMS of heights off their plane"),
    "support": ("", "share of known cells within a wheel's diameter"),
    "drop": ("m", "minimum depth of an occluded cell below the ground"),
    "first": ("s", "first time the cell was seen, after the map's epoch"),
    "last": ("s", "last time the cell was seen, after the map's epoch"),
    "frames": ("", "frames that saw the cell"),
    "logs": ("", "logs that saw the cell"),
    "best_log": ("", "number of the log with the smallest variance, as in merge.json"),
    "disagreement": ("m", "largest difference of two logs' heights"),
    "conflicts": ("", "pairs of logs whose heights differ by more than 3 sigma"),
    "contradictions": ("", "frames that contradicted the height"),
}  # fmt: skip


def unit_and_meaning(layer: str) -> tuple[str, str]:
    """Unit (UDUNITS) and meaning of a layer; empty where they are not known."""
    return _LAYERS.get(layer, ("", ""))
