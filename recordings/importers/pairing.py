"""Finds the pairs among the image files of a folder, by the words and letters for left and right in their names."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from flow.contracts import counted
from recordings.containers.finding import natural
from recordings.discovery import images
from recordings.errors import LogError

SUFFIXES = {".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".tif", ".tiff", ".bmp"}
# Ground truth beside the images of data sets, such as Middlebury's mask0nocc.png.
_TRUTHS = ("mask", "disp", "disparity", "depth", "truth", "gt")
_NOT_CAMERAS = re.compile(f"(^|[^a-z])({'|'.join(_TRUTHS)})([^a-z]|$)", re.IGNORECASE)
# Names that differ only in these words are images of one moment by several cameras.
_CAMERA_WORD = re.compile(r"[-_. ]?(?<![a-z])(front|rear|rect(ified)?|raw|(nav|haz)(cam)?)(?![a-z])", re.IGNORECASE)
_MAX_LISTED = 5  # files in a sentence
_CAMERA = "|".join(f"(?<={word}{dash})" for word in ("cam", "camera", "im", "img", "image") for dash in ("", "_"))
_RIGHT = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "l": "r", "L": "R"}
# As in names of topics, but without bare 0 and 1, which may count images; also single letters in capitals, and several
# words at once: left/L_01.png.
SIDES: tuple[tuple[re.Pattern[str], str | Callable[[re.Match[str]], str]], ...] = (
    *images.SIDES[:-1],
    (re.compile(r"(?<![A-Za-z])L(?![A-Za-z])"), "R"),
    (re.compile(r"left|Left|LEFT|(?<![A-Za-z])[lL](?![A-Za-z])"), lambda found: _RIGHT[found.group()]),
    (re.compile(rf"(?:{_CAMERA})0(?!\d)", re.IGNORECASE), "1"),
    (re.compile(r"(?<=image_)(0?)2(?=/)"), r"\g<1>3"),  # the colour cameras of KITTI
)


def pair_images(folder: Path, notes: list[str]) -> tuple[list[Path], list[Path]]:
    """The left and the right images of a folder and the folders in it, in order; hidden files are ignored.

    Names such as a-left.png and a-right.png, left/1.png and right/1.png, im0.png and im1.png are pairs. Notes say what
    is left out, and whether the pairs may be of several cameras. Raises LogError if there are no pairs, an image has no
    partner, or the pairs are of several cameras.
    """
    if not folder.is_dir():
        raise LogError(f"{folder} is not a folder; give the folder with the left and right images")
    candidates = (f for pattern in ("[!.]*", "[!.]*/[!.]*") for f in folder.glob(pattern))
    files = sorted(
        (f for f in candidates if f.suffix.lower() in SUFFIXES and f.is_file()),
        key=lambda f: natural(f.relative_to(folder).as_posix()),
    )
    named = {file.relative_to(folder).as_posix(): file for file in files}
    names = {name: file for name, file in named.items() if not _NOT_CAMERAS.search(name)}
    if truths := [name for name in named if name not in names]:
        notes.append(
            f"{counted(len(truths), 'image')} left out, as the names contain {'/'.join(_TRUTHS)}, first: {truths[0]}"
        )
    for word, other in SIDES:
        partners = {name: word.sub(other, name) for name in names if word.search(name)}
        pairs = [(one, two) for one, two in partners.items() if two in names]
        if not pairs:
            continue
        paired = {name for pair in pairs for name in pair}
        if len(paired) < 2 * len(pairs):
            raise LogError(f"{folder}: several images may be the partner of {pairs[0][0]}; name them left and right")
        if alone := [name for name in names if name not in paired]:
            more = f" and {len(alone) - _MAX_LISTED} more have" if len(alone) > _MAX_LISTED else " has"
            listed = ", ".join(alone[:_MAX_LISTED])
            raise LogError(f"{folder}: {listed}{more} no partner; add it, or remove the image")
        _check_cameras(folder, [one for one, _ in pairs], word, notes)
        return [names[one] for one, _ in pairs], [names[two] for _, two in pairs]
    raise LogError(f"{folder} contains no image pairs, {_reason(list(named), list(names))}")


def _check_cameras(folder: Path, names: list[str], word: re.Pattern[str], notes: list[str]) -> None:
    """Raise LogError if names of left images are those of several cameras; a note if they may be. word: of the side."""
    folders = dict.fromkeys(parent for name in names if word.search(parent := Path(name).parent.as_posix()))
    if len(folders) > 1:
        raise LogError(
            f"{folder} contains pairs of several cameras ({', '.join(folders)}); give the folder of one camera"
        )
    moments, kinds = dict[str, str](), dict[str, str]()  # name without words for a camera, or without digits -> first
    for name in names:
        stem = name.rpartition(".")[0]
        first = moments.setdefault(_CAMERA_WORD.sub("", stem).strip("-_. "), name)
        if first != name:
            both = f"{first}, {name}"
            raise LogError(f"{folder} contains pairs of several cameras ({both}); give a folder with those of one")
        kinds.setdefault(re.sub(r"[\W\d_]+", " ", word.sub(" ", stem)).strip(), name)
    if len(kinds) > 1:
        some = ", ".join(list(kinds.values())[:2])
        notes.append(f"all pairs are taken as those of one camera, with {len(kinds)} kinds of names, such as {some}")


def _reason(named: list[str], names: list[str]) -> str:
    """Why there are no pairs among names, and the remedy. named: also those of ground truth."""
    if named and not names:
        return f"as the names of all {counted(len(named), 'image')} contain {'/'.join(_TRUTHS)}; rename them"
    by_stem = {name.rpartition(".")[0]: name for name in names}
    for word, other in SIDES:
        for stem, name in by_stem.items():
            if word.search(stem) and (two := by_stem.get(word.sub(other, stem))):
                return f"as {name} and {two} have different endings; convert the images to one format"
    return (
        f"only {counted(len(named), 'image')} in it and its folders (deeper ones are not searched); the two names of a "
        "pair must differ in left/right, l/r or cam0/cam1"
    )
