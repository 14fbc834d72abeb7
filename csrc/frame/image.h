#pragma once

// The pictures that a frame draws, and their tiles.

#include <cstdint>

#include "camera/camera.h"
#include "math/lanes.h"

namespace v3dg {

constexpr int kTileSize = 32;  // px; the CPU draws pictures tile by tile

// The pixels [x0, x1) x [y0, y1) of a picture.
struct Window {
    int x0, y0, x1, y1;
    V3DG_INLINE int width() const { return x1 - x0; }
    V3DG_INLINE int height() const { return y1 - y0; }
    V3DG_INLINE bool contains(int x, int y) const { return x0 <= x && x < x1 && y0 <= y && y < y1; }
};

// The rule by which a pixel stops when its transmittance is low, and ignores everything
// behind. Like gsplat, it stops before a gaussian that would leave a transmittance of
// kMinTransmittance or less; this gaussian is not blended.
struct StopsBefore {};
// The rule by which a pixel stops after the gaussian that leaves this transmittance or
// less. The remaining transmittance is distributed in proportion over the gaussians
// that were blended. So the error of a channel is at most this fraction of the
// difference between the blended colour and the colour behind.
template <class T>
struct StopsBehind {
    T transmittance;
};

// The value of `min_transmittance` that selects StopsBefore; and the value that selects
// StopsBehind with the transmittance that stop_of_tolerance() returns for the cut. Both
// are negative; other values select StopsBehind.
constexpr float kStopsBefore = -1.0f, kStopsByCut = -2.0f;

// Returns the transmittance behind which pixels of a cut stop. Up to the default
// tolerance, where level 0 may be all that is drawn, it is that of kMinTransmittance,
// with which assets are drawn. It grows with the square of the tolerance to a
// thousandth, which costs nothing visible in cuts of 9.5 px² a gaussian or more.
V3DG_HD inline float stop_of_tolerance(float tolerance_px2) {
    constexpr float kLeast = 1e-4f, kMost = 1e-3f, kLeastTolerance = 3;
    const float ratio = tolerance_px2 / kLeastTolerance;
    return min_of(max_of(kLeast * (ratio * ratio), kLeast), kMost);
}

// Returns `min_transmittance`, for a cut of a tolerance if it is kStopsByCut.
V3DG_HD inline float stop_of_cut(float min_transmittance, float tolerance_px2) {
    return min_transmittance == kStopsByCut ? stop_of_tolerance(tolerance_px2) : min_transmittance;
}

// `min_transmittance` may be kStopsByCut if draw() finds out the transmittance itself.
template <class T, class Draw>
V3DG_INLINE void with_stop(float min_transmittance, const Draw& draw) {
    if (min_transmittance == kStopsBefore)
        draw(StopsBefore{});
    else
        draw(StopsBehind<T>{static_cast<T>(min_transmittance)});
}

// The pixels of a window, row major; colour has three channels.
template <class T>
struct Picture {
    Window window;
    T background[3];
    T* color;  // premultiplied, composed over the background
    T* alpha;
    // The expected depth: sum of weight * depth over alpha, 0 if alpha is 0; may be
    // null.
    T* depth;
    T* count = nullptr;  // number of blended gaussians, instead of depth; may be null
    float min_transmittance = kStopsBefore;
};

// Gradients of the picture, in its layout; `depth` may be null.
template <class T>
struct PictureGradient {
    const T* color;
    const T* alpha;
    const T* depth;
};

namespace cuda {

// A block blends one tile, and each of its warps four rows of it.
constexpr int kFrameTileWidth = 32, kFrameTileHeight = 16;
// The destination of a picture, as in Picture<float>. It may be requested after the
// first stages of a frame were enqueued.
struct PicturePlanes {
    float *color, *alpha, *depth;  // all may be null, or only depth
};

// One picture of a batch.
struct FrameImage {
    Intrinsics<float> camera;
    int width, height;
    int tile_columns, tile_rows;
    uint32_t first_tile;  // index in the batch; tiles are numbered row by row
    float background[3];
    PicturePlanes planes;
};

V3DG_HD inline uint32_t num_tiles_of(const FrameImage& image) {
    return static_cast<uint32_t>(image.tile_columns) * static_cast<uint32_t>(image.tile_rows);
}

// The pictures of a scene's frame, one per eye. The tiles of the second follow those of
// the first.
struct EyeImages {
    FrameImage image[2];
    uint32_t count;
    float min_transmittance;  // shared by both pictures; may be kStopsByCut
};

}  // namespace cuda
}  // namespace v3dg
