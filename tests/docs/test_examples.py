"""The code of README and docs runs as it stands."""

import importlib
import json
import runpy
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from flow.contracts import Severity, StageError
from recordings.simulator import Simulation
from stages import Cell, Disparity, ElevationMap, NavigationMap, PixelOrigin, StereoFrame, Tilt, known
from tests.docs import pages


def save(page, folder):
    """Write the named blocks of a page into a folder."""
    for language in ("python", "yaml"):
        for block in pages.blocks(language):
            if block.page == page and pages.named(block):
                (folder / pages.named(block)).write_text(block.text)


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Writes the blocks of a page and imports a module of it."""

    def write(page, module):
        save(page, tmp_path)
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(sys.modules, module, raising=False)
        return importlib.import_module(module)

    return write


def test_the_stage_of_the_readme_removes_sparse_cells(written):
    stage = written("README.md", "my_module").DropSparse(min_points=5)
    layers = {"elevation": np.ones((1, 2), np.float32), "count": np.array([[4, 5]], np.float32)}
    dense = stage(ElevationMap(0, layers, 0.05, (0.0, 0.0), "level"))
    np.testing.assert_array_equal(dense.layers["elevation"], [[np.nan, 1]])
    np.testing.assert_array_equal(dense.layers["count"], [[4, 5]])


def test_the_mask_of_the_rovers_body_makes_its_pixels_unknown(written, tmp_path):
    module = written("docs/writing-a-stage.md", "body_mask")
    body = np.array([[0, 255]], np.uint8)
    cv2.imwrite(str(tmp_path / "body.png"), body)
    measured = np.full((1, 2), PixelOrigin.MEASURED, np.uint8)
    disparity = Disparity(0, np.full((1, 2), 7, np.float32), measured, np.ones((1, 2), np.float32))
    masked = module.MaskBody(image=str(tmp_path / "body.png"))(disparity)
    np.testing.assert_array_equal(masked.pixels, [[7, np.nan]])
    np.testing.assert_array_equal(known(masked.source), [[True, False]])
    with pytest.raises(StageError, match="cannot be read as an image"):
        module.MaskBody(image="none.png")(disparity)


def test_two_images_become_a_picture_of_the_terrain(tmp_path, monkeypatch, capsys):
    images = Simulation(width=640, height=480, relief_cells=512).frame(0).images
    for name, image in zip(("left", "right"), images, strict=True):
        cv2.imwrite(str(tmp_path / f"{name}.png"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["", "left.png", "right.png", "dem.png"])
    runpy.run_path(str(pages.ROOT / "docs" / "examples" / "two_images_to_dem.py"))
    assert int(capsys.readouterr().out.split()[0]) > 4000
    assert cv2.imread(str(tmp_path / "dem.png")).shape == (240, 240, 3)


def test_the_notebook_finds_a_hazards_pixels(traverse, result, tmp_path, monkeypatch, capsys):
    notebook = json.loads((pages.ROOT / "docs" / "examples" / "debugging.ipynb").read_text())
    assert not any(cell.get("outputs") for cell in notebook["cells"])
    monkeypatch.chdir(tmp_path)
    for name, made in (("drive", traverse), ("traverse", traverse), ("drive-nav", result)):
        (tmp_path / f"{name}.mcap").symlink_to(made)
    shown = list[bytes]()
    stub = SimpleNamespace(Image=lambda data: data, display=shown.append)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(display=stub))
    monkeypatch.setitem(sys.modules, "IPython.display", stub)
    capsys.readouterr()
    names: dict[str, object] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    said = capsys.readouterr().out
    assert "hazard cells at" in said
    assert "HAZARD by" in said
    assert "limit" in said
    assert len(shown) == 3
    assert all(picture.startswith(b"\x89PNG") for picture in shown)


def test_flow_runs_without_a_rover(tmp_path):
    save("docs/flow-without-a-rover.md", tmp_path)
    done = subprocess.run(
        [sys.executable, "run_numbers.py"],
        cwd=tmp_path, env={"PYTHONPATH": str(pages.ROOT)}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout == "COMPLETE 3\n"
    shown = next(block.text for block in pages.blocks("text") if block.page == "docs/flow-without-a-rover.md")
    assert (tmp_path / "numbers.txt").read_text() == shown


def test_a_pipeline_is_evaluated_in_a_notebook():
    simulation = Simulation(width=320, height=240, relief_cells=512)
    camera, rendered = simulation.camera, simulation.frame(0)
    truth = camera.fx * camera.baseline / rendered.depth
    code = next(block.text for block in pages.blocks("python") if "import evaluate" in block.text)
    names: dict[str, Any] = {
        "frame": StereoFrame(7, *rendered.images, camera),
        "tilt": Tilt(7, [0.0, -np.cos(0.26), -np.sin(0.26)], camera.frame_id),
    }
    exec(code, names)
    found = names["streams"]["disparity"]
    measured = found.source == PixelOrigin.MEASURED
    assert np.median(np.abs(found.pixels - truth)[measured] / found.sigma[measured]) < 1
    navigation = names["streams"]["navigation_map"]
    assert navigation.stamp == 7
    assert np.count_nonzero(navigation.cells == Cell.FREE) > 2000


def test_the_stage_with_state_starts_each_run_empty(written):
    stage = written("docs/writing-a-stage.md", "counting").CountHazards(max_hazards=1)
    cells = np.array([[100, 100, 0]], np.int8)
    navigation = NavigationMap(0, cells, np.zeros_like(cells, np.uint8), 0.05, (0.0, 0.0), "level")
    first, second = stage.start(), stage.start()
    assert stage(navigation, state=first) == 2
    assert stage.finding(first).severity == Severity.WARNING
    assert stage.finding(second) is None
