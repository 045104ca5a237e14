"""README and docs as the tests read them: links, headings, and blocks of code with their language."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
_FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    line: int
    language: str
    text: str


def blocks(language: str) -> list[Block]:
    """All blocks of a language."""
    found = []
    for page, name in zip(PAGES, NAMES, strict=True):
        text = page.read_text()
        for match in _FENCE.finditer(text):
            if match[2] == language:
                found.append(Block(name, text.count("\n", 0, match.start()) + 1, match[2], match[3]))
    return found


def named(block: Block) -> str | None:
    """The file name in the first line of a block, `# my_module.py`; None where there is none."""
    match = re.match(r"# (\w+\.(?:py|yaml))\n", block.text)
    return match[1] if match else None


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return _FENCE.sub("", page.read_text())


def inline_codes(page: Path) -> Iterator[str]:
    """The pieces of inline code, those that span two lines as one."""
    for match in re.finditer(r"`([^`]+)`", prose(page)):
        yield " ".join(match[1].split())


def links(page: Path) -> Iterator[str]:
    """The targets of links and pictures."""
    yield from (match[1] for match in _LINK.finditer(prose(page)))


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and mkdocs make them."""
    found = set()
    for heading in re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE):
        text = re.sub(r"[^\w\s-]", "", heading.replace("`", "")).strip().lower()
        found.add(re.sub(r"\s", "-", text))
    return found
