"""Places a map on the Earth: fixes of a satellite receiver beside the poses give its position and heading in UTM.

Map and grid are both metric, so two shifts and a heading transform one to the other; the scale is that of the
projection. Heights stay those of the map.

References
----------
Karney, Transverse Mercator with an accuracy of a few nanometers, 2011 (the series of Krueger); EPSG guidance note 7-2.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recordings.containers.opening import open_recording
from recordings.errors import LogError
from recordings.mcap.file import iter_decoded
from recordings.source.settings import MAX_RATE
from recordings.source.topics import DecodedTopics
from stages.data import Array

FIX = "sensor_msgs/msg/NavSatFix"
SEMI_MAJOR, FLATTENING = 6_378_137.0, 1 / 298.257223563  # of WGS 84
SCALE, FALSE_EASTING, FALSE_NORTHING = 0.9996, 500_000.0, 10_000_000.0
MIN_FIXES, MAX_HEADING_SIGMA = 3, math.radians(2.0)
_UTM = re.compile(r"EPSG:32([67])(0[1-9]|[1-5]\d|60)$", re.IGNORECASE)


@dataclass(frozen=True)
class Georeference:
    """Where a map's frame lies in UTM: (east, north) = scale * rotated (x, y) + (east, north) of its origin.

    epsg: code of the zone; heading: of the frame's x axis from grid east to the left, rad; residual: RMS of the fixes,
    m; sigma: standard deviation of the heading, rad.
    """

    epsg: int
    scale: float
    heading: float
    east: float
    north: float
    residual: float
    sigma: float
    fixes: int

    def matrix(self, resolution: float, left: float, top: float) -> tuple[float, ...]:
        """The GeoTIFF transformation, (16,) row by row, of an image whose upper left corner is at (left, top) m."""
        along, across = self.scale * math.cos(self.heading), self.scale * math.sin(self.heading)
        east, north = (along * left - across * top + self.east, across * left + along * top + self.north)
        step = resolution
        return (along * step, across * step, 0, east, across * step, -along * step, 0, north, *(0.0,) * 7, 1.0)

    def sentence(self, frame_id: str) -> str:
        """What was found, for a terminal."""
        return (
            f"frame '{frame_id}' is placed in EPSG:{self.epsg} by {self.fixes} fixes: residual {self.residual:.2f} m "
            f"RMS, heading {math.degrees(self.heading):.2f} +- {math.degrees(self.sigma):.2f} deg; heights stay local"
        )


def zone_of(crs: str, latitude: float, longitude: float) -> int:
    """The EPSG code of "utm", the zone of a place, or of "EPSG:326nn" and "EPSG:327nn". Raises LogError."""
    if crs.lower() == "utm":
        return (32600 if latitude >= 0 else 32700) + int((longitude + 180) % 360 // 6) + 1
    found = _UTM.match(crs)
    if found is None:
        raise LogError(f"'{crs}' is not a UTM zone; give utm, or EPSG:32601 to EPSG:32660 or EPSG:32701 to EPSG:32760")
    return int(crs[5:])


def to_utm(latitude: Array, longitude: Array, epsg: int) -> Array:
    """(N, 2) east and north, m, of WGS 84 places, deg, in a zone of UTM."""
    n = FLATTENING / (2 - FLATTENING)
    radius = SEMI_MAJOR / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    series = (
        n / 2 - 2 / 3 * n**2 + 5 / 16 * n**3 + 41 / 180 * n**4,
        13 / 48 * n**2 - 3 / 5 * n**3 + 557 / 1440 * n**4,
        61 / 240 * n**3 - 103 / 140 * n**4,
        49561 / 161280 * n**4,
    )
    phi, lam = np.radians(latitude), np.radians(longitude - (6 * (epsg % 100) - 183))
    e = 2 * math.sqrt(n) / (1 + n)
    t = np.sinh(np.arctanh(np.sin(phi)) - e * np.arctanh(e * np.sin(phi)))
    xi, eta = np.arctan2(t, np.cos(lam)), np.arctanh(np.sin(lam) / np.hypot(1, t))
    north, east = xi.copy(), eta.copy()
    for order, weight in enumerate(series, 1):
        north += weight * np.sin(2 * order * xi) * np.cosh(2 * order * eta)
        east += weight * np.cos(2 * order * xi) * np.sinh(2 * order * eta)
    base = FALSE_NORTHING if epsg >= 32700 else 0.0
    return np.column_stack([FALSE_EASTING + SCALE * radius * east, base + SCALE * radius * north])


def georeferences(result: Path, fixes: Sequence[Sequence[Path]], crs: str) -> dict[str, Georeference]:
    """Frame of reference -> its place, by the poses of a result log and the fixes of the first log that has any.

    fixes: logs, each of one or several files. Raises LogError if there are no fixes or poses, or if they leave the
    heading open.
    """
    poses: dict[str, list[tuple[float, ...]]] = {}
    for _, stamp, message in iter_decoded(result, ["/nav/pose"]):
        place = message.pose.pose.position
        poses.setdefault(message.header.frame_id, []).append((stamp, place.x, place.y))
    if not poses:
        raise LogError(f"{result} has no poses; run the log with a pose stream")
    found = next((read for log in fixes if len(read := _fixes(log))), None)
    if found is None:
        named = " or ".join(", ".join(map(str, log)) for log in fixes)
        raise LogError(f"no fixes ({FIX}) are in {named}; give the log that has them with --fixes")
    epsg = zone_of(crs, *found[0, 1:])
    places = to_utm(found[:, 1], found[:, 2], epsg)
    return {name: _fitted(name, np.array(rows), found[:, 0], places, epsg) for name, rows in poses.items()}


def _fixes(log: Sequence[Path]) -> Array:
    """(N, 3) stamp, ns, latitude and longitude, deg, of the first topic of fixes in a log."""
    with open_recording(log) as file:
        topics = DecodedTopics(file, 0, MAX_RATE)
        named = sorted(topic for topic, schema in topics.schemas.items() if schema == FIX)
        return np.array([row for topic in named[:1] for row in _usable(topics, topic)]).reshape(-1, 3)


def _usable(topics: DecodedTopics, topic: str) -> Iterator[tuple[float, float, float]]:
    """The fixes that the receiver calls fixes."""
    for fix in topics.each(topic, lambda message: message):
        if isinstance(fix, LogError) or fix.status.status < 0:
            continue
        if abs(fix.latitude) <= 84 and abs(fix.longitude) <= 180:
            yield fix.header.stamp.sec * 1e9 + fix.header.stamp.nanosec, fix.latitude, fix.longitude


def _fitted(name: str, poses: Array, stamps: Array, places: Array, epsg: int) -> Georeference:
    """The place of a frame by poses (n, 3) of stamp, x and y, and places (m, 2) at stamps, by least squares.

    The antenna counts as above base_link.
    """
    inside = (stamps >= poses[0, 0]) & (stamps <= poses[-1, 0])
    stamps, places = stamps[inside], places[inside]
    if len(stamps) < MIN_FIXES:
        raise LogError(f"only {len(stamps)} fixes are at the time of the poses in '{name}'; {MIN_FIXES} are needed")
    driven = np.column_stack([np.interp(stamps, poses[:, 0], poses[:, axis]) for axis in (1, 2)])
    x, y = (driven - driven.mean(axis=0)).T
    east, north = (places - places.mean(axis=0)).T
    heading = math.atan2(float(x @ north - y @ east), float(x @ east + y @ north))
    distance = (places[:, 0].mean() - FALSE_EASTING) / (SCALE * SEMI_MAJOR)
    scale = SCALE * (1 + distance**2 / 2)
    turn = scale * np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    shift = places.mean(axis=0) - turn @ driven.mean(axis=0)
    off = places - driven @ turn.T - shift
    residual = float(np.sqrt((off**2).sum(axis=1).mean()))
    spread = float(np.sqrt((x**2 + y**2).sum()))
    sigma = residual / math.sqrt(2) / spread if spread else math.inf
    if not sigma <= MAX_HEADING_SIGMA:
        raise LogError(
            f"the fixes do not determine the heading of '{name}': they are {residual:.2f} m off a drive over "
            f"{math.hypot(np.ptp(x), np.ptp(y)):.1f} m; export without --crs, or a longer drive"
        )
    return Georeference(epsg, scale, heading, float(shift[0]), float(shift[1]), residual, sigma, len(stamps))
