"""Tests of stages are collected only if the libraries that read stages are installed."""

from importlib.util import find_spec

_OF_MATERIALX = ["test_materialx.py", "test_surface_models.py"]
_NAMES = "picture_detail skinning stage_curves stage_frames unfit_attributes usd_scene changed_stages"
_OF_STAGES = [f"test_{name}.py" for name in _NAMES.split()]
_NEEDED_BY = {"pxr": _OF_STAGES + _OF_MATERIALX, "MaterialX": _OF_MATERIALX}
collect_ignore = [name for library, names in _NEEDED_BY.items() if find_spec(library) is None for name in names]
