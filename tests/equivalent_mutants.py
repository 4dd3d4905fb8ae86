"""Mutants that change no result, with the reason; `mutants.py report` counts them apart.

Each is a module, its line and the mutated line, by their text, so that they are found wherever the line has moved.
"""

EQUIVALENT: tuple[tuple[str, tuple[tuple[str, str, str], ...]], ...] = (
    (
        "a bound on work: blocks, runs, thresholds between two paths of equal results, depths beyond any that occurs",
        (
            ("evaluation/divided_element.py", "for _ in range(MOST_DEPTH + 1):", "for _ in range(MOST_DEPTH + 2):"),
            ("evaluation/piece_tree.py", "SHARED_PIECES = 64", "SHARED_PIECES = 65"),
            (
                "kernels/apply_weights.py",
                "vertex_stencils.counts * vertex_stencils.run_counts,",
                "vertex_stencils.counts / vertex_stencils.run_counts,",
            ),
            ("mesh/connectivity.py", "FEW_HALF_EDGES = 1 << 13", "FEW_HALF_EDGES = 1 << 12"),
            ("patches/energies.py", "CHUNK = 1 << 21", "CHUNK = 1 << 22"),
            ("patches/nearest_in_piece.py", "STEPS = 60", "STEPS = 61"),
            (
                "patches/patch_table.py",
                "if self.class_count <= max(MANY_CLASSES, self.patch_count // FEW_PATCHES):",
                "if self.class_count < max(MANY_CLASSES, self.patch_count // FEW_PATCHES):",
            ),
            (
                "patches/polynomial_pieces.py",
                "if element.regular_count > MOST_PIECES and depth == DIVISIONS:",
                "if element.regular_count > MOST_PIECES and depth != DIVISIONS:",
            ),
            (
                "patches/surface_area.py",
                "for at, columns in pieces.runs(MOST_POINTS // len(du)):",
                "for at, columns in pieces.runs(MOST_POINTS * len(du)):",
            ),
            (
                "tessellation/quad_grid.py",
                "for corners in slices_of(t.half_edges_of(t.face_sizes != 4), self.half**2 + 1):",
                "for corners in slices_of(t.half_edges_of(t.face_sizes != 4), self.half** 3 + 1):",
            ),
            (
                "tessellation/vertex_table.py",
                "number = (np.cumsum(vertex_counts[kinds]) - 1) // max(1, BLOCK_WEIGHTS // size)",
                "number = (np.cumsum(vertex_counts[kinds]) - 1) * max(1, BLOCK_WEIGHTS // size)",
            ),
            (
                "tessellation/uniform_grid.py",
                "length = max(1, VERTICES_AT_ONCE // size)",
                "length = max(1, VERTICES_AT_ONCE * size)",
            ),
            ("tessellation/tile_rates.py", "@lru_cache(maxsize=16)", "@lru_cache(maxsize= 17)"),
            ("shapes/vertex_choice.py", "WORTH_A_KERNEL = 300_000", "WORTH_A_KERNEL = 300001"),
            ("usd/stage_materials.py", "_DEEPEST = 16", "_DEEPEST = 17"),
            ("patches/surface_area.py", "MOST_HALVINGS = 10", "MOST_HALVINGS = 11"),
            ("evaluation/divided_tile.py", "elif depth > 1:", "elif depth > 0:"),
            (
                "patches/closest_points.py",
                "is_flat = boxes.halves[:, 2] <= FLAT * boxes.halves[:, :2].max(axis=1) + rounded",
                "is_flat = boxes.halves[:, 2] <= FLAT / boxes.halves[:, :2].max(axis=1) + rounded",
            ),
            (
                "mesh/connectivity.py",
                "return paired(self.edge_names.__getitem__, self.half_edge_count,"
                " int(self.edge_names.max(initial=0)) + 1)",
                "return paired(self.edge_names.__getitem__, self.half_edge_count,"
                " int(self.edge_names.max(initial=0)) + 2)",
            ),
            (
                "kernels/apply_weights.py",
                "if first < index and (is_product or (count > FEW_SAMPLES and is_other_size)):",
                "if first < index and (is_product or (count >= FEW_SAMPLES and is_other_size)):",
            ),
            (
                "tessellation/uniform.py",
                "step = max(1, WEIGHTS_TOGETHER // (3 * len(uv) * most))",
                "step = max(1, WEIGHTS_TOGETHER // (3 + len(uv) * most))",
            ),
            ("evaluation/irregular_patch.py", "MANY_CONTROLS = 256", "MANY_CONTROLS = 255"),
            ("patches/element_bounds.py", "@lru_cache(maxsize=64)", "@lru_cache(maxsize= 63)"),
            ("patches/patch_table.py", "KEPT_BYTES = 1 << 25", "KEPT_BYTES = 2 << 25"),
            ("patches/one_ring_codes.py", "elif count > FEW_CODES:", "elif count < FEW_CODES:"),
            ("patches/closest_points.py", "MOST_CONVEX_HALVINGS = 3", "MOST_CONVEX_HALVINGS = 2"),
        ),
    ),
    (
        "a faster path: what it leaves out is read or computed by the slower one",
        (
            ("files/ply_lists.py", "for each in self._element.properties:", "for each in []:"),
            ("files/obj_tags.py", "continue", "break"),
            ("files/obj_tags.py", "for name, (head, width) in _PLAIN_TAGS.items():", "for name, (head, width) in []:"),
            (
                "files/obj_tags.py",
                "positions = obj.statement_start[statements][:, None] + np.arange(len(head))",
                "positions = obj.statement_start[statements][:, None] - np.arange(len(head))",
            ),
            (
                "patches/patch_samples.py",
                'is_usual = evaluator == "stabilized" and derivatives == 1 and np.dtype(dtype) == np.float64',
                'is_usual = evaluator == "stabilized" and derivatives != 1 and np.dtype(dtype) == np.float64',
            ),
            (
                "usd/stage_scenes.py",
                "if self._first is not None and self._first[0] == number:",
                "if self._first is not None and self._first[ 1] == number:",
            ),
            (
                "shapes/exact_shading.py",
                "return dr.select(dr.squared_norm(seen) > 0, seen, vector3(dr.detach(si.n)))",
                "return dr.select(dr.squared_norm(seen) >= 0, seen, vector3(dr.detach(si.n)))",
            ),
            (
                "files/ply_header.py",
                "if offset + column_type.itemsize > len(content):",
                "if offset + column_type.itemsize >= len(content):",
            ),
        ),
    ),
    (
        "values that no one reads: masked, overwritten, of a loop over nothing, an entry more of a copied table, the"
        " file of memory that has none, or a default that schemas or models of surfaces always replace",
        (
            (
                "evaluation/equations.py",
                "ratios = np.where(kept, basis.eigenvalues / base, 0).astype(real)",
                "ratios = np.where(kept, basis.eigenvalues / base, 1).astype(real)",
            ),
            (
                "evaluation/eigenbasis.py",
                "weight = binomial * np.where(levels >= order, mean ** np.maximum(levels - order, 0.0), 0)",
                "weight = binomial * np.where(levels >= order, mean ** np.maximum(levels - order, -1.0), 0)",
            ),
            (
                "regression/compare.py",
                'paired, is_replaced = results.get("paired"), False',
                'paired, is_replaced = results.get("paired"), True',
            ),
            ("schemes/scheme.py", "regular_border_faces: int = 0", "regular_border_faces: int = -1"),
            (
                "tessellation/patch_frames.py",
                "twin = np.concatenate([twin, *corners[:2]])",
                "twin = np.concatenate([twin, *corners[: 3]])",
            ),
            (
                "files/obj_reader.py",
                "return None if vertices is None else (vertices, has_texcoord, vertices[:0])",
                "return None if vertices is None else (vertices, has_texcoord, vertices[: -1])",
            ),
            ("patches/nearest_in_piece.py", "break", "continue"),
            (
                "patches/one_ring_codes.py",
                "beyond = np.zeros((t.vertex_count, int(count.max(initial=0)), 3))",
                "beyond = np.zeros((t.vertex_count, int(count.max(initial= 1)), 3))",
            ),
            (
                "schemes/crease_masks.py",
                "twin_refined = semi.edges_refined[np.maximum(t.twin, 0)]",
                "twin_refined = semi.edges_refined[np.maximum(t.twin, -1)]",
            ),
            ("shapes/mitsuba_3_9_hook/interaction_hook.py", "_BEFORE = 2", "_BEFORE = 3"),
            (
                "shapes/mitsuba_3_9_hook/machine_code.py",
                "address = allocate(None, mmap.PAGESIZE, mmap.PROT_READ | mmap.PROT_WRITE, flags, -1, 0)",
                "address = allocate(None, mmap.PAGESIZE, mmap.PROT_READ | mmap.PROT_WRITE, flags, +1, 0)",
            ),
            (
                "evaluation/equations.py",
                "ratios = np.where(kept, basis.eigenvalues / base, 0).astype(real)",
                "ratios = np.where(kept, basis.eigenvalues / base, -1).astype(real)",
            ),
            ("mesh/one_ring.py", "inside = twins >= 0", "inside = twins >= 1"),
            (
                "usd/polygons.py",
                'radius, half = number("radius", 1.0), number("height", 2.0) / 2',
                'radius, half = number("radius", 2.0), number("height", 2.0) / 2',
            ),
            (
                "usd/surface_models.py",
                '"base_color": [0.18, 0.18, 0.18],  # Of diffuse reflection, and of metal seen head-on.',
                '"base_color": [ 1.18, 0.18, 0.18],  # Of diffuse reflection, and of metal seen head-on.',
            ),
        ),
    ),
    (
        "the same element, or another of the same value: all half-edges of a fan begin at its vertex, all channels have"
        " as many pixels, a field of view is one number, a fan that begins at half-edge 0 is found either way,"
        " closed meshes have no valence of one, maps of coefficients are square, a rule is the same in all meshes,"
        " a polygon is closed if its mirror image is, and one place has one row of values",
        (
            (
                "evaluation/refined_fans.py",
                "alone = RefinedRing(refined_ring(scheme, near or signature), 0)",
                "alone = RefinedRing(refined_ring(scheme, near or signature), -1)",
            ),
            ("files/joined_meshes.py", "return values[0]", "return values[ 1]"),
            (
                "patches/turned_boxes.py",
                "middle = basis.values(basis.domain.centre[None])[0]",
                "middle = basis.values(basis.domain.centre[None])[ -1]",
            ),
            (
                "schemes/scheme_members.py",
                "point, edge = point + edge, scheme.edge_turn @ edge",
                "point, edge = point - edge, scheme.edge_turn @ edge",
            ),
            (
                "regression/radiance_tiers.py",
                'numbers = {"paired_relative": largest, "changed_pixels": changed, "pixels":'
                " int(difference[..., 0].size)}",
                'numbers = {"paired_relative": largest, "changed_pixels": changed, "pixels":'
                " int(difference[..., 1].size)}",
            ),
            (
                "mesh/manifold.py",
                "start = np.where(t.open_fan_start[run] < 0, t.vertex_half_edge[run], t.open_fan_start[run])"
                "[count > 0]",
                "start = np.where(t.open_fan_start[run] <= 0, t.vertex_half_edge[run], t.open_fan_start[run])"
                "[count > 0]",
            ),
            (
                "mesh/signature.py",
                "rule = VertexRule(int(topology.vertex_rules[topology.face_vertices[ahead[0]]]))",
                "rule = VertexRule(int(topology.vertex_rules[topology.face_vertices[ahead[ -1]]]))",
            ),
            (
                "schemes/scheme.py",
                'return Unsupported("vertex", low, f"has valence {topology.vertex_face_count[low[0]]}",'
                ' f"valence {least} or more")',
                'return Unsupported("vertex", low, f"has valence {topology.vertex_face_count[low[ -1]]}",'
                ' f"valence {least} or more")',
            ),
            (
                "shapes/tessellation_parameters.py",
                'fov = float(np.ravel(np.array(parameters["x_fov"]))[0])',
                'fov = float(np.ravel(np.array(parameters["x_fov"]))[ -1])',
            ),
            (
                "tessellation/tile_rates.py",
                "size, length = maps.shape[-1], max(1, PARTS_AT_ONCE // maps.shape[2])",
                "size, length = maps.shape[+1], max(1, PARTS_AT_ONCE // maps.shape[2])",
            ),
            (
                "shapes/displaced_vertices.py",
                "self._values = [_columns(each) if each.shape[1] > 1 else _columns(each)[0] for each in values]",
                "self._values = [_columns(each) if each.shape[1] > 1 else _columns(each)[ -1] for each in values]",
            ),
            (
                "tessellation/memory.py",
                "is_whole = refined is None and patches.is_whole[patches.elements.face_of(patch_class.corners[:1])][0]",
                "is_whole = refined is None and patches.is_whole[patches.elements.face_of("
                "patch_class.corners[: 2])][0]",
            ),
        ),
    ),
    (
        "another name for the same thing: keys stay as distinct, what is below zero counts as smooth, and both sides of"
        " an edge run along it the same way",
        (
            (
                "mesh/manifold.py",
                "is_again = _is_later(t.edge.astype(np.int64) * t.face_count + t.face)",
                "is_again = _is_later(t.edge.astype(np.int64) * t.face_count - t.face)",
            ),
            (
                "tessellation/tile_sides.py",
                "line[at, side] = (own.astype(np.int64) + t.half_edge_count) << DEEPEST",
                "line[at, side] = (own.astype(np.int64) - t.half_edge_count) << DEEPEST",
            ),
            (
                "tessellation/tile_sides.py",
                "line[:, side] = (tiles.corner.astype(np.int64) + (2 + axis) * t.half_edge_count)"
                " << DEEPEST | own_level",
                "line[:, side] = (tiles.corner.astype(np.int64) + ( 3 + axis) * t.half_edge_count)"
                " << DEEPEST | own_level",
            ),
            (
                "mesh/seams.py",
                "sharpness = Sharpness(np.where(seam, INFINITE, 0.0), np.zeros(topology.vertex_count))",
                "sharpness = Sharpness(np.where(seam, INFINITE, -1.0), np.zeros(topology.vertex_count))",
            ),
            (
                "tessellation/patch_frames.py",
                "edge, is_backward = lower, lower != every",
                "edge, is_backward = lower, lower == every",
            ),
            (
                "tessellation/spans.py",
                "point, of_point = ranked(joined(point, of_points, 32))",
                "point, of_point = ranked(joined(point, of_points, 33))",
            ),
            (
                "tessellation/stitching.py",
                "width = int(most.max(initial=0)) + 2",
                "width = int(most.max(initial=0)) + 1",
            ),
            (
                "mesh/seams.py",
                "is_down = t.face_vertices[start] > t.face_vertices[end]",
                "is_down = t.face_vertices[start] < t.face_vertices[end]",
            ),
        ),
    ),
    (
        "a difference within rounding, a tie of two results that are both right, or a factor of zero",
        (
            ("mesh/refinement_differences.py", "DECIMALS = 12", "DECIMALS = 13"),
            ("patches/area_samples.py", "ROUNDED = 1 + 1e-9", "ROUNDED = 1 - 1e-9"),
            ("evaluation/scheme_check.py", "SAME_DIGITS = 9", "SAME_DIGITS = 8"),
            (
                "tessellation/tile_extents.py",
                "is_last = division == MOST_DIVISIONS[is_convex] - 1",
                "is_last = division == MOST_DIVISIONS[is_convex] - 2",
            ),
            (
                "patches/closest_points.py",
                "self._slope[self._squared_distance > limit] = np.inf",
                "self._slope[self._squared_distance >= limit] = np.inf",
            ),
            ("patches/nearest_in_piece.py", "on_edge = inside <= ON_EDGE", "on_edge = inside < ON_EDGE"),
            ("patches/patch_table.py", "is_less = codes[turn] < least", "is_less = codes[turn] <= least"),
            (
                "patches/nearest_in_piece.py",
                "bend = np.where(is_newton[slides], bend, flat + damped[slides])",
                "bend = np.where(is_newton[slides], bend, flat - damped[slides])",
            ),
            (
                "kernels/nearest_location.py",
                "inverse = dr.select(exists, 1 / dr.select(exists, determinant, 1), 0)",
                "inverse = dr.select(exists, 1 / dr.select(exists, determinant, 1), 1)",
            ),
            (
                "shapes/moving_vertices.py",
                "to_world = matrix if dr.is_jit_v(matrix) else types.matrix4(matrix.tolist())",
                "to_world = matrix if not dr.is_jit_v(matrix) else types.matrix4(matrix.tolist())",
            ),
            (
                "patches/nearest_in_piece.py",
                "return step * np.minimum(part, 1)[:, None], is_newton & (part >= 1)",
                "return step * np.minimum(part, 1)[:, None], is_newton & (part > 1)",
            ),
            (
                "patches/surface_area.py",
                "rough = sum(float(_measured(part, ORDERS[0])[1].sum()) for part in parts)",
                "rough = sum(float(_measured(part, ORDERS[0])[ 0].sum()) for part in parts)",
            ),
            (
                "shapes/cage_files.py",
                "if abs(clock.time_ns() - found.st_mtime_ns) < SETTLED:",
                "if abs(clock.time_ns() - found.st_mtime_ns) <= SETTLED:",
            ),
        ),
    ),
    (
        "a probe or a step among many as good: any power checks a basis, any places a linear function or a"
        " texture's kind, and steps of either sign shrink until one leads nearer",
        (
            ("evaluation/eigenbasis.py", "POWER = 20", "POWER = 19"),
            ("evaluation/ring_symmetry.py", "PROBES_OF_FACE = 2", "PROBES_OF_FACE = 1"),
            (
                "patches/channel.py",
                "uv = np.array([(0.1, 0.2), (0.5, 0.25), (0.3, 0.6)])",
                "uv = np.array([(0.1, 0.2), ( 1.5, 0.25), (0.3, 0.6)])",
            ),
            ("patches/nearest_in_piece.py", "SHORTER = 0.25", "SHORTER = -0.75"),
            (
                "patches/nearest_in_piece.py",
                "self.part = np.where(improves, 1, self.part * SHORTER)",
                "self.part = np.where(improves, 2, self.part * SHORTER)",
            ),
            ("shapes/heights.py", "middle = self._interaction(0.5, 0.5)", "middle = self._interaction( 1.5, 0.5)"),
            (
                "shapes/mitsuba_3_9_hook/hook_trial.py",
                'mesh = Triangle("triangle", vertex_count=3, face_count=1)',
                'mesh = Triangle("triangle", vertex_count=3, face_count= 2)',
            ),
        ),
    ),
    (
        "the length or the digits of a message, or of a stated number",
        (
            (
                "files/usd_stage.py",
                "_MOST_SHOWN, _MOST_SEARCHED = 200, 10_000",
                "_MOST_SHOWN, _MOST_SEARCHED = 200, 9999",
            ),
            (
                "regression/radiance_tiers.py",
                "return round(start, 3), round(stop, 3), max(2, int(np.ceil(stop - start)))",
                "return round(start, 3), round(stop, 4), max(2, int(np.ceil(stop - start)))",
            ),
            ("regression/image.py", "_LONGEST = 60", "_LONGEST = 61"),
            ("regression/image.py", "_LONGEST = 60", "_LONGEST = 59"),
            (
                "files/usd_stage.py",
                "files = _listed(sorted({Path(each).name for each in documents}), 3)",
                "files = _listed(sorted({Path(each).name for each in documents}), 2)",
            ),
            ("tessellation/memory.py", "ADAPTIVE_TRIANGLE_BYTES = 400", "ADAPTIVE_TRIANGLE_BYTES = 399"),
        ),
    ),
    (
        "less than one texel is needed: an image has one at least",
        (
            (
                "usd/texture_detail.py",
                "found[texture.file] = max(needed, found.get(texture.file, 0.0))",
                "found[texture.file] = max(needed, found.get(texture.file, 1.0))",
            ),
        ),
    ),
    (
        "no picture shows a single point, wherever the studio around it stands",
        (
            (
                "usd/studio_defaults.py",
                "bounds += np.array([[-1], [1]]) * _LEAST_SIZE * (1 + np.abs(bounds).max())",
                "bounds += np.array([[-1], [ 2]]) * _LEAST_SIZE * (1 + np.abs(bounds).max())",
            ),
        ),
    ),
    (
        "the spaces of a file that programs read",
        (
            (
                "regression/report.py",
                '_write_text(folder / NUMBERS, json.dumps({"title": title, **comparison.as_dict()}, indent=1) + "\\n")',
                '_write_text(folder / NUMBERS, json.dumps({"title": title, **comparison.as_dict()},'
                ' indent= 2) + "\\n")',
            ),
        ),
    ),
)
