"""Where heights come from without a store: formulas, noise, arrays, and sources made of sources."""
