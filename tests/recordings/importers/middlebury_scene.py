"""A small Middlebury scene: an asymmetric pattern in front of a plane, with values exact in float32."""

from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, NDISP, DOFFS = 96, 64, 21, 12.5
FOCAL, BASELINE = 100.0, 250.0  # px, mm
BACK, FRONT = 5, 13  # px, disparities of the plane and of a box before it


def write_pfm(path: Path, pixels: np.ndarray, order: str = "<") -> Path:
    """pixels (H, W) as a PFM file, little-endian ("<") or big-endian (">")."""
    scale = b"-0.003922" if order == "<" else b"1"
    header = b"Pf\n%d %d\n%s\n" % (pixels.shape[1], pixels.shape[0], scale)
    path.write_bytes(header + pixels[::-1].astype(f"{order}f4").tobytes())
    return path


def true_disparity() -> np.ndarray:
    """(H, W) float32, inf = unknown: the box is off the middle, a corner is unknown."""
    truth = np.full((HEIGHT, WIDTH), BACK, np.float32)
    truth[10:40, 40:70] = FRONT
    truth[:4, :7] = np.inf
    return truth


def occlusion() -> np.ndarray:
    """(H, W) uint8: the right camera cannot see a strip left of the box."""
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[10:40, 40 - (FRONT - BACK) : 40] = 128
    mask[:, :BACK] = 128  # beyond the right image's edge
    mask[:4, :7] = 0
    return mask


def images() -> tuple[np.ndarray, np.ndarray]:
    """The left and the right image (H, W, 3) RGB; the right one follows from the left by the true disparities."""
    rng = np.random.default_rng(7)
    shown = np.where(np.isfinite(true_disparity()), true_disparity(), BACK).astype(int)
    left = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8), (3, 3), 0)
    right = rng.integers(0, 256, left.shape, np.uint8)
    for disparity in (BACK, FRONT):  # the nearer one last
        rows, columns = np.nonzero(shown == disparity)
        inside = columns >= disparity
        right[rows[inside], columns[inside] - disparity] = left[rows[inside], columns[inside]]
    return left, right


def calibration(**changes: object) -> str:
    """calib.txt, with values changed, or left out where None."""
    values = {
        "cam0": f"[{FOCAL:g} 0 40.25; 0 {FOCAL:g} 30; 0 0 1]",
        "cam1": f"[{FOCAL:g} 0 {40.25 + DOFFS:g}; 0 {FOCAL:g} 30; 0 0 1]", "doffs": f"{DOFFS:g}",
        "baseline": f"{BASELINE:g}", "width": WIDTH, "height": HEIGHT, "ndisp": NDISP, "isint": 0, **changes,
    }  # fmt: skip
    return "".join(f"{name}={value}\n" for name, value in values.items() if value is not None)


def write_scene(folder: Path, without: tuple[str, ...] = ()) -> Path:
    """The scene's folder, `without` some of its files."""
    folder.mkdir(parents=True)
    for name, pixels in zip(("im0.png", "im1.png"), images(), strict=True):
        assert cv2.imwrite(str(folder / name), pixels[:, :, ::-1])
    (folder / "calib.txt").write_text(calibration())
    write_pfm(folder / "disp0GT.pfm", true_disparity())
    assert cv2.imwrite(str(folder / "mask0nocc.png"), occlusion())
    for name in without:
        (folder / name).unlink()
    return folder
