"""Contents of a USD stage as plain data: numbers, names and arrays, without the USD library or Mitsuba.

Matrices are ``(4, 4)`` float64 for column vectors. Colours are linear, with the primaries of Rec. 709.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from mitsuba_subdivision.cage import CageContents
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mitsuba_subdivision.mitsuba_mesh import CurveSet


@dataclass(frozen=True, eq=False)
class NodeContents:
    """A node of a shading network: what MaterialX computes of its inputs, or a plugin of Mitsuba."""

    category: str  # Such as "multiply", see `materialx_nodes.OPERATIONS`; or the name of a plugin
    type: str  # Of its output: "float", "color3", "vector2" and so on; "mitsuba" for plugins
    # All its inputs except geometric ones. A string is an option. The category "texcoord" has the name of a primvar,
    # and the fallback where a mesh lacks it; without a fallback, others of the mesh serve as well.
    inputs: dict[str, Input]

    @property
    def is_plugin(self) -> bool:
        """Whether it is a plugin of Mitsuba."""
        return self.type == "mitsuba"


@dataclass(frozen=True, eq=False)
class TextureContents:
    """An image that an input of a material reads, ``scale * image + bias``."""

    file: str  # Path; `a.usdz[b.png]` for a file in an archive
    channel: str  # "rgb", "r", "g", "b" or "a"; within a `NodeContents` also "rg" and "rgba"
    color_space: str  # "auto", "raw" or "sRGB"
    wrap: str = "repeat"  # Mitsuba's name: "repeat", "clamp" or "mirror"
    scale: list[float] = field(default_factory=lambda: [1.0] * 4)
    bias: list[float] = field(default_factory=lambda: [0.0] * 4)
    # (3, 3) float64: from texture coordinates to those of the picture, whose v points up
    to_uv: NDArray = field(default_factory=lambda: np.eye(3))
    texcoords: NodeContents = field(default_factory=lambda: NodeContents("texcoord", "vector2", {"name": "st"}))
    fallback: list[float] = field(default_factory=lambda: [0.0] * 4)  # Where there is no such file

    @property
    def channels(self) -> list[int]:
        """Indices of the channel's letters among "rgba"."""
        return ["rgba".index(letter) for letter in self.channel]


@dataclass(frozen=True, eq=False)
class PrimvarContents:
    """An attribute of the mesh that an input of a material reads."""

    name: str
    fallback: list[float]


class MaterialError(ValueError):
    """A material that cannot be read, with the reason."""


Part = TypeVar("Part", "ShapeContents", "LightContents")
Source = TextureContents | PrimvarContents | NodeContents
# A number or a colour, or where it comes from.
Input = float | list[float] | str | Source


def parts(given: Input) -> list[Source]:
    """An input itself, unless it is constant, and all that it depends on, each once."""
    known: dict[int, Source] = {}
    rest = [given]
    while rest:
        part = rest.pop()
        if not isinstance(part, (float, int, list, str)) and id(part) not in known:
            known[id(part)] = part
            rest.extend(part.inputs.values() if isinstance(part, NodeContents) else ())
    return list(known.values())


def leaves(given: Input) -> list[Source]:
    """Pictures, attributes and texture coordinates that an input depends on."""
    return [part for part in parts(given) if not isinstance(part, NodeContents) or part.category == "texcoord"]


@dataclass(frozen=True, eq=False)
class MaterialContents:
    """A material, in the terms that all models of surfaces share, or as a BSDF of Mitsuba."""

    name: str  # Path of the prim
    # By names of `surface_models.NEUTRAL`, without defaults, or "bsdf"; and "displacement" and its scale, in its units
    inputs: dict[str, Input]

    @property
    def is_emissive(self) -> bool:
        """Whether it may shine."""
        emission = self.inputs.get("emission", 0.0)
        if isinstance(emission, (TextureContents, NodeContents)):
            return True
        return not isinstance(emission, (PrimvarContents, str)) and np.any(np.greater(emission, 0)).item()

    def textures(self) -> list[TextureContents]:
        """Pictures that it reads."""
        return [leaf for leaf in self._leaves() if isinstance(leaf, TextureContents)]

    def primvars(self) -> set[str]:
        """Names of the attributes that it reads."""
        return {leaf.name for leaf in self._leaves() if isinstance(leaf, PrimvarContents)}

    def texcoords(self) -> dict[str, Input | None]:
        """Names of the texture coordinates that it reads, with their fallbacks."""
        sets = (leaf.texcoords if isinstance(leaf, TextureContents) else leaf for leaf in self._leaves())
        return {str(s.inputs["name"]): s.inputs.get("fallback") for s in sets if isinstance(s, NodeContents)}

    def _leaves(self) -> Iterator[Source]:
        return (leaf for given in self.inputs.values() for leaf in leaves(given))


@dataclass(frozen=True, eq=False)
class ShapeContents:
    """A mesh, those faces of a mesh that have one material, or curves."""

    name: str  # Path of the prim
    cage: CageContents  # In the prim's own space. Without a scheme, it is a polygon mesh.
    to_world: NDArray  # (4, 4) float64: to the world, or to the space of the group that the shape belongs to
    normals: NDArray | None = None  # (n_h, 3) float64: of a polygon mesh, at its face corners; None for facets
    material: MaterialContents | None = None  # Those that are equal are one
    constants: dict[str, list[float]] = field(default_factory=dict)  # Attributes with one value for the whole mesh
    radiance: list[float] | None = None  # Three numbers, if the mesh is a light
    is_normalized: bool = False  # Whether the radiance is that of the whole light, to be divided by its area
    # (n,) int: faces with this material, of a limit surface that is evaluated whole; None for all. Parts of polygon
    # meshes and of large surfaces have the other faces as holes.
    shown_faces: NDArray | None = None
    curves: CurveSet | None = None  # In the prim's own space; then the cage has their points in USD, and no faces
    rate: int | None = None  # Segments on each edge, where the stage says

    @property
    def is_displaced(self) -> bool:
        """Whether it is a limit surface whose material displaces it."""
        return self.cage.scheme is not None and self.material is not None and "displacement" in self.material.inputs


@dataclass(frozen=True, eq=False)
class InstanceContents:
    """A group of shapes, placed in the world."""

    name: str
    group: int
    to_world: NDArray

    def placed(self, part: Part) -> Part:
        """A part of the group where the instance is."""
        return replace(part, name=f"{self.name}{part.name}", to_world=self.to_world @ part.to_world)


@dataclass(frozen=True, eq=False)
class LightContents:
    """A light."""

    name: str  # Path of the prim
    kind: str  # "distant", "rect", "disk", "sphere", "point", "spot", "cylinder" or "dome"
    to_world: NDArray  # (4, 4) float64
    emission: list[float]  # Three numbers: colour times intensity
    is_normalized: bool = False  # Whether the emission is that of the whole light: its area does not change its power
    # Angle in degrees, width and height, radius, or length and radius. Of a spot, its radius, and the angle and the
    # softness of its cone.
    size: list[float] = field(default_factory=list)
    texture: str | None = None  # Path of a picture that multiplies the radiance
    pole: str = "y"  # Axis of a dome's image


@dataclass(frozen=True, eq=False)
class CameraContents:
    """A camera, which looks along -z with y up."""

    name: str  # Path of the prim
    to_world: NDArray  # (4, 4) float64
    is_perspective: bool
    # Two numbers each: of the film, horizontal and vertical, in the same unit as the focal length; for orthographic
    # cameras, in the world's
    aperture: list[float]
    offset: list[float]
    focal_length: float
    near: float
    far: float
    # In the world's units; 0 without depth of field
    lens_radius: float
    focus_distance: float
    shutter: list[float]  # When it opens and closes, in time codes after the time
    conform_policy: str = "expandAperture"  # For pictures of another aspect ratio; see `sensors.film_window`
    mitsuba: dict[str, Any] = field(default_factory=dict)  # Parameters of Mitsuba's sensor that the prim states


# Of a picture, whose y points up.
WHOLE = [0.0, 0.0, 1.0, 1.0]


@dataclass(frozen=True, eq=False)
class PictureContents:
    """Render settings of a stage, with those of its first render product."""

    name: str = ""  # Path of the prim
    resolution: list[int] | None = None
    window: list[float] = field(default_factory=lambda: WHOLE)  # Least x and y, then largest, of what is rendered
    is_transparent: bool = False  # Whether pictures have alpha
    spp: int | None = None  # Samples per pixel
    integrator: dict[str, Any] = field(default_factory=dict)  # Parameters of Mitsuba's integrator
    aovs: dict[str, str] = field(default_factory=dict)  # Types of Mitsuba's AOVs, by the names of their variables
    products: dict[str, list[str]] = field(default_factory=dict)  # Names of AOVs of products; "" is the colour


@dataclass(frozen=True, eq=False)
class SceneContents:
    """Contents of a stage, or of a part of it; a part has names relative to it, and groups of the whole stage."""

    up: str = "y"
    shapes: list[ShapeContents] = field(default_factory=list)
    groups: list[list[ShapeContents]] = field(default_factory=list)
    instances: list[InstanceContents] = field(default_factory=list)
    lights: list[LightContents] = field(default_factory=list)
    camera: CameraContents | None = None
    picture: PictureContents = field(default_factory=PictureContents)

    @property
    def all_shapes(self) -> list[ShapeContents]:
        """Shapes of the stage and of its groups."""
        return [*self.shapes, *(shape for group in self.groups for shape in group)]

    @property
    def materials(self) -> list[MaterialContents]:
        """Materials of the shapes, each once."""
        return list(dict.fromkeys(shape.material for shape in self.all_shapes if shape.material is not None))

    @property
    def placed_shapes(self) -> list[tuple[ShapeContents, NDArray[np.float64]]]:
        """Shapes and their matrices to the world, those of a group once for each of its instances."""
        placed = [(shape, shape.to_world) for shape in self.shapes]
        for instance in self.instances:
            placed += [(shape, instance.to_world @ shape.to_world) for shape in self.groups[instance.group]]
        return placed

    @property
    def is_lit(self) -> bool:
        """Whether there are lights; emissive materials do not count."""
        return bool(self.lights) or any(shape.radiance and any(shape.radiance) for shape in self.all_shapes)

    @property
    def has_surfaces(self) -> bool:
        """Whether there are meshes to be subdivided."""
        return any(shape.cage.scheme is not None for shape in self.all_shapes)
