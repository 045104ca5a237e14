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


def _refuses():
    raise LogError("the file is damaged")


def _fails():
    raise KeyError("stamp")


def _fills_the_memory():
    return bytearray(600_000_000)


def _answers():
    return []


@pytest.mark.parametrize(("work", "fault"), [
    (_refuses, ""), (_fails, "KeyError"), (_fills_the_memory, "took"), (_answers, ""),
], ids=["refusal", "another exception", "much memory", "result"])  # fmt: skip
def test_only_refusals_and_results_are_no_findings(work, fault):
    assert isolated(work).fault.partition(":")[0].partition(" ")[0] == fault


def test_a_refusal_without_a_sentence_is_a_finding():
    def refuses():
        raise LogError

    assert isolated(refuses).fault == "LogError without a sentence"
