"""Cameras of benchmarks."""

from __future__ import annotations

from unbake.dataset.camera import Camera


def of_size(camera: Camera, longest: int) -> Camera:
    """The camera with so many pixels along its longer edge."""
    scale = longest / max(camera.width, camera.height)
    return camera.rescaled(round(camera.width * scale), round(camera.height * scale))
