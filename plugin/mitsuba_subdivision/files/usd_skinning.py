"""Points of USD meshes after skeletons and blend shapes, evaluated by the package usd-core."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom, UsdSkel


class Skinning:
    """Evaluates UsdSkel at one time, for the meshes of a stage; reports messages and the path of the mesh."""

    def __init__(self, time: Usd.TimeCode, report: Callable[[str, object], None]) -> None:
        from pxr import UsdGeom, UsdSkel

        self.time, self._report = time, report
        self._cache, self._roots = UsdSkel.Cache(), set[str]()
        self._transforms = UsdGeom.XformCache(time)

    def points(self, mesh: UsdGeom.Mesh, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points ``(n, 3)`` after blend shapes and joints, in the mesh's space; float32 if they are moved."""
        if (query := self._query(mesh.GetPrim())) is None:
            return points
        if query.HasBlendShapes():
            points = self._blended(query, points)
        return self._skinned(query, points) if query.HasJointInfluences() else points

    def normals(
        self, mesh: UsdGeom.Mesh, points: NDArray[np.float64], corners: IntArray, normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Normals ``(n_h, 3)`` at face corners after joints; ``corners`` (n_h,) are indices of their points (n, 3).

        Joints move each point by an affine map, whose linear part follows from images of shifted points.
        """
        if (query := self._query(mesh.GetPrim())) is None:
            return normals
        if query.HasBlendShapes():
            self._report("normals of polygons do not follow blend shapes", mesh.GetPath())
        if not query.HasJointInfluences():
            return normals
        step = float(np.abs(points).max(initial=0)) or 1.0
        base = self._skinned(query, np.zeros_like(points))
        shifted = [self._skinned(query, np.broadcast_to(step * axis, points.shape)) - base for axis in np.eye(3)]
        # Rows are images of the axes. Normals are multiplied by the adjugate, the inverse transpose up to a factor.
        x, y, z = shifted
        adjugate = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=1)
        moved = np.einsum("ni,nij->nj", normals, adjugate[corners])
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        return np.divide(moved, length, out=normals.copy(), where=length > 0)

    def _query(self, prim: Usd.Prim) -> UsdSkel.SkinningQuery | None:
        from pxr import Usd, UsdSkel

        if not prim.HasAPI(UsdSkel.BindingAPI):
            return None
        root, binding = UsdSkel.Root.Find(prim), UsdSkel.BindingAPI(prim)
        if root and str(root.GetPath()) not in self._roots:
            self._roots.add(str(root.GetPath()))
            self._cache.Populate(root, Usd.TraverseInstanceProxies())
        query = self._cache.GetSkinningQuery(prim) if root else None
        if query and binding.GetInheritedSkeleton() and (query.HasJointInfluences() or query.HasBlendShapes()):
            return query
        bound = (binding.GetJointIndicesPrimvar(), binding.GetJointWeightsPrimvar(), binding.GetBlendShapesAttr())
        if any(attribute.HasAuthoredValue() for attribute in bound):
            what = "joints and blend shapes are ignored where USD does not evaluate them"
            self._report(f"{what}, as without a SkelRoot above or a skeleton", prim.GetPath())
        return None

    def _blended(self, query: UsdSkel.SkinningQuery, points: NDArray[np.float64]) -> NDArray[np.float64]:
        from pxr import UsdSkel, Vt

        prim, mapper = query.GetPrim(), query.GetBlendShapeMapper()
        skeleton = self._cache.GetSkelQuery(UsdSkel.BindingAPI(prim).GetInheritedSkeleton())
        animation = skeleton.GetAnimQuery() if skeleton else None
        weights = animation.ComputeBlendShapeWeights(self.time) if animation else None
        if not weights or mapper is None:
            return points
        shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim))
        parts = shapes.ComputeSubShapeWeights(mapper.Remap(weights))
        moved = Vt.Vec3fArray.FromNumpy(points.astype(np.float32))
        offsets = shapes.ComputeBlendShapePointIndices(), shapes.ComputeSubShapePointOffsets()
        if not shapes.ComputeDeformedPoints(*parts, *offsets, moved):
            self._report("blend shapes that do not match their mesh are ignored", prim.GetPath())
            return points
        return np.array(moved, dtype=np.float64)

    def _skinned(self, query: UsdSkel.SkinningQuery, points: NDArray[np.float64]) -> NDArray[np.float64]:
        from pxr import UsdSkel, Vt

        prim = query.GetPrim()
        skeleton = self._cache.GetSkelQuery(UsdSkel.BindingAPI(prim).GetInheritedSkeleton())
        joints = skeleton.ComputeSkinningTransforms(self.time) if skeleton else None
        placed = np.array(self._transforms.GetLocalToWorldTransform(prim))
        moved = Vt.Vec3fArray.FromNumpy(points.astype(np.float32))
        is_placed = np.isfinite(placed).all() and np.linalg.det(placed[:3, :3]) != 0
        if not joints or not is_placed or not query.ComputeSkinnedPoints(joints, moved, self.time):
            self._report("joints that do not match their mesh are ignored", prim.GetPath())
            return points
        # USD skins in the skeleton's space.
        to_mesh = np.array(self._transforms.GetLocalToWorldTransform(skeleton.GetPrim())) @ np.linalg.inv(placed)
        return np.array(moved, dtype=np.float64) @ to_mesh[:3, :3] + to_mesh[3, :3]
