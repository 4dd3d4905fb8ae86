// Times OpenSubdiv on the limit surface of a cage: points and normals at the samples of a rate.
//
//   opensubdiv_timing far|bfr CAGE.bin RATE REPEATS shared|grid
//
// far: adaptive refinement to level 3, where Gregory patches leave no visible error, patch table, patch map.
// bfr: one surface per face, at its default level; made and evaluated on all cores, as its cache for threads allows.
#include <opensubdiv/bfr/refinerSurfaceFactory.h>
#include <opensubdiv/bfr/surfaceFactoryCache.h>
#include <opensubdiv/far/patchMap.h>
#include <opensubdiv/far/patchTableFactory.h>
#include <opensubdiv/far/primvarRefiner.h>
#include <opensubdiv/far/topologyDescriptor.h>

#include <memory>
#include <mutex>
#include <shared_mutex>
#include <string>

#include "peer_timing.h"

using namespace OpenSubdiv;

struct Point {
    float x[3];
    void Clear() { x[0] = x[1] = x[2] = 0; }
    void AddWithWeight(const Point &other, float weight) { for (int k = 0; k < 3; ++k) x[k] += weight * other.x[k]; }
};

static Far::TopologyRefiner *make_refiner(const peer::Cage &cage) {
    std::vector<int> sizes(cage.faces, 4);
    Far::TopologyDescriptor descriptor;
    descriptor.numVertices = cage.vertices;
    descriptor.numFaces = cage.faces;
    descriptor.numVertsPerFace = sizes.data();
    descriptor.vertIndicesPerFace = cage.quads.data();
    Sdc::Options options;
    options.SetVtxBoundaryInterpolation(Sdc::Options::VTX_BOUNDARY_EDGE_AND_CORNER);
    typedef Far::TopologyRefinerFactory<Far::TopologyDescriptor> Factory;
    return Factory::Create(descriptor, Factory::Options(Sdc::SCHEME_CATMARK, options));
}

static void time_far(const peer::Cage &cage, const std::vector<float> &uv, int repeats) {
    size_t samples = uv.size() / 2;
    std::vector<float> out(cage.faces * samples * 6);
    std::unique_ptr<Far::TopologyRefiner> refiner;
    std::unique_ptr<Far::PatchTable> patches;
    std::unique_ptr<Far::PatchMap> map;
    std::vector<Point> points;
    auto setup = [&] {
        map.reset(); patches.reset(); refiner.reset(make_refiner(cage));
        Far::PatchTableFactory::Options options(3);
        options.useInfSharpPatch = true;
        options.generateVaryingTables = options.generateVaryingLocalPoints = false;
        options.SetEndCapType(Far::PatchTableFactory::Options::ENDCAP_GREGORY_BASIS);
        refiner->RefineAdaptive(options.GetRefineAdaptiveOptions());
        patches.reset(Far::PatchTableFactory::Create(*refiner, options));
        map.reset(new Far::PatchMap(*patches));
    };
    auto update = [&] {
        int refined = refiner->GetNumVerticesTotal();
        points.resize(refined + patches->GetNumLocalPoints());
        std::copy(cage.points.begin(), cage.points.end(), points[0].x);
        Far::PrimvarRefinerReal<float> primvars(*refiner);
        Point *source = points.data();
        for (int level = 1; level <= refiner->GetMaxLevel(); ++level) {
            Point *target = source + refiner->GetLevel(level - 1).GetNumVertices();
            primvars.Interpolate(level, source, target);
            source = target;
        }
        if (patches->GetNumLocalPoints())
            patches->GetLocalPointStencilTable<float>()->UpdateValues(points.data(), points.data() + refined);
    };
    auto evaluate = [&] {
        peer::parallel(cage.faces, [&](int first, int last) {
            float w[20], wu[20], wv[20];
            for (int face = first; face < last; ++face)
                for (size_t s = 0; s < samples; ++s) {
                    float u = uv[2 * s], v = uv[2 * s + 1];
                    const auto *handle = map->FindPatch(face, u, v);
                    patches->EvaluateBasis(*handle, u, v, w, wu, wv);
                    auto controls = patches->GetPatchVertices(*handle);
                    Point p, du, dv;
                    p.Clear(); du.Clear(); dv.Clear();
                    for (int i = 0; i < controls.size(); ++i) {
                        const Point &control = points[controls[i]];
                        p.AddWithWeight(control, w[i]);
                        du.AddWithWeight(control, wu[i]);
                        dv.AddWithWeight(control, wv[i]);
                    }
                    peer::store(&out[(face * samples + s) * 6], p.x, du.x, dv.x);
                }
        });
    };
    peer::report(repeats, setup, update, update, evaluate);
}

static void time_bfr(const peer::Cage &cage, const std::vector<float> &uv, int repeats) {
    typedef Bfr::SurfaceFactoryCacheThreaded<std::shared_mutex, std::shared_lock<std::shared_mutex>, std::unique_lock<std::shared_mutex>> Cache;
    size_t samples = uv.size() / 2;
    std::vector<float> out(cage.faces * samples * 6), patch_points;
    std::vector<size_t> offsets(cage.faces + 1);
    std::unique_ptr<Far::TopologyRefiner> refiner;
    std::vector<Bfr::Surface<float>> surfaces;
    auto setup = [&] {
        surfaces.clear();
        refiner.reset(make_refiner(cage));
        Bfr::RefinerSurfaceFactory<Cache> factory(*refiner);
        surfaces.resize(cage.faces);
        peer::parallel(cage.faces, [&](int first, int last) {
            for (int face = first; face < last; ++face) factory.InitVertexSurface(face, &surfaces[face]);
        });
        for (int face = 0; face < cage.faces; ++face)
            offsets[face + 1] = offsets[face] + 3 * (size_t) surfaces[face].GetNumPatchPoints();
        patch_points.resize(offsets[cage.faces]);
    };
    auto update = [&] {
        peer::parallel(cage.faces, [&](int first, int last) {
            for (int face = first; face < last; ++face)
                surfaces[face].PreparePatchPoints(cage.points.data(), 3, &patch_points[offsets[face]], 3);
        });
    };
    auto evaluate = [&] {
        peer::parallel(cage.faces, [&](int first, int last) {
            float p[3], du[3], dv[3];
            for (int face = first; face < last; ++face)
                for (size_t s = 0; s < samples; ++s) {
                    surfaces[face].Evaluate(&uv[2 * s], &patch_points[offsets[face]], 3, p, du, dv);
                    peer::store(&out[(face * samples + s) * 6], p, du, dv);
                }
        });
    };
    peer::report(repeats, setup, update, update, evaluate);
}

int main(int argc, char **argv) {
    if (argc != 6) return 1;
    peer::Cage cage = peer::read_cage(argv[2]);
    auto uv = peer::lattice(atoi(argv[3]), std::string(argv[5]) == "shared");
    (std::string(argv[1]) == "far" ? time_far : time_bfr)(cage, uv, atoi(argv[4]));
}
