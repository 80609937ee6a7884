"""Stamps and what they do to the ground."""
