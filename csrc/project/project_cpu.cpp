// Projection on the CPU, forward and backward. Each step processes a vector of
// gaussians. In the forward pass, the lanes are adjacent gaussians in memory. Compiled
// once per instruction set.

#include "project/project.h"

#include "math/instance_factors.h"
#include "project/host_sources.h"
#include "project/store_records.h"

namespace v3dg {
namespace V3DG_ISA {

// Returns the number of tiles that the pixels from `first` to `last` touch along one
// axis.
template <class I>
static V3DG_INLINE I tiles_of(I first, I last) {
    return last / kTileSize - first / kTileSize + 1;
}

// Writes the records of the gaussians `at` + k for which bit k of `lanes` is set.
template <class Source, class T, class V, class I>
static V3DG_INLINE void write_records(const Source& from, const Draw<T>& draw, uint64_t at,
                                      uint64_t count, unsigned lanes, const Gaussian3d<V>& g,
                                      const Ellipse<V>& e, const PixelBox<I>& box,
                                      Record<T>* records) {
    V direction[3], color[3];
    from_eye(draw.view, g.mean, direction);
    if (draw.palette.sh != nullptr) {
        V sh[3];
        load_palette(draw.palette, at, lanes, sh);
        color_of_sh(0, direction, sh, color);
    } else {
        from.color_of(at, count, direction, color);
        if (draw.color_factors != nullptr) tint(draw.color_factors, color);
    }
    store_records(lanes, count, e, color, box, records);
}

// Implements project() for one source. `first` is the row of the first gaussian.
template <class Source, class T, ProjectingModel C>
static size_t project_rows(const Source& from, const Draw<T>& draw, uint64_t first, uint64_t count,
                           const C& model, const Window& window, Record<T>* records,
                           uint32_t* source, uint32_t source_base, Reach& reach) {
    // Of a copy, the compiler knows that writing records does not change it.
    const C camera = model;
    using V = Vec<T>;
    using I = decltype(V{} < V{});
    constexpr int kWidth = kLanes<T>;
    constexpr uint64_t kLineRows = 64 / sizeof(T);
    I top = I{} + INT_MAX, bottom = I{} - 1, entries = I{};
    size_t num_records = 0;
    for (uint64_t done = 0; done < count; done += kWidth) {
        const uint64_t at = first + done;
        const unsigned lanes =
            count - done >= kWidth ? (1u << kWidth) - 1 : (1u << (count - done)) - 1;
        // A vector may be shorter than a cache line.
        if (done % kLineRows == 0) from.prefetch(at, count - done);
        const Gaussian3d<V> g = from.load_gaussians(at, count - done);
        Projection<V, C> s;
        to_view(draw.view, g.mean, s.p);
        const auto in_front = camera.depth_of(s.p) >= all_lanes<V>(camera.near_depth);
        if ((bits_of(in_front) & lanes) == 0) continue;
        Ellipse<V> e = project_gaussian(g, draw.view, camera, draw.appearance.filter_px2,
                                        draw.appearance.antialiased, s, draw.appearance.is_limited);
        if (draw.weight < 1) fade(draw.weight, e);

        V half_x, half_y;
        const auto drawable = in_front & extent_of(g.opacity, e, s, half_x, half_y);
        const auto meets = drawable & meets_image(e.u, half_x, camera.width) &
                           meets_image(e.v, half_y, camera.height);
        const unsigned meets_bits = bits_of(meets) & lanes;
        reach.in_frustum += __builtin_popcount(meets_bits);
        if (meets_bits == 0) continue;

        PixelBox<I> box = pixel_box(e, half_x, half_y, camera);
        const auto drawn = meets & box.holds_pixels();
        const unsigned drawn_bits = bits_of(drawn) & lanes;
        reach.drawn += __builtin_popcount(drawn_bits);
        top = min_of(top, drawn ? box.y0 : top);
        bottom = max_of(bottom, drawn ? box.y1 : bottom);
        // The mask is applied before the multiplication, because the boxes of gaussians
        // that are not drawn can be so large that the product overflows.
        const I columns = drawn ? tiles_of(box.x0, box.x1) : I{},
                rows = drawn ? tiles_of(box.y0, box.y1) : I{};
        entries += columns * rows;

        box.x0 = max_of(box.x0, I{} + window.x0), box.x1 = min_of(box.x1, I{} + (window.x1 - 1));
        box.y0 = max_of(box.y0, I{} + window.y0), box.y1 = min_of(box.y1, I{} + (window.y1 - 1));
        const unsigned kept = drawn_bits & bits_of(box.holds_pixels());
        if (kept == 0) continue;

        if (source != nullptr)
            for (unsigned left = kept; left != 0; left &= left - 1)
                source[num_records + __builtin_popcount(kept) - __builtin_popcount(left)] =
                    source_base + static_cast<uint32_t>(done) + __builtin_ctz(left);
        write_records(from, draw, at, count - done, kept, g, e, box, records + num_records);
        num_records += __builtin_popcount(kept);
    }
    for (int i = 0; i < kWidth; ++i) {
        reach.top = min_of(reach.top, static_cast<int>(top[i]));
        reach.bottom = max_of(reach.bottom, static_cast<int>(bottom[i]));
        reach.entries += static_cast<uint64_t>(entries[i]);
    }
    return num_records;
}

// Implements project() for codes, one cluster after another.
template <ProjectingModel C>
static size_t project_codes(const Draw<float>& draw, uint64_t skip, uint64_t count, const C& camera,
                            const Window& window, Record<float>* records, uint32_t* source,
                            uint32_t source_base, Reach& reach) {
    const uint64_t start = draw.first + skip;
    size_t num_records = 0;
    for_clusters(
        *draw.codes, start, count, [&](const CodeSource& codes, uint64_t first, uint64_t size) {
            num_records +=
                project_rows(codes, draw, first, size, camera, window, records + num_records,
                             source == nullptr ? nullptr : source + num_records,
                             source_base + static_cast<uint32_t>(first - start), reach);
        });
    return num_records;
}

template <class T>
size_t project(const Draw<T>& draw, uint64_t skip, uint64_t count, const Intrinsics<T>& camera,
               const Window& window, Record<T>* records, uint32_t* source, uint32_t source_base,
               Reach& reach, const NextRun<T>& next) {
    return camera.visit([&](const auto& model) {
        if constexpr (std::is_same<T, float>::value)
            if (draw.codes != nullptr)
                return project_codes(draw, skip, count, model, window, records, source, source_base,
                                     reach);
        return project_rows(PlaneSource<T>{*draw.model, next}, draw, draw.first + skip, count,
                            model, window, records, source, source_base, reach);
    });
}

// What the backward pass does with gradients: it stores them, or adds them to sums over
// views, without or with those of the pose.
enum class Backward { stores, adds, adds_with_pose };

template <Backward kWhat, class T>
static void put(T value, T& out) {
    if constexpr (kWhat == Backward::stores)
        out = value;
    else
        out += value;
}

template <class V, class T>
static void add_lanes(const PoseSums<V>& d, size_t lanes, PoseSums<T>& sums) {
    for (size_t i = 0; i < lanes; ++i) {
        for (int k = 0; k < 9; ++k) sums.linear[k] += d.linear[k][i];
        for (int k = 0; k < 3; ++k) sums.shift[k] += d.shift[k][i];
        for (int k = 0; k < 3; ++k) sums.direction[k] += d.direction[k][i];
    }
}

// Fill the lanes one by one, because the gaussians of adjacent records are scattered in
// memory. Filling costs little compared to the arithmetic.
template <Backward kWhat, class T, ProjectingModel C>
static void project_backward_by(const C& model, const Draw<T>& draw, const uint32_t* source,
                                const RecordGradient<T>* d_records, size_t count,
                                const GaussianRows<T>& out, PoseSums<double>* pose) {
    constexpr bool kWithPose = kWhat == Backward::adds_with_pose;
    using V = Vec<T>;
    constexpr size_t kWidth = kLanes<T>;
    const GaussianPlanes<T>& m = *draw.model;
    const int num_sh = 3 * num_sh_bases(m.sh_degree);
    for (size_t done = 0; done < count; done += kWidth) {
        const size_t lanes = count - done < kWidth ? count - done : kWidth;
        Gaussian3d<V> g{};
        V sh[3 * kMaxShBases] = {};
        Ellipse<V> d{};
        V d_color[3] = {};
        for (size_t i = 0; i < kWidth; ++i) {
            // Unused lanes repeat the first gaussian; their gradients are zero.
            const size_t at = done + (i < lanes ? i : 0);
            const uint64_t s = draw.first + source[at];
            for (int k = 0; k < 3; ++k) g.mean[k][i] = m.mean[k][s];
            for (int k = 0; k < 4; ++k) g.quat[k][i] = m.quat[k][s];
            for (int k = 0; k < 3; ++k) g.scale[k][i] = m.scale[k][s];
            g.opacity[i] = m.opacity[s];
            for (int k = 0; k < num_sh; ++k) sh[k][i] = m.sh[k][s];
            if (i >= lanes) continue;
            const RecordGradient<T>& r = d_records[at];
            d.u[i] = r.ellipse.u;
            d.v[i] = r.ellipse.v;
            d.l11[i] = r.ellipse.l11;
            d.l12[i] = r.ellipse.l12;
            d.l22[i] = r.ellipse.l22;
            d.log2_opacity[i] = r.ellipse.log2_opacity;
            d.depth[i] = r.ellipse.depth;
            for (int c = 0; c < 3; ++c) d_color[c][i] = r.color[c];
        }
        V d_point[3], d_axes[9], d_direction[3] = {};
        const auto camera = probed<kWithPose>(model, d_point, d_axes);
        Projection<V, std::remove_const_t<decltype(camera)>> s;
        to_view(draw.view, g.mean, s.p);
        const Ellipse<V> e = project_gaussian(g, draw.view, camera, draw.appearance.filter_px2,
                                              draw.appearance.antialiased, s);
        V direction[3], color[3], d_sh[3 * kMaxShBases];
        from_eye(draw.view, g.mean, direction);
        color_of_sh(m.sh_degree, direction, sh, color);
        Gaussian3d<V> d_g = project_gaussian_vjp(g, draw.view, camera, draw.appearance.filter_px2,
                                                 draw.appearance.antialiased, s, e, d);
        color_of_sh_vjp(m.sh_degree, direction, sh, color, d_color,
                        kWithPose ? d_direction : d_g.mean, d_sh);
        if constexpr (kWithPose) {
            for (int k = 0; k < 3; ++k) d_g.mean[k] += d_direction[k];
            PoseSums<V> d_pose;
            pose_vjp(g, draw.view, d_point, d_axes, d_direction, d_pose);
            add_lanes(d_pose, lanes, *pose);
        }
        for (size_t i = 0; i < lanes; ++i) {
            const uint64_t at = source[done + i];
            for (int k = 0; k < 3; ++k) put<kWhat>(d_g.mean[k][i], out.means[3 * at + k]);
            for (int k = 0; k < 4; ++k) put<kWhat>(d_g.quat[k][i], out.quats[4 * at + k]);
            for (int k = 0; k < 3; ++k) put<kWhat>(d_g.scale[k][i], out.scales[3 * at + k]);
            put<kWhat>(d_g.opacity[i], out.opacities[at]);
            for (int k = 0; k < num_sh; ++k) put<kWhat>(d_sh[k][i], out.sh[num_sh * at + k]);
        }
    }
}

template <class T>
void project_backward(const Draw<T>& draw, const uint32_t* source,
                      const RecordGradient<T>* d_records, size_t count, const Intrinsics<T>& camera,
                      const GaussianRows<T>& out) {
    camera.visit([&](const auto& model) {
        project_backward_by<Backward::stores>(model, draw, source, d_records, count, out, nullptr);
    });
}

template <class T>
void add_project_backward(const Draw<T>& draw, const uint32_t* source,
                          const RecordGradient<T>* d_records, size_t count,
                          const Intrinsics<T>& camera, const GaussianRows<T>& out,
                          PoseSums<double>* pose) {
    camera.visit([&](const auto& model) {
        if (pose == nullptr)
            project_backward_by<Backward::adds>(model, draw, source, d_records, count, out, pose);
        else
            project_backward_by<Backward::adds_with_pose>(model, draw, source, d_records, count,
                                                          out, pose);
    });
}

#define V3DG_INSTANTIATE(T)                                                                       \
    template size_t project<T>(const Draw<T>&, uint64_t, uint64_t, const Intrinsics<T>&,          \
                               const Window&, Record<T>*, uint32_t*, uint32_t, Reach&,            \
                               const NextRun<T>&);                                                \
    template void project_backward<T>(const Draw<T>&, const uint32_t*, const RecordGradient<T>*,  \
                                      size_t, const Intrinsics<T>&, const GaussianRows<T>&);      \
    template void add_project_backward<T>(const Draw<T>&, const uint32_t*,                        \
                                          const RecordGradient<T>*, size_t, const Intrinsics<T>&, \
                                          const GaussianRows<T>&, PoseSums<double>*);
V3DG_INSTANTIATE(float)
V3DG_INSTANTIATE(double)
#undef V3DG_INSTANTIATE

}  // namespace V3DG_ISA
}  // namespace v3dg
