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
    // The records of all chunks. Those of one chunk are contiguous and in the order of
    // the draws. The order of chunks is arbitrary, and there are gaps between them.
    Buffer<Record<T>> records;
    Buffer<uint32_t> source;
    Buffer<uint64_t> chunk_first;
    Buffer<uint32_t> chunk_count;
    TileLists lists;
    GrowingLists growing;      // replaces `lists` if one thread draws few gaussians
    Buffer<uint64_t> scratch;  // for sorting a list of `growing`
    size_t num_chunks = 0;
    uint64_t room = 0;  // length of the used part of `records`, with gaps
    // Largest `room` so far, which determines how much memory was ever touched.
    uint64_t most_room = 0;
    // For the sensor pass: the normal and the instance of each record.
    Buffer<float> normals;
    Buffer<int32_t> instances;
};

// The sensor of a picture, and the ids that its channels output.
struct DrawnSensor {
    Sensor sensor;
    Span<const int32_t> instance_of_draw;   // [draws]
    Span<const int32_t> label_of_instance;  // empty if no instance has a label
};

struct RenderCounts {
    uint64_t in_frustum;  // gaussians whose extent meets the image
    uint64_t records;     // gaussians that reach a pixel centre
    uint64_t entries;     // entries in the lists of the window's tiles
    double project_seconds, bin_seconds, rasterize_seconds;
};

// Draws the window of a picture: projects, bins, sorts and blends the gaussians of
// `draws`. Gaussians of equal depth are blended in the order of the draws. If records
// and entries would need much memory, the picture is drawn in bands of tile rows, with
// the same result. Throws std::length_error above about 3e9 gaussians.
//
// If `keep_source` is true, the picture is drawn in one band, and the workspace can be
// passed to render_backward(). `source` then holds the index of each record's gaussian
// in the concatenation of all draws. If `stop` becomes true, the function returns soon,
// with an incomplete picture and incomplete counts. `sensor` may be null and requires
// float. If it is given, its channels are computed, except for `clipped`, and its
// meshes are mixed into the picture.
template <class T>
RenderCounts render(const std::vector<Draw<T>>& draws, const Intrinsics<T>& camera,
                    const Picture<T>& picture, bool keep_source, Workspace<T>& workspace,
                    const std::atomic<bool>* stop = nullptr, const DrawnSensor* sensor = nullptr);

// The gaussian with the largest blend weight in a pixel.
struct Pick {
    uint64_t gaussian;  // index in the concatenation of all draws
    float weight;       // blend weight
    float depth;
};

// Finds the gaussian with the largest blend weight in pixel (x, y). Returns false if no
// gaussian is drawn there.
bool pick(const std::vector<Draw<float>>& draws, const Intrinsics<float>& camera, int x, int y,
          Pick& picked);

// Sums over several views, to which render_backward() adds.
struct ViewSums {
    PoseSums<double>* pose;  // sums of this view only, initially zero; may be null
};

// Computes the gradients of the gaussians of a single draw. `workspace` must be the one
// that render() used for the picture. The gradients overwrite `out`; with `sums`, they
// are added to it. For gaussians without a record, `out` and `centers` are not changed.
template <class T>
void render_backward(const Draw<T>& draw, const Intrinsics<T>& camera, const Picture<T>& picture,
                     const PictureGradient<T>& d_picture, const Workspace<T>& workspace,
                     const GaussianRows<T>& out, const CenterGradients<T>& centers,
                     T d_background[3], const ViewSums* sums = nullptr);

}  // namespace v3dg
