"""Warp functions, structs and kernels: arrays and scalars in, arrays out."""

import warp as wp

# Warp's banner goes to stdout, where a program that prints JSON can have nothing else.
wp.config.log_level = wp.LOG_WARNING
