// What the timed peers share: the cage's file, timers, the samples of a quadrilateral, and the printed result.
#pragma once
#include <sys/resource.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <thread>
#include <vector>

namespace peer {

struct Cage {
    int32_t vertices, faces;
    std::vector<float> points;   // x, y, z of each vertex
    std::vector<int32_t> quads;  // four vertices of each face
};

inline Cage read_cage(const char *path) {
    FILE *file = fopen(path, "rb");
    int32_t sizes[2];
    if (!file || fread(sizes, sizeof(int32_t), 2, file) != 2) { perror(path); exit(1); }
    Cage cage{sizes[0], sizes[1], std::vector<float>(3 * (size_t) sizes[0]), std::vector<int32_t>(4 * (size_t) sizes[1])};
    if (fread(cage.points.data(), sizeof(float), cage.points.size(), file) != cage.points.size() ||
        fread(cage.quads.data(), sizeof(int32_t), cage.quads.size(), file) != cage.quads.size()) { perror(path); exit(1); }
    fclose(file);
    return cage;
}

// Wall time in seconds.
inline double timed(const std::function<void()> &work) {
    auto start = std::chrono::steady_clock::now();
    work();
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

// Splits [0, count) over the cores.
inline void parallel(int count, const std::function<void(int, int)> &work) {
    int threads = std::max(1u, std::thread::hardware_concurrency());
    std::vector<std::thread> running;
    for (int k = 0; k < threads; ++k)
        running.emplace_back(work, (int) ((int64_t) count * k / threads), (int) ((int64_t) count * (k + 1) / threads));
    for (auto &thread : running) thread.join();
}

// Parameters of the samples of each quadrilateral. On a closed cage every vertex of the tessellation is found once if
// quadrilaterals leave out their last row and column: "shared". All of them are "grid".
inline std::vector<float> lattice(int rate, bool shared) {
    std::vector<float> uv;
    int count = shared ? rate : rate + 1;
    for (int j = 0; j < count; ++j)
        for (int i = 0; i < count; ++i) { uv.push_back((float) i / rate); uv.push_back((float) j / rate); }
    return uv;
}

// Point and unit normal from point and tangents.
inline void store(float *out, const float *p, const float *du, const float *dv) {
    float n[3] = {du[1] * dv[2] - du[2] * dv[1], du[2] * dv[0] - du[0] * dv[2], du[0] * dv[1] - du[1] * dv[0]};
    float factor = 1 / std::sqrt(std::max(n[0] * n[0] + n[1] * n[1] + n[2] * n[2], 1e-30f));
    for (int k = 0; k < 3; ++k) { out[k] = p[k]; out[3 + k] = n[k] * factor; }
}

// Peak resident memory in MB. On Linux, what getrusage knows includes the program that started this one.
inline double peak_memory() {
    long kilobytes = 0;
    if (FILE *status = fopen("/proc/self/status", "r")) {
        char line[256];
        while (fgets(line, sizeof line, status))
            if (sscanf(line, "VmHWM: %ld kB", &kilobytes) == 1) break;
        fclose(status);
    }
    if (!kilobytes) {
        rusage usage;
        getrusage(RUSAGE_SELF, &usage);
#ifdef __APPLE__
        usage.ru_maxrss /= 1024;
#endif
        kilobytes = usage.ru_maxrss;
    }
    return kilobytes / 1024.;
}

// Best of several runs, as one line of JSON, in seconds and MB. After a set-up the control points are used for the first
// time, which `first` does; `update` follows control points that moved.
inline void report(int repeats, const std::function<void()> &setup, const std::function<void()> &first,
                   const std::function<void()> &update, const std::function<void()> &evaluate) {
    double best[4] = {1e9, 1e9, 1e9, 1e9};
    for (int k = 0; k < repeats; ++k) {
        double s = timed(setup) + timed(first), e = timed(evaluate), u = timed(update);
        double now[4] = {s, u, e, s + e};
        for (int i = 0; i < 4; ++i) best[i] = std::min(best[i], now[i]);
    }
    printf("{\"setup\": %.6g, \"update\": %.6g, \"evaluation\": %.6g, \"total\": %.6g, \"memory\": %.6g}\n", best[0],
           best[1], best[2], best[3], peak_memory());
}

}  // namespace peer
