"""Without the libraries that read stages, their tests are not collected."""

from importlib.util import find_spec

_NEEDED_BY = {
    "pxr": ["test_skinning.py", "test_stage_frames.py", "test_unfit_attributes.py", "test_usd_scene.py"],
    "MaterialX": ["test_materialx.py", "test_surface_models.py"],
}
collect_ignore = [name for library, names in _NEEDED_BY.items() if find_spec(library) is None for name in names]
