"""Patches: every element of a cage grouped by the shape of its neighbourhood, and evaluation anywhere on them."""
