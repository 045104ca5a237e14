"""Result logs that also contain the messages of the input."""

from collections import Counter, defaultdict

import pytest

from recordings.mcap.file import iter_decoded
from tests.conftest import SMALL, chunks_of, mcap_rows, rewrite, roverflow


def contents(path):
    """(Topic, encoding, schema) -> its (log time, bytes)."""
    found = defaultdict(list)
    for *channel, log_time, data in mcap_rows(path):
        found[tuple(channel)].append((log_time, data))
    return found


def test_a_result_log_contains_the_input_byte_for_byte_beside_the_results(both, traverse, result):
    found, results = contents(both), contents(result)
    for channel, messages in contents(traverse).items():
        own = [] if channel[0] == "/tf" else results.get(channel, [])  # the tree of the results is another one
        assert not Counter(messages + own) - Counter(found[channel]), channel[0]
        assert len(found[channel]) == len(messages + results.get(channel, [])), channel[0]
    for channel in results.keys() - {known for known in results if known[0] == "/tf"}:
        assert set(results[channel]) <= set(found[channel]), channel[0]
    assert roverflow("diff", both, result) == 0


@pytest.mark.parametrize("left_out", [(), ("/tf",), ("/odometry", "/tf")], ids=" ".join)
def test_input_and_results_have_one_tree_of_frames(traverse, tmp_path, left_out):
    log = rewrite(traverse, tmp_path / "log.mcap", lambda topic, _, data: None if topic in left_out else data)
    given = *SMALL, "--set", "McapSink.viewers=true", "--end", 1
    assert roverflow("run", log, *given, "-o", tmp_path / "out.mcap", "--no-rrd", "--with-inputs") == 0
    parents = defaultdict(set)
    for _, _, message in iter_decoded(tmp_path / "out.mcap", ["/tf", "/tf_static"]):
        for item in message.transforms:
            parents[item.child_frame_id].add(item.header.frame_id)
    assert {frame: names for frame, names in parents.items() if len(names) > 1} == {}
    assert parents.keys() > {"level", "left_camera_optical"}
    assert set().union(*parents.values()) - parents.keys() == {"tf#/"}  # one root
    topics = "/stereo/left/camera_info", "/nav/disparity/depth/camera_info", "/nav/disparity/depth/image_rect"
    cameras = {topic: item.header.frame_id for topic, _, item in iter_decoded(tmp_path / "out.mcap", topics)}
    own = f"nav/{cameras[topics[0]]}"  # rerun refuses two calibrations of one camera
    assert [cameras[topic] for topic in topics[1:]] == [own, own]
    assert own in parents


def test_chunks_with_small_messages_contain_no_images(both):
    topics = [names for _, names in chunks_of(both)]
    assert any("/imu" in topic or "tilt" in topic or "incl" in topic for names in topics for topic in names)
    assert all(len(names) == 1 for names in topics if any("image" in topic for topic in names))


def test_score_and_export_read_its_results(both, traverse, tmp_path):
    assert roverflow("score", both, "--truth", traverse) == 0
    assert roverflow("export", both, tmp_path / "maps") == 0


def test_a_result_with_its_inputs_is_sound_and_explains_itself(both, said):
    assert "damaged" not in said(0, "info", both).out
    assert "limits:" in said(0, "why", both, "--at", "1", "--cell", "2.5,0", "--log", both).out


def test_a_run_refuses_a_result_with_its_inputs(both, tmp_path, refused):
    assert refused("run", both, "-o", tmp_path / "again.mcap").endswith(
        f"{both} contains results; run the log that they were made from, traverse.mcap\n"
    )
