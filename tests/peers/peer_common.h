// Around the surfaces of `osd_peer`: files of named arrays, the cage and the queries in them, and options.
//
// A file is a run of records: a name (16 bytes, padded with zeros), a type ('i' int32, 'd' float64; 8 bytes, likewise),
// a count (int64), and the values. peers.py writes the queries and reads the answers.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <limits>
#include <map>
#include <memory>
#include <string>
#include <vector>

namespace peer {

[[noreturn]] inline void fail(const std::string &message) {
    std::fprintf(stderr, "%s\n", message.c_str());
    std::exit(1);
}

class Records {
public:
    std::map<std::string, std::vector<int>> ints;
    std::map<std::string, std::vector<double>> reals;

    static Records read(const std::string &path) {
        std::ifstream file(path, std::ios::binary);
        if (!file) fail("cannot read " + path);
        Records records;
        char name[17] = {}, type[8];
        int64_t count;
        while (file.read(name, 16)) {
            file.read(type, 8);
            file.read(reinterpret_cast<char *>(&count), 8);
            if (type[0] == 'i') take(file, records.ints[name], count);
            else take(file, records.reals[name], count);
            if (!file) fail("a record of " + path + " ends too early");
        }
        return records;
    }

    void write(const std::string &path) const {
        std::ofstream file(path, std::ios::binary);
        for (const auto &record : ints) put(file, record.first, "i", record.second);
        for (const auto &record : reals) put(file, record.first, "d", record.second);
        if (!file.flush()) fail("cannot write " + path);
    }

private:
    template <class T> static void take(std::ifstream &file, std::vector<T> &values, int64_t count) {
        values.resize(count);
        file.read(reinterpret_cast<char *>(values.data()), count * sizeof(T));
    }

    template <class T>
    static void put(std::ofstream &file, std::string name, const char *type, const std::vector<T> &values) {
        char kind[8] = {type[0]};
        int64_t count = static_cast<int64_t>(values.size());
        name.resize(16);
        file.write(name.data(), 16);
        file.write(kind, 8);
        file.write(reinterpret_cast<const char *>(&count), 8);
        file.write(reinterpret_cast<const char *>(values.data()), count * sizeof(T));
    }
};

// Polygons with tags. `values` are rows per vertex, positions first; `fvar_values` rows per face-varying value.
struct Cage {
    int width, fvar_width;
    std::vector<double> values, fvar_values;
    std::vector<int> sizes, corners, creases, sharp_vertices, holes, fvar_indices;
    std::vector<float> crease_sharpness, vertex_sharpness;

    explicit Cage(Records &r)
        : width(r.ints["widths"].at(0)), fvar_width(r.ints["widths"].at(1)), values(r.reals["values"]),
          fvar_values(r.reals["fvar_values"]), sizes(r.ints["sizes"]), corners(r.ints["corners"]),
          creases(r.ints["creases"]), sharp_vertices(r.ints["sharp_vertices"]), holes(r.ints["holes"]),
          fvar_indices(r.ints["fvar_indices"]), crease_sharpness(singles(r.reals["edge_sharpness"])),
          vertex_sharpness(singles(r.reals["point_sharpness"])) {}
    int vertex_count() const { return static_cast<int>(values.size()) / width; }
    int face_count() const { return static_cast<int>(sizes.size()); }

private:
    static std::vector<float> singles(const std::vector<double> &v) { return {v.begin(), v.end()}; }
};

// Parameters (u, v) of a face or, where faces are not of the scheme's own size, of the sub-face of one of its corners.
struct Queries {
    std::vector<int> face, sub;
    std::vector<double> uv;

    explicit Queries(Records &r) : face(r.ints["face"]), sub(r.ints["sub"]), uv(r.reals["uv"]) {}
    int count() const { return static_cast<int>(face.size()); }
};

// Rows per query; not a number where the surface has no value.
struct Answers {
    int width, fvar_width;
    std::vector<double> p, du, dv, fvar;
    std::vector<int> vertex, rule;   // refined vertex at the query, -1 where none is known; its Sdc::Crease::Rule or 0

    Answers(const Cage &cage, int count)
        : width(cage.width), fvar_width(cage.fvar_width), p(size_t(count) * width, none()), du(p), dv(p),
          fvar(size_t(count) * fvar_width, none()), vertex(count, -1), rule(count, 0) {}

    void write(const std::string &path) const {
        Records records;
        records.reals = {{"p", p}, {"du", du}, {"dv", dv}, {"fvar", fvar}};
        records.ints = {{"vertex", vertex}, {"rule", rule}};
        records.write(path);
    }

private:
    static double none() { return std::numeric_limits<double>::quiet_NaN(); }
};

// `program QUERIES ANSWERS [--name value]...`
class Arguments {
public:
    Arguments(int count, char **values) : values_(values + 1, values + count) {
        if (count < 3 || count % 2 == 0) fail("expected QUERIES ANSWERS [--name value]...");
    }
    std::string queries() const { return values_[0]; }
    std::string answers() const { return values_[1]; }
    std::string text(const std::string &name, const std::string &otherwise) const {
        for (size_t i = 2; i + 1 < values_.size(); i += 2)
            if (values_[i] == "--" + name) return values_[i + 1];
        return otherwise;
    }
    int number(const std::string &name, int otherwise) const {
        return std::stoi(text(name, std::to_string(otherwise)));
    }
    template <class T>
    T choice(const std::string &name, const std::string &otherwise, const std::map<std::string, T> &from) const {
        auto found = from.find(text(name, otherwise));
        if (found == from.end()) fail("unknown --" + name + " " + text(name, otherwise));
        return found->second;
    }

private:
    std::vector<std::string> values_;
};

// Makes a `Surface` of the cage and answers all queries with it.
template <class Surface>
void run(const Arguments &arguments, const Cage &cage, const Queries &queries, Answers &answers) {
    Surface surface(cage, arguments, queries);
    for (int i = 0; i < queries.count(); ++i) surface.answer(queries, i, answers);
}

} // namespace peer
