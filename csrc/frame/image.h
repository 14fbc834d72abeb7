#pragma once

// The pictures that a frame draws, and their tiles.

#include <cstdint>

#include "camera/camera.h"

namespace v3dg {

constexpr int kTileSize = 32;  // px; the CPU draws pictures tile by tile

// The pixels [x0, x1) x [y0, y1) of a picture.
struct Window {
    int x0, y0, x1, y1;
    V3DG_INLINE int width() const { return x1 - x0; }
    V3DG_INLINE int height() const { return y1 - y0; }
    V3DG_INLINE bool contains(int x, int y) const { return x0 <= x && x < x1 && y0 <= y && y < y1; }
};

// A pixel stops where hardly any light gets through, and what is behind is left out. As gsplat's
// do: before a gaussian that would leave kMinTransmittance or less, which is left out too.
struct StopsBefore {};
// Behind the gaussian that leaves this much or less. That light goes to what was blended, in
// proportion: so no channel is off by more than this much of the difference between what was
// blended and what is behind it.
template <class T>
struct StopsBehind {
    T transmittance;
};

// What pictures hold: StopsBehind, or StopsBefore where that is negative.
constexpr float kStopsBefore = -1.0f;
template <class T, class Draw>
V3DG_INLINE void with_stop(float min_transmittance, const Draw& draw) {
    if (min_transmittance < 0)
        draw(StopsBefore{});
    else
        draw(StopsBehind<T>{static_cast<T>(min_transmittance)});
}

// The pixels of a window, row major; colour has three channels.
template <class T>
struct Picture {
    Window window;
    T background[3];
    T* color;  // premultiplied, the background composed last
    T* alpha;
    T* depth;  // expected depth, sum of weight * depth over alpha, 0 where alpha is 0; may be null
    T* count = nullptr;  // gaussians that were blended, in place of depth; may be null
    float min_transmittance = kStopsBefore;
};

// Gradients of the picture, laid out as it is; `depth` may be null.
template <class T>
struct PictureGradient {
    const T* color;
    const T* alpha;
    const T* depth;
};

namespace cuda {

// A block blends one tile, a warp a part of four rows of it.
constexpr int kFrameTileWidth = 32, kFrameTileHeight = 16;
// Where a picture is, as Picture<float> has it. It may be asked for after the first stages of a
// frame are enqueued.
struct PicturePlanes {
    float *color, *alpha, *depth;  // all may be null, or depth alone
};

// One picture of a batch.
struct FrameImage {
    Intrinsics<float> camera;
    int width, height;
    int tile_columns, tile_rows;
    uint32_t first_tile;  // in the batch, its tiles row by row
    float background[3];
    PicturePlanes planes;
};

// The pictures of a scene's frame: one for each eye. Tiles of the second follow on those of the
// first.
struct EyeImages {
    FrameImage image[2];
    uint32_t count;
    float min_transmittance;  // of both
};

}  // namespace cuda
}  // namespace v3dg
