#pragma once

// Loads vectors of gaussians from the memory of models on the host. Only included by
// sources that are compiled once per instruction set.

#include <algorithm>

#include "frame/draw_list.h"
#include "math/gaussian.h"
#include "math/sh.h"
#include "project/project.h"
#include "quantize/quantize_math.h"

namespace v3dg {
namespace V3DG_ISA {

// Prefetches the cache lines in which row i begins, in all planes.
template <class T>
V3DG_INLINE void prefetch_row(const GaussianPlanes<T>& m, uint64_t i) {
    for (int k = 0; k < 3; ++k) __builtin_prefetch(m.mean[k] + i);
    for (int k = 0; k < 4; ++k) __builtin_prefetch(m.quat[k] + i);
    for (int k = 0; k < 3; ++k) __builtin_prefetch(m.scale[k] + i);
    __builtin_prefetch(m.opacity + i);
    for (int k = 0; k < 3 * num_sh_bases(m.sh_degree); ++k) __builtin_prefetch(m.sh[k] + i);
}

// Loads gaussians from planes (one array per component).
template <class T>
struct PlaneSource {
    const GaussianPlanes<T>& m;
    NextRun<T> next = {};

    // Prefetches gaussians that are needed soon. Row i of a run is being projected, and
    // the run has `left` rows from i on. Hardware prefetching is not enough: clusters
    // are short, and a processor recognises only a few of the many planes as streams.
    V3DG_INLINE void prefetch(uint64_t i, uint64_t left) const {
        constexpr uint64_t kRowsAhead = 64;
        if (left > kRowsAhead)
            prefetch_row(m, i + kRowsAhead);
        else if (next.model != nullptr)
            prefetch_row(*next.model, next.first + (kRowsAhead - left));
    }

    // Loads a vector of gaussians that starts at row i. Reading all lanes is safe,
    // because planes are padded.
    V3DG_INLINE Gaussian3d<Vec<T>> load_gaussians(uint64_t i, uint64_t) const {
        Gaussian3d<Vec<T>> g;
        for (int k = 0; k < 3; ++k) g.mean[k] = load(m.mean[k] + i);
        for (int k = 0; k < 4; ++k) g.quat[k] = load(m.quat[k] + i);
        for (int k = 0; k < 3; ++k) g.scale[k] = load(m.scale[k] + i);
        g.opacity = load(m.opacity + i);
        return g;
    }
    V3DG_INLINE void color_of(uint64_t i, uint64_t, const Vec<T> direction[3],
                              Vec<T> color[3]) const {
        color_of_coefficients(
            m.sh_degree, direction, [&](int k) { return load(m.sh[k] + i); }, color);
    }
};

// Loads the coded gaussians of one cluster. Lanes beyond the end of the cluster repeat
// its last gaussian.
struct CodeSource {
    using V = Vec<float>;

    const Codes& codes;
    const ClusterRanges& ranges;

    V3DG_INLINE Gaussian3d<V> load_gaussians(uint64_t i, uint64_t count) const {
        Bits<V> words[kRecordWords];
        load_words(codes.record_of(ranges, static_cast<uint32_t>(i)), kRecordWords, kRecordWords,
                   count, words);
        Gaussian3d<V> g;
        V color[3];
        decode(words, ranges, g, color);
        return g;
    }
    V3DG_INLINE void prefetch(uint64_t, uint64_t) const {}
    V3DG_INLINE void color_of(uint64_t i, uint64_t count, const V direction[3], V color[3]) const {
        V sh[3 * kMaxShBases];
        Bits<V> words[2 * kMaxShDegree];
        Gaussian3d<V> g;
        load_words(codes.record_of(ranges, static_cast<uint32_t>(i)), kRecordWords, kRecordWords,
                   count, words);
        decode(words, ranges, g, sh);
        load_words(codes.sh_of(ranges, static_cast<uint32_t>(i)), num_sh_words(codes.sh_degree),
                   2 * codes.sh_stride, count, words);
        decode_sh(words, ranges.sh_step, codes.sh_degree, sh + 3);
        color_of_sh(codes.sh_degree, direction, sh, color);
    }

  private:
    // Loads the first `width` words of each row. Rows begin `stride` words apart.
    static V3DG_INLINE void load_words(const uint32_t* rows, int width, uint64_t stride,
                                       uint64_t count, Bits<V>* words) {
        for (int lane = 0; lane < kLanes<float>; ++lane) {
            const uint64_t row = static_cast<uint64_t>(lane) < count ? lane : count - 1;
            for (int k = 0; k < width; ++k) words[k][lane] = rows[stride * row + k];
        }
    }
};

// Loads the palette colours of gaussians `at`, `at` + 1, ... into those lanes whose
// bits are set in `kept`. All other lanes become 0.
template <class V>
V3DG_INLINE void load_palette(const Palette& palette, uint64_t at, unsigned kept, V sh[3]) {
    for (int k = 0; k < 3; ++k) sh[k] = V{};
    for (; kept != 0; kept &= kept - 1) {
        const int i = __builtin_ctz(kept);
        const float* color = palette.sh + 3 * static_cast<uint64_t>(palette.cluster_of(at + i));
        for (int k = 0; k < 3; ++k) sh[k][i] = static_cast<Lane<V>>(color[k]);
    }
}

// Calls body(source, first, count) for the part of each cluster that is in the coded
// rows [start, start + count).
template <class Body>
V3DG_INLINE void for_clusters(const Codes& codes, uint64_t start, uint64_t count,
                              const Body& body) {
    const uint64_t end = start + count;
    uint64_t first = start;
    size_t cluster =
        std::upper_bound(codes.offset.begin(), codes.offset.end(), static_cast<int64_t>(start)) -
        codes.offset.begin() - 1;
    for (; first < end; ++cluster) {
        const uint64_t last = std::min(end, static_cast<uint64_t>(codes.offset[cluster + 1]));
        body(CodeSource{codes, codes.ranges_of(static_cast<uint32_t>(cluster))}, first,
             last - first);
        first = last;
    }
}

}  // namespace V3DG_ISA
}  // namespace v3dg
