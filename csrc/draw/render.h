#pragma once

#include <atomic>
#include <vector>

#include "base/buffer.h"
#include "frame/draw_list.h"
#include "frame/image.h"
#include "frame/record.h"
#include "frame/sensor.h"
#include "project/pose_gradient.h"
#include "tile_bin/tile_bin.h"

namespace v3dg {

// Temporary memory for drawing a picture on the CPU, reused from picture to picture.
template <class T>
struct Workspace {
    // The records of a chunk are contiguous, in the order of the draws. Chunks are in
    // any order, with gaps between them.
    Buffer<Record<T>> records;
    Buffer<uint32_t> source;
    Buffer<uint64_t> chunk_first;
    Buffer<uint32_t> chunk_count;
    TileLists lists;
    GrowingLists growing;      // instead of `lists`, if one thread draws few gaussians
    Buffer<uint64_t> scratch;  // for sorting a list of `growing`
    size_t num_chunks = 0;
    uint64_t room = 0;  // length of the used part of `records`, including gaps
    // Largest `room` so far, and thus the memory that was ever touched.
    uint64_t most_room = 0;
    // For the sensor pass: the normal and the instance of each record.
    Buffer<float> normals;
    Buffer<int32_t> instances;
};

// The sensor of a picture, and the ids that its channels name.
struct DrawnSensor {
    Sensor sensor;
    Span<const int32_t> instance_of_draw;   // [draws]
    Span<const int32_t> label_of_instance;  // empty: no instance has a label
};

struct RenderCounts {
    uint64_t in_frustum;  // gaussians whose extent meets the image
    uint64_t records;     // gaussians that reach a pixel centre
    uint64_t entries;     // records in the lists of the window's tiles
    double project_seconds, bin_seconds, rasterize_seconds;
};

// Draws the window of a picture: projects, bins, sorts and blends the gaussians of
// `draws`. Gaussians of equal depth are blended in the order of the draws. If records
// and entries would need much memory, the picture is drawn in bands of tile rows, with
// the same result. Throws std::length_error above about 3e9 gaussians.
//
// If `keep_source`, the picture is drawn in one band, and render_backward() can use the
// workspace. `source` is then the index of each record's gaussian, counted over all
// draws. If `stop` becomes true, the function returns soon; the picture and the counts
// are then incomplete. With a sensor (only float), which may be null, its channels are
// computed, and its meshes are mixed into the picture; not the channel `clipped`.
template <class T>
RenderCounts render(const std::vector<Draw<T>>& draws, const Intrinsics<T>& camera,
                    const Picture<T>& picture, bool keep_source, Workspace<T>& workspace,
                    const std::atomic<bool>* stop = nullptr, const DrawnSensor* sensor = nullptr);

// The gaussian with the largest blend weight in a pixel.
struct Pick {
    uint64_t gaussian;  // index, counted over all draws
    float weight;       // blend weight
    float depth;
};

// Finds the gaussian with the largest blend weight in pixel (x, y). Returns whether any
// gaussian is drawn there.
bool pick(const std::vector<Draw<float>>& draws, const Intrinsics<float>& camera, int x, int y,
          Pick& picked);

// The sums over views to which render_backward() adds.
struct ViewSums {
    PoseSums<double>* pose;  // of this view alone, zero initially; may be null
};

// Computes the gradients of the gaussians of a single draw. `workspace` must be the
// workspace of the picture's render() call. Gradients are overwritten; with `sums`,
// they are added to `out` instead. `out` and `centers` do not change for gaussians
// without a record.
template <class T>
void render_backward(const Draw<T>& draw, const Intrinsics<T>& camera, const Picture<T>& picture,
                     const PictureGradient<T>& d_picture, const Workspace<T>& workspace,
                     const GaussianRows<T>& out, const CenterGradients<T>& centers,
                     T d_background[3], const ViewSums* sums = nullptr);

}  // namespace v3dg
