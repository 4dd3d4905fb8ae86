// OpenSubdiv's limit surface of any cage at given parameters.
//
//   osd_peer QUERIES ANSWERS [--method far|bfr|refine] [--level n] [--real float|double] [--scheme catmark|loop]
//            [--boundary none|edge_only|edge_and_corner] [--creasing uniform|chaikin]
//            [--triangles catmark|smooth] [--fvar all|none|boundaries|corners_only|corners_plus1|corners_plus2]
//
//   far      adaptive refinement to the level, a patch table with Gregory end caps, EvaluateBasis
//   bfr      Bfr::Surface of each face that is asked for, which approximates smooth features at the level; without
//            face-varying values, for the figure of reflection lines
//   refine   uniform refinement to the level and limit masks: only parameters that are vertices of that level have a
//            value; du and dv are two tangents at the vertex, whatever the directions of its edges
#include "peer_common.h"
#include <array>
#include <memory>
#include <opensubdiv/bfr/refinerSurfaceFactory.h>
#include <opensubdiv/far/patchMap.h>
#include <opensubdiv/far/patchTableFactory.h>
#include <opensubdiv/far/primvarRefiner.h>
#include <opensubdiv/far/ptexIndices.h>
#include <opensubdiv/far/stencilTable.h>
#include <opensubdiv/far/topologyDescriptor.h>

using namespace OpenSubdiv;
using namespace peer;

using Refiner = Far::TopologyRefiner;

// Rows of any width, as OpenSubdiv wants to see them.
template <class R> class Rows {
public:
    struct Row {
        R *x;
        int width;
        void Clear() { std::fill(x, x + width, R(0)); }
        void AddWithWeight(const Row &other, R weight) {
            for (int k = 0; k < width; ++k) x[k] += weight * other.x[k];
        }
    };
    Rows(int width, R *data) : width_(width), data_(data) {}
    Row operator[](int i) const { return {data_ + size_t(i) * width_, width_}; }
    Rows from(int i) const { return {width_, data_ + size_t(i) * width_}; }

private:
    int width_;
    R *data_;
};

template <class R>
void combine(const Rows<R> &rows, const Far::ConstIndexArray &points, const R *weights, int width, double *out,
             R scale = 1) {
    R sum[64] = {};
    for (int i = 0; i < points.size(); ++i)
        for (int k = 0; k < width; ++k) sum[k] += weights[i] * rows[points[i]].x[k];
    for (int k = 0; k < width; ++k) out[k] = scale * sum[k];
}

static std::unique_ptr<Refiner> make_refiner(const Cage &cage, const Arguments &a) {
    using O = Sdc::Options;
    auto scheme = a.choice<Sdc::SchemeType>("scheme", "catmark",
        {{"catmark", Sdc::SCHEME_CATMARK}, {"loop", Sdc::SCHEME_LOOP}});
    O options;
    options.SetVtxBoundaryInterpolation(a.choice<O::VtxBoundaryInterpolation>("boundary", "edge_and_corner",
        {{"none", O::VTX_BOUNDARY_NONE}, {"edge_only", O::VTX_BOUNDARY_EDGE_ONLY},
         {"edge_and_corner", O::VTX_BOUNDARY_EDGE_AND_CORNER}}));
    options.SetCreasingMethod(a.choice<O::CreasingMethod>("creasing", "uniform",
        {{"uniform", O::CREASE_UNIFORM}, {"chaikin", O::CREASE_CHAIKIN}}));
    options.SetTriangleSubdivision(a.choice<O::TriangleSubdivision>("triangles", "catmark",
        {{"catmark", O::TRI_SUB_CATMARK}, {"smooth", O::TRI_SUB_SMOOTH}}));
    options.SetFVarLinearInterpolation(a.choice<O::FVarLinearInterpolation>("fvar", "all",
        {{"all", O::FVAR_LINEAR_ALL}, {"none", O::FVAR_LINEAR_NONE}, {"boundaries", O::FVAR_LINEAR_BOUNDARIES},
         {"corners_only", O::FVAR_LINEAR_CORNERS_ONLY}, {"corners_plus1", O::FVAR_LINEAR_CORNERS_PLUS1},
         {"corners_plus2", O::FVAR_LINEAR_CORNERS_PLUS2}}));

    Far::TopologyDescriptor d;
    d.numVertices = cage.vertex_count();
    d.numFaces = cage.face_count();
    d.numVertsPerFace = cage.sizes.data();
    d.vertIndicesPerFace = cage.corners.data();
    d.numCreases = int(cage.crease_sharpness.size());
    d.creaseVertexIndexPairs = cage.creases.data();
    d.creaseWeights = cage.crease_sharpness.data();
    d.numCorners = int(cage.vertex_sharpness.size());
    d.cornerVertexIndices = cage.sharp_vertices.data();
    d.cornerWeights = cage.vertex_sharpness.data();
    d.numHoles = int(cage.holes.size());
    d.holeIndices = cage.holes.data();
    Far::TopologyDescriptor::FVarChannel channel;
    if (cage.fvar_width) {
        channel.numValues = int(cage.fvar_values.size()) / cage.fvar_width;
        channel.valueIndices = cage.fvar_indices.data();
        d.numFVarChannels = 1;
        d.fvarChannels = &channel;
    }
    using Factory = Far::TopologyRefinerFactory<Far::TopologyDescriptor>;
    std::unique_ptr<Refiner> refiner(Factory::Create(d, Factory::Options(scheme, options)));
    if (!refiner) fail("OpenSubdiv refuses the cage");
    return refiner;
}

// Rows of all levels, one after the other: of vertices, or of face-varying values.
template <class R> std::vector<R> refined(const Refiner &refiner, const Cage &cage, bool is_fvar, int local_points) {
    int width = is_fvar ? cage.fvar_width : cage.width;
    int total = is_fvar ? refiner.GetNumFVarValuesTotal() : refiner.GetNumVerticesTotal();
    const auto &values = is_fvar ? cage.fvar_values : cage.values;
    std::vector<R> data(values.begin(), values.end());
    data.resize(size_t(width) * (total + local_points));
    Far::PrimvarRefinerReal<R> primvars(refiner);
    Rows<R> source(width, data.data());
    for (int level = 1; level <= refiner.GetMaxLevel(); ++level) {
        const auto &before = refiner.GetLevel(level - 1);
        Rows<R> next = source.from(is_fvar ? before.GetNumFVarValues() : before.GetNumVertices());
        if (is_fvar) primvars.InterpolateFaceVarying(level, source, next);
        else primvars.Interpolate(level, source, next);
        source = next;
    }
    return data;
}

template <class R> class FarSurface {
public:
    FarSurface(const Cage &cage, const Arguments &a, const Queries &) : refiner_(make_refiner(cage, a)) {
        Far::PatchTableFactory::Options options(a.number("level", 10));
        options.useInfSharpPatch = true;
        options.generateVaryingTables = options.generateVaryingLocalPoints = false;
        options.generateFVarTables = cage.fvar_width > 0;
        options.generateFVarLegacyLinearPatches = false;
        options.template SetPatchPrecision<R>();
        options.template SetFVarPatchPrecision<R>();
        options.SetEndCapType(Far::PatchTableFactory::Options::ENDCAP_GREGORY_BASIS);
        refiner_->RefineAdaptive(options.GetRefineAdaptiveOptions());
        patches_.reset(Far::PatchTableFactory::Create(*refiner_, options));
        map_.reset(new Far::PatchMap(*patches_));
        ptex_.reset(new Far::PtexIndices(*refiner_));

        points_ = refined<R>(*refiner_, cage, false, patches_->GetNumLocalPoints());
        Rows<R> rows(cage.width, points_.data());
        if (patches_->GetNumLocalPoints()) {
            Rows<R> local = rows.from(refiner_->GetNumVerticesTotal());
            patches_->template GetLocalPointStencilTable<R>()->UpdateValues(rows, local);
        }
        if (!cage.fvar_width) return;
        fvar_points_ = refined<R>(*refiner_, cage, true, patches_->GetNumLocalPointsFaceVarying());
        Rows<R> fvar_rows(cage.fvar_width, fvar_points_.data());
        if (patches_->GetNumLocalPointsFaceVarying()) {
            Rows<R> local = fvar_rows.from(refiner_->GetNumFVarValuesTotal());
            patches_->template GetLocalPointFaceVaryingStencilTable<R>()->UpdateValues(fvar_rows, local);
        }
    }

    void answer(const Queries &queries, int i, Answers &answers) {
        const int w = answers.width, f = answers.fvar_width;
        const R u = R(queries.uv[2 * i]), v = R(queries.uv[2 * i + 1]);
        auto *handle = map_->FindPatch(ptex_->GetFaceId(queries.face[i]) + queries.sub[i], u, v);
        if (!handle) return;
        R p[20], du[20], dv[20];
        patches_->EvaluateBasis(*handle, u, v, p, du, dv);
        auto points = patches_->GetPatchVertices(*handle);
        Rows<R> rows(w, points_.data());
        combine(rows, points, p, w, &answers.p[size_t(i) * w]);
        // Derivatives on a sub-face come by the parameters of its polygon, in which it is half as wide.
        const R scale = patches_->GetPatchParam(*handle).NonQuadRoot() ? R(0.5) : R(1);
        combine(rows, points, du, w, &answers.du[size_t(i) * w], scale);
        combine(rows, points, dv, w, &answers.dv[size_t(i) * w], scale);
        if (!f) return;
        patches_->EvaluateBasisFaceVarying(*handle, u, v, p);
        Rows<R> fvar_rows(f, fvar_points_.data());
        combine(fvar_rows, patches_->GetPatchFVarValues(*handle), p, f, &answers.fvar[size_t(i) * f]);
    }

private:
    std::unique_ptr<Refiner> refiner_;
    std::unique_ptr<Far::PatchTable> patches_;
    std::unique_ptr<Far::PatchMap> map_;
    std::unique_ptr<Far::PtexIndices> ptex_;
    std::vector<R> points_, fvar_points_;
};

template <class R> class BfrSurface {
public:
    BfrSurface(const Cage &cage, const Arguments &a, const Queries &queries)
        : cage_(cage), refiner_(make_refiner(cage, a)), surface_(cage.face_count()), points_(cage.face_count()) {
        typename Bfr::RefinerSurfaceFactory<>::Options options;
        options.SetApproxLevelSmooth(a.number("level", 2));
        Bfr::RefinerSurfaceFactory<> factory(*refiner_, options);
        std::vector<R> values(cage.values.begin(), cage.values.end());
        for (int f : queries.face) {
            if (surface_[f].IsValid() || !factory.InitVertexSurface(f, &surface_[f])) continue;
            points_[f].resize(size_t(surface_[f].GetNumPatchPoints()) * cage.width);
            surface_[f].PreparePatchPoints(values.data(), cage.width, points_[f].data(), cage.width);
        }
    }

    void answer(const Queries &queries, int i, Answers &answers) {
        const int f = queries.face[i], w = cage_.width;
        if (points_[f].empty()) return;
        R uv[2] = {R(queries.uv[2 * i]), R(queries.uv[2 * i + 1])}, out[3][64];
        double scale = 1;
        auto parameters = surface_[f].GetParameterization();
        if (parameters.HasSubFaces()) {
            R on_sub_face[2] = {uv[0], uv[1]};
            parameters.ConvertNormalizedSubFaceToCoord(queries.sub[i], on_sub_face, uv);
            scale = 0.5;   // as for Far
        }
        surface_[f].Evaluate(uv, points_[f].data(), w, out[0], out[1], out[2]);
        for (int k = 0; k < w; ++k) {
            answers.p[size_t(i) * w + k] = out[0][k];
            answers.du[size_t(i) * w + k] = scale * out[1][k];
            answers.dv[size_t(i) * w + k] = scale * out[2][k];
        }
    }

private:
    const Cage &cage_;
    std::unique_ptr<Refiner> refiner_;
    std::vector<Bfr::Surface<R>> surface_;
    std::vector<std::vector<R>> points_;
};

// Faces of a level with what they are a part of: a face of the cage or a polygon's sub-face, and their corners' (u, v)
// on it.
struct Part {
    int face, sub;
    double corners[4][2];
};

static void set_middle(double *out, const double *a, const double *b) {
    for (int k = 0; k < 2; ++k) out[k] = (a[k] + b[k]) / 2;
}

static std::vector<Part> split(const std::vector<Part> &parents, const Far::TopologyLevel &level, int regular_size,
                               int child_count) {
    const double square[4][2] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};
    std::vector<Part> parts(child_count);
    for (int f = 0; f < int(parents.size()); ++f) {
        auto children = level.GetFaceChildFaces(f);
        const int size = level.GetFaceVertices(f).size();
        const Part &parent = parents[f];
        for (int c = 0; c < children.size(); ++c) {
            if (children[c] < 0) continue;
            Part &part = parts[children[c]] = parent;
            if (size != regular_size) {
                part.sub = c;
                std::memcpy(part.corners, square, sizeof square);
            } else if (size == 4) {
                // Child c lies at corner c, and each of its corners halfway from there.
                for (int k = 0; k < 4; ++k) set_middle(part.corners[k], parent.corners[c], parent.corners[k]);
            } else if (c < 3) {
                for (int k = 0; k < 3; ++k) set_middle(part.corners[k], parent.corners[c], parent.corners[k]);
            } else {
                for (int k = 0; k < 3; ++k)
                    set_middle(part.corners[k], parent.corners[(k + 1) % 3], parent.corners[(k + 2) % 3]);
            }
        }
    }
    return parts;
}

template <class R> class RefinedSurface {
public:
    RefinedSurface(const Cage &cage, const Arguments &a, const Queries &queries)
        : refiner_(make_refiner(cage, a)) {
        const int regular_size = refiner_->GetSchemeType() == Sdc::SCHEME_LOOP ? 3 : 4;
        Refiner::UniformOptions options(a.number("level", 6));
        options.fullTopologyInLastLevel = true;
        refiner_->RefineUniform(options);
        const int last = refiner_->GetMaxLevel();
        scale_ = std::ldexp(1.0, last);

        const double square[4][2] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}}, triangle[4][2] = {{0, 0}, {1, 0}, {0, 1}, {0, 0}};
        std::vector<Part> parts(cage.face_count());
        for (int f = 0; f < cage.face_count(); ++f) {
            parts[f] = {f, 0, {}};
            std::memcpy(parts[f].corners, regular_size == 4 ? square : triangle, sizeof square);
        }
        for (int i = 0; i < last; ++i)
            parts = split(parts, refiner_->GetLevel(i), regular_size, refiner_->GetLevel(i + 1).GetNumFaces());
        for (int i = 0; i < queries.count(); ++i)
            places_[key(queries.face[i], queries.sub[i], &queries.uv[2 * i])] = {-1, -1};
        const auto &level = refiner_->GetLevel(last), &base = refiner_->GetLevel(0);
        for (int f = 0; f < int(parts.size()); ++f) {
            const Part &part = parts[f];
            // A polygon that is not of the scheme's own size has parameters only after one refinement.
            if (base.IsFaceHole(part.face) || (last == 0 && cage.sizes[part.face] != regular_size)) continue;
            for (int k = 0; k < regular_size; ++k) {
                auto asked = places_.find(key(part.face, part.sub, part.corners[k]));
                if (asked == places_.end()) continue;
                asked->second = {level.GetFaceVertices(f)[k], cage.fvar_width ? level.GetFaceFVarValues(f)[k] : 0};
            }
        }

        auto points = refined<R>(*refiner_, cage, false, 0);
        int before = refiner_->GetNumVerticesTotal() - level.GetNumVertices();
        Rows<R> source = Rows<R>(cage.width, points.data()).from(before);
        for (auto *values : {&p_, &du_, &dv_}) values->resize(size_t(level.GetNumVertices()) * cage.width);
        Rows<R> p(cage.width, p_.data()), du(cage.width, du_.data()), dv(cage.width, dv_.data());
        Far::PrimvarRefinerReal<R> primvars(*refiner_);
        primvars.Limit(source, p, du, dv);
        if (!cage.fvar_width) return;
        auto fvar = refined<R>(*refiner_, cage, true, 0);
        before = refiner_->GetNumFVarValuesTotal() - level.GetNumFVarValues();
        Rows<R> fvar_source = Rows<R>(cage.fvar_width, fvar.data()).from(before);
        fvar_.resize(size_t(level.GetNumFVarValues()) * cage.fvar_width);
        Rows<R> fvar_limit(cage.fvar_width, fvar_.data());
        primvars.LimitFaceVarying(fvar_source, fvar_limit);
    }

    void answer(const Queries &queries, int i, Answers &answers) {
        auto found = places_.find(key(queries.face[i], queries.sub[i], &queries.uv[2 * i]));
        if (found->second.vertex < 0) return;
        const int w = answers.width, f = answers.fvar_width;
        const auto place = found->second;
        std::copy_n(&p_[size_t(place.vertex) * w], w, &answers.p[size_t(i) * w]);
        std::copy_n(&du_[size_t(place.vertex) * w], w, &answers.du[size_t(i) * w]);
        std::copy_n(&dv_[size_t(place.vertex) * w], w, &answers.dv[size_t(i) * w]);
        if (f) std::copy_n(&fvar_[size_t(place.fvar) * f], f, &answers.fvar[size_t(i) * f]);
        answers.vertex[i] = place.vertex;
        answers.rule[i] = refiner_->GetLevel(refiner_->GetMaxLevel()).GetVertexRule(place.vertex);
    }

private:
    struct Place { int vertex, fvar; };
    using Key = std::array<int64_t, 4>;

    Key key(int face, int sub, const double *uv) const {
        double u = uv[0] * scale_, v = uv[1] * scale_;
        // Between the vertices there is no value.
        if (u != std::floor(u) || v != std::floor(v)) return {-1, 0, 0, 0};
        return {face, sub, int64_t(u), int64_t(v)};
    }

    std::unique_ptr<Refiner> refiner_;
    double scale_;
    std::map<Key, Place> places_;
    std::vector<R> p_, du_, dv_, fvar_;
};

template <class R> void run_in(const Arguments &a, const Cage &cage, const Queries &queries, Answers &answers) {
    std::string method = a.text("method", "far");
    if (method == "far") run<FarSurface<R>>(a, cage, queries, answers);
    else if (method == "bfr") run<BfrSurface<R>>(a, cage, queries, answers);
    else if (method == "refine") run<RefinedSurface<R>>(a, cage, queries, answers);
    else fail("unknown --method " + method);
}

int main(int count, char **values) {
    Arguments arguments(count, values);
    Records records = Records::read(arguments.queries());
    Cage cage(records);
    Queries queries(records);
    if (std::max(cage.width, cage.fvar_width) > 64) fail("rows of more than 64 values");
    Answers answers(cage, queries.count());
    if (arguments.text("real", "double") == "float") run_in<float>(arguments, cage, queries, answers);
    else run_in<double>(arguments, cage, queries, answers);
    answers.write(arguments.answers());
}
