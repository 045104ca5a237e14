"""What all stages share: the base class with its check of parameters, saved states, and checks of inputs."""

from __future__ import annotations

import inspect
import pickle
import re
from dataclasses import Field, dataclass, fields
from functools import cache
from typing import Any, Self, get_args, get_type_hints

import numpy as np

from flow.contracts import StageError
from flow.parameters import Checked
from flow.parameters import parameter as parameter
from stages.data import LEVEL_FRAME, Disparity, PixelOrigin, PointCloud, StereoFrame

MAX_CELLS = 4000  # cells, of a map


@dataclass(frozen=True)
class Stage(Checked):
    """Base of the stages: a frozen dataclass whose fields are its parameters and whose `__call__` is the work.

    The docstring of a subclass gets a section Parameters, made from all fields, for `help()`.
    """

    def __new__(cls, *given: Any, **named: Any) -> Self:
        """Raises StageError where an input of the work is given instead of parameters."""
        inputs = [type(item).__name__ for item in (*given, *named.values()) if hasattr(item, "stamp")]
        if any(name not in str([known.type for known in fields(cls)]) for name in inputs):
            _, *ports = inspect.signature(cls.__call__).parameters.values()
            needed = [port for port in ports if port.default is port.empty]
            call = ", ".join(f"{port.name}=" * (port.kind is port.KEYWORD_ONLY) + port.name for port in needed)
            raise StageError(f"{cls.__name__} takes parameters; use {cls.__name__}()({call})")
        return super().__new__(cls)

    def __init_subclass__(cls) -> None:
        known = {**getattr(cls, "__dataclass_fields__", {}), **vars(cls)}  # inherited ones first
        about = {name: item.metadata for name, item in known.items() if _is_parameter(item)}
        rows = [f"{name}{' : ' * bool(of['unit'])}{of['unit']}\n    {of['help']}" for name, of in about.items()]
        if cls.__doc__ and rows and "Parameters\n---" not in cls.__doc__:
            sections = re.split(r"\n\n(?=\w+\n---)", inspect.cleandoc(cls.__doc__))
            cls.__doc__ = "\n\n".join([sections[0], "\n".join(["Parameters", "----------", *rows]), *sections[1:]])


def _is_parameter(item: Any) -> bool:
    return isinstance(item, Field) and "help" in item.metadata


def snapshot(stage: Any, state: Any) -> bytes:
    """The state of a stage in the middle of a run, as bytes from which `restore` continues in the same version."""
    return pickle.dumps((type(stage).__qualname__, state))


def restore(stage: Any, saved: bytes) -> Any:
    """The state that `snapshot` saved for a stage of this class with the same parameters.

    The bytes are a pickle: never restore any from an untrusted source. Raises ValueError for those of another class.
    """
    name, state = pickle.loads(saved)
    if name != type(stage).__qualname__:
        raise ValueError(f"a snapshot of {name} is not one of {type(stage).__qualname__}; restore each into its own")
    return state


def check_cells(what: str, width: float, resolution: float, times: int = 1) -> None:
    """Raise ValueError for a map with a side of more than MAX_CELLS cells.

    The side is `times` the width, m, of the parameter `what`.
    """
    cells = times * width / resolution
    if cells > MAX_CELLS:
        raise ValueError(
            f"{what} = {width:g} m makes a map {cells:.0f} cells of {resolution:g} m wide; the limit is "
            f"{MAX_CELLS}; take larger cells or a smaller map"
        )


_types = cache(get_type_hints)  # of the inputs of a stage


def check_types(stage: Stage, **inputs: Any) -> None:
    """Raise StageError for an input that is not of the type that `__call__` names, such as a bare array."""
    # A class made from a stage may have other inputs.
    kinds = _types(next(vars(own)["__call__"] for own in reversed(type(stage).__mro__) if "__call__" in vars(own)))
    for port, item in inputs.items():
        if not isinstance(item, kinds[port]):
            wanted = next(iter(get_args(kinds[port])), kinds[port]).__name__
            name = type(stage).__name__
            raise StageError(f"{name}: the {port} must be a stages.{wanted}, not a {type(item).__name__}")


def check_rectified(stage: Stage, frame: StereoFrame) -> None:
    """Raise StageError for a frame that is not rectified, or is none, as a single image."""
    check_types(stage, frame=frame)
    if frame.camera.raw is not None:
        name = type(stage).__name__
        raise StageError(f"{name}: the frame is not rectified; put stages.Rectify before stages.{name}")


def check_level(stage: Stage, cloud: PointCloud) -> None:
    """Raise StageError for a cloud that is not in frame `level`."""
    check_types(stage, cloud=cloud)
    if cloud.frame_id != LEVEL_FRAME:
        name = type(stage).__name__
        raise StageError(
            f"{name}: the cloud is in frame '{cloud.frame_id}', not '{LEVEL_FRAME}'; put stages.Level before it"
        )


def check_joined(stage: Stage, frame: StereoFrame, disparity: Disparity) -> None:
    """Raise StageError for a frame that is not rectified, or a disparity of another size."""
    check_rectified(stage, frame)
    check_types(stage, disparity=disparity)
    if disparity.pixels.shape != frame.left.shape[:2]:
        raise StageError(
            f"{type(stage).__name__}: the disparity is {disparity.pixels.shape}, the left image "
            f"{frame.left.shape[:2]}; join the disparity with the rectified frame it was made from"
        )


def check_confidence(stage: Stage, disparity: Disparity) -> None:
    """Raise StageError if a matched disparity has no confidence, as those that a result log contains."""
    if np.isnan(disparity.confidence.max(initial=0)):  # quick: NaN passes on
        matched = disparity.confidence[disparity.source == PixelOrigin.MEASURED]
        if np.isnan(matched).any():
            raise StageError(
                f"{type(stage).__name__}: the confidence of matched pixels is NaN; a result log does not keep it: give "
                "the disparity one by dataclasses.replace(disparity, confidence=...)"
            )


def check_same_time(stage: Stage, **stamps: int) -> None:
    """Raise StageError for inputs with different stamps. stamps: by the name of the port."""
    if len(set(stamps.values())) > 1:
        found = ", ".join(f"{name} of {stamp} ns" for name, stamp in stamps.items())
        raise StageError(f"{type(stage).__name__}: {found}: join data that were made from one frame")
