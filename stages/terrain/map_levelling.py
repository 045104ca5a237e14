"""Where a frame lies in the regional map: a Kalman filter of the errors of the pose and of the map.

Three things measure a frame's height and up: the pose, the tilt, and the overlap with the map. The pose drifts slowly.
The tilt is noisy, and all tilts share an error. The overlap is precise from frame to frame, but its errors add up along
the drive. Each gets the weight of its variance, and the estimated error of the map is taken out by and by.

Height and up are a plane: height at the rover, m, and slopes along x and y of the pose's frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stages.data import Array, Pose

# The state: errors of the pose, errors of the map, both planes, and the error common to all tilts.
POSE, MAP, BIAS = slice(0, 3), slice(3, 6), slice(6, 8)
POSE_UP = slice(1, 3)
MAX_CORRECTION = 0.2  # share of the map's estimated error that one frame takes out; the rest keeps seams small
MAX_SIGMAS = 3.0  # of an innovation; beyond it the pose is worse than stated
# Standard deviations of a plane's numbers, m and rad
MIN_POSE_SIGMA = np.array([0.0, *np.radians([0.03, 0.03])])  # of any pose
MAX_POSE_SIGMA = np.array([1.0, 0.5, 0.5])  # the largest that counts
POSE_NOISE = np.array([0.0005, *np.radians([0.005, 0.005])])  # between two frames
MAP_DRIFT = np.array([0.003, *np.radians([0.03, 0.03])])  # of the overlap, per metre
FRAME_NOISE = np.array([0.003, *np.radians([0.1, 0.1])])  # of a single frame against its pose: stereo, vibration
OVERLAP_NOISE = np.array([0.001, *np.radians([0.02, 0.02])])
POSE_LEAN_DRIFT = np.radians(0.02)  # of a pose of unknown covariance, per metre


@dataclass(frozen=True, eq=False)
class StatedErrors:
    """What is stated about the sensors.

    attitude: rad, roll and pitch of a pose of unknown covariance; height_drift: its height error per metre; tilt_bias:
    rad, the error common to all tilts. All are standard deviations.
    """

    attitude: float
    height_drift: float
    tilt_bias: float


@dataclass(frozen=True, eq=False)
class MapLevelling:
    """The errors so far; every method returns new ones.

    mean: (8,); covariance: (8, 8); position: (3,) m, the last pose; pose_variance: (3,) stated with it.
    """

    mean: Array
    covariance: Array
    position: Array
    pose_variance: Array

    @classmethod
    def begin(cls, pose: Pose, stated: StatedErrors) -> MapLevelling:
        """Before the first frame of a map. Its height is that of the first pose by definition."""
        variance = _stated_variance(pose, stated)
        covariance = np.zeros((8, 8))
        covariance[POSE_UP, POSE_UP] = np.diag(variance[1:])
        covariance[BIAS, BIAS] = stated.tilt_bias**2 * np.eye(2)
        return cls(np.zeros(8), covariance, pose.position, variance)

    def moved(self, pose: Pose, stated: StatedErrors) -> MapLevelling:
        """At the next pose."""
        step = pose.position - self.position
        length, variance = float(np.linalg.norm(step)), _stated_variance(pose, stated)
        if pose.covariance is None:
            noise = np.array([stated.height_drift, POSE_LEAN_DRIFT, POSE_LEAN_DRIFT]) ** 2 * length**2
        else:
            noise = np.maximum(variance - self.pose_variance, 0.0)
        change = np.eye(8)
        change[0, POSE_UP] = change[3, 4:6] = step[:2]  # a lean raises what lies ahead
        covariance = change @ self.covariance @ change.T
        covariance[POSE, POSE] += np.diag(noise + POSE_NOISE**2)
        covariance[MAP, MAP] += np.diag((MAP_DRIFT * length) ** 2)
        return MapLevelling(change @ self.mean, covariance, pose.position, variance)

    def plane(self, up: Array) -> Array:
        """The plane to add to a frame that was levelled by the tilt `up`, (3,) in the pose's frame."""
        return np.asarray(self.mean[POSE] + self.mean[MAP] - _leaning(up))

    def overlapped(self, plane: Array, covariance: Array, up: Array) -> MapLevelling:
        """After the frame's overlap with the map has shown its plane (3,), with a covariance (3, 3)."""
        model = np.zeros((3, 8))
        model[:, POSE] = model[:, MAP] = np.eye(3)
        noise = covariance + np.diag(OVERLAP_NOISE**2)
        return self._measured(plane - self.plane(up), model, noise)

    def tilted(self, up: Array, sigma: float) -> MapLevelling:
        """After the tilt has measured up, with a standard deviation, rad, about each horizontal axis."""
        model = np.zeros((2, 8))
        model[:, POSE_UP] = model[:, BIAS] = np.eye(2)
        return self._measured(up[:2] - self.mean[POSE_UP] - self.mean[BIAS], model, sigma**2 * np.eye(2))

    def placed(self) -> MapLevelling:
        """After the first frame was placed: the map has the opposite of the pose's remaining errors."""
        copy = np.eye(8)
        copy[MAP], copy[MAP, POSE] = 0.0, -np.eye(3)
        covariance = copy @ self.covariance @ copy.T
        covariance[MAP, MAP] += np.diag(FRAME_NOISE**2)
        return replace(self, covariance=covariance)

    def at(self, plane: Array, up: Array) -> MapLevelling:
        """With the pose where a frame with the tilt `up` got the plane (3,), and without other known errors."""
        mean = np.zeros(8)
        mean[POSE] = plane + _leaning(up)
        return replace(self, mean=mean)

    def corrected(self) -> MapLevelling:
        """With a part of the map's estimated error taken out."""
        mean = self.mean.copy()
        mean[MAP] *= 1 - MAX_CORRECTION
        return replace(self, mean=mean)

    def _measured(self, off: Array, model: Array, noise: Array) -> MapLevelling:
        """After a measurement with an innovation (n,); one that is too large for the variances is the pose's error."""
        excess = off**2 - MAX_SIGMAS**2 * np.diag(model @ self.covariance @ model.T + noise)
        covariance = self.covariance.copy()
        covariance[POSE, POSE] += np.diag(model[:, POSE].T @ np.maximum(excess, 0.0))
        gain = np.linalg.solve(model @ covariance @ model.T + noise, model @ covariance).T
        left = np.eye(8) - gain @ model
        covariance = left @ covariance @ left.T + gain @ noise @ gain.T
        return replace(self, mean=self.mean + gain @ off, covariance=covariance)


def _leaning(up: Array) -> Array:
    """The plane that levelling by up (3,) instead of by z has taken out."""
    return np.array([0.0, up[0], up[1]])


def _stated_variance(pose: Pose, stated: StatedErrors) -> Array:
    """Variance (3,) of the pose's height, m^2, and up, rad^2."""
    given = np.full(3, np.nan) if pose.covariance is None else np.diag(pose.covariance)[2:5][[0, 2, 1]]
    unknown = ~(given > 0)
    variance = np.where(unknown, np.array([0.0, stated.attitude, stated.attitude]) ** 2, given)
    return np.clip(variance, MIN_POSE_SIGMA**2, MAX_POSE_SIGMA**2)
