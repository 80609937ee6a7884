"""The detail grid: differences to the ground on posts a whole number of times closer."""
