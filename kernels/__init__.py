"""Warp functions, structs and kernels: arrays and scalars in, arrays out."""
