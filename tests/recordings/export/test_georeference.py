"""Maps placed in UTM by fixes, read back by GDAL."""

import numpy as np
import pytest
import rasterio
from rasterio.warp import transform

from recordings.errors import LogError
from recordings.export.georeference import georeferences, to_utm, zone_of
from recordings.importers.recording import fix
from recordings.mcap.file import iter_decoded
from recordings.mcap.writer import Ros2Writer
from recordings.scoring.result_log import about_run
from tests.conftest import FRAMES, roverflow, write_messages

TURN, ORIGIN = np.radians(37.0), np.array([412_345.6, 5_432_100.7])  # of the map's frame in zone 33


def on_grid(places, scale=1.0):
    """Places (n, 2) of the map's frame in the zone."""
    turn = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
    return scale * places @ turn.T + ORIGIN


def scale_at(east):
    return 0.9996 * (1 + ((east - 500_000) / (0.9996 * 6_378_137)) ** 2 / 2)


def driven(result):
    """Stamps, and x and y of the poses of a result."""
    poses = [(stamp, message.pose.pose.position) for _, stamp, message in iter_decoded(result, ["/nav/pose"])]
    return [stamp for stamp, _ in poses], np.array([(place.x, place.y) for _, place in poses])


def write_fixes(path, stamps, places, noise=0.0):
    """A log of fixes at places on the grid."""
    places = places + np.random.default_rng(1).normal(0, noise, places.shape)
    longitudes, latitudes = transform("EPSG:32633", "EPSG:4326", *places.T)
    fixes = zip(stamps, latitudes, longitudes, strict=True)
    return write_messages(path, [fix(stamp, "gps", *place, 300.0) for stamp, *place in fixes])


@pytest.mark.parametrize(("zone", "latitude", "longitude"), [
    (32633, 52.0, 15.0), (32633, 0.0, 12.1), (32633, 83.9, 17.9), (32733, -33.0, 16.0), (32601, 10.0, -179.5),
    (32660, 64.0, 179.0), (32631, 52.2, 4.4),
])  # fmt: skip
def test_places_in_utm_are_those_of_proj(zone, latitude, longitude):
    expected = transform("EPSG:4326", f"EPSG:{zone}", [longitude], [latitude])
    found = to_utm(np.array([latitude]), np.array([longitude]), zone)
    np.testing.assert_allclose(found, np.transpose(expected), atol=1e-3)
    assert zone_of("utm", latitude, longitude) == zone
    assert zone_of(f"epsg:{zone}", 0, 0) == zone


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32661", "EPSG:32600", "33N", ""])
def test_another_crs_is_refused(crs):
    with pytest.raises(LogError, match="not a UTM zone"):
        zone_of(crs, 0, 0)


def test_a_map_is_placed_to_a_centimetre(result, tmp_path, capsys):
    stamps, places = driven(result)
    scale = scale_at(ORIGIN[0])
    log = write_fixes(tmp_path / "fixes.mcap", stamps, on_grid(places, scale))
    out = tmp_path / "maps", tmp_path / "placed"
    assert roverflow("export", result, out[0]) == 0
    assert roverflow("export", result, out[1], "--crs", "utm", "--fixes", log) == 0
    assert f"EPSG:32633 by {FRAMES} fixes: residual 0.00 m RMS, heading 37.0" in capsys.readouterr().out
    with rasterio.open(out[0] / "elevation.tif") as local, rasterio.open(out[1] / "elevation.tif") as placed:
        assert placed.crs.to_epsg() == 32633
        np.testing.assert_array_equal(local.read(1), placed.read(1))
        for row, column in ((0, 0), (0, local.width), (local.height, 0), (local.height, local.width)):
            expected = on_grid(np.array([local.xy(row, column, offset="ul")]), scale)
            np.testing.assert_allclose([placed.xy(row, column, offset="ul")], expected, atol=0.01)
        centre = placed.xy(0, 0)
    lines = [float(line) for line in (out[1] / "hillshade.pgw").read_text().split()]
    np.testing.assert_allclose(lines[4:], centre, atol=1e-6)


def test_the_fixes_of_all_files_of_an_input_count(result, tmp_path, said):
    out, (stamps, places) = tmp_path / "out.mcap", driven(result)
    about = {**about_run(result), "log": "a.mcap, b.mcap"}
    with Ros2Writer(out) as log:
        log.metadata("roverflow", about)
        for topic, stamp, message in iter_decoded(result, ["/nav/pose", "/nav/regional_map", "/tf"]):
            log.write(topic, message, stamp)
    for name, part in (("a", slice(0, 1)), ("b", slice(1, None))):
        write_fixes(tmp_path / f"{name}.mcap", stamps[part], on_grid(places[part], scale_at(ORIGIN[0])))
    for number, fixes in enumerate([(), ("--fixes", tmp_path / "b.mcap", "--fixes", tmp_path / "a.mcap")]):
        printed = said(0, "export", out, tmp_path / f"maps-{number}", "--crs", "utm", *fixes).out
        assert f"by {FRAMES} fixes: residual 0.00 m RMS" in printed


def test_the_stated_errors_are_those_of_the_fixes(result, tmp_path):
    stamps, places = driven(result)
    log = write_fixes(tmp_path / "fixes.mcap", stamps, on_grid(places, scale_at(ORIGIN[0])), 0.005)
    (found,) = georeferences(result, [[log]], "EPSG:32633").values()
    assert 0.001 < found.residual < 0.02
    assert abs(np.degrees(found.heading) - 37) < 4 * np.degrees(found.sigma)


def test_fixes_that_say_too_little_are_refused(result, traverse, tmp_path, refused):
    stamps, places = driven(result)
    noisy = write_fixes(tmp_path / "noisy.mcap", stamps, on_grid(places), 3.0)
    few = write_fixes(tmp_path / "few.mcap", stamps[:2], on_grid(places[:2]))
    for log, sentence in (
        (noisy, "do not determine the heading of 'odom'"),
        (few, "only 2 fixes"),
        (traverse, "no fixes"),
    ):
        assert sentence in refused("export", result, tmp_path / "maps", "--crs", "utm", "--fixes", log)
        assert not (tmp_path / "maps").exists()
    assert roverflow("export", result, tmp_path / "maps", "--frames", "--crs", "utm") == 2
