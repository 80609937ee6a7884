"""Other engines, run beside this one on the same ground."""
