"""Without the libraries that read stages, their tests are not collected."""

from importlib.util import find_spec

_OF_MATERIALX = ["test_materialx.py", "test_surface_models.py"]
_NEEDED_BY = {
    "pxr": [
        "test_skinning.py",
        "test_stage_frames.py",
        "test_unfit_attributes.py",
        "test_usd_scene.py",
        *_OF_MATERIALX,
    ],
    "MaterialX": _OF_MATERIALX,
}
collect_ignore = [name for library, names in _NEEDED_BY.items() if find_spec(library) is None for name in names]
