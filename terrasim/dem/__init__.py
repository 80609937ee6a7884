"""Reading files of heights: rasters, images, arrays; several files as one terrain."""
