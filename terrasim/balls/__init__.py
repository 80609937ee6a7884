"""Balls: state, step, the ground they need."""
