"""The digest of a log distinguishes its content, not its name."""

import pytest

from recordings.containers.digest import SAMPLE_BYTES, log_digest


@pytest.mark.parametrize("place", [0, SAMPLE_BYTES + 10, -1], ids=["beginning", "middle", "end"])
def test_a_changed_beginning_end_or_size_changes_the_digest(tmp_path, place):
    content = bytearray(2 * SAMPLE_BYTES + 20)
    (tmp_path / "a").write_bytes(content)
    (tmp_path / "copy").write_bytes(content)
    content[place] ^= 1
    (tmp_path / "changed").write_bytes(content)
    (tmp_path / "longer").write_bytes(content + b"\0")
    digests = {name: log_digest([tmp_path / name]) for name in ("a", "copy", "changed", "longer")}
    assert digests["a"] == digests["copy"]
    assert (digests["a"] != digests["changed"]) == (place != SAMPLE_BYTES + 10)  # what lies between is not read
    assert digests["longer"] not in (digests["a"], digests["changed"])


def test_the_order_of_files_and_an_empty_file_count(tmp_path):
    one, other, empty = (tmp_path / name for name in ("one", "other", "empty"))
    for path, content in ((one, b"abc"), (other, b"xyz"), (empty, b"")):
        path.write_bytes(content)
    assert len({log_digest(files) for files in ([one, other], [other, one], [one, other, empty], [])}) == 4
