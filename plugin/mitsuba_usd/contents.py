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
    """A node of a shading network: a node of MaterialX, or a plugin of Mitsuba."""

    category: str  # Such as "multiply", see `materialx_nodes.OPERATIONS`; or the name of a plugin
    type: str  # Type of the output: "float", "color3", "vector2" and so on; `materialx_nodes.PLUGIN`
    # All inputs except geometric ones; options are strings. "texcoord" has the name of a primvar, and a fallback for
    # meshes without it; if there is no fallback, other texture coordinates of the mesh serve as well.
    inputs: dict[str, Input]


@dataclass(frozen=True, eq=False)
class TextureContents:
    """An image with a scale and a bias, ``scale * image + bias``."""

    file: str  # Path; `a.usdz[b.png]` for a file in an archive
    channel: str  # "rgb", "r", "g", "b" or "a"; as input of a node also "rg" and "rgba"
    color_space: str  # "auto", "raw" or "sRGB"
    wrap: str = "repeat"  # Mitsuba's name: "repeat", "clamp" or "mirror"
    scale: list[float] = field(default_factory=lambda: [1.0] * 4)
    bias: list[float] = field(default_factory=lambda: [0.0] * 4)
    # (3, 3) float64: from texture coordinates to those of the image, whose v points up
    to_uv: NDArray = field(default_factory=lambda: np.eye(3))
    texcoords: NodeContents = field(default_factory=lambda: NodeContents("texcoord", "vector2", {"name": "st"}))
    fallback: list[float] = field(default_factory=lambda: [0.0] * 4)  # Value if the file is missing

    @property
    def channels(self) -> list[int]:
        """Indices of the channels among "rgba"."""
        return ["rgba".index(letter) for letter in self.channel]


@dataclass(frozen=True, eq=False)
class PrimvarContents:
    """A primvar of the mesh; its fallback where the mesh lacks it."""

    name: str
    fallback: list[float]


class MaterialError(ValueError):
    """Reason why a material cannot be read."""


Part = TypeVar("Part", "ShapeContents", "LightContents")
Source = TextureContents | PrimvarContents | NodeContents
Input = float | list[float] | str | Source  # A number, a colour, an option, or the source of a value that varies


def parts(given: Input) -> list[Source]:
    """Sources of an input, each once: itself, unless it is constant, and the inputs of its nodes, recursively."""
    known: dict[int, Source] = {}
    rest = [given]
    while rest:
        part = rest.pop()
        if not isinstance(part, (float, int, list, str)) and id(part) not in known:
            known[id(part)] = part
            rest.extend(part.inputs.values() if isinstance(part, NodeContents) else ())
    return list(known.values())


def leaves(given: Input) -> list[Source]:
    """Images, primvars and texture coordinates that an input depends on."""
    return [part for part in parts(given) if not isinstance(part, NodeContents) or part.category == "texcoord"]


@dataclass(frozen=True, eq=False)
class MaterialContents:
    """A material: inputs of `surface_models.NEUTRAL` that differ from their defaults, or a BSDF of Mitsuba."""

    name: str  # Path of the prim
    inputs: dict[str, Input]  # Also "bsdf", and "displacement" and "displacement_scale" in units of the shape

    @property
    def is_emissive(self) -> bool:
        """Whether the emission is an image, an expression or above 0."""
        emission = self.inputs.get("emission", 0.0)
        if isinstance(emission, (TextureContents, NodeContents)):
            return True
        return not isinstance(emission, (PrimvarContents, str)) and np.any(np.greater(emission, 0)).item()

    def textures(self) -> list[TextureContents]:
        """Images of all inputs."""
        return [leaf for leaf in self._leaves() if isinstance(leaf, TextureContents)]

    def primvars(self) -> set[str]:
        """Names of the primvars of all inputs."""
        return {leaf.name for leaf in self._leaves() if isinstance(leaf, PrimvarContents)}

    def texcoords(self) -> dict[str, Input | None]:
        """Names of the texture coordinates of all inputs, with their fallbacks."""
        sets = (leaf.texcoords if isinstance(leaf, TextureContents) else leaf for leaf in self._leaves())
        return {str(s.inputs["name"]): s.inputs.get("fallback") for s in sets if isinstance(s, NodeContents)}

    def _leaves(self) -> Iterator[Source]:
        return (leaf for given in self.inputs.values() for leaf in leaves(given))


@dataclass(frozen=True, eq=False)
class ShapeContents:
    """A mesh, the faces of a mesh with one material, or curves."""

    name: str  # Path of the prim
    cage: CageContents  # In the prim's own space; a polygon mesh if it has no scheme
    to_world: NDArray  # (4, 4) float64: to the world, or to the space of a group
    normals: NDArray | None = None  # (n_h, 3) float64: at face corners of a polygon mesh; None for facets
    material: MaterialContents | None = None  # The same object for equal materials
    constants: dict[str, list[float]] = field(default_factory=dict)  # Primvars with one value for the whole mesh
    radiance: list[float] | None = None  # RGB of a mesh light
    whole_light: CageContents | None = None  # All faces of a normalized mesh light, whose area divides the radiance
    # (n,) int: faces with this material, of a limit surface that is evaluated whole; None for all. Parts of polygon
    # meshes and of large surfaces have the other faces as holes.
    shown_faces: NDArray | None = None
    curves: CurveSet | None = None  # In the prim's own space; the cage then has their points in USD, and no faces
    rate: int | None = None  # Segments on each edge that the stage states

    @property
    def is_displaced(self) -> bool:
        """Whether it is a limit surface whose material displaces it."""
        return self.cage.scheme is not None and self.material is not None and "displacement" in self.material.inputs


@dataclass(frozen=True, eq=False)
class InstanceContents:
    """A group of shapes with a place in the world."""

    name: str
    group: int
    to_world: NDArray

    def placed(self, part: Part) -> Part:
        """A shape or light of the group, in the place of the instance."""
        return replace(part, name=f"{self.name}{part.name}", to_world=self.to_world @ part.to_world)


@dataclass(frozen=True, eq=False)
class LightContents:
    """A light of UsdLux."""

    name: str  # Path of the prim
    kind: str  # "distant", "rect", "disk", "sphere", "point", "spot", "cylinder" or "dome"
    to_world: NDArray  # (4, 4) float64
    emission: list[float]  # RGB: colour times intensity
    is_normalized: bool = False  # Whether the area of the light does not change its power
    # Angle in degrees; width and height; radius; length and radius; or radius, cone angle and softness of a spot
    size: list[float] = field(default_factory=list)
    texture: str | None = None  # Path of an image that multiplies the radiance
    pole: str = "y"  # Axis of a dome's image

    def scaled(self, factor: float) -> LightContents:
        """The light with all lengths multiplied by a factor, and the same radiance."""
        # Power is divided by the area of the light, or by the square of the distance.
        grows = self.is_normalized and self.kind not in ("distant", "dome")
        emission = [factor**2 * channel for channel in self.emission] if grows else self.emission
        return replace(self, to_world=np.diag([factor, factor, factor, 1.0]) @ self.to_world, emission=emission)


@dataclass(frozen=True, eq=False)
class CameraContents:
    """A camera, which looks along -z with y up."""

    name: str  # Path of the prim
    to_world: NDArray  # (4, 4) float64
    is_perspective: bool
    # Horizontal and vertical, in the unit of the focal length; of orthographic cameras, in the world's unit
    aperture: list[float]
    offset: list[float]
    focal_length: float
    near: float
    far: float
    lens_radius: float  # In the world's unit; 0 without depth of field
    focus_distance: float  # Likewise
    shutter: list[float]  # Time codes of its opening and closing, relative to the frame
    conform_policy: str = "expandAperture"  # Value of aspectRatioConformPolicy
    mitsuba: dict[str, Any] = field(default_factory=dict)  # Authored parameters of Mitsuba's sensor

    def scaled(self, factor: float) -> CameraContents:
        """The camera with all lengths of the world multiplied by a factor; the film of a perspective camera stays."""
        to_world = self.to_world.copy()
        to_world[:3, 3] *= factor
        film = 1.0 if self.is_perspective else factor
        lengths = ("near", "far", "lens_radius", "focus_distance")
        changed: dict[str, Any] = {name: factor * getattr(self, name) for name in lengths}
        changed |= {name: [film * length for length in getattr(self, name)] for name in ("aperture", "offset")}
        return replace(self, to_world=to_world, **changed)


WHOLE = [0.0, 0.0, 1.0, 1.0]  # Least and largest x and y of a picture, whose y points up


@dataclass(frozen=True, eq=False)
class PictureContents:
    """Render settings of a stage, and of its first render product."""

    name: str = ""  # Path of the prim
    resolution: tuple[int, int] | None = None
    window: list[float] = field(default_factory=lambda: WHOLE)  # Rendered part of the picture
    is_transparent: bool = False  # Whether pictures have alpha
    spp: int | None = None  # Samples per pixel
    integrator: dict[str, Any] = field(default_factory=dict)  # Authored parameters of Mitsuba's integrator
    aovs: dict[str, str] = field(default_factory=dict)  # Types of Mitsuba's AOVs by the names of render variables
    products: dict[str, list[str]] = field(default_factory=dict)  # AOVs of each product; "" is the colour


@dataclass(frozen=True, eq=False)
class SceneContents:
    """Contents of a stage, or of a subtree: with names relative to it, and groups of the whole stage."""

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
    def placements(self) -> dict[ShapeContents, NDArray[np.float64]]:
        """Transforms ``(n, 4, 4)`` to the world of each shape; of a shape in a group, one for each instance."""
        found = {shape: [shape.to_world] for shape in self.shapes}
        for instance in self.instances:
            for shape in self.groups[instance.group]:
                found.setdefault(shape, []).append(instance.to_world @ shape.to_world)
        return {shape: np.stack(matrices) for shape, matrices in found.items()}

    @property
    def is_lit(self) -> bool:
        """Whether there are lights of UsdLux."""
        return bool(self.lights) or any(shape.radiance and any(shape.radiance) for shape in self.all_shapes)

    @property
    def has_surfaces(self) -> bool:
        """Whether there are limit surfaces."""
        return any(shape.cage.scheme is not None for shape in self.all_shapes)

    def scaled(self, factor: float) -> SceneContents:
        """The same picture with all lengths multiplied by a factor: light leaks below small models (`enlargement`)."""
        scale = np.diag([factor, factor, factor, 1.0])
        materials: dict[MaterialContents | None, MaterialContents | None] = {}

        def of_material(material: MaterialContents | None) -> MaterialContents | None:
            depth = 0.0 if material is None else material.inputs.get("depth", 0.0)
            if material is not None and material not in materials and isinstance(depth, (int, float)) and depth > 0:
                materials[material] = replace(material, inputs={**material.inputs, "depth": depth * factor})
            return materials.get(material, material)

        def of_shape(shape: ShapeContents, matrix: NDArray) -> ShapeContents:
            power = factor**2 if shape.whole_light else 1.0
            radiance = None if shape.radiance is None else [power * channel for channel in shape.radiance]
            shape = replace(shape, material=of_material(shape.material), radiance=radiance)
            return replace(shape, to_world=matrix @ shape.to_world)

        return replace(
            self,
            shapes=[of_shape(shape, scale) for shape in self.shapes],
            groups=[[of_shape(shape, np.eye(4)) for shape in group] for group in self.groups],
            instances=[replace(instance, to_world=scale @ instance.to_world) for instance in self.instances],
            lights=[light.scaled(factor) for light in self.lights],
            camera=None if self.camera is None else self.camera.scaled(factor),
        )
