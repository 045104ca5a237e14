import cv2
import numpy as np
from stages.data import Array
class Match: pass


def eight_bit(*images: Array) -> tuple[Array, ...]:
    """uint8 copies of images of one exposure; 16-bit ones are stretched jointly, 0.1th to 99.9th percentile."""
    if all(image.dtype == np.uint8 for image in images):
        return images
    low, high = np.percentile(np.concatenate([image.ravel() for image in images]), (0.1, 99.9))
    scale = 255 / max(high - low, 1.0)
    return tuple(np.clip((image - low) * scale + 0.5, 0, 255).astype(np.uint8) for image in images)


def gray(image: Array) -> Array:
    """A gray or RGB uint8 image as gray (H, W) uint8."""
    luma: Array = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return luma
