"""Materials as plain data, by the models of their surfaces."""

from __future__ import annotations

from mitsuba_subdivision.cage import same
from pxr import Usd, UsdShade

from . import surface_models
from .contents import MaterialContents
from .stage_networks import NetworkReader
from .stage_warnings import StageWarnings
from .surface_models import MODELS, left_out


class MaterialReader:
    """Reads materials, each once."""

    def __init__(self, time: Usd.TimeCode, notes: StageWarnings) -> None:
        self._notes = notes
        self._networks = NetworkReader(time, notes)
        self._numbers: dict[str, int | None] = {}
        self.materials: list[MaterialContents] = []  # Of those that are equal, the first

    def bound(self, prim: Usd.Prim) -> int | None:
        """Number of the material bound to a prim; None if there is none or it is not supported."""
        for purpose in (UsdShade.Tokens.full, UsdShade.Tokens.preview):
            material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)[0]
            number = self.number(material) if material else None
            if number is not None:
                return number
        return None

    def number(self, material: UsdShade.Material) -> int | None:
        """Number of a material; None if it is not supported. Materials that differ by their names only have one."""
        path = str(material.GetPath())
        if path not in self._numbers:
            try:
                contents = self._contents(material)
            except (AttributeError, TypeError, ValueError, IndexError, RecursionError):
                what = "materials whose inputs have other types than their model's are ignored"
                self._notes.add(f"{what}, and display colours are used", path)
                contents = None
            self._numbers[path] = None
            if contents is not None:
                known = (n for n, other in enumerate(self.materials) if same(other, contents, frozenset({"name"})))
                self._numbers[path] = next(known, len(self.materials))
                self.materials += [contents] if self._numbers[path] == len(self.materials) else []
        return self._numbers[path]

    def _contents(self, material: UsdShade.Material) -> MaterialContents | None:
        path = material.GetPath()
        surfaces = [surface for context in ("mtlx", "") if (surface := material.ComputeSurfaceSource(context)[0])]
        read = next((inputs for inputs in map(self._networks.surface, surfaces) if inputs is not None), None)
        if read is None:
            kinds = ", ".join(f'"{surface.GetShaderId() or "of files"}"' for surface in surfaces)
            what = f"surface shaders {kinds}" if surfaces else "materials without a surface shader"
            self._notes.add(f"{what} are ignored, and display colours are used; expected {', '.join(MODELS)}", path)
            return None
        if material.ComputeVolumeSource()[0]:
            self._notes.add("volumes of materials are ignored", path)
        model, inputs = read
        names = left_out(model, inputs)
        if names:
            self._notes.add(f"inputs of {model} that Mitsuba's BSDFs lack are ignored", f"{', '.join(names)} of {path}")
        if any(inputs.get(name, 0.0) != 0 for name in ("subsurface", "subsurface_weight")):
            self._notes.add("subsurface scattering is rendered as diffuse reflection of its colour", path)
        return surface_models.material(str(path), model, inputs)
