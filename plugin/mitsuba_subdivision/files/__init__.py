"""Readers and writers of files: OBJ, PLY and USD."""
