// Embree's Catmull-Clark limit surface of a cage at given parameters, always in float32.
//
//   embree_peer QUERIES ANSWERS [--boundary none|edge_only|edge_and_corner] [--repetitions n] [--threads n]
#include "peer_common.h"
#include <embree3/rtcore.h>

using namespace peer;

template <class T>
static void fill(RTCGeometry geometry, RTCBufferType type, RTCFormat format, const std::vector<T> &values,
                 int per_item) {
    if (values.empty()) return;
    void *buffer = rtcSetNewGeometryBuffer(geometry, type, 0, format, sizeof(T) * per_item, values.size() / per_item);
    std::memcpy(buffer, values.data(), values.size() * sizeof(T));
}

class EmbreeSurface {
public:
    EmbreeSurface(const Cage &cage, const Arguments &a, const Queries &) : sizes_(cage.sizes) {
        device_ = rtcNewDevice("threads=1,set_affinity=0");
        geometry_ = rtcNewGeometry(device_, RTC_GEOMETRY_TYPE_SUBDIVISION);
        fill(geometry_, RTC_BUFFER_TYPE_FACE, RTC_FORMAT_UINT, cage.sizes, 1);
        fill(geometry_, RTC_BUFFER_TYPE_INDEX, RTC_FORMAT_UINT, cage.corners, 1);
        fill(geometry_, RTC_BUFFER_TYPE_EDGE_CREASE_INDEX, RTC_FORMAT_UINT2, cage.creases, 2);
        fill(geometry_, RTC_BUFFER_TYPE_EDGE_CREASE_WEIGHT, RTC_FORMAT_FLOAT, as_embree(cage.crease_sharpness), 1);
        fill(geometry_, RTC_BUFFER_TYPE_VERTEX_CREASE_INDEX, RTC_FORMAT_UINT, cage.sharp_vertices, 1);
        fill(geometry_, RTC_BUFFER_TYPE_VERTEX_CREASE_WEIGHT, RTC_FORMAT_FLOAT, as_embree(cage.vertex_sharpness), 1);
        fill(geometry_, RTC_BUFFER_TYPE_HOLE, RTC_FORMAT_UINT, cage.holes, 1);
        // Embree loads whole vectors of four: a tighter buffer would end in undefined memory.
        auto *points = static_cast<float *>(rtcSetNewGeometryBuffer(
            geometry_, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 16, cage.vertex_count()));
        for (int i = 0; i < 4 * cage.vertex_count(); ++i)
            points[i] = i % 4 < 3 ? float(cage.values[size_t(i / 4) * cage.width + i % 4]) : 0.f;
        rtcSetGeometrySubdivisionMode(geometry_, 0, a.choice<RTCSubdivisionMode>("boundary", "edge_and_corner",
            {{"none", RTC_SUBDIVISION_MODE_NO_BOUNDARY}, {"edge_only", RTC_SUBDIVISION_MODE_SMOOTH_BOUNDARY},
             {"edge_and_corner", RTC_SUBDIVISION_MODE_PIN_CORNERS}}));
        rtcCommitGeometry(geometry_);
        scene_ = rtcNewScene(device_);
        rtcAttachGeometry(scene_, geometry_);
        rtcCommitScene(scene_);
        if (rtcGetDeviceError(device_) != RTC_ERROR_NONE) fail("Embree refuses the cage");
    }
    ~EmbreeSurface() {
        rtcReleaseScene(scene_);
        rtcReleaseGeometry(geometry_);
        rtcReleaseDevice(device_);
    }

    void answer(const Queries &queries, int i, Answers &answers) {
        float u = float(queries.uv[2 * i]), v = float(queries.uv[2 * i + 1]), out[3][16];
        if (sizes_[queries.face[i]] != 4) {
            // Sub-faces of a polygon are tiles 2 apart, four in a row, with room of 1/2 around each.
            u += 2 * (queries.sub[i] % 4) + 0.5f;
            v += 2 * (queries.sub[i] / 4) + 0.5f;
        }
        rtcInterpolate1(geometry_, queries.face[i], u, v, RTC_BUFFER_TYPE_VERTEX, 0, out[0], out[1], out[2], 3);
        for (int k = 0; k < 3; ++k) {
            answers.p[size_t(i) * answers.width + k] = out[0][k];
            answers.du[size_t(i) * answers.width + k] = out[1][k];
            answers.dv[size_t(i) * answers.width + k] = out[2][k];
        }
    }

private:
    // OpenSubdiv's 10 is infinite.
    static std::vector<float> as_embree(std::vector<float> sharpness) {
        for (float &s : sharpness)
            if (s >= 10) s = std::numeric_limits<float>::infinity();
        return sharpness;
    }

    std::vector<int> sizes_;
    RTCDevice device_;
    RTCGeometry geometry_;
    RTCScene scene_;
};

int main(int count, char **values) {
    Arguments arguments(count, values);
    Records records = Records::read(arguments.queries());
    Cage cage(records);
    Queries queries(records);
    Answers answers(cage, queries.count());
    run<EmbreeSurface>(arguments, cage, queries, answers);
    answers.write(arguments.answers());
}
