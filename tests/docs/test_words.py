"""The rule of words (CONTRIBUTING.md) for pages, docstrings, comments, messages and pipeline files."""

import ast
import io
import re
import tokenize
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest

from tests.docs import pages

FORBIDDEN = (
    r"\btold\b", r"\btells?\b", r"\banew\b", r"\bamid\b", r"\bbe it\b", r"\bwherefrom\b", r"\bspeaks? of\b",
    r"\bsays? of\b", r"\b(bears?|borne) out\b", r"\bha(s|ve) it that\b", r"\bof which [^.:;]*\b(is|are)\b",
    r", too(?=[.,;:)]|$)", r"\bas good as any\b", r"\bsuch as have\b",
)  # fmt: skip
RULE = re.compile("|".join(f"(?:{pattern})" for pattern in FORBIDDEN), re.IGNORECASE)


def texts(file: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of the comments and string literals of a Python file."""
    source = file.read_text()
    if any(RULE.search(line[line.index("#") :]) for line in source.splitlines() if "#" in line):  # tokens are slow
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.string
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def lines(file: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of a page or a pipeline file, without the bad examples in CONTRIBUTING."""
    for number, line in enumerate(file.read_text().splitlines(), 1):
        yield number, line.rpartition(" | ")[2] if file.name == "CONTRIBUTING.md" else line


def slips(files: Iterable[Path], read: Callable[[Path], Iterable[tuple[int, str]]]) -> list[str]:
    """Each use of a forbidden pattern: file, line and words."""
    return [
        f"{file.relative_to(pages.ROOT)}:{line}: {match[0]}"
        for file in files
        for line, text in read(file)
        for match in RULE.finditer(text)
    ]


@pytest.mark.parametrize("room", ["flow", "stages", "recordings", "tests"])
def test_docstrings_comments_and_messages_keep_the_rule_of_words(room):
    files = sorted((pages.ROOT / room).rglob("*.py"))
    assert slips([file for file in files if file != Path(__file__)], texts) == []


def test_pages_and_pipeline_files_keep_the_rule_of_words():
    assert slips([*pages.PAGES, *(pages.ROOT / "flow" / "pipelines").rglob("*.yaml")], lines) == []
