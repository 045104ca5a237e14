"""Places a map on the Earth: fixes of a satellite receiver beside the poses give its position and heading in UTM.

Map and grid are both metric, so two shifts and a heading transform one to the other; the scale is that of the
projection. Heights stay those of the map.

References
----------
Karney, Transverse Mercator with an accuracy of a few nanometers, 2011 (the series of Krueger); EPSG guidance note 7-2.
"""

from __future__ import annotations

import cmath
import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flow.contracts import counted
from recordings.errors import LogError
from recordings.export.fixes import read_fixes
from recordings.mcap.file import iter_decoded
from recordings.ros2.from_msg import stamp_of
from stages.data import LEVEL_FRAME, Array

SEMI_MAJOR, FLATTENING = 6_378_137.0, 1 / 298.257223563  # of WGS 84
SCALE, FALSE_EASTING, FALSE_NORTHING = 0.9996, 500_000.0, 10_000_000.0
MIN_FIXES, MAX_HEADING_SIGMA = 3, math.radians(2.0)
MAX_APART_S = 0.5  # from a fix to a pose
MAX_STRETCH = 0.1  # of the fixes against the drive
MIRROR_SHARE, MIRROR_RATIO = 0.01, 3.0  # of the residual, to the drive and to the residual of the mirrored drive
ONLY_REGIONAL = "--crs georeferences regional maps only, not those of every frame; leave out --crs"
MAX_LONGITUDE = 9.0  # deg from the central meridian: the zone and those beside it
_UTM = re.compile(r"EPSG:32([67])(0[1-9]|[1-5]\d|60)$", re.IGNORECASE)


@dataclass(frozen=True)
class Georeference:
    """Where a map's frame lies in UTM: (east, north) = scale * rotated (x, y) + (east, north) of its origin.

    epsg: code of the zone; heading: of the frame's x axis from grid east to the left, rad; residual: RMS of the fixes,
    m; sigma: standard deviation of the heading, rad; topic: of the fixes; others: further topics that fit, and how far
    they place the poses from here, m.
    """

    epsg: int
    scale: float
    heading: float
    east: float
    north: float
    residual: float
    sigma: float
    fixes: int
    topic: str
    others: tuple[tuple[str, float], ...] = ()

    def at(self, x: float, y: float) -> tuple[float, float]:
        """East and north of a place in the frame, m."""
        along, across = self.scale * math.cos(self.heading), self.scale * math.sin(self.heading)
        return along * x - across * y + self.east, across * x + along * y + self.north

    def matrix(self, resolution: float, left: float, top: float) -> tuple[float, ...]:
        """The GeoTIFF transformation, (16,) row by row, of an image whose upper left corner is at (left, top) m."""
        along, across = self.scale * math.cos(self.heading), self.scale * math.sin(self.heading)
        (east, north), step = self.at(left, top), resolution
        return (along * step, across * step, 0, east, across * step, -along * step, 0, north, *(0.0,) * 7, 1.0)

    def sentence(self, frame_id: str) -> str:
        """What was found, for a terminal."""
        heading = f"heading {math.degrees(self.heading):.2f} +- {math.degrees(self.sigma):.2f} deg"
        others = "".join(f"; {topic} places it {apart:.2f} m from there" for topic, apart in self.others)
        return (
            f"frame '{frame_id}' is placed in EPSG:{self.epsg} by {self.fixes} fixes: residual {self.residual:.2f} m "
            f"RMS, {heading}, by {self.topic}{others}; heights stay local"
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


def georeferences(
    result: Path, logs: Sequence[Sequence[Path]], crs: str, maps: Collection[str], lost: Counter[str]
) -> dict[str, Georeference]:
    """Frame of reference of a map -> its place, by the poses of a result and the fixes of the first log that has any.

    logs: each of one or several files; maps: topics of the result; lost: counts the reasons why messages were lost or a
    frame has no place. Raises LogError if there are no fixes or poses, or if no frame has a place.
    """
    poses = _poses(result, maps, lost)
    fixes = read_fixes(logs, lost)
    epsg = _zone(crs, poses, fixes)
    tracks = {topic: np.column_stack([own[:, 0], to_utm(own[:, 1], own[:, 2], epsg)]) for topic, own in fixes.items()}
    places, faults = dict[str, Georeference](), dict[str, LogError]()
    for name, own in poses.items():
        try:
            places[name] = _placed(name, own, tracks, epsg)
        except LogError as error:
            faults[name] = error
    if not places:
        raise LogError(f"{'; '.join(map(str, faults.values()))}; export without --crs")
    lost.update(f"the map in '{name}' is not georeferenced: {fault}" for name, fault in faults.items())
    return places


def _poses(result: Path, maps: Collection[str], lost: Counter[str]) -> dict[str, Array]:
    """Frame of reference of a map -> its poses, (n, 3): stamp, ns, x and y. Of all frames if there is no map."""
    rows, mapped = dict[str, list[tuple[float, ...]]](), set[str]()
    for topic, _, message in iter_decoded(result, ["/nav/pose", *maps], lost):
        if topic in maps:
            mapped.add(message.header.frame_id)
            continue
        place = message.pose.pose.position
        rows.setdefault(message.header.frame_id, []).append((stamp_of(message.header), place.x, place.y))
    if not rows:
        raise LogError(f"{result} has no poses; run the log with a pose stream")
    if mapped == {LEVEL_FRAME}:
        raise LogError(ONLY_REGIONAL)
    if mapped and not mapped & rows.keys():
        named = " or ".join(f"'{name}'" for name in sorted(mapped))
        raise LogError(f"{result} has no poses in {named}; export without --crs")
    return {name: np.array(sorted(own)) for name, own in rows.items() if name in (mapped or rows)}


def _zone(crs: str, poses: Mapping[str, Array], fixes: Mapping[str, Array]) -> int:
    """The EPSG code for the median of the fixes during the poses. Raises LogError for a zone far from them."""
    stamps, found = np.concatenate([own[:, 0] for own in poses.values()]), np.concatenate([*fixes.values()])
    during = found[(found[:, 0] >= stamps.min()) & (found[:, 0] <= stamps.max())]
    found = during if len(during) else found
    latitude, longitude = found[np.argsort(found[:, 2])[len(found) // 2], 1:]
    epsg = zone_of(crs, latitude, longitude)
    apart = abs(math.remainder(longitude - (6 * (epsg % 100) - 183), 360))
    if apart > MAX_LONGITUDE:
        raise LogError(
            f"the fixes are {apart:.1f} deg of longitude from the middle of EPSG:{epsg}; at most {MAX_LONGITUDE:g} are "
            f"allowed: give utm, or EPSG:{zone_of('utm', latitude, longitude)}"
        )
    return epsg


def _placed(name: str, poses: Array, tracks: Mapping[str, Array], epsg: int) -> Georeference:
    """The place of a frame by the topic of fixes that leaves its heading the smallest sigma."""
    found, faults = list[Georeference](), list[str]()
    for topic, track in tracks.items():
        try:
            found.append(_fitted(name, poses, topic, track, epsg))
        except LogError as error:
            faults.append(str(error))
    if not found:
        raise LogError("; ".join(faults))
    best, *others = sorted(found, key=lambda place: place.sigma)
    _, *middle = poses.mean(axis=0)
    apart = [math.dist(best.at(*middle), other.at(*middle)) for other in others]
    return replace(best, others=tuple((other.topic, metres) for other, metres in zip(others, apart, strict=True)))


def _fitted(name: str, poses: Array, topic: str, fixes: Array, epsg: int) -> Georeference:
    """The place of a frame by poses (n, 3), stamp, x and y, and fixes (m, 3), stamp, east and north, by least squares.

    The antenna counts as above base_link.
    """
    driven, places = _pairs(poses, fixes)
    if len(driven) < MIN_FIXES:
        of = f"{counted(len(fixes), 'fix', 'fixes')} of {topic} and {counted(len(poses), 'pose')} in '{name}'"
        raise LogError(f"only {len(driven)} of {of} are within {MAX_APART_S:g} s of each other; {MIN_FIXES} are needed")
    x, grid = driven - driven.mean(), places - places.mean()
    distance = (places.mean().real - FALSE_EASTING) / (SCALE * SEMI_MAJOR)
    scale = SCALE * (1 + distance**2 / 2)
    turn, off = _turned(x, grid, scale)
    residual, mirrored, spread = _rms(off), _rms(_turned(x.conj(), grid, scale)[1]), _rms(x)
    sigma = residual / spread / math.sqrt(2 * _independent(off) - 3) if spread else math.inf
    stretch = abs(np.vdot(x, grid)) / (scale * spread**2 * len(x)) if spread else math.inf
    is_mirrored = residual > max(MIRROR_SHARE * spread, MIRROR_RATIO * mirrored)
    if not (sigma <= MAX_HEADING_SIGMA and abs(stretch - 1) <= MAX_STRETCH) or is_mirrored:
        instead = "" if abs(stretch - 1) > MAX_STRETCH else "; a longer drive may"
        if is_mirrored:
            instead = f"; mirrored, they are {mirrored:.2f} m off: is y to the left?"
        raise LogError(
            f"the fixes of {topic} do not determine the heading of '{name}': they span {_extent(grid):.1f} m, and are "
            f"{residual:.2f} m off a drive over {_extent(x):.1f} m{instead}"
        )
    shift = places.mean() - turn * driven.mean()
    heading = cmath.phase(turn)
    return Georeference(epsg, scale, heading, shift.real, shift.imag, residual, sigma, len(driven), topic)


def _pairs(poses: Array, fixes: Array) -> tuple[Array, Array]:
    """x + iy of poses and east + i north of fixes, (k,), at the times of whichever has fewer where both are.

    Between fixes that are close in time a rover moves evenly, but not between poses that are a long halt apart.
    """
    begin, end = max(poses[0, 0], fixes[0, 0]), min(poses[-1, 0], fixes[-1, 0])
    inside = [track[(track[:, 0] >= begin) & (track[:, 0] <= end), 0] for track in (poses, fixes)]
    times = min(inside, key=len)
    for track in (poses, fixes):
        after = np.searchsorted(track[:, 0], times).clip(1, len(track) - 1)
        apart = np.minimum(np.abs(times - track[after - 1, 0]), np.abs(times - track[after, 0]))
        times = times[apart <= MAX_APART_S * 1e9]
    driven, places = (
        np.interp(times, track[:, 0], track[:, 1]) + 1j * np.interp(times, track[:, 0], track[:, 2])
        for track in (poses, fixes)
    )
    return driven, places


def _turned(x: Array, grid: Array, scale: float) -> tuple[complex, Array]:
    """The scaled turn of places about their mean onto those of the grid, and their residuals, (k,) complex."""
    turn = scale * cmath.exp(1j * cmath.phase(np.vdot(x, grid)))
    return turn, grid - turn * x


def _independent(off: Array) -> float:
    """The number of independent ones of (k,) residuals in the order of time, at least 2.

    It is k over the sum of their autocorrelation up to its first zero, on both sides.
    """
    power = np.abs(np.fft.fft(off, 2 * len(off))) ** 2
    sums = np.fft.ifft(power).real[: len(off)]
    first = int(np.argmax(sums <= 0)) or len(off)
    return max(2.0, len(off) / (2 * sums[:first].sum() / sums[0] - 1)) if sums[0] > 0 else len(off)


def _rms(values: Array) -> float:
    return float(np.sqrt((np.abs(values) ** 2).mean()))


def _extent(values: Array) -> float:
    """The diameter of the circle about places, whose mean is 0."""
    return float(2 * np.abs(values).max())
