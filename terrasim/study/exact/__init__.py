"""Motions that are known in closed form, shared by studies and tests."""
