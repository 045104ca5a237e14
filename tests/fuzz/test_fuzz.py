"""Changed files are read or refused in one sentence, and a reader that fails in another way is found."""

import pytest

from recordings.errors import LogError
from tests.fuzz.isolation import isolated
from tests.fuzz.targets import TARGETS


@pytest.mark.parametrize("name", sorted(TARGETS))
def test_changed_files_are_read_or_refused_in_one_sentence(name, tmp_path):
    seeds = TARGETS[name].seeds(tmp_path)
    faults = {number: isolated(TARGETS[name].case(name, number, seeds, tmp_path)).fault for number in range(3)}
    assert set(faults.values()) == {""}


def raising(error):
    def work():
        raise error

    return work


@pytest.mark.parametrize(("work", "fault"), [
    (raising(LogError("the file is damaged")), ""), (list, ""), (raising(KeyError("stamp")), "KeyError: \"'stamp'\""),
    (lambda: bytearray(600_000_000), "took "), (raising(LogError), "LogError without a sentence"),
], ids=["refusal", "result", "another exception", "much memory", "refusal without a sentence"])  # fmt: skip
def test_only_refusals_and_results_are_no_findings(work, fault):
    found = isolated(work).fault
    assert found.startswith(fault)
    assert bool(found) == bool(fault)
