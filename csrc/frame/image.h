#pragma once

// The pictures that a frame draws, and their tiles.

#include <cstdint>

#include "camera/camera.h"

namespace v3dg {

constexpr int kTileSize = 32;  // Width and height of a tile on the CPU, px.

// The pixels of a picture that are drawn: x in [x0, x1) and y in [y0, y1).
struct Window {
    int x0, y0, x1, y1;
    V3DG_INLINE int width() const { return x1 - x0; }
    V3DG_INLINE int height() const { return y1 - y0; }
    V3DG_INLINE bool contains(int x, int y) const { return x0 <= x && x < x1 && y0 <= y && y < y1; }
};

// The stop rule of gsplat. A pixel stops before a gaussian that would leave a
// transmittance of at most kMinTransmittance. Neither this gaussian nor any behind it
// is blended.
struct StopsBefore {};
// The stop rule with a chosen transmittance. A pixel stops after the gaussian that
// leaves this transmittance or less. The blend weights are then scaled up to fill the
// transmittance that is left. So the error of a channel is at most `transmittance`
// times the difference between the blended colour and the colour behind.
template <class T>
struct StopsBehind {
    T transmittance;
};

// The value of `min_transmittance` that selects StopsBefore. It is negative; other
// values select StopsBehind.
constexpr float kStopsBefore = -1.0f;
template <class T, class Draw>
V3DG_INLINE void with_stop(float min_transmittance, const Draw& draw) {
    if (min_transmittance < 0)
        draw(StopsBefore{});
    else
        draw(StopsBehind<T>{static_cast<T>(min_transmittance)});
}

// A picture to draw: the pixels of a window, row major. Colours have three channels.
template <class T>
struct Picture {
    Window window;
    T background[3];
    T* color;  // premultiplied by alpha, plus background
    T* alpha;  // may be null
    // Expected depth: the sum of weight * depth, divided by alpha; 0 if alpha is 0. May
    // be null.
    T* depth;
    // Number of blended gaussians per pixel, drawn instead of depth. May be null.
    T* count = nullptr;
    float min_transmittance = kStopsBefore;
    // The distance between adjacent pixels, in floats, in `color` and in `alpha`.
    int color_step = 3, alpha_step = 1;
};

// The memory of pictures of one size, one after another. With four channels, the colour
// contains alpha, and `alpha` is null.
struct BatchPlanes {
    float* color;  // (B, H, W, channels)
    int channels;  // 3 or 4
    float* alpha;  // (B, H, W), or null
    float* depth;  // (B, H, W), or null

    // Returns the planes that begin at pixel `pixel`, which is counted over all
    // pictures.
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

// The size of a tile on CUDA, px. A block of threads blends a tile, each warp four
// rows.
constexpr int kFrameTileWidth = 32, kFrameTileHeight = 16;
// The destination of a picture on CUDA (see Picture<float>). A frame may obtain it
// after its first stages are enqueued.
struct PicturePlanes {
    // May be null: either all three, only alpha, or only depth.
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

// The pictures of the one or two eyes of a scene's frame. The tiles of the second
// picture follow the tiles of the first picture.
struct EyeImages {
    FrameImage image[2];
    uint32_t count;
    float min_transmittance;  // the same for both pictures
};

}  // namespace cuda
}  // namespace v3dg
