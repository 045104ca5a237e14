"""Maps placed in UTM by fixes, read back by GDAL."""

from collections import Counter

import numpy as np
import pytest
import rasterio
from rasterio.warp import transform

from recordings.errors import LogError
from recordings.export.georeference import georeferences, to_utm, zone_of
from recordings.export.map_files import REGIONAL
from recordings.importers.recording import fix
from recordings.mcap.file import iter_decoded
from recordings.mcap.writer import Ros2Writer
from recordings.ros2 import to_msg
from recordings.scoring.result_log import about_run
from stages.data import ElevationMap, Pose
from tests.conftest import FRAMES, rewrite, roverflow, write_messages

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
    return write_messages(path, fixes_at(stamps, places + np.random.default_rng(1).normal(0, noise, places.shape)))


def fixes_at(stamps, places, topic="/gps/fix"):
    """Fixes at places (n, 2) on the grid."""
    longitudes, latitudes = transform("EPSG:32633", "EPSG:4326", *places.T)
    return degrees(stamps, latitudes, longitudes, topic)


def degrees(stamps, latitudes, longitudes, topic="/gps/fix", status=0):
    """Fixes at latitudes and longitudes, deg."""
    fixes = [fix(int(stamp), "gps", *place, 300.0) for stamp, *place in zip(stamps, latitudes, longitudes, strict=True)]
    for *_, message in fixes:
        message.status.status = status
    return [(stamp, topic, message) for stamp, _, message in fixes]


def write_drive(path, stamps, places, frame_id="odom"):
    """A result of poses at places (n, 2), with a regional map in their frame."""
    layers = {name: np.ones((4, 4), np.float32) for name in ("elevation", "variance", "count")}
    terrain = ElevationMap(int(stamps[0]), layers, 1.0, (0.0, 0.0), frame_id)
    mapped = terrain.stamp, str(REGIONAL.elevation), to_msg.grid_map(terrain)
    return write_messages(path, [*poses_at(stamps, places, frame_id), mapped])


def poses_at(stamps, places, frame_id):
    placed = [
        Pose(int(stamp), np.array([*place, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]), frame_id, "base_link")
        for stamp, place in zip(stamps, places, strict=True)
    ]
    return [(pose.stamp, "/nav/pose", to_msg.odometry(pose)) for pose in placed]


def place_of(drive, log, crs="utm"):
    """The place of the only frame, and what was lost."""
    lost = Counter()
    (found,) = georeferences(drive, [[log]], crs, REGIONAL, lost).values()
    return found, lost


STAMPS = 1_700_000_000_000_000_000 + np.arange(400) * 100_000_000
CURVE = np.column_stack([np.linspace(0, 20, 400), 3 * np.sin(np.linspace(0, 5, 400))])  # m, a drive of 40 s


@pytest.fixture
def drive(tmp_path):
    """A result of 400 poses along a curve of 20 m."""
    return write_drive(tmp_path / "drive.mcap", STAMPS, CURVE)


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


@pytest.mark.parametrize(("name", "why"), [
    ("elevation_map", "--crs georeferences regional maps only, not those of every frame; leave out --crs"),
    ("regional_navigation_map", "--crs georeferences elevation maps, and none in 'odom' is exported; leave out --crs"),
    ("regional_maap", "did you mean 'regional_map'?"),
])  # fmt: skip
def test_a_map_that_has_no_georeference_is_refused(result, tmp_path, refused, capsys, name, why):
    stamps, places = driven(result)
    log = write_fixes(tmp_path / "fixes.mcap", stamps, on_grid(places, scale_at(ORIGIN[0])))
    assert why in refused("export", result, tmp_path / "maps", "--map", name, "--crs", "utm", "--fixes", log)
    assert not (tmp_path / "maps").exists()
    assert roverflow("export", result, tmp_path / "maps", "--map", "regional_map", "--crs", "utm", "--fixes", log) == 0
    assert capsys.readouterr().out.startswith("frame 'odom' is placed in EPSG:32633")


def test_the_stated_errors_are_those_of_the_fixes(result, tmp_path):
    stamps, places = driven(result)
    log = write_fixes(tmp_path / "fixes.mcap", stamps, on_grid(places, scale_at(ORIGIN[0])), 0.005)
    (found,) = georeferences(result, [[log]], "EPSG:32633", REGIONAL, Counter()).values()
    assert 0.001 < found.residual < 0.02
    assert abs(np.degrees(found.heading) - 37) < 4 * np.degrees(found.sigma)


def test_fixes_that_say_too_little_are_refused(result, traverse, tmp_path, refused):
    stamps, places = driven(result)
    noisy = write_fixes(tmp_path / "noisy.mcap", stamps, on_grid(places), 3.0)
    few = write_fixes(tmp_path / "few.mcap", stamps[:2], on_grid(places[:2]))
    for log, sentence in (
        (noisy, "do not determine the heading of 'odom'"),
        (few, "only 2 of 2 fixes"),
        (traverse, "no fixes"),
    ):
        assert sentence in refused("export", result, tmp_path / "maps", "--crs", "utm", "--fixes", log)
        assert not (tmp_path / "maps").exists()
    assert roverflow("export", result, tmp_path / "maps", "--frames", "--crs", "utm") == 2


def walk(size):
    """Errors (400, 2) that drift up to `size` m."""
    steps = np.cumsum(np.random.default_rng(4).normal(size=CURVE.shape), axis=0)
    return size * steps / np.abs(steps).max()


@pytest.mark.parametrize(("places", "sentence"), [
    (np.random.default_rng(1).normal(ORIGIN, 0.02, CURVE.shape), "span 0.2 m, and are 6.17 m off a drive over 21.1 m"),
    (on_grid(2 * CURVE), "span 42.1 m, and are 6.17 m off a drive over 21.1 m"),
    (on_grid(CURVE * [1, -1]), "mirrored, they are 0.0"),
    (on_grid(CURVE) + walk(3.0), "do not determine the heading of 'odom'"),
])  # fmt: skip
def test_fixes_that_contradict_the_drive_are_refused(places, sentence, drive, tmp_path, refused):
    log = write_messages(tmp_path / "fixes.mcap", fixes_at(STAMPS, places))
    assert sentence in refused("export", drive, tmp_path / "maps", "--crs", "utm", "--fixes", log)


def test_errors_that_last_count_once(drive, tmp_path):
    errors = np.random.default_rng(2).normal(0, 0.2, (41, 2))
    lasting = np.column_stack([np.interp(np.arange(400) / 10, np.arange(41), axis) for axis in errors.T])
    places = on_grid(CURVE, scale_at(ORIGIN[0])) + lasting
    often, _ = place_of(drive, write_fixes(tmp_path / "often.mcap", STAMPS, places))
    seldom, _ = place_of(drive, write_fixes(tmp_path / "seldom.mcap", STAMPS[::10], places[::10]))
    assert 0.5 < often.sigma / seldom.sigma < 1.5
    assert abs(often.heading - TURN) < 3 * often.sigma


def test_of_several_receivers_the_one_that_follows_the_poses_is_used(drive, tmp_path, said):
    exact = on_grid(CURVE, scale_at(ORIGIN[0]))
    rows = [
        *degrees(STAMPS, 400 * [np.nan], 400 * [np.nan], "/a/fix", status=-1),
        *fixes_at(STAMPS, on_grid(0 * CURVE), "/base/fix"),
        *fixes_at(STAMPS, exact + np.random.default_rng(1).normal((3, 4), 0.1, CURVE.shape), "/coarse/fix"),
        *fixes_at(STAMPS, exact, "/rover/fix"),
    ]
    log = write_messages(tmp_path / "fixes.mcap", rows)
    printed = said(0, "export", drive, tmp_path / "maps", "--crs", "utm", "--fixes", log).out
    assert "by 400 fixes: residual 0.00 m RMS" in printed
    assert ", by /rover/fix; /coarse/fix places it 4.99 m from there; heights" in printed


def test_halts_between_poses_that_are_far_apart_shift_nothing(tmp_path):
    times, gap = np.arange(0, 100, 0.2), 12.5
    halted = np.floor(times / gap) + np.clip(times / gap % 1 * 5 - 4, 0, 1)  # a halt, and then the way to the next pose
    places = 3 * np.column_stack([halted, np.sin(halted)])
    stamps = STAMPS[0] + (times * 1e9).astype(int)
    sparse = np.flatnonzero(times % gap < 0.1)
    result = write_drive(tmp_path / "sparse.mcap", stamps[sparse], places[sparse])
    found, _ = place_of(result, write_fixes(tmp_path / "fixes.mcap", stamps, on_grid(places, scale_at(ORIGIN[0]))))
    np.testing.assert_allclose(found.at(0, 0), ORIGIN, atol=0.1)
    assert found.residual < 0.05


@pytest.mark.parametrize(("rows", "cause"), [
    (degrees(STAMPS, 400 * [89.0], 400 * [20.0]), "400 of /gps/fix have latitudes beyond 84 deg"),
    (degrees(STAMPS, 400 * [48.0], 400 * [20.0], status=-1), "400 of /gps/fix have status -1, no fix"),
    (degrees(STAMPS, 400 * [0.0], 400 * [0.0]), "400 of /gps/fix have latitude and longitude 0, as of a receiver with"),
    (degrees(STAMPS, 400 * [0.0], 400 * [200.0]), "400 of /gps/fix have no latitude and longitude in range"),
    (degrees(STAMPS + 10**12, 400 * [48.0], 400 * [20.0]),
     "only 0 of 400 fixes of /gps/fix and 400 poses in 'odom' are within 0.5 s of each other; 3 are needed; export"),
])  # fmt: skip
def test_the_cause_is_named_where_no_fix_is_usable(rows, cause, drive, tmp_path, refused):
    log = write_messages(tmp_path / "fixes.mcap", rows)
    assert cause in refused("export", drive, tmp_path / "maps", "--crs", "utm", "--fixes", log)


def test_a_zone_is_that_of_the_fixes_beside_the_poses(drive, tmp_path):
    early = degrees(STAMPS[:1] - 5_000_000_000, [10.0], [-60.0])
    null = degrees(STAMPS[:5] + 1, 5 * [0.0], 5 * [0.0])
    log = tmp_path / "fixes.mcap"
    write_messages(log, [*early, *null, *fixes_at(STAMPS, on_grid(CURVE, scale_at(ORIGIN[0])))])
    found, _ = place_of(drive, log)
    assert (found.epsg, found.fixes) == (32633, 400)
    np.testing.assert_allclose(found.at(0, 0), ORIGIN, atol=0.01)


def test_poses_count_at_their_own_stamps(drive, tmp_path):
    """Not at the log times of a result that was recorded again while it was played."""
    again = rewrite(drive, tmp_path / "again.mcap", time=lambda topic, log_time: log_time + 2_000_000_000)
    found, _ = place_of(again, write_fixes(tmp_path / "fixes.mcap", STAMPS, on_grid(CURVE, scale_at(ORIGIN[0]))))
    np.testing.assert_allclose(found.at(0, 0), ORIGIN, atol=0.01)


def test_a_zone_far_from_the_fixes_is_refused(drive, tmp_path):
    log = write_fixes(tmp_path / "fixes.mcap", STAMPS, on_grid(CURVE))
    assert place_of(drive, log, "EPSG:32632")[0].epsg == 32632
    with pytest.raises(LogError, match=r"from the middle of EPSG:32660.*EPSG:32633"):
        place_of(drive, log, "EPSG:32660")


def test_damaged_results_and_fixes_are_used_with_a_warning(drive, tmp_path, said):
    log = write_fixes(tmp_path / "fixes.mcap", STAMPS, on_grid(CURVE, scale_at(ORIGIN[0])))
    for path in (drive, log):
        (tmp_path / f"cut-{path.name}").write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    undecodable = rewrite(log, tmp_path / "bad.mcap", lambda topic, index, data: data if index % 2 else data[:20])
    for number, (result, fixes, what) in enumerate([
        (tmp_path / "cut-drive.mcap", log, "cut-drive.mcap: the log is truncated"),
        (drive, tmp_path / "cut-fixes.mcap", "cut-fixes.mcap: the log is truncated"),
        (drive, undecodable, "bad.mcap: /gps/fix: "),
    ]):  # fmt: skip
        printed = said(3, "export", result, tmp_path / f"maps-{number}", "--crs", "utm", "--fixes", fixes).out
        assert "is placed in EPSG:32633" in printed
        assert "WARNING: " in printed
        assert what in printed


def test_a_frame_without_fixes_leaves_the_others_their_place(tmp_path, said):
    drives = [write_drive(tmp_path / "a.mcap", STAMPS[:200], CURVE[:200])]
    drives.append(write_drive(tmp_path / "b.mcap", STAMPS[200:], CURVE[200:], "map"))
    rows = [(stamp, topic, message) for path in drives for topic, stamp, message in iter_decoded(path)]
    both = write_messages(tmp_path / "both.mcap", [*rows, *poses_at(STAMPS[-9:] + 10**10, CURVE[-9:], "unmapped")])
    log = write_fixes(tmp_path / "fixes.mcap", STAMPS[:180], on_grid(CURVE[:180], scale_at(ORIGIN[0])))
    printed = said(3, "export", both, tmp_path / "maps", "--crs", "utm", "--fixes", log).out
    assert "frame 'odom' is placed in EPSG:32633 by 180 fixes" in printed
    assert "both.mcap: the map in 'map' is not georeferenced: only 0 of 180 fixes" in printed
    assert "unmapped" not in printed
