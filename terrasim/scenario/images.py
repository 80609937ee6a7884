"""The images that a scenario's stamps are made of: named in its file, read when it is run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
from pydantic import Field

from terrasim.deform.shapes.height_image import HeightImage
from terrasim.errors import InputError
from terrasim.scenario.settings import Settings


class ImageFile(Settings):
    """An image file whose samples are heights."""

    path: str = Field(min_length=1)
    """PNG, TIFF, OpenEXR, or an array in NumPy's format; relative to the scenario's folder."""
    channel: int | None = Field(default=None, ge=1)
    """Channel that holds the heights, from 1; images with several beside alpha need it."""
    alpha: bool = True
    """Whether the image's alpha channel, if it has one, is the samples' weight."""

    def read(self, folder: Path) -> HeightImage:
        """Read it.

        Raises:
            InputError: If it cannot be read as heights.
        """
        try:
            return HeightImage.load(folder / self.path, channel=self.channel, alpha=self.alpha)
        except InputError as error:
            raise InputError(f"texture: image {error}") from None


Images = Mapping[ImageFile, HeightImage]
"""What was read from each file."""


class _Blank(Images):
    """An image for every file, all zero: enough to check the rest of a stamp."""

    def __getitem__(self, _: ImageFile) -> HeightImage:
        return HeightImage(np.zeros((2, 2)))

    def __iter__(self) -> Iterator[ImageFile]:
        return iter(())

    def __len__(self) -> int:
        return 0


BLANK = _Blank()
"""Stands for files that have not been read."""


def read_images(files: Iterable[ImageFile], folder: Path) -> Images:
    """Read image files, each once.

    Args:
        files: The files.
        folder: What their paths are relative to.

    Raises:
        InputError: If one cannot be read as heights.
    """
    return {one: one.read(folder) for one in dict.fromkeys(files)}
