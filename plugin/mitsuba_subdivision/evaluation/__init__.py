"""Exact evaluation: local subdivision matrices, eigenbases, evaluators and limit stencils."""
