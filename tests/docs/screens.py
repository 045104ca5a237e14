"""Draws the pictures of the viewer in docs/: `python -m tests.docs.screens [FOLDER] [NAME ...]`, by default all.

It simulates the logs of `tests.walks`, runs them, and takes screenshots of the viewer without a screen, which needs a
Vulkan driver (Mesa's lavapipe will do).
"""

from __future__ import annotations

import argparse
import os
import socket
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from rerun.experimental import ViewerClient

from recordings.simulator import write_log
from stages.data import Array
from tests.conftest import roverflow
from tests.viewers import viewer
from tests.walks import FAULTS, SIMULATION

MENU = 36  # px, of the viewer's own bar at the top
PANELS = (201, 201, 300)  # px, of its own panels below, at the left and at the right, which desks hide
MAX_WAIT = 300  # s, for a viewer or a picture


class Screen(NamedTuple):
    """A picture: the log it is of, the desk, the share of the timeline, the size of the viewer, px, and a scale."""

    log: str
    desk: str = ""
    at: float = 0.6
    size: tuple[int, int] = (1600, 900)
    part: Sequence[slice] = ()  # rows and columns
    scale: float = 1.0


LEDGER: dict[str, Any] = {"desk": "runtime", "at": 1.0, "size": (1600, 1200), "part": (slice(374), slice(960, None))}
SCREENS = {
    "desk": Screen("sound", "overview"),
    "walk-sign": Screen("sign", "tilt", scale=0.8),
    "walk-late": Screen("late", "tilt", scale=0.8),
    "walk-baseline": Screen("baseline", **LEDGER),
    "walk-lost": Screen("lost", **LEDGER),
    "walk-blotch": Screen("blotch", "matching", scale=0.8),
    "walk-setting": Screen("try", scale=0.8),
    "gallery-rerun": Screen("viewers", size=(1326, 716)),
}


def main(folder: Path, names: Sequence[str]) -> None:
    """Draw the pictures of these names."""
    with tempfile.TemporaryDirectory() as place:
        logs = Path(place)
        write_log(SIMULATION, logs / "sound.mcap")
        for name in names or SCREENS:
            screen = SCREENS[name]
            picture = shot(_files(logs, screen), screen.at, screen.size)[MENU:]
            if screen.log == "viewers":
                below, left, right = PANELS
                picture = picture[:-below, left:-right]
            size = {"fx": screen.scale, "fy": screen.scale}
            picture = cv2.resize(picture[*screen.part], None, **size, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / f"{name}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 85])


def _files(logs: Path, screen: Screen) -> list[Path]:
    """The files that the viewer opens for a screen."""
    sound, out, disparities = logs / "sound.mcap", logs / f"{screen.log}-nav.mcap", ("--set", "disparities=96")
    if screen.log == "try":
        change = ("--set", "disparity/full.uniqueness=60")
        roverflow("try", sound, "--at", 8, *change, "-o", out.with_suffix(".rrd"))
        return [out.with_suffix(".rrd")]
    if screen.log == "viewers":
        roverflow("run", sound, *disparities, "--set", "McapSink.viewers=true", "--end", 6, "--no-rrd", "-o", out)
        return [out]
    log = sound if screen.log == "sound" else FAULTS[screen.log](sound, logs / f"{screen.log}.mcap")
    roverflow("run", log, *disparities, "-o", out)
    roverflow("desk", out.with_suffix(".rrd"))
    return [out.with_suffix(".rrd"), out.with_name(f"{out.stem}-{screen.desk}.rbl")]


def shot(files: Sequence[Path], at: float, size: tuple[int, int]) -> Array:
    """The viewer with these files at a share of the first timeline, BGR, once two pictures are the same."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as home:
        words = ("--headless", "--bind", "127.0.0.1", "--port", port, "--hide-welcome-screen", "--window-size")
        settings = {**os.environ, "HOME": home, "RUST_LOG": "error"}  # no layout that an earlier viewer saved
        with viewer(*words, "{}x{}".format(*size), *files, env=settings):
            client = _connected(port)
            recording = client.get_state().recordings[0]
            line = next(each for each in recording.timelines if each.name == recording.current_timeline)
            stamp = line.start + round(at * (line.end - line.start))
            client.set_time(line.name, timestamp=np.datetime64(stamp, "ns"), play_state="paused")
            before, now, end = b"", b" ", time.monotonic() + MAX_WAIT
            while before != now or client.get_state().loading:
                if time.monotonic() > end:
                    raise TimeoutError(f"the picture of {files[0]} does not come to rest")
                time.sleep(1.0)
                client.save_screenshot(f"{home}/shot.png")
                before, now = now, Path(home, "shot.png").read_bytes()
    return np.asarray(cv2.imdecode(np.frombuffer(now, np.uint8), cv2.IMREAD_COLOR))


def _connected(port: int) -> ViewerClient:
    """A client of the viewer at a port of loopback, once its files are open."""
    end = time.monotonic() + MAX_WAIT
    while time.monotonic() < end:
        time.sleep(0.2)
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            state = client.get_state()
        except Exception:  # rerun does not say which; the viewer is not ready
            continue
        if state.recordings and not state.loading and state.recordings[0].timelines:
            return client
    raise TimeoutError("the viewer opens no recording")


if __name__ == "__main__":
    parser = argparse.ArgumentParser("python -m tests.docs.screens", description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs"), help="of the pictures (docs)")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(SCREENS))
    given = parser.parse_args()
    if unknown := set(given.names) - SCREENS.keys():
        parser.error(f"no picture is called {', '.join(sorted(unknown))}")
    given.folder.mkdir(parents=True, exist_ok=True)
    main(given.folder, given.names)
