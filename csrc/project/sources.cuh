#pragma once

// The sources from which the projection kernels read gaussians: rows, packed planes, or
// codes.
//
// A source computes a gaussian in steps, because most gaussians reach no pixel centre
// and only need the first steps. fetch() loads the data of the bounding sphere.
// sphere() returns the mean and the radius. project() returns the ellipse and the
// colour; p of the Projection must be set. shade() replaces the colour; it is called if
// has_shade() is true. The kernel then applies the factors of instances.

#include "base/launch.cuh"
#include "project/project_cuda.h"
#include "project/project_math.h"

namespace v3dg {
namespace cuda {

// The tables of one item: its placement, image and model.
template <class Model>
struct ItemTables {
    alignas(16) Placement placement;
    alignas(16) FrameImage image;
    alignas(16) Model model;
    DrawItem item;
    SlopeLimits<float> limits;  // limits of the image's camera
};

// Returns the camera of the image as a model. It is a pinhole camera if all images have
// one, and otherwise Intrinsics.
template <class C, class Model>
__device__ const C& camera_as(const ItemTables<Model>& in) {
    return in.image.camera;
}

__device__ inline float4 load4(const float* rows, uint32_t row) {
    return __ldg(reinterpret_cast<const float4*>(rows) + row);
}

// Computes `color` for the view direction. sh(k) returns the k-th coefficient, as in
// color_of_coefficients().
template <int kDegree, class Coefficient>
__device__ void color_of(const Coefficient& sh, const float mean[3], const ModelView<float>& view,
                         float color[3]) {
    float direction[3];
    from_eye(view, mean, direction);
    color_of_coefficients(kDegree, direction, sh, color);
}

// Like color_of(), but for coefficients in memory. Each coefficient is loaded just
// before its use, because registers cannot hold all of them.
template <int kDegree>
__device__ void color_of_row(const float* row, const float mean[3], const ModelView<float>& view,
                             float color[3]) {
    constexpr int kSize = 3 * num_sh_bases(kDegree);
    float4 four{};
    const auto coefficient = [&](int k) {
        if (kSize % 4 != 0) return __ldg(row + k);
        if (k % 4 == 0) four = load4(row, k / 4);
        return k % 4 == 0 ? four.x : k % 4 == 1 ? four.y : k % 4 == 2 ? four.z : four.w;
    };
    color_of<kDegree>(coefficient, mean, view, color);
}

// The base class of sources that have a row for each gaussian.
template <class RowModel>
struct OfRows {
    using Model = RowModel;
    using Fetched = float4;
    struct Place {};  // not needed, because rows are addressed directly
    static constexpr bool kFades = false;
    static constexpr bool kTints = false;
    static constexpr bool kPlaces = false;

    static __device__ Place start(const ItemTables<Model>&) { return {}; }
    static __device__ void prepare() {}
    static __device__ float4 sphere(const Model&, Place&, uint32_t, const float4& fetched) {
        return fetched;
    }
};

// Reads unpacked gaussians from the caller's memory.
struct RowSource : OfRows<GaussianRows<const float>> {
    static __device__ bool has(const Model&) { return true; }
    static __device__ bool has_shade(const Model& m) { return m.sh_degree > 0; }
    static __device__ float4 fetch(const Model& m, uint32_t g) {
        Gaussian3d<float> gaussian{
            {__ldg(m.means + 3 * size_t(g)), __ldg(m.means + 3 * size_t(g) + 1),
             __ldg(m.means + 3 * size_t(g) + 2)},
            {1, 0, 0, 0},
            {},
            __ldg(m.opacities + g)};
        for (int k = 0; k < 3; ++k) gaussian.scale[k] = __ldg(m.scales + 3 * size_t(g) + k);
        return {gaussian.mean[0], gaussian.mean[1], gaussian.mean[2], reach_of(gaussian)};
    }
    template <class C>
    static __device__ Ellipse<float> project(const ItemTables<Model>& in,
                                             const ModelView<float>& view, Place&, uint32_t g,
                                             Projection<float, C>& s, float color[3]) {
        const GaussianRows<const float>& m = in.model;
        Gaussian3d<float> gaussian{{}, {}, {}, __ldg(m.opacities + g)};
        for (int k = 0; k < 3; ++k) gaussian.scale[k] = __ldg(m.scales + 3 * size_t(g) + k);
        const float4 quat = load4(m.quats, g);
        gaussian.quat[0] = quat.x;
        gaussian.quat[1] = quat.y;
        gaussian.quat[2] = quat.z;
        gaussian.quat[3] = quat.w;
        const float* sh = m.sh + 3 * size_t(g);  // used only for degree 0
        if (m.sh_degree == 0)
            color_of_row<0>(sh, gaussian.mean, view, color);
        else if (m.sh_degree == kPlainColor)
            color_of_row<kPlainColor>(sh, gaussian.mean, view, color);
        const Appearance<float>& look = in.item.appearance;
        return project_gaussian(gaussian, view, camera_as<C>(in), look.filter_px2, look.antialiased,
                                s, look.is_limited);
    }
    static __device__ void shade(const Model& m, const ModelView<float>& view, const Place&,
                                 uint32_t g, float color[3]) {
        shade_row(m.sh + size_t(g) * m.num_sh(), m.sh_degree, fetch(m, g), view, color);
    }
    static __device__ void shade_row(const float* row, int sh_degree, const float4& sphere,
                                     const ModelView<float>& view, float color[3]) {
        const float mean[3] = {sphere.x, sphere.y, sphere.z};
        switch (sh_degree) {
            case 1: color_of_row<1>(row, mean, view, color); break;
            case 2: color_of_row<2>(row, mean, view, color); break;
            default: color_of_row<3>(row, mean, view, color);
        }
    }
};

// Reads packed gaussians. This is the fastest source.
struct PackedSource : OfRows<PackedPlanes> {
    static __device__ bool has(const Model& m) { return m.plane[0] != nullptr; }
    static __device__ bool has_palette(const Model& m) { return m.palette.sh != nullptr; }
    static __device__ bool has_shade(const Model& m) {
        return m.palette.sh != nullptr || m.sh_degree > 0;
    }
    static __device__ float4 fetch(const Model& m, uint32_t g) { return load4(m.plane[0], g); }
    template <class C>
    static __device__ Ellipse<float> project(const ItemTables<Model>& in,
                                             const ModelView<float>& view, Place&, uint32_t g,
                                             Projection<float, C>& s, float color[3]) {
        const PackedPlanes& m = in.model;
        const float4 a = load4(m.plane[1], g), b = load4(m.plane[2], g), c = load4(m.plane[3], g);
        color[0] = c.y;
        color[1] = c.z;
        color[2] = c.w;
        const PackedGaussian gaussian{{}, 0.0f, {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w}, c.x};
        return project_packed(gaussian, view, camera_as<C>(in), in.limits, in.item.appearance, s);
    }
    static __device__ void shade(const Model& m, const ModelView<float>& view, const Place&,
                                 uint32_t g, float color[3]) {
        const float anywhere[3] = {0, 0, 0};
        if (m.palette.sh != nullptr)
            color_of_row<0>(m.palette.sh + 3 * size_t(m.palette.cluster_of(g)), anywhere, view,
                            color);
        else
            RowSource::shade_row(m.sh + size_t(g) * m.sh_stride, m.sh_degree, fetch(m, g), view,
                                 color);
    }
};

// Reads coded gaussians. The results have the same bits as if the codes were decoded to
// rows and then packed.
struct CodeSource {
    using Model = CodedGaussians;
    using Fetched = uint4;
    static constexpr bool kFades = false;
    static constexpr bool kTints = false;
    static constexpr bool kPlaces = false;
    struct Place {
        // Cluster of the current row, and the end of that cluster's rows.
        uint32_t cluster, end;
    };
    // Values that only depend on the code of the opacity. They are stored in a table.
    struct OpacityEntry {
        float reach_in_sigmas, log2_opacity;
    };

    static __device__ bool has(const Model& m) { return m.codes.records != nullptr; }
    static __device__ bool has_palette(const Model& m) { return m.palette.sh != nullptr; }
    static __device__ bool has_shade(const Model& m) {
        return m.palette.sh != nullptr || m.codes.sh_degree > 0;
    }
    static __device__ OpacityEntry* opacity_table() {
        __shared__ OpacityEntry entries[kMostOpacity + 1];
        return entries;
    }
    // Fills the table of OpacityEntry. All threads of the block must call it.
    static __device__ void prepare() {
        for (unsigned code = threadIdx.x; code <= kMostOpacity; code += blockDim.x) {
            const float opacity = static_cast<float>(code) * kOpacityStep;
            opacity_table()[code] = {reach_in_sigmas(opacity), log2_of(opacity)};
        }
        __syncthreads();
    }
    // Returns the place of the item's first gaussian. All lanes of the warp must call
    // it.
    static __device__ Place start(const ItemTables<Model>& in) {
        const Span<const int64_t>& offset = in.model.codes.offset;
        const uint32_t next = in.item.cluster + 1 + threadIdx.x % 32;
        const bool is_before = threadIdx.x % 32 < kItemClusters && next < offset.size &&
                               static_cast<uint32_t>(__ldg(offset.data + next)) <= in.item.first;
        const uint32_t cluster = in.item.cluster + __popc(__ballot_sync(kAllLanes, is_before));
        return {cluster, static_cast<uint32_t>(__ldg(offset.data + cluster + 1))};
    }
    // Advances the place to the cluster of row g. Rows must not decrease from call to
    // call.
    static __device__ void advance(const Model& m, Place& place, uint32_t g) {
        while (g >= place.end)
            place.end = static_cast<uint32_t>(__ldg(m.codes.offset.data + ++place.cluster + 1));
    }
    static __device__ uint4 fetch(const Model& m, uint32_t g) {
        return __ldg(reinterpret_cast<const uint4*>(m.codes.records) + g);
    }
    static __device__ Gaussian3d<float> decoded(const Model& m, uint32_t cluster,
                                                const uint4& record, float color[3]) {
        const uint32_t words[kRecordWords] = {record.x, record.y, record.z, record.w};
        const auto* at = reinterpret_cast<const float*>(&m.codes.ranges_of(cluster));
        const float4 mean_first = load4(at, 0), mean_step = load4(at, 1), a = load4(at, 2),
                     b = load4(at, 3);
        const ClusterRanges ranges{{mean_first.x, mean_first.y, mean_first.z},
                                   __float_as_uint(mean_first.w),
                                   {mean_step.x, mean_step.y, mean_step.z},
                                   __float_as_uint(mean_step.w),
                                   {a.x, a.y, a.z},
                                   {a.w, b.x, b.y},
                                   0,
                                   0,
                                   {}};
        Gaussian3d<float> g;
        decode(words, ranges, g, color);
        return g;
    }
    static __device__ float4 sphere(const Model& m, Place& place, uint32_t g, const uint4& record) {
        advance(m, place, g);
        float color[3];
        const Gaussian3d<float> gaussian = decoded(m, place.cluster, record, color);
        const float sigmas = opacity_table()[record.x >> 24].reach_in_sigmas;
        const float most = max_of(gaussian.scale[0], max_of(gaussian.scale[1], gaussian.scale[2]));
        return {gaussian.mean[0], gaussian.mean[1], gaussian.mean[2],
                sigmas < 0 ? -1.0f : most * sigmas};
    }
    template <class C>
    static __device__ Ellipse<float> project(const ItemTables<Model>& in,
                                             const ModelView<float>& view, Place& place, uint32_t g,
                                             Projection<float, C>& s, float color[3]) {
        const uint4 record = fetch(in.model, g);
        advance(in.model, place, g);
        float sh[3];
        const Gaussian3d<float> gaussian = decoded(in.model, place.cluster, record, sh);
        color_of_sh(0, gaussian.mean, sh, color);
        PackedGaussian packed = pack_gaussian(gaussian);
        packed.log2_opacity = opacity_table()[record.x >> 24].log2_opacity;
        return project_packed(packed, view, camera_as<C>(in), in.limits, in.item.appearance, s);
    }
    static __device__ void shade(const Model& m, const ModelView<float>& view, const Place& place,
                                 uint32_t g, float color[3]) {
        const float anywhere[3] = {0, 0, 0};
        if (m.palette.sh != nullptr) {
            color_of_row<0>(m.palette.sh + 3 * size_t(place.cluster), anywhere, view, color);
            return;
        }
        switch (m.codes.sh_degree) {
            case 1: shade_codes<1>(m, view, place, g, color); break;
            case 2: shade_codes<2>(m, view, place, g, color); break;
            default: shade_codes<3>(m, view, place, g, color);
        }
    }
    template <int kDegree>
    static __device__ void shade_codes(const Model& m, const ModelView<float>& view,
                                       const Place& place, uint32_t g, float color[3]) {
        float sh[3 * num_sh_bases(kDegree)], step[3 * kDegree];
        const Gaussian3d<float> gaussian = decoded(m, place.cluster, fetch(m, g), sh);
        uint32_t words[num_sh_words(kDegree)];
#pragma unroll
        for (int k = 0; k < kDegree; ++k) {
            const uint2 pair = __ldg(reinterpret_cast<const uint2*>(m.codes.sh) +
                                     m.codes.sh_stride * size_t(g) + k);
            words[2 * k] = pair.x;
            words[2 * k + 1] = pair.y;
        }
#pragma unroll
        for (int k = 0; k < 3 * kDegree; ++k)
            step[k] = __ldg(m.codes.ranges_of(place.cluster).sh_step + k);
        decode_sh<float>(words, step, kDegree, sh + 3);
        color_of<kDegree>([&](int k) { return sh[k]; }, gaussian.mean, view, color);
    }
};

// A source for frames in which instances have factors of colours or opacities.
template <class Source>
struct Tinted : Source {
    static constexpr bool kTints = true;
};

// A source for shared items in frames that need the placement of each record.
template <class Source>
struct Placing : Source {
    static constexpr bool kPlaces = true;
};

// A source for frames in which items have weights below 1.
template <class Source>
struct Faded : Source {
    static constexpr bool kFades = true;

    template <class C>
    static __device__ Ellipse<float> project(const ItemTables<typename Source::Model>& in,
                                             const ModelView<float>& view,
                                             typename Source::Place& place, uint32_t g,
                                             Projection<float, C>& s, float color[3]) {
        Ellipse<float> e = Source::project(in, view, place, g, s, color);
        fade(in.item.weight, e);
        return e;
    }
};

}  // namespace cuda
}  // namespace v3dg
