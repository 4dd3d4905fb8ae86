"""Render-difference tests: rendering by passes, references, and comparison with them."""
