"""Errors against run time: a scenario run under varied settings, each in a process of its own."""
