"""The scenes of the simulator: named defaults of the parameters that make images easy or hard to match.

mixed: sand, gravel, dust and bedrock side by side; gravel: rich texture, high sun; dunes: rippled sand, few rocks;
dusk: low sun, hard shadows, dark and noisy; bedrock: slabs with cracks, dust between them.
"""

from __future__ import annotations

from math import radians

SCENES = ("gravel", "mixed", "dunes", "dusk", "bedrock")
DEFAULT_SCENE = "mixed"

# Field of Simulation -> its default in each of SCENES.
_TABLE: dict[str, tuple[float, ...]] = {
    "sand": (0.0, 0.45, 0.94, 0.45, 0.05),
    "dust": (0.0, 0.10, 0.03, 0.10, 0.25),
    "bedrock": (0.0, 0.15, 0.0, 0.10, 0.60),
    "sand_contrast": (2.0, 2.0, 2.0, 2.0, 2.0),
    "gravel_contrast": (18.0, 12.0, 12.0, 12.0, 12.0),
    "ripples": (1.0, 1.0, 3.0, 1.0, 1.0),
    "abundance": (0.10, 0.10, 0.015, 0.10, 0.05),
    "sun_elevation": (radians(38), radians(38), radians(30), radians(6), radians(45)),
    "skylight": (0.24, 0.24, 0.24, 0.10, 0.24),
    "brightness": (1.0, 1.0, 1.0, 0.75, 1.0),
    "noise": (1.36385252, 1.5, 1.5, 3.0, 1.5),
}


def defaults_of(scene: str) -> dict[str, float]:
    """Field of Simulation -> its default in a scene."""
    return {name: values[SCENES.index(scene)] for name, values in _TABLE.items()}
