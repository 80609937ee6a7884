"""From a scenario file to a plan, a run and its record."""
