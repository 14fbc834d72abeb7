// Blends one tile, and computes the gradients of its records. Runs on a single CPU
// thread.

#include "rasterize/rasterize.h"

#include "rasterize/simd_blend.h"

namespace v3dg {
namespace V3DG_ISA {

template <class T, Extra kExtra, class Stop>
static void blend_entries(const Record<T>* records, EntryFormat format, const uint64_t* entry,
                          size_t count, int left, int top, const Window& window, Stop stop,
                          TilePlanes<T>& tile) {
    blend_tile<T, kExtra>(count, left, top, window, stop, tile, [&](size_t i) {
        return Listed<T>{records + format.record_of(entry[i]), EntryFormat::blocks_of(entry[i])};
    });
}

template <class T>
void rasterize_tile(const Record<T>* records, EntryFormat format, const uint64_t* entry,
                    size_t count, int left, int top, const Picture<T>& picture) {
    TilePlanes<T> tile;
    with_stop<T>(picture.min_transmittance, [&](auto stop) {
        if (picture.count != nullptr)
            blend_entries<T, Extra::kCount>(records, format, entry, count, left, top,
                                            picture.window, stop, tile);
        else if (picture.depth != nullptr)
            blend_entries<T, Extra::kDepth>(records, format, entry, count, left, top,
                                            picture.window, stop, tile);
        else
            blend_entries<T, Extra::kNothing>(records, format, entry, count, left, top,
                                              picture.window, stop, tile);
    });
    for_each_pixel(left, top, picture.window, [&](int p, size_t out) {
        const Finished<T> pixel = finished(tile.transmittance[p], picture.min_transmittance);
        const T alpha = 1 - pixel.transmittance;
        for (int c = 0; c < 3; ++c)
            picture.color[picture.color_step * out + c] =
                pixel.gain * tile.color[c][p] + pixel.transmittance * picture.background[c];
        if (picture.alpha != nullptr) picture.alpha[picture.alpha_step * out] = alpha;
        if (picture.count != nullptr)
            picture.count[out] = tile.extra[p];
        else if (picture.depth != nullptr)
            picture.depth[out] = alpha > 0 ? pixel.gain * tile.extra[p] / alpha : T(0);
    });
}

template <class T, bool kWithDepth, bool kWithSize>
static void backward(const Record<T>* records, EntryFormat format, const uint64_t* entry,
                     size_t count, int left, int top, const Picture<T>& picture,
                     const PictureGradient<T>& d_picture, RecordGradient<T>* d_entry,
                     CenterSize<T>* size, T* d_background) {
    TilePlanes<T> tile;
    constexpr Extra kExtra = kWithDepth ? Extra::kDepth : Extra::kNothing;
    blend_entries<T, kExtra>(records, format, entry, count, left, top, picture.window,
                             StopsBefore{}, tile);
    TileGradient<T> grad = {};
    for_each_pixel(left, top, picture.window, [&](int p, size_t out) {
        const T t = tile.transmittance[p] < 0 ? -tile.transmittance[p] : tile.transmittance[p];
        T d_weight = d_picture.alpha[out], total = 0;
        for (int c = 0; c < 3; ++c) {
            const T d = d_picture.color[3 * out + c];
            grad.d_color[c][p] = d;
            d_weight -= d * picture.background[c];
            total += d * tile.color[c][p];
            d_background[c] += d * t;
        }
        if (kWithDepth && t < 1) {
            const T d = d_picture.depth[out] / (1 - t);
            grad.d_depth[p] = d;
            d_weight -= d * tile.extra[p] / (1 - t);
            total += d * tile.extra[p];
        }
        grad.d_weight[p] = d_weight;
        grad.total[p] = total + d_weight * (1 - t);
    });
    // Records are prefetched this far ahead, so that they arrive in time.
    constexpr size_t kPrefetch = 48;
    const BlockPixels<T> pixels;
    uint64_t alive = clear_tile(tile, left, top, picture.window, Extra::kNothing);
    for (size_t i = 0; i < count && alive != 0; ++i) {
        if (i + kPrefetch < count)
            prefetch_record(records + format.record_of(entry[i + kPrefetch]));
        const Record<T>& g = records[format.record_of(entry[i])];
        const uint64_t blocks =
            blocks_of_ellipse(g, left, top, EntryFormat::blocks_of(entry[i]) & alive);
        if (blocks != 0)
            blend_record_vjp<T, kWithDepth, kWithSize>(g, blocks, left, top, pixels, grad, tile,
                                                       alive, d_entry[i],
                                                       kWithSize ? size + i : nullptr);
    }
}

template <class T>
void rasterize_tile_backward(const Record<T>* records, EntryFormat format, const uint64_t* entry,
                             size_t count, int left, int top, const Picture<T>& picture,
                             const PictureGradient<T>& d_picture, RecordGradient<T>* d_entry,
                             CenterSize<T>* size, T* d_background) {
    const bool with_depth = d_picture.depth != nullptr;
    const auto run = size != nullptr
                         ? with_depth ? &backward<T, true, true> : &backward<T, false, true>
                     : with_depth ? &backward<T, true, false>
                                  : &backward<T, false, false>;
    run(records, format, entry, count, left, top, picture, d_picture, d_entry, size, d_background);
}

#define V3DG_INSTANTIATE(T)                                                                      \
    template void rasterize_tile<T>(const Record<T>*, EntryFormat, const uint64_t*, size_t, int, \
                                    int, const Picture<T>&);                                     \
    template void rasterize_tile_backward<T>(                                                    \
        const Record<T>*, EntryFormat, const uint64_t*, size_t, int, int, const Picture<T>&,     \
        const PictureGradient<T>&, RecordGradient<T>*, CenterSize<T>*, T*);
V3DG_INSTANTIATE(float)
V3DG_INSTANTIATE(double)
#undef V3DG_INSTANTIATE

}  // namespace V3DG_ISA
}  // namespace v3dg
