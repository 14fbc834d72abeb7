#pragma once

// Reads vectors of gaussians from the memory of models on the host. Included only by
// sources that are compiled once per instruction set.

#include <algorithm>

#include "frame/draw_list.h"
#include "math/gaussian.h"
#include "quantize/quantize_math.h"

namespace v3dg {
namespace V3DG_ISA {

// Reads gaussians from planes (one array per component).
template <class T>
struct PlaneSource {
    const GaussianPlanes<T>& m;

    // Loads a vector of gaussians that starts at row i. All lanes may be read, because
    // planes are padded.
    V3DG_INLINE Gaussian3d<Vec<T>> load_gaussians(uint64_t i, uint64_t) const {
        Gaussian3d<Vec<T>> g;
        for (int k = 0; k < 3; ++k) g.mean[k] = load(m.mean[k] + i);
        for (int k = 0; k < 4; ++k) g.quat[k] = load(m.quat[k] + i);
        for (int k = 0; k < 3; ++k) g.scale[k] = load(m.scale[k] + i);
        g.opacity = load(m.opacity + i);
        return g;
    }
    V3DG_INLINE int load_sh(uint64_t i, uint64_t, Vec<T>* sh) const {
        for (int k = 0; k < 3 * num_sh_bases(m.sh_degree); ++k) sh[k] = load(m.sh[k] + i);
        return m.sh_degree;
    }
};

// Reads the coded gaussians of one cluster. Lanes beyond the end of the cluster repeat
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
    V3DG_INLINE int load_sh(uint64_t i, uint64_t count, V* sh) const {
        Bits<V> words[2 * kMaxShDegree];
        Gaussian3d<V> g;
        load_words(codes.record_of(ranges, static_cast<uint32_t>(i)), kRecordWords, kRecordWords,
                   count, words);
        decode(words, ranges, g, sh);
        load_words(codes.sh_of(ranges, static_cast<uint32_t>(i)), num_sh_words(codes.sh_degree),
                   2 * codes.sh_stride, count, words);
        decode_sh(words, ranges.sh_step, codes.sh_degree, sh + 3);
        return codes.sh_degree;
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

// Loads the palette colours of gaussians `at`, `at` + 1, ... for the lanes whose bits
// are set in `kept`. Other lanes become 0.
template <class V>
V3DG_INLINE void load_palette(const Palette& palette, uint64_t at, unsigned kept, V sh[3]) {
    for (int k = 0; k < 3; ++k) sh[k] = V{};
    for (; kept != 0; kept &= kept - 1) {
        const int i = __builtin_ctz(kept);
        const float* color = palette.sh + 3 * static_cast<uint64_t>(palette.cluster_of(at + i));
        for (int k = 0; k < 3; ++k) sh[k][i] = static_cast<Lane<V>>(color[k]);
    }
}

// Calls body(source, first, count) for the part of each cluster in the coded rows
// [start, start + count).
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
