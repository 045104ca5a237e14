"""README and docs: links resolve, commands parse, pipelines load, generated pages are current."""

import argparse
import contextlib
import functools
import importlib
import re
import shlex
from pathlib import Path

import pytest
import yaml

from flow.cli.main import parser
from flow.config.loader import load
from tests.docs import generated, pages

PARTS = {"source", "streams", "sinks"}
COMPLETE = [block for block in pages.blocks("yaml") if (yaml.safe_load(block.text) or {}).keys() >= PARTS]


@pytest.mark.parametrize("name", pages.NAMES)
def test_relative_links_and_anchors_resolve(name):
    page = pages.ROOT / name
    for link in pages.links(page):
        if re.match(r"\w+://|mailto:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{name} links to {link}"
        if anchor:
            assert anchor in pages.anchors(target), f"{name} links to {link}; anchors: {sorted(pages.anchors(target))}"


def command_lines():
    for block in pages.blocks("sh"):
        for line in block.text.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["roverflow"]:
                yield pytest.param(words[1:], id=f"{block.page}:{' '.join(words[:3])}")


@pytest.mark.parametrize("words", list(command_lines()))
def test_command_lines_parse(words):
    parser().parse_args(words[: words.index(">")] if ">" in words else words)


def commands(among, path=()):
    """Command -> its options, those of `import images` under "import"."""
    for action in among._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                yield from commands(command, (*path, name))
    yield (path[:1] or ("",))[0], {option for action in among._actions for option in action.option_strings}


@pytest.mark.parametrize("name", pages.NAMES)
def test_inline_commands_and_their_options_exist(name):
    options: dict[str, set[str]] = {}
    for command, names in commands(parser()):
        options.setdefault(command, set()).update(names)
    for code in pages.inline_codes(pages.ROOT / name):
        words = code.split()
        if words[0] == "roverflow" and len(words) > 1 and words[1][0].islower():
            assert words[1] in options, f"{name}: {code}"
        words = words[words[0] == "roverflow" :]
        if words and words[0] in options:
            unknown = {word.partition("=")[0] for word in words if word.startswith("--")} - options[words[0]]
            assert not unknown, f"{name}: {code}: no {unknown}"


@pytest.mark.parametrize("block", COMPLETE, ids=lambda block: f"{block.page}:{block.line}")
def test_complete_pipelines_load(block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for module in pages.blocks("python"):
        if pages.named(module):
            Path(pages.named(module)).write_text(module.text)
    file = tmp_path / "shown.yaml"
    file.write_text(block.text)
    assert load(str(file)).nodes


@pytest.mark.parametrize("name", generated.pages())
def test_generated_pages_are_current(name):
    assert (generated.DOCS / name).read_text() == generated.pages()[name], "run: python -m tests.docs.generated"


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r"[\w-]+\.md", (pages.ROOT / "mkdocs.yml").read_text()))
    assert listed == {page.name for page in (pages.ROOT / "docs").glob("*.md")}


def test_readme_fits_a_page_and_shows_the_two_commands_first():
    lines = (pages.ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 170
    first_screen = "\n".join(lines[:25])
    assert "docs/desk.jpg" in first_screen
    assert re.search(r"^make demo\b", first_screen, re.MULTILINE)
    assert re.search(r"^make test\b", first_screen, re.MULTILINE)


@pytest.mark.parametrize("name", pages.NAMES)
def test_paths_of_the_project_exist(name):
    rooms = ("flow/", "stages/", "recordings/", "tests/", "docs/")
    found = [code for code in pages.inline_codes(pages.ROOT / name) if code.startswith(rooms) and " " not in code]
    assert [path for path in found if not (pages.ROOT / path).exists()] == []


def dotted(name):
    """Whether a dotted name is a module, or is found in one."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except ImportError:
            continue
        with contextlib.suppress(AttributeError):
            functools.reduce(getattr, parts[cut:], found)
            return True
        return False
    return False


@pytest.mark.parametrize("name", pages.NAMES)
def test_dotted_names_of_the_product_resolve(name):
    text = "" if name == "CHANGELOG.md" else (pages.ROOT / name).read_text()
    found = set(
        re.findall(r"(?:^::: |[`\s{])((?:flow|stages|recordings)(?:\.[A-Za-z]\w*)+)\b(?!/)", text, re.MULTILINE)
    )
    assert sorted(item for item in found if not dotted(item)) == []
