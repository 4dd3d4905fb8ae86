// Times Embree on the limit surface of a cage: points and normals at the samples of a rate.
//
//   embree_timing CAGE.bin RATE REPEATS shared|grid
//
// Set-up is everything up to the first call of rtcInterpolateN, which needs a committed scene.
#include <embree3/rtcore.h>

#include <memory>
#include <string>

#include "peer_timing.h"

int main(int argc, char **argv) {
    if (argc != 5) return 1;
    peer::Cage cage = peer::read_cage(argv[1]);
    auto uv = peer::lattice(atoi(argv[2]), std::string(argv[4]) == "shared");
    int samples = (int) uv.size() / 2, batch = 4 * samples;  // Of four faces, so that rows stay aligned to 16 bytes.
    std::vector<float> out((size_t) cage.faces * samples * 6);
    RTCDevice device = rtcNewDevice(nullptr);
    RTCGeometry geometry = nullptr;
    RTCScene scene = nullptr;
    float *vertices = nullptr;

    auto place = [&] {  // A stride of 16 bytes, as Embree loads whole vectors.
        for (int i = 0; i < cage.vertices; ++i) {
            std::copy_n(&cage.points[3 * (size_t) i], 3, vertices + 4 * (size_t) i);
            vertices[4 * (size_t) i + 3] = 0;
        }
    };
    auto setup = [&] {
        if (scene) { rtcReleaseScene(scene); rtcReleaseGeometry(geometry); }
        geometry = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_SUBDIVISION);
        auto *sizes = (unsigned *) rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_FACE, 0, RTC_FORMAT_UINT, 4, cage.faces);
        auto *indices = (unsigned *) rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT, 4, 4 * (size_t) cage.faces);
        vertices = (float *) rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 16, cage.vertices);
        std::fill_n(sizes, cage.faces, 4u);
        std::copy(cage.quads.begin(), cage.quads.end(), indices);
        place();
        rtcSetGeometryTessellationRate(geometry, 1);
        rtcCommitGeometry(geometry);
        scene = rtcNewScene(device);
        rtcSetSceneFlags(scene, RTC_SCENE_FLAG_DYNAMIC);
        rtcAttachGeometry(scene, geometry);
        rtcCommitScene(scene);
    };
    auto update = [&] {
        place();
        rtcUpdateGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0);
        rtcCommitGeometry(geometry);
        rtcCommitScene(scene);
    };
    auto evaluate = [&] {
        peer::parallel((cage.faces + 3) / 4, [&](int first, int last) {
            std::vector<unsigned> faces(batch);
            std::vector<float> u(batch), v(batch);
            std::unique_ptr<float[], decltype(&free)> found((float *) aligned_alloc(64, (9 * (size_t) batch * 4 + 63) / 64 * 64), &free);
            for (int i = 0; i < batch; ++i) { u[i] = uv[2 * (i % samples)]; v[i] = uv[2 * (i % samples) + 1]; }
            for (int group = first; group < last; ++group) {
                for (int i = 0; i < batch; ++i) faces[i] = std::min(4 * group + i / samples, cage.faces - 1);
                RTCInterpolateNArguments query{};
                query.geometry = geometry;
                query.primIDs = faces.data();
                query.u = u.data();
                query.v = v.data();
                query.N = batch;
                query.bufferType = RTC_BUFFER_TYPE_VERTEX;
                query.P = found.get();
                query.dPdu = found.get() + 3 * batch;
                query.dPdv = found.get() + 6 * batch;
                query.valueCount = 3;
                rtcInterpolateN(&query);
                int count = std::min(4, cage.faces - 4 * group) * samples;
                for (int i = 0; i < count; ++i) {
                    float row[9];
                    for (int k = 0; k < 9; ++k) row[k] = found[(size_t) k * batch + i];
                    peer::store(&out[((size_t) group * batch + i) * 6], row, row + 3, row + 6);
                }
            }
        });
    };
    peer::report(atoi(argv[3]), setup, [] {}, update, evaluate);
}
