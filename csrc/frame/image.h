#pragma once

// The pictures that a frame draws, and their tiles.

#include <cstdint>

#include "camera/camera.h"
#include "math/lanes.h"

namespace v3dg {

constexpr int kTileSize = 32;  // width and height of a tile on the CPU, px

// The pixels of a picture that are drawn: x in [x0, x1) and y in [y0, y1).
struct Window {
    int x0, y0, x1, y1;
    V3DG_INLINE int width() const { return x1 - x0; }
    V3DG_INLINE int height() const { return y1 - y0; }
    V3DG_INLINE bool contains(int x, int y) const { return x0 <= x && x < x1 && y0 <= y && y < y1; }
};

// The stop rule of gsplat. A pixel stops before a gaussian that would reduce its
// transmittance to kMinTransmittance or less. Neither this gaussian nor any behind it
// is blended.
struct StopsBefore {};
// A stop rule with a chosen transmittance. A pixel stops after the gaussian that
// reduces its transmittance to this value or less. The blend weights are then scaled
// up, so that they also use the transmittance that is left. Therefore the error of a
// channel is at most `transmittance` times the difference between the blended colour
// and the colour behind it.
template <class T>
struct StopsBehind {
    T transmittance;
};

// Special values of `min_transmittance`. kStopsBefore selects StopsBefore. kStopsByCut
// selects StopsBehind with the transmittance that stop_of_tolerance() returns for the
// cut. Both are negative; other values select StopsBehind.
constexpr float kStopsBefore = -1.0f, kStopsByCut = -2.0f;

// Returns the transmittance at which pixels of a cut stop. Up to the default tolerance,
// where a cut may consist of level 0 only, it is the value for assets,
// kMinTransmittance. It then grows with the square of the tolerance up to a thousandth.
// The difference is not visible in cuts of 9.5 px² per gaussian or more.
V3DG_HD inline float stop_of_tolerance(float tolerance_px2) {
    constexpr float kLeast = 1e-4f, kMost = 1e-3f, kLeastTolerance = 3;
    const float ratio = tolerance_px2 / kLeastTolerance;
    return min_of(max_of(kLeast * (ratio * ratio), kLeast), kMost);
}

// Returns `min_transmittance`. If it is kStopsByCut, returns the value for a cut with
// this tolerance.
V3DG_HD inline float stop_of_cut(float min_transmittance, float tolerance_px2) {
    return min_transmittance == kStopsByCut ? stop_of_tolerance(tolerance_px2) : min_transmittance;
}

// `min_transmittance` may be kStopsByCut if draw() computes the transmittance itself.
template <class T, class Draw>
V3DG_INLINE void with_stop(float min_transmittance, const Draw& draw) {
    if (min_transmittance == kStopsBefore)
        draw(StopsBefore{});
    else
        draw(StopsBehind<T>{static_cast<T>(min_transmittance)});
}

// A picture to draw: the pixels of a window, in row-major order. Colours have three
// channels.
template <class T>
struct Picture {
    Window window;
    T background[3];
    T* color;  // premultiplied by alpha, with the background added
    T* alpha;  // may be null
    // Expected depth: the sum of weight * depth, divided by alpha, or 0 if alpha is 0.
    // May be null.
    T* depth;
    // Number of blended gaussians per pixel, which is drawn instead of depth. May be
    // null.
    T* count = nullptr;
    float min_transmittance = kStopsBefore;
    // The distance between adjacent pixels in `color` and in `alpha`, in floats.
    int color_step = 3, alpha_step = 1;
};

// Planes that hold pictures of one size, one after another. With four channels, the
// colour includes alpha, and `alpha` is null.
struct BatchPlanes {
    float* color;  // (B, H, W, channels)
    int channels;  // 3 or 4
    float* alpha;  // (B, H, W), or null
    float* depth;  // (B, H, W), or null

    // Returns the planes with their pointers advanced to `pixel`, which is counted over
    // all pictures.
    V3DG_HD BatchPlanes from(size_t pixel) const {
        return {.color = color + channels * pixel,
                .channels = channels,
                .alpha = alpha == nullptr ? nullptr : alpha + pixel,
                .depth = depth == nullptr ? nullptr : depth + pixel};
    }
    V3DG_HD float* alpha_plane() const { return channels == 4 ? color + 3 : alpha; }
    V3DG_HD int alpha_step() const { return channels == 4 ? 4 : 1; }
};

// The gradients of a Picture, in the same layout. `depth` may be null.
template <class T>
struct PictureGradient {
    const T* color;
    const T* alpha;
    const T* depth;
};

namespace cuda {

// The size of a tile on CUDA, px. A block of threads blends a tile, and each warp
// blends four rows.
constexpr int kFrameTileWidth = 32, kFrameTileHeight = 16;
// The destination of a picture on CUDA (see Picture<float>). It may be set after the
// first stages of a frame are enqueued.
struct PicturePlanes {
    // Either all three pointers, only `alpha`, or only `depth` may be null.
    float *color, *alpha, *depth;
    bool has_four_channels;  // alpha is the fourth channel of `color`
};

// One picture of a batch.
struct FrameImage {
    Intrinsics<float> camera;
    int width, height;
    int tile_columns, tile_rows;
    // Index of the picture's first tile in the batch. Tiles are numbered row by row.
    uint32_t first_tile;
    float background[3];
    PicturePlanes planes;
};

V3DG_HD inline uint32_t num_tiles_of(const FrameImage& image) {
    return static_cast<uint32_t>(image.tile_columns) * static_cast<uint32_t>(image.tile_rows);
}

// The pictures of a scene's frame, for one eye or two. The tiles of the second picture
// follow those of the first.
struct EyeImages {
    FrameImage image[2];
    uint32_t count;
    float min_transmittance;  // used for both pictures; may be kStopsByCut
};

}  // namespace cuda
}  // namespace v3dg
